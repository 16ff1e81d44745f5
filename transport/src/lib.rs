//! The one trait behind which every way of moving a letter stands, and the words it is spoken in.
//!
//! * [`Transport`] carries [`Parcel`]s to [`Location`]s and says what became of each.
//! * [`Sink`] is who listens: the delivery core of `fipa-mts`.
//! * [`Outcome`] is what a sender is told in the end, one per receiver.
//! * [`wire`] is the fixed layout of a parcel, shared by the mailbox and the network frame.
//! * [`OwnerProcess`] tells a process from a forked child.
//! * [`Allowance`] is how much a peer or a sender may still do.
//! * `conformance` (feature of that name) is the suite that every implementation passes;
//!   [`Faulty`] wraps a transport and makes it fail on purpose.
//!
//! What must not live here: sockets, shared memory, routes, retries. A transport tries once and
//! reports; trying again, elsewhere or in order is the delivery core's business.

mod allowance;
#[cfg(feature = "conformance")]
pub mod conformance;
mod faulty;
mod incarnation;
mod location;
mod outcome;
mod owner;
mod parcel;
mod transport;
pub mod wire;

pub use allowance::Allowance;
pub use faulty::{Fault, Faulty};
pub use incarnation::Incarnation;
pub use location::{Kind, Location, LocationError, Signature};
pub use outcome::{Attempt, FailureReason, Outcome};
pub use owner::{Forked, OwnerProcess};
pub use parcel::{Body, Parcel, Report, Stream};
pub use transport::{
    Abandoned, Answer, Arrival, Arriving, AttemptId, Conclusion, Hop, Introduction, LegacySource,
    ListenError, LoanedContent, Mandate, Principal, Sink, Ticket, Transport, Verdict, WayError,
    WayFault,
};
