//! Memory for arriving letters.
//!
//! A peer can announce a large letter and send it slowly, on many connections. Therefore the bytes
//! of all arriving letters have one budget, in which every [quota key](QuotaKey) has a share
//! ([`ByteBudget`]). The memory of a letter is reserved as [`ReservedBytes`] before it is
//! allocated. A [`Meter`] without a reservation waits for its turn; its connection is not read
//! meanwhile. A letter is always admitted when no other letter of its quota key is arriving and the
//! budget has room for it, or when no other letter is arriving at all. So every letter gets its
//! turn, provided that the letters with a reservation make progress; see
//! [`ReservedBytes::least_progress`].
//!
//! Memory of the sink is scarcer, so less of it is [lent](ByteBudget::lend). A letter without it
//! arrives in memory of the process, within the same budget.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::sync::Arc;

use bytes::Bytes;
use fipa_transport::LoanedContent;
use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::sync::futures::Notified;

use super::source::QuotaKey;

/// Number of periods of `stall_timeout` within which a letter must arrive while others wait for its memory.
pub(crate) const PERIODS: u32 = 12;

/// Maximum number of bytes that are reserved at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct BudgetLimits {
    /// By all quota keys together.
    pub(crate) total: usize,
    /// By one quota key.
    pub(crate) each: usize,
}

/// The memory budget of an endpoint.
#[derive(Debug, Clone, Default)]
pub(crate) struct ByteBudget(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    /// Wakes waiting meters when bytes have been released.
    freed: Notify,
}

#[derive(Debug, Default)]
struct State {
    taken: usize,
    /// Reserved bytes by quota key; no entry is 0.
    by: HashMap<QuotaKey, usize>,
    /// Lent memory of the sink, in bytes.
    lent: usize,
    /// Waiting meters in order, with the number of bytes that they need.
    waiting: BTreeMap<u64, (QuotaKey, usize)>,
    last_turn: u64,
}

/// Bytes reserved in the budget. Dropping it releases them.
#[derive(Debug)]
pub(crate) struct ReservedBytes {
    byte_budget: ByteBudget,
    quota_key: QuotaKey,
    len: usize,
}

/// Reserves memory for the letters of one reader, one after the other.
#[derive(Debug)]
pub(crate) struct Meter {
    byte_budget: ByteBudget,
    quota_key: QuotaKey,
    budget: BudgetLimits,
    /// Its position among the waiting meters.
    turn: Option<u64>,
}

/// Lent memory of the sink. Dropping it ends the loan.
#[derive(Debug)]
pub(crate) struct Loan {
    byte_budget: ByteBudget,
    len: usize,
}

impl State {
    /// Whether a quota key may reserve `len` more bytes.
    fn quota_has(&self, quota_key: &QuotaKey, len: usize, budget: BudgetLimits) -> bool {
        let taken = self.by.get(quota_key).copied().unwrap_or(0);
        taken == 0 || taken.saturating_add(len) <= budget.each
    }

    /// Whether another letter may be admitted. Waiting letters come first: always within a quota
    /// key, otherwise when they wait for the whole budget and not for the share of their quota key.
    fn admits(
        &self,
        turn: Option<u64>,
        quota_key: &QuotaKey,
        len: usize,
        budget: BudgetLimits,
    ) -> bool {
        let before = self.waiting.range(..turn.unwrap_or(u64::MAX));
        let mut before = before.map(|(_, waiting)| waiting);
        let has_turn =
            !before.any(|(other, len)| other == quota_key || self.quota_has(other, *len, budget));
        has_turn
            && self.quota_has(quota_key, len, budget)
            && (self.taken == 0 || self.taken.saturating_add(len) <= budget.total)
    }

    /// Ends the turn of a meter that was admitted. Returns whether to notify the next waiting meters,
    /// which may be admitted as well.
    fn end_turn(&mut self, turn: Option<u64>) -> bool {
        let waited = turn.is_some_and(|turn| self.waiting.remove(&turn).is_some());
        waited && !self.waiting.is_empty()
    }

    fn add(&mut self, quota_key: &QuotaKey, len: usize) {
        self.taken += len;
        *self.by.entry(quota_key.clone()).or_default() += len;
    }

    fn subtract(&mut self, quota_key: &QuotaKey, len: usize) {
        self.taken -= len;
        if let Some(taken) = self.by.get_mut(quota_key) {
            *taken -= len;
            if *taken == 0 {
                self.by.remove(quota_key);
            }
        }
    }
}

impl ByteBudget {
    /// Returns a meter for a reader whose letters count for this quota key.
    pub(crate) fn meter(&self, quota_key: QuotaKey, budget: BudgetLimits) -> Meter {
        Meter {
            byte_budget: self.clone(),
            quota_key,
            budget,
            turn: None,
        }
    }

    /// Lends memory of the sink, unless the sum of all loans would exceed `most`.
    pub(crate) fn lend(&self, len: usize, most: usize) -> Option<Loan> {
        let mut state = self.0.state.lock();
        state.lent = state.lent.checked_add(len).filter(|sum| *sum <= most)?;
        drop(state);
        Some(Loan {
            byte_budget: self.clone(),
            len,
        })
    }

    /// Completes when bytes have been released after this call.
    pub(crate) fn freed(&self) -> Notified<'_> {
        self.0.freed.notified()
    }

    /// Whether a meter waits.
    fn is_contended(&self) -> bool {
        !self.0.state.lock().waiting.is_empty()
    }

    /// Returns the number of reserved bytes.
    #[cfg(test)]
    pub(crate) fn taken(&self) -> usize {
        self.0.state.lock().taken
    }
}

impl Meter {
    /// Reserves memory for a letter, if it is its turn and the budget allows it.
    pub(crate) fn take_now(&mut self, len: usize) -> Option<ReservedBytes> {
        let byte_budget = &self.byte_budget;
        let mut state = byte_budget.0.state.lock();
        if !state.admits(self.turn, &self.quota_key, len, self.budget) {
            return None;
        }
        state.add(&self.quota_key, len);
        let notify = state.end_turn(self.turn.take());
        drop(state);
        if notify {
            byte_budget.0.freed.notify_waiters();
        }
        Some(ReservedBytes {
            byte_budget: byte_budget.clone(),
            quota_key: self.quota_key.clone(),
            len,
        })
    }

    /// Like [`take_now`](Self::take_now), but the meter waits for its turn on failure. The caller
    /// tries again when bytes have been [released](ByteBudget::freed).
    pub(crate) fn take(&mut self, len: usize) -> Option<ReservedBytes> {
        let room = self.take_now(len);
        if room.is_none() {
            let byte_budget = self.byte_budget.clone();
            self.wait(&mut byte_budget.0.state.lock(), len);
        }
        room
    }

    /// Increases the reservation of a letter. It takes precedence over letters without a
    /// reservation. On failure, this meter waits.
    #[cfg(any(feature = "ip", test))]
    pub(crate) fn grow(&mut self, room: &mut ReservedBytes, more: usize) -> bool {
        let byte_budget = self.byte_budget.clone();
        let mut state = byte_budget.0.state.lock();
        let of_others = state.taken - room.len;
        let by = state.by.get(&self.quota_key).copied().unwrap_or(0);
        let of_quota_key = by.saturating_sub(room.len);
        let len = room.len.saturating_add(more);
        let has_room = (of_others == 0 || of_others.saturating_add(len) <= self.budget.total)
            && (of_quota_key == 0 || of_quota_key.saturating_add(len) <= self.budget.each);
        if !has_room {
            self.wait(&mut state, more);
            return false;
        }
        state.add(&self.quota_key, more);
        room.len = len;
        let notify = state.end_turn(self.turn.take());
        drop(state);
        if notify {
            byte_budget.0.freed.notify_waiters();
        }
        true
    }

    fn wait(&mut self, state: &mut State, len: usize) {
        if self.turn.is_none() {
            state.last_turn += 1;
            self.turn = Some(state.last_turn);
            let waiting = (self.quota_key.clone(), len);
            state.waiting.insert(state.last_turn, waiting);
        }
    }
}

impl Drop for Meter {
    fn drop(&mut self) {
        if let Some(turn) = self.turn {
            self.byte_budget.0.state.lock().waiting.remove(&turn);
            self.byte_budget.0.freed.notify_waiters();
        }
    }
}

impl ReservedBytes {
    /// Returns the number of bytes that must arrive in each measuring period: a share of the
    /// reservation while others wait, otherwise 0.
    pub(crate) fn least_progress(&self) -> u64 {
        match self.byte_budget.is_contended() {
            true => self.len as u64 / u64::from(PERIODS),
            false => 0,
        }
    }
}

impl Drop for ReservedBytes {
    fn drop(&mut self) {
        let mut state = self.byte_budget.0.state.lock();
        state.subtract(&self.quota_key, self.len);
        let notify = !state.waiting.is_empty();
        drop(state);
        if notify {
            self.byte_budget.0.freed.notify_waiters();
        }
    }
}

impl Drop for Loan {
    fn drop(&mut self) {
        self.byte_budget.0.state.lock().lent -= self.len;
    }
}

/// Memory of the sink for content that is arriving.
pub(crate) struct ContentBuffer {
    memory: Box<dyn LoanedContent>,
    len: usize,
    /// The loan, held until the content is complete.
    _loan: Loan,
}

impl ContentBuffer {
    pub(crate) fn new(mut memory: Box<dyn LoanedContent>, loan: Loan) -> Self {
        Self {
            len: memory.content_mut().len(),
            memory,
            _loan: loan,
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Returns the memory behind the first `filled` bytes, or `None` when the content is complete.
    pub(crate) fn missing(&mut self, filled: usize) -> Option<&mut [u8]> {
        let missing = self.memory.content_mut().get_mut(filled..)?;
        (!missing.is_empty()).then_some(missing)
    }

    pub(crate) fn freeze(self) -> Bytes {
        self.memory.freeze()
    }
}

impl fmt::Debug for ContentBuffer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ContentBuffer")
            .field("len", &self.len)
            .finish()
    }
}

#[cfg(test)]
mod tests {
    use super::super::source::Home;
    use super::*;

    const BUDGET: BudgetLimits = BudgetLimits {
        total: 200,
        each: 100,
    };

    fn meter(byte_budget: &ByteBudget, process: i32) -> Meter {
        byte_budget.meter(QuotaKey::Unproved(Home::Process(process)), BUDGET)
    }

    #[test]
    fn loans_are_bounded_and_released_on_drop() {
        let byte_budget = ByteBudget::default();
        let first = byte_budget.lend(60, 100).unwrap();
        assert!(byte_budget.lend(41, 100).is_none());
        assert!(byte_budget.lend(usize::MAX, usize::MAX).is_none());
        let second = byte_budget.lend(40, 100);
        assert!(second.is_some());
        drop(first);
        // Exactly the bytes of the first loan are free again.
        assert!(byte_budget.lend(61, 100).is_none());
        assert!(byte_budget.lend(60, 100).is_some());
    }

    #[test]
    fn each_quota_key_has_a_share_and_all_share_the_budget() {
        let byte_budget = ByteBudget::default();
        let mut meters: Vec<Meter> = [1, 1, 2, 3, 4].map(|p| meter(&byte_budget, p)).into();
        let first = meters[0].take(80).unwrap();
        assert!(
            meters[1].take(21).is_none(),
            "the limit of its quota key is 100"
        );
        let second = meters[2].take(90).unwrap();
        assert!(meters[3].take(31).is_none(), "the whole budget is 200");
        assert!(meters[4].take(10).is_none(), "an earlier meter waits");
        assert_eq!(byte_budget.taken(), 170);
        assert_eq!(first.least_progress(), 80 / u64::from(PERIODS));
        drop(first);
        let third = meters[1].take(21).unwrap();
        let fourth = meters[3].take(31).unwrap();
        let fifth = meters[4].take(10).unwrap();
        assert_eq!(byte_budget.taken(), 90 + 21 + 31 + 10);
        assert_eq!(second.least_progress(), 0, "nothing waits");
        drop((second, third, fourth, fifth));
        assert_eq!(byte_budget.taken(), 0);
        assert!(byte_budget.0.state.lock().by.is_empty());
    }

    #[test]
    fn a_letter_larger_than_the_budget_is_admitted_alone() {
        let byte_budget = ByteBudget::default();
        let (mut one, mut other) = (meter(&byte_budget, 1), meter(&byte_budget, 2));
        let small = other.take(1).unwrap();
        assert!(one.take(300).is_none());
        assert!(other.take(1).is_none(), "the earlier meter would starve");
        drop(other);
        drop(small);
        let mut large = one.take(300).unwrap();
        assert!(one.grow(&mut large, 100));
        let mut other = meter(&byte_budget, 2);
        assert!(other.take(1).is_none());
        drop(large);
        assert!(other.take(1).is_some());
    }

    #[test]
    fn a_letter_grows_within_its_share_and_the_budget() {
        let byte_budget = ByteBudget::default();
        let mut meters: Vec<Meter> = [1, 1, 2, 3].map(|p| meter(&byte_budget, p)).into();
        let other = meters[1].take(30).unwrap();
        let mut letter = meters[0].take(20).unwrap();
        assert!(!meters[0].grow(&mut letter, 51), "its share is 100");
        assert_eq!(byte_budget.taken(), 50);
        assert!(
            meters[0].grow(&mut letter, 50),
            "it waits, and has precedence"
        );
        assert_eq!(byte_budget.taken(), 100);
        // It waits no longer, so it holds back nothing else.
        assert_eq!(letter.least_progress(), 0);
        assert!(meters[2].take(10).is_some());
        drop(other);
        drop(meters);
        let mut meters: Vec<Meter> = [1, 2, 3].map(|p| meter(&byte_budget, p)).into();
        let others = (meters[1].take(60).unwrap(), meters[2].take(60).unwrap());
        assert!(!meters[0].grow(&mut letter, 11), "the whole budget is 200");
        assert!(meters[0].grow(&mut letter, 10));
        assert_eq!(byte_budget.taken(), 200);
        drop((others, letter));
        assert_eq!(byte_budget.taken(), 0);
    }

    #[test]
    fn a_dropped_meter_does_not_block_later_ones() {
        let byte_budget = ByteBudget::default();
        let (mut one, mut two) = (meter(&byte_budget, 1), meter(&byte_budget, 2));
        let _room = meter(&byte_budget, 3).take(150).unwrap();
        assert!(one.take(60).is_none());
        assert!(two.take(10).is_none());
        drop(one);
        assert!(two.take(10).is_some());
    }
}
