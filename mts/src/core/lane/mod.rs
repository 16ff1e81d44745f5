//! A lane: the letters of one stream that have no outcome yet, in order, and where each of them
//! stands.
//!
//! Letters are dispatched in order and only along one way at a time. When one comes back, the
//! lane waits until everything under way has been heard of, and goes on from the earliest letter
//! without an outcome. The receiving end takes a letter only after the one before it
//! ([`Parcel::after`]), so that nothing overtakes while ways change.
//!
//! Here is what moves letters on; [`answers`] is what comes back, [`clock`] what time does,
//! [`delivery`] a single letter.

mod answers;
mod clock;
mod delivery;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_sds::Entry;
use fipa_transport::{
    Body, FailureReason, Incarnation, Location, Outcome, Parcel, Stream, WayFault,
};

pub(crate) use self::delivery::Delivery;
use self::delivery::State;
use super::desk::{Author, Desk, Origin, Purpose, Undelivered, life_of};
use super::routes::Tally;

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
    /// What the receiver said of itself, if the directory does not know it.
    said: Option<Arc<Entry>>,
    letters: VecDeque<Delivery>,
    under_way: usize,
    /// The way that letters under way go.
    way: Option<Location>,
    /// Where it is counted what happens on that way, also when it was the last one.
    tally: Option<(Location, Arc<Tally>)>,
    /// Something came back: nothing is dispatched until all that is under way has been heard of.
    recovering: bool,
    paused_until: Option<Instant>,
    pauses: u32,
    /// The last letter that has got there.
    delivered: u64,
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

/// A letter for another lane: its receiver was registered anew, and it was certainly not delivered
/// before.
pub(crate) struct Moved {
    pub(crate) to: Arc<Entry>,
    pub(crate) delivery: Delivery,
}

impl Lane {
    pub(crate) fn new(now: Instant, stream: Stream, receiver: Arc<str>) -> Self {
        Self {
            stream,
            receiver,
            said: None,
            letters: VecDeque::new(),
            under_way: 0,
            way: None,
            tally: None,
            recovering: false,
            paused_until: None,
            pauses: 0,
            delivered: 0,
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

    /// Where the receiver can be reached: as the directory has it, or as it said itself when the
    /// directory does not know it.
    fn entry(&self, desk: &Desk) -> Option<Arc<Entry>> {
        let known = desk.receiver(self.stream.receiver, &self.receiver);
        known.or_else(|| self.said.clone())
    }

    /// Whether the receiver, of which others say that it is not there, is not in the directory
    /// either: it may have been registered anew, a moment ago.
    fn has_no_entry_any_more(&self, desk: &Desk) -> bool {
        desk.directory.refresh();
        self.entry(desk).is_none()
    }

    /// The receiver is not in the directory, but has said where it can be reached.
    pub(crate) fn said(&mut self, entry: Arc<Entry>) {
        self.said = Some(entry);
    }

    /// Puts a letter in, at its place in the order.
    pub(crate) fn push(&mut self, mut delivery: Delivery, desk: &mut Desk) {
        desk.held += delivery.letter.len();
        // A copy that strayed, most likely: the letter itself has got there, and this one's fate must
        // not tell otherwise.
        let forwarded = matches!(delivery.origin, Origin::Forwarded { .. });
        delivery.progress.unconfirmed |= forwarded && delivery.sequence <= self.delivered;
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
            let Some(entry) = self.entry(desk) else {
                if self.receiver_left(index, desk, moved) {
                    continue;
                }
                break;
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
        if let Some(tally) = self.tally_of(&way, desk) {
            Tally::add(&tally.tried);
        }
        let delivery = &mut self.letters[index];
        let left = delivery.deadline.saturating_duration_since(now);
        let parcel = Parcel {
            receiver: Arc::clone(&self.receiver),
            stream: self.stream,
            sequence: delivery.sequence,
            after,
            remaining: left - HOP_MARGIN.min(left / 8),
            hops: match delivery.progress.unconfirmed {
                true => delivery.hops.max(Parcel::LAST_HOPS),
                false => delivery.hops,
            },
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

    /// The tally of the way that letters take now: looked up when the way changes, not for each.
    fn tally_of(&mut self, way: &Location, desk: &mut Desk) -> Option<&Tally> {
        if self
            .tally
            .as_ref()
            .is_none_or(|(counted, _)| counted != way)
        {
            self.tally = Some((way.clone(), desk.tallies.of(way)));
        }
        self.tally()
    }

    fn tally(&self) -> Option<&Tally> {
        self.tally.as_ref().map(|(_, tally)| &**tally)
    }

    /// A letter is not under way any more.
    fn back(&mut self) {
        self.under_way -= 1;
        if let Some(tally) = self.tally() {
            Tally::add(&tally.ended);
        }
    }

    /// The letter that the one at `index` comes after: what it was told, unless that failed here,
    /// or the one before it here, whichever is later. What it was told may not have come yet. Ends,
    /// because every letter comes after an earlier one ([`Core::handle_arrival`] sees to it).
    ///
    /// [`Core::handle_arrival`]: super::Core::handle_arrival
    fn after(&self, index: usize) -> u64 {
        let mut told = self.letters[index].after;
        while let Some((_, before)) = self.skipped.iter().find(|(failed, _)| *failed == told) {
            told = *before;
        }
        let before = index
            .checked_sub(1)
            .map_or(0, |before| self.letters[before].sequence);
        told.max(before)
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

    /// The receiver's life has ended. Says whether the letter has left this lane.
    fn receiver_left(&mut self, index: usize, desk: &mut Desk, moved: &mut Vec<Moved>) -> bool {
        let progress = &self.letters[index].progress;
        // Whoever handed the letter over decides about a successor: only the sender knows whether
        // another copy may have been delivered.
        let may_move =
            matches!(self.letters[index].origin, Origin::Local { .. }) && !progress.unconfirmed;
        let successor = desk.directory.lookup(&self.receiver);
        let successor = successor.filter(|entry| life_of(entry) != self.stream.receiver);
        match successor.filter(|_| may_move) {
            // Those before it may have to go there too, and first.
            Some(_) if index > 0 => false,
            Some(entry) => {
                if let Some(mut delivery) = self.letters.pop_front() {
                    desk.held -= delivery.letter.len();
                    delivery.progress.tried.clear();
                    moved.push(Moved {
                        to: entry,
                        delivery,
                    });
                }
                true
            }
            None => {
                self.fail(index, FailureReason::NoSuchAgent, desk);
                true
            }
        }
    }

    /// There is room again, at the receiver or on the way to it.
    pub(crate) fn resume(&mut self, now: Instant, desk: &mut Desk, moved: &mut Vec<Moved>) {
        self.paused_until = None;
        self.pauses = 0;
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
                self.back();
            }
            let delivery = &self.letters[0];
            let reason = match delivery.reason_at_deadline() {
                FailureReason::TimedOut => FailureReason::Unreachable,
                reason => reason,
            };
            self.fail(0, reason, desk);
        }
    }

    /// Gives a letter up. If it may have been delivered, that is what its sender has to know.
    fn fail(&mut self, index: usize, reason: FailureReason, desk: &mut Desk) {
        let delivery = &mut self.letters[index];
        let reason = match delivery.progress.unconfirmed {
            true => FailureReason::Unconfirmed,
            false => reason,
        };
        let attempts = std::mem::take(&mut delivery.progress.attempts);
        let sender = match delivery.origin {
            Origin::Local { .. } => Some(Author::Ours(self.stream.sender)),
            Origin::OldPeer { from } => Some(Author::OldPeer { from }),
            Origin::Forwarded { .. } | Origin::Nobody => None,
        };
        if let Some(sender) = sender {
            let detail = attempts.last().map(ToString::to_string).unwrap_or_default();
            desk.undelivered.push_back(Undelivered {
                sender,
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
        desk.held -= delivery.letter.len();
        if !matches!(outcome, Outcome::Failed { .. }) {
            self.delivered = self.delivered.max(delivery.sequence);
        }
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
        if self.letters.len() * 2 <= desk.config.lane
            && let Some(back) = self.waiting.take()
        {
            desk.credit(self.stream, Arc::clone(&self.receiver), back);
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
