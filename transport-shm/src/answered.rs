//! The senders that have an answer and have not been woken for it.

use std::sync::atomic::{AtomicBool, Ordering};

use fipa_transport::Incarnation;
use parking_lot::Mutex;

/// A list of senders. Most polls find it empty, and do not take its lock.
#[derive(Debug, Default)]
pub(crate) struct Answered {
    senders: Mutex<Vec<Incarnation>>,
    /// Whether the list has senders. Written under the lock. A thread that added a sender reads true
    /// afterwards, unless another thread has taken or removed the sender.
    any: AtomicBool,
}

impl Answered {
    /// Whether there may be senders.
    pub(crate) fn has_any(&self) -> bool {
        self.any.load(Ordering::Relaxed)
    }

    pub(crate) fn add(&self, sender: Incarnation) {
        let mut senders = self.senders.lock();
        if !senders.contains(&sender) {
            senders.push(sender);
        }
        self.any.store(true, Ordering::Relaxed);
    }

    /// Removes the senders for which `stays` returns false. Returns whether one of the others satisfies
    /// `is_wanted`.
    pub(crate) fn retain(
        &self,
        stays: impl FnMut(&Incarnation) -> bool,
        is_wanted: impl FnMut(&Incarnation) -> bool,
    ) -> bool {
        let mut senders = self.senders.lock();
        senders.retain(stays);
        self.any.store(!senders.is_empty(), Ordering::Relaxed);
        senders.iter().any(is_wanted)
    }

    /// Removes and returns all senders.
    pub(crate) fn take(&self) -> Vec<Incarnation> {
        if !self.has_any() {
            // The list keeps its memory for the next letter.
            return Vec::new();
        }
        let mut senders = self.senders.lock();
        self.any.store(false, Ordering::Relaxed);
        std::mem::take(&mut *senders)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sender_is_taken_once_unless_it_is_removed_before() {
        let answered = Answered::default();
        let [one, other] = [1, 2].map(Incarnation::from_u64);
        assert!(!answered.has_any());
        for sender in [one, other, one] {
            answered.add(sender);
        }
        assert!(answered.retain(|it| *it == one, |it| *it == one));
        assert!(!answered.retain(|_| true, |it| *it == other));
        assert!(answered.has_any());
        assert_eq!(answered.take(), [one]);
        assert!(!answered.has_any());
        answered.add(other);
        assert!(!answered.retain(|_| false, |_| true));
        assert!(answered.take().is_empty());
    }
}
