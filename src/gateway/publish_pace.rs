//! Decides when the gateway writes the agents of other hosts again. No I/O, no clock.
//!
//! The file is written as a whole, and each process of the host reads it again. Other hosts cause the changes, so
//! the pause after a write grows with the size of the file. A change after a longer time is written at once.

use std::time::{Duration, Instant};

/// Bytes that are written per second in the long term.
const BYTES_PER_SECOND: u32 = 10 * 1024 * 1024;
/// Pause after a small file.
const MIN_PAUSE: Duration = Duration::from_millis(1);
/// Maximum number of bytes for which a pause is computed; files are smaller than 64 MiB.
const MAX_SIZE: u32 = 64 * 1024 * 1024;
/// Sum of pauses that urgent writes may run ahead.
const AHEAD: Duration = Duration::from_secs(1);

/// Computes the time of the next write.
#[derive(Debug, Default)]
pub(super) struct PublishPace {
    /// The end of the pauses after the writes so far.
    next: Option<Instant>,
}

impl PublishPace {
    /// Returns the time of the next write, which is not before `now`.
    pub(super) fn next(&self, now: Instant) -> Instant {
        self.next.map_or(now, |next| next.max(now))
    }

    /// Whether a write may take place now for which a letter waits. Such writes use up the pauses of later ones.
    pub(super) fn may_hurry(&self, now: Instant) -> bool {
        self.next(now) <= now + AHEAD
    }

    /// Records that a file of `size` bytes has been written, or would have been if it had changed.
    pub(super) fn wrote(&mut self, now: Instant, size: usize) {
        let size = u32::try_from(size).unwrap_or(MAX_SIZE).min(MAX_SIZE);
        let pause = (Duration::from_secs(1) * size / BYTES_PER_SECOND).max(MIN_PAUSE);
        self.next = Some(self.next(now) + pause);
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn the_pause_between_writes_grows_with_the_size_of_the_file() {
        let start = Instant::now();
        let mut pause_before = Duration::ZERO;
        for size in [0, 30_000, 1 << 20, 8 << 20, 64 << 20] {
            let mut pace = PublishPace::default();
            assert_eq!(
                pace.next(start),
                start,
                "the first change is written at once"
            );
            pace.wrote(start, size);
            let pause = pace.next(start) - start;
            assert!(pause > pause_before, "{size}: {pause:?}");
            pause_before = pause;
            // After the pause, a change is written at once again.
            let later = start + 2 * pause;
            assert_eq!(pace.next(later), later);
        }
        assert!(pause_before < Duration::from_secs(10));
        let mut pace = PublishPace::default();
        pace.wrote(start, usize::MAX);
        assert_eq!(pace.next(start) - start, pause_before);
    }

    proptest! {
        /// Whatever changes at what times, the bytes that are written within a time have a bound.
        #[test]
        fn writes_have_a_rate(
            sizes in prop::collection::vec(0..20_000_000_usize, 1..40),
            waits in prop::collection::vec(0..2_000_u64, 40),
            urgent in prop::collection::vec(any::<bool>(), 40),
        ) {
            let start = Instant::now();
            let (mut pace, mut now, mut written, mut largest) = (PublishPace::default(), start, 0, 0);
            for ((size, wait), urgent) in sizes.into_iter().zip(waits).zip(urgent) {
                now += Duration::from_millis(wait);
                if !(urgent && pace.may_hurry(now)) {
                    now = pace.next(now);
                }
                pace.wrote(now, size);
                (written, largest) = (written + size, largest.max(size));
                let time = (now - start + AHEAD).as_secs_f64();
                let most = time * f64::from(BYTES_PER_SECOND) + largest as f64 + 40.0;
                prop_assert!(written as f64 <= most, "{written} bytes in {time} s");
            }
        }
    }
}
