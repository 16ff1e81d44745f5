//! What custodians do about predecessors: a letter waits for one that is in the lane, and is handed
//! back when one does not arrive. Copies of held letters, and notes about predecessors, come here.

use std::time::{Duration, Instant};

use fipa_transport::Incarnation;

use super::super::desk::{Desk, Settlement, Upstream};
use super::super::rules::{self, Hold};
use super::super::work;
use super::Lane;
use super::delivery::{Holding, State};

/// How long a predecessor that is not here may take to arrive. Longer than two round trips of
/// most networks; where it is not, a letter travels twice, and nothing is lost.
pub(super) const PREDECESSOR_PATIENCE: Duration = Duration::from_millis(50);
/// Letters that left a lane are remembered, at most this many.
const MAX_LEFT: usize = 64;

impl Lane {
    /// A copy of a letter that may be here already. Returns what it came with when it is not.
    pub(crate) fn adopt(
        &mut self,
        now: Instant,
        (sequence, after): (u64, u64),
        upstream: Upstream,
        desk: &mut Desk,
    ) -> Result<(), Upstream> {
        let Some(index) = self.index(sequence) else {
            return Err(upstream);
        };
        let delivery = &mut self.letters[index];
        delivery.custody_taken(desk);
        delivery.add_upstream(upstream);
        self.lower_predecessor(index, after, desk);
        self.pump(now, desk);
        Ok(())
    }

    /// A note says that this letter has a lower predecessor. Believed from a service that handed
    /// the letter over.
    pub(crate) fn predecessor_told(
        &mut self,
        now: Instant,
        from: Incarnation,
        (sequence, after): (u64, u64),
        desk: &mut Desk,
    ) {
        if let Some(index) = self.index(sequence)
            && self.letters[index].came_from(from)
        {
            self.lower_predecessor(index, after, desk);
            self.pump(now, desk);
        }
    }

    fn lower_predecessor(&mut self, index: usize, after: u64, desk: &mut Desk) {
        let stream = self.stream_of(&self.letters[index]);
        let delivery = &mut self.letters[index];
        let lower = rules::lower(delivery.after, after);
        if lower == delivery.after {
            return;
        }
        delivery.after = lower;
        match &delivery.progress.state {
            State::Waiting => {
                delivery.progress.hold = None;
                self.paused_until = self.paused_until.filter(|_| !self.paused_for_lower);
            }
            State::UnderWay { location, .. } | State::Custody { location, .. } => {
                let (sequence, location) = (delivery.sequence, location.clone());
                let receiver = self.receiver.clone();
                desk.predecessor(stream, receiver, (sequence, lower), location);
            }
        }
    }

    /// Whether a letter waits for another one, or for its predecessor to arrive.
    pub(super) fn is_held_back(&self, index: usize) -> bool {
        if !self.is_custody() {
            return false;
        }
        let delivery = &self.letters[index];
        if matches!(delivery.progress.hold, Some(Holding::Until(_))) {
            return true;
        }
        let Some(predecessor) = self.index(delivery.after) else {
            return false;
        };
        match self.letters[predecessor].progress.state.handed_over() {
            None => true,
            // What leaves on the same way arrives behind it, unless it came back from there already.
            Some((attempt, _)) => delivery.progress.hold == Some(Holding::ForPredecessor(attempt)),
        }
    }

    /// The letter came back because its predecessor was not taken, or was handed back by the next
    /// custodian for that reason.
    pub(super) fn hold(&mut self, now: Instant, index: usize, patience: Duration, desk: &mut Desk) {
        let delivery = &self.letters[index];
        let after = delivery.after;
        work::steps(self.left.len());
        let left = self.left.iter().rev().find(|(other, _)| *other == after);
        let since = left.map_or(delivery.since, |(_, at)| *at);
        let missing_for = now.saturating_duration_since(since);
        let here = self.index(after).is_some();
        match rules::hold(here, missing_for, patience) {
            Hold::ForPredecessor => {
                let predecessor = self.index(after).map(|at| &self.letters[at]);
                let attempt = predecessor.and_then(|it| it.progress.state.handed_over());
                let hold = attempt.map(|(attempt, _)| Holding::ForPredecessor(attempt));
                self.letters[index].progress.hold = hold;
            }
            Hold::For(rest) => {
                let until = now + rest;
                self.holds = true;
                self.letters[index].progress.hold = Some(Holding::Until(until));
                self.due_at(until);
            }
            Hold::Return => self.return_letter(now, index, desk),
        }
    }

    /// Hands a letter back to the services that handed it over.
    pub(super) fn return_letter(&mut self, now: Instant, index: usize, desk: &mut Desk) {
        let uncertain = self.letters[index].progress.uncertain;
        self.settle(now, index, Settlement::Returned { uncertain }, desk);
    }

    /// A letter came: those that wait for it to arrive wait for it in the lane now.
    pub(super) fn predecessor_came(&mut self, sequence: u64) {
        if !self.holds {
            return;
        }
        self.holds = false;
        work::steps(self.letters.len());
        for delivery in &mut self.letters {
            if delivery.after == sequence {
                delivery.progress.hold = None;
            }
            self.holds |= matches!(delivery.progress.hold, Some(Holding::Until(_)));
        }
    }

    /// A letter left the lane without being delivered.
    pub(super) fn predecessor_failed(&mut self, now: Instant, sequence: u64) {
        if self.left.len() >= MAX_LEFT {
            self.left.pop_front();
        }
        self.left.push_back((sequence, now));
    }
}
