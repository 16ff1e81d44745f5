//! The index of conversations: a hash table with eight bytes per place.
//!
//! Linear probing reads one cache line for most searches. A table with separate control bytes reads two, and
//! the address of the second line depends on the first.

use crate::conversation::ids::SlotIndex;

/// Hash table of conversations by a part of the fingerprint of their identifier. Several entries may have
/// one tag.
///
/// An insertion displaces entries that are nearer to their homes than the new one is to its own (Robin Hood
/// hashing). So a search ends early, also in a table that is nearly full.
#[derive(Debug, Default)]
pub(crate) struct Index {
    /// None, or a power of two.
    places: Vec<Indexed>,
    len: usize,
}

/// A tag and the slot of a conversation; none for a free place.
#[derive(Debug, Clone, Copy)]
struct Indexed {
    tag: u32,
    at: Option<SlotIndex>,
}

const FREE: Indexed = Indexed { tag: 0, at: None };

/// Number of places of the smallest table.
const FIRST: usize = 16;

impl Index {
    /// Bytes of an entry in a table that may be half empty.
    pub(crate) const COST: usize = 2 * size_of::<Indexed>();

    /// The slots of the entries with this tag.
    #[inline]
    pub(crate) fn find_all(&self, tag: u32) -> impl Iterator<Item = SlotIndex> + '_ {
        self.run_of(tag)
            .filter(move |(_, one)| one.tag == tag)
            .filter_map(|(_, one)| one.at)
    }

    pub(crate) fn insert(&mut self, tag: u32, at: SlotIndex) {
        if self.len >= self.places.len() / 8 * 7 {
            let double = (self.places.len() * 2).max(FIRST);
            let before = std::mem::replace(&mut self.places, vec![FREE; double]);
            for entry in before.into_iter().filter(|entry| entry.at.is_some()) {
                self.place(entry);
            }
        }
        self.place(Indexed { tag, at: Some(at) });
        self.len += 1;
    }

    pub(crate) fn remove(&mut self, tag: u32, at: SlotIndex) {
        let found = self.run_of(tag).find(|(_, one)| one.at == Some(at));
        let Some((mut hole, _)) = found else {
            return;
        };
        // The entries behind it move one place toward their homes.
        for _ in 0..self.places.len() {
            let next = (hole + 1) & self.mask();
            let entry = self.places.get(next).copied().unwrap_or(FREE);
            if entry.at.is_none() || self.distance(entry, next) == 0 {
                break;
            }
            self.set(hole, entry);
            hole = next;
        }
        self.set(hole, FREE);
        self.len -= 1;
    }

    /// The entries among which those with this tag are, with their places.
    #[inline]
    fn run_of(&self, tag: u32) -> impl Iterator<Item = (usize, Indexed)> + '_ {
        (0..self.places.len()).map_while(move |distance| {
            let at = (tag as usize).wrapping_add(distance) & self.mask();
            let entry = *self.places.get(at)?;
            let is_over = entry.at.is_none() || self.distance(entry, at) < distance;
            (!is_over).then_some((at, entry))
        })
    }

    fn place(&mut self, mut entry: Indexed) {
        let mut distance = 0;
        let mut at = entry.tag as usize & self.mask();
        for _ in 0..self.places.len() {
            let Some(resident) = self.places.get(at).copied() else {
                return;
            };
            if resident.at.is_none() {
                self.set(at, entry);
                return;
            }
            let of_resident = self.distance(resident, at);
            if of_resident < distance {
                self.set(at, entry);
                (entry, distance) = (resident, of_resident);
            }
            at = (at + 1) & self.mask();
            distance += 1;
        }
    }

    fn set(&mut self, at: usize, entry: Indexed) {
        if let Some(place) = self.places.get_mut(at) {
            *place = entry;
        }
    }

    /// Number of places from the home of an entry to this one.
    #[inline]
    fn distance(&self, entry: Indexed, at: usize) -> usize {
        at.wrapping_sub(entry.tag as usize) & self.mask()
    }

    #[inline]
    fn mask(&self) -> usize {
        self.places.len().wrapping_sub(1)
    }
}

#[cfg(test)]
mod tests {
    use fastrand::Rng;

    use super::*;

    /// Compares the index with a list. Few homes are used, some of them at the end of the table.
    #[test]
    fn it_has_the_entries_that_were_inserted_and_not_removed() {
        for seed in 0..50 {
            let mut rng = Rng::with_seed(seed);
            let homes = rng.u32(1..40);
            let tags: Vec<u32> = (0..60)
                .map(|_| (rng.u32(0..4) << 20).wrapping_sub(rng.u32(0..homes)))
                .collect();
            let mut index = Index::default();
            let mut entries: Vec<(u32, SlotIndex)> = Vec::new();
            for at in (0..2_000).map(SlotIndex::new) {
                if rng.bool() && !entries.is_empty() {
                    let (tag, at) = entries.swap_remove(rng.usize(..entries.len()));
                    index.remove(tag, at);
                } else {
                    let tag = tags[rng.usize(..tags.len())];
                    index.insert(tag, at);
                    entries.push((tag, at));
                }
                // Removes nothing.
                index.remove(tags[0], SlotIndex::new(1 << 20));
                assert_eq!(index.len, entries.len());
                let tag = tags[rng.usize(..tags.len())];
                let mut found: Vec<SlotIndex> = index.find_all(tag).collect();
                let expected = entries.iter().filter(|(one, _)| *one == tag);
                let mut expected: Vec<SlotIndex> = expected.map(|(_, at)| *at).collect();
                found.sort_unstable();
                expected.sort_unstable();
                assert_eq!(found, expected, "seed {seed}");
            }
        }
    }

    #[test]
    fn a_search_reads_few_places_of_a_full_table() {
        let mut rng = Rng::with_seed(1);
        let mut index = Index::default();
        let tags: Vec<u32> = (0..(1 << 14) / 8 * 7).map(|_| rng.u32(..)).collect();
        for (tag, at) in tags.iter().zip((0..).map(SlotIndex::new)) {
            index.insert(*tag, at);
        }
        assert_eq!(index.places.len(), 1 << 14);
        let read: usize = tags.iter().map(|tag| index.run_of(*tag).count()).sum();
        assert!(read < 6 * tags.len(), "{read} for {} searches", tags.len());
        for (tag, at) in tags.iter().zip((0..).map(SlotIndex::new)) {
            index.remove(*tag, at);
        }
        assert!(index.places.iter().all(|place| place.at.is_none()));
    }
}
