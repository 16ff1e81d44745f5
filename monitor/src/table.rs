//! The table of conversations: indexed by identifier, and listed in the order of their last message.

use std::hash::{BuildHasher, RandomState};

use hashbrown::HashTable;
use smallvec::SmallVec;

use crate::conversation::{Conversation, NONE};

/// A list of conversations.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum List {
    /// Conversations that are not over.
    Open = 0,
    /// Conversations that are over.
    Ended = 1,
}

/// Precision of the order of the lists, in milliseconds. Moving a conversation changes two others. For
/// every message, this would be the largest cost of a check.
const PRECISION: u64 = 1_000;

/// Conversations in slots. A free slot is reused without allocating.
#[derive(Debug)]
pub(crate) struct Table {
    slots: Vec<Slot>,
    free: Vec<u32>,
    by_id: HashTable<u32>,
    hasher: RandomState,
    ends: [Ends; 2],
    len: usize,
}

#[derive(Debug)]
pub(crate) struct Slot {
    pub(crate) conversation: Conversation,
    /// Number of conversations that have used the slot.
    pub(crate) generation: u32,
    /// Time of the last message, in milliseconds since 1970.
    pub(crate) touched: u64,
    /// First conversation embedded in this one.
    pub(crate) child: u32,
    /// Next conversation with the same parent.
    pub(crate) sibling: u32,
    pub(crate) parent: u32,
    used: bool,
    list: List,
    /// Value of `touched` when the conversation got its position in the list.
    listed: u64,
    older: u32,
    newer: u32,
}

#[derive(Debug, Clone, Copy)]
struct Ends {
    oldest: u32,
    newest: u32,
}

impl Table {
    pub(crate) fn new(hasher: RandomState) -> Self {
        let none = Ends {
            oldest: NONE,
            newest: NONE,
        };
        Self {
            slots: Vec::new(),
            free: Vec::new(),
            by_id: HashTable::new(),
            hasher,
            ends: [none; 2],
            len: 0,
        }
    }

    /// Number of conversations, including embedded ones.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    #[inline]
    pub(crate) fn find(&self, id: &str) -> Option<u32> {
        let same = |at: &u32| {
            self.slot(*at)
                .is_some_and(|slot| slot.conversation.id == id)
        };
        self.by_id.find(self.hasher.hash_one(id), same).copied()
    }

    pub(crate) fn slot(&self, at: u32) -> Option<&Slot> {
        self.slots.get(at as usize).filter(|slot| slot.used)
    }

    pub(crate) fn slot_mut(&mut self, at: u32) -> Option<&mut Slot> {
        self.slots.get_mut(at as usize).filter(|slot| slot.used)
    }

    pub(crate) fn oldest(&self, list: List) -> Option<u32> {
        Some(self.ends[list as usize].oldest).filter(|at| *at != NONE)
    }

    /// Inserts a new conversation, with a parent or [`NONE`].
    pub(crate) fn insert(&mut self, id: &str, parent: u32, machine: u16, now: u64) -> u32 {
        let at = self.free_slot(id);
        if let Some(slot) = self.slots.get_mut(at as usize) {
            slot.used = true;
            slot.generation = slot.generation.wrapping_add(1);
            slot.touched = now;
            (slot.child, slot.sibling, slot.parent) = (NONE, NONE, parent);
            slot.conversation.machine = machine;
        }
        self.len += 1;
        if parent == NONE {
            let (slots, hasher) = (&self.slots, &self.hasher);
            self.by_id.insert_unique(hasher.hash_one(id), at, |at| {
                let slot = slots.get(*at as usize);
                hasher.hash_one(slot.map_or("", |slot| slot.conversation.id.as_str()))
            });
            self.append(at, List::Open);
        } else {
            let first = self.slot(parent).map_or(NONE, |slot| slot.child);
            if let Some(slot) = self.slot_mut(at) {
                slot.sibling = first;
            }
            if let Some(slot) = self.slot_mut(parent) {
                slot.child = at;
            }
        }
        at
    }

    fn free_slot(&mut self, id: &str) -> u32 {
        if let Some(at) = self.free.pop() {
            if let Some(slot) = self.slots.get_mut(at as usize) {
                slot.conversation.id.clear();
                slot.conversation.id.push_str(id);
            }
            return at;
        }
        self.slots.push(Slot {
            conversation: Conversation {
                id: id.to_owned(),
                machine: 0,
                initiator: NONE,
                parties: SmallVec::new(),
                bound: SmallVec::new(),
                joined: false,
                reply_to: Vec::new(),
                unnamed: None,
            },
            generation: 0,
            touched: 0,
            child: NONE,
            sibling: NONE,
            parent: NONE,
            used: false,
            list: List::Open,
            listed: 0,
            older: NONE,
            newer: NONE,
        });
        u32::try_from(self.slots.len() - 1).unwrap_or(NONE)
    }

    /// Updates the time and the list of a main conversation.
    pub(crate) fn touch(&mut self, at: u32, list: List, now: u64) {
        let Some(slot) = self.slot_mut(at) else {
            return;
        };
        slot.touched = now;
        if slot.list == list && now < slot.listed.saturating_add(PRECISION) {
            return;
        }
        self.unlink(at);
        self.append(at, list);
    }

    /// Frees a slot without children. The caller must release its names first.
    pub(crate) fn remove(&mut self, at: u32) {
        let Some(slot) = self.slot(at) else {
            return;
        };
        let parent = slot.parent;
        if parent == NONE {
            let hash = self.hasher.hash_one(slot.conversation.id.as_str());
            if let Ok(found) = self.by_id.find_entry(hash, |other| *other == at) {
                found.remove();
            }
            self.unlink(at);
        } else {
            self.leave_parent(at, parent);
        }
        if let Some(slot) = self.slots.get_mut(at as usize) {
            slot.used = false;
            let conversation = &mut slot.conversation;
            // Large buffers are not kept for reuse.
            if conversation.id.capacity() > 256 {
                conversation.id = String::new();
            }
            conversation.parties = SmallVec::new();
            conversation.bound = SmallVec::new();
            conversation.joined = false;
            conversation.reply_to = Vec::new();
            conversation.unnamed = None;
        }
        self.free.push(at);
        self.len -= 1;
    }

    fn leave_parent(&mut self, at: u32, parent: u32) {
        let next = self.slot(at).map_or(NONE, |slot| slot.sibling);
        let mut before = None;
        let mut current = self.slot(parent).map_or(NONE, |slot| slot.child);
        while current != NONE && current != at {
            before = Some(current);
            current = self.slot(current).map_or(NONE, |slot| slot.sibling);
        }
        match before {
            None => {
                if let Some(slot) = self.slot_mut(parent) {
                    slot.child = next;
                }
            }
            Some(before) => {
                if let Some(slot) = self.slot_mut(before) {
                    slot.sibling = next;
                }
            }
        }
    }

    fn append(&mut self, at: u32, list: List) {
        let newest = self.ends[list as usize].newest;
        if let Some(slot) = self.slot_mut(at) {
            (slot.list, slot.older, slot.newer) = (list, newest, NONE);
            slot.listed = slot.touched;
        }
        match self.slot_mut(newest) {
            Some(slot) => slot.newer = at,
            None => self.ends[list as usize].oldest = at,
        }
        self.ends[list as usize].newest = at;
    }

    fn unlink(&mut self, at: u32) {
        let Some(&Slot {
            list, older, newer, ..
        }) = self.slot(at)
        else {
            return;
        };
        match self.slot_mut(older) {
            Some(slot) => slot.newer = newer,
            None => self.ends[list as usize].oldest = newer,
        }
        match self.slot_mut(newer) {
            Some(slot) => slot.older = older,
            None => self.ends[list as usize].newest = older,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn order(table: &Table, list: List) -> Vec<String> {
        let mut names = Vec::new();
        let mut at = table.oldest(list);
        while let Some(slot) = at.and_then(|at| table.slot(at)) {
            names.push(slot.conversation.id.clone());
            at = Some(slot.newer);
        }
        names
    }

    #[test]
    fn conversations_are_listed_by_age_and_slots_are_reused() {
        let mut table = Table::new(RandomState::new());
        let [a, b, c] = ["a", "b", "c"].map(|id| table.insert(id, NONE, 0, 1));
        assert_eq!(order(&table, List::Open), ["a", "b", "c"]);
        table.touch(a, List::Open, 2_000);
        assert_eq!(order(&table, List::Open), ["b", "c", "a"]);
        table.touch(c, List::Ended, 3_000);
        table.touch(a, List::Ended, 4_000);
        assert_eq!(order(&table, List::Open), ["b"]);
        assert_eq!(order(&table, List::Ended), ["c", "a"]);
        table.touch(c, List::Open, 5_000);
        assert_eq!(order(&table, List::Open), ["b", "c"]);
        table.touch(b, List::Open, 5_500);
        assert_eq!(order(&table, List::Open), ["c", "b"]);
        table.touch(c, List::Open, 5_999);
        assert_eq!(order(&table, List::Open), ["c", "b"], "within a second");
        table.touch(c, List::Open, 6_000);
        assert_eq!(order(&table, List::Open), ["b", "c"]);
        table.remove(b);
        assert_eq!((table.find("b"), table.find("c")), (None, Some(c)));
        assert_eq!(table.insert("d", NONE, 0, 6_000), b);
        assert_eq!(order(&table, List::Open), ["c", "d"]);
        assert_eq!(table.len(), 3);
    }

    #[test]
    fn buffers_of_long_ids_are_not_kept() {
        for (len, kept) in [(200, true), (256, true), (257, false), (1_000, false)] {
            let mut table = Table::new(RandomState::new());
            let at = table.insert(&"x".repeat(len), NONE, 0, 1);
            table.remove(at);
            let left = table.slots[at as usize].conversation.id.capacity();
            assert_eq!(left >= len, kept, "{len}: {left}");
        }
    }

    #[test]
    fn embedded_conversations_are_linked_to_their_parent() {
        let mut table = Table::new(RandomState::new());
        let main = table.insert("main", NONE, 0, 1);
        let children = [0; 3].map(|_| table.insert("main", main, 1, 1));
        let chain = |table: &Table| {
            let mut found = Vec::new();
            let mut at = table.slot(main).unwrap().child;
            while at != NONE {
                found.push(at);
                at = table.slot(at).unwrap().sibling;
            }
            found
        };
        assert_eq!(chain(&table), [children[2], children[1], children[0]]);
        table.remove(children[1]);
        assert_eq!(chain(&table), [children[2], children[0]]);
        table.remove(children[2]);
        table.remove(children[0]);
        assert_eq!(chain(&table), Vec::<u32>::new());
        assert_eq!(table.find("main"), Some(main));
    }
}
