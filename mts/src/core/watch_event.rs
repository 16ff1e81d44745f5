//! Notifications about letters from a watched core: see [`Core::watch`](super::Core::watch).

use std::sync::Arc;

use fipa_acl::Letter;
use fipa_transport::{Kind, Outcome, Stream};

use super::ids::SubmissionId;

/// An event of a letter to one receiver.
///
/// Stream and sequence number are the same at every point of the route: the sender's incarnation
/// and the sequence number identify the letter.
#[derive(Debug, Clone)]
pub struct Notice {
    /// The stream of the letter.
    pub stream: Stream,
    /// Sequence number among all letters of the sender.
    pub sequence: u64,
    /// Name of the receiver.
    pub receiver: Arc<str>,
    /// The event.
    pub news: News,
}

/// An event of a letter.
#[derive(Debug, Clone)]
pub enum News {
    /// An agent of this process sends it, or this service does: on behalf of a legacy peer, which
    /// cannot be watched, or in its own name (failure messages). Precedes the first attempt.
    Sent {
        /// The call of [`Core::submit`](super::Core::submit), if any: letters of one call carry one
        /// message to several receivers.
        submission: Option<SubmissionId>,
        /// The letter.
        letter: Letter,
    },
    /// It was added to the queue of an agent of this process.
    Taken {
        /// Transport of the last hop; `None` for letters that this process itself sends to the
        /// agent.
        via: Option<Kind>,
        /// The letter.
        letter: Letter,
    },
    /// This gateway has taken it into custody.
    Passed {
        /// Transport by which it arrived.
        via: Kind,
        /// Whether it came from another host.
        remote: bool,
        /// The letter, with this gateway's stamp.
        letter: Letter,
    },
    /// It has an outcome.
    Settled {
        /// The outcome.
        outcome: Outcome,
        /// Whether this is the outcome reported to the sender; otherwise it is the outcome at a
        /// gateway, which reports it towards the sender.
        sender: bool,
    },
}
