//! The round-trip time of a connection (draft-gg-udt-03 section 6.2).

use std::time::Duration;

use super::SYN;

/// The time before the first measurement.
const FIRST: Duration = Duration::from_millis(100);

/// The longest time that counts. A peer could claim a longer one.
const LONGEST: Duration = Duration::from_secs(3);

#[derive(Debug)]
pub(crate) struct RoundTrip {
    mean: Duration,
    variance: Duration,
    is_measured: bool,
}

impl Default for RoundTrip {
    fn default() -> Self {
        Self {
            mean: FIRST,
            variance: FIRST / 2,
            is_measured: false,
        }
    }
}

impl RoundTrip {
    pub(crate) fn mean(&self) -> Duration {
        self.mean
    }

    pub(crate) fn variance(&self) -> Duration {
        self.variance
    }

    pub(crate) fn measured(&mut self, sample: Duration) {
        let sample = sample.min(LONGEST);
        if self.is_measured {
            self.variance = (self.variance * 3 + self.mean.abs_diff(sample)) / 4;
            self.mean = (self.mean * 7 + sample) / 8;
        } else {
            self.is_measured = true;
            self.mean = sample;
            self.variance = sample / 2;
        }
    }

    /// Returns the time in which an answer arrives, unless a packet was lost.
    pub(crate) fn timeout(&self) -> Duration {
        self.mean + 4 * self.variance + SYN
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measurements_converge_and_are_bounded() {
        let mut round_trip = RoundTrip::default();
        round_trip.measured(Duration::from_millis(8));
        assert_eq!(round_trip.mean(), Duration::from_millis(8));
        for _ in 0..100 {
            round_trip.measured(Duration::from_millis(2));
        }
        assert!(round_trip.mean() < Duration::from_millis(3));
        assert!(round_trip.timeout() < Duration::from_millis(14));
        for _ in 0..100 {
            round_trip.measured(Duration::MAX);
        }
        assert!(round_trip.mean() <= LONGEST);
    }
}
