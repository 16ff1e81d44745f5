//! When notes leave, and when reports are repeated.

use std::cmp::Reverse;
use std::time::Instant;

use fipa_transport::{
    Answer, AttemptId, Body, Conclusion, Location, Stream, TransportError, TransportErrorKind,
};

use super::super::ids::LaneId;
use super::super::label::HandedOver;
use super::super::lane::PauseEnd;
use super::super::lane_table::{LaneTable, Purpose};
use super::super::{Core, Now, work};
use super::{AFTER_ANSWER, Due, Note, PROBES, ROOM_TRIES, TIMERS_AT_ONCE, Timer, source_of};
use crate::gate::LetterSource;

impl LaneTable {
    /// Sends a note.
    pub(crate) fn note(&mut self, mut note: Note) {
        if note.is_report() {
            self.notes.open_reports.insert(note.transfer());
        }
        self.notes.count(&mut note);
        self.post(note);
    }

    /// Sends a note, behind those that wait for room at its location.
    fn post(&mut self, note: Note) {
        let waiting = self.notes.without_room.get(&note.location);
        match waiting.is_some_and(|waiting| !waiting.notes.is_empty()) {
            true => self.notes.put_without_room(note),
            false => self.transmit(note),
        }
    }

    fn transmit(&mut self, mut note: Note) {
        note.tries += 1;
        let (location, parcel) = (note.location.clone(), note.parcel.clone());
        let attempt = self.next_attempt();
        if note.repeated.is_some() {
            self.notes.sent.push_back(attempt);
        }
        self.dispatch(attempt, Purpose::Note(Box::new(note)), location, parcel);
    }

    /// Sends a report again, to the next of the current locations of its receiver.
    fn repeat(&mut self, mut note: Note) {
        note.location = self.present_location(&note);
        self.post(note);
    }

    /// Repeats at most this number of reports that a source has not answered.
    fn repeat_some(&mut self, now: Instant, source: LetterSource, most: usize) {
        for _ in 0..most {
            let Some(note) = self.notes.next_unanswered(now, source) else {
                break;
            };
            self.repeat(note);
        }
        self.notes.pause(now, source);
    }

    /// Repeats a few reports for the services at this address, which have given a sign of life.
    pub(in crate::core) fn repeat_reports(&mut self, now: Instant, location: &Location) {
        if !self.notes.unanswered.is_empty() {
            self.repeat_some(now, source_of(location), PROBES);
        }
    }

    /// Returns the current location of the service to which a note goes; its address may have
    /// changed. The directory has the locations of the letter's sender, which is behind that
    /// service.
    fn present_location(&self, note: &Note) -> Location {
        let service = note.location.incarnation();
        let sender = self.view.registered(note.parcel.stream.sender);
        let mut present: Vec<&Location> = Vec::new();
        if let Some(entry) = &sender {
            let locations = entry.locations.iter();
            present.extend(locations.filter(|it| it.incarnation() == service));
        }
        let next = (note.tries as usize).checked_rem(present.len());
        match next.and_then(|next| present.get(next)) {
            Some(location) if service.is_known() => (*location).clone(),
            _ => note.location.clone(),
        }
    }

    pub(crate) fn wait_for_room(&mut self, location: &Location, lane: LaneId) {
        let waiting = self.notes.without_room.entry(location.clone()).or_default();
        waiting.lanes.push(lane);
    }

    /// Handles the end of an attempt at this location. Sends a note that waits for room there; without one,
    /// returns the lane that may use the room.
    pub(in crate::core) fn made_room(
        &mut self,
        now: Instant,
        location: &Location,
    ) -> Option<LaneId> {
        if let Some(note) = self.notes.next_without_room(now, location) {
            self.transmit(note);
            return None;
        }
        let waiting = self.notes.without_room.get_mut(location)?;
        let lane = waiting.lanes.pop();
        self.notes.forget_room(location);
        lane
    }

    /// Whether the end of this hand-over of a letter is being reported and not acknowledged yet.
    pub(crate) fn is_reporting(&self, stream: Stream, sequence: u64, transfer: u64) -> bool {
        let hand_over = (stream, sequence, transfer);
        self.notes.open_reports.contains(&hand_over)
    }

    /// Whether the end of any hand-over is being reported and not acknowledged yet.
    pub(in crate::core) fn has_open_reports(&self) -> bool {
        !self.notes.open_reports.is_empty()
    }
}

impl Core {
    /// Sets the timers of reports that were sent.
    pub(in crate::core) fn await_answers(&mut self, now: Now) {
        while let Some(attempt) = self.table.notes.sent.pop_front() {
            if let Some(Purpose::Note(note)) = self.table.attempts.get_mut(&attempt) {
                note.sent = Some(now.instant);
            }
            let due = now.instant + self.table.config.attempt_timeout;
            self.table.notes.timer(due, Due::Answer(attempt));
        }
    }

    /// Handles the end of an attempt to send a note.
    pub(in crate::core) fn note_concluded(&mut self, now: Now, note: Note, conclusion: Conclusion) {
        let location = note.location.clone();
        if let Conclusion::NotSent(error) = &conclusion
            && error.fault.waits_for_room()
        {
            let mut note = note;
            note.tries -= 1;
            let notes = &mut self.table.notes;
            notes.put_without_room(note);
            notes.watch_room(now.instant, &location);
            return;
        }
        // Before this note is repeated.
        self.room_at(now, &location);
        let is_answered = matches!(conclusion, Conclusion::Answered(_) | Conclusion::Handed);
        // A refused note has changed nothing.
        let arrived = matches!(
            conclusion,
            Conclusion::Answered(Answer::Accepted | Answer::Busy | Answer::Returned { .. })
                | Conclusion::Handed
        );
        if arrived && let Some(sent) = note.sent {
            let took = now.instant.saturating_duration_since(sent);
            self.table.acknowledged(location.incarnation(), took);
        }
        if arrived || !note.goes_again(now.instant) {
            self.table.notes.end(&note);
            self.predecessor_answered(now, &note, &conclusion);
        } else {
            if is_answered {
                self.table.notes.report_ended(&note);
            }
            self.table.notes.put_unanswered(now.instant, note);
        }
        if arrived && !self.table.notes.unanswered.is_empty() {
            let source = source_of(&location);
            if let Some(unanswered) = self.table.notes.unanswered.get_mut(&source) {
                unanswered.pauses = 0;
            }
            self.table.repeat_some(now.instant, source, AFTER_ANSWER);
        }
        self.await_answers(now);
    }

    /// Handles the answer of a custodian to the question whether it has a letter.
    fn predecessor_answered(&mut self, now: Now, note: &Note, conclusion: &Conclusion) {
        let is_busy = matches!(conclusion, Conclusion::Answered(Answer::Busy));
        if note.parcel.body != Body::Predecessor || !(is_busy || is_denied(conclusion)) {
            return;
        }
        let (stream, sequence, transfer) = note.transfer();
        if let Some(lane) = self.lane_of(stream, &note.parcel.receiver) {
            let letter = HandedOver {
                registration: stream.receiver,
                sequence,
                transfer,
            };
            self.with_lane(now, lane, |lane, table| match is_busy {
                true => lane.custodian_busy(now.instant, letter),
                false => lane.custodian_denied(now.instant, letter, table),
            });
        }
    }

    /// Lets a note or a lane use the room that the end of an attempt at this location has made.
    fn room_at(&mut self, now: Now, location: &Location) {
        if !self.table.notes.wait_for_room() {
            return;
        }
        if let Some(lane) = self.table.made_room(now.instant, location) {
            self.with_lane(now, lane, |lane, table| {
                lane.resume(now.instant, PauseEnd::Room, table);
            });
        }
    }

    /// Handles the timers of notes that are due, at most a portion of them.
    pub(in crate::core) fn handle_note_timers(&mut self, now: Now) {
        for _ in 0..TIMERS_AT_ONCE {
            let timers = &mut self.table.notes.timers;
            if timers.peek().is_none_or(|Reverse(it)| it.0 > now.instant) {
                break;
            }
            work::steps(1);
            let Some(Reverse(Timer(at, due))) = timers.pop() else {
                break;
            };
            match due {
                Due::Answer(attempt) => self.report_unanswered(now, attempt),
                Due::Room(location) => self.send_without_room(now, &location),
                Due::Pause(source) => self.pause_ended(now, source, at),
            }
        }
        self.await_answers(now);
    }

    fn report_unanswered(&mut self, now: Now, attempt: AttemptId) {
        if let Some(Purpose::Note(note)) = self.table.attempts.remove(&attempt) {
            let location = note.location.clone();
            let error = TransportError::new(TransportErrorKind::TimedOut, "");
            self.table.abandon(location, attempt, error.clone());
            self.note_concluded(now, *note, Conclusion::Unconfirmed(error));
        }
    }

    fn send_without_room(&mut self, now: Now, location: &Location) {
        if let Some(waiting) = self.table.notes.without_room.get_mut(location) {
            waiting.has_timer = false;
        }
        for _ in 0..ROOM_TRIES {
            let notes = &mut self.table.notes;
            let Some(note) = notes.next_without_room(now.instant, location) else {
                break;
            };
            self.table.transmit(note);
        }
        self.table.notes.watch_room(now.instant, location);
    }

    fn pause_ended(&mut self, now: Now, source: LetterSource, at: Instant) {
        let unanswered = self.table.notes.unanswered.get_mut(&source);
        if let Some(unanswered) = unanswered.filter(|it| it.due == Some(at)) {
            unanswered.due = None;
            self.table.repeat_some(now.instant, source, PROBES);
        }
    }
}

/// Whether the custodian answered that it does not have the letter, or is gone.
fn is_denied(conclusion: &Conclusion) -> bool {
    match conclusion {
        Conclusion::Answered(Answer::Returned { .. }) => true,
        Conclusion::NotSent(error) => error.fault == TransportErrorKind::WrongIncarnation,
        _ => false,
    }
}
