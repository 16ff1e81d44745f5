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
    /// The name of the receiving agent, 1 to [`Parcel::MAX_NAME`] bytes of UTF-8. For a report or
    /// a credit: the receiver of the letters it is about.
    pub receiver: Arc<str>,
    /// Whose order this letter belongs to.
    pub stream: Stream,
    /// Position among everything this life of the sender sends, from 1: later letters of a
    /// stream have higher numbers, not necessarily the next one.
    pub sequence: u64,
    /// The letter of the stream that must have been taken before this one, or 0 when there is
    /// none: the nearest earlier one that has no outcome yet. A letter that expired is thus left
    /// out of the chain and not waited for.
    pub after: u64,
    /// What is left of the letter's deadline. Time spent on the way is not subtracted: hosts need
    /// not agree on the clock.
    pub remaining: Duration,
    /// How many times the letter went from host to host so far; at least
    /// [`LAST_HOPS`](Self::LAST_HOPS) when it must not follow a receiver that has moved.
    pub hops: u8,
    /// What it is about.
    pub body: Body,
}

impl Parcel {
    /// Longest name of a receiver, in bytes.
    pub const MAX_NAME: usize = 4096;

    /// With this many [`hops`](Self::hops) a letter is for this life of its receiver only: it has
    /// followed its receiver once, or an attempt that nothing was heard of may have delivered it.
    pub const LAST_HOPS: u8 = 2;
}

/// The kinds of parcels.
#[derive(Debug, Clone, PartialEq)]
pub enum Body {
    /// A letter to be delivered.
    Letter(Letter),
    /// What became of a letter that had been taken into custody. Goes back to whoever handed the
    /// letter over; stream and sequence say which letter.
    Report(Report),
    /// There is room again for letters of this stream, after [`crate::Answer::Busy`].
    Credit,
}

/// The outcome of a letter that was in custody.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Report {
    /// The outcome as the sender is to be told, with the attempts made since custody.
    pub outcome: Outcome,
}
