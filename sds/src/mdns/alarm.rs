//! A timer of the kernel.
//!
//! The timers of the runtime wake their thread up to three times for a deadline more than 64 ms ahead:
//! once for each level of the timer wheel that the deadline passes. An idle gateway does little else
//! than send beacons, so most of its wake-ups would be these.

use std::io;
use std::time::Instant;

use fipa_transport::log_limit;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create,
    timerfd_settime,
};
use tokio::net::unix::pipe;

/// A timer that wakes its task once for each deadline.
#[derive(Debug)]
pub(super) struct Alarm {
    /// The timer; `None` if the system has none left, and a timer of the runtime is used.
    ///
    /// The runtime has no type for timers, and its general one (`AsyncFd`) needs `unsafe`. Waiting
    /// and read(2) are the same for a pipe.
    timer: Option<pipe::Receiver>,
    /// The deadline of the timer, unless it was reached.
    armed: Option<Instant>,
}

impl Alarm {
    /// Must be called within a runtime.
    pub(super) fn new() -> Self {
        let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
        let timer = timerfd_create(TimerfdClockId::Monotonic, flags);
        let timer = timer
            .map_err(io::Error::from)
            .and_then(pipe::Receiver::from_owned_fd_unchecked);
        if let Err(error) = &timer {
            tracing::debug!(%error, "no timer of the kernel; using one of the runtime");
        }
        Self {
            timer: timer.ok(),
            armed: None,
        }
    }

    /// Waits until this time, or forever. This method is cancel-safe.
    pub(super) async fn until(&mut self, due: Option<Instant>) {
        let Some(due) = due else {
            return std::future::pending().await;
        };
        match self.expires(due).await {
            Some(Ok(())) => return,
            Some(Err(error)) => {
                log_limit::warn!(%error, "a timer of the kernel failed; using one of the runtime");
                self.timer = None;
            }
            None => {}
        }
        tokio::time::sleep_until(due.into()).await;
    }

    /// Waits until the timer expires, if there is one.
    async fn expires(&mut self, due: Instant) -> Option<io::Result<()>> {
        let timer = self.timer.as_ref()?;
        let time_left = due.saturating_duration_since(Instant::now());
        if time_left.is_zero() {
            return Some(Ok(()));
        }
        let expires = async {
            if self.armed != Some(due) {
                let value = Itimerspec {
                    it_interval: Timespec::default(),
                    it_value: Timespec::try_from(time_left).map_err(io::Error::other)?,
                };
                timerfd_settime(timer, TimerfdTimerFlags::empty(), &value)?;
                self.armed = Some(due);
            }
            loop {
                timer.readable().await?;
                match timer.try_read(&mut [0; 8]) {
                    Ok(_) => break,
                    // The event of an earlier deadline.
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                    Err(error) => return Err(error),
                }
            }
            self.armed = None;
            Ok(())
        };
        Some(expires.await)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test]
    async fn every_deadline_is_reached_once() {
        let mut alarm = Alarm::new();
        assert!(alarm.timer.is_some());
        let began = Instant::now();
        let at = |milliseconds| Some(began + Duration::from_millis(milliseconds));
        // Later, earlier, the same after a canceled wait, and past deadlines.
        for (canceled, due) in [(90_000, 20), (5, 90), (120, 120), (1, 1)] {
            tokio::select! {
                biased;
                () = alarm.until(at(canceled)), if canceled > due => unreachable!(),
                () = tokio::time::sleep(Duration::from_millis(3)) => {}
            }
            alarm.until(at(due)).await;
            assert!(began.elapsed() >= Duration::from_millis(due));
        }
        let forever = tokio::time::timeout(Duration::from_millis(20), alarm.until(None));
        assert!(forever.await.is_err());
        // An expired timer that was not read does not shorten a later wait.
        let soon = began.elapsed() + Duration::from_millis(2);
        tokio::select! {
            biased;
            () = alarm.until(Some(began + soon)) => {}
            () = std::future::ready(()) => {}
        }
        std::thread::sleep(Duration::from_millis(5));
        let later = began.elapsed() + Duration::from_millis(30);
        alarm.until(Some(began + later)).await;
        assert!(began.elapsed() >= later);
    }

    #[tokio::test]
    async fn without_a_timer_of_the_kernel_the_runtime_has_one() {
        let mut alarm = Alarm {
            timer: None,
            armed: None,
        };
        let due = Instant::now() + Duration::from_millis(20);
        alarm.until(Some(due)).await;
        assert!(Instant::now() >= due);
    }
}
