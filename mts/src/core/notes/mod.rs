//! Notes about letters: reports, credits and predecessors. Only reports are repeated.
//!
//! * A note for which a route has no room has not failed. It waits before the lanes that wait for room there,
//!   and leaves when an attempt there ends.
//! * A report without an answer waits until its receiver's source answers another one, or a pause ends. The
//!   pause doubles. So a peer that never answers causes a few repetitions for each pause, however many reports
//!   wait for it.
//! * Each source has a share of the reports that are repeated. Beyond it, reports of that source are sent once.

mod sending;

use std::cmp::{Ordering, Reverse};
use std::collections::{BinaryHeap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{AttemptId, Body, Location, Parcel, Stream};

use super::ids::LaneId;
use super::work;
use crate::gate::LetterSource;
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
    repeated: Option<(LetterSource, Instant)>,
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
fn source_of(location: &Location) -> LetterSource {
    match location.kind().is_host_local() {
        true => LetterSource::Process(location.incarnation()),
        false => LetterSource::unproved(location),
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
    Pause(LetterSource),
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
    unanswered: Map<LetterSource, Unanswered>,
    /// Number of reports that are repeated, of each source and of all.
    shares: Map<LetterSource, usize>,
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
    fn pause(&mut self, now: Instant, source: LetterSource) {
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
    fn next_unanswered(&mut self, now: Instant, source: LetterSource) -> Option<Note> {
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

pub(super) fn note_parcel(stream: Stream, receiver: Arc<str>, sequence: u64, body: Body) -> Parcel {
    Parcel {
        receiver,
        stream,
        sequence,
        after: 0,
        transfer: 0,
        remaining: Duration::ZERO,
        body,
    }
}

#[cfg(test)]
mod tests {
    use fipa_transport::Incarnation;

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
