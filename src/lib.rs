//! Agent communication for robots, following the FIPA standards.
//!
//! # Concepts
//!
//! A process joins a [`Domain`] and registers [`Agent`]s in it. An agent is a name that sends and
//! receives messages. All agents of a domain exchange messages: through shared memory or Unix domain
//! sockets on one host, and through the gateways (`fipa up`) of the hosts between them.
//!
//! A [`Message`] (FIPA00061) has a [`Performative`], such as `request` or `inform`, receivers, and a
//! content of any bytes. A letter is a message in its envelope. [`Agent::send`] returns one [`Outcome`] per
//! receiver, within the deadline: delivered, with the transport; sent to a legacy peer, which confirms nothing; or
//! failed, with the reason.
//!
//! # Send and receive
//!
//! ```no_run
//! use fipa::{Domain, Performative::Request};
//!
//! #[tokio::main]
//! async fn main() -> fipa::Result<()> {
//!     let domain = Domain::from_environment().await?;
//!     let rover = domain.register("rover").await?;
//!     let lift = rover.message(Request).receiver("arm_1").content("(lift crate)");
//!     println!("{}", rover.send(lift).await?); // for example: arm_1: delivered via shm
//!     let letter = rover.receive().await?;
//!     println!("{}", letter.message().text());
//!     domain.close().await;
//!     Ok(())
//! }
//! ```
//!
//! A receiver may be a pattern such as `arm_.*`, or a [`Coalition`], one name for several agents.
//! [`Agent::reply`] starts an answer. [`Agent::loan`] loans memory for large content, which the
//! receivers on this host read in place. [`Message::parse`] reads a value from a content. Every error of
//! this crate converts into [`Error`].
//!
//! # Converse
//!
//! Calls lead the interaction protocols of FIPA, so that a program needs no state machines of its own
//! ([`protocol`]):
//!
//! ```no_run
//! # use std::time::Duration;
//! # use fipa::Performative::{Cfp, Request};
//! # async fn example(rover: fipa::Agent) -> fipa::Result<()> {
//! let timeout = Duration::from_secs(30);
//! let lift = rover.message(Request).receiver("arm_1").content("(lift crate)");
//! println!("{}", rover.request(lift, timeout).await?.result().await?.text());
//!
//! let carry = rover.message(Cfp).content("(carry crate)");
//! let mut net = rover.contract_net(carry, &["arm_.*"], timeout).await?;
//! let best = net.bids().proposals.first().cloned();
//! println!("{:?}", net.award(best.as_slice(), "", timeout).await?);
//! # Ok(())
//! # }
//! ```
//!
//! [`Agent::serve`] answers the other side, one task per conversation. [`Agent::publisher`] and
//! [`Agent::subscribe`] notify many agents. `monitor.check = "enforce"` checks all messages of a process
//! against the protocols.
//!
//! [`Agent::own`] and [`Agent::lock`] reserve resources that agents share ([`locks`]). [`Agent::found_coalition`] gives
//! several agents one name and a leader that another member replaces ([`coalitions`]).
//!
//! [`Agent::offer`] (feature `actions`) offers an action of a robot, and [`Agent::robot`] lists and invokes
//! those of another ([`actions`]).
//!
//! # Find
//!
//! [`Domain::agents`] and [`Domain::agents_of_type`] list the agents, [`Domain::changes`] is a stream of
//! the changes, and [`Domain::directory`] looks up and searches. [`Agent::df`] registers and finds
//! services with the directory facilitator of a gateway ([`platform`]).
//!
//! # Traces
//!
//! With the feature `opentelemetry`, a letter that is sent in a span of [OpenTelemetry](https://docs.rs/opentelemetry)
//! carries the identity of the span in its envelope (W3C Trace Context). [`Incoming::trace_context`] and
//! [`protocol::Task::trace_context`] return it, so that the receiver can start a child of the span.
//! Messages of calls such as [`Agent::request`] are letters, too. Without a span, nothing is added.
//!
//! The span is that of `opentelemetry::Context::current()` when the letter is sent: at the call of [`Agent::send`] or
//! [`Agent::send_loan`], before its future is polled, and while the futures of other calls are polled. It is current for
//! both in an `async` block that `opentelemetry::context::FutureExt::with_context` or `tracing::Instrument::instrument`
//! wraps. An entered span of the crate `tracing` is current if the subscriber has the layer of `tracing-opentelemetry`,
//! without `with_context_activation(false)`, and no filter disables the span for this layer.
//!
//! The program has to use the version of `opentelemetry` that this crate uses (0.33), and `tracing-opentelemetry` 0.34:
//! each minor version of `opentelemetry` has a current context of its own.
//!
//! # Configure
//!
//! [`Domain::from_environment`] reads the file named by `$FIPA_CONFIG`, else `./fipa.toml`, else
//! `~/.config/fipa/fipa.toml`, else `/etc/fipa/fipa.toml`; without a file it uses the defaults, as
//! [`Config::default`] does.
//! [`Domain::open`] takes a [`Config`]. The module [`config`] has all keys.
//!
//! # Without an async runtime
//!
//! Threads wait for the calls with [`Wait::wait`](blocking::Wait::wait).
//!
//! # Examples and tools
//!
//! The directory `examples` of the repository has a program per topic. [`watch`](admin::watch) observes the letters of
//! all processes of a domain on this host, [`routes`](admin::routes) reports the routes that letters would take now,
//! [`doctor`](admin::doctor) checks a machine, [`keys`](admin::keys) (feature `secure`) manages the keys of this host,
//! [`pairing`](admin::pairing) (feature `secure`) exchanges certificates with another host, and [`Gateway`] (feature
//! `net`) is the gateway that `fipa up` runs. `docs/architecture.md` describes the other crates: delivery, transports and
//! protocols.
//!
#![cfg_attr(
    not(feature = "actions"),
    doc = "[`actions`]: https://docs.rs/fipa/latest/fipa/actions/index.html"
)]
#![cfg_attr(
    not(feature = "opentelemetry"),
    doc = "[`Incoming::trace_context`]: https://docs.rs/fipa/latest/fipa/struct.Incoming.html#method.trace_context"
)]
#![cfg_attr(
    not(feature = "opentelemetry"),
    doc = "[`protocol::Task::trace_context`]: https://docs.rs/fipa/latest/fipa/protocol/struct.Task.html"
)]
#![cfg_attr(
    not(feature = "net"),
    doc = "[`Gateway`]: https://docs.rs/fipa/latest/fipa/struct.Gateway.html"
)]

mod access;
#[cfg(feature = "actions")]
pub mod actions;
pub mod admin;
mod agent;
mod any_error;
pub mod blocking;
#[cfg(feature = "protocols")]
pub mod coalitions;
pub mod config;
mod domain;
#[cfg(any(feature = "protocols", feature = "secure", feature = "web"))]
mod durable;
pub mod error;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
#[cfg(feature = "net")]
mod gateway;
#[cfg(feature = "protocols")]
pub mod locks;
#[cfg(feature = "protocols")]
pub mod platform;
#[cfg(feature = "protocols")]
pub mod protocol;
#[cfg(feature = "protocols")]
pub mod topics;
#[cfg(any(feature = "protocols", feature = "secure"))]
mod wall_clock;
#[cfg(feature = "web")]
pub mod web;

pub use agent::delivery::{Deliveries, Delivery};
pub use agent::incoming::Incoming;
pub use agent::sender_tasks::SenderTasks;
pub use agent::{Agent, Loan, Unread};
pub use any_error::{Error, Result};
pub use config::Config;
#[cfg(feature = "shm")]
pub use domain::ContentCounts;
pub use domain::coalition::Coalition;
pub use domain::directory_view::DirectoryView;
pub use domain::{Domain, Follower, RegisterOptions};
pub use fipa_acl::{
    AgentId, Envelope, EnvelopeParams, Letter, Message, MessageBuilder, Payload, Performative,
    Problem, Time,
};
#[cfg(feature = "protocols")]
pub use fipa_monitor as monitor;
pub use fipa_mts::DeliveryFailure;
pub use fipa_sds::{
    Change, Entry, Matcher, Members, Pattern, Query, Reach, Role, Source, Watch, is_pattern,
};
pub use fipa_transport::{Attempt, FailureReason, Incarnation, Kind, Location, Outcome, Signature};
#[doc(hidden)]
pub use fipa_transport::{fnv1a, log_limit, threads};
#[cfg(feature = "shm")]
pub use fipa_transport_shm::is_in_place;
#[cfg(feature = "net")]
pub use gateway::{Gateway, Neighbor, SelfCheck, SelfCheckError};
