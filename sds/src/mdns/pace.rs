//! Rate limit for announcements. Each record is probed three times and announced twice (RFC 6762
//! clause 8), and radios send multicast at their slowest rate, so hundreds of agents that start at
//! once must not be announced at once.

use std::time::{Duration, Instant};

/// Long-term interval between records.
const SPACING: Duration = Duration::from_millis(5);
/// Number of records that are announced without waiting.
const BURST: u32 = 25;
/// Maximum jitter of every wait, so that hosts that start together do not send simultaneously.
const JITTER: Duration = Duration::from_millis(50);

/// Computes the time at which the next record may be announced.
#[derive(Debug, Default)]
pub(super) struct Pace {
    /// The time without a burst.
    next: Option<Instant>,
}

impl Pace {
    /// Takes a turn: returns `None` if it is now, otherwise its time. `share`, from 0 to 1, scales
    /// the jitter.
    pub(super) fn turn(&mut self, now: Instant, share: f64) -> Option<Instant> {
        let slot = self.next.map_or(now, |next| next.max(now));
        self.next = Some(slot + SPACING);
        let ahead = SPACING * BURST;
        (slot >= now + ahead).then(|| slot - ahead + JITTER.mul_f64(share))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_is_announced_at_once_and_the_rest_at_a_limited_rate() {
        let (mut pace, now) = (Pace::default(), Instant::now());
        let turns: Vec<_> = (0..500).map(|_| pace.turn(now, 0.0)).collect();
        let at_once = turns.iter().filter(|turn| turn.is_none()).count();
        assert_eq!(at_once, BURST as usize);
        let waits: Vec<Duration> = turns.iter().flatten().map(|turn| *turn - now).collect();
        assert!(waits.is_sorted());
        assert_eq!(waits.last(), Some(&(SPACING * (499 - BURST))));
        // After the backlog, a record is announced at once again.
        let later = now + SPACING * 500;
        assert_eq!(pace.turn(later, 0.5), None);
        let mut others = (0..30).filter_map(|_| pace.turn(later, 1.0));
        assert!(others.next().unwrap() >= later + JITTER);
    }
}
