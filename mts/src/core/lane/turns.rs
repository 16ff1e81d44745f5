//! The turns in which a service hands a letter over.
//!
//! A peer decides how often a letter comes back, so the number of repetitions must not depend on its
//! answers. A letter can be dispatched only in its [`Turn`]. It gets the first one when it enters the
//! lane, and each later one from [`HandOvers::came_back`], which is given the [`Cause`].
//!
//! Two limits hold for every letter, whatever other services do: it leaves this service at most
//! [`BURST`] times and once more per [`INTERVAL`], and repetitions of its content have at most
//! [`CONTENT_BURST`] times its length and [`SLOWEST_BYTES_PER_SECOND`]. The lane adds pauses, which
//! other services may shorten; see `pause.rs`.

use std::time::{Duration, Instant};

use super::super::rules::{self, Again, Cause};
use super::transfer_time;

/// Number of times that a letter may leave this service without a pause, and the interval in which it
/// may leave once more.
const BURST: u32 = 16;
const INTERVAL: Duration = Duration::from_millis(250);
/// Number of repetitions of a letter's content without a pause.
const CONTENT_BURST: u32 = 4;

/// Permission to dispatch a letter from a time on.
#[derive(Debug)]
pub(super) struct Turn {
    /// `None` for at once.
    from: Option<Instant>,
}

impl Turn {
    /// The beginning of the turn, if it is still to come.
    pub(super) fn begins_after(&self, now: Instant) -> Option<Instant> {
        self.from.filter(|from| *from > now)
    }

    /// Delays the turn until then.
    pub(super) fn delay_until(&mut self, until: Instant) {
        self.from = self.from.max(Some(until));
    }
}

/// The hand-overs of one letter by this service.
#[derive(Debug)]
pub(super) struct HandOvers {
    /// The predecessor that the latest copy carried.
    sent_after: u64,
    /// Time of the latest hand-over.
    at: Instant,
    pace: Pace,
}

impl HandOvers {
    /// Creates the record of a letter that was not handed over yet, and its first turn.
    pub(super) fn new(now: Instant) -> (Self, Turn) {
        let hand_overs = Self {
            sent_after: 0,
            at: now,
            pace: Pace::new(now),
        };
        (hand_overs, Turn { from: None })
    }

    /// Continues with the pace that the letter had when it was in this lane before. Returns the time of
    /// its next hand-over, unless it may be now.
    pub(super) fn resume(&mut self, now: Instant, pace: Pace, len: usize) -> Option<Instant> {
        self.pace = pace;
        self.pace.next(now, len)
    }

    /// The pace of the repetitions.
    pub(super) fn pace(&self) -> Pace {
        self.pace
    }

    /// Records a hand-over, which uses up the turn.
    pub(super) fn handed_over(&mut self, now: Instant, _used: Turn, after: u64) {
        self.sent_after = after;
        self.at = now;
    }

    /// Decides when the letter goes again after the end of its latest hand-over. `after` is its present
    /// predecessor, `len` its length. Also returns the minimum length of a pause of the lane: about the time that
    /// the content took to leave.
    pub(super) fn came_back(
        &mut self,
        now: Instant,
        cause: Cause,
        after: u64,
        len: usize,
    ) -> (Turn, Again, Duration) {
        if cause.has_left() {
            self.pace.count(now, len);
        }
        let turn = Turn {
            from: self.pace.next(now, len),
        };
        let took = now.saturating_duration_since(self.at);
        let again = rules::again(cause, self.sent_after, after);
        (turn, again, took.min(transfer_time(len)))
    }
}

/// The pace of a letter's repetitions: two buckets that leak with the time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Pace {
    /// The time to which the buckets apply.
    at: Instant,
    /// Levels in microseconds, because many of these values are kept.
    letters: u32,
    content: u32,
}

impl Pace {
    fn new(now: Instant) -> Self {
        Self {
            at: now,
            letters: 0,
            content: 0,
        }
    }

    /// The time to which the levels apply.
    pub(super) fn at(&self) -> Instant {
        self.at
    }

    /// Whether a hand-over has ended without an outcome.
    pub(super) fn has_repeated(&self) -> bool {
        self.letters > 0
    }

    /// Returns the pace as it is at a later time.
    pub(super) fn leaked(self, now: Instant) -> Self {
        let leaks = micros(now.saturating_duration_since(self.at));
        Self {
            at: self.at.max(now),
            letters: self.letters.saturating_sub(leaks),
            content: self.content.saturating_sub(leaks),
        }
    }

    /// Returns the slower one of two paces in each respect.
    pub(super) fn slower(self, other: Self) -> Self {
        let at = self.at.max(other.at);
        let (one, other) = (self.leaked(at), other.leaked(at));
        Self {
            at,
            letters: one.letters.max(other.letters),
            content: one.content.max(other.content),
        }
    }

    /// Counts a hand-over.
    pub(super) fn count(&mut self, now: Instant, len: usize) {
        *self = self.leaked(now);
        self.letters = self.letters.saturating_add(micros(INTERVAL));
        self.content = self.content.saturating_add(micros(transfer_time(len)));
    }

    /// The time of the next hand-over, unless it may be now.
    fn next(&self, now: Instant, len: usize) -> Option<Instant> {
        let Self {
            letters, content, ..
        } = self.leaked(now);
        let letters = letters.saturating_sub(micros(INTERVAL * (BURST - 1)));
        let content = content.saturating_sub(micros(transfer_time(len) * CONTENT_BURST));
        let wait = letters.max(content);
        (wait > 0).then(|| now + Duration::from_micros(wait.into()))
    }
}

fn micros(duration: Duration) -> u32 {
    u32::try_from(duration.as_micros()).unwrap_or(u32::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Repeats a letter of this length as soon as it may be, for a while, and counts how often it leaves.
    fn storm(len: usize, time: Duration) -> u32 {
        let begin = Instant::now();
        let (mut hand_overs, mut turn) = HandOvers::new(begin);
        let (mut now, mut count) = (begin, 0);
        loop {
            now = turn.begins_after(now).unwrap_or(now);
            if now > begin + time {
                return count;
            }
            hand_overs.handed_over(now, turn, 0);
            count += 1;
            let cause = match count % 3 {
                0 => Cause::Busy,
                1 => Cause::Returned,
                _ => Cause::Unconfirmed,
            };
            (turn, _, _) = hand_overs.came_back(now, cause, 0, len);
        }
    }

    #[test]
    fn a_letter_leaves_sixteen_times_and_then_four_times_a_second() {
        assert_eq!(storm(0, Duration::ZERO), 16);
        assert_eq!(storm(0, Duration::from_secs(10)), 16 + 4 * 10);
    }

    #[test]
    fn content_is_repeated_four_times_and_then_at_a_mebibyte_a_second() {
        let len = 2 << 20;
        assert_eq!(storm(len, Duration::ZERO), 1 + 4);
        assert_eq!(storm(len, Duration::from_secs(10)), 1 + 4 + 5);
    }

    #[test]
    fn what_has_not_left_does_not_count() {
        let now = Instant::now();
        let (mut hand_overs, mut turn) = HandOvers::new(now);
        for _ in 0..1000 {
            hand_overs.handed_over(now, turn, 0);
            (turn, _, _) = hand_overs.came_back(now, Cause::NotSent, 0, 1 << 20);
            assert_eq!(turn.begins_after(now), None);
        }
    }

    #[test]
    fn a_letter_that_comes_again_has_its_former_pace() {
        let now = Instant::now();
        let (mut former, mut turn) = HandOvers::new(now);
        for _ in 0..20 {
            former.handed_over(now, turn, 0);
            (turn, _, _) = former.came_back(now, Cause::Returned, 0, 100);
        }
        let (mut present, _) = HandOvers::new(now);
        let resumed = present.resume(now, former.pace(), 100);
        assert_eq!(resumed, turn.begins_after(now));
        // A pace of the past has leaked.
        let later = now + Duration::from_secs(60);
        assert_eq!(present.resume(later, former.pace(), 100), None);
    }
}
