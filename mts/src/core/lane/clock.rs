//! What a lane does because time has passed.

use std::time::Instant;

use fipa_transport::{FailureReason, Signature, WayError, WayFault};

use super::super::desk::Desk;
use super::Lane;
use super::delivery::State;

impl Lane {
    /// What is due by the clock: deadlines, attempts without an answer, custody to be told.
    pub(super) fn expire(&mut self, now: Instant, desk: &mut Desk) {
        if self.due.is_none_or(|due| due > now) {
            return;
        }
        let mut index = 0;
        while index < self.letters.len() {
            let delivery = &mut self.letters[index];
            if delivery.deadline <= now {
                let reason = delivery.reason_at_deadline();
                if let State::UnderWay {
                    attempt, location, ..
                } = &delivery.progress.state
                {
                    let (attempt, location) = (*attempt, location.clone());
                    desk.abandon(location.kind(), attempt);
                    delivery.progress.state = State::Waiting;
                    self.back();
                    self.recovering = true;
                    let error = WayError::new(WayFault::TimedOut, "the letter's deadline passed");
                    if let Some(tally) = self.tally() {
                        tally.fail(now, &error);
                    }
                    self.letters[index].failed_at(&location, error);
                }
                self.fail(index, reason, desk);
                continue;
            }
            if delivery.custody_due.is_some_and(|due| due <= now) {
                delivery.custody_taken(desk);
            }
            if let State::UnderWay {
                attempt,
                location,
                times_out,
            } = &delivery.progress.state
                && *times_out <= now
            {
                let (attempt, location) = (*attempt, location.clone());
                desk.abandon(location.kind(), attempt);
                delivery.progress.state = State::Waiting;
                delivery.progress.unconfirmed = true;
                self.back();
                let error = WayError::new(WayFault::TimedOut, "");
                if location.signature() != Signature::Frames {
                    // An old peer would take a copy for another letter.
                    self.letters[index].failed_at(&location, error);
                    self.fail(index, FailureReason::Unconfirmed, desk);
                    continue;
                }
                self.came_back(now, index, &location, error, desk);
            }
            index += 1;
        }
        self.due = self.next_due(now);
    }

    fn next_due(&self, now: Instant) -> Option<Instant> {
        let letters = self.letters.iter().flat_map(|delivery| {
            let times_out = match &delivery.progress.state {
                State::UnderWay { times_out, .. } => Some(*times_out),
                _ => None,
            };
            [Some(delivery.deadline), delivery.custody_due, times_out]
        });
        let paused = self.paused_until.filter(|until| *until > now);
        letters.chain([paused]).flatten().min()
    }
}
