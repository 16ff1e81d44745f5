//! Conversations of an agent in protocols with three or more roles. The monitor checks them against the
//! projection of the protocol onto the role of the agent.

use std::sync::Arc;

use crate::act::{CANCEL, FAILURE, NOT_UNDERSTOOD};
use crate::conversation::{AFTER_NOT_UNDERSTOOD, Conversation, NONE, Party, RoleBinding};
use crate::judge::{Fault, ObservedMessage, unbound};
use crate::machine::Machine;
use crate::monitor::{Denied, Monitor, Passed};
use crate::names::Names;
use crate::projection::{LocalRun, NotLocal, Observed, Projection};
use crate::verdict::{Unchecked, ViolationKind as Kind};
use crate::{Header, Now};

impl Monitor {
    /// Begins a conversation with the first message that the agent sends or receives in it.
    pub(crate) fn open_local(
        &mut self,
        id: &str,
        (index, machine): (u16, &Machine),
        projection: &Projection,
        (header, observed): (&Header<'_>, &ObservedMessage<'_>),
        now: Now,
    ) -> Result<Passed, Denied> {
        let mut run = LocalRun::new(projection.locals(), u32::MAX);
        let message = Observed {
            act: observed.act,
            own: observed.own,
            peers: u32::MAX,
        };
        if run.take(projection.locals(), message).is_err() {
            let certain = observed.own && self.is_certain(id);
            return Err(if certain || !machine.may_follow(observed.act) {
                Denied::NotOpened(index)
            } else {
                self.remember_removed(id);
                Denied::Unchecked(Unchecked::UnknownHistory)
            });
        }
        let at = self.insert(id, NONE, index, (header, observed), now)?;
        if let Some(slot) = self.table.slot_mut(at) {
            let conversation = &mut slot.conversation;
            conversation.initiator = conversation.acquire(&mut self.names, observed.sender);
            conversation.add(Party::new(NONE, machine.initial));
            conversation.rare().local = Some(LocalRun::new(projection.locals(), u32::MAX));
        }
        let passed = self.advance_local(at, projection, observed, now);
        passed.map(|passed| Passed {
            opened: true,
            ..passed
        })
    }

    /// Whether the message fits the conversation as the role of the agent sees it.
    pub(crate) fn fits_role(
        &self,
        at: u32,
        header: &Header<'_>,
        observed: &ObservedMessage<'_>,
    ) -> bool {
        let slot = self
            .table
            .slot(at)
            .filter(|slot| slot.conversation.is_local());
        let Some(conversation) = slot.map(|slot| &slot.conversation) else {
            return false;
        };
        let machine = self.library.machine(conversation.machine);
        let named = header.protocol_name();
        let called = |machine: &&Machine| named.is_none_or(|name| machine.is_called(name));
        let Some(machine) = machine.filter(called) else {
            return false;
        };
        let run = conversation
            .rare
            .as_deref()
            .and_then(|rare| rare.local.clone());
        let (_, message) = observed_by_role(machine, conversation, &self.names, observed);
        run.zip(machine.projection.as_deref())
            .is_some_and(|(mut run, projection)| run.take(projection.locals(), message).is_ok())
    }

    /// Checks a message in a conversation that the role of the agent sees.
    pub(crate) fn advance_local(
        &mut self,
        at: u32,
        projection: &Projection,
        observed: &ObservedMessage<'_>,
        now: Now,
    ) -> Result<Passed, Denied> {
        let library = Arc::clone(&self.library);
        let fault = |kind, state| {
            let fault = Fault {
                state: Some(state),
                ..Fault::plain(kind)
            };
            Err(Denied::Fault(fault, at))
        };
        let Some(slot) = self.table.slot_mut(at) else {
            return fault(Kind::NotOpened, 0);
        };
        let conversation = &mut slot.conversation;
        let index = conversation.machine;
        let Some(machine) = library.machine(index) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        let state = conversation.parties.first().map_or(0, |party| party.state);
        if state == AFTER_NOT_UNDERSTOOD {
            // Other agents may not have received it yet.
            return match observed.own {
                true => fault(Kind::Ended, state),
                false => Err(Denied::Unchecked(Unchecked::BegunElsewhere)),
            };
        }
        let (free, message) = observed_by_role(machine, conversation, &self.names, observed);
        let peers = message.peers;
        let Some(run) = conversation.rare().local.as_mut() else {
            return fault(Kind::NotOpened, state);
        };
        let locals = projection.locals();
        match run.take(locals, message) {
            Ok((_, peer)) => {
                let local = run.state(locals);
                let state = local.map_or(state, |local| local.global_in(machine));
                if let Some(party) = conversation.parties.first_mut() {
                    party.state = state;
                }
                if let Some(role) = peer.filter(|role| free & (1 << role) != 0) {
                    let agents = match observed.own {
                        true => observed.receivers,
                        false => &[observed.sender.into()][..],
                    };
                    for name in agents {
                        let agent = conversation.acquire(&mut self.names, name);
                        conversation.bound.push(RoleBinding { role, agent });
                    }
                }
                let complete = local.is_some_and(|local| local.is_final());
                let passed = Passed {
                    complete,
                    ..Passed::in_state_of(conversation, machine, index)
                };
                self.touch(at, now.millis());
                self.charge(at);
                Ok(passed)
            }
            // The rules of all protocols are between two agents, and the others do not see it.
            Err(_) if observed.act == NOT_UNDERSTOOD => {
                if let Some(party) = conversation.parties.first_mut() {
                    party.state = AFTER_NOT_UNDERSTOOD;
                }
                let passed = Passed::in_state_of(conversation, machine, index);
                self.touch(at, now.millis());
                Ok(passed)
            }
            Err(_) if [CANCEL, FAILURE].contains(&observed.act) => {
                Err(Denied::Unchecked(Unchecked::BegunElsewhere))
            }
            Err(NotLocal::Ended) => fault(Kind::Ended, state),
            Err(NotLocal::Unexpected) if peers == 0 && !observed.own => {
                fault(Kind::Stranger, state)
            }
            Err(NotLocal::Unexpected) if peers == 0 => fault(Kind::WrongReceiver, state),
            Err(NotLocal::Unexpected) => fault(Kind::Unexpected, state),
        }
    }
}

/// Returns the roles that no agent has, and the message with the roles that the other side may have. An
/// agent with a role has no other one.
fn observed_by_role<'a>(
    machine: &Machine,
    conversation: &Conversation,
    names: &Names,
    observed: &ObservedMessage<'a>,
) -> (u32, Observed<'a>) {
    let free = unbound(machine, conversation);
    let may = |name: &str| {
        let bound = conversation.bound.iter();
        let held = bound.filter(|bound| names.is(bound.agent, name));
        match held.fold(0, |mask, bound| mask | (1 << bound.role)) {
            0 => free,
            held => held,
        }
    };
    let peers = match observed.own {
        true => {
            let receivers = observed.receivers.iter();
            receivers.fold(u32::MAX, |all, name| all & may(name))
        }
        false => may(observed.sender),
    };
    let message = Observed {
        act: observed.act,
        own: observed.own,
        peers,
    };
    (free, message)
}
