//! What a watched core tells of the letters that pass it: see [`Core::watch`](super::Core::watch).

use std::sync::Arc;

use fipa_acl::Letter;
use fipa_transport::{Kind, Outcome, Stream};

use super::SendId;

/// Something that has just happened to a letter here, on its way to one receiver.
///
/// Stream and sequence are the same wherever the letter passes: the sender's life and the sequence
/// tell it from all others.
#[derive(Debug, Clone)]
pub struct Notice {
    /// The stream of the letter.
    pub stream: Stream,
    /// Its position among all that the sender sends.
    pub sequence: u64,
    /// The name of the receiver.
    pub receiver: Arc<str>,
    /// What has happened.
    pub news: News,
}

/// What happens to letters.
#[derive(Debug, Clone)]
pub enum News {
    /// It begins its way here: an agent of this process sends it, or this service on behalf of
    /// somebody who cannot be watched (an old peer) or of itself (failure messages). Comes before
    /// the letter leaves.
    Sent {
        /// The call of [`Core::send`](super::Core::send), when there was one: letters with the
        /// same one are one message to several receivers.
        send: Option<SendId>,
        /// The letter.
        letter: Letter,
    },
    /// It was put into the queue of an agent of this process.
    Taken {
        /// How it came on its last stretch; none for what this process itself tells the agent.
        via: Option<Kind>,
        /// The letter.
        letter: Letter,
    },
    /// This gateway has taken it into custody.
    Passed {
        /// How it came.
        via: Kind,
        /// Whether it came from another host.
        remote: bool,
        /// The letter, with this gateway's stamp.
        letter: Letter,
    },
    /// It has an outcome.
    Settled {
        /// What became of it.
        outcome: Outcome,
        /// Whether this is what the sender is told; else what a gateway knows, which is told to
        /// the sender.
        sender: bool,
    },
}
