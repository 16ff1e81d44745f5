//! Lines for debugging about single letters.
//!
//! Each line is within a span `letter` whose field `id` identifies the letter: the incarnation of its sender and its
//! sequence number, which are the same in all processes and on all hosts of its route. Below the level debug, a line
//! costs the comparison of a level.

use std::fmt;

use fipa_transport::{Incarnation, Stream};
use tracing::{Level, Span};

/// The identifier of a letter.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LetterId {
    sender: Incarnation,
    sequence: u64,
}

impl LetterId {
    pub(crate) fn new(stream: Stream, sequence: u64) -> Self {
        Self::of(stream.sender, sequence)
    }

    pub(crate) fn of(sender: Incarnation, sequence: u64) -> Self {
        Self { sender, sequence }
    }
}

impl fmt::Display for LetterId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}-{}", self.sender, self.sequence)
    }
}

/// Whether lines about letters may be logged. `tracing` decides about each of them.
#[inline(always)]
pub(crate) fn is_enabled() -> bool {
    Level::DEBUG <= tracing::level_filters::STATIC_MAX_LEVEL
        && Level::DEBUG <= tracing::level_filters::LevelFilter::current()
}

/// The span of a letter. Only useful if lines [are logged](is_enabled).
#[cold]
pub(crate) fn span(letter: LetterId) -> Span {
    tracing::debug_span!("letter", id = %letter)
}

/// Logs a line in the span of a letter. The arguments behind the letter are those of `tracing::debug`; they are
/// evaluated only if lines are logged.
macro_rules! letter_debug {
    ($letter:expr, $($line:tt)+) => {
        if $crate::core::letter_log::is_enabled() {
            $crate::core::letter_log::span($letter).in_scope(|| tracing::debug!($($line)+));
        }
    };
}
pub(crate) use letter_debug;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_identifier_has_the_sender_and_the_sequence() {
        let id = LetterId::of(Incarnation::from_u64(0xa86e), 12);
        assert_eq!(id.to_string(), "000000000000a86e-12");
    }
}
