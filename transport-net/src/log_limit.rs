//! Rate-limited warnings about events that peers cause.

use parking_lot::Mutex;

/// Logs a warning at the first, second, fourth, eighth, … occurrence, and a debug message
/// otherwise, so that peers cannot fill the log.
pub(crate) fn warn_limited(times_before: u64, what: std::fmt::Arguments<'_>) {
    let times = times_before.saturating_add(1);
    if times.is_power_of_two() {
        tracing::warn!(times, "{what}");
    } else {
        tracing::debug!(times, "{what}");
    }
}

/// Counts events of one kind, to be logged once a second.
#[derive(Debug, Default)]
pub(crate) struct PerSecond(Mutex<Option<u64>>);

impl PerSecond {
    /// Counts an event. Returns whether it is the first of a series: then the caller logs it and
    /// starts the task that calls [`take`](Self::take) every second.
    pub(crate) fn count(&self) -> bool {
        let mut counted = self.0.lock();
        match &mut *counted {
            Some(number) => {
                *number = number.saturating_add(1);
                false
            }
            None => {
                *counted = Some(0);
                true
            }
        }
    }

    /// Returns the number of events since the last call. Without any the series has ended.
    pub(crate) fn take(&self) -> Option<u64> {
        let mut counted = self.0.lock();
        match *counted {
            Some(number) if number > 0 => counted.replace(0),
            _ => {
                *counted = None;
                None
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_series_is_logged_at_its_start_and_then_by_count() {
        let events = PerSecond::default();
        assert!(events.count());
        assert!(!events.count());
        assert!(!events.count());
        assert_eq!(events.take(), Some(2));
        assert!(!events.count());
        assert_eq!(events.take(), Some(1));
        assert_eq!(events.take(), None);
        assert!(events.count());
    }
}
