//! Notifications to the service manager, as systemd defines them (`sd_notify(3)`): readiness, reloads, the end, and the
//! watchdog. Without `$NOTIFY_SOCKET` nothing is sent. The variable stays in the environment, because the commands that
//! notify start no other programs.

use std::time::Duration;

use fipa::error::ErrorChain;
use fipa::{SelfCheck, log_limit};
use sd_notify::NotifyState;
use tokio::task::JoinHandle;
use tokio::time::MissedTickBehavior;

/// Reports that the service works, after its start or a reload. The text is for operators.
pub(crate) fn ready(status: &str) {
    notify(&[NotifyState::Ready, NotifyState::Status(status)]);
}

/// Reports that the service reads its configuration again. [`ready`] must follow.
pub(crate) fn reloading() {
    match NotifyState::monotonic_usec_now() {
        // systemd 253 and later take this time to match the report with its own request.
        Ok(now) => notify(&[NotifyState::Reloading, now]),
        Err(error) => log_limit::warn!(%error, "cannot read the clock for the service manager"),
    }
}

/// Reports that the service ends.
pub(crate) fn stopping() {
    notify(&[NotifyState::Stopping, NotifyState::Status("stopping")]);
}

/// Starts to report at half of the watchdog's time that the gateway works, each time after the gateway has passed a
/// letter to itself. Returns `None` if the service manager has requested no watchdog.
///
/// Must be called within a tokio runtime.
pub(crate) fn start_watchdog(check: SelfCheck) -> Option<JoinHandle<()>> {
    std::env::var_os("NOTIFY_SOCKET")?;
    let half = sd_notify::watchdog_enabled()? / 2;
    if half.is_zero() {
        return None;
    }
    Some(tokio::spawn(watch(check, half)))
}

async fn watch(check: SelfCheck, half: Duration) {
    let mut due = tokio::time::interval(half);
    due.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        due.tick().await;
        match check.pass_letter(half).await {
            Ok(()) => notify(&[NotifyState::Watchdog]),
            Err(error) => log_limit::warn!(
                error = %ErrorChain(&error),
                "the gateway has not passed a letter to itself; the service manager restarts it if it fails again"
            ),
        }
    }
}

fn notify(states: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(states) {
        log_limit::warn!(%error, "cannot notify the service manager at $NOTIFY_SOCKET");
    }
}
