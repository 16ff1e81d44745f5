//! What a lane does with answers, with the end of attempts, and with news of those it relies on.

use std::time::Instant;

use fipa_sds::Entry;
use fipa_transport::{
    Answer, AttemptId, Conclusion, FailureReason, Kind, Location, Outcome, Report, Signature,
    WayError, WayFault,
};

use super::super::desk::Desk;
use super::super::routes::Tally;
use super::delivery::State;
use super::{BUSY_PAUSE, CONGESTED_PAUSE, CONGESTED_TRIES, Lane, Moved};

impl Lane {
    /// What became of an attempt.
    pub(crate) fn concluded(
        &mut self,
        now: Instant,
        sequence: u64,
        attempt: AttemptId,
        conclusion: Conclusion,
        desk: &mut Desk,
        moved: &mut Vec<Moved>,
    ) {
        let Some(index) = self.index(sequence) else {
            return;
        };
        let location = match &self.letters[index].progress.state {
            State::UnderWay {
                attempt: current,
                location,
                ..
            } if *current == attempt => location.clone(),
            _ => return,
        };
        self.back();
        self.letters[index].progress.state = State::Waiting;
        match conclusion {
            Conclusion::Answered(answer) => {
                if let Some(tally) = self.tally() {
                    Tally::add(match answer {
                        Answer::Accepted | Answer::Custody => &tally.taken,
                        _ => &tally.turned_back,
                    });
                }
                desk.way_worked(&location);
                self.answered(now, index, location, answer, desk, moved);
            }
            Conclusion::Handed => {
                if let Some(tally) = self.tally() {
                    Tally::add(&tally.taken);
                }
                desk.way_worked(&location);
                let attempts = std::mem::take(&mut self.letters[index].progress.attempts);
                self.settle(
                    index,
                    Outcome::Sent {
                        via: location.kind(),
                        attempts,
                    },
                    desk,
                );
            }
            Conclusion::NotSent(error) => self.came_back(now, index, &location, error, desk),
            Conclusion::Unconfirmed(error) if location.signature() != Signature::Frames => {
                // An old peer would take a copy for another letter.
                let delivery = &mut self.letters[index];
                delivery.failed_at(&location, error);
                self.fail(index, FailureReason::Unconfirmed, desk);
            }
            Conclusion::Unconfirmed(error) => {
                self.letters[index].progress.unconfirmed = true;
                self.came_back(now, index, &location, error, desk);
            }
            other => {
                let text = format!("conclusion not understood: {other:?}");
                self.letters[index].progress.unconfirmed = true;
                let error = WayError::new(WayFault::Incompatible, text);
                self.came_back(now, index, &location, error, desk);
            }
        }
        self.pump(now, desk, moved);
    }

    fn answered(
        &mut self,
        now: Instant,
        index: usize,
        location: Location,
        answer: Answer,
        desk: &mut Desk,
        moved: &mut Vec<Moved>,
    ) {
        match answer {
            Answer::Accepted => {
                self.pauses = 0;
                self.congested = 0;
                let attempts = std::mem::take(&mut self.letters[index].progress.attempts);
                self.settle(
                    index,
                    Outcome::Delivered {
                        via: location.kind(),
                        attempts,
                    },
                    desk,
                );
            }
            Answer::Custody => {
                let delivery = &mut self.letters[index];
                delivery.progress.state = State::Custody { location };
            }
            Answer::Busy => {
                let delivery = &mut self.letters[index];
                delivery.progress.busy = true;
                delivery.progress.tried.clear();
                delivery.custody_taken(desk);
                self.recovering = true;
                self.pause_until(now + BUSY_PAUSE);
            }
            Answer::OutOfOrder { .. } => {
                self.letters[index].progress.tried.clear();
                self.recovering = true;
                // What is missing is under way here, or on another way: no need to wait for the
                // one, no way to know of the other.
                if index == 0 {
                    self.pause(now);
                }
            }
            Answer::Failed {
                reason: FailureReason::NoSuchAgent,
                detail,
            } => {
                if self.has_no_entry_any_more(desk) {
                    self.recovering = true;
                    self.receiver_left(index, desk, moved);
                } else {
                    self.refused(index, &location, FailureReason::NoSuchAgent, detail, desk);
                }
            }
            Answer::Failed { reason, detail } => {
                self.refused(index, &location, reason, detail, desk);
            }
            other => {
                let detail = format!("answer not understood: {other:?}");
                self.refused(index, &location, FailureReason::Refused, detail, desk);
            }
        }
    }

    /// The other side said finally that it does not take the letter.
    fn refused(
        &mut self,
        index: usize,
        location: &Location,
        reason: FailureReason,
        detail: String,
        desk: &mut Desk,
    ) {
        self.letters[index].failed_at(
            location,
            WayError {
                fault: WayFault::Refused,
                detail,
            },
        );
        self.fail(index, reason, desk);
    }

    /// An attempt did not reach the other side, or nobody knows.
    pub(super) fn came_back(
        &mut self,
        now: Instant,
        index: usize,
        location: &Location,
        error: WayError,
        desk: &mut Desk,
    ) {
        self.recovering = true;
        if let Some(tally) = self.tally() {
            tally.fail(now, &error);
        }
        if error.fault == WayFault::Congested && self.congested < CONGESTED_TRIES {
            // What is under way, in this lane or in another, makes room.
            self.congested += 1;
            self.letters[index]
                .progress
                .tried
                .retain(|tried| tried != location);
            desk.wait_for_room(location, self.stream);
            self.pause_until(now + CONGESTED_PAUSE);
            return;
        }
        if error.fault != WayFault::TooLarge {
            desk.way_failed(now, location);
        }
        self.letters[index].failed_at(location, error);
    }

    /// The outcome of a letter that somebody had in custody.
    pub(crate) fn reported(
        &mut self,
        now: Instant,
        sequence: u64,
        report: Report,
        desk: &mut Desk,
        moved: &mut Vec<Moved>,
    ) {
        let Some(index) = self.index(sequence) else {
            return;
        };
        let delivered = !matches!(report.outcome, Outcome::Failed { .. });
        let taken_by = match &self.letters[index].progress.state {
            // It is being tried again; that somebody failed with it before changes nothing.
            State::Waiting if !delivered => return,
            // It got there by an attempt that nothing was heard of, the last one most likely.
            State::Waiting => self.letters[index]
                .progress
                .attempts
                .last()
                .map(|it| it.via),
            State::Custody { location } => Some(location.kind()),
            // The report overtook the answer.
            State::UnderWay {
                attempt, location, ..
            } => {
                let kind = location.kind();
                desk.abandon(kind, *attempt);
                // If another way was tried before, the report may be from there.
                if self.letters[index].progress.attempts.is_empty() {
                    desk.way_worked(location);
                    if let Some(tally) = self.tally() {
                        Tally::add(&tally.taken);
                    }
                }
                self.back();
                Some(kind)
            }
        };
        let delivery = &mut self.letters[index];
        delivery.progress.state = State::Waiting;
        // The sender is told the way between the hosts, which only this side may have seen.
        let way = |theirs| match taken_by {
            None | Some(Kind::Shm) => theirs,
            Some(ours) => ours,
        };
        let mut attempts = std::mem::take(&mut delivery.progress.attempts);
        attempts.extend_from_slice(report.outcome.attempts());
        match report.outcome {
            Outcome::Delivered { via, .. } => {
                let via = way(via);
                self.settle(index, Outcome::Delivered { via, attempts }, desk);
            }
            Outcome::Sent { via, .. } => {
                let via = way(via);
                self.settle(index, Outcome::Sent { via, attempts }, desk);
            }
            Outcome::Failed { reason, .. } => {
                delivery.progress.attempts = attempts;
                if reason == FailureReason::NoSuchAgent && self.has_no_entry_any_more(desk) {
                    self.receiver_left(index, desk, moved);
                } else {
                    self.fail(index, reason, desk);
                }
            }
            // An outcome that a later version knows says nothing to this one.
            _ => self.fail(index, FailureReason::Unconfirmed, desk),
        }
        self.pump(now, desk, moved);
    }

    /// The directory has changed: who has letters in custody may be gone.
    pub(crate) fn directory_changed(
        &mut self,
        now: Instant,
        desk: &mut Desk,
        moved: &mut Vec<Moved>,
    ) {
        // When the receiver itself is gone, its custodian says so, or the deadline does.
        if let Some(entry) = self.entry(desk) {
            for index in 0..self.letters.len() {
                self.check_custodian(now, index, &entry, desk);
            }
        }
        self.pump(now, desk, moved);
    }

    /// A custodian that the receiver cannot be reached through any more will not report.
    fn check_custodian(&mut self, now: Instant, index: usize, entry: &Entry, desk: &mut Desk) {
        let State::Custody { location } = &self.letters[index].progress.state else {
            return;
        };
        let custodian = location.incarnation();
        let stands = |way: &Location| way.incarnation() == custodian;
        if !custodian.is_known() || entry.locations.iter().any(stands) {
            return;
        }
        let location = location.clone();
        let delivery = &mut self.letters[index];
        delivery.progress.state = State::Waiting;
        delivery.progress.unconfirmed = true;
        let text = "the gateway that had the letter in custody is gone";
        let error = WayError::new(WayFault::Broken, text);
        self.came_back(now, index, &location, error, desk);
    }
}
