//! The end of an attempt: the answer of the other side, or whether the parcel can have reached it.

use crate::error::TransportError;
use crate::{FailureReason, Kind};

/// The other side's answer to a parcel.
///
/// Exhaustive: a new answer compiles only after every transport and the core know what it means.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Answer {
    /// Accepted into the named agent's queue, now or when an earlier copy arrived. Reports and
    /// credits are accepted, too.
    Accepted,
    /// Delivered by the service that got the parcel, over this transport. Only for services of the
    /// same host: those of other hosts get [`Accepted`](Self::Accepted).
    Delivered {
        /// The transport that delivered the letter. For a letter to another host, the transport
        /// between the hosts.
        via: Kind,
    },
    /// Accepted for forwarding; a report follows.
    Custody,
    /// No room; a credit follows when there is room.
    Busy,
    /// The predecessor of the letter has not been accepted yet.
    OutOfOrder {
        /// Sequence of the last letter of the stream that was accepted.
        last: u64,
    },
    /// Handed back, because the letter's predecessor is not here. Its sender dispatches the letter
    /// again. Not a failure of the route.
    Returned {
        /// Whether an attempt by this service, or by a later one, may have delivered the letter.
        uncertain: bool,
    },
    /// Not accepted: the receiver's registration that this letter is for has just left this host.
    Moved,
    /// Finally not accepted.
    Failed {
        /// The reason.
        reason: FailureReason,
        /// Details for people; at most [`Answer::MAX_DETAIL`] bytes are transmitted.
        detail: String,
    },
}

impl Answer {
    /// Maximum length of a transmitted failure detail, in bytes.
    pub const MAX_DETAIL: usize = 160;
    /// Number of answers that contradict their parcels at which a connection ends.
    pub const MAX_CONTRADICTIONS: u32 = 16;

    /// Whether no receiver can give this answer to a parcel with this predecessor: a letter is not out
    /// of order after its predecessor was accepted.
    #[must_use]
    pub fn contradicts(&self, after: u64) -> bool {
        matches!(self, Self::OutOfOrder { last } if *last >= after)
    }

    /// A final refusal.
    pub fn failed(reason: FailureReason, detail: impl Into<String>) -> Self {
        Self::Failed {
            reason,
            detail: detail.into(),
        }
    }
}

/// The end of an attempt that its caller [abandoned](crate::Transport::abandon).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Abandoned {
    /// No byte of the parcel has reached the other side, and none will.
    NotSent,
    /// The other side may have the parcel.
    Unconfirmed,
}

impl Abandoned {
    /// The conclusion of the attempt, with this error.
    #[must_use]
    pub fn conclusion(self, error: TransportError) -> Conclusion {
        match self {
            Self::NotSent => Conclusion::NotSent(error),
            Self::Unconfirmed => Conclusion::Unconfirmed(error),
        }
    }
}

/// The end of an attempt.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Conclusion {
    /// The other side answered.
    Answered(Answer),
    /// Handed to a peer that cannot answer.
    Handed,
    /// The other side has not received the parcel, and will not.
    NotSent(TransportError),
    /// The other side may have received the parcel.
    Unconfirmed(TransportError),
}
