//! Conversations within a conversation: the subprotocols of a state.

use crate::check::observed::ObservedMessage;
use crate::check::open::Opening;
use crate::check::outcome::{Denied, Fault, Passed};
use crate::conversation::Conversation;
use crate::conversation::ids::SlotIndex;
use crate::conversation::names::Names;
use crate::conversation::party::Party;
use crate::monitor::Monitor;
use crate::protocol::machine::{Machine, Scope};
use crate::protocol::role::RoleSet;
use crate::verdict::{Unchecked, ViolationKind as Kind};
use crate::{Library, Moment};

impl Monitor {
    /// Checks a message with another protocol than its conversation has. It belongs to an embedded
    /// conversation.
    pub(crate) fn embedded(
        &mut self,
        library: &Library,
        main: SlotIndex,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        let name = observed.protocol.unwrap_or_default();
        let (mut denied, mut open) = (None, None);
        let mut children = 0;
        let mut may_begin = self.may_begin(library, main, name, observed.sender);
        let mut next = self.table.slot(main).and_then(|slot| slot.child);
        while let Some(child) = next {
            children += 1;
            may_begin |= self.may_begin(library, child, name, observed.sender);
            let called = self.machine_of(library, child);
            if called.is_some_and(|machine| machine.is_called(name)) {
                match self.advance(child, observed, now) {
                    Ok(passed) => {
                        self.touch(main, now.millis());
                        return Ok(passed);
                    }
                    Err(fault) if self.may_continue_elsewhere(child) => open = Some((child, fault)),
                    Err(fault) => denied = denied.or(Some(fault)),
                }
            }
            next = self.table.sibling(child);
        }
        if !may_begin {
            return Err(match (denied, open) {
                (Some(denied), _) => denied,
                (None, Some((child, fault))) => self.recheck_delegated(child, observed, fault, now),
                (None, None) if self.began_elsewhere(library, main, name, observed.sender) => {
                    let inner = library.index_of(name).filter(|_| !observed.own);
                    if let Some(inner) = inner.filter(|_| children < self.limits.embedded) {
                        let opening = Opening {
                            id: observed.conversation_id,
                            parent: Some(main),
                            machine: inner,
                        };
                        let _ = self.join(opening, observed, now);
                    }
                    Denied::Unchecked(Unchecked::BegunElsewhere)
                }
                (None, None) if self.is_joined(main) => {
                    Denied::Unchecked(Unchecked::BegunElsewhere)
                }
                (None, None) => Denied::Fault(Fault::plain(Kind::WrongProtocol), main),
            });
        }
        let Some(machine) = library.index_of(name) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        if children >= self.limits.embedded {
            return Err(Denied::Fault(Fault::plain(Kind::TooMany), main));
        }
        let opening = Opening {
            id: observed.conversation_id,
            parent: Some(main),
            machine,
        };
        match self.open(opening, observed, now) {
            Ok(passed) => {
                self.touch(main, now.millis());
                Ok(passed)
            }
            Err(not_opened) => Err(denied.unwrap_or(not_opened)),
        }
    }

    /// Whether the agent may begin a conversation of this protocol within another conversation.
    pub(crate) fn may_begin(
        &self,
        library: &Library,
        at: SlotIndex,
        protocol: &str,
        sender: &str,
    ) -> bool {
        self.is_begun(library, at, protocol, |roles| roles.of(sender))
    }

    /// Whether another agent than the monitored one may have begun a conversation of this protocol
    /// within its conversation, so that an unknown agent sends messages to it. Recruited agents do so.
    fn began_elsewhere(
        &self,
        library: &Library,
        at: SlotIndex,
        protocol: &str,
        sender: &str,
    ) -> bool {
        let Some(agent) = &self.agent else {
            return false;
        };
        let takes_part = |name: &str| {
            let slot = self.table.slot(at);
            slot.is_some_and(|slot| slot.conversation.takes_part(&self.names, name))
        };
        !takes_part(sender) && self.is_begun(library, at, protocol, |roles| !roles.of(agent))
    }

    /// Whether agents with the roles `by` may begin the protocol now.
    fn is_begun(
        &self,
        library: &Library,
        at: SlotIndex,
        protocol: &str,
        by: impl Fn(&Holders<'_>) -> RoleSet,
    ) -> bool {
        let Some((slot, machine)) = self.table.slot(at).zip(self.machine_of(library, at)) else {
            return false;
        };
        let inner = library.find(protocol);
        slot.conversation.parties.iter().any(|party| {
            let roles = by(&Holders {
                conversation: &slot.conversation,
                machine,
                party,
                names: &self.names,
            });
            let state = machine.state(party.state);
            let mut embedded = state.into_iter().flat_map(|state| &state.embedded);
            embedded.any(|sub| {
                let named = match inner {
                    Some(inner) => sub.admits(inner),
                    None => sub.name.matches(protocol),
                };
                named && sub.from.mask.intersects(roles)
            })
        })
    }
}

/// The roles of agents in a conversation, with respect to one party.
pub(crate) struct Holders<'a> {
    pub(crate) conversation: &'a Conversation,
    pub(crate) machine: &'a Machine,
    pub(crate) party: &'a Party,
    pub(crate) names: &'a Names,
}

impl Holders<'_> {
    pub(crate) fn of(&self, agent: &str) -> RoleSet {
        let initiator = RoleSet::of(self.machine.initiator);
        match self.machine.scope {
            Scope::Participant if self.names.is(self.conversation.initiator, agent) => initiator,
            Scope::Participant if self.names.is(self.party.peer, agent) => !initiator,
            Scope::Participant => RoleSet::NONE,
            Scope::Conversation => {
                let bound = self.conversation.bound.iter();
                let held = bound.filter(|bound| self.names.is(bound.agent, agent));
                held.map(|bound| bound.role).collect()
            }
        }
    }
}
