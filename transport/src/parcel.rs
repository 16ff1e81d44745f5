//! The parcel: one letter for one receiver, or one of the short notes that delivery cores send
//! each other about letters.

use std::sync::Arc;
use std::time::Duration;

use fipa_acl::Letter;

use crate::{Incarnation, Outcome};

/// The pair within which order and deduplication hold: one life of a sender, one life of a
/// receiver.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Stream {
    /// The sending agent. [`Incarnation::UNKNOWN`] for letters of old peers, which have neither
    /// order nor deduplication.
    pub sender: Incarnation,
    /// The receiving agent.
    pub receiver: Incarnation,
}

/// What a transport carries: the header that the promises of delivery need, and a body.
///
/// A parcel has exactly one receiver. A letter to several receivers is several parcels that share
/// the letter's memory.
#[derive(Debug, Clone, PartialEq)]
pub struct Parcel {
    /// The name of the receiving agent, 1 to [`Parcel::MAX_NAME`] bytes of UTF-8. For a note
    /// ([`Body::Report`], [`Body::Credit`], [`Body::Predecessor`]): the receiver of the letters it
    /// is about.
    pub receiver: Arc<str>,
    /// The stream that the letter belongs to.
    pub stream: Stream,
    /// Position among everything that this registration of the sender sends, from 1. Later letters
    /// of a stream have higher numbers, not necessarily the next one.
    pub sequence: u64,
    /// The letter of the stream that the receiver must have taken before this one, or 0: the
    /// highest lower sequence that was open (without an outcome) in the sender's process when it
    /// dispatched this copy.
    pub after: u64,
    /// The hand-over: a number that the service which hands the letter over uses for no other
    /// hand-over, and that rises from each to the next. A report repeats the number of the latest
    /// hand-over of its letter by the service that it goes to. 0 in credits.
    pub transfer: u64,
    /// Rest of the letter's deadline. Time in transit is not subtracted, because hosts need not
    /// agree on the clock.
    pub remaining: Duration,
    /// The letter, or the note about letters.
    pub body: Body,
}

impl Parcel {
    /// Longest name of a receiver, in bytes.
    pub const MAX_NAME: usize = 4096;
}

/// The kinds of parcels.
#[derive(Debug, Clone, PartialEq)]
pub enum Body {
    /// A letter to be delivered.
    Letter(Letter),
    /// The end of a custody. It goes back to the service that handed the letter over; stream,
    /// sequence and transfer name the letter and the hand-over.
    Report(Report),
    /// There is room again for letters of this stream, after [`crate::Answer::Busy`].
    Credit,
    /// The letter named by stream and sequence has a lower predecessor now: the `after` of this
    /// parcel. It goes to the service that the letter was handed to.
    Predecessor,
}

/// How the custody of a letter ended.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Report {
    /// The letter has an outcome, as its sender is to be told, with the attempts made since
    /// custody.
    Settled(Outcome),
    /// The letter is handed back, because its predecessor is not here. The service forgets it, and
    /// its sender dispatches it again.
    Returned {
        /// Whether an attempt by this service, or by one behind it, may have delivered the letter.
        uncertain: bool,
    },
    /// The letter is handed back, because its receiver's registration has left this host. Not
    /// taken, neither here nor behind this service.
    Moved,
}
