//! Schedule of the queries for all records.

use std::time::{Duration, Instant};

use super::JITTER;

/// The pause between the first two queries for all records, its growth factor and its maximum (RFC
/// 6762 clause 5.2 requires a factor of at least two).
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const GROWTH: u32 = 4;
const LONGEST_PAUSE: Duration = Duration::from_secs(3600);
/// Minimum pause per known record. Every gateway answers in full, with half a kilobyte per agent on
/// IPv4 and the same on IPv6: this pause limits the answers to 2 kB/s in the long run, until the
/// maximum pause is reached.
const PAUSE_EACH: Duration = Duration::from_millis(500);

/// Times of the queries for all records.
#[derive(Debug)]
pub(super) struct FullQuery {
    pub(super) last: Option<Instant>,
    pub(super) next: Instant,
    pause: Duration,
}

impl FullQuery {
    /// Schedules the first query at once, except for a jitter that separates hosts that start
    /// together; `chance`, from 0 to 1, scales it.
    pub(super) fn new(now: Instant, chance: f64) -> Self {
        Self {
            last: None,
            next: now + JITTER.mul_f64(chance.clamp(0.0, 1.0)),
            pause: FIRST_PAUSE,
        }
    }

    pub(super) fn asked(&mut self, now: Instant, known: usize, chance: f64) {
        let least = PAUSE_EACH.saturating_mul(u32::try_from(known).unwrap_or(u32::MAX));
        let pause = self.pause.max(least).min(LONGEST_PAUSE);
        self.last = Some(now);
        self.next = now + pause + (pause / 8).mul_f64(chance.clamp(0.0, 1.0));
        self.pause = pause * GROWTH;
    }

    /// Counts a query of another host as our own if ours would have been due soon. Our own
    /// looped-back query does not count, because `last` is then too recent.
    pub(super) fn asked_by_others(&mut self, now: Instant, known: usize) {
        if let Some(last) = self.last
            && now >= last + self.next.saturating_duration_since(last) / 2
        {
            self.asked(now, known, 0.0);
        }
    }

    /// Whether the previous query is old enough that its answers have arrived.
    pub(super) fn may_be_asked(&self, now: Instant) -> bool {
        self.last.is_none_or(|last| now >= last + FIRST_PAUSE)
    }
}
