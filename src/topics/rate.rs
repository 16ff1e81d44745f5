//! The measured rate of a topic.

use std::collections::VecDeque;

use tokio::time::Instant;

/// Number of publications over which the rate is measured.
const MEASURED: usize = 32;

/// The times of the newest publications.
#[derive(Debug, Default)]
pub(super) struct MeasuredRate(VecDeque<Instant>);

impl MeasuredRate {
    /// Counts a publication.
    pub(super) fn count(&mut self, now: Instant) {
        if self.0.len() >= MEASURED {
            self.0.pop_front();
        }
        self.0.push_back(now);
    }

    /// Returns the publications per second. `None` before the second one. A publisher that has paused for longer than
    /// two periods has a lower rate.
    pub(super) fn hertz(&self, now: Instant) -> Option<f64> {
        let (first, last) = (*self.0.front()?, *self.0.back()?);
        let periods = u32::try_from(self.0.len() - 1).unwrap_or(u32::MAX);
        let period = (last - first).checked_div(periods)?;
        let is_paused = now.saturating_duration_since(last) > 2 * period;
        let until = if is_paused { now } else { last };
        let seconds = (until - first).as_secs_f64();
        (seconds > 0.0).then(|| f64::from(periods) / seconds)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn the_rate_is_that_of_the_newest_publications() {
        let mut rate = MeasuredRate::default();
        let mut now = Instant::now();
        assert_eq!(rate.hertz(now), None);
        rate.count(now);
        assert_eq!(rate.hertz(now), None);
        for period in [1000; 5].into_iter().chain([20; 40]) {
            now += Duration::from_millis(period);
            rate.count(now);
        }
        assert_eq!(rate.hertz(now), Some(50.0));
        assert_eq!(rate.hertz(now + Duration::from_millis(30)), Some(50.0));
        // 31 periods of 20 ms, and 9.38 s of silence.
        assert_eq!(rate.hertz(now + Duration::from_millis(9_380)), Some(3.1));
    }
}
