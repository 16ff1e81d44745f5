//! A lane: the letters of one stream that have no outcome yet, in order, and where each of them
//! stands.
//!
//! Letters are dispatched in order and only along one way at a time. When one comes back, the
//! lane waits until everything under way has been heard of, and goes on from the earliest letter
//! without an outcome. The receiving end takes a letter only after the one before it
//! ([`Parcel::after`]), so that nothing overtakes while ways change.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::Letter;
use fipa_sds::Entry;
use fipa_transport::{
    Answer, Attempt, AttemptId, Body, Conclusion, FailureReason, Incarnation, Kind, Location,
    Outcome, Parcel, Report, Stream, Ticket, WayError, WayFault,
};

use super::desk::{Action, Desk, Origin, Purpose, Undelivered};

/// One letter on its way to one receiver.
#[derive(Debug)]
pub(crate) struct Delivery {
    pub(crate) origin: Origin,
    pub(crate) letter: Letter,
    pub(crate) sequence: u64,
    /// The letter that this one comes after, as it was told by whoever handed it over.
    pub(crate) after: u64,
    pub(crate) deadline: Instant,
    pub(crate) hops: u8,
    /// When whoever handed it over is told that it is in custody, if nothing happened before.
    pub(crate) custody_due: Option<Instant>,
    progress: Progress,
}

#[derive(Debug)]
struct Progress {
    state: State,
    /// What was tried, for the outcome.
    attempts: Vec<Attempt>,
    /// The ways tried in this round.
    tried: Vec<Location>,
    /// Some attempt may have delivered it.
    unconfirmed: bool,
    /// The receiver's queue was full.
    busy: bool,
}

#[derive(Debug)]
enum State {
    Waiting,
    UnderWay {
        attempt: AttemptId,
        location: Location,
        times_out: Instant,
    },
    Custody {
        location: Location,
    },
}

impl Delivery {
    pub(crate) fn new(
        origin: Origin,
        letter: Letter,
        sequence: u64,
        after: u64,
        deadline: Instant,
        hops: u8,
    ) -> Self {
        let progress = Progress {
            state: State::Waiting,
            attempts: Vec::new(),
            tried: Vec::new(),
            unconfirmed: false,
            busy: false,
        };
        Self {
            origin,
            letter,
            sequence,
            after,
            deadline,
            hops,
            custody_due: None,
            progress,
        }
    }

    fn is_waiting(&self) -> bool {
        matches!(self.progress.state, State::Waiting)
    }

    fn failed_at(&mut self, location: &Location, error: WayError) {
        if self.progress.attempts.len() < MAX_ATTEMPTS {
            let location = location.clone();
            self.progress.attempts.push(Attempt {
                via: location.kind(),
                location,
                error,
            });
        }
    }

    /// Why it failed when its time is over.
    fn reason_at_deadline(&self) -> FailureReason {
        let progress = &self.progress;
        if progress.unconfirmed || !self.is_waiting() {
            FailureReason::Unconfirmed
        } else if progress.busy {
            FailureReason::QueueFull
        } else if progress.attempts.is_empty() {
            FailureReason::TimedOut
        } else {
            FailureReason::Unreachable
        }
    }

    fn custody_taken(&mut self, desk: &mut Desk) {
        if let Origin::Forwarded { unanswered, .. } = &mut self.origin {
            if let Some((kind, ticket)) = unanswered.take() {
                desk.actions.push_back(Action::Answer {
                    kind,
                    ticket,
                    answer: Answer::Custody,
                });
            }
        }
        self.custody_due = None;
    }
}

/// How many failed attempts are remembered for one letter's outcome.
const MAX_ATTEMPTS: usize = 16;
/// How many failed letters of a stream are remembered to mend the order of later ones.
const MAX_SKIPPED: usize = 64;
/// Pauses between rounds over all ways.
const FIRST_PAUSE: Duration = Duration::from_millis(10);
const LONGEST_PAUSE: Duration = Duration::from_millis(500);
/// How long a busy receiver is left alone when no credit comes.
const BUSY_PAUSE: Duration = Duration::from_millis(100);
/// How long a lane waits for room when nobody tells it, and how often before it counts as a
/// failure of the way.
const CONGESTED_PAUSE: Duration = Duration::from_millis(20);
const CONGESTED_TRIES: u32 = 25;
/// A large letter may take longer: this many bytes a second are expected at least.
const SLOWEST_BYTES_PER_SECOND: u64 = 1 << 20;
/// What is taken off the remaining time at every hop, so that those further down the way give up
/// and say why before those further up.
const HOP_MARGIN: Duration = Duration::from_millis(100);

#[derive(Debug)]
pub(crate) struct Lane {
    stream: Stream,
    receiver: Arc<str>,
    letters: VecDeque<Delivery>,
    under_way: usize,
    /// The way that letters under way go.
    way: Option<Location>,
    /// Something came back: nothing is dispatched until all that is under way has been heard of.
    recovering: bool,
    paused_until: Option<Instant>,
    pauses: u32,
    /// Letters that failed here, and what they came after: who came after them comes after that.
    skipped: VecDeque<(u64, u64)>,
    /// When something is due by the clock at the earliest.
    due: Option<Instant>,
    /// When the core's timer will look at this lane next.
    pub(crate) scheduled: Option<Instant>,
    /// How often in a row the way had no room.
    congested: u32,
    /// When something last happened here.
    pub(crate) active: Instant,
    /// Who was told that the lane is full and waits for a credit.
    waiting: Option<Location>,
}

/// What a lane cannot decide alone.
pub(crate) enum Moved {
    /// The receiver was registered anew, and this letter was certainly not delivered before.
    To(Arc<Entry>, Delivery),
}

impl Lane {
    pub(crate) fn new(now: Instant, stream: Stream, receiver: Arc<str>) -> Self {
        Self {
            stream,
            receiver,
            letters: VecDeque::new(),
            under_way: 0,
            way: None,
            recovering: false,
            paused_until: None,
            pauses: 0,
            skipped: VecDeque::new(),
            due: None,
            scheduled: None,
            congested: 0,
            active: now,
            waiting: None,
        }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.letters.is_empty()
    }

    pub(crate) fn len(&self) -> usize {
        self.letters.len()
    }

    /// The way that a letter is going at the moment.
    pub(crate) fn way_of(&self, sequence: u64) -> Option<&Location> {
        match &self.letters[self.index(sequence)?].progress.state {
            State::UnderWay { location, .. } => Some(location),
            _ => None,
        }
    }

    /// Nothing more to do and nothing to remember.
    pub(crate) fn is_idle(&self) -> bool {
        self.letters.is_empty() && self.waiting.is_none()
    }

    /// Whether the order of letters that are still to come depends on this lane.
    pub(crate) fn remembers(&self) -> bool {
        !self.skipped.is_empty()
    }

    /// When the lane must be looked at again at the latest.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.due
    }

    fn due_at(&mut self, at: Instant) {
        if self.due.is_none_or(|due| at < due) {
            self.due = Some(at);
        }
    }

    /// Puts a letter in, at its place in the order.
    pub(crate) fn push(&mut self, delivery: Delivery) {
        let place = self
            .letters
            .partition_point(|other| other.sequence < delivery.sequence);
        self.due_at(delivery.deadline);
        if let Some(due) = delivery.custody_due {
            self.due_at(due);
        }
        self.letters.insert(place, delivery);
    }

    /// A copy of a letter that is here already: its sender has not heard of the first one, and is
    /// told of this one. Says whether there was one.
    pub(crate) fn adopt(
        &mut self,
        sequence: u64,
        origin: Origin,
        desk: &mut Desk,
    ) -> Option<Origin> {
        let Some(index) = self.index(sequence) else {
            return Some(origin);
        };
        let delivery = &mut self.letters[index];
        delivery.custody_taken(desk);
        delivery.origin = origin;
        None
    }

    pub(crate) fn wait_for_credit(&mut self, back: Location) {
        self.waiting = Some(back);
    }

    /// Dispatches what can be dispatched.
    pub(crate) fn pump(&mut self, now: Instant, desk: &mut Desk, moved: &mut Vec<Moved>) {
        self.active = now;
        self.expire(now, desk);
        if self.recovering && self.under_way == 0 {
            self.recovering = false;
            self.way = None;
        }
        if !self.recovering && self.paused_until.is_none_or(|until| until <= now) {
            self.paused_until = None;
            self.dispatch_waiting(now, desk, moved);
        }
        self.give_credit(desk);
    }

    fn dispatch_waiting(&mut self, now: Instant, desk: &mut Desk, moved: &mut Vec<Moved>) {
        let mut index = 0;
        while index < self.letters.len() && self.under_way < desk.config.window {
            if !self.letters[index].is_waiting() {
                index += 1;
                continue;
            }
            let Some(entry) = desk.directory.by_incarnation(self.stream.receiver) else {
                self.receiver_left(index, desk, moved);
                continue;
            };
            match desk.choose(now, &entry, &self.letters[index].progress.tried) {
                Some(way) if self.under_way == 0 || self.way.as_ref() == Some(&way) => {
                    self.dispatch(now, index, way, desk);
                    index += 1;
                }
                // Another way than the letters before it: not before they have arrived.
                Some(_) => break,
                None if self.under_way > 0 => break,
                None => {
                    if !self.end_of_round(now, index, desk) {
                        break;
                    }
                }
            }
        }
    }

    fn dispatch(&mut self, now: Instant, index: usize, way: Location, desk: &mut Desk) {
        let after = self.after(index);
        let delivery = &mut self.letters[index];
        let left = delivery.deadline.saturating_duration_since(now);
        let parcel = Parcel {
            receiver: Arc::clone(&self.receiver),
            stream: self.stream,
            sequence: delivery.sequence,
            after,
            remaining: left - HOP_MARGIN.min(left / 8),
            hops: delivery.hops,
            body: Body::Letter(delivery.letter.clone()),
        };
        let size = delivery.letter.len() as u64;
        let allowance = Duration::from_millis(size.saturating_mul(1000) / SLOWEST_BYTES_PER_SECOND);
        let times_out = now + desk.config.attempt_timeout + allowance;
        let purpose = Purpose::Letter {
            stream: self.stream,
            sequence: delivery.sequence,
        };
        let attempt = desk.dispatch(purpose, way.clone(), parcel);
        delivery.progress.tried.push(way.clone());
        delivery.progress.state = State::UnderWay {
            attempt,
            location: way.clone(),
            times_out,
        };
        self.due_at(times_out);
        self.under_way += 1;
        self.way = Some(way);
    }

    /// The letter that the one at `index` comes after: the one before it here, or what it was
    /// told, unless that failed here.
    fn after(&self, index: usize) -> u64 {
        if let Some(before) = index.checked_sub(1) {
            return self.letters[before].sequence;
        }
        let mut after = self.letters[index].after;
        while let Some((_, before)) = self.skipped.iter().find(|(failed, _)| *failed == after) {
            after = *before;
        }
        after
    }

    /// Every way was tried. Says whether the letter was settled.
    fn end_of_round(&mut self, now: Instant, index: usize, desk: &mut Desk) -> bool {
        let progress = &mut self.letters[index].progress;
        if progress.tried.is_empty() {
            self.fail(index, FailureReason::Unreachable, desk);
            return true;
        }
        let too_large = progress
            .attempts
            .iter()
            .all(|a| a.error.fault == WayFault::TooLarge);
        if too_large && !progress.attempts.is_empty() {
            self.fail(index, FailureReason::TooLarge, desk);
            return true;
        }
        progress.tried.clear();
        self.pause(now);
        false
    }

    fn pause(&mut self, now: Instant) {
        let pause = FIRST_PAUSE
            .saturating_mul(1 << self.pauses.min(10))
            .min(LONGEST_PAUSE);
        self.pauses += 1;
        self.pause_until(now + pause);
    }

    fn pause_until(&mut self, until: Instant) {
        self.paused_until = Some(until);
        self.due_at(until);
    }

    fn receiver_left(&mut self, index: usize, desk: &mut Desk, moved: &mut Vec<Moved>) {
        let delivery = &self.letters[index];
        let local = matches!(delivery.origin, Origin::Local { .. });
        let successor = desk.directory.lookup(&self.receiver);
        match successor {
            // Whoever handed the letter over decides about the successor: only the sender knows
            // whether another copy may have been delivered.
            Some(entry)
                if local
                    && !delivery.progress.unconfirmed
                    && entry.incarnation != self.stream.receiver =>
            {
                self.note_skipped(index);
                if let Some(mut delivery) = self.letters.remove(index) {
                    delivery.progress.tried.clear();
                    delivery.progress.state = State::Waiting;
                    moved.push(Moved::To(entry, delivery));
                }
            }
            _ => {
                let unconfirmed = self.letters[index].progress.unconfirmed;
                let reason = if unconfirmed {
                    FailureReason::Unconfirmed
                } else {
                    FailureReason::NoSuchAgent
                };
                self.fail(index, reason, desk);
            }
        }
    }

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
        self.under_way -= 1;
        self.letters[index].progress.state = State::Waiting;
        match conclusion {
            Conclusion::Answered(answer) => {
                desk.way_worked(&location);
                self.answered(now, index, location, answer, desk, moved);
            }
            Conclusion::Handed => {
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
                // The directory may know by now that the agent was registered anew.
                let gone = desk
                    .directory
                    .by_incarnation(self.stream.receiver)
                    .is_none();
                if gone {
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

    /// The other side said finally that it does not take the letter. If an earlier attempt may
    /// have delivered it, that is what the sender has to know.
    fn refused(
        &mut self,
        index: usize,
        location: &Location,
        reason: FailureReason,
        detail: String,
        desk: &mut Desk,
    ) {
        let delivery = &mut self.letters[index];
        let unconfirmed = delivery.progress.unconfirmed;
        delivery.failed_at(
            location,
            WayError {
                fault: WayFault::Refused,
                detail,
            },
        );
        let reason = if unconfirmed {
            FailureReason::Unconfirmed
        } else {
            reason
        };
        self.fail(index, reason, desk);
    }

    /// An attempt did not reach the other side, or nobody knows.
    fn came_back(
        &mut self,
        now: Instant,
        index: usize,
        location: &Location,
        error: WayError,
        desk: &mut Desk,
    ) {
        self.recovering = true;
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
        let delivery = &mut self.letters[index];
        match &delivery.progress.state {
            State::Waiting => return,
            State::Custody { .. } => {}
            // The report overtook the answer.
            State::UnderWay {
                attempt, location, ..
            } => {
                desk.abandon(location.kind(), *attempt);
                self.under_way -= 1;
            }
        }
        delivery.progress.state = State::Waiting;
        let mut attempts = std::mem::take(&mut delivery.progress.attempts);
        let unconfirmed = delivery.progress.unconfirmed;
        match report.outcome {
            Outcome::Failed { reason, attempts: theirs } => {
                attempts.extend(theirs);
                delivery.progress.attempts = attempts;
                let gone = reason == FailureReason::NoSuchAgent
                    && desk.directory.by_incarnation(self.stream.receiver).is_none();
                if gone {
                    self.receiver_left(index, desk, moved);
                } else {
                    let reason = if unconfirmed { FailureReason::Unconfirmed } else { reason };
                    self.fail(index, reason, desk);
                }
            }
            Outcome::Delivered {
                via,
                attempts: theirs,
            } => {
                attempts.extend(theirs);
                self.settle(index, Outcome::Delivered { via, attempts }, desk);
            }
            Outcome::Sent {
                via,
                attempts: theirs,
            } => {
                attempts.extend(theirs);
                self.settle(index, Outcome::Sent { via, attempts }, desk);
            }
            other => {
                delivery.progress.attempts = attempts;
                let error = WayError::new(WayFault::Incompatible, format!("{other:?}"));
                let location = Location::new(Kind::Shm, "report");
                if let Ok(location) = location {
                    delivery.failed_at(&location, error);
                }
                self.fail(index, FailureReason::Unconfirmed, desk);
            }
        }
        self.pump(now, desk, moved);
    }

    /// There is room again, at the receiver or on the way to it.
    pub(crate) fn resume(&mut self, now: Instant, desk: &mut Desk, moved: &mut Vec<Moved>) {
        self.paused_until = None;
        self.pauses = 0;
        self.pump(now, desk, moved);
    }

    /// The directory has changed: who had letters in custody may be gone.
    pub(crate) fn directory_changed(
        &mut self,
        now: Instant,
        desk: &mut Desk,
        moved: &mut Vec<Moved>,
    ) {
        for index in 0..self.letters.len() {
            let State::Custody { location } = &self.letters[index].progress.state else {
                continue;
            };
            let custodian = location.incarnation();
            if custodian.is_known() && desk.directory.by_incarnation(custodian).is_none() {
                let location = location.clone();
                let delivery = &mut self.letters[index];
                delivery.progress.state = State::Waiting;
                delivery.progress.unconfirmed = true;
                let text = "the gateway that had the letter in custody is gone";
                let error = WayError::new(WayFault::Broken, text);
                self.came_back(now, index, &location, error, desk);
            }
        }
        self.pump(now, desk, moved);
    }

    /// Gives up everything, when the sending agent goes away or the service ends.
    pub(crate) fn give_up(&mut self, desk: &mut Desk) {
        while let Some(delivery) = self.letters.front() {
            if let State::UnderWay {
                attempt, location, ..
            } = &delivery.progress.state
            {
                desk.abandon(location.kind(), *attempt);
            }
            let reason = match delivery.reason_at_deadline() {
                FailureReason::TimedOut => FailureReason::Unreachable,
                reason => reason,
            };
            self.fail(0, reason, desk);
        }
        self.under_way = 0;
    }

    /// What is due by the clock: deadlines, attempts without an answer, custody to be told.
    fn expire(&mut self, now: Instant, desk: &mut Desk) {
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
                    self.under_way -= 1;
                    self.recovering = true;
                    let text = "the letter's deadline passed";
                    delivery.failed_at(&location, WayError::new(WayFault::TimedOut, text));
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
            {
                if *times_out <= now {
                    let (attempt, location) = (*attempt, location.clone());
                    desk.abandon(location.kind(), attempt);
                    self.under_way -= 1;
                    delivery.progress.state = State::Waiting;
                    delivery.progress.unconfirmed = true;
                    let error = WayError::new(WayFault::TimedOut, "");
                    self.came_back(now, index, &location, error, desk);
                }
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

    fn fail(&mut self, index: usize, reason: FailureReason, desk: &mut Desk) {
        let delivery = &mut self.letters[index];
        let attempts = std::mem::take(&mut delivery.progress.attempts);
        let local = matches!(delivery.origin, Origin::Local { .. } | Origin::Nobody);
        if local {
            let detail = attempts.last().map(ToString::to_string).unwrap_or_default();
            desk.undelivered.push_back(Undelivered {
                stream: self.stream,
                receiver: Arc::clone(&self.receiver),
                letter: delivery.letter.clone(),
                reason,
                detail,
            });
        }
        self.note_skipped(index);
        self.settle(index, Outcome::Failed { reason, attempts }, desk);
    }

    fn note_skipped(&mut self, index: usize) {
        let delivery = &self.letters[index];
        if matches!(delivery.origin, Origin::Forwarded { .. }) {
            let after = self.after(index);
            if self.skipped.len() >= MAX_SKIPPED {
                self.skipped.pop_front();
            }
            self.skipped
                .push_back((self.letters[index].sequence, after));
        }
    }

    fn settle(&mut self, index: usize, outcome: Outcome, desk: &mut Desk) {
        let Some(delivery) = self.letters.remove(index) else {
            return;
        };
        if self.letters.is_empty() {
            self.way = None;
        }
        let receiver = Arc::clone(&self.receiver);
        desk.settle(
            delivery.origin,
            self.stream,
            delivery.sequence,
            receiver,
            outcome,
        );
    }

    fn give_credit(&mut self, desk: &mut Desk) {
        if self.letters.len() * 2 <= desk.config.lane {
            if let Some(back) = self.waiting.take() {
                desk.credit(self.stream, Arc::clone(&self.receiver), back);
            }
        }
    }

    fn index(&self, sequence: u64) -> Option<usize> {
        self.letters
            .binary_search_by_key(&sequence, |delivery| delivery.sequence)
            .ok()
    }

    /// The agent that sends in this lane.
    pub(crate) fn sender(&self) -> Incarnation {
        self.stream.sender
    }
}

impl Delivery {
    /// Remembers which arrival still has no answer, and until when it may wait.
    pub(crate) fn answer_by(mut self, unanswered: Option<(Kind, Ticket)>, due: Instant) -> Self {
        if unanswered.is_some() {
            self.custody_due = Some(due);
        }
        if let Origin::Forwarded {
            unanswered: slot, ..
        } = &mut self.origin
        {
            *slot = unanswered;
        }
        self
    }
}
