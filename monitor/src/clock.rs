//! The current time, as the caller of a monitor passes it.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// The current time on two clocks.
///
/// `reply-by` is a time of the wall clock. The age of a conversation and the timeouts of a protocol are
/// spans of a clock that nothing sets back. A [`SystemTime`] converts into a `Moment` with the wall clock
/// for both.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Moment {
    /// Time of the wall clock.
    pub wall: SystemTime,
    /// Time since a fixed point, on a monotonic clock that counts while the machine is suspended, such
    /// as `CLOCK_BOOTTIME` of Linux.
    pub elapsed: Duration,
}

impl Moment {
    /// Creates the current time from a time of the wall clock and one of a monotonic clock.
    #[must_use]
    pub fn new(wall: SystemTime, elapsed: Duration) -> Self {
        Self { wall, elapsed }
    }

    /// Milliseconds of the monotonic clock, at least 1.
    pub(crate) fn millis(self) -> u64 {
        span_millis(self.elapsed).max(1)
    }

    /// Milliseconds of the monotonic clock at a time of the wall clock, at least 1.
    pub(crate) fn millis_at(self, wall: SystemTime) -> u64 {
        let at = match wall.duration_since(self.wall) {
            Ok(ahead) => self.elapsed.saturating_add(ahead),
            Err(behind) => self.elapsed.saturating_sub(behind.duration()),
        };
        span_millis(at).max(1)
    }

    /// The time of the wall clock at this time of the monotonic clock.
    pub(crate) fn wall_at(self, elapsed: Duration) -> Option<SystemTime> {
        match elapsed.checked_sub(self.elapsed) {
            Some(ahead) => self.wall.checked_add(ahead),
            None => self.wall.checked_sub(self.elapsed.saturating_sub(elapsed)),
        }
    }
}

impl From<SystemTime> for Moment {
    fn from(wall: SystemTime) -> Self {
        let elapsed = wall.duration_since(UNIX_EPOCH).unwrap_or_default();
        Self { wall, elapsed }
    }
}

pub(crate) fn span_millis(span: Duration) -> u64 {
    // The same as `Duration::as_millis`, without 128 bits.
    let seconds = span.as_secs().saturating_mul(1_000);
    seconds.saturating_add(u64::from(span.subsec_millis()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_of_the_wall_clock_are_times_of_the_monotonic_clock() {
        let wall = UNIX_EPOCH + Duration::from_secs(1_000);
        let now = Moment::new(wall, Duration::from_secs(50));
        assert_eq!(now.millis(), 50_000);
        assert_eq!(now.millis_at(wall + Duration::from_secs(3)), 53_000);
        assert_eq!(now.millis_at(wall - Duration::from_secs(3)), 47_000);
        assert_eq!(now.millis_at(UNIX_EPOCH), 1);
        let at = |secs| now.wall_at(Duration::from_secs(secs));
        assert_eq!(at(60), Some(wall + Duration::from_secs(10)));
        assert_eq!(at(40), Some(wall - Duration::from_secs(10)));
        assert_eq!(Moment::from(wall).millis(), 1_000_000);
    }
}
