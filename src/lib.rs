//! Agent communication for robots, to the FIPA standards: what a robot process embeds.
//!
//! A process joins a [`Domain`], registers [`Agent`]s in it, and these exchange FIPA messages with
//! all agents of the domain: through shared memory or Unix domain sockets on one host, and through
//! the host's gateway with those of other hosts.
//!
//! ```no_run
//! use fipa::{AgentId, Config, Domain, Performative};
//!
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let domain = Domain::open(&Config::load(&fipa::config::Sources::from_environment())?).await?;
//! let agent = domain.register("rover")?;
//! let request = agent
//!     .message(Performative::Request)
//!     .receiver(AgentId::new("arm_1")?)
//!     .content("(lift sample-3)")
//!     .build()?;
//! let deliveries = agent.send(request).await?;
//! println!("{deliveries}");
//! let letter = agent.receive().await?;
//! println!("{}", letter.message);
//! # Ok(())
//! # }
//! ```
//!
//! * [`Domain`] is this process's membership, [`Agent`] one name in it, [`Coalition`] a name for
//!   several.
//! * [`watch`] sees the letters of all processes of a domain on this host pass.
//! * [`config`] is what the owner of a robot chooses, in one TOML file.
//! * [`blocking`] is for processes without an async runtime.
//! * [`routes`] tells which way letters would go now, and why.
//! * [`doctor`] says what is wrong with a machine.
//! * [`keys`] (feature `secure`) is who may speak with this host from others.
//! * [`Gateway`] (feature `net`) is what `fipa up` runs; robot processes do not need it.
//!
//! What must not live here: delivery (that is `fipa-mts`), transports, terminals.

mod access;
mod agent;
pub mod blocking;
#[cfg(feature = "monitor")]
mod checks;
#[cfg(not(feature = "monitor"))]
#[path = "checks_disabled.rs"]
mod checks;
mod coalition;
pub mod config;
mod delivery;
#[cfg(feature = "monitor")]
mod demultiplexer;
#[cfg(not(feature = "monitor"))]
#[path = "demultiplexer_disabled.rs"]
mod demultiplexer;
pub mod doctor;
mod domain;
mod endpoint;
mod error;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod gate;
#[cfg(feature = "net")]
mod gateway;
mod host_directory;
mod incoming;
mod keeper;
#[cfg(feature = "secure")]
pub mod keys;
mod owner;
mod place;
#[cfg(feature = "monitor")]
pub mod protocol;
pub mod routes;
mod service;
pub mod watch;

pub use agent::{Agent, Loan, Unread};
pub use coalition::{Coalition, CoalitionError};
pub use config::Config;
pub use delivery::{Deliveries, Delivery};
pub use domain::{Domain, RegisterOptions};
#[cfg(feature = "monitor")]
pub use error::ProtocolError;
pub use error::{OpenError, ReceiveError, SendError};
pub use fipa_acl::{
    AgentId, AgentIdError, BuildError, DecodeError, Envelope, EnvelopeParams, Letter, Message,
    MessageBuilder, Payload, Performative, Time,
};
#[cfg(feature = "monitor")]
pub use fipa_monitor as monitor;
pub use fipa_mts::DeliveryFailure;
pub use fipa_sds::{
    Change, Directory, Entry, Matcher, Members, MembersError, Pattern, PatternError, Query, Reach,
    RegisterError, Role, Source, Watch, is_pattern,
};
pub use fipa_transport::{
    Attempt, FailureReason, Forked, Incarnation, Kind, ListenError, Location, Outcome, Signature,
    WayError, WayFault,
};
#[cfg(feature = "net")]
pub use gateway::{Gateway, Neighbour};
pub use incoming::Incoming;
pub use place::PlaceError;
