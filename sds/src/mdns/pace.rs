//! How fast records are announced: hundreds of agents that start at once must not make a storm,
//! because each record is probed three times and announced twice (RFC 6762 clause 8), and radios
//! send multicast at their slowest rate.

use std::time::{Duration, Instant};

/// One record every so often, in the long run.
const SPACING: Duration = Duration::from_millis(5);
/// So many are announced at once, before anybody has to wait.
const BURST: u32 = 25;
/// Up to how much is added to every wait, so that hosts that start together do not speak together.
const JITTER: Duration = Duration::from_millis(50);

/// When the next record may be announced.
#[derive(Debug, Default)]
pub(super) struct Pace {
    /// When it could be if there were no burst.
    next: Option<Instant>,
}

impl Pace {
    /// Takes a turn: none when it is now, else when it comes. The share of the jitter is between 0
    /// and 1.
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
    fn a_few_go_at_once_and_hundreds_one_after_the_other() {
        let (mut pace, now) = (Pace::default(), Instant::now());
        let turns: Vec<_> = (0..500).map(|_| pace.turn(now, 0.0)).collect();
        let at_once = turns.iter().filter(|turn| turn.is_none()).count();
        assert_eq!(at_once, BURST as usize);
        let waits: Vec<Duration> = turns.iter().flatten().map(|turn| *turn - now).collect();
        assert!(waits.is_sorted());
        assert_eq!(waits.last(), Some(&(SPACING * (499 - BURST))));
        // Later there is room again.
        let later = now + SPACING * 500;
        assert_eq!(pace.turn(later, 0.5), None);
        let mut others = (0..30).filter_map(|_| pace.turn(later, 1.0));
        assert!(others.next().unwrap() >= later + JITTER);
    }
}
