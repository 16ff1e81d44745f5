//! Finds the conversation of a message.

use smallvec::SmallVec;

use crate::check::observed::ObservedMessage;
use crate::conversation::Conversation;
use crate::conversation::ids::SlotIndex;
use crate::conversation::table::Slot;
use crate::limits::MAX_ALIKE;
use crate::monitor::Monitor;
use crate::protocol::act::{Act, CANCEL, FAILURE, INFORM, NOT_UNDERSTOOD};
use crate::protocol::machine::{Machine, Scope, step};
use crate::protocol::role::RoleSet;

/// The part that the agents of a message take in a conversation, the least first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Rank {
    /// The sender takes no part.
    None,
    /// The sender takes part.
    Sender,
    /// The sender and a receiver take part.
    Both,
}

impl Monitor {
    /// Finds the conversation of a message among those with its identifier: the one in which sender and
    /// receiver take part. Otherwise, an agent that does not lead one of them can begin another.
    pub(crate) fn place(
        &self,
        id: &str,
        observed: &ObservedMessage<'_>,
    ) -> Option<(SlotIndex, &Slot)> {
        // One search: hashing the identifier is a large part of a check.
        let mut found = self.table.find_all(id);
        let first = found.next()?;
        let fits_role = |slot: &Slot| self.fits_role(&slot.conversation, observed);
        // A service stands for the agent that did not get a message.
        let sender = observed.undelivered_to.unwrap_or(observed.sender);
        let Some(second) = found.next() else {
            // Nearly all identifiers have one conversation.
            let (_, slot) = first;
            if fits_role(slot) || self.rank(slot, sender, observed) == Rank::Both {
                return Some(first);
            }
            return self.place_among(id, &[first], observed);
        };
        let alike = [first, second].into_iter().chain(found);
        let alike: SmallVec<[(SlotIndex, &Slot); MAX_ALIKE]> = alike.collect();
        let local = alike.iter().find(|(_, slot)| fits_role(slot)).copied();
        local.or_else(|| self.place_among(id, &alike, observed))
    }

    /// Finds the conversation of a message among those with its identifier, when the roles of the agents do not
    /// select one.
    #[inline(never)]
    fn place_among<'s>(
        &self,
        id: &str,
        alike: &[(SlotIndex, &'s Slot)],
        observed: &ObservedMessage<'_>,
    ) -> Option<(SlotIndex, &'s Slot)> {
        let sender = observed.undelivered_to.unwrap_or(observed.sender);
        // Of several, the last that began.
        let (at, slot) = *alike.iter().max_by_key(|(at, slot)| {
            let rank = self.rank(slot, sender, observed);
            // Other agents may take part in a conversation that began elsewhere.
            let joined = rank == Rank::None && slot.conversation.joined;
            let has_protocol = self.has_protocol(*at, observed);
            (rank, joined, has_protocol, self.table.serial(*at), *at)
        })?;
        if self.single || self.rank(slot, sender, observed) == Rank::Both {
            return Some((at, slot));
        }
        if observed.undelivered_to.is_some() {
            return None;
        }
        let begins = |machine: &Machine| {
            step(
                &machine.initial().steps,
                observed.act,
                RoleSet::ALL,
                RoleSet::ALL,
            )
            .is_some()
                || self.begins_for_role(machine, observed)
        };
        let named = observed.protocol;
        let machine = named.and_then(|name| self.library.find(name));
        let stays = match machine {
            Some(machine) if begins(machine) => !self.begins_another(at, machine, observed),
            // The monitor may have removed the conversation of the message.
            _ => self.is_certain(id),
        };
        stays.then_some((at, slot))
    }

    /// The part that the sender and the receivers take in the conversation or in one within it.
    #[inline]
    fn rank(&self, slot: &Slot, sender: &str, observed: &ObservedMessage<'_>) -> Rank {
        match self.links(&slot.conversation, sender, observed) {
            true => Rank::Both,
            false => self.rank_without_link(slot, sender, observed),
        }
    }

    fn rank_without_link(&self, slot: &Slot, sender: &str, observed: &ObservedMessage<'_>) -> Rank {
        let children = std::iter::successors(slot.child, |at| self.table.sibling(*at));
        let children = children.map_while(|at| self.table.slot(at));
        let inner = || children.clone().map(|slot| &slot.conversation);
        let all = || inner().chain([&slot.conversation]);
        let sends = |conversation: &Conversation| self.sends_in(conversation, sender);
        let receives = |conversation: &Conversation| self.receives_in(conversation, observed);
        let embeds = slot.child.is_some();
        if embeds
            && (inner().any(|conversation| self.links(conversation, sender, observed))
                || all().any(sends) && all().any(receives))
        {
            return Rank::Both;
        }
        match all().any(sends) {
            true => Rank::Sender,
            false => Rank::None,
        }
    }

    /// Whether a message of this sender fits the agents of the conversation.
    #[inline]
    fn links(
        &self,
        conversation: &Conversation,
        sender: &str,
        observed: &ObservedMessage<'_>,
    ) -> bool {
        let machine = self.library.machine(conversation.machine);
        if machine.is_none_or(|machine| machine.scope == Scope::Conversation) {
            return self.sends_in(conversation, sender) && self.receives_in(conversation, observed);
        }
        // With a state for each participant, these exchange messages with the initiator only.
        let names = &self.names;
        let leads = |agent: &str| {
            names.is(conversation.initiator, agent) || conversation.is_designated(names, agent)
        };
        let answers = |agent: &str| {
            conversation.unnamed().is_some() || conversation.party(names, agent).is_some()
        };
        let receivers = || observed.receivers.iter().take(MAX_LOOKED_AT);
        leads(sender) && receivers().any(|receiver| answers(receiver))
            || answers(sender) && receivers().any(|receiver| leads(receiver))
    }

    fn sends_in(&self, conversation: &Conversation, sender: &str) -> bool {
        conversation.unnamed().is_some() || self.has(conversation, sender)
    }

    fn receives_in(&self, conversation: &Conversation, observed: &ObservedMessage<'_>) -> bool {
        let mut receivers = observed.receivers.iter().take(MAX_LOOKED_AT);
        receivers.any(|receiver| self.has(conversation, receiver))
    }

    /// Whether the agent takes part in the conversation, or may.
    fn has(&self, conversation: &Conversation, agent: &str) -> bool {
        conversation.is_local() && self.agent.as_deref() == Some(agent)
            || conversation.takes_part(&self.names, agent)
            || conversation.is_designated(&self.names, agent)
    }

    /// Whether the protocol of a message is that of the conversation or of one within it, or may begin
    /// within it.
    fn has_protocol(&self, at: SlotIndex, observed: &ObservedMessage<'_>) -> bool {
        let Some(name) = observed.protocol else {
            return true;
        };
        let mut next = Some(at);
        while let Some(part) = next
            && let Some(slot) = self.table.slot(part)
        {
            let machine = self.machine_of(&self.library, part);
            if machine.is_some_and(|machine| machine.is_called(name))
                || self.may_begin(&self.library, part, name, observed.sender)
            {
                return true;
            }
            next = if part == at {
                slot.child
            } else {
                self.table.sibling(part)
            };
        }
        false
    }

    /// Whether a message of this protocol, in a conversation of another one, cancels the conversation or
    /// answers the cancel: the cancel meta-protocol is part of every protocol. If it may run within the
    /// conversation as a subprotocol, it does.
    pub(crate) fn is_cancel_of(
        &self,
        main: SlotIndex,
        protocol: &str,
        sender: &str,
        act: Act<'_>,
    ) -> bool {
        let named = self.library.find(protocol);
        if ![CANCEL, INFORM, FAILURE, NOT_UNDERSTOOD].contains(&act)
            || named.is_none_or(|machine| !machine.is_called(CANCEL_PROTOCOL))
        {
            return false;
        }
        let mut next = Some(main);
        while let Some(part) = next
            && let Some(slot) = self.table.slot(part)
        {
            let inner = part != main;
            let machine = self.machine_of(&self.library, part);
            if inner && machine.is_some_and(|machine| machine.is_called(protocol))
                || self.may_begin(&self.library, part, protocol, sender)
            {
                return false;
            }
            next = if inner {
                self.table.sibling(part)
            } else {
                slot.child
            };
        }
        true
    }

    /// Whether the first message of a protocol begins another conversation than this one.
    fn begins_another(
        &self,
        at: SlotIndex,
        machine: &Machine,
        observed: &ObservedMessage<'_>,
    ) -> bool {
        let name = machine.name();
        let mut next = Some(at);
        while let Some(part) = next
            && let Some(slot) = self.table.slot(part)
        {
            let conversation = &slot.conversation;
            let initiates = part == at && self.names.is(conversation.initiator, observed.sender);
            let leads = !conversation.joined
                && (initiates || conversation.is_designated(&self.names, observed.sender));
            if leads || self.may_begin(&self.library, part, name, observed.sender) {
                return false;
            }
            next = if part == at {
                slot.child
            } else {
                self.table.sibling(part)
            };
        }
        true
    }
}

/// The name of the cancel meta-protocol as a protocol of its own.
const CANCEL_PROTOCOL: &str = "fipa-cancel";

/// Number of receivers that are looked at to find the conversation of a message.
pub(super) const MAX_LOOKED_AT: usize = 16;
