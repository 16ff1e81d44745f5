//! Memory for letters that are arriving.
//!
//! A peer can announce a large letter and send it slowly, on many connections. So the bytes of all
//! letters that are arriving have one budget, in which every [account](Account) has a share
//! ([`Rooms`]). The memory of a letter is taken from the budget as a [`Room`] before it is allocated.
//! A [`Meter`] that gets none waits for its turn; its connection is not read meanwhile. A letter is
//! always admitted when nothing else of its account is arriving and the budget has room for it, or
//! nothing else is arriving at all. So every letter gets its turn, provided that those which have a
//! room make progress; see [`Room::least_progress`].
//!
//! Memory of the sink is scarcer: of that less is [lent](Rooms::lend). A letter for which there is
//! none arrives in memory of the process, within the same budget.

use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::sync::Arc;

use bytes::Bytes;
use fipa_transport::LoanedContent;
use parking_lot::Mutex;
use tokio::sync::Notify;
use tokio::sync::futures::Notified;

use super::source::Account;

/// While others wait, a letter has to arrive within this many times the period in which progress is
/// measured.
const PERIODS: u64 = 12;

/// Largest number of bytes that are taken at a time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Budget {
    /// By all accounts together.
    pub(crate) total: usize,
    /// By one account.
    pub(crate) each: usize,
}

/// The budget of an endpoint.
#[derive(Debug, Clone, Default)]
pub(crate) struct Rooms(Arc<Shared>);

#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    /// Tells meters that wait that there may be room.
    freed: Notify,
}

#[derive(Debug, Default)]
struct State {
    taken: usize,
    /// What the accounts have taken; none of them nothing.
    by: HashMap<Account, usize>,
    /// The memory of the sink that is lent.
    lent: usize,
    /// Meters that wait, in the order in which they began to, with what they need.
    waiting: BTreeMap<u64, (Account, usize)>,
    last_turn: u64,
}

/// Bytes that were taken from the budget; given back when this is dropped.
#[derive(Debug)]
pub(crate) struct Room {
    rooms: Rooms,
    account: Account,
    len: usize,
}

/// Takes rooms for the letters of one reader, one after the other.
#[derive(Debug)]
pub(crate) struct Meter {
    rooms: Rooms,
    account: Account,
    budget: Budget,
    /// Its number among those that wait.
    turn: Option<u64>,
}

/// Memory of the sink that is lent; given back when this is dropped.
#[derive(Debug)]
pub(crate) struct Loan {
    rooms: Rooms,
    len: usize,
}

impl State {
    /// Whether an account may take so much more.
    fn account_has(&self, account: &Account, len: usize, budget: Budget) -> bool {
        let taken = self.by.get(account).copied().unwrap_or(0);
        taken == 0 || taken.saturating_add(len) <= budget.each
    }

    /// Whether another letter may be taken. Those that wait come first: within an account always,
    /// otherwise when they wait for the budget of all and not for the share of their account.
    fn admits(&self, turn: Option<u64>, account: &Account, len: usize, budget: Budget) -> bool {
        let before = self.waiting.range(..turn.unwrap_or(u64::MAX));
        let mut before = before.map(|(_, waiting)| waiting);
        let has_turn =
            !before.any(|(other, len)| other == account || self.account_has(other, *len, budget));
        has_turn
            && self.account_has(account, len, budget)
            && (self.taken == 0 || self.taken.saturating_add(len) <= budget.total)
    }

    fn add(&mut self, account: &Account, len: usize) {
        self.taken += len;
        *self.by.entry(account.clone()).or_default() += len;
    }

    fn subtract(&mut self, account: &Account, len: usize) {
        self.taken -= len;
        if let Some(taken) = self.by.get_mut(account) {
            *taken -= len;
            if *taken == 0 {
                self.by.remove(account);
            }
        }
    }
}

impl Rooms {
    /// A meter for a reader whose letters count for this account.
    pub(crate) fn meter(&self, account: Account, budget: Budget) -> Meter {
        Meter {
            rooms: self.clone(),
            account,
            budget,
            turn: None,
        }
    }

    /// Lends memory of the sink, unless more than `most` would be lent then.
    pub(crate) fn lend(&self, len: usize, most: usize) -> Option<Loan> {
        let mut state = self.0.state.lock();
        state.lent = state.lent.checked_add(len).filter(|sum| *sum <= most)?;
        drop(state);
        Some(Loan {
            rooms: self.clone(),
            len,
        })
    }

    /// Becomes ready when room has been given back since this was called.
    pub(crate) fn freed(&self) -> Notified<'_> {
        self.0.freed.notified()
    }

    /// Whether a reader waits for room.
    fn is_contended(&self) -> bool {
        !self.0.state.lock().waiting.is_empty()
    }

    /// Bytes that are taken now.
    #[cfg(test)]
    pub(crate) fn taken(&self) -> usize {
        self.0.state.lock().taken
    }
}

impl Meter {
    /// Takes room for a letter, if it is its turn and there is some.
    pub(crate) fn take_now(&mut self, len: usize) -> Option<Room> {
        let rooms = &self.rooms;
        let mut state = rooms.0.state.lock();
        if !state.admits(self.turn, &self.account, len, self.budget) {
            return None;
        }
        state.add(&self.account, len);
        let turn = self.turn.take();
        let waited = turn.is_some_and(|turn| state.waiting.remove(&turn).is_some());
        let notify = waited && !state.waiting.is_empty();
        drop(state);
        if notify {
            // Those behind it may have room as well.
            rooms.0.freed.notify_waiters();
        }
        Some(Room {
            rooms: rooms.clone(),
            account: self.account.clone(),
            len,
        })
    }

    /// The same. Without room the meter waits: this is to be called again when room has been
    /// [freed](Rooms::freed).
    pub(crate) fn take(&mut self, len: usize) -> Option<Room> {
        let room = self.take_now(len);
        if room.is_none() {
            let rooms = self.rooms.clone();
            self.wait(&mut rooms.0.state.lock(), len);
        }
        room
    }

    /// Takes more for a letter that has a room from such a meter. It goes before letters that wait for
    /// a room. When there is none, this meter waits.
    #[cfg(any(feature = "ip", test))]
    pub(crate) fn grow(&mut self, room: &mut Room, more: usize) -> bool {
        let rooms = self.rooms.clone();
        let mut state = rooms.0.state.lock();
        let of_others = state.taken - room.len;
        let by = state.by.get(&self.account).copied().unwrap_or(0);
        let of_account = by.saturating_sub(room.len);
        let len = room.len.saturating_add(more);
        let has_room = (of_others == 0 || of_others.saturating_add(len) <= self.budget.total)
            && (of_account == 0 || of_account.saturating_add(len) <= self.budget.each);
        if has_room {
            state.add(&self.account, more);
            room.len = len;
        } else {
            self.wait(&mut state, more);
        }
        has_room
    }

    fn wait(&mut self, state: &mut State, len: usize) {
        if self.turn.is_none() {
            state.last_turn += 1;
            self.turn = Some(state.last_turn);
            let waiting = (self.account.clone(), len);
            state.waiting.insert(state.last_turn, waiting);
        }
    }
}

impl Drop for Meter {
    fn drop(&mut self) {
        if let Some(turn) = self.turn {
            self.rooms.0.state.lock().waiting.remove(&turn);
            self.rooms.0.freed.notify_waiters();
        }
    }
}

impl Room {
    /// How many bytes have to arrive in each period in which progress is measured: while others
    /// wait, a share of what the room holds.
    pub(crate) fn least_progress(&self) -> u64 {
        match self.rooms.is_contended() {
            true => self.len as u64 / PERIODS,
            false => 0,
        }
    }
}

impl Drop for Room {
    fn drop(&mut self) {
        let mut state = self.rooms.0.state.lock();
        state.subtract(&self.account, self.len);
        let notify = !state.waiting.is_empty();
        drop(state);
        if notify {
            self.rooms.0.freed.notify_waiters();
        }
    }
}

impl Drop for Loan {
    fn drop(&mut self) {
        self.rooms.0.state.lock().lent -= self.len;
    }
}

/// Where content is put while it arrives.
pub(crate) struct Place {
    memory: Box<dyn LoanedContent>,
    len: usize,
    /// Until the content is there.
    _loan: Loan,
}

impl Place {
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

    /// What is to be filled behind the first `filled` bytes; none when nothing is.
    pub(crate) fn missing(&mut self, filled: usize) -> Option<&mut [u8]> {
        let missing = self.memory.content_mut().get_mut(filled..)?;
        (!missing.is_empty()).then_some(missing)
    }

    pub(crate) fn freeze(self) -> Bytes {
        self.memory.freeze()
    }
}

impl fmt::Debug for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Place").field("len", &self.len).finish()
    }
}

#[cfg(test)]
mod tests {
    use super::super::source::Home;
    use super::*;

    const BUDGET: Budget = Budget {
        total: 200,
        each: 100,
    };

    fn meter(rooms: &Rooms, process: i32) -> Meter {
        rooms.meter(Account::Unproved(Home::Process(process)), BUDGET)
    }

    #[test]
    fn no_more_is_lent_than_allowed_and_all_of_it_given_back() {
        let rooms = Rooms::default();
        let first = rooms.lend(60, 100).unwrap();
        assert!(rooms.lend(41, 100).is_none());
        assert!(rooms.lend(usize::MAX, usize::MAX).is_none());
        let second = rooms.lend(40, 100);
        assert!(second.is_some());
        drop(first);
        assert!(rooms.lend(60, 100).is_some());
    }

    #[test]
    fn an_account_has_its_share_and_all_have_the_budget() {
        let rooms = Rooms::default();
        let mut meters: Vec<Meter> = [1, 1, 2, 3, 4].map(|p| meter(&rooms, p)).into();
        let first = meters[0].take(80).unwrap();
        assert!(meters[1].take(21).is_none(), "its account has 100");
        let second = meters[2].take(90).unwrap();
        assert!(meters[3].take(31).is_none(), "all have 200");
        assert!(meters[4].take(10).is_none(), "another came before");
        assert_eq!(rooms.taken(), 170);
        assert_eq!(first.least_progress(), 80 / PERIODS);
        drop(first);
        let third = meters[1].take(21).unwrap();
        let fourth = meters[3].take(31).unwrap();
        let fifth = meters[4].take(10).unwrap();
        assert_eq!(rooms.taken(), 90 + 21 + 31 + 10);
        assert_eq!(second.least_progress(), 0, "nothing waits");
        drop((second, third, fourth, fifth));
        assert_eq!(rooms.taken(), 0);
        assert!(rooms.0.state.lock().by.is_empty());
    }

    #[test]
    fn a_letter_larger_than_the_budget_is_taken_alone() {
        let rooms = Rooms::default();
        let (mut one, mut other) = (meter(&rooms, 1), meter(&rooms, 2));
        let small = other.take(1).unwrap();
        assert!(one.take(300).is_none());
        assert!(other.take(1).is_none(), "it would wait for ever otherwise");
        drop(other);
        drop(small);
        let mut large = one.take(300).unwrap();
        assert!(one.grow(&mut large, 100));
        let mut other = meter(&rooms, 2);
        assert!(other.take(1).is_none());
        drop(large);
        assert!(other.take(1).is_some());
    }

    #[test]
    fn a_meter_that_is_gone_holds_up_nothing() {
        let rooms = Rooms::default();
        let (mut one, mut two) = (meter(&rooms, 1), meter(&rooms, 2));
        let _room = meter(&rooms, 3).take(150).unwrap();
        assert!(one.take(60).is_none());
        assert!(two.take(10).is_none());
        drop(one);
        assert!(two.take(10).is_some());
    }
}
