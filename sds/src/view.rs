//! Views of a directory without I/O.

use std::sync::{Arc, OnceLock};

use fipa_transport::{Incarnation, Mandate};
use parking_lot::Mutex;
use rpds::{HashTrieMapSync, RedBlackTreeMapSync};

use crate::{Directory, Entry};

/// The entries of a directory, for readers that must not wait.
///
/// No method waits for another process. An entry of an agent of another host may be read from a file that
/// is open and does not change. [`Directory::view`] returns a view that does not change. A directory is
/// also a view of itself, which changes with it.
pub trait View: Send + Sync {
    /// Returns the entry of exactly this name.
    fn named(&self, name: &str) -> Option<Arc<Entry>>;

    /// Returns the entry of this incarnation. Always `None` for an unknown incarnation.
    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>>;

    /// Returns all entries, sorted by name.
    fn all(&self) -> Arc<[Arc<Entry>]>;

    /// Returns the last entries of agents that the directory listed until their gateway was gone. The
    /// time of registration of such an entry is the time when the gateway was last seen. They are not
    /// among the other entries. They tell an agent that cannot be reached from one that does not exist,
    /// for one hour: an agent that leaves or returns is in each view either lost or listed. Bounded by
    /// [`Exchange::MAX_LOST`](crate::Exchange::MAX_LOST).
    fn lost_agents(&self) -> Vec<Arc<Entry>> {
        Vec::new()
    }

    /// Returns the last entry of a [lost agent](Self::lost_agents) of this name.
    fn lost_agent(&self, name: &str) -> Option<Arc<Entry>> {
        let _ = name;
        None
    }

    /// Whether the view is [authoritative](Directory::speaks_for) for the coalitions of this message
    /// transport service.
    fn is_authority(&self, mts: Incarnation) -> bool {
        let _ = mts;
        false
    }

    /// Returns the [mandate](Directory::mandate) of this message transport service.
    fn mandate_of(&self, mts: Incarnation) -> Mandate {
        let _ = mts;
        Mandate::Unproved
    }
}

impl<D: Directory + ?Sized> View for D {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        self.known(name)
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.known_incarnation(incarnation)
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        self.entries()
    }

    fn lost_agents(&self) -> Vec<Arc<Entry>> {
        self.view().lost_agents()
    }

    fn lost_agent(&self, name: &str) -> Option<Arc<Entry>> {
        self.view().lost_agent(name)
    }

    fn is_authority(&self, mts: Incarnation) -> bool {
        self.speaks_for(mts)
    }

    fn mandate_of(&self, mts: Incarnation) -> Mandate {
        self.mandate(mts)
    }
}

/// The entries of a directory at one time.
///
/// A copy shares its entries with the original, so that a change costs the same however many entries
/// there are.
///
/// Several names may claim one registration, because other hosts choose the incarnations that they
/// announce. The registration belongs to a proved entry before an unproved one, and to the first of
/// equals, so that a later claim takes no letters from its agent.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    names: HashTrieMapSync<Arc<str>, Arc<Entry>>,
    incarnations: HashTrieMapSync<Incarnation, ProvedEntry>,
    /// Entries whose registration belongs to an entry of another name; proved ones first.
    disputed: HashTrieMapSync<Incarnation, DisputedEntries>,
    /// Lost agents, which are not among the entries above.
    lost: HashTrieMapSync<Arc<str>, Arc<Entry>>,
    sorted: OnceLock<Arc<[Arc<Entry>]>>,
}

/// An entry, and whether its origin is proved.
pub(crate) type ProvedEntry = (Arc<Entry>, bool);
/// Entries by whether their origin is unproved, then by name.
type DisputedEntries = RedBlackTreeMapSync<(bool, Arc<str>), Arc<Entry>>;

impl Snapshot {
    /// Creates a snapshot of these entries, all unproved. Of several entries of one name, the last
    /// one counts.
    pub fn of<'a>(entries: impl IntoIterator<Item = &'a Arc<Entry>>) -> Self {
        let mut snapshot = Self::default();
        for entry in entries {
            let before = snapshot.names.get(&entry.name).cloned();
            snapshot.set(before.as_ref(), Some((Arc::clone(entry), false)));
        }
        snapshot
    }

    /// Replaces the lost agents.
    pub(crate) fn set_lost(&mut self, lost: impl IntoIterator<Item = Arc<Entry>>) {
        let lost = lost.into_iter();
        self.lost = lost.map(|entry| (Arc::clone(&entry.name), entry)).collect();
    }

    /// Replaces the entry of a name.
    pub(crate) fn set(&mut self, before: Option<&Arc<Entry>>, after: Option<ProvedEntry>) {
        self.sorted.take();
        if let Some(before) = before {
            self.names.remove_mut(&before.name);
            let stays = after.as_ref().is_some_and(|(after, _)| {
                after.incarnation == before.incarnation && after.name == before.name
            });
            self.remove(before, stays);
        }
        if let Some((entry, is_proved)) = after {
            self.names
                .insert_mut(entry.name.clone(), Arc::clone(&entry));
            if entry.incarnation.is_known() {
                self.insert(entry, is_proved);
            }
        }
    }

    /// Removes an entry from the registrations. If an update of it follows, its registration stays
    /// with its name.
    fn remove(&mut self, before: &Arc<Entry>, is_updated: bool) {
        let registration = before.incarnation;
        let is_holder = self
            .incarnations
            .get(&registration)
            .is_some_and(|(holder, _)| holder.name == before.name);
        let mut disputed = self.disputed_for(registration);
        match is_holder {
            true if is_updated => return,
            true => {
                let next = disputed.first();
                match next.map(|(key, next)| (key.clone(), Arc::clone(next))) {
                    Some((key, next)) => {
                        disputed.remove_mut(&key);
                        self.incarnations.insert_mut(registration, (next, !key.0));
                    }
                    None => {
                        self.incarnations.remove_mut(&registration);
                    }
                }
            }
            false => {
                for is_unproved in [false, true] {
                    disputed.remove_mut(&(is_unproved, Arc::clone(&before.name)));
                }
            }
        }
        match disputed.is_empty() {
            true => {
                self.disputed.remove_mut(&registration);
            }
            false => self.disputed.insert_mut(registration, disputed),
        }
    }

    fn disputed_for(&self, registration: Incarnation) -> DisputedEntries {
        let disputed = self.disputed.get(&registration);
        disputed.cloned().unwrap_or_default()
    }

    fn insert(&mut self, entry: Arc<Entry>, is_proved: bool) {
        let registration = entry.incarnation;
        let holder = self.incarnations.get(&registration);
        let holder = holder.filter(|(holder, _)| holder.name != entry.name);
        let (loser, is_loser_proved) = match holder.cloned() {
            None => {
                self.incarnations
                    .insert_mut(registration, (entry, is_proved));
                return;
            }
            Some((holder, false)) if is_proved => {
                self.incarnations
                    .insert_mut(registration, (entry, is_proved));
                (holder, false)
            }
            Some(_) => (entry, is_proved),
        };
        let mut disputed = self.disputed_for(registration);
        let key = (!is_loser_proved, Arc::clone(&loser.name));
        disputed.insert_mut(key, loser);
        self.disputed.insert_mut(registration, disputed);
    }
}

impl View for Snapshot {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        self.names.get(name).cloned()
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let (entry, _) = self.incarnations.get(&incarnation)?;
        Some(Arc::clone(entry))
    }

    fn lost_agents(&self) -> Vec<Arc<Entry>> {
        self.lost.values().cloned().collect()
    }

    fn lost_agent(&self, name: &str) -> Option<Arc<Entry>> {
        self.lost.get(name).cloned()
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        let sorted = self.sorted.get_or_init(|| {
            let mut entries: Vec<_> = self.names.values().cloned().collect();
            entries.sort_unstable_by(|a, b| a.name.cmp(&b.name));
            entries.into()
        });
        Arc::clone(sorted)
    }
}

/// The entries that lookups returned last, each at the place of its hash.
pub(crate) struct KeptEntries<const COUNT: usize>([Mutex<Option<Arc<Entry>>>; COUNT]);

impl<const COUNT: usize> Default for KeptEntries<COUNT> {
    fn default() -> Self {
        Self(std::array::from_fn(|_| Mutex::default()))
    }
}

impl<const COUNT: usize> KeptEntries<COUNT> {
    /// Returns the kept entry that is the wanted one, or else the one that `find` returns, which is kept.
    pub(crate) fn get_or(
        &self,
        hash: usize,
        is_it: impl FnOnce(&Entry) -> bool,
        find: impl FnOnce() -> Option<Arc<Entry>>,
    ) -> Option<Arc<Entry>> {
        let place = self.0.get(hash % COUNT)?;
        let cached = place.lock().clone();
        if let Some(entry) = cached.filter(|entry| is_it(entry)) {
            return Some(entry);
        }
        let found = find()?;
        let replaced = place.lock().replace(Arc::clone(&found));
        // Without the lock: a view may be the last owner of the entry.
        drop(replaced);
        Some(found)
    }
}
