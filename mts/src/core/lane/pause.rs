//! Letters that came back, and the pauses of their lane.
//!
//! Every letter that was handed over and goes again passes [`Lane::again`] with the cause. The pause
//! holds back the lane only, so no other stream waits. Some events end it early; none of them gives a
//! letter its turn earlier.

use std::time::{Duration, Instant};

use fipa_transport::Hop;

use super::super::lane_table::LaneTable;
use super::super::rules::{self, Again, Cause};
use super::Lane;
use super::open_letter::{State, is_of};

/// Pauses between rounds over all routes, and before a returned letter is dispatched again.
const FIRST_PAUSE: Duration = Duration::from_millis(10);
const LONGEST_PAUSE: Duration = Duration::from_millis(500);
/// Pause for a busy receiver without a credit.
const BUSY_PAUSE: Duration = Duration::from_millis(100);
/// Pause of a lane that waits for room on its route.
const CONGESTED_PAUSE: Duration = Duration::from_millis(20);

/// A pause of a lane.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pause {
    pub(super) until: Instant,
    ends_with: PauseEnd,
}

/// The event that ends a pause early.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PauseEnd {
    /// A credit of the service that was busy.
    Credit,
    /// The end of an attempt on the same route.
    Room,
    /// A connection with a service whose routes had failed.
    Reachable,
    /// Another registration of the receiver.
    Registration,
    /// A lower predecessor of the letter with this sequence.
    LowerPredecessor(u64),
}

impl Lane {
    /// Takes back a letter whose hand-over has ended without an outcome, and decides when it goes again. A
    /// letter that was handed over gets no turn in any other way.
    pub(super) fn again(
        &mut self,
        now: Instant,
        index: usize,
        cause: Cause,
        table: &mut LaneTable,
    ) {
        self.recovering = true;
        let after = self.after(index);
        let open_letter = &mut self.letters[index];
        let (sequence, len) = (open_letter.sequence, open_letter.letter.len());
        let hand_overs = &mut open_letter.progress.hand_overs;
        let (turn, again, least) = hand_overs.came_back(now, cause, after, len);
        if let Some(from) = turn.begins_after(now) {
            self.due_at(from);
        }
        let open_letter = &mut self.letters[index];
        open_letter.progress.state = State::Waiting(turn);
        let ends_with = match cause {
            // The route has not failed.
            Cause::Returned | Cause::OutOfOrder { .. } => {
                open_letter.progress.tried.clear();
                PauseEnd::LowerPredecessor(sequence)
            }
            Cause::Busy => {
                open_letter.progress.tried.clear();
                PauseEnd::Credit
            }
            Cause::Moved | Cause::NoSuchAgent => PauseEnd::Registration,
            Cause::NoRoom => PauseEnd::Room,
            Cause::NotSent | Cause::Unconfirmed | Cause::CustodianLost => PauseEnd::Reachable,
        };
        match again {
            Again::AtOnce => {}
            Again::AfterPause => self.pause(now, ends_with, least),
            Again::AfterPredecessor if self.is_custody() => {
                let timeout = match cause {
                    Cause::OutOfOrder { .. } => self.predecessor_timeout(index, table),
                    _ => Duration::ZERO,
                };
                self.hold(now, index, timeout, table);
            }
            Again::AfterPredecessor => {
                let lower = index.checked_sub(1).map(|lower| &self.letters[lower]);
                // Otherwise the letter before it is elsewhere, and slow.
                if !lower.is_some_and(|lower| lower.is_waiting()) {
                    self.pause(now, ends_with, least);
                }
            }
        }
    }

    /// Pauses the lane for at least this time. Pauses without progress between them grow.
    pub(super) fn pause(&mut self, now: Instant, ends_with: PauseEnd, least: Duration) {
        let pause = match ends_with {
            PauseEnd::Credit => BUSY_PAUSE,
            PauseEnd::Room => CONGESTED_PAUSE,
            _ => {
                let pause = FIRST_PAUSE.saturating_mul(1 << self.pauses.min(10));
                // The letters that came back together share a pause.
                if !self.is_paused(now) {
                    self.pauses = self.pauses.saturating_add(1);
                }
                pause.min(LONGEST_PAUSE)
            }
        };
        let until = now + pause.max(least);
        if self.pause.is_none_or(|pause| pause.until < until) {
            self.pause = Some(Pause { until, ends_with });
            self.due_at(until);
        }
    }

    pub(super) fn is_paused(&self, now: Instant) -> bool {
        self.pause.is_some_and(|pause| now < pause.until)
    }

    /// Ends a pause that this event ends. Returns whether there was one.
    pub(super) fn end_pause(&mut self, event: PauseEnd) -> bool {
        self.pause
            .take_if(|pause| pause.ends_with == event)
            .is_some()
    }

    /// Ends the pause for a lower predecessor when the letter with this sequence has left the lane.
    pub(super) fn end_pause_behind(&mut self, settled: u64) {
        let is_behind = |pause: &mut Pause| matches!(pause.ends_with, PauseEnd::LowerPredecessor(sequence) if settled <= sequence);
        self.pause.take_if(is_behind);
    }

    /// Continues after an event that may have ended the pause.
    pub(crate) fn resume(&mut self, now: Instant, event: PauseEnd, table: &mut LaneTable) {
        if self.end_pause(event) {
            self.dispatch_all(now, table);
        }
    }

    /// Handles a credit: the service that answered that it was full has room again. Credits of
    /// others do not count, because each one has a letter dispatched again.
    pub(crate) fn credited(&mut self, now: Instant, from: &Hop, table: &mut LaneTable) {
        let counts = self.busy_at.is_some_and(|busy| is_of(busy, from))
            && rules::credit_counts(self.has_settled);
        if counts && self.end_pause(PauseEnd::Credit) {
            self.has_settled = false;
            self.dispatch_all(now, table);
        }
    }
}
