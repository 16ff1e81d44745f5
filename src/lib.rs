//! Agent communication for robots after the FIPA standards, as a library for robot processes.
//!
//! A process joins a [`Domain`] and registers [`Agent`]s in it. The agents exchange FIPA messages
//! with all agents of the domain: through shared memory or Unix domain sockets on one host, and
//! through the gateway of the host with agents on other hosts.
//!
//! ```no_run
//! use fipa::{AgentId, Config, Domain, Performative};
//!
//! # async fn example() -> Result<(), Box<dyn std::error::Error>> {
//! let domain = Domain::open(&Config::load(&fipa::config::Sources::from_environment())?).await?;
//! let agent = domain.register("rover").await?;
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
//! * [`Domain`] is the membership of this process in a domain. [`Agent`] is a registered name,
//!   [`Coalition`] a name for several agents.
//! * [`watch`] observes the letters of all processes of a domain on this host.
//! * [`config`] is the configuration, one TOML file.
//! * [`blocking`] has the same calls for processes without an async runtime.
//! * [`routes`] reports the routes that letters would take now, and the reasons.
//! * [`doctor`] checks whether a machine meets the requirements.
//! * [`keys`] (feature `secure`) manages the keys of this host and the certificates of its peers.
//! * [`locks`] (feature `locks`) reserves resources that agents share.
//! * [`platform`] (feature `monitor`) registers and finds services with the directory facilitator of a
//!   gateway, and lists agents with its agent management system.
//! * [`Gateway`] (feature `net`) is the gateway that `fipa up` runs; robot processes do not need it.
//!
//! Not in this crate: delivery (`fipa-mts`), the transports, and terminal output (`fipa-cli`).
//!
#![cfg_attr(
    not(feature = "net"),
    doc = "[`Gateway`]: https://docs.rs/fipa/latest/fipa/struct.Gateway.html"
)]
#![cfg_attr(
    not(feature = "secure"),
    doc = "[`keys`]: https://docs.rs/fipa/latest/fipa/keys/index.html"
)]
#![cfg_attr(
    not(feature = "locks"),
    doc = "[`locks`]: https://docs.rs/fipa/latest/fipa/locks/index.html"
)]

mod access;
mod access_gate;
mod agent;
mod background;
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
mod dir_maintenance;
mod directory_view;
pub mod doctor;
mod domain;
mod domain_dir;
mod endpoint;
mod error;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
#[cfg(feature = "net")]
mod gateway;
mod host_directory;
mod incoming;
#[cfg(feature = "secure")]
pub mod keys;
#[cfg(feature = "locks")]
mod lock_slot;
#[cfg(not(feature = "locks"))]
#[path = "lock_slot_disabled.rs"]
mod lock_slot;
#[cfg(feature = "locks")]
pub mod locks;
mod owner;
#[cfg(feature = "monitor")]
pub mod platform;
#[cfg(any(feature = "monitor", feature = "net"))]
mod presence;
#[cfg(feature = "monitor")]
pub mod protocol;
pub mod routes;
mod service;
pub mod watch;

pub use agent::{Agent, Loan, Unread};
pub use coalition::{Coalition, CoalitionError};
pub use config::Config;
pub use delivery::{Deliveries, Delivery};
pub use directory_view::DirectoryView;
pub use domain::{Domain, RegisterOptions};
pub use domain_dir::DomainDirError;
#[cfg(feature = "monitor")]
pub use error::ProtocolError;
pub use error::{OpenError, ReceiveError, SendError};
pub use fipa_acl::{
    AgentId, AgentIdError, BuildError, DecodeError, EncodeError, Envelope, EnvelopeParams,
    ErrorChain, Letter, Message, MessageBuilder, Payload, Performative, PerformativeError, Problem,
    Time, TimeError,
};
#[cfg(feature = "monitor")]
pub use fipa_monitor as monitor;
pub use fipa_mts::{DeliveryFailure, PostError};
#[cfg(feature = "mdns")]
pub use fipa_sds::MdnsError;
pub use fipa_sds::{
    Change, DeregisterError, Entry, EntryError, HostError, Matcher, Members, MembersError,
    NameError, Pattern, PatternError, Query, Reach, RegisterError, Role, Source, Watch, is_pattern,
};
pub use fipa_transport::{
    Attempt, FailureReason, Forked, Incarnation, IncarnationError, Kind, ListenError, Location,
    LocationError, Outcome, Signature, TransportError, TransportErrorKind,
};
#[cfg(feature = "net")]
pub use gateway::{Gateway, Neighbour};
pub use incoming::Incoming;
