//! The memory of a monitor: the bytes of its conversations, and the conversations that it removes.

use std::hash::BuildHasher;

use smallvec::SmallVec;

use crate::check::outcome::Denied;
use crate::conversation::ids::{Name, SlotIndex};
use crate::conversation::table::{List, Listed};
use crate::limits::MAX_ALIKE;
use crate::monitor::Monitor;
use crate::verdict::ViolationKind as Kind;

impl Monitor {
    /// Charges the peer of a conversation, and evicts others if it has grown beyond a limit.
    pub(crate) fn charge(&mut self, at: SlotIndex) {
        if self.table.charge(at)
            && let Some(slot) = self.table.slot(at)
        {
            let main = slot.parent.unwrap_or(at);
            self.evict(Some(main), self.table.peer(at), 0);
        }
    }

    /// Removes conversations until the limits hold, with so many more of this peer. The conversation `keep`
    /// is kept.
    pub(crate) fn evict(&mut self, keep: Option<SlotIndex>, peer: Option<Name>, more: usize) {
        loop {
            let full = self.table.len() + more > self.limits.conversations.max(1);
            let heavy = self.table.bytes() > self.limits.bytes;
            let (count, held) = self.table.of_peer(peer);
            let over = peer.is_some()
                && (held > self.limits.share_of_bytes()
                    || count + more > self.limits.share_of_conversations());
            if !full && !heavy && !over {
                return;
            }
            let own = |list| self.table.oldest_but(keep, Listed::Peer(peer), list);
            let any = |list| self.table.oldest_but(keep, Listed::All, list);
            let own = || own(List::Ended).or_else(|| own(List::Open));
            let any = || any(List::Ended).or_else(|| any(List::Open));
            let oldest = match over {
                true => own().or_else(|| any().filter(|_| full || heavy)),
                false => any(),
            };
            let Some(at) = oldest else {
                return;
            };
            let slot = self.table.slot(at);
            if slot.is_some_and(|slot| slot.list() == List::Open) {
                self.forgotten += 1;
            }
            self.forget(at);
        }
    }

    /// Removes the least recently active conversation with this identifier, if there are too many of
    /// them. Those that the monitored agent began stay.
    pub(crate) fn evict_alike(&mut self, id: &str) -> Result<(), Denied> {
        let alike = self.table.find_all(id).map(|(at, _)| at);
        let alike: SmallVec<[SlotIndex; MAX_ALIKE]> = alike.collect();
        if alike.len() < MAX_ALIKE {
            return Ok(());
        }
        let slots = alike
            .iter()
            .filter_map(|at| Some((*at, self.table.slot(*at)?)));
        let of_peers =
            slots.filter(|(at, _)| self.table.peer(*at).is_some() || self.agent.is_none());
        let oldest = of_peers.min_by_key(|(at, slot)| (slot.touched, self.table.serial(*at)));
        match oldest.map(|(at, _)| at) {
            Some(at) => {
                self.forgotten += 1;
                self.forget(at);
                Ok(())
            }
            None => Err(Denied::Refused(Kind::TooMany, None)),
        }
    }

    /// Removes a main conversation with its embedded conversations before its time. Messages to it may
    /// still come.
    pub(crate) fn forget(&mut self, at: SlotIndex) {
        if self.table.slot(at).is_some() {
            let id = self.hasher.hash_one(self.table.id(at));
            self.removed.add(id);
        }
        self.remove_all(at);
    }

    /// Removes a main conversation with its embedded conversations, without remembering that the
    /// monitor had it. A further message to it is a violation.
    pub(crate) fn remove_all(&mut self, at: SlotIndex) {
        while let Some(slot) = self.table.slot(at) {
            let Some(child) = slot.child else {
                break;
            };
            self.remove(child);
        }
        self.remove(at);
    }

    pub(crate) fn remove(&mut self, at: SlotIndex) {
        if let Some(slot) = self.table.slot(at) {
            let conversation = &slot.conversation;
            let peers = conversation.parties.iter().filter_map(|party| party.peer);
            let bound = conversation.bound.iter().map(|bound| bound.agent);
            let delegates = conversation.delegates().iter().map(|(_, agent)| *agent);
            let rare = conversation.rare.as_deref().into_iter();
            let asked = rare.flat_map(|rare| rare.asked.iter().map(|asked| asked.agent));
            let named = peers
                .chain(bound)
                .chain(conversation.reply_to().iter().copied())
                .chain(delegates)
                .chain(asked)
                .chain(conversation.initiator)
                .chain(self.table.peer(at));
            for name in named {
                self.names.release(name);
            }
        }
        self.table.remove(at);
    }
}
