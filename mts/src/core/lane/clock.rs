//! Timeouts of a lane.

use std::time::Instant;

use fipa_transport::{FailureReason, TransportError, TransportErrorKind};

use super::super::lane_table::LaneTable;
use super::super::work;
use super::open_letter::{Holding, State};
use super::{ENDED_AT_ONCE, ENDED_TIMEOUT, Lane};

impl Lane {
    /// Handles what is due: deadlines, attempts without an answer, custody reports, and letters to
    /// return. Returns false if more letters end than one visit handles; the lane is due at once then, and
    /// nothing may be dispatched.
    #[must_use]
    pub(super) fn expire(&mut self, now: Instant, table: &mut LaneTable) -> bool {
        if self.due.is_none_or(|due| due > now) {
            return true;
        }
        self.ask_custodians(now, table);
        let ended = self
            .ended
            .filter(|(_, last_event)| now >= *last_event + ENDED_TIMEOUT);
        // Once for due timers, and once for the next ones.
        work::steps(2 * self.letters.len());
        let (mut index, mut answered, before) = (0, 0, self.letters.len());
        while index < self.letters.len() {
            if answered + before - self.letters.len() >= ENDED_AT_ONCE {
                self.due = Some(now);
                return false;
            }
            let Some(open_letter) = self.letters.get_mut(index) else {
                break;
            };
            let expired = open_letter.deadline <= now;
            let abandoned = ended.is_some_and(|(gone, _)| gone == open_letter.registration);
            if open_letter.custody_due.is_some_and(|due| due <= now) {
                open_letter.custody_taken(table);
                answered += 1;
            }
            match &mut open_letter.progress.state {
                State::UnderWay { times_out, .. } => {
                    if expired || abandoned || *times_out <= now {
                        let text = match expired {
                            true => "the letter's deadline passed",
                            false => "",
                        };
                        open_letter.abandon(table, || {
                            TransportError::new(TransportErrorKind::TimedOut, text)
                        });
                    }
                }
                State::Custody { location, .. } if expired || abandoned => {
                    let location = location.clone();
                    let text = "the gateway that has the letter in custody has not reported";
                    open_letter.failed_at(
                        &location,
                        TransportError::new(TransportErrorKind::TimedOut, text),
                    );
                    self.fail(now, index, FailureReason::Unconfirmed, table);
                    continue;
                }
                State::Waiting(_) | State::Ended if self.returning => {
                    self.return_letter(now, index, table);
                    continue;
                }
                State::Waiting(_) | State::Ended if expired => {
                    let reason = self.reason_while_waiting(index);
                    self.fail(now, index, reason, table);
                    continue;
                }
                State::Ended => debug_assert!(false, "a letter came back without a decision"),
                State::Waiting(_) => {
                    if let Some(Holding::Until(until)) = open_letter.progress.hold
                        && until <= now
                    {
                        self.return_letter(now, index, table);
                        continue;
                    }
                }
                State::Custody { .. } => {}
            }
            index += 1;
        }
        if ended.is_some() {
            // Another registration may have ended, too.
            self.notice_end(now, table);
        }
        self.due = self.next_due(now);
        true
    }

    fn next_due(&self, now: Instant) -> Option<Instant> {
        let letters = self.letters.iter().flat_map(|open_letter| {
            let progress = &open_letter.progress;
            // The conclusion of an abandoned attempt follows at once, and decides about the letter.
            let (deadline, times_out) = match &progress.state {
                State::UnderWay {
                    abandoned: true, ..
                } => (None, None),
                State::UnderWay { times_out, .. } => (Some(open_letter.deadline), Some(*times_out)),
                _ => (Some(open_letter.deadline), None),
            };
            let held = match progress.hold {
                Some(Holding::Until(until)) => Some(until),
                _ => None,
            };
            let turn = open_letter.begins_after(now);
            [deadline, open_letter.custody_due, times_out, held, turn]
        });
        let paused = self.pause.map(|pause| pause.until);
        let paused = paused.filter(|until| *until > now);
        let still =
            |wait: Option<(_, Instant)>| wait.map(|(_, until)| until).filter(|until| *until > now);
        let (moving, absent) = (still(self.moving), still(self.absent));
        let ended = self.ended.map(|(_, last_event)| last_event + ENDED_TIMEOUT);
        let ended = ended.filter(|due| *due > now);
        let ask = self.ask_custodian.filter(|due| *due > now);
        let others = [paused, moving, absent, ended, ask];
        letters.chain(others).flatten().min()
    }
}
