//! The clock of locks, which counts the time in which the machine is suspended.

use std::io;
use std::os::fd::OwnedFd;
use std::time::{Duration, SystemTime};

use fipa_locking::Millis;
use rustix::io::Errno;
use rustix::time::{
    ClockId, Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, clock_gettime,
    timerfd_create, timerfd_settime,
};
use tokio::io::unix::AsyncFd;
use tokio::runtime::Handle;

use crate::wall_clock;

/// Returns the time since the machine started, in milliseconds.
pub(super) fn now() -> Millis {
    let elapsed = Duration::try_from(clock_gettime(ClockId::Boottime)).unwrap_or_default();
    millis(elapsed)
}

/// Returns the time of day in seconds since 1970, if the clock was set.
pub(super) fn time_of_day() -> Option<u64> {
    wall_clock::set_time(SystemTime::now())
}

/// Returns a span in milliseconds.
pub(super) fn millis(span: Duration) -> Millis {
    Millis::try_from(span.as_millis()).unwrap_or(Millis::MAX)
}

/// A timer of this clock. A timer of tokio does not count suspend.
pub(super) struct Timer {
    timer: AsyncFd<OwnedFd>,
    due: Option<Millis>,
}

impl Timer {
    pub(super) fn new(runtime: &Handle) -> io::Result<Self> {
        let flags = TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC;
        let timer = timerfd_create(TimerfdClockId::Boottime, flags)?;
        let _context = runtime.enter();
        #[expect(
            deprecated,
            reason = "safe for an `OwnedFd`, whose descriptor stays the same and open"
        )]
        let timer = AsyncFd::new(timer)?;
        Ok(Self { timer, due: None })
    }

    /// Sets the time at which [`expired`](Self::expired) returns; `None` for never.
    pub(super) fn set(&mut self, due: Option<Millis>) -> io::Result<()> {
        if self.due == due {
            return Ok(());
        }
        let at = match due {
            // Zero would stop the timer.
            Some(due) => Duration::from_millis(due.max(1)),
            None => Duration::ZERO,
        };
        let it_value = Timespec::try_from(at).unwrap_or(Timespec {
            tv_sec: i64::MAX,
            tv_nsec: 0,
        });
        let it_interval = Timespec::default();
        let at = Itimerspec {
            it_interval,
            it_value,
        };
        timerfd_settime(&self.timer, TimerfdTimerFlags::ABSTIME, &at)?;
        self.due = due;
        Ok(())
    }

    /// Waits until the time is reached. Dropping the future loses nothing.
    pub(super) async fn expired(&mut self) -> io::Result<()> {
        loop {
            let mut ready = self.timer.readable().await?;
            match rustix::io::read(ready.get_inner(), &mut [0; 8]) {
                Ok(_) => {
                    self.due = None;
                    return Ok(());
                }
                Err(Errno::AGAIN) => ready.clear_ready(),
                Err(Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn the_timer_expires_at_the_time_that_was_set_last() {
        let mut timer = Timer::new(&Handle::current()).unwrap();
        timer.set(Some(Millis::MAX)).unwrap();
        let start = now();
        timer.set(Some(start + 20)).unwrap();
        timer.expired().await.unwrap();
        assert!(now() >= start + 20);
        // A time in the past, and the start of the machine.
        for past in [start, 0] {
            timer.set(Some(past)).unwrap();
            timer.expired().await.unwrap();
        }
        timer.set(Some(now() + 1)).unwrap();
        timer.set(None).unwrap();
        tokio::select! {
            biased;
            _ = timer.expired() => panic!("the timer was stopped"),
            () = tokio::time::sleep(Duration::from_millis(50)) => {}
        }
    }
}
