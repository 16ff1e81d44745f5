//! Deadlines of expected messages.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::conversation::ids::{PartyIndex, SlotIndex};

/// The deadline of a message: its time, its conversation and its party.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Deadline {
    /// Milliseconds of the monotonic clock.
    pub(crate) due: u64,
    /// Slot of the conversation.
    pub(crate) at: SlotIndex,
    /// Generation of the slot.
    pub(crate) generation: u32,
    /// Index of the party.
    pub(crate) party: PartyIndex,
}

/// Deadlines, the earliest first. A stale deadline is removed when it is due, or when there are too
/// many.
#[derive(Debug, Default)]
pub(crate) struct Deadlines {
    heap: BinaryHeap<Reverse<Deadline>>,
    /// Number of deadlines after stale ones were last removed.
    counted: usize,
}

impl Deadlines {
    pub(crate) fn push(&mut self, deadline: Deadline) {
        self.heap.push(Reverse(deadline));
    }

    pub(crate) fn next(&self) -> Option<u64> {
        self.heap.peek().map(|Reverse(deadline)| deadline.due)
    }

    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.heap.len()
    }

    /// Removes and returns the earliest deadline if it is before `now`.
    pub(crate) fn pop_before(&mut self, now: u64) -> Option<Deadline> {
        if self.next()? >= now {
            return None;
        }
        self.heap.pop().map(|Reverse(deadline)| deadline)
    }

    /// Whether there may be more stale deadlines than valid ones.
    #[inline]
    pub(crate) fn are_many(&self) -> bool {
        const SOME: usize = 1_024;
        self.heap.len() > 2 * self.counted + SOME
    }

    /// Removes stale deadlines. `counts` tells whether a deadline is valid.
    pub(crate) fn remove_stale(&mut self, counts: impl Fn(&Deadline) -> bool) {
        self.heap.retain(|Reverse(deadline)| counts(deadline));
        self.counted = self.heap.len();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deadlines_are_ordered_and_stale_ones_are_removed() {
        let mut deadlines = Deadlines::default();
        let deadline = |due| Deadline {
            due,
            at: SlotIndex::new(0),
            generation: 0,
            party: PartyIndex::new(0),
        };
        for due in [7, 3, 5] {
            deadlines.push(deadline(due));
        }
        assert_eq!(deadlines.next(), Some(3));
        assert_eq!(deadlines.pop_before(3), None);
        assert_eq!(deadlines.pop_before(6), Some(deadline(3)));
        assert_eq!(deadlines.pop_before(6), Some(deadline(5)));
        assert_eq!(deadlines.pop_before(6), None);
        for due in 0..100_000 {
            deadlines.push(deadline(due));
            if deadlines.are_many() {
                deadlines.remove_stale(|deadline| deadline.due % 100 == 0);
            }
        }
        assert!(deadlines.heap.len() < 4_000, "{}", deadlines.heap.len());
    }

    #[test]
    fn stale_deadlines_are_removed_beyond_a_bound() {
        let mut deadlines = Deadlines::default();
        let mut remaining = |more, counts| {
            for due in 0..more {
                deadlines.push(Deadline {
                    due,
                    at: SlotIndex::new(0),
                    generation: 0,
                    party: PartyIndex::new(0),
                });
            }
            if deadlines.are_many() {
                deadlines.remove_stale(|_| counts);
            }
            deadlines.len()
        };
        assert_eq!(remaining(1_024, false), 1_024);
        assert_eq!(remaining(1, false), 0);
        assert_eq!(remaining(3_000, true), 3_000);
        assert_eq!(remaining(4_024, false), 7_024);
        assert_eq!(remaining(1, false), 0);
    }
}
