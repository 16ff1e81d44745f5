//! Bounds of the memory of a monitor.

use std::time::Duration;

/// Bounds of the number of conversations that a monitor keeps, and of the time that it keeps them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// Maximum number of conversations, including embedded ones. Beyond it, the monitor evicts the
    /// least recently active conversation that is over or, if there is none, the least recently
    /// active one.
    pub conversations: usize,
    /// Maximum number of participants of a conversation.
    pub participants: usize,
    /// Maximum number of conversations embedded in one.
    pub embedded: usize,
    /// Time for which a conversation is kept after its end.
    pub ended: Duration,
    /// Time for which a conversation is kept without a message.
    pub idle: Duration,
}

impl Default for Limits {
    /// Returns limits of 100,000 conversations, 1,024 participants and 64 embedded conversations
    /// each, one minute after the end, and one hour without a message.
    fn default() -> Self {
        Self {
            conversations: 100_000,
            participants: 1_024,
            embedded: 64,
            ended: Duration::from_secs(60),
            idle: Duration::from_secs(60 * 60),
        }
    }
}

/// Maximum length of a conversation identifier or an agent name, in bytes.
pub(crate) const MAX_TEXT: usize = 4_096;
