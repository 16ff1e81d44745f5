//! The [`Transport`] trait, which every transport implements, and the types that it uses.
//!
//! * [`Transport`] carries [`Parcel`]s to [`Location`]s and reports the conclusion of each attempt.
//! * [`Sink`] receives arrivals and conclusions: the delivery core of `fipa-mts`.
//! * [`Outcome`] is the final result of a letter, one per receiver.
//! * [`wire`] is the fixed layout of a parcel in mailboxes and network frames.
//! * [`OwnerProcess`] tells a process from a forked child.
//! * [`DomainUsers`] are the users whose processes share the files of a domain.
//! * [`PeerId`] names the party that has one share of a bound.
//! * [`TokenBucket`] limits the rate of a peer or a sender.
//! * [`counts`] has the counters of a process, which others read.
//! * [`log_limit`] limits the rate of log lines.
//! * `conformance` (feature of that name) is the suite that every implementation passes.
//!   [`Faulty`] wraps a transport and injects faults.
//!
//! Sockets, shared memory, routes and retries belong to other crates. A transport tries once and
//! reports; retries, other routes and order belong to the delivery core.

mod conclusion;
#[cfg(feature = "conformance")]
pub mod conformance;
pub mod counts;
mod error;
mod faulty;
mod fnv;
mod incarnation;
mod location;
pub mod log_limit;
mod outcome;
mod owner;
mod parcel;
mod peer_id;
mod principal;
mod quota_address;
mod serde_text;
pub mod threads;
mod token_bucket;
mod transport;
mod users;
pub mod wire;

pub use conclusion::{Abandoned, Answer, Conclusion};
pub use error::{ListenError, TransportError, TransportErrorKind};
pub use faulty::{Fault, Faulty};
pub use fnv::fnv1a;
pub use incarnation::{Incarnation, IncarnationError};
pub use location::{Kind, Location, LocationError, Signature};
pub use outcome::{Attempt, FailureReason, Outcome};
pub use owner::{Forked, OwnerProcess};
pub use parcel::{Body, Parcel, Realm, Report, Stream};
pub use peer_id::PeerId;
pub use principal::Principal;
pub use quota_address::{quota_address, scoped_quota_address};
pub use token_bucket::TokenBucket;
pub use transport::{
    Arrival, Arriving, AttemptId, Hop, Introduction, LegacySource, LoanedContent, Mandate,
    Reaction, Sink, Ticket, Transport,
};
pub use users::{DirectoryError, DomainUsers, Intrusion};
