//! Begins a conversation with its first message.

use std::sync::Arc;

use crate::Moment;
use crate::check::observed::ObservedMessage;
use crate::check::outcome::{Denied, Passed};
use crate::conversation::ids::SlotIndex;
use crate::conversation::names::Names;
use crate::conversation::party::Party;
use crate::monitor::Monitor;
use crate::protocol::index::MachineIndex;
use crate::protocol::machine::{Machine, Scope, step};
use crate::protocol::role::RoleSet;
use crate::verdict::{Unchecked, ViolationKind as Kind};

/// A conversation that a message begins.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Opening<'a> {
    pub(crate) id: &'a str,
    /// The conversation within which it begins.
    pub(crate) parent: Option<SlotIndex>,
    pub(crate) machine: MachineIndex,
}

impl<'a> Opening<'a> {
    /// Returns a conversation that begins within no other one.
    pub(crate) fn alone(id: &'a str, machine: MachineIndex) -> Self {
        Self {
            id,
            parent: None,
            machine,
        }
    }
}

impl Monitor {
    pub(crate) fn open(
        &mut self,
        opening: Opening<'_>,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        let Opening {
            id,
            parent,
            machine,
        } = opening;
        let library = Arc::clone(&self.library);
        let Some(protocol) = library.machine(machine) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        // Checked before eviction, so that an invalid message evicts no conversation.
        if parent.is_none()
            && let Some(projection) = protocol.projection.clone().filter(|_| self.agent.is_some())
        {
            return self.open_local(opening, protocol, &projection, observed, now);
        }
        let begins = step(
            &protocol.initial().steps,
            observed.act,
            RoleSet::ALL,
            RoleSet::ALL,
        );
        let Some(begins) = begins else {
            return Err(match parent {
                None => self.unopened(id, machine, protocol, observed, now),
                Some(_) => Denied::NotOpened(machine),
            });
        };
        let at = self.insert(opening, observed, now)?;
        let may_continue = parent.is_none() && !self.is_certain(id);
        if let Some(slot) = self.table.slot_mut(at) {
            let conversation = &mut slot.conversation;
            conversation.initiator = Some(conversation.acquire(&mut self.names, observed.sender));
            if protocol.scope == Scope::Conversation {
                let party = Party::new(None, protocol.initial);
                conversation.parties.push(party);
            }
            if may_continue && protocol.may_repeat(observed.act, begins) {
                conversation.rare().may_continue = true;
            }
        }
        let passed = self.advance(at, observed, now);
        passed.map_err(|denied| {
            self.remove(at);
            match denied {
                Denied::Fault(fault, _) if fault.kind == Kind::TooMany => {
                    Denied::Refused(Kind::TooMany, None)
                }
                Denied::Fault(..) => Denied::NotOpened(machine),
                other => other,
            }
        })
    }

    /// Inserts a conversation that a message begins, and evicts others for it.
    pub(crate) fn insert(
        &mut self,
        opening: Opening<'_>,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<SlotIndex, Denied> {
        let Opening { id, parent, .. } = opening;
        if parent.is_none() {
            self.evict_alike(id)?;
        }
        let peer = match parent {
            Some(parent) => {
                let peer = self.table.peer(parent);
                peer.map(|peer| self.names.acquire_again(peer))
            }
            None if observed.own => None,
            None => {
                let peer = observed.peer.unwrap_or(observed.sender);
                Some(self.names.acquire(peer))
            }
        };
        let peer_cost = peer.map_or(0, |peer| Names::cost(self.names.text(peer).len()));
        // Its bytes are charged, and others evicted for them, when the message has been accepted.
        self.evict(parent, peer, 1);
        let at = self
            .table
            .insert(id, parent, peer, opening.machine, now.millis());
        if let Some(slot) = self.table.slot_mut(at) {
            slot.conversation.charge(peer_cost);
        }
        Ok(at)
    }

    /// Returns the verdict on a message that begins no conversation, if the monitor has none for it.
    fn unopened(
        &mut self,
        id: &str,
        machine: MachineIndex,
        protocol: &Machine,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Denied {
        if !protocol.may_follow(observed.act) {
            return Denied::NotOpened(machine);
        }
        let certain = self.is_certain(id);
        if self.agent.is_none() || observed.own {
            if certain {
                return Denied::NotOpened(machine);
            }
            return Denied::Unchecked(Unchecked::UnknownHistory);
        }
        if certain && self.policy.unsolicited && !self.policy.exempts(protocol.name()) {
            return Denied::Refused(Kind::Unsolicited, None);
        }
        // The sender may have named the monitored agent in a `reply-to`, or the agent has restarted.
        if protocol.shows_initiator(observed.act) {
            let opening = Opening::alone(id, machine);
            if let Err(denied) = self.join(opening, observed, now) {
                return denied;
            }
            return Denied::Unchecked(Unchecked::BegunElsewhere);
        }
        // The agent may answer.
        self.remember_removed(id);
        Denied::Unchecked(Unchecked::UnknownHistory)
    }
}
