//! What a monitor remembers beside conversations, as fingerprints: the identifiers of conversations that
//! it removed before their end, and messages that it refused.

use std::collections::{HashSet, VecDeque};

/// Identifiers of conversations that the monitor does not know any more.
///
/// Beyond a bound, single identifiers are not told apart: every conversation may be one of them.
#[derive(Debug, Default)]
pub(crate) struct Removed {
    ids: HashSet<u64>,
    any: bool,
}

impl Removed {
    /// Maximum number of identifiers.
    const MAX: usize = 1 << 16;

    pub(crate) fn add(&mut self, id: u64) {
        if self.any {
            return;
        }
        self.ids.insert(id);
        if self.ids.len() > Self::MAX {
            self.any = true;
            self.ids = HashSet::new();
        }
    }

    pub(crate) fn contains(&self, id: u64) -> bool {
        self.any || self.ids.contains(&id)
    }
}

/// The last refused messages, which may be answered with not-understood.
#[derive(Debug, Default)]
pub(crate) struct Refused {
    keys: VecDeque<u64>,
}

impl Refused {
    /// Maximum number of messages.
    const MAX: usize = 1_024;

    /// Adds a refused message with a key for each receiver.
    pub(crate) fn add(&mut self, keys: &[u64]) {
        for key in keys {
            if self.keys.len() == Self::MAX {
                self.keys.pop_front();
            }
            self.keys.push_back(*key);
        }
    }

    /// Whether one of the keys is that of a refused message, which is then removed: it gets one answer.
    pub(crate) fn take(&mut self, keys: &[u64]) -> bool {
        let found = self.keys.iter().position(|known| keys.contains(known));
        found.and_then(|at| self.keys.remove(at)).is_some()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn beyond_the_bound_every_conversation_may_have_been_removed() {
        let mut removed = Removed::default();
        for id in 0..1 << 16 {
            removed.add(id);
        }
        assert!(removed.contains(17) && !removed.contains(u64::MAX));
        removed.add(1 << 16);
        assert!(removed.contains(u64::MAX));
        assert!(removed.ids.is_empty());
    }

    #[test]
    fn a_refused_message_has_one_answer() {
        let mut refused = Refused::default();
        refused.add(&[1, 2]);
        assert!(refused.take(&[7, 2]));
        assert!(!refused.take(&[7, 2]));
        assert!(refused.take(&[1]));
        for key in 0..2_000 {
            refused.add(&[key]);
        }
        assert!(!refused.take(&[975]) && refused.take(&[976]));
    }
}
