//! The service directory: which agents there are, where they can be reached, and who joins and
//! leaves.
//!
//! * [`Entry`] is what is known about one registration; [`Registration`] is what its owner says.
//! * [`Directory`] is the one view everybody reads; [`Watch`] tells what changes in it.
//! * [`MemoryDirectory`], [`StaticDirectory`], [`ContactDirectory`], [`HostDirectory`],
//!   [`ExchangeDirectory`] and (feature `mdns`) `MdnsDirectory` are its back ends;
//!   [`MergedDirectory`] makes one view of several.
//! * [`Exchange`] decides what gateways tell each other of their agents.
//! * [`Query`] and [`Pattern`] search; [`resolve`] turns the name of a receiver into entries.
//! * A coalition is an entry, too: its role names its [`Members`].
//!
//! The crate depends on `fipa-transport`, sideways, for two words only: an entry lists
//! [`Location`](fipa_transport::Location)s, and a registration is told from an earlier one of the
//! same name by its [`Incarnation`](fipa_transport::Incarnation); and on `fipa-acl` for which
//! characters a name may have ([`is_unprintable`](fipa_acl::is_unprintable)).
//!
//! What must not live here: letters, routes, connections. Which of an agent's locations is tried
//! first is the delivery core's business.

// First, for its macro.
#[macro_use]
mod table;

mod coalition;
mod contacts;
mod directory;
mod entry;
mod exchange;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod host;
#[cfg(feature = "mdns")]
mod mdns;
mod memory;
mod merged;
mod name;
mod query;
mod resolve;
mod watch;

pub use coalition::{Members, MembersError};
pub use contacts::ContactDirectory;
pub use directory::{DeregisterError, Directory, RegisterError, Updated};
pub use entry::{Entry, EntryError, Mts, Reach, Registration, Role, Source};
pub use exchange::{EXCHANGE_ONTOLOGY, Exchange, ExchangeDirectory, ExchangeError, Present};
pub use host::{Departures, HostConfig, HostDirectory, HostError, SocketId};
#[cfg(feature = "mdns")]
pub use mdns::{MdnsConfig, MdnsDirectory, MdnsError, MdnsStatus, Multicast, Withdrawal, probe};
pub use memory::{MemoryDirectory, StaticDirectory};
pub use merged::MergedDirectory;
pub use name::{MAX_NAME, NameError, check_name};
pub use query::{Matcher, Pattern, PatternError, Query, is_pattern};
pub use resolve::{Resolution, is_legacy_pattern, resolve, resolve_legacy};
pub use watch::{Change, Subscriber, Watch};
