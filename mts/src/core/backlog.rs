//! Letters of legacy peers beyond the share of their receiver. Such a peer cannot be held back, so they wait, in
//! order, until the receiver's lane has room, as far as the share of the address from which they came goes.

use std::collections::{BTreeMap, VecDeque};
use std::net::IpAddr;
use std::ops::Bound;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_transport::{FailureReason, quota_address};

use super::ids::LaneId;
use super::lane::{LETTER_BYTES, OpenLetter};
use super::lanes::LANES_AT_ONCE;
use super::origin::{Origin, Settlement};
use super::undelivered::{FailureTarget, Undelivered};
use super::{Core, CoreConfig, Now, failed_for, work};
use crate::Map;

/// Time between two visits of the lanes with a backlog. Room in its own lane is used at once, and room in the custody
/// at the next visit.
const VISITED_EVERY: Duration = Duration::from_millis(100);
/// Maximum number of letters of one lane that leave the backlog in one call.
const LEAVE_AT_ONCE: usize = 64;

/// The letters that wait for room in their lanes.
#[derive(Debug, Default)]
pub(super) struct Backlog {
    lanes: BTreeMap<LaneId, VecDeque<(IpAddr, Box<OpenLetter>)>>,
    bytes: usize,
    bytes_from: Map<IpAddr, usize>,
    next_visit: Option<Instant>,
    /// The lane that was visited last.
    visited: Option<LaneId>,
}

impl Backlog {
    pub(super) fn is_empty(&self) -> bool {
        self.lanes.is_empty()
    }

    pub(super) fn has_any_of(&self, lane: LaneId) -> bool {
        self.lanes.contains_key(&lane)
    }

    /// Time of the next visit.
    pub(super) fn due(&self) -> Option<Instant> {
        self.next_visit.filter(|_| !self.is_empty())
    }

    /// Adds a letter that came from this address, or returns it if there is no room: all letters have half as many
    /// bytes as the letters in custody may have, and those of one address half of that.
    fn push(
        &mut self,
        now: Instant,
        lane: LaneId,
        (from, letter): (IpAddr, Box<OpenLetter>),
        config: &CoreConfig,
    ) -> Result<(), Box<OpenLetter>> {
        let (from, len) = (quota_address(from), counted(&letter));
        let taken = self.bytes_from.get(&from).copied().unwrap_or_default();
        let most = config.custody_bytes / 2;
        if taken.saturating_add(len) > most / 2 || self.bytes.saturating_add(len) > most {
            return Err(letter);
        }
        if self.is_empty() {
            self.next_visit = Some(now + VISITED_EVERY);
        }
        self.bytes += len;
        *self.bytes_from.entry(from).or_default() += len;
        self.lanes
            .entry(lane)
            .or_default()
            .push_back((from, letter));
        Ok(())
    }

    /// Removes the first letter of a lane if this holds.
    fn pop_if(
        &mut self,
        lane: LaneId,
        goes: impl FnOnce(&OpenLetter) -> bool,
    ) -> Option<Box<OpenLetter>> {
        let letters = self.lanes.get_mut(&lane)?;
        let (from, letter) = letters.pop_front_if(|(_, letter)| goes(letter))?;
        if letters.is_empty() {
            self.lanes.remove(&lane);
        }
        let len = counted(&letter);
        self.bytes -= len;
        if let Some(taken) = self.bytes_from.get_mut(&from) {
            *taken -= len;
            if *taken == 0 {
                self.bytes_from.remove(&from);
            }
        }
        Some(letter)
    }

    /// The lanes to visit, in turn, if their time has come.
    fn visits(&mut self, now: Instant) -> Vec<LaneId> {
        if self.due().is_none_or(|due| now < due) {
            return Vec::new();
        }
        let begin = self.visited.map_or(Bound::Unbounded, Bound::Excluded);
        let later = self.lanes.range((begin, Bound::Unbounded));
        let earlier = self.visited.map(|visited| self.lanes.range(..=visited));
        let lanes = later.chain(earlier.into_iter().flatten());
        let lanes: Vec<LaneId> = lanes.map(|(lane, _)| *lane).take(LANES_AT_ONCE).collect();
        work::steps(lanes.len());
        self.visited = lanes.last().copied();
        self.next_visit = Some(now + VISITED_EVERY);
        lanes
    }

    /// Bytes of the letters.
    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }
}

fn counted(letter: &OpenLetter) -> usize {
    letter.letter.len().max(LETTER_BYTES)
}

impl Core {
    /// Puts a letter of a legacy peer into its lane, or, when the lane is full, into the backlog. Without room there,
    /// the letter fails.
    pub(super) fn put_unframed(
        &mut self,
        now: Now,
        lane: LaneId,
        letter: Box<OpenLetter>,
        from: IpAddr,
    ) {
        if !self.backlog.has_any_of(lane) && self.has_room_for_legacy(lane, &letter) {
            return self.put(now, lane, letter);
        }
        let config = &self.table.config;
        if let Err(letter) = self.backlog.push(now.instant, lane, (from, letter), config) {
            self.fail_unframed(now, lane, letter);
        }
    }

    fn has_room_for_legacy(&self, lane: LaneId, letter: &OpenLetter) -> bool {
        let lane = self.lanes.get(&lane);
        lane.is_some_and(|lane| lane.has_room_for_legacy(letter.letter.len(), &self.table))
    }

    /// Moves letters from the backlog into their lane while it has room, and ends those whose deadlines have passed.
    pub(super) fn relieve(&mut self, now: Now, lane: LaneId) {
        let mut has_more = false;
        for number in 0.. {
            if !self.backlog.has_any_of(lane) {
                break;
            }
            if number == LEAVE_AT_ONCE {
                self.backlog.next_visit = Some(now.instant);
                break;
            }
            work::steps(1);
            let is_late = |letter: &OpenLetter| letter.deadline <= now.instant;
            if let Some(letter) = self.backlog.pop_if(lane, is_late) {
                self.fail_unframed(now, lane, letter);
                continue;
            }
            let state = self.lanes.get(&lane);
            let table = &self.table;
            let has_room = |letter: &OpenLetter| {
                state.is_some_and(|it| it.has_room_for_legacy(letter.letter.len(), table))
            };
            let Some(letter) = self.backlog.pop_if(lane, has_room) else {
                break;
            };
            if let Some(state) = self.lanes.get_mut(&lane) {
                state.push(letter, &mut self.table);
                has_more = true;
            }
        }
        if let Some(state) = self.lanes.get_mut(&lane).filter(|_| has_more) {
            state.dispatch_all(now.instant, &mut self.table);
        }
    }

    /// Visits the lanes with a backlog.
    pub(super) fn visit_backlog(&mut self, now: Now) {
        for lane in self.backlog.visits(now.instant) {
            // Each visit of a lane relieves it.
            self.with_lane(now, lane, |_, _| {});
        }
    }

    /// Fails all letters, because the service ends. Their senders get no message.
    pub(super) fn end_backlog(&mut self, now: Now) {
        while let Some(lane) = self.backlog.lanes.keys().next().copied() {
            while let Some(letter) = self.backlog.pop_if(lane, |_| true) {
                self.settle_unframed(now, lane, letter, FailureReason::Closed);
            }
        }
    }

    fn fail_unframed(&mut self, now: Now, lane: LaneId, letter: Box<OpenLetter>) {
        let reason = FailureReason::QueueFull;
        let origin = match &letter.origin {
            Origin::LegacyPeer { from, failed } => failed.clone().map(|failed| (*from, failed)),
            _ => None,
        };
        let content = letter.letter.clone();
        let Some(receiver) = self.settle_unframed(now, lane, letter, reason) else {
            return;
        };
        if let Some((from, failed)) = origin {
            self.table.undelivered.push_back(Undelivered {
                sender: FailureTarget::LegacyPeer { from, failed },
                receiver,
                letter: content,
                reason,
                detail: String::new(),
                count: 1,
            });
        }
    }

    /// Reports the end of a letter, and returns its receiver.
    fn settle_unframed(
        &mut self,
        now: Now,
        lane: LaneId,
        letter: Box<OpenLetter>,
        reason: FailureReason,
    ) -> Option<Arc<str>> {
        let lane = self.lanes.get(&lane)?;
        let (stream, receiver) = (lane.stream_of(&letter), lane.receiver());
        let ended = Settlement::Outcome(failed_for(reason));
        self.table
            .settle(now.instant, letter, stream, Arc::clone(&receiver), ended);
        Some(receiver)
    }
}
