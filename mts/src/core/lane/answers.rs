//! Handling of answers, ends of attempts, reports of custodians, and changes of the directory.

use std::time::Instant;

use fipa_sds::Entry;
use fipa_transport::counts::Event;
use fipa_transport::{
    Answer, AttemptId, Conclusion, FailureReason, Hop, Incarnation, Kind, Location, Outcome,
    Report, Signature, TransportError, TransportErrorKind,
};

use super::super::ids::registration_of;
use super::super::label::HandedOver;
use super::super::lane_table::LaneTable;
use super::super::letter_log::{LetterId, letter_debug};
use super::super::origin::Settlement;
use super::super::rules::{self, AttemptEnd, Belief, Cause, CustodyReport};
use super::super::tally::Tally;
use super::open_letter::{Departure, State};
use super::predecessors::ASK_CUSTODIAN_AFTER;
use super::{CONGESTED_TRIES, ENDED_TIMEOUT, Lane, LaneKey, MOVING_TIMEOUT};

impl Lane {
    /// Handles the conclusion of an attempt.
    pub(crate) fn concluded(
        &mut self,
        now: Instant,
        sequence: u64,
        attempt: AttemptId,
        conclusion: Conclusion,
        table: &mut LaneTable,
    ) {
        let Some(index) = self.index(sequence) else {
            return;
        };
        let state = &mut self.letters[index].progress.state;
        let is_current = matches!(
            state,
            State::UnderWay { attempt: current, .. } if *current == attempt
        );
        if !is_current {
            return;
        }
        let before = std::mem::replace(state, State::Ended);
        let State::UnderWay {
            location, since, ..
        } = before
        else {
            return;
        };
        let letter = LetterId::of(self.sender, sequence);
        letter_debug!(letter, %location, ?conclusion, "attempt ended");
        self.end_transit();
        self.record_event(now, index);
        // The timer visits the letter again, also if its deadline passed in the meantime.
        self.due_at(match self.returning {
            true => now,
            false => self.letters[index].deadline,
        });
        match conclusion {
            Conclusion::Answered(answer) => {
                if let Some(tally) = self.tally() {
                    Tally::add(match answer {
                        Answer::Accepted | Answer::Delivered { .. } | Answer::Custody => {
                            &tally.taken
                        }
                        _ => &tally.turned_back,
                    });
                    if !location.kind().is_host_local() {
                        tally.answered_after(now.saturating_duration_since(since));
                    }
                }
                table.routes.worked(&location);
                self.route_worked(&location);
                self.answered(now, index, (attempt, location), answer, table);
            }
            Conclusion::Handed => {
                if let Some(tally) = self.tally() {
                    Tally::add(&tally.taken);
                }
                table.routes.worked(&location);
                self.route_worked(&location);
                let attempts = std::mem::take(&mut self.letters[index].progress.attempts);
                let via = location.kind();
                let outcome = Outcome::Sent { via, attempts };
                table.taken_by_legacy_peer(&self.receiver, &location);
                self.settle(now, index, Settlement::Outcome(outcome), table);
            }
            Conclusion::NotSent(error) => {
                self.came_back(now, index, &location, (error, Cause::NotSent), table);
            }
            Conclusion::Unconfirmed(error) if location.signature() != Signature::Frames => {
                // A legacy peer would take a copy for a new letter.
                self.letters[index].failed_at(&location, error);
                self.fail(now, index, FailureReason::Unconfirmed, table);
            }
            Conclusion::Unconfirmed(error) => {
                self.letters[index].ended(AttemptEnd::Unknown);
                self.came_back(now, index, &location, (error, Cause::Unconfirmed), table);
            }
        }
        self.dispatch_all(now, table);
    }

    fn answered(
        &mut self,
        now: Instant,
        index: usize,
        (attempt, location): (AttemptId, Location),
        answer: Answer,
        table: &mut LaneTable,
    ) {
        // The route had room.
        self.congested = 0;
        match answer {
            Answer::Accepted => {
                let attempts = std::mem::take(&mut self.letters[index].progress.attempts);
                let via = location.kind();
                let outcome = Outcome::Delivered { via, attempts };
                self.settle(now, index, Settlement::Outcome(outcome), table);
            }
            Answer::Delivered { via } => {
                let taken_by = Some(location.kind());
                let attempts = Vec::new();
                let outcome = Outcome::Delivered { via, attempts };
                self.settled_by_report(now, index, taken_by, outcome, table);
            }
            Answer::Custody => {
                let open_letter = &mut self.letters[index];
                open_letter.progress.state = State::Custody {
                    attempt,
                    location,
                    since: now,
                };
                self.ask_custodian_at(now + ASK_CUSTODIAN_AFTER);
                // A letter before it may have failed since this copy was dispatched.
                if !self.is_custody() {
                    self.send_predecessor(index, table);
                }
            }
            Answer::Busy => {
                self.was_full(now);
                let open_letter = &mut self.letters[index];
                open_letter.progress.busy = true;
                self.busy_at = open_letter.handed_at(&location);
                open_letter.custody_taken(table);
                self.again(now, index, Cause::Busy, table);
            }
            Answer::OutOfOrder { last } => {
                self.again(now, index, Cause::OutOfOrder { last }, table);
            }
            Answer::Returned { uncertain } => {
                self.letters[index].ended(end_of(uncertain));
                self.again(now, index, Cause::Returned, table);
            }
            Answer::Moved => self.receiver_moved(now, index, table),
            Answer::Failed {
                reason: FailureReason::NoSuchAgent,
                detail,
            } => {
                let refused = Some((location, detail));
                self.receiver_unknown(now, index, refused, table);
            }
            Answer::Failed { reason, detail } => {
                self.refused(now, index, &location, (reason, detail), table);
            }
        }
    }

    /// Handles an answer that this registration of the receiver recently left its host.
    fn receiver_moved(&mut self, now: Instant, index: usize, table: &mut LaneTable) {
        let open_letter = &self.letters[index];
        let registration = open_letter.registration;
        if self.is_custody() {
            self.recovering = true;
            match rules::may_move(open_letter.progress.uncertain) {
                true => self.settle(now, index, Settlement::Moved, table),
                false => self.fail(now, index, FailureReason::Unconfirmed, table),
            }
            return;
        }
        if self.moving.is_none_or(|(moved, _)| moved != registration) {
            let until = now + MOVING_TIMEOUT;
            self.moving = Some((registration, until));
            self.due_at(until);
        }
        self.again(now, index, Cause::Moved, table);
        self.await_directory(index, Departure::Moved, table);
    }

    /// Handles a letter whose receiver another service does not know, according to this refusal or a report.
    fn receiver_unknown(
        &mut self,
        now: Instant,
        index: usize,
        refused: Option<(Location, String)>,
        table: &mut LaneTable,
    ) {
        self.again(now, index, Cause::NoSuchAgent, table);
        self.await_directory(index, Departure::Unknown { refused }, table);
    }

    /// Makes a letter whose registration another service reports as moved or unknown wait for a refresh of
    /// the directory.
    fn await_directory(&mut self, index: usize, departure: Departure, table: &mut LaneTable) {
        self.letters[index].progress.departure = Some(Box::new(departure));
        self.want_refresh(table);
    }

    /// Handles the end of a refresh of the directory.
    pub(crate) fn refreshed(&mut self, now: Instant, number: u64, table: &mut LaneTable) {
        // A later refresh may have been requested.
        if self.awaited.is_none_or(|awaited| awaited > number) {
            return;
        }
        self.awaited = None;
        self.is_fresh = true;
        let departed = self.letters.iter();
        let departed = departed.filter(|open_letter| open_letter.progress.departure.is_some());
        let departed: Vec<u64> = departed.map(|open_letter| open_letter.sequence).collect();
        for sequence in departed {
            let Some(index) = self.index(sequence) else {
                continue;
            };
            let departure = self.letters[index].progress.departure.take();
            if !self.letters[index].is_waiting() {
                continue;
            }
            let is_known = self
                .entry(self.letters[index].registration, table)
                .is_some();
            match departure.map(|it| *it) {
                Some(Departure::Unknown { refused }) if is_known => {
                    if let Some((location, detail)) = refused {
                        let fault = TransportErrorKind::Refused;
                        self.letters[index].failed_at(&location, TransportError { fault, detail });
                    }
                    self.contradicted(now, index, table);
                }
                Some(_) => {
                    self.recovering = true;
                    self.receiver_left(now, index, table);
                }
                None => {}
            }
        }
        self.dispatch_all(now, table);
        self.is_fresh = false;
    }

    /// Handles a letter whose receiver is in the directory, but not known to its service. The directory
    /// may show an agent that has left, and not yet show its successor; or the service may not yet know
    /// an agent that has come. The sender's process sends the letter again for a while.
    fn contradicted(&mut self, now: Instant, index: usize, table: &mut LaneTable) {
        let is_custody = self.is_custody();
        let registration = self.letters[index].registration;
        let progress = &mut self.letters[index].progress;
        let since = *progress.unknown_since.get_or_insert(now);
        if is_custody {
            return self.fail(now, index, FailureReason::NoSuchAgent, table);
        }
        if now >= since + MOVING_TIMEOUT {
            return self.fail_absent(now, index, table);
        }
        progress.tried.clear();
        self.recovering = true;
        let successor = match &self.key {
            LaneKey::Name(_, name) => table.view.named(name),
            LaneKey::Service(_) | LaneKey::Custody(_) => None,
        };
        if successor.is_some_and(|entry| registration_of(&entry) != registration) {
            self.receiver_left(now, index, table);
        }
    }

    /// Handles the final refusal of a letter by the other side.
    fn refused(
        &mut self,
        now: Instant,
        index: usize,
        location: &Location,
        (reason, detail): (FailureReason, String),
        table: &mut LaneTable,
    ) {
        let fault = TransportErrorKind::Refused;
        self.letters[index].failed_at(location, TransportError { fault, detail });
        self.fail(now, index, reason, table);
    }

    /// Handles an attempt that did not reach the other side, or may not have.
    pub(super) fn came_back(
        &mut self,
        now: Instant,
        index: usize,
        location: &Location,
        (error, cause): (TransportError, Cause),
        table: &mut LaneTable,
    ) {
        table.counts().event(Event::FailedAttempt, 1);
        if let Some(tally) = self.tally() {
            tally.fail(now, &error);
        }
        let waits_for_room = cause == Cause::NotSent && error.fault.waits_for_room();
        if waits_for_room && self.congested < CONGESTED_TRIES {
            // The end of another attempt, in this lane or another, makes room.
            self.congested += 1;
            self.letters[index]
                .progress
                .tried
                .retain(|tried| tried != location);
            table.wait_for_room(location, self.id);
            return self.again(now, index, Cause::NoRoom, table);
        }
        self.again(now, index, cause, table);
        if !matches!(
            error.fault,
            TransportErrorKind::TooLarge | TransportErrorKind::Inexpressible
        ) {
            table.route_failed(now, location, error.fault);
        }
        self.route_failed(location, &error);
        self.letters[index].failed_at(location, error);
    }

    /// Handles this service's report that the custody of a letter has ended.
    pub(crate) fn reported(
        &mut self,
        now: Instant,
        from: &Hop,
        letter: HandedOver,
        report: Report,
        table: &mut LaneTable,
    ) {
        let HandedOver {
            registration,
            sequence,
            transfer,
        } = letter;
        let Some(index) = self.index(sequence) else {
            return;
        };
        let open_letter = &mut self.letters[index];
        if open_letter.registration != registration {
            return;
        }
        let reported = match &report {
            Report::Settled(Outcome::Delivered { .. } | Outcome::Sent { .. }) => {
                CustodyReport::Delivered
            }
            Report::Settled(Outcome::Failed { reason, .. }) => CustodyReport::NotDelivered {
                uncertain: *reason == FailureReason::Unconfirmed,
            },
            Report::Returned { uncertain } => CustodyReport::NotDelivered {
                uncertain: *uncertain,
            },
            Report::Moved => CustodyReport::NotDelivered { uncertain: false },
            // An unknown outcome of a later version carries no information.
            Report::Settled(_) => CustodyReport::NotDelivered { uncertain: true },
        };
        let handed = open_letter.was_handed_to(from);
        let current = open_letter.progress.state.handed_over();
        let current = current.map(|(attempt, location)| (attempt.0, location.kind()));
        match rules::believe(
            handed,
            reported,
            transfer,
            current.map(|(attempt, _)| attempt),
        ) {
            Belief::Believed => {}
            Belief::OnlyUncertain => {
                open_letter.ended(AttemptEnd::Unknown);
                return;
            }
            Belief::Ignored => return,
        }
        let taken_by = match current {
            Some((_, kind)) => Some(kind),
            // An attempt without an answer delivered it, most likely the last one.
            None => open_letter.progress.attempts.last().map(|it| it.via),
        };
        self.end_hand_over(index, transfer, table);
        self.record_event(now, index);
        match report {
            Report::Settled(outcome) => {
                self.settled_by_report(now, index, taken_by, outcome, table);
            }
            Report::Returned { uncertain } => {
                self.letters[index].ended(end_of(uncertain));
                self.again(now, index, Cause::Returned, table);
            }
            Report::Moved => self.receiver_moved(now, index, table),
        }
        self.dispatch_all(now, table);
    }

    /// Takes a letter back after a report, which may have arrived before the conclusion of the
    /// attempt.
    fn end_hand_over(&mut self, index: usize, transfer: u64, table: &mut LaneTable) {
        let state = &mut self.letters[index].progress.state;
        let before = std::mem::replace(state, State::Ended);
        if let State::UnderWay {
            attempt, location, ..
        } = before
        {
            table.drop_attempt(location.clone(), attempt);
            // A report of an earlier hand-over does not show that this route works.
            if attempt.0 == transfer {
                table.routes.worked(&location);
                if let Some(tally) = self.tally() {
                    Tally::add(&tally.taken);
                }
            }
            self.end_transit();
        }
    }

    fn settled_by_report(
        &mut self,
        now: Instant,
        index: usize,
        taken_by: Option<Kind>,
        outcome: Outcome,
        table: &mut LaneTable,
    ) {
        // The sender is told the transport between the hosts, which only this side may know.
        let route = |theirs| match taken_by {
            None => theirs,
            Some(ours) if ours.is_host_local() => theirs,
            Some(ours) => ours,
        };
        let open_letter = &mut self.letters[index];
        let mut attempts = std::mem::take(&mut open_letter.progress.attempts);
        attempts.extend_from_slice(outcome.attempts());
        let outcome = match outcome {
            Outcome::Delivered { via, .. } => Outcome::Delivered {
                via: route(via),
                attempts,
            },
            Outcome::Sent { via, .. } => Outcome::Sent {
                via: route(via),
                attempts,
            },
            Outcome::Failed { reason, .. } => {
                open_letter.progress.attempts = attempts;
                if reason == FailureReason::QueueFull {
                    self.was_full(now);
                }
                match reason {
                    FailureReason::NoSuchAgent => self.receiver_unknown(now, index, None, table),
                    _ => self.fail(now, index, reason, table),
                }
                return;
            }
            _ => return self.fail(now, index, FailureReason::Unconfirmed, table),
        };
        self.settle(now, index, Settlement::Outcome(outcome), table);
    }

    /// Handles a change of the directory: services with letters in custody may be gone.
    pub(crate) fn directory_changed(&mut self, now: Instant, table: &mut LaneTable) {
        self.check_next_hops(now, table);
        self.notice_end(now, table);
        self.dispatch_all(now, table);
    }

    /// Ends attempts and custody at services that no longer lead to the receiver, according to the
    /// receiver's entry in the directory.
    pub(super) fn check_next_hops(&mut self, now: Instant, table: &mut LaneTable) {
        let mut entry: Option<(Incarnation, Option<std::sync::Arc<Entry>>)> = None;
        for index in 0..self.letters.len() {
            let registration = self.letters[index].registration;
            let known = match &entry {
                Some((of, known)) if *of == registration => known.clone(),
                _ => {
                    let known = table.receiver(registration, &self.receiver);
                    let known = known.or_else(|| self.stated.clone());
                    entry = Some((registration, known.clone()));
                    known
                }
            };
            // If the receiver itself is gone, its custodian reports that, or a timeout ends the
            // letter.
            if let Some(entry) = known {
                self.check_next_hop(now, index, &entry, table);
            }
        }
    }

    /// Detects that a registration with letters in the lane has left the directory; letters for its
    /// successor then wait only for a limited time. Letters before the first one for that
    /// registration may have moved to the successor.
    pub(super) fn notice_end(&mut self, now: Instant, table: &LaneTable) {
        if self.is_custody() || self.stated.is_some() {
            return;
        }
        let mut present = None;
        let mut registrations = self.letters.iter().map(|letter| letter.registration);
        let ended = registrations.find(|registration| {
            let is_there = present == Some(*registration)
                || table.receiver(*registration, &self.receiver).is_some();
            if is_there {
                present = Some(*registration);
            }
            !is_there
        });
        match (self.ended, ended) {
            (_, None) => self.ended = None,
            (Some((known, _)), Some(ended)) if known == ended => {}
            (_, Some(ended)) => {
                self.ended = Some((ended, now));
                self.due_at(now + ENDED_TIMEOUT);
            }
        }
    }

    /// Restarts the wait for letters of an ended registration after an event of the letter at
    /// `index`, if that is one of them.
    fn record_event(&mut self, now: Instant, index: usize) {
        let registration = self.letters[index].registration;
        if let Some((ended, last_event)) = &mut self.ended
            && *ended == registration
        {
            *last_event = now;
        }
    }

    /// Checks whether the receiver can still be reached through the service that the letter was
    /// handed to; if not, ends the wait for that service's answer or report.
    fn check_next_hop(&mut self, now: Instant, index: usize, entry: &Entry, table: &mut LaneTable) {
        let open_letter = &mut self.letters[index];
        let Some((_, location)) = open_letter.progress.state.handed_over() else {
            return;
        };
        let service = location.incarnation();
        let stands = |route: &Location| route.incarnation() == service;
        let is_there = entry.locations.iter().any(stands);
        let has_left =
            || table.routes.service_has_left(location) && !entry.locations.contains(location);
        let is_under_way = matches!(open_letter.progress.state, State::UnderWay { .. });
        if !service.is_known() || (is_there && !(is_under_way && has_left())) {
            return;
        }
        match &open_letter.progress.state {
            State::UnderWay { .. } => {
                let text = match is_there {
                    true => "the service has left this location",
                    false => "the service at this location was replaced",
                };
                open_letter.abandon(table, || {
                    TransportError::new(TransportErrorKind::Broken, text)
                });
            }
            State::Custody { .. } => {
                let text = "the gateway that had the letter in custody is gone";
                self.custodian_lost(now, index, text, table);
            }
            State::Waiting(_) | State::Ended => {}
        }
    }
}

/// The end of a custody that returned the letter.
fn end_of(uncertain: bool) -> AttemptEnd {
    match uncertain {
        true => AttemptEnd::Unknown,
        false => AttemptEnd::NotTaken,
    }
}
