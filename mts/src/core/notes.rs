//! Notes about letters: reports, credits and predecessors. Only reports are repeated.
//!
//! * A note for which a route has no room has not failed. It waits before the lanes that wait for room there,
//!   and leaves when an attempt there ends.
//! * A report without an answer waits until its receiver's source answers another one, or a pause ends. The
//!   pause doubles. So a peer that never answers causes a few repetitions for each pause, however many reports
//!   wait for it.
//! * Each source has a share of the reports that are repeated. Beyond it, reports of that source are sent once.

use std::cmp::{Ordering, Reverse};
use std::collections::{BinaryHeap, VecDeque};
use std::time::{Duration, Instant};

use fipa_transport::{
    Answer, AttemptId, Body, Conclusion, Location, Parcel, Stream, TransportError,
    TransportErrorKind,
};

use super::attempts::{AttemptTable, Purpose};
use super::lane::{LaneId, PauseEnd};
use super::{Core, Now, work};
use crate::gate::Source;
use crate::{Map, Set};

/// Maximum number of reports that are repeated, and of one source. A source with few of them is always served.
const MAX_REPORTS: usize = 65_536;
const MAX_REPORTS_OF_SOURCE: usize = 4096;
const FEW_REPORTS: usize = 256;
/// Maximum number of repetitions of one report.
const MAX_REPETITIONS: u32 = 32;
/// Pause of a source after a report without an answer, which doubles.
const FIRST_PAUSE: Duration = Duration::from_millis(20);
const LONGEST_PAUSE: Duration = Duration::from_secs(60);
/// Number of reports that are repeated when the pause of a source ends, and after an answer of the source.
const PROBES: usize = 4;
const AFTER_ANSWER: usize = 2;
/// Maximum number of notes that wait for room on the route to one location. Further ones are lost.
const MAX_WITHOUT_ROOM: usize = 2 * MAX_REPORTS_OF_SOURCE;
/// Time after which notes without room are sent although no attempt at the location has ended, and their number.
const ROOM_PAUSE: Duration = Duration::from_millis(50);
const ROOM_TRIES: usize = 16;
/// Maximum number of timers that one call handles.
const TIMERS_AT_ONCE: usize = 64;

/// A message about a letter: a report, a credit or a predecessor.
#[derive(Debug)]
pub(crate) struct Note {
    location: Location,
    parcel: Parcel,
    tries: u32,
    /// Time of the last transmission, if an answer is expected.
    sent: Option<Instant>,
    /// The share of which it is a part, and the end of its repetitions.
    repeated: Option<(Source, Instant)>,
}

impl Note {
    /// A note that is not repeated. A lost one only costs time.
    pub(super) fn once(location: Location, parcel: Parcel) -> Self {
        Self {
            location,
            parcel,
            tries: 0,
            sent: None,
            repeated: None,
        }
    }

    /// A report that is repeated until its receiver answers, or until then.
    pub(super) fn until(until: Instant, location: Location, parcel: Parcel) -> Self {
        let repeated = Some((source_of(&location), until));
        Self {
            repeated,
            ..Self::once(location, parcel)
        }
    }

    fn is_report(&self) -> bool {
        matches!(self.parcel.body, Body::Report(_))
    }

    /// The hand-over that the note is about: stream, sequence and transfer.
    fn transfer(&self) -> (Stream, u64, u64) {
        (
            self.parcel.stream,
            self.parcel.sequence,
            self.parcel.transfer,
        )
    }

    fn key(&self) -> NoteKey {
        let (stream, sequence, transfer) = self.transfer();
        match self.parcel.body {
            Body::Report(_) => NoteKey::Report(stream, sequence, transfer),
            Body::Predecessor => NoteKey::Predecessor(stream, sequence),
            Body::Credit | Body::Letter(_) => NoteKey::Credit(stream),
        }
    }

    /// Whether the note is to be repeated if it gets no answer.
    fn goes_again(&self, now: Instant) -> bool {
        self.tries <= MAX_REPETITIONS && self.repeated.is_some_and(|(_, until)| now < until)
    }

    fn is_late(&self, now: Instant) -> bool {
        self.repeated.is_some_and(|(_, until)| until <= now)
    }
}

/// The source to whose share the reports for a location count.
fn source_of(location: &Location) -> Source {
    match location.kind().is_host_local() {
        true => Source::Process(location.incarnation()),
        false => Source::unproved(location),
    }
}

/// Identifies a note among those that wait. Of two equal ones, the newest is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum NoteKey {
    Report(Stream, u64, u64),
    Credit(Stream),
    Predecessor(Stream, u64),
}

/// The notes and lanes that wait for room on the route to a location, in order.
#[derive(Debug, Default)]
struct WithoutRoom {
    order: VecDeque<NoteKey>,
    notes: Map<NoteKey, Note>,
    lanes: WaitingLanes,
    /// Whether a timer is set.
    has_timer: bool,
}

/// Lanes in the order in which they began to wait, each once.
#[derive(Debug, Default)]
struct WaitingLanes {
    order: VecDeque<LaneId>,
    members: Set<LaneId>,
}

impl WaitingLanes {
    fn push(&mut self, lane: LaneId) {
        if self.members.insert(lane) {
            self.order.push_back(lane);
        }
    }

    fn pop(&mut self) -> Option<LaneId> {
        let lane = self.order.pop_front()?;
        self.members.remove(&lane);
        Some(lane)
    }

    fn is_empty(&self) -> bool {
        self.order.is_empty()
    }
}

impl WithoutRoom {
    fn pop(&mut self) -> Option<Note> {
        let key = self.order.pop_front()?;
        self.notes.remove(&key)
    }
}

/// The reports that a source has not answered.
#[derive(Debug, Default)]
struct Unanswered {
    reports: VecDeque<Note>,
    /// Number of consecutive pauses without an answer.
    pauses: u32,
    /// The end of the present pause.
    due: Option<Instant>,
}

/// An event at a time.
#[derive(Debug)]
struct Timer(Instant, Due);

#[derive(Debug)]
enum Due {
    /// Check whether this report was answered.
    Answer(AttemptId),
    /// Send notes that wait for room at this location.
    Room(Location),
    /// End the pause of this source.
    Pause(Source),
}

impl Ord for Timer {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.cmp(&other.0)
    }
}

impl PartialOrd for Timer {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Timer {
    fn eq(&self, other: &Self) -> bool {
        self.0 == other.0
    }
}

impl Eq for Timer {}

/// The notes that are not answered.
#[derive(Debug, Default)]
pub(super) struct Notes {
    without_room: Map<Location, WithoutRoom>,
    unanswered: Map<Source, Unanswered>,
    /// Number of reports that are repeated, of each source and of all.
    shares: Map<Source, usize>,
    repeated: usize,
    /// Hand-overs whose end was reported and neither acknowledged nor refused yet.
    open_reports: Set<(Stream, u64, u64)>,
    /// Reports that have been sent and have no timer yet.
    sent: VecDeque<AttemptId>,
    timers: BinaryHeap<Reverse<Timer>>,
}

impl Notes {
    pub(super) fn due(&self) -> Option<Instant> {
        self.timers.peek().map(|Reverse(timer)| timer.0)
    }

    /// Whether notes or lanes wait for room on a route.
    pub(super) fn wait_for_room(&self) -> bool {
        !self.without_room.is_empty()
    }

    /// Counts a report to the share of its source. Beyond the share, it is sent once.
    fn count(&mut self, note: &mut Note) {
        let Some((source, _)) = note.repeated else {
            return;
        };
        let own = self.shares.entry(source).or_default();
        let fits = match self.repeated < MAX_REPORTS {
            true => *own < MAX_REPORTS_OF_SOURCE,
            false => *own < FEW_REPORTS && self.repeated < 2 * MAX_REPORTS,
        };
        if fits {
            *own += 1;
            self.repeated += 1;
            return;
        }
        if *own == 0 {
            self.shares.remove(&source);
        }
        note.repeated = None;
    }

    /// Ends a note: it was answered, or is no longer repeated.
    fn end(&mut self, note: &Note) {
        self.report_ended(note);
        self.uncount(note);
    }

    fn uncount(&mut self, note: &Note) {
        let Some((source, _)) = note.repeated else {
            return;
        };
        self.repeated -= 1;
        if let Some(own) = self.shares.get_mut(&source) {
            *own -= 1;
            if *own == 0 {
                self.shares.remove(&source);
            }
        }
    }

    /// A report that was refused may not be believed when it is repeated.
    fn report_ended(&mut self, note: &Note) {
        if note.is_report() {
            self.open_reports.remove(&note.transfer());
        }
    }

    fn timer(&mut self, at: Instant, due: Due) {
        self.timers.push(Reverse(Timer(at, due)));
    }

    /// Puts a note behind those that wait for room at its location. One without a place is lost.
    fn put_without_room(&mut self, note: Note) {
        let waiting = self.without_room.entry(note.location.clone()).or_default();
        let key = note.key();
        let is_known = waiting.notes.contains_key(&key);
        let is_full = !is_known && waiting.notes.len() >= MAX_WITHOUT_ROOM;
        let is_beyond_share = note.is_report() && note.repeated.is_none();
        if is_full || is_beyond_share {
            return self.end(&note);
        }
        match waiting.notes.insert(key, note) {
            Some(before) => self.uncount(&before),
            None => waiting.order.push_back(key),
        }
    }

    /// Sets the timer after which notes at this location leave although no attempt there has ended.
    fn watch_room(&mut self, now: Instant, location: &Location) {
        let Some(waiting) = self.without_room.get_mut(location) else {
            return;
        };
        if waiting.notes.is_empty() {
            return self.forget_room(location);
        }
        if !std::mem::replace(&mut waiting.has_timer, true) {
            self.timer(now + ROOM_PAUSE, Due::Room(location.clone()));
        }
    }

    fn forget_room(&mut self, location: &Location) {
        let is_over =
            |it: &WithoutRoom| it.notes.is_empty() && it.lanes.is_empty() && !it.has_timer;
        if self.without_room.get(location).is_some_and(is_over) {
            self.without_room.remove(location);
        }
    }

    /// Returns the next note that waits for room at this location.
    fn next_without_room(&mut self, now: Instant, location: &Location) -> Option<Note> {
        loop {
            let note = self.without_room.get_mut(location)?.pop()?;
            work::steps(1);
            if !note.is_late(now) {
                return Some(note);
            }
            self.end(&note);
        }
    }

    /// Keeps a report without an answer, until the pause of its source ends or the source answers.
    fn put_unanswered(&mut self, now: Instant, note: Note) {
        let Some((source, _)) = note.repeated else {
            return;
        };
        let unanswered = self.unanswered.entry(source).or_default();
        unanswered.pauses = unanswered.pauses.max(note.tries.saturating_sub(1));
        unanswered.reports.push_back(note);
        self.pause(now, source);
    }

    /// Begins the next pause of a source, unless one has not ended.
    fn pause(&mut self, now: Instant, source: Source) {
        let Some(unanswered) = self.unanswered.get_mut(&source) else {
            return;
        };
        if unanswered.reports.is_empty() {
            self.unanswered.remove(&source);
        } else if unanswered.due.is_none() {
            let pause = FIRST_PAUSE.saturating_mul(1 << unanswered.pauses.min(16));
            let due = now + pause.min(LONGEST_PAUSE);
            unanswered.pauses = unanswered.pauses.saturating_add(1);
            unanswered.due = Some(due);
            self.timer(due, Due::Pause(source));
        }
    }

    /// Returns the next report that a source has not answered.
    fn next_unanswered(&mut self, now: Instant, source: Source) -> Option<Note> {
        loop {
            let unanswered = self.unanswered.get_mut(&source)?;
            let note = unanswered.reports.pop_front()?;
            work::steps(1);
            if !note.is_late(now) {
                return Some(note);
            }
            self.end(&note);
        }
    }
}

impl AttemptTable {
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
    fn repeat_some(&mut self, now: Instant, source: Source, most: usize) {
        for _ in 0..most {
            let Some(note) = self.notes.next_unanswered(now, source) else {
                break;
            };
            self.repeat(note);
        }
        self.notes.pause(now, source);
    }

    /// Repeats a few reports for the services at this address, which have given a sign of life.
    pub(super) fn repeat_reports(&mut self, now: Instant, location: &Location) {
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
    pub(super) fn made_room(&mut self, now: Instant, location: &Location) -> Option<LaneId> {
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
    pub(super) fn has_open_reports(&self) -> bool {
        !self.notes.open_reports.is_empty()
    }
}

impl Core {
    /// Sets the timers of reports that were sent.
    pub(super) fn await_answers(&mut self, now: Now) {
        while let Some(attempt) = self.table.notes.sent.pop_front() {
            if let Some(Purpose::Note(note)) = self.table.attempts.get_mut(&attempt) {
                note.sent = Some(now.instant);
            }
            let due = now.instant + self.table.config.attempt_timeout;
            self.table.notes.timer(due, Due::Answer(attempt));
        }
    }

    /// Handles the end of an attempt to send a note.
    pub(super) fn note_concluded(&mut self, now: Now, note: Note, conclusion: Conclusion) {
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
            let letter = (stream.receiver, sequence, transfer);
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
    pub(super) fn handle_note_timers(&mut self, now: Now) {
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

    fn pause_ended(&mut self, now: Now, source: Source, at: Instant) {
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

#[cfg(test)]
mod tests {
    use fipa_transport::Incarnation;

    use super::super::attempts::note_parcel;
    use super::*;

    #[test]
    fn a_note_without_room_replaces_an_earlier_one() {
        let location: Location = "tcp://192.0.2.1:7100#0000000000000009".parse().unwrap();
        let note = |sender: u64, sequence: u64, after: u64, body: Body| {
            let stream = Stream::between(Incarnation::from_u64(sender), Incarnation::from_u64(1));
            let parcel = Parcel {
                after,
                ..note_parcel(stream, "arm".into(), sequence, body)
            };
            Note::once(location.clone(), parcel)
        };
        let mut notes = Notes::default();
        for round in (1..=3).rev() {
            for sender in 2..4 {
                notes.put_without_room(note(sender, 0, 0, Body::Credit));
                notes.put_without_room(note(sender, 7, round, Body::Predecessor));
                notes.put_without_room(note(sender, 8, round, Body::Predecessor));
            }
        }
        let now = Instant::now();
        let waiting = std::iter::from_fn(|| notes.next_without_room(now, &location));
        let waiting: Vec<Parcel> = waiting.map(|note| note.parcel).collect();
        assert_eq!(waiting.len(), 6);
        let newest = |it: &Parcel| it.body == Body::Credit || it.after == 1;
        assert!(waiting.iter().all(newest), "{waiting:?}");
        for sender in 0..2 * MAX_WITHOUT_ROOM as u64 {
            notes.put_without_room(note(sender, 0, 0, Body::Credit));
        }
        assert_eq!(notes.without_room[&location].notes.len(), MAX_WITHOUT_ROOM);
    }
}
