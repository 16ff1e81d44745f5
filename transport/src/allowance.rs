//! How much somebody may do: so much a second.

use std::time::{Duration, Instant};

/// What somebody may still do, of what is allowed to do so much a second: letters, bytes. A second's
/// worth may be done at once.
///
/// Sans-I/O: `now` goes in, and must not go back.
#[derive(Debug, Clone)]
pub struct Allowance {
    /// Below zero when more was [spent](Self::spend) than there was.
    left: f64,
    at: Instant,
}

impl Allowance {
    /// Of somebody who has done nothing yet.
    #[must_use]
    pub fn new(per_second: f64, now: Instant) -> Self {
        Self {
            left: per_second,
            at: now,
        }
    }

    /// When it was last asked.
    #[must_use]
    pub fn asked(&self) -> Instant {
        self.at
    }

    /// Takes so much, if there is as much.
    pub fn take(&mut self, amount: f64, per_second: f64, now: Instant) -> bool {
        self.refill(per_second, now);
        let enough = self.left >= amount;
        if enough {
            self.left -= amount;
        }
        enough
    }

    /// Takes so much of what cannot be helped any more, and says for how long no more is to be let in
    /// after that: a second at most, however much it was.
    pub fn spend(&mut self, amount: f64, per_second: f64, now: Instant) -> Option<Duration> {
        self.refill(per_second, now);
        self.left = (self.left - amount).max(-per_second);
        (self.left < 0.0).then(|| Duration::from_secs_f64(-self.left / per_second))
    }

    fn refill(&mut self, per_second: f64, now: Instant) {
        let since = now.saturating_duration_since(self.at).as_secs_f64();
        self.left = (self.left + since * per_second).min(per_second);
        self.at = self.at.max(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn a_second_s_worth_at_once_and_then_as_time_goes_by() {
        let now = Instant::now();
        let mut allowance = Allowance::new(2.0, now);
        assert!(allowance.take(1.0, 2.0, now) && allowance.take(1.0, 2.0, now));
        assert!(!allowance.take(1.0, 2.0, now));
        assert!(allowance.take(1.0, 2.0, now + SECOND / 2));
        assert!(!allowance.take(1.0, 2.0, now + SECOND / 2));
    }

    #[test]
    fn what_is_spent_beyond_it_lasts_a_second_at_most() {
        let now = Instant::now();
        let mut allowance = Allowance::new(10.0, now);
        assert_eq!(allowance.spend(10.0, 10.0, now), None);
        assert_eq!(allowance.spend(5.0, 10.0, now), Some(SECOND / 2));
        assert_eq!(allowance.spend(1e12, 10.0, now), Some(SECOND));
        assert_eq!(allowance.spend(0.0, 10.0, now + SECOND), None);
    }

    #[test]
    fn nobody_takes_more_than_a_second_s_worth_and_the_rate() {
        let mut random = fastrand::Rng::with_seed(9);
        for _ in 0..200 {
            let rate = f64::from(random.u32(1..50));
            let begun = Instant::now();
            let (mut now, mut taken) = (begun, 0.0);
            let mut allowance = Allowance::new(rate, begun);
            for _ in 0..random.usize(1..200) {
                now += Duration::from_millis(random.u64(0..200));
                taken += f64::from(u8::from(allowance.take(1.0, rate, now)));
                let most = rate * (1.0 + (now - begun).as_secs_f64());
                assert!(taken <= most + 1e-6, "{taken} of {most}");
            }
        }
    }
}
