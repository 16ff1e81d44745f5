//! Waiting for conditions.

use std::time::{Duration, Instant};

/// Timeout of a test that hangs. No condition is expected to take this long.
const WATCHDOG: Duration = Duration::from_secs(90);

/// Pause between two checks of a condition.
const PAUSE: Duration = Duration::from_millis(2);

/// Waits until the condition holds.
///
/// # Panics
/// If the condition does not hold within 90 s. The message has `what`.
#[track_caller]
pub fn until(what: &str, mut condition: impl FnMut() -> bool) {
    until_some(what, || condition().then_some(()));
}

/// Waits until the condition returns a value, and returns the value.
///
/// # Panics
/// If the condition returns no value within 90 s. The message has `what`.
#[track_caller]
pub fn until_some<T>(what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        if let Some(value) = condition() {
            return value;
        }
        check(what, started);
        std::thread::sleep(PAUSE);
    }
}

/// Waits in a task of tokio until the condition holds.
///
/// # Panics
/// If the condition does not hold within 90 s. The message has `what`.
pub async fn until_async(what: &str, mut condition: impl FnMut() -> bool) {
    until_some_async(what, || condition().then_some(())).await;
}

/// Waits in a task of tokio until the condition returns a value, and returns the value.
///
/// # Panics
/// If the condition returns no value within 90 s. The message has `what`.
pub async fn until_some_async<T>(what: &str, mut condition: impl FnMut() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        if let Some(value) = condition() {
            return value;
        }
        check(what, started);
        tokio::time::sleep(PAUSE).await;
    }
}

#[track_caller]
fn check(what: &str, started: Instant) {
    assert!(
        started.elapsed() < WATCHDOG,
        "timed out waiting until: {what}"
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_condition_is_checked_until_it_holds() {
        let mut checks = 0;
        until("three checks", || {
            checks += 1;
            checks == 3
        });
        assert_eq!(checks, 3);
    }
}
