//! Bounds of the memory of a monitor.

use std::time::Duration;

/// Bounds of the conversations that a monitor keeps: their number, their memory and their time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct MonitorLimits {
    /// Maximum number of conversations, including embedded ones. Beyond it, the monitor evicts the
    /// least recently active conversation that is over or, if there is none, the least recently
    /// active one. A peer has at most an eighth, or eight: beyond it, the monitor evicts conversations
    /// of that peer. See [`bytes`](Self::bytes) for the peer of a conversation.
    pub conversations: usize,
    /// Maximum number of bytes of all conversations. A peer has at most an eighth: beyond it, the
    /// monitor evicts conversations of that peer. A conversation belongs to the agent that began it,
    /// or to the [`Header::peer`](crate::Header::peer) of its first message. Those of the monitored
    /// agent count toward the total only.
    pub bytes: usize,
    /// Maximum number of participants of a conversation.
    pub participants: usize,
    /// Maximum number of conversations embedded in one.
    pub embedded: usize,
    /// Time for which a conversation is kept after its end.
    pub ended: Duration,
    /// Time for which a conversation is kept without a message.
    pub idle: Duration,
}

impl Default for MonitorLimits {
    /// Returns limits of 100,000 conversations, 64 MiB, 1,024 participants and 64 embedded
    /// conversations each, one minute after the end, and 24 hours without a message.
    fn default() -> Self {
        Self {
            conversations: 100_000,
            bytes: 64 << 20,
            participants: 1_024,
            embedded: 64,
            ended: Duration::from_secs(60),
            idle: Duration::from_secs(24 * 60 * 60),
        }
    }
}

impl MonitorLimits {
    /// Maximum number of bytes of the conversations of a peer, and of a single conversation.
    pub(crate) fn share_of_bytes(&self) -> usize {
        self.bytes / SHARES
    }

    /// Maximum number of conversations of a peer.
    pub(crate) fn share_of_conversations(&self) -> usize {
        (self.conversations / SHARES).max(SHARES)
    }
}

/// A peer gets one share of this many.
const SHARES: usize = 8;

/// Maximum length of a conversation identifier or an agent name, in bytes.
pub(crate) const MAX_TEXT: usize = 4_096;

/// Maximum number of agents in the `reply-to` of a message, and of agents that receive replies instead
/// of one side of a conversation.
pub(crate) const MAX_DESIGNATED: usize = 64;

/// Maximum number of conversations with one identifier.
pub(crate) const MAX_ALIKE: usize = 8;
