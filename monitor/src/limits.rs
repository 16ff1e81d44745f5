//! How much a monitor keeps.

use std::time::Duration;

/// How much a monitor keeps, and for how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Limits {
    /// Conversations, those within others included. When there are more, one that is over is
    /// forgotten, else the one in which nothing has happened for longest.
    pub conversations: usize,
    /// Participants of one conversation.
    pub participants: usize,
    /// Conversations within one.
    pub embedded: usize,
    /// How long a conversation is kept that is over.
    pub ended: Duration,
    /// How long one is kept in which nothing happens.
    pub idle: Duration,
}

impl Default for Limits {
    /// 100,000 conversations of at most 1,024 participants and 64 embedded ones, kept for a minute
    /// after their end and for an hour of silence.
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

/// Longest conversation id or agent's name that is kept, in bytes.
pub(crate) const MAX_TEXT: usize = 4_096;
