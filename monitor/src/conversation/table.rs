//! The table of conversations: indexed by identifier, listed in the order of their last message, and
//! charged to the peers that began them.
//!
//! Several conversations may have one identifier, if their agents differ.

use std::hash::{BuildHasher, RandomState};

use hashbrown::HashTable;
use siphasher::sip128::SipHasher13;

use crate::conversation::Conversation;
use crate::conversation::ids::{Name, SlotIndex};
use crate::conversation::index::Index;
use crate::conversation::names::spread;
use crate::protocol::index::MachineIndex;

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
const PRECISION: u16 = 1_000;

/// The conversations among which a list is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Listed {
    All,
    /// Those of a peer; none for the monitored agent.
    Peer(Option<Name>),
}

/// Conversations in slots. A free slot is reused without allocating.
#[derive(Debug)]
pub(crate) struct Table {
    slots: Slots,
    /// As many as slots.
    cold: Vec<Cold>,
    free: Vec<SlotIndex>,
    by_id: Index,
    keys: [u64; 2],
    /// The lists of all conversations.
    ends: [Ends; 2],
    accounts: HashTable<Account>,
    len: usize,
    bytes: usize,
    begun: u64,
}

/// A fingerprint of an identifier. It has 96 bits and a secret random key, so that equal fingerprints are
/// equal identifiers: a search does not read the text. The index has the tag, and the slot the rest.
#[derive(Debug, Clone, Copy)]
struct Fingerprint {
    tag: u32,
    rest: u64,
}

/// The conversations of one peer.
#[derive(Debug)]
struct Account {
    peer: Option<Name>,
    len: usize,
    bytes: usize,
    ends: [Ends; 2],
}

/// A conversation with its place in the table.
///
/// With many conversations, misses of the cache are most of the time of a check. So a slot has what every
/// message needs, in two cache lines. The rest is in [`Cold`], and behind pointers that an ordinary
/// message does not follow.
#[derive(Debug)]
#[repr(C, align(64))]
pub(crate) struct Slot {
    used: bool,
    list: List,
    /// Time from the last change of its position in the lists to the last message, in milliseconds. It is
    /// less than [`PRECISION`].
    since_listed: u16,
    /// Number of conversations that have used the slot.
    pub(crate) generation: u32,
    /// First conversation embedded in this one.
    pub(crate) child: Option<SlotIndex>,
    pub(crate) parent: Option<SlotIndex>,
    /// Time of the last message, in milliseconds of the monotonic clock.
    pub(crate) touched: u64,
    /// See [`Fingerprint`]; 0 for an embedded conversation.
    id_rest: u64,
    pub(crate) conversation: Conversation,
}

/// The parts that only the beginning and the end of a conversation need.
#[derive(Debug)]
struct Cold {
    id: String,
    /// Number of conversations that began before this one.
    serial: u64,
    /// Next conversation with the same parent.
    sibling: Option<SlotIndex>,
    /// The peer to which the conversation belongs; none for the monitored agent.
    peer: Option<Name>,
    /// Neighbors in the list of all conversations and in that of the peer.
    links: [Link; 2],
}

/// Slots in chunks. A growing number of them is not copied.
#[derive(Debug, Default)]
struct Slots {
    /// All but the last one are full.
    chunks: Vec<Vec<Slot>>,
}

/// Number of slots in a chunk.
const CHUNK: usize = 256;

impl Slots {
    fn get(&self, at: SlotIndex) -> Option<&Slot> {
        let at = at.get();
        self.chunks.get(at / CHUNK)?.get(at % CHUNK)
    }

    fn get_mut(&mut self, at: SlotIndex) -> Option<&mut Slot> {
        let at = at.get();
        self.chunks.get_mut(at / CHUNK)?.get_mut(at % CHUNK)
    }

    fn iter(&self) -> impl Iterator<Item = &Slot> {
        self.chunks.iter().flatten()
    }

    /// Adds a slot. Returns its index.
    fn push(&mut self, slot: Slot) -> SlotIndex {
        if self.chunks.last().is_none_or(|last| last.len() == CHUNK) {
            self.chunks.push(Vec::new());
        }
        let full = (self.chunks.len() - 1) * CHUNK;
        let mut len = 0;
        if let Some(last) = self.chunks.last_mut() {
            len = last.len();
            last.push(slot);
        }
        SlotIndex::new(full + len)
    }
}

#[derive(Debug, Clone, Copy)]
struct Link {
    older: Option<SlotIndex>,
    newer: Option<SlotIndex>,
}

const UNLINKED: Link = Link {
    older: None,
    newer: None,
};

/// Index of the link in the list of all conversations.
const ALL: usize = 0;

/// Index of the link in the list of the peer.
const PEERS: usize = 1;

#[derive(Debug, Clone, Copy)]
struct Ends {
    oldest: Option<SlotIndex>,
    newest: Option<SlotIndex>,
}

const EMPTY: Ends = Ends {
    oldest: None,
    newest: None,
};

impl Slot {
    /// Bytes of a conversation with its entry in the index, which may be half empty, but without its
    /// allocations.
    pub(crate) const COST: usize = size_of::<Self>() + size_of::<Cold>() + Index::COST;

    pub(crate) fn list(&self) -> List {
        self.list
    }

    /// Bytes of the conversation.
    #[inline]
    fn cost(&self) -> u32 {
        let cost = Self::COST + self.conversation.allocated();
        u32::try_from(cost).unwrap_or(u32::MAX)
    }

    /// Whether the peer of the conversation is charged with its present size.
    #[inline]
    pub(crate) fn is_charged(&self) -> bool {
        self.conversation.cost == self.cost()
    }

    /// Updates the time of a main conversation, if it keeps its place in the lists. Returns whether it does.
    pub(crate) fn touch(&mut self, list: List, now: u64) -> bool {
        let listed = self.touched.saturating_sub(u64::from(self.since_listed));
        // The clock may have been set back.
        let since = u16::try_from(now.saturating_sub(listed)).unwrap_or(u16::MAX);
        let stays = self.list == list && since < PRECISION;
        if stays {
            (self.touched, self.since_listed) = (now, since);
        }
        stays
    }
}

impl Table {
    pub(crate) fn new(random: &RandomState) -> Self {
        Self {
            slots: Slots::default(),
            cold: Vec::new(),
            free: Vec::new(),
            by_id: Index::default(),
            keys: ["first", "second"].map(|key| random.hash_one(key)),
            ends: [EMPTY; 2],
            accounts: HashTable::new(),
            len: 0,
            bytes: 0,
            begun: 0,
        }
    }

    /// Number of conversations, including embedded ones.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Bytes of all conversations.
    pub(crate) fn bytes(&self) -> usize {
        self.bytes
    }

    /// Number and bytes of the conversations of a peer.
    pub(crate) fn of_peer(&self, peer: Option<Name>) -> (usize, usize) {
        let account = self
            .accounts
            .find(spread_peer(peer), |one| one.peer == peer);
        account.map_or((0, 0), |account| (account.len, account.bytes))
    }

    /// The conversations with this identifier, at most [`MAX_ALIKE`](crate::limits::MAX_ALIKE).
    #[inline]
    pub(crate) fn find_all<'t>(
        &'t self,
        id: &str,
    ) -> impl Iterator<Item = (SlotIndex, &'t Slot)> + use<'t> {
        let Fingerprint { tag, rest } = self.fingerprint(id);
        let alike = self.by_id.find_all(tag);
        let alike = alike.filter_map(|at| Some((at, self.slot(at)?)));
        alike.filter(move |(_, slot)| slot.id_rest == rest)
    }

    fn fingerprint(&self, id: &str) -> Fingerprint {
        let [first, second] = self.keys;
        let hasher = SipHasher13::new_with_keys(first, second);
        let found = hasher.hash(id.as_bytes());
        Fingerprint {
            tag: u32::try_from(found.h1 >> 32).unwrap_or(0),
            rest: found.h2,
        }
    }

    #[cfg(test)]
    pub(crate) fn find(&self, id: &str) -> Option<SlotIndex> {
        self.find_all(id).next().map(|(at, _)| at)
    }

    /// The main conversations: the time of the last message, the serial number and the slot.
    pub(crate) fn mains(&self) -> impl Iterator<Item = (u64, u64, SlotIndex)> + '_ {
        let used = (0..)
            .map(SlotIndex::new)
            .zip(self.slots.iter())
            .filter(|(_, slot)| slot.used);
        used.filter(|(_, slot)| slot.parent.is_none())
            .map(|(at, slot)| (slot.touched, self.serial(at), at))
    }

    pub(crate) fn slot(&self, at: SlotIndex) -> Option<&Slot> {
        self.slots.get(at).filter(|slot| slot.used)
    }

    pub(crate) fn slot_mut(&mut self, at: SlotIndex) -> Option<&mut Slot> {
        self.slots.get_mut(at).filter(|slot| slot.used)
    }

    fn cold(&self, at: SlotIndex) -> Option<&Cold> {
        self.cold.get(at.get())
    }

    fn cold_mut(&mut self, at: SlotIndex) -> Option<&mut Cold> {
        self.cold.get_mut(at.get())
    }

    /// Identifier of a conversation.
    pub(crate) fn id(&self, at: SlotIndex) -> &str {
        self.cold(at).map_or("", |cold| &cold.id)
    }

    /// Number of conversations that began before this one.
    pub(crate) fn serial(&self, at: SlotIndex) -> u64 {
        self.cold(at).map_or(0, |cold| cold.serial)
    }

    /// The next conversation with the same parent, if there is one.
    pub(crate) fn sibling(&self, at: SlotIndex) -> Option<SlotIndex> {
        self.cold(at)?.sibling
    }

    /// The peer to which a conversation belongs, and none for the monitored agent.
    pub(crate) fn peer(&self, at: SlotIndex) -> Option<Name> {
        self.cold(at)?.peer
    }

    pub(crate) fn oldest(&self, list: List) -> Option<SlotIndex> {
        self.ends[list as usize].oldest
    }

    /// The least recently active conversation of a peer in a list.
    pub(crate) fn oldest_of(&self, peer: Option<Name>, list: List) -> Option<SlotIndex> {
        let account = self
            .accounts
            .find(spread_peer(peer), |one| one.peer == peer);
        account?.ends[list as usize].oldest
    }

    /// The least recently active conversation in a list except `keep`. A list is
    /// not sorted within [`PRECISION`], so `keep` may be the first in it.
    pub(crate) fn oldest_but(
        &self,
        keep: Option<SlotIndex>,
        of: Listed,
        list: List,
    ) -> Option<SlotIndex> {
        let (oldest, kind) = match of {
            Listed::Peer(peer) => (self.oldest_of(peer, list)?, PEERS),
            Listed::All => (self.oldest(list)?, ALL),
        };
        if Some(oldest) != keep {
            return Some(oldest);
        }
        self.cold(oldest)?.links[kind].newer
    }

    /// Inserts a new conversation of this peer, with a parent or none. The caller holds a reference
    /// to the name of the peer for it.
    pub(crate) fn insert(
        &mut self,
        id: &str,
        parent: Option<SlotIndex>,
        peer: Option<Name>,
        machine: MachineIndex,
        now: u64,
    ) -> SlotIndex {
        let at = self.free_slot();
        if let Some(slot) = self.slots.get_mut(at) {
            slot.used = true;
            slot.generation = slot.generation.wrapping_add(1);
            (slot.touched, slot.id_rest) = (now, 0);
            (slot.child, slot.parent) = (None, parent);
            slot.conversation.machine = machine;
        }
        if let Some(cold) = self.cold.get_mut(at.get()) {
            cold.id.push_str(id);
            let capacity = cold.id.capacity();
            (cold.serial, cold.sibling, cold.peer) = (self.begun, None, peer);
            if let Some(slot) = self.slots.get_mut(at) {
                slot.conversation.charge(capacity);
            }
        }
        self.len += 1;
        self.begun += 1;
        self.account(peer).len += 1;
        if let Some(parent) = parent {
            let first = self.slot(parent).and_then(|slot| slot.child);
            if let Some(cold) = self.cold_mut(at) {
                cold.sibling = first;
            }
            if let Some(slot) = self.slot_mut(parent) {
                slot.child = Some(at);
            }
        } else {
            let Fingerprint { tag, rest } = self.fingerprint(id);
            if let Some(slot) = self.slots.get_mut(at) {
                slot.id_rest = rest;
            }
            self.by_id.insert(tag, at);
            self.append(at, List::Open);
        }
        self.charge(at);
        at
    }

    /// Charges the peer of a conversation with its present size. Returns whether it has grown.
    pub(crate) fn charge(&mut self, at: SlotIndex) -> bool {
        let Some(slot) = self.slot_mut(at) else {
            return false;
        };
        let stored = slot.cost();
        let before = std::mem::replace(&mut slot.conversation.cost, stored);
        if stored == before {
            return false;
        }
        let [cost, before] = [stored, before].map(|bytes| bytes as usize);
        let peer = self.peer(at);
        self.bytes = (self.bytes + cost).saturating_sub(before);
        let account = self.account(peer);
        account.bytes = (account.bytes + cost).saturating_sub(before);
        cost > before
    }

    fn account(&mut self, peer: Option<Name>) -> &mut Account {
        let entry = self.accounts.entry(
            spread_peer(peer),
            |one| one.peer == peer,
            |one| spread_peer(one.peer),
        );
        entry
            .or_insert(Account {
                peer,
                len: 0,
                bytes: 0,
                ends: [EMPTY; 2],
            })
            .into_mut()
    }

    fn free_slot(&mut self) -> SlotIndex {
        if let Some(at) = self.free.pop() {
            return at;
        }
        self.cold.push(Cold {
            id: String::new(),
            serial: 0,
            sibling: None,
            peer: None,
            links: [UNLINKED; 2],
        });
        self.slots.push(Slot {
            used: false,
            list: List::Open,
            since_listed: 0,
            generation: 0,
            child: None,
            parent: None,
            touched: 0,
            id_rest: 0,
            conversation: Conversation::unused(),
        })
    }

    /// Updates the time and the list of a main conversation.
    pub(crate) fn touch(&mut self, at: SlotIndex, list: List, now: u64) {
        let Some(slot) = self.slot_mut(at) else {
            return;
        };
        if slot.touch(list, now) {
            return;
        }
        slot.touched = now;
        self.unlink(at);
        self.append(at, list);
    }

    /// Frees a slot without children. The caller must release its names first.
    pub(crate) fn remove(&mut self, at: SlotIndex) {
        let Some(slot) = self.slot(at) else {
            return;
        };
        let (parent, cost) = (slot.parent, slot.conversation.cost as usize);
        let peer = self.peer(at);
        if let Some(parent) = parent {
            self.leave_parent(at, parent);
        } else {
            let Fingerprint { tag, .. } = self.fingerprint(self.id(at));
            self.by_id.remove(tag, at);
            self.unlink(at);
        }
        if let Some(slot) = self.slots.get_mut(at) {
            slot.used = false;
            slot.conversation.clear();
        }
        if let Some(cold) = self.cold.get_mut(at.get()) {
            cold.id.clear();
            // Large buffers are not kept for reuse.
            if cold.id.capacity() > KEPT {
                cold.id = String::new();
            }
        }
        self.free.push(at);
        self.len -= 1;
        self.bytes = self.bytes.saturating_sub(cost);
        let account = self.account(peer);
        account.len = account.len.saturating_sub(1);
        account.bytes = account.bytes.saturating_sub(cost);
        if account.len == 0
            && let Ok(found) = self
                .accounts
                .find_entry(spread_peer(peer), |one| one.peer == peer)
        {
            found.remove();
        }
    }

    fn leave_parent(&mut self, at: SlotIndex, parent: SlotIndex) {
        let next = self.sibling(at);
        let mut before = None;
        let mut current = self.slot(parent).and_then(|slot| slot.child);
        while let Some(child) = current.filter(|child| *child != at) {
            before = Some(child);
            current = self.sibling(child);
        }
        match before {
            None => {
                if let Some(slot) = self.slot_mut(parent) {
                    slot.child = next;
                }
            }
            Some(before) => {
                if let Some(cold) = self.cold_mut(before) {
                    cold.sibling = next;
                }
            }
        }
    }

    fn append(&mut self, at: SlotIndex, list: List) {
        let Some(slot) = self.slot_mut(at) else {
            return;
        };
        slot.list = list;
        slot.since_listed = 0;
        let peer = self.peer(at);
        for kind in [ALL, PEERS] {
            let newest = self.ends_of(kind, peer, list).newest;
            if let Some(cold) = self.cold_mut(at) {
                cold.links[kind] = Link {
                    older: newest,
                    newer: None,
                };
            }
            match newest.and_then(|newest| self.cold_mut(newest)) {
                Some(cold) => cold.links[kind].newer = Some(at),
                None => self.ends_of(kind, peer, list).oldest = Some(at),
            }
            self.ends_of(kind, peer, list).newest = Some(at);
        }
    }

    fn unlink(&mut self, at: SlotIndex) {
        let Some(slot) = self.slot(at) else {
            return;
        };
        let list = slot.list;
        let Some(Cold { peer, links, .. }) = self.cold(at) else {
            return;
        };
        let (peer, links) = (*peer, *links);
        for kind in [ALL, PEERS] {
            let Link { older, newer } = links[kind];
            match older.and_then(|older| self.cold_mut(older)) {
                Some(cold) => cold.links[kind].newer = newer,
                None => self.ends_of(kind, peer, list).oldest = newer,
            }
            match newer.and_then(|newer| self.cold_mut(newer)) {
                Some(cold) => cold.links[kind].older = older,
                None => self.ends_of(kind, peer, list).newest = older,
            }
        }
    }

    fn ends_of(&mut self, kind: usize, peer: Option<Name>, list: List) -> &mut Ends {
        let ends = match kind {
            ALL => &mut self.ends,
            _ => &mut self.account(peer).ends,
        };
        &mut ends[list as usize]
    }
}

/// A hash of a peer, or of the monitored agent.
fn spread_peer(peer: Option<Name>) -> u64 {
    peer.map_or(u64::MAX, spread)
}

/// Maximum capacity of the buffer for the identifier of a free slot, in bytes.
const KEPT: usize = 128;

#[cfg(test)]
mod tests {
    use super::*;

    fn peer(number: usize) -> Option<Name> {
        Some(Name::new(number))
    }

    fn order(table: &Table, list: List) -> Vec<String> {
        let mut names = Vec::new();
        let mut at = table.oldest(list);
        while let Some(slot) = at.and_then(|at| table.slot(at)) {
            let Some(cold) = at.filter(|_| slot.used).and_then(|at| table.cold(at)) else {
                break;
            };
            names.push(cold.id.clone());
            at = cold.links[ALL].newer;
        }
        names
    }

    #[test]
    fn conversations_are_listed_by_age_and_slots_are_reused() {
        let mut table = Table::new(&RandomState::new());
        let [a, b, c] =
            ["a", "b", "c"].map(|id| table.insert(id, None, peer(7), MachineIndex::FIRST, 1));
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
        assert_eq!(
            table.insert("d", None, peer(7), MachineIndex::FIRST, 6_000),
            b
        );
        assert_eq!(order(&table, List::Open), ["c", "d"]);
        assert_eq!(table.len(), 3);
    }

    #[test]
    fn a_conversation_moves_in_its_list_at_most_once_a_second() {
        let mut table = Table::new(&RandomState::new());
        let [a, _] = ["a", "b"].map(|id| table.insert(id, None, peer(7), MachineIndex::FIRST, 1));
        for now in [400, 800, 1_000] {
            table.touch(a, List::Open, now);
            assert_eq!(order(&table, List::Open), ["a", "b"], "{now}");
            assert_eq!(table.slot(a).unwrap().touched, now);
        }
        table.touch(a, List::Open, 1_001);
        assert_eq!(order(&table, List::Open), ["b", "a"]);
        // The clock was set back, and then by hours forward.
        for now in [500, 1_499, 90_000_000] {
            table.touch(a, List::Open, now);
            assert_eq!(order(&table, List::Open), ["b", "a"], "{now}");
            assert_eq!(table.slot(a).unwrap().touched, now);
        }
    }

    #[test]
    fn each_peer_has_a_list_and_is_charged() {
        let mut table = Table::new(&RandomState::new());
        let a = table.insert("a", None, peer(1), MachineIndex::FIRST, 1);
        let b = table.insert("b", None, peer(2), MachineIndex::FIRST, 2);
        let c = table.insert("a", None, peer(1), MachineIndex::FIRST, 3);
        let child = table.insert("a", Some(c), peer(1), MachineIndex::FIRST, 3);
        assert_eq!(table.find_all("a").count(), 2);
        assert_eq!(table.oldest_of(peer(1), List::Open), Some(a));
        assert_eq!(table.oldest_of(peer(2), List::Open), Some(b));
        assert_eq!(table.oldest_of(peer(3), List::Open), None);
        table.touch(a, List::Ended, 5_000);
        assert_eq!(table.oldest_of(peer(1), List::Open), Some(c));
        assert_eq!(table.oldest_of(peer(1), List::Ended), Some(a));
        let (count, bytes) = table.of_peer(peer(1));
        assert_eq!(count, 3);
        assert_eq!(bytes + table.of_peer(peer(2)).1, table.bytes());
        table.slot_mut(a).unwrap().conversation.charge(500);
        table.charge(a);
        assert_eq!(table.of_peer(peer(1)), (3, bytes + 500));
        for at in [child, c, a, b] {
            table.remove(at);
        }
        assert_eq!((table.bytes(), table.len()), (0, 0));
        assert_eq!(table.accounts.len(), 0);
    }

    #[test]
    fn hashes_and_tags_are_spread() {
        use std::collections::HashSet;

        // The tables use the upper and the lower bits of a hash.
        let lower: HashSet<u64> = (0..256)
            .map(|name| spread(Name::new(name)) & 0xff)
            .collect();
        let upper: HashSet<u64> = (0..256).map(|name| spread(Name::new(name)) >> 57).collect();
        assert_eq!((lower.len(), upper.len()), (256, 128));
        let table = Table::new(&RandomState::new());
        let tags = (0..256).map(|number: u32| table.fingerprint(&number.to_string()).tag);
        let tags: HashSet<u32> = tags.collect();
        assert!(tags.len() > 250, "{}", tags.len());
    }

    #[test]
    fn buffers_of_long_ids_are_not_kept() {
        for (len, is_reused) in [(100, true), (128, true), (129, false), (1_000, false)] {
            let mut table = Table::new(&RandomState::new());
            let at = table.insert(&"x".repeat(len), None, peer(7), MachineIndex::FIRST, 1);
            table.remove(at);
            let capacity = table.cold[at.get()].id.capacity();
            assert_eq!(capacity >= len, is_reused, "{len}: {capacity}");
        }
    }

    #[test]
    fn what_every_message_needs_is_in_two_cache_lines() {
        use crate::conversation::Party;

        assert_eq!(size_of::<Party>(), 64);
        assert_eq!(size_of::<Slot>(), 2 * 64);
    }

    #[test]
    fn slots_are_found_in_all_chunks() {
        let mut table = Table::new(&RandomState::new());
        let ids: Vec<String> = (0..3 * CHUNK).map(|number| number.to_string()).collect();
        for (at, id) in (0..).map(SlotIndex::new).zip(&ids) {
            assert_eq!(table.insert(id, None, peer(7), MachineIndex::FIRST, 1), at);
        }
        for (at, id) in (0..).map(SlotIndex::new).zip(&ids) {
            assert_eq!(table.id(at), id);
            assert_eq!(table.find(id), Some(at));
        }
        assert!(table.slot(SlotIndex::new(ids.len())).is_none());
        assert!(table.slot(SlotIndex::new(usize::MAX)).is_none());
    }

    #[test]
    fn embedded_conversations_are_linked_to_their_parent() {
        let mut table = Table::new(&RandomState::new());
        let main = table.insert("main", None, peer(7), MachineIndex::FIRST, 1);
        let children =
            [0; 3].map(|_| table.insert("main", Some(main), peer(7), MachineIndex::new(1), 1));
        let chain = |table: &Table| {
            let mut found = Vec::new();
            let mut at = table.slot(main).unwrap().child;
            while let Some(child) = at {
                found.push(child);
                at = table.sibling(child);
            }
            found
        };
        assert_eq!(chain(&table), [children[2], children[1], children[0]]);
        table.remove(children[1]);
        assert_eq!(chain(&table), [children[2], children[0]]);
        table.remove(children[2]);
        table.remove(children[0]);
        assert_eq!(chain(&table), Vec::<SlotIndex>::new());
        assert_eq!(table.find("main"), Some(main));
    }
}
