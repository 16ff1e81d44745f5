//! A table of agent names with reference counts. Conversations share its entries.

use std::hash::{BuildHasher, RandomState};

use hashbrown::HashTable;

use crate::conversation::ids::Name;

/// Agent names with reference counts. A released entry is reused without allocating.
#[derive(Debug)]
pub(crate) struct Names {
    entries: Vec<Entry>,
    free: Vec<Name>,
    by_name: HashTable<Name>,
    hasher: RandomState,
}

#[cfg(test)]
thread_local! {
    /// Number of comparisons of names by this thread. Tests bound it by the number of names.
    pub(crate) static COMPARISONS: std::cell::Cell<usize> = const { std::cell::Cell::new(0) };
}

/// Maximum capacity of the buffer of an unused name, in bytes.
const KEPT: usize = 64;

#[derive(Debug)]
struct Entry {
    name: String,
    uses: u32,
}

impl Names {
    pub(crate) fn new(hasher: RandomState) -> Self {
        Self {
            entries: Vec::new(),
            free: Vec::new(),
            by_name: HashTable::new(),
            hasher,
        }
    }

    /// Adds a reference to a name. The caller must call [`release`](Self::release) for it once.
    pub(crate) fn acquire(&mut self, name: &str) -> Name {
        let hash = self.hasher.hash_one(name);
        if let Some(known) = self.find(hash, name) {
            if let Some(entry) = self.entry(known) {
                entry.uses += 1;
            }
            return known;
        }
        let index = match self.free.pop() {
            Some(index) => {
                if let Some(entry) = self.entry(index) {
                    entry.name.clear();
                    entry.name.push_str(name);
                    entry.uses = 1;
                }
                index
            }
            None => {
                self.entries.push(Entry {
                    name: name.to_owned(),
                    uses: 1,
                });
                // The number of conversations and participants bounds the number of entries.
                Name::new(self.entries.len() - 1)
            }
        };
        let (entries, hasher) = (&self.entries, &self.hasher);
        self.by_name.insert_unique(hash, index, |name| {
            let entry = entries.get(name.get());
            hasher.hash_one(entry.map_or("", |entry| entry.name.as_str()))
        });
        index
    }

    /// Adds a reference to a name in use, if it is one.
    pub(crate) fn acquire_again(&mut self, name: Name) -> Name {
        if let Some(entry) = self.entry(name) {
            entry.uses += 1;
        }
        name
    }

    pub(crate) fn release(&mut self, name: Name) {
        let Some(entry) = self.entries.get_mut(name.get()) else {
            return;
        };
        entry.uses = entry.uses.saturating_sub(1);
        if entry.uses > 0 {
            return;
        }
        let hash = self.hasher.hash_one(entry.name.as_str());
        if let Ok(found) = self.by_name.find_entry(hash, |other| *other == name) {
            found.remove();
        }
        // The buffer of a long name is not reused.
        if entry.name.capacity() > KEPT {
            entry.name = String::new();
        }
        self.free.push(name);
    }

    #[inline]
    pub(crate) fn is(&self, name: impl Into<Option<Name>>, text: &str) -> bool {
        #[cfg(test)]
        COMPARISONS.with(|count| count.set(count.get() + 1));
        let entry = self.entries.get(Name::index_of(name.into()));
        entry.is_some_and(|entry| entry.name == text)
    }

    /// Text of a name; empty without one.
    pub(crate) fn text(&self, name: impl Into<Option<Name>>) -> &str {
        let entry = name.into().and_then(|name| self.entries.get(name.get()));
        entry.map_or("", |entry| entry.name.as_str())
    }

    /// Returns the index of the name if it is in use.
    pub(crate) fn known(&self, text: &str) -> Option<Name> {
        self.find(self.hasher.hash_one(text), text)
    }

    /// Bytes that a reference to a name of this length is charged with.
    pub(crate) fn cost(len: usize) -> usize {
        // The buffer and the entry in the index.
        len.max(24) + size_of::<Entry>() + 2 * size_of::<Name>()
    }

    #[cfg(test)]
    pub(crate) fn len(&self) -> usize {
        self.by_name.len()
    }

    fn find(&self, hash: u64, text: &str) -> Option<Name> {
        self.by_name
            .find(hash, |name| self.is(*name, text))
            .copied()
    }

    fn entry(&mut self, name: Name) -> Option<&mut Entry> {
        self.entries.get_mut(name.get())
    }
}

/// A hash of a name. Names are small numbers that [`Names`] gives out, so it needs no key.
pub(crate) fn spread(name: Name) -> u64 {
    (name.get() as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_is_kept_while_it_has_references() {
        let mut names = Names::new(RandomState::new());
        let alice = names.acquire("alice");
        assert_eq!(names.acquire("alice"), alice);
        let bob = names.acquire("bob");
        assert_ne!(bob, alice);
        names.release(alice);
        assert_eq!(names.known("alice"), Some(alice));
        names.release(alice);
        assert_eq!(names.known("alice"), None);
        assert_eq!(names.acquire("carol"), alice, "its entry is reused");
        assert!(names.is(alice, "carol") && names.is(bob, "bob"));
        assert_eq!(names.len(), 2);
    }

    #[test]
    fn a_reference_in_use_is_counted() {
        let mut names = Names::new(RandomState::new());
        names.acquire("alice");
        let bob = names.acquire("bob");
        assert_eq!(names.acquire_again(bob), bob);
        names.release(bob);
        assert_eq!(names.known("bob"), Some(bob));
        names.release(bob);
        assert_eq!(names.known("bob"), None);
        assert_eq!(names.len(), 1);
    }

    #[test]
    fn a_reference_is_charged_with_its_text_and_its_entries() {
        for (len, charged) in [(0, 64), (24, 64), (25, 65), (4_096, 4_136)] {
            assert_eq!(Names::cost(len), charged, "{len}");
        }
    }

    #[test]
    fn buffers_of_long_names_are_not_kept() {
        for (len, is_reused) in [(40, true), (64, true), (65, false), (1_000, false)] {
            let mut names = Names::new(RandomState::new());
            let name = names.acquire(&"x".repeat(len));
            names.release(name);
            let capacity = names.entries[name.get()].name.capacity();
            assert_eq!(capacity >= len, is_reused, "{len}: {capacity}");
        }
    }
}
