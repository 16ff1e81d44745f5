//! When everything is asked for.

use std::time::{Duration, Instant};

use super::JITTER;

/// The time between the first two questions for everything, by what each following one grows, and
/// the longest (RFC 6762 clause 5.2 asks for at least twofold).
const FIRST_PAUSE: Duration = Duration::from_secs(1);
const GROWTH: u32 = 4;
const LONGEST_PAUSE: Duration = Duration::from_secs(3600);
/// The least of that for each record that is known. Every gateway answers in full, with half a
/// kilobyte for each of its agents on IPv4 and as much on IPv6: so the answers take no more than
/// 2 kB/s in the long run, until the pause is the longest.
const PAUSE_EACH: Duration = Duration::from_millis(500);

/// When the question for everything is asked.
#[derive(Debug)]
pub(super) struct Everything {
    pub(super) last: Option<Instant>,
    pub(super) next: Instant,
    pause: Duration,
}

impl Everything {
    /// At once, but for the jitter that keeps hosts that start together apart, of which there is
    /// `chance`, from 0 to 1.
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

    /// That counts when we would have asked soon. Our own question, which comes back to us, does
    /// not: we have just asked.
    pub(super) fn asked_by_others(&mut self, now: Instant, known: usize) {
        if let Some(last) = self.last
            && now >= last + self.next.saturating_duration_since(last) / 2
        {
            self.asked(now, known, 0.0);
        }
    }

    /// What has been asked a moment ago is being answered.
    pub(super) fn may_be_asked(&self, now: Instant) -> bool {
        self.last.is_none_or(|last| now >= last + FIRST_PAUSE)
    }
}
