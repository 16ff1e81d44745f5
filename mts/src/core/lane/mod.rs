//! A lane: open letters in order, and the state of each.
//!
//! The sender's process has one lane for each pair of a sender and the *name* of a receiver, so
//! that letters for a new registration wait for those of the old one. A custodian has one lane for
//! each stream. The module [`rules`] states the rules; the lane applies them.
//!
//! Letters are dispatched in order and only on one route at a time. When a letter comes back, the
//! lane waits until all letters in transit have ended, and continues with the earliest waiting
//! letter.
//!
//! This module dispatches letters; [`answers`] handles answers and reports, [`clock`] timeouts,
//! [`predecessors`] letters that wait at custodians, [`open_letter`] the state of one letter, [`turns`] the times
//! at which it may be dispatched, [`pause`] letters that came back, [`failed_routes`] the attempts that are
//! reported for letters that were never dispatched, [`trust`] withdrawn certificates.
//!
//! [`rules`]: super::rules

mod answers;
mod clock;
mod failed_routes;
mod open_letter;
mod pause;
mod predecessors;

mod trust;
mod turns;

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_sds::{Entry, Reach};
use fipa_transport::{
    Attempt, Body, FailureReason, Incarnation, Location, Outcome, Parcel, Realm, Signature, Stream,
    TransportError, TransportErrorKind,
};

pub(crate) use self::open_letter::OpenLetter;
use self::open_letter::State;
use self::pause::Pause;
pub(crate) use self::pause::PauseEnd;
use self::predecessors::PastLetters;
use super::ids::{LaneId, LaneKey, registration_of};
use super::label::PredecessorNote;
use super::lane_table::{LaneTable, Purpose};
use super::origin::{Origin, Settlement};
use super::rules;
use super::tally::Tally;
use super::undelivered::{FailureTarget, Undelivered};
use super::work;

/// A lane from which a letter has left within this time moves. It holds back this many times the letters of a lane
/// that does not.
const MOVES_WITHIN: Duration = Duration::from_secs(1);
const HELD_BACK: usize = 4;
/// A lane of legacy peers' letters holds this many times the letters of another one. Its length bounds the time of
/// one visit.
const OF_LEGACY_PEERS: usize = 16;
/// Number of consecutive attempts without room that count as a failure of the route.
const CONGESTED_TRIES: u32 = 25;
/// Minimum expected throughput, which extends the timeout of large letters, and limits repetitions of their content.
const SLOWEST_BYTES_PER_SECOND: u64 = 1 << 20;
/// Subtracted from the remaining time at every hop, so that services further down the route time
/// out first and can still report the reason.
const HOP_MARGIN: Duration = Duration::from_millis(100);
/// Time for which a letter waits for the new registration of a receiver that has moved.
const MOVING_TIMEOUT: Duration = Duration::from_secs(2);
/// Time for which a letter that an attempt may have delivered waits for its receiver to return to the directory.
const ABSENT_TIMEOUT: Duration = Duration::from_secs(1);
/// Time for which letters that were handed over for an ended registration are waited for.
const ENDED_TIMEOUT: Duration = Duration::from_secs(2);
/// Time for which a letter that is too large for the receiver's current kinds of transport waits
/// for another kind.
const KIND_TIMEOUT: Duration = Duration::from_secs(2);

/// Bytes that a lane with letters counts as, in addition to the letters, among the letters in custody.
/// Its state takes about as much memory, and peers can invent senders, each with a lane.
const LANE_BYTES: usize = 2560;
/// Minimum number of bytes that a letter counts as there. Its state, its stamp and the header of its parcel take
/// about as much memory, and peers can send letters of 71 bytes.
pub(super) const LETTER_BYTES: usize = 1536;
/// Maximum number of letters that one visit of a lane ends or answers for because of a timeout, or because their
/// receiver has left. The next visit follows at once.
const ENDED_AT_ONCE: usize = 64;

#[derive(Debug)]
pub(crate) struct Lane {
    id: LaneId,
    key: LaneKey,
    sender: Incarnation,
    receiver: Arc<str>,
    /// The location that the receiver stated itself, if it is not in the directory.
    stated: Option<Arc<Entry>>,
    /// In boxes, because letters enter and leave in the middle.
    letters: VecDeque<Box<OpenLetter>>,
    /// Number of letters that were pushed since the lane was empty.
    pushed: u64,
    bytes: usize,
    under_way: usize,
    /// The route of the letters in transit.
    route: Option<Location>,
    /// Counters of the current or last route.
    tally: Option<(Location, Arc<Tally>)>,
    /// The latest error of each route that failed since the lane was empty and has not worked
    /// since. Reported for letters without an attempt of their own.
    failed: Vec<Attempt>,
    /// Whether a letter came back: nothing is dispatched until all letters in transit have ended.
    recovering: bool,
    /// Whether the service ends, and returns the letters that are in its custody.
    returning: bool,
    /// The refresh of the directory that the letters wait for.
    awaited: Option<u64>,
    /// Whether the directory has just been refreshed, so that an unknown receiver is final.
    is_fresh: bool,
    pause: Option<Pause>,
    /// Number of consecutive pauses, each longer than the one before, since a letter was delivered.
    pauses: u32,
    /// Whether a letter was settled since a credit last ended a pause.
    has_settled: bool,
    /// Time at which a letter left the lane last.
    settled: Option<Instant>,
    /// Whether the receiver's queue was full at its last answer.
    busy: bool,
    /// Time at which it was last full.
    was_busy: Option<Instant>,
    /// The service that gave that answer, and whether it is on this host: only its credit counts.
    busy_at: Option<(Incarnation, bool)>,
    /// A registration that has moved, and the end of the wait for its successor.
    moving: Option<(Incarnation, Instant)>,
    /// A registration that the directory lacks and that may return, and the end of the wait for it.
    absent: Option<(Incarnation, Instant)>,
    /// Whether the last letter was dispatched for a receiver on another host.
    is_abroad: bool,
    /// A registration that left the directory, and the time of the last event of letters for it.
    ended: Option<(Incarnation, Instant)>,
    /// Time at which custodians are asked whether they have letters of this lane.
    ask_custodian: Option<Instant>,
    /// Whether a letter may wait for its predecessor to arrive.
    has_held_letters: bool,
    past_letters: PastLetters,
    /// Earliest time at which a timer of this lane is due.
    due: Option<Instant>,
    /// Time at which the core's timer visits this lane next.
    pub(crate) scheduled: Option<Instant>,
    /// Number of consecutive attempts that found no room on the route.
    congested: u32,
    /// Time of the last activity.
    pub(crate) active: Instant,
    /// The service that was told that the lane is full, and waits for a credit.
    waiting: Option<Location>,
}

impl Lane {
    pub(crate) fn new(now: Instant, id: LaneId, key: LaneKey, receiver: Arc<str>) -> Self {
        let sender = match &key {
            LaneKey::Name(sender, _) => *sender,
            LaneKey::Service(stream) | LaneKey::Custody(stream) => stream.sender,
        };
        Self {
            id,
            key,
            sender,
            receiver,
            stated: None,
            letters: VecDeque::new(),
            pushed: 0,
            bytes: 0,
            under_way: 0,
            route: None,
            tally: None,
            failed: Vec::new(),
            recovering: false,
            returning: false,
            awaited: None,
            is_fresh: false,
            pause: None,
            pauses: 0,
            has_settled: true,
            settled: None,
            busy: false,
            was_busy: None,
            busy_at: None,
            moving: None,
            absent: None,
            is_abroad: false,
            ended: None,
            ask_custodian: None,
            has_held_letters: false,
            past_letters: PastLetters::default(),
            due: None,
            scheduled: None,
            congested: 0,
            active: now,
            waiting: None,
        }
    }

    pub(crate) fn key(&self) -> &LaneKey {
        &self.key
    }

    /// The agent or service that sends in this lane.
    pub(crate) fn sender(&self) -> Incarnation {
        self.sender
    }

    pub(crate) fn receiver(&self) -> Arc<str> {
        Arc::clone(&self.receiver)
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.letters.is_empty()
    }

    /// Whether nothing is left to do.
    pub(crate) fn is_idle(&self) -> bool {
        self.letters.is_empty() && self.waiting.is_none()
    }

    /// Whether later letters depend on the state of this lane.
    pub(crate) fn remembers(&self) -> bool {
        !self.past_letters.is_empty()
    }

    fn is_custody(&self) -> bool {
        matches!(self.key, LaneKey::Custody(_))
    }

    pub(crate) fn stream_of(&self, open_letter: &OpenLetter) -> Stream {
        let realm = match self.key {
            LaneKey::Custody(stream) => stream.realm,
            LaneKey::Name(..) | LaneKey::Service(_) => Realm::UNPROVED,
        };
        Stream {
            realm,
            ..Stream::between(self.sender, open_letter.registration)
        }
    }

    /// The current route of a letter in transit.
    pub(crate) fn route_of(&self, sequence: u64) -> Option<&Location> {
        match &self.letters[self.index(sequence)?].progress.state {
            State::UnderWay { location, .. } => Some(location),
            _ => None,
        }
    }

    /// Whether there is room for another letter of this process with this many bytes.
    pub(crate) fn has_room(&self, len: usize, table: &LaneTable) -> bool {
        let config = &table.config;
        let fits = self.bytes.saturating_add(len) <= config.lane_bytes;
        self.letters.len() < config.lane && (fits || self.letters.is_empty())
    }

    /// Whether there is room for another letter of a legacy peer with this many bytes. Such a peer cannot be held
    /// back, and a letter that is refused is lost for it, so bytes are the limit.
    pub(crate) fn has_room_for_legacy(&self, len: usize, table: &LaneTable) -> bool {
        let config = &table.config;
        let fits = self.bytes.saturating_add(len) <= config.lane_bytes;
        let is_long = self.letters.len() >= config.lane.saturating_mul(OF_LEGACY_PEERS);
        !is_long && (fits || self.letters.is_empty()) && self.fits_into_custody(len, table)
    }

    /// Whether another letter of this process with this many bytes can wait in the lane. While letters leave the
    /// lane, more of them wait than otherwise.
    pub(crate) fn has_room_to_wait(&self, now: Instant, len: usize, table: &LaneTable) -> bool {
        let config = &table.config;
        self.has_room(len, table)
            || (self.letters.len() < config.lane.saturating_mul(HELD_BACK)
                && self.bytes.saturating_add(len) <= config.lane_bytes
                && self.settled.is_some_and(|at| now < at + MOVES_WITHIN))
    }

    /// Whether the letters in custody leave room for another one with this many bytes in this lane.
    pub(crate) fn fits_into_custody(&self, len: usize, table: &LaneTable) -> bool {
        table
            .custody
            .has_room(&self.receiver, self.counted(len), &table.config)
    }

    /// Bytes that count in custody when a letter of this many bytes comes or goes: its own and, when it is the only
    /// letter, those of the lane.
    fn counted(&self, len: usize) -> usize {
        let of_lane = match self.letters.is_empty() {
            true => LANE_BYTES,
            false => 0,
        };
        len.max(LETTER_BYTES).saturating_add(of_lane)
    }

    /// Whether a custodian takes this letter. A letter below a waiting one is taken beyond the
    /// limits, up to twice as much.
    pub(crate) fn takes_into_custody(&self, sequence: u64, len: usize, table: &LaneTable) -> bool {
        let config = &table.config;
        let held = table.custody.held().saturating_add(len.max(LETTER_BYTES));
        if self.has_room(len, table) && self.fits_into_custody(len, table) {
            return true;
        }
        let highest = self.letters.back().map(|open_letter| open_letter.sequence);
        rules::admits_when_full(highest, sequence)
            && self.letters.len() < 2 * config.lane
            && self.bytes.saturating_add(len) <= config.lane_bytes.saturating_mul(2)
            && held <= config.custody_bytes.saturating_mul(2)
    }

    /// Whether letters wait for a pause to end, and the receiver has such a location.
    pub(crate) fn is_paused_towards(
        &self,
        table: &LaneTable,
        is_meant: impl Fn(&Location) -> bool,
    ) -> bool {
        let first = self.letters.front().filter(|_| self.pause.is_some());
        let entry = first.and_then(|first| self.entry(first.registration, table));
        entry.is_some_and(|entry| entry.locations.iter().any(is_meant))
    }

    /// Latest time of the next visit.
    pub(crate) fn due(&self) -> Option<Instant> {
        self.due
    }

    fn due_at(&mut self, at: Instant) {
        if self.due.is_none_or(|due| at < due) {
            self.due = Some(at);
        }
    }

    /// The entry of this registration of the receiver: from the directory, or as the receiver
    /// stated it. `None` when it has moved.
    fn entry(&self, registration: Incarnation, table: &LaneTable) -> Option<Arc<Entry>> {
        if self.moving.is_some_and(|(moved, _)| moved == registration) {
            return None;
        }
        let known = table.receiver(registration, &self.receiver);
        known.or_else(|| self.stated.clone())
    }

    /// Sets the entry that a receiver outside the directory stated.
    pub(crate) fn set_stated(&mut self, entry: Arc<Entry>) {
        self.stated = Some(entry);
    }

    /// Inserts a letter at its position in the order.
    pub(crate) fn push(&mut self, mut open_letter: Box<OpenLetter>, table: &mut LaneTable) {
        open_letter.position = self.pushed;
        self.pushed += 1;
        let len = open_letter.letter.len();
        let counted = self.counted(len);
        table.custody.hold(&self.receiver, counted, &table.config);
        self.bytes += len;
        self.due_at(open_letter.deadline);
        if let Some(due) = open_letter.custody_due {
            self.due_at(due);
        }
        let sequence = open_letter.sequence;
        if let Some(pace) = self.past_letters.take(sequence) {
            open_letter.came_before(pace);
        }
        let place = self
            .letters
            .partition_point(|other| other.sequence < sequence);
        self.letters.insert(place, open_letter);
        self.predecessor_came(sequence);
    }

    /// Records a service that is held back. It gets a credit when letters have left this lane; while there
    /// are none, letters of other lanes have to leave, and the service tries again after a pause.
    pub(crate) fn wait_for_credit(&mut self, upstream: Location) {
        if !self.letters.is_empty() {
            self.waiting = Some(upstream);
        }
    }

    /// Dispatches all letters that can be dispatched.
    pub(crate) fn dispatch_all(&mut self, now: Instant, table: &mut LaneTable) {
        self.active = now;
        if !self.expire(now, table) {
            return;
        }
        if self.recovering && self.under_way == 0 {
            self.recovering = false;
            self.route = None;
        }
        if !self.recovering && self.awaited.is_none() && !self.is_paused(now) {
            self.pause = None;
            self.dispatch_waiting(now, table);
        }
        self.give_credit(table);
    }

    fn dispatch_waiting(&mut self, now: Instant, table: &mut LaneTable) {
        let (mut index, mut failed) = (0, 0);
        while index < self.letters.len() && self.under_way < table.config.window {
            work::steps(1);
            let registration = self.letters[index].registration;
            // All letters in between have the same registration, or the loop would have ended
            // earlier.
            if !rules::may_dispatch(self.first_registration(), registration) {
                break;
            }
            if !self.is_remembered(index, table) {
                break;
            }
            if !self.letters[index].is_waiting() || self.is_held_back(index) {
                index += 1;
                continue;
            }
            let Some(entry) = self.entry(registration, table) else {
                if !self.is_fresh {
                    self.want_refresh(table);
                    break;
                }
                if !self.receiver_left(now, index, table) {
                    break;
                }
                failed += 1;
                if failed >= ENDED_AT_ONCE {
                    self.want_refresh(table);
                    break;
                }
                continue;
            };
            if trust::is_withdrawn(&entry, table) {
                self.refuse(now, index, &entry, table);
                continue;
            }
            if self.letters[index].progress.uncertain && !entry.incarnation.is_known() {
                // An earlier gateway may have sent it, and a legacy peer would take a copy for a new
                // letter.
                self.fail(now, index, FailureReason::Unconfirmed, table);
                continue;
            }
            if let Some(from) = self.letters[index].begins_after(now) {
                self.due_at(from);
                break;
            }
            match table.choose(now, &entry, &self.letters[index].progress.tried) {
                Some(route) if self.under_way == 0 || self.route.as_ref() == Some(&route) => {
                    let local = entry.reach == Reach::Local;
                    self.dispatch(now, index, (route, local), table);
                    index += 1;
                }
                // A different route than that of earlier letters must wait until those have
                // arrived.
                Some(_) => break,
                None if self.under_way > 0 => break,
                None => {
                    if !self.end_of_round(now, index, &entry, table) {
                        break;
                    }
                }
            }
        }
    }

    /// Whether the receiver still remembers the first open letter after it has taken the letter at this
    /// index. Custodians hold what the sender's process has dispatched.
    fn is_remembered(&self, index: usize, table: &LaneTable) -> bool {
        let (first, letter) = (self.letters.front(), self.letters.get(index));
        let (Some(first), Some(letter)) = (first, letter) else {
            return true;
        };
        self.is_custody()
            || rules::is_remembered(first.position, letter.position, table.config.lane)
    }

    fn first_registration(&self) -> impl Iterator<Item = Incarnation> {
        self.letters
            .front()
            .map(|first| first.registration)
            .into_iter()
    }

    /// Dispatches a letter on this route; `local` is whether its receiver is on this host.
    fn dispatch(
        &mut self,
        now: Instant,
        index: usize,
        (route, local): (Location, bool),
        table: &mut LaneTable,
    ) {
        let after = self.after(index);
        let progress = &mut self.letters[index].progress;
        let State::Waiting(turn) = std::mem::replace(&mut progress.state, State::Ended) else {
            return;
        };
        progress.hand_overs.handed_over(now, turn, after);
        if let Some(tally) = self.tally_of(&route, table) {
            Tally::add(&tally.tried);
        }
        let attempt = table.next_attempt();
        let stream = self.stream_of(&self.letters[index]);
        let open_letter = &mut self.letters[index];
        open_letter.after = after;
        let time_left = open_letter.deadline.saturating_duration_since(now);
        let parcel = Parcel {
            receiver: Arc::clone(&self.receiver),
            stream,
            sequence: open_letter.sequence,
            after,
            transfer: attempt.0,
            remaining: time_left - HOP_MARGIN.min(time_left / 8),
            body: Body::Letter(open_letter.letter.clone()),
        };
        let allowance = transfer_time(open_letter.letter.len());
        let times_out = now + table.config.timeout_at(&route) + allowance;
        let purpose = Purpose::Letter {
            lane: self.id,
            sequence: open_letter.sequence,
        };
        table.dispatch(attempt, purpose, route.clone(), parcel);
        open_letter.handed_to(&route, local);
        open_letter.progress.tried.push(route.clone());
        open_letter.progress.hold = None;
        (self.is_abroad, self.absent) = (!local, None);
        open_letter.progress.state = State::UnderWay {
            attempt,
            location: route.clone(),
            since: now,
            times_out,
            abandoned: false,
        };
        self.due_at(times_out);
        self.under_way += 1;
        self.route = Some(route);
    }

    /// The predecessor with which the letter at `index` is dispatched: at a custodian the one it
    /// came with, at the sender's process the nearest open letter before it.
    fn after(&self, index: usize) -> u64 {
        let open_letter = &self.letters[index];
        if self.is_custody() {
            return open_letter.after;
        }
        // Of all registrations: a letter that waits for a new one must not be passed over either.
        let open = self.letters.iter().take(index);
        rules::predecessor(open.map(|other| other.sequence), open_letter.sequence)
    }

    /// The counters of the current route, looked up only when the route changes.
    fn tally_of(&mut self, route: &Location, table: &mut LaneTable) -> Option<&Tally> {
        if self
            .tally
            .as_ref()
            .is_none_or(|(counted, _)| counted != route)
        {
            self.tally = Some((route.clone(), table.tallies.of(route)));
        }
        self.tally()
    }

    fn tally(&self) -> Option<&Tally> {
        self.tally.as_ref().map(|(_, tally)| &**tally)
    }

    /// Records that a letter is no longer in transit.
    fn end_transit(&mut self) {
        self.under_way -= 1;
        if let Some(tally) = self.tally() {
            Tally::add(&tally.ended);
        }
    }

    /// Handles a letter for which every route was tried. Returns whether it was settled.
    fn end_of_round(
        &mut self,
        now: Instant,
        index: usize,
        entry: &Entry,
        table: &mut LaneTable,
    ) -> bool {
        let open_letter = &mut self.letters[index];
        if open_letter.progress.tried.is_empty() {
            let reason = match entry.is_unsupported() {
                true => {
                    for location in &entry.locations {
                        let error =
                            TransportError::new(TransportErrorKind::Unsupported, location.kind());
                        open_letter.failed_at(location, error);
                    }
                    FailureReason::Unsupported
                }
                false => FailureReason::Unreachable,
            };
            self.fail(now, index, reason, table);
            return true;
        }
        open_letter.progress.tried.clear();
        if let Some(reason) = self.never_fits(now, index, entry.reach, table) {
            self.fail(now, index, reason, table);
            return true;
        }
        // The next round is one of all letters: with a round of its own, each would wait for the end of the one
        // before it.
        work::steps(self.letters.len());
        for other in &mut self.letters {
            if other.is_waiting() {
                other.progress.tried.clear();
            }
        }
        self.pause(now, PauseEnd::Reachable, Duration::ZERO);
        false
    }

    /// The reason why no repetition can succeed, after all routes of the receiver were tried.
    ///
    /// A letter that is too large for all of them waits for a while for a kind of transport that the
    /// directory does not show at present and that may return; later letters wait behind it. Kinds
    /// within a host are excluded, because they do not lead to other hosts. A letter to a legacy peer does
    /// not wait: such a peer announces all its addresses at once.
    fn never_fits(
        &mut self,
        now: Instant,
        index: usize,
        reach: Reach,
        table: &LaneTable,
    ) -> Option<FailureReason> {
        let open_letter = &mut self.letters[index];
        let reason = open_letter.unfit()?;
        let since = *open_letter.progress.unfit_since.get_or_insert(now);
        let attempts = &open_letter.progress.attempts;
        let mut order = table.config.order_for(&self.receiver, reach).iter();
        let is_legacy = |attempt: &Attempt| attempt.location.signature() != Signature::Frames;
        let waits = reason == FailureReason::TooLarge
            && now < since + KIND_TIMEOUT
            && !attempts.iter().all(is_legacy)
            && !order.all(|kind| {
                kind.is_host_local() || attempts.iter().any(|attempt| attempt.via == *kind)
            });
        (!waits).then_some(reason)
    }

    /// Requests a refresh of the directory. The letters of the lane wait for it.
    pub(super) fn want_refresh(&mut self, table: &mut LaneTable) {
        self.awaited = Some(table.want_refresh_for(self.id));
    }

    /// Handles the end of the registration that the letter is for, after a refresh. Returns whether the lane may
    /// continue with the letter at this index: another one, or the same for the new registration.
    fn receiver_left(&mut self, now: Instant, index: usize, table: &mut LaneTable) -> bool {
        let open_letter = &self.letters[index];
        let registration = open_letter.registration;
        if !rules::may_move(open_letter.progress.uncertain) {
            if self.may_return(now, index, table) {
                return false;
            }
            self.fail(now, index, FailureReason::Unconfirmed, table);
            return true;
        }
        if self.is_custody() {
            // Only the sender's process moves letters to another registration.
            match table.departed.contains(now, registration) {
                true => self.settle(now, index, Settlement::Moved, table),
                false => self.fail(now, index, FailureReason::NoSuchAgent, table),
            }
            return true;
        }
        let successor = table.view.named(&self.receiver);
        let successor = successor.map(|entry| registration_of(&entry));
        if let Some(successor) = successor.filter(|successor| *successor != registration) {
            let open_letter = &mut self.letters[index];
            open_letter.registration = successor;
            open_letter.after = 0;
            open_letter.progress.tried.clear();
            self.end_pause(PauseEnd::Registration);
            return true;
        }
        match self.moving {
            Some((moved, until)) if moved == registration && now < until => {
                self.due_at(until);
                false
            }
            _ => {
                self.fail_absent(now, index, table);
                true
            }
        }
    }

    /// Whether a letter that may have arrived waits for its receiver to return to the directory. After a broken
    /// connection, the directory may have less than before: the receiver was known from its letters only, for
    /// example. A registration that has a successor does not return, and neither does one of this host.
    fn may_return(&mut self, now: Instant, index: usize, table: &LaneTable) -> bool {
        let registration = self.letters[index].registration;
        let has_successor = table.view.named(&self.receiver).is_some();
        if !self.is_abroad || has_successor || table.departed.contains(now, registration) {
            return false;
        }
        let until = match self.absent {
            Some((absent, until)) if absent == registration => until,
            _ => now + ABSENT_TIMEOUT,
        };
        self.absent = Some((registration, until));
        self.due_at(until);
        now < until
    }

    /// Abandons all letters, when the sending agent goes away or the service ends. A letter in
    /// transit gets its outcome from the conclusion of its transport, which follows at once. Letters
    /// in custody are returned to the services that handed them over, which try other routes, or
    /// give the outcome.
    pub(crate) fn give_up(&mut self, now: Instant, table: &mut LaneTable) {
        self.recovering = true;
        self.returning = self.is_custody();
        work::steps(self.letters.len());
        let mut index = 0;
        while let Some(open_letter) = self.letters.get_mut(index) {
            if !self.returning {
                open_letter.deadline = now;
            }
            match &mut open_letter.progress.state {
                State::UnderWay { .. } => {
                    open_letter.abandon(table, || {
                        TransportError::new(TransportErrorKind::Closed, "the sender went away")
                    });
                    index += 1;
                }
                State::Custody { .. } if self.returning => {
                    open_letter.ended(rules::AttemptEnd::Unknown);
                    self.return_letter(now, index, table);
                }
                State::Waiting(_) | State::Ended if self.returning => {
                    self.return_letter(now, index, table);
                }
                State::Custody { .. } => {
                    self.fail(now, index, FailureReason::Unconfirmed, table);
                }
                State::Waiting(_) | State::Ended => {
                    let reason = match open_letter.reason_at_deadline(false) {
                        FailureReason::TimedOut => FailureReason::Closed,
                        reason => reason,
                    };
                    self.fail(now, index, reason, table);
                }
            }
        }
    }

    /// Ends a letter as failed, or as unconfirmed if an attempt may have delivered it.
    fn fail(&mut self, now: Instant, index: usize, reason: FailureReason, table: &mut LaneTable) {
        let open_letter = &mut self.letters[index];
        let reason = match open_letter.progress.uncertain {
            true => FailureReason::Unconfirmed,
            false => reason,
        };
        let attempts = std::mem::take(&mut open_letter.progress.attempts);
        let sender = match &open_letter.origin {
            Origin::Local { .. } => Some(FailureTarget::Ours(self.sender)),
            Origin::LegacyPeer { from, failed } => {
                let (from, failed) = (*from, failed.clone());
                failed.map(|failed| FailureTarget::LegacyPeer { from, failed })
            }
            Origin::Forwarded { .. } | Origin::FailureMessage => None,
        };
        if let Some(sender) = sender {
            let detail = attempts.last().map(ToString::to_string).unwrap_or_default();
            table.undelivered.push_back(Undelivered {
                sender,
                receiver: Arc::clone(&self.receiver),
                letter: open_letter.letter.clone(),
                reason,
                detail,
                count: 1,
            });
        }
        let outcome = Outcome::Failed { reason, attempts };
        self.settle(now, index, Settlement::Outcome(outcome), table);
    }

    /// Fails a letter to an agent that the directory no longer lists.
    fn fail_absent(&mut self, now: Instant, index: usize, table: &mut LaneTable) {
        let (reason, attempt) = table.absence(&self.receiver);
        if let Some(Attempt {
            location, error, ..
        }) = attempt
        {
            self.letters[index].failed_at(&location, error);
        }
        self.fail(now, index, reason, table);
    }

    /// Removes a letter from the lane, and reports its end to its origin.
    fn settle(
        &mut self,
        now: Instant,
        index: usize,
        settlement: Settlement,
        table: &mut LaneTable,
    ) {
        let Some(open_letter) = self.letters.remove(index) else {
            return;
        };
        let len = open_letter.letter.len();
        table.custody.release(&self.receiver, self.counted(len));
        self.bytes -= len;
        let is_last = self.letters.is_empty();
        if is_last {
            self.pushed = 0;
            self.route = None;
            self.ended = None;
            self.moving = None;
            self.absent = None;
            self.failed.clear();
        }
        let delivered = matches!(
            settlement,
            Settlement::Outcome(Outcome::Delivered { .. } | Outcome::Sent { .. })
        );
        self.has_settled = true;
        self.settled = Some(now);
        if delivered || is_last {
            self.busy = false;
            self.pauses = 0;
            self.congested = 0;
        }
        match is_last {
            true => self.pause = None,
            false => self.end_pause_behind(open_letter.sequence),
        }
        match self.is_custody() {
            // A copy of a letter that was repeated may come although it was delivered.
            true if !delivered || open_letter.progress.hand_overs.pace().has_repeated() => {
                self.past_letters.push(now, &open_letter, delivered);
            }
            false if !delivered => self.send_predecessor(index, table),
            _ => {}
        }
        let stream = self.stream_of(&open_letter);
        let receiver = Arc::clone(&self.receiver);
        table.settle(now, open_letter, stream, receiver, settlement);
    }

    /// Sends the custodian of the letter at `index` its new predecessor, after the letter before it
    /// failed at the sender's process. A gateway may hold a letter before it answers.
    fn send_predecessor(&mut self, index: usize, table: &mut LaneTable) {
        let Some(open_letter) = self.letters.get(index) else {
            return;
        };
        let (attempt, location) = match &open_letter.progress.state {
            State::Custody {
                attempt, location, ..
            } => (attempt, location),
            State::UnderWay {
                attempt, location, ..
            } if self.is_abroad => (attempt, location),
            _ => return,
        };
        let after = self.after(index);
        if after < open_letter.after {
            let stream = self.stream_of(open_letter);
            let note = PredecessorNote {
                sequence: open_letter.sequence,
                after,
                transfer: attempt.0,
            };
            table.predecessor(stream, Arc::clone(&self.receiver), note, location.clone());
            self.letters[index].after = after;
        }
    }

    fn give_credit(&mut self, table: &mut LaneTable) {
        let config = &table.config;
        if self.letters.len() * 2 <= config.lane
            && self.bytes <= config.lane_bytes / 2
            && let Some(back) = self.waiting.take()
        {
            // Only custodians answer that they are full.
            if let LaneKey::Custody(stream) = &self.key {
                table.credit(*stream, Arc::clone(&self.receiver), back);
            }
        }
    }

    fn index(&self, sequence: u64) -> Option<usize> {
        self.letters
            .binary_search_by_key(&sequence, |open_letter| open_letter.sequence)
            .ok()
    }
}

/// Maximum time that this many bytes are expected to take to leave.
fn transfer_time(len: usize) -> Duration {
    let micros = (len as u64).saturating_mul(1_000_000);
    Duration::from_micros(micros.div_ceil(SLOWEST_BYTES_PER_SECOND))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A queue has room for up to twice its letters. A stamp, the header of a parcel and the allocations take less
    /// than 256 bytes.
    #[test]
    fn the_state_of_a_letter_takes_no_more_memory_than_it_counts_as() {
        let state = size_of::<OpenLetter>();
        assert!(2 * state + 256 <= LETTER_BYTES, "{state} bytes");
        // A queue has room for at least four letters.
        let state = size_of::<Lane>() + 4 * state + 512;
        assert!(state <= LANE_BYTES + LETTER_BYTES, "{state} bytes");
    }
}
