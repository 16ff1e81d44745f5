//! The service directory: the known agents, their locations, and notifications of joining and
//! leaving agents.
//!
//! * [`Entry`] is the known data of one registration; [`Registration`] is the data that its owner
//!   supplies.
//! * [`Directory`] is the trait of all back ends; [`Watch`] reports changes. [`View`] is a view of a
//!   directory without I/O, for readers that must not wait.
//! * [`MemoryDirectory`], [`StaticDirectory`], [`ContactDirectory`], [`HostDirectory`],
//!   [`ExchangeDirectory`] and (feature `mdns`) `MdnsDirectory` are its back ends;
//!   [`MergedDirectory`] merges several directories into one view.
//! * [`Exchange`] decides which entries gateways send each other about their agents.
//! * [`Query`] and [`Pattern`] search; [`resolve()`] turns the name of a receiver into entries.
//! * A coalition is also an entry: its role lists its [`Members`].
//!
//! The crate depends on `fipa-transport` for two types: an entry lists
//! [`Location`](fipa_transport::Location)s, and an [`Incarnation`](fipa_transport::Incarnation)
//! distinguishes a registration from an earlier one of the same name. It depends on `fipa-acl` for
//! [`Pattern`] and the characters that a name may have
//! ([`misleading_character`](fipa_acl::misleading_character)).
//!
//! Letters, routes and connections do not belong here. The delivery core decides which location of
//! an agent is tried first.

// Must come first: later modules use its macro.
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
mod reserved;
mod resolve;
mod shares;
mod view;
mod watch;

pub use coalition::{Members, MembersError};
pub use contacts::{ContactDirectory, ContactError};
pub use directory::{DeregisterError, Directory, RegisterError, Updated};
pub use entry::{Entry, EntryError, MtsId, Reach, Registration, Role, Source};
pub use exchange::{
    DfEntry, EXCHANGE_ONTOLOGY, Exchange, ExchangeDirectory, ExchangeError, LetterKind, OwnDfEntry,
    Present,
};
pub use fipa_acl::{Pattern, PatternError, is_pattern};
pub use host::{
    Cancellation, Departures, HostConfig, HostCounts, HostDirectory, HostError, SocketId,
};
#[cfg(feature = "mdns")]
pub use mdns::{MdnsConfig, MdnsDirectory, MdnsError, MdnsStatus, Multicast, probe};
pub use memory::{MemoryDirectory, StaticDirectory};
pub use merged::MergedDirectory;
pub use name::{MAX_NAME, NameError, check_characters, check_name, to_name};
pub use query::{Matcher, Query};
pub use reserved::{reserved_for, second_name};
pub use resolve::{Resolution, is_leaderless, is_legacy_pattern, resolve, resolve_legacy};
pub use view::{Snapshot, View};
pub use watch::{Change, Subscriber, Watch};
