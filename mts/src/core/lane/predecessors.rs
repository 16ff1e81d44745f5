//! Predecessors at custodians: a letter waits for a predecessor that is in the lane, and is
//! returned when a predecessor does not arrive. This module also handles copies of held letters,
//! and notes about predecessors.
//!
//! It also has the previous hop's checks: that service periodically asks a custodian whether it has
//! the letter. A custodian without the letter has lost it, even if its report was lost as well.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa_transport::{Answer, Hop, TransportError, TransportErrorKind};

use super::super::label::{HandedOver, Label, PredecessorNote};
use super::super::lane_table::LaneTable;
use super::super::origin::{Settlement, Upstream};
use super::super::rules::{self, AttemptEnd, Cause, HoldDecision};
use super::super::work;
use super::Lane;
use super::open_letter::{Holding, OpenLetter, State};
use super::pause::PauseEnd;
use super::turns::Pace;

/// Minimum and maximum time for a missing predecessor to arrive: two round trips to the service
/// that handed the letter over. If the predecessor takes longer, the letter travels twice, and
/// nothing is lost.
const LEAST_TIMEOUT: Duration = Duration::from_millis(50);
const MOST_TIMEOUT: Duration = Duration::from_secs(1);
/// Time in custody after which the custodian is asked whether it has the letter, and the pause
/// until it is asked again. The custodian of a receiver with a full queue is asked after the shorter time.
pub(super) const ASK_CUSTODIAN_AFTER: Duration = Duration::from_secs(1);
const ASK_CUSTODIAN_AGAIN: Duration = Duration::from_secs(2);
/// The pause when the custodian did not have another letter of this lane.
const ASK_CUSTODIAN_ON: Duration = Duration::from_millis(10);
/// Maximum number of letters of one lane that are asked about at once.
const ASKED_AT_ONCE: usize = 16;
/// Maximum number of remembered letters that left a lane.
const MAX_LEFT: usize = 64;

impl Lane {
    /// Handles a copy of a letter that may be in the lane already; returns `upstream` if it is not.
    pub(crate) fn adopt(
        &mut self,
        now: Instant,
        label: &Label,
        upstream: Upstream,
        table: &mut LaneTable,
    ) -> Result<(), Upstream> {
        let Some(index) = self.index(label.sequence) else {
            return Err(upstream);
        };
        let open_letter = &mut self.letters[index];
        open_letter.custody_taken(table);
        open_letter.add_upstream(upstream);
        self.lower_predecessor(index, label.after, table);
        self.dispatch_all(now, table);
        Ok(())
    }

    /// Handles a note with the current predecessor of this letter, which also asks whether the
    /// letter of this hand-over is here. Accepted only from the service that handed it over.
    /// Returns the answer, or `None` if the letter is not here.
    pub(crate) fn handle_predecessor_note(
        &mut self,
        now: Instant,
        from: &Hop,
        note: PredecessorNote,
        table: &mut LaneTable,
    ) -> Option<Answer> {
        let index = self.index(note.sequence);
        let index = index.filter(|index| self.letters[*index].came_from(from, note.transfer))?;
        self.lower_predecessor(index, note.after, table);
        self.dispatch_all(now, table);
        Some(match self.busy {
            true => Answer::Busy,
            false => Answer::Accepted,
        })
    }

    /// Maximum time for the predecessor of the letter at `index` to arrive.
    pub(super) fn predecessor_timeout(&self, index: usize, table: &LaneTable) -> Duration {
        let upstreams = self.letters[index].upstreams();
        let slowest = upstreams.filter_map(|it| table.round_trip(it)).max();
        (slowest.unwrap_or_default() * 2).clamp(LEAST_TIMEOUT, MOST_TIMEOUT)
    }

    /// Schedules the question to custodians for this time at the latest.
    pub(super) fn ask_custodian_at(&mut self, at: Instant) {
        if self.ask_custodian.is_none_or(|due| at < due) {
            self.ask_custodian = Some(at);
            self.due_at(at);
        }
    }

    /// Asks the custodians of the letters that are longest in custody whether they have them, and
    /// sends them the current predecessors with that. Checks the directory's data about them, too.
    pub(super) fn ask_custodians(&mut self, now: Instant, table: &mut LaneTable) {
        if self.ask_custodian.is_none_or(|due| due > now) {
            return;
        }
        self.ask_custodian = None;
        let mut asked = 0;
        let mut next: Option<Instant> = None;
        for index in 0..self.letters.len() {
            let open_letter = &self.letters[index];
            let State::Custody {
                attempt,
                location,
                since,
            } = &open_letter.progress.state
            else {
                continue;
            };
            let due = *since + ASK_CUSTODIAN_AFTER;
            if due > now {
                next = Some(next.map_or(due, |next| next.min(due)));
                continue;
            }
            if asked >= ASKED_AT_ONCE {
                break;
            }
            asked += 1;
            let (attempt, location) = (*attempt, location.clone());
            let stream = self.stream_of(open_letter);
            let after = self.after(index);
            let note = PredecessorNote {
                sequence: open_letter.sequence,
                after,
                transfer: attempt.0,
            };
            table.predecessor(stream, self.receiver.clone(), note, location);
            let open_letter = &mut self.letters[index];
            open_letter.after = open_letter.after.min(after);
        }
        if asked > 0 {
            next = Some(now + ASK_CUSTODIAN_AGAIN);
            self.check_next_hops(now, table);
        }
        if let Some(next) = next {
            self.ask_custodian_at(next);
        }
    }

    /// Handles the answer of a custodian that it does not have the letter of this hand-over.
    pub(crate) fn custodian_denied(
        &mut self,
        now: Instant,
        letter: HandedOver,
        table: &mut LaneTable,
    ) {
        if let Some(index) = self.in_custody(letter) {
            let text = "the gateway that had the letter in custody does not have it";
            self.custodian_lost(now, index, text, table);
            // It may have lost others, too.
            self.ask_custodian_at(now + ASK_CUSTODIAN_ON);
            self.dispatch_all(now, table);
        }
    }

    /// Handles the answer of a custodian that it has the letter of this hand-over, and that the
    /// receiver's queue is full.
    pub(crate) fn custodian_busy(&mut self, now: Instant, letter: HandedOver) {
        if self.in_custody(letter).is_some() {
            self.was_full(now);
            self.ask_custodian_at(now + ASK_CUSTODIAN_AFTER);
        }
    }

    /// The letter of this registration, sequence and hand-over, if its custodian has it.
    fn in_custody(&self, letter: HandedOver) -> Option<usize> {
        let index = self.index(letter.sequence)?;
        let open_letter = &self.letters[index];
        let is_meant = open_letter.registration == letter.registration
            && matches!(open_letter.progress.state, State::Custody { attempt, .. } if attempt.0 == letter.transfer);
        is_meant.then_some(index)
    }

    /// Handles the loss of the custodian, or of the letter at the custodian.
    pub(super) fn custodian_lost(
        &mut self,
        now: Instant,
        index: usize,
        text: &'static str,
        table: &mut LaneTable,
    ) {
        let open_letter = &mut self.letters[index];
        if let State::Custody { location, .. } = &open_letter.progress.state {
            let location = location.clone();
            open_letter.ended(AttemptEnd::CustodianLost);
            let error = TransportError::new(TransportErrorKind::Broken, text);
            self.came_back(now, index, &location, (error, Cause::CustodianLost), table);
        }
    }

    fn lower_predecessor(&mut self, index: usize, after: u64, table: &mut LaneTable) {
        let stream = self.stream_of(&self.letters[index]);
        let open_letter = &mut self.letters[index];
        let lower = rules::lower(open_letter.after, after);
        if lower == open_letter.after {
            return;
        }
        open_letter.after = lower;
        match &open_letter.progress.state {
            State::Waiting(_) | State::Ended => {
                open_letter.progress.hold = None;
                let sequence = open_letter.sequence;
                self.end_pause(PauseEnd::LowerPredecessor(sequence));
            }
            State::UnderWay { location, .. } | State::Custody { location, .. } => {
                let (sequence, location) = (open_letter.sequence, location.clone());
                let transfer = open_letter.progress.state.handed_over();
                let transfer = transfer.map_or(0, |(attempt, _)| attempt.0);
                let receiver = self.receiver.clone();
                let note = PredecessorNote {
                    sequence,
                    after: lower,
                    transfer,
                };
                table.predecessor(stream, receiver, note, location);
            }
        }
    }

    /// Whether a letter waits for another one, or for its predecessor to arrive.
    pub(super) fn is_held_back(&self, index: usize) -> bool {
        if !self.is_custody() {
            return false;
        }
        let open_letter = &self.letters[index];
        if matches!(open_letter.progress.hold, Some(Holding::Until(_))) {
            return true;
        }
        let Some(predecessor) = self.index(open_letter.after) else {
            return false;
        };
        match self.letters[predecessor].progress.state.handed_over() {
            None => true,
            // A letter on the same route arrives behind it, unless it already came back from there.
            Some((attempt, _)) => {
                open_letter.progress.hold == Some(Holding::ForPredecessor(attempt))
            }
        }
    }

    /// Holds a letter that came back because its predecessor was not taken, or that the next
    /// custodian returned for that reason.
    pub(super) fn hold(
        &mut self,
        now: Instant,
        index: usize,
        timeout: Duration,
        table: &mut LaneTable,
    ) {
        let open_letter = &self.letters[index];
        let after = open_letter.after;
        let since = self.past_letters.since(after).unwrap_or(open_letter.since);
        let missing_for = now.saturating_duration_since(since);
        let holds_predecessor = self.index(after).is_some();
        match rules::hold(holds_predecessor, missing_for, timeout) {
            HoldDecision::ForPredecessor => {
                let predecessor = self.index(after).map(|at| &self.letters[at]);
                let attempt = predecessor.and_then(|it| it.progress.state.handed_over());
                let hold = attempt.map(|(attempt, _)| Holding::ForPredecessor(attempt));
                self.letters[index].progress.hold = hold;
            }
            HoldDecision::For(rest) => {
                let until = now + rest;
                self.has_held_letters = true;
                self.letters[index].progress.hold = Some(Holding::Until(until));
                self.due_at(until);
            }
            HoldDecision::Return => self.return_letter(now, index, table),
        }
    }

    /// Returns a letter to the services that handed it over.
    pub(super) fn return_letter(&mut self, now: Instant, index: usize, table: &mut LaneTable) {
        let open_letter = &self.letters[index];
        let (sequence, uncertain) = (open_letter.sequence, open_letter.progress.uncertain);
        self.settle(now, index, Settlement::Returned { uncertain }, table);
        // The letter behind it cannot be taken before it. With a wait of its own, a lane would return
        // one letter for each wait.
        if let Some(next) = self.letters.get_mut(index)
            && next.is_waiting()
            && next.after >= sequence
        {
            next.progress.hold = Some(Holding::Until(now));
            self.has_held_letters = true;
            self.due_at(now);
        }
    }

    /// Lets letters that wait for the arrival of this one wait for it in the lane.
    pub(super) fn predecessor_came(&mut self, sequence: u64) {
        if !self.has_held_letters {
            return;
        }
        self.has_held_letters = false;
        work::steps(self.letters.len());
        for open_letter in &mut self.letters {
            if open_letter.after == sequence {
                open_letter.progress.hold = None;
            }
            self.has_held_letters |= matches!(open_letter.progress.hold, Some(Holding::Until(_)));
        }
    }
}

/// Letters that left a lane without being delivered, or after repetitions, and may come again.
#[derive(Debug, Default)]
pub(super) struct PastLetters {
    /// Sequences, and paces as they were when the letters left.
    latest: VecDeque<(u64, Pace)>,
    /// The highest sequence, and the slowest pace, of those that left earlier.
    earlier: Option<(u64, Pace)>,
    /// The highest sequence of all.
    highest: u64,
}

impl PastLetters {
    pub(super) fn is_empty(&self) -> bool {
        self.latest.is_empty()
    }

    /// Records a letter that leaves. The hand-over that has delivered it did not come back, and counts, too.
    pub(super) fn push(&mut self, now: Instant, open_letter: &OpenLetter, delivered: bool) {
        if self.latest.len() >= MAX_LEFT
            && let Some((sequence, pace)) = self.latest.pop_front()
        {
            self.earlier = Some(match self.earlier {
                Some((highest, slowest)) => (highest.max(sequence), slowest.slower(pace)),
                None => (sequence, pace),
            });
        }
        let mut pace = open_letter.progress.hand_overs.pace().leaked(now);
        if delivered {
            pace.count(now, open_letter.letter.len());
        }
        self.latest.push_back((open_letter.sequence, pace));
        self.highest = self.highest.max(open_letter.sequence);
    }

    /// The time at which this letter left, if it is known.
    fn since(&self, sequence: u64) -> Option<Instant> {
        self.position(sequence)
            .and_then(|position| self.latest.get(position))
            .map(|(_, pace)| pace.at())
    }

    /// Returns the pace of a letter that comes again. One that is no longer remembered has the slowest pace
    /// of those.
    pub(super) fn take(&mut self, sequence: u64) -> Option<Pace> {
        let latest = self.position(sequence);
        if let Some((_, pace)) = latest.and_then(|position| self.latest.remove(position)) {
            return Some(pace);
        }
        let earlier = self.earlier.filter(|(highest, _)| sequence <= *highest);
        earlier.map(|(_, pace)| pace)
    }

    fn position(&self, sequence: u64) -> Option<usize> {
        if sequence > self.highest {
            return None;
        }
        work::steps(self.latest.len());
        self.latest
            .iter()
            .rposition(|(other, _)| *other == sequence)
    }
}
