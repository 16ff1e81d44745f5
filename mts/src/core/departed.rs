//! Agents of this host that have left it: letters that were on their way to one of them when it
//! moved are passed on once more, to where its name is registered now.
//!
//! Only letters for a life that was on this host a moment ago are, so that a gateway never relays
//! between strangers; and only letters that nobody can have taken yet ([`Parcel::LAST_HOPS`]),
//! because only the life that took a letter knows a copy of it.
//!
//! [`Parcel::LAST_HOPS`]: fipa_transport::Parcel::LAST_HOPS

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_sds::{Directory, Entry, Reach, Role};
use fipa_transport::Incarnation;

use crate::Map;

/// For how long letters follow: those that were sent before the move became known everywhere.
const MEMORY: Duration = Duration::from_secs(30);
/// Agents that are remembered, at most; the one that left first is forgotten first.
const MAX_DEPARTED: usize = 4096;

/// The agents that were on this host a moment ago.
#[derive(Debug, Default)]
pub(super) struct Departed {
    names: Map<Incarnation, Arc<str>>,
    order: VecDeque<(Instant, Incarnation)>,
}

impl Departed {
    /// This agent of this host has left the directory, or its name is somebody else's now.
    pub(super) fn left(&mut self, now: Instant, entry: &Entry) {
        if entry.reach != Reach::Local || entry.role != Role::Agent {
            return;
        }
        while let Some((since, life)) = self.order.front().copied() {
            let old = now.saturating_duration_since(since) > MEMORY;
            if !old && self.order.len() < MAX_DEPARTED {
                break;
            }
            self.order.pop_front();
            self.names.remove(&life);
        }
        let name = Arc::clone(&entry.name);
        if self.names.insert(entry.incarnation, name).is_none() {
            self.order.push_back((now, entry.incarnation));
        }
    }

    /// Where letters for this life go now, if it was here and its name is registered again.
    pub(super) fn successor(
        &self,
        life: Incarnation,
        directory: &dyn Directory,
    ) -> Option<Arc<Entry>> {
        let found = directory.lookup(self.names.get(&life)?)?;
        // An old peer's agent takes letters that nobody could tell from copies.
        let may_follow = found.role == Role::Agent && found.incarnation.is_known();
        (may_follow && found.incarnation != life).then_some(found)
    }
}

#[cfg(test)]
mod tests {
    use fipa_sds::{MemoryDirectory, Mts, Registration};

    use super::*;

    fn directory() -> MemoryDirectory {
        MemoryDirectory::new(Mts::new("mts", Incarnation::from_u64(1)))
    }

    fn register(directory: &MemoryDirectory, life: u64) -> Arc<Entry> {
        let life = Incarnation::from_u64(life);
        let arm = Registration::new("arm", life, Vec::new());
        directory.register(arm).unwrap()
    }

    #[test]
    fn letters_follow_who_was_here_and_is_somewhere_again() {
        let (directory, now) = (directory(), Instant::now());
        let mut departed = Departed::default();
        let first = register(&directory, 7);
        departed.left(now, &first);
        assert!(departed.successor(first.incarnation, &directory).is_none());
        directory.deregister("arm", first.incarnation).unwrap();
        assert!(departed.successor(first.incarnation, &directory).is_none());
        let second = register(&directory, 8);
        let follows = departed.successor(first.incarnation, &directory).unwrap();
        assert_eq!(follows.incarnation, second.incarnation);
        let stranger = Incarnation::from_u64(9);
        assert!(departed.successor(stranger, &directory).is_none());
    }

    #[test]
    fn who_left_long_ago_is_forgotten() {
        let (directory, now) = (directory(), Instant::now());
        let mut departed = Departed::default();
        let mut entry = Entry::clone(&register(&directory, 7));
        for number in 0..10_000 {
            entry.incarnation = Incarnation::from_u64(100 + number);
            departed.left(now, &entry);
        }
        assert_eq!(departed.names.len(), MAX_DEPARTED);
        assert_eq!(departed.order.len(), MAX_DEPARTED);
        entry.incarnation = Incarnation::from_u64(8);
        departed.left(now + MEMORY * 2, &entry);
        assert_eq!(departed.names.len(), 1);
    }
}
