//! A token bucket.

use std::time::{Duration, Instant};

/// A token bucket for a peer or a sender: a rate of letters or bytes per second, with bursts of one
/// second's worth.
///
/// Sans-I/O: the caller passes `now`, which must not decrease.
#[derive(Debug, Clone)]
pub struct TokenBucket {
    /// Tokens. Negative after more was [spent](Self::spend) than there was.
    tokens: f64,
    at: Instant,
}

impl TokenBucket {
    /// A full bucket.
    #[must_use]
    pub fn new(per_second: f64, now: Instant) -> Self {
        Self {
            tokens: per_second,
            at: now,
        }
    }

    /// The time of the last use.
    #[must_use]
    pub fn asked(&self) -> Instant {
        self.at
    }

    /// Takes `amount` tokens if there are as many. Returns whether it did.
    pub fn take(&mut self, amount: f64, per_second: f64, now: Instant) -> bool {
        self.take_of(amount, per_second, per_second, now)
    }

    /// Like [`take`](Self::take), from a bucket that holds at most `burst` tokens. It begins with the
    /// number of its creation.
    pub fn take_of(&mut self, amount: f64, per_second: f64, burst: f64, now: Instant) -> bool {
        self.refill(per_second, burst, now);
        let enough = self.tokens >= amount;
        if enough {
            self.tokens -= amount;
        }
        enough
    }

    /// Takes `amount` tokens for something that has already happened. If the bucket is negative then,
    /// returns the time until it no longer is, limited to one second.
    pub fn spend(&mut self, amount: f64, per_second: f64, now: Instant) -> Option<Duration> {
        self.refill(per_second, per_second, now);
        self.tokens = (self.tokens - amount).max(-per_second);
        (self.tokens < 0.0).then(|| Duration::from_secs_f64(-self.tokens / per_second))
    }

    fn refill(&mut self, per_second: f64, most: f64, now: Instant) {
        let since = now.saturating_duration_since(self.at).as_secs_f64();
        self.tokens = (self.tokens + since * per_second).min(most);
        self.at = self.at.max(now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn a_burst_of_one_second_is_allowed_and_then_the_rate() {
        let now = Instant::now();
        let mut allowance = TokenBucket::new(2.0, now);
        assert!(allowance.take(1.0, 2.0, now) && allowance.take(1.0, 2.0, now));
        assert!(!allowance.take(1.0, 2.0, now));
        assert!(allowance.take(1.0, 2.0, now + SECOND / 2));
        assert!(!allowance.take(1.0, 2.0, now + SECOND / 2));
    }

    #[test]
    fn a_burst_may_be_larger_than_the_rate() {
        let now = Instant::now();
        let mut allowance = TokenBucket::new(3.0, now);
        let mut take = |now| allowance.take_of(1.0, 1.0, 3.0, now);
        assert_eq!(
            [take(now), take(now), take(now), take(now)],
            [true, true, true, false]
        );
        assert_eq!([take(now + SECOND), take(now + SECOND)], [true, false]);
        let full = now + 10 * SECOND;
        assert_eq!(
            [take(full), take(full), take(full), take(full)],
            [true, true, true, false]
        );
    }

    #[test]
    fn an_overdraft_lasts_at_most_one_second() {
        let now = Instant::now();
        let mut allowance = TokenBucket::new(10.0, now);
        assert_eq!(allowance.spend(10.0, 10.0, now), None);
        assert_eq!(allowance.spend(5.0, 10.0, now), Some(SECOND / 2));
        assert_eq!(allowance.spend(1e12, 10.0, now), Some(SECOND));
        assert_eq!(allowance.spend(0.0, 10.0, now + SECOND), None);
    }

    #[test]
    fn the_total_never_exceeds_the_burst_and_the_rate() {
        let mut random = fastrand::Rng::with_seed(9);
        for _ in 0..200 {
            let rate = f64::from(random.u32(1..50));
            let begun = Instant::now();
            let (mut now, mut taken) = (begun, 0.0);
            let mut allowance = TokenBucket::new(rate, begun);
            for _ in 0..random.usize(1..200) {
                now += Duration::from_millis(random.u64(0..200));
                taken += f64::from(u8::from(allowance.take(1.0, rate, now)));
                let most = rate * (1.0 + (now - begun).as_secs_f64());
                assert!(taken <= most + 1e-6, "{taken} of {most}");
            }
        }
    }
}
