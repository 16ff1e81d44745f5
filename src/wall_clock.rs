//! Whether the clock of this host was set. A host without a battery for its clock starts in 1970, until a program sets
//! the clock.

use std::time::{SystemTime, UNIX_EPOCH};

/// Date of this release, in seconds since 1970: 2026-11-01. A clock that shows an earlier time was not set.
const RELEASED: u64 = 1_793_491_200;

/// Returns this time in seconds since 1970, if a clock that shows it was set.
#[cfg(feature = "protocols")]
pub(crate) fn set_time(now: SystemTime) -> Option<u64> {
    let seconds = now.duration_since(UNIX_EPOCH).ok()?.as_secs();
    (seconds > RELEASED).then_some(seconds)
}

/// Returns the earliest time that it can be if a clock shows this one.
#[cfg(feature = "secure")]
pub(crate) fn earliest(now: SystemTime) -> SystemTime {
    now.max(UNIX_EPOCH + std::time::Duration::from_secs(RELEASED))
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[cfg(feature = "protocols")]
    #[test]
    fn a_clock_before_the_release_was_not_set() {
        let at = |seconds| UNIX_EPOCH + Duration::from_secs(seconds);
        assert_eq!(set_time(at(0)), None);
        assert_eq!(set_time(UNIX_EPOCH - Duration::from_secs(1)), None);
        assert_eq!(set_time(at(RELEASED)), None);
        assert_eq!(set_time(at(RELEASED + 1)), Some(RELEASED + 1));
        let now = set_time(SystemTime::now());
        assert!(now.is_some(), "the clock of this machine is set");
    }

    #[cfg(feature = "secure")]
    #[test]
    fn it_is_never_earlier_than_the_release() {
        let now = SystemTime::now();
        assert_eq!(earliest(now), now);
        let released = UNIX_EPOCH + Duration::from_secs(RELEASED);
        assert_eq!(earliest(UNIX_EPOCH), released);
    }
}
