//! Views of a directory without I/O.

use std::sync::{Arc, OnceLock};

use fipa_transport::{Incarnation, Mandate};
use rpds::HashTrieMapSync;

use crate::{Directory, Entry};

/// The entries of a directory, for readers that must not wait.
///
/// No method reads files or waits for another process. [`Directory::view`] returns a view that does
/// not change. A directory is also a view of itself, which changes with it.
pub trait View: Send + Sync {
    /// Returns the entry of exactly this name.
    fn named(&self, name: &str) -> Option<Arc<Entry>>;

    /// Returns the entry of this incarnation. Always `None` for an unknown incarnation.
    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>>;

    /// Returns all entries, sorted by name.
    fn all(&self) -> Arc<[Arc<Entry>]>;

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
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    names: HashTrieMapSync<Arc<str>, Arc<Entry>>,
    incarnations: HashTrieMapSync<Incarnation, Arc<Entry>>,
    sorted: OnceLock<Arc<[Arc<Entry>]>>,
}

impl Snapshot {
    /// Creates a snapshot of these entries. Of several entries of one name, the last one counts.
    pub fn of<'a>(entries: impl IntoIterator<Item = &'a Arc<Entry>>) -> Self {
        let mut snapshot = Self::default();
        for entry in entries {
            let before = snapshot.names.get(&entry.name).cloned();
            snapshot.set(before.as_ref(), Some(entry));
        }
        snapshot
    }

    /// Replaces the entry of a name.
    pub(crate) fn set(&mut self, before: Option<&Arc<Entry>>, after: Option<&Arc<Entry>>) {
        self.sorted.take();
        if let Some(before) = before {
            self.names.remove_mut(&before.name);
            if let Some(indexed) = self.incarnations.get(&before.incarnation)
                && indexed.name == before.name
            {
                self.incarnations.remove_mut(&before.incarnation);
            }
        }
        if let Some(after) = after {
            self.names.insert_mut(after.name.clone(), Arc::clone(after));
            if after.incarnation.is_known() {
                self.incarnations
                    .insert_mut(after.incarnation, Arc::clone(after));
            }
        }
    }
}

impl View for Snapshot {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        self.names.get(name).cloned()
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.incarnations.get(&incarnation).cloned()
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
