//! The clocks of this machine, as the core is told them.

use std::time::{Duration, Instant, SystemTime};

use crate::core::Now;

/// Time after which the wall clock is read again. A change of the wall clock is seen at the latest
/// then.
const REREAD_AFTER: Duration = Duration::from_millis(100);

/// The monotonic clock, and the wall clock as of its last reading.
///
/// A letter causes three events, and each reading of a clock takes about 20 ns. The dates that the
/// core writes have a resolution of a millisecond.
#[derive(Debug)]
pub(super) struct Clocks {
    read_at: Instant,
    utc: SystemTime,
}

impl Clocks {
    pub(super) fn new() -> Self {
        Self {
            read_at: Instant::now(),
            utc: SystemTime::now(),
        }
    }

    /// Returns the current time.
    pub(super) fn now(&mut self) -> Now {
        self.now_at(Instant::now(), SystemTime::now)
    }

    fn now_at(&mut self, instant: Instant, read_utc: impl FnOnce() -> SystemTime) -> Now {
        let since = instant.saturating_duration_since(self.read_at);
        let utc = match self.utc.checked_add(since) {
            Some(utc) if since < REREAD_AFTER => utc,
            _ => {
                self.read_at = instant;
                self.utc = read_utc();
                self.utc
            }
        };
        Now { instant, utc }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wall_clock_is_read_again_after_a_moment() {
        let (start, epoch) = (Instant::now(), SystemTime::UNIX_EPOCH);
        let mut clocks = Clocks {
            read_at: start,
            utc: epoch,
        };
        let soon = Duration::from_millis(99);
        let now = clocks.now_at(start + soon, || panic!("not read"));
        assert_eq!((now.instant, now.utc), (start + soon, epoch + soon));
        // The wall clock was set forward by an hour.
        let set = epoch + Duration::from_secs(3600);
        let later = start + Duration::from_millis(100);
        assert_eq!(clocks.now_at(later, || set).utc, set);
        let soon_after = Duration::from_millis(1);
        let now = clocks.now_at(later + soon_after, || panic!("not read"));
        assert_eq!(now.utc, set + soon_after);
    }
}
