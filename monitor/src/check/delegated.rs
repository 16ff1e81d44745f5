//! Conversations that began between other agents.
//!
//! The monitored agent joins such a conversation because a `reply-to` names it, for example that of a
//! recruiter (FIPA00034). It may then continue with the agents that answer it.
//!
//! The monitor has not seen the earlier messages, and does not see messages between other agents. So
//! it infers the state from a received answer, if the answer can lead to one state only. An answer
//! that does not fit the inferred state is no violation: it implies another state. Messages of the
//! monitored agent itself must fit.
//!
//! The same holds if the monitored agent has named another agent in a `reply-to`: the monitor does
//! not see the messages between that agent and the others.
//!
//! The rules of conversations with a known beginning do not belong here.

use std::sync::Arc;

use crate::Moment;
use crate::check::observed::ObservedMessage;
use crate::check::open::Opening;
use crate::check::outcome::Denied;
use crate::conversation::ids::SlotIndex;
use crate::conversation::names::Names;
use crate::conversation::party::{Party, Side, side_index};
use crate::conversation::state::ELSEWHERE;
use crate::monitor::Monitor;
use crate::protocol::act::{Act, ActNumber, FAILURE, INFORM};
use crate::protocol::index::StateId;
use crate::protocol::machine::{Cancel, Machine, Scope, step};
use crate::protocol::role::RoleSet;
use crate::verdict::{Unchecked, ViolationKind as Kind};

impl Monitor {
    /// Whether the conversation began between other agents.
    pub(crate) fn is_joined(&self, at: SlotIndex) -> bool {
        let slot = self.table.slot(at);
        slot.is_some_and(|slot| slot.conversation.joined)
    }

    /// Whether the conversation may continue without messages to the monitored agent: it began
    /// between other agents, or the monitored agent has named another agent in `reply-to`.
    pub(crate) fn may_continue_elsewhere(&self, at: SlotIndex) -> bool {
        let slot = self.table.slot(at);
        slot.zip(self.agent.as_deref())
            .is_some_and(|(slot, agent)| {
                let conversation = &slot.conversation;
                let named = || !conversation.reply_to().is_empty();
                conversation.joined || named() && self.names.is(conversation.initiator, agent)
            })
    }

    /// Joins a conversation with a message to the monitored agent, if the message is an answer.
    pub(crate) fn join(
        &mut self,
        opening: Opening<'_>,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<(), Denied> {
        let library = Arc::clone(&self.library);
        let protocol = library.machine(opening.machine);
        let Some(protocol) = protocol.filter(|it| it.shows_initiator(observed.act)) else {
            return Ok(());
        };
        let at = self.insert(opening, observed, now)?;
        let agent = self.agent.as_deref().unwrap_or_default();
        if let Some(slot) = self.table.slot_mut(at) {
            let conversation = &mut slot.conversation;
            conversation.initiator = Some(conversation.acquire(&mut self.names, agent));
            conversation.joined = true;
        }
        self.infer_state(at, protocol, observed, now);
        Ok(())
    }

    /// Reconsiders the refusal of a message in a conversation that may continue elsewhere.
    pub(crate) fn recheck_delegated(
        &mut self,
        at: SlotIndex,
        observed: &ObservedMessage<'_>,
        denied: Denied,
        now: Moment,
    ) -> Denied {
        let library = Arc::clone(&self.library);
        let slot = self
            .table
            .slot(at)
            .filter(|_| self.may_continue_elsewhere(at));
        let machine = slot.and_then(|slot| library.machine(slot.conversation.machine));
        let Some((slot, machine)) = slot.zip(machine) else {
            return denied;
        };
        let joined = slot.conversation.joined;
        // The agent that asked knows its participants, and the messages that it has received.
        let asked = !joined && slot.conversation.takes_part(&self.names, observed.sender);
        let known = |kind| [Kind::Repeated, Kind::WrongReceiver].contains(&kind);
        let asked = asked && !matches!(&denied, Denied::Fault(fault, _) if known(fault.kind));
        let not_known = if !joined && !asked {
            false
        } else if observed.own {
            let unknown = |party: &Party| {
                let mut receivers = observed.receivers.iter();
                let mut addressed =
                    || receivers.any(|receiver| self.names.is(party.peer, receiver));
                // The state after an undelivered message is unknown too.
                [party.state, party.resume].contains(&ELSEWHERE)
                    && (party.peer.is_none() || addressed())
            };
            slot.conversation.parties.iter().any(unknown)
                && machine.is_sent_by_initiator(observed.act)
        } else if machine.is_answer(observed.act) {
            self.infer_state(at, machine, observed, now);
            true
        } else {
            // Other agents may begin the protocol with the monitored agent too, or answer a cancel.
            let begins = step(
                &machine.initial().steps,
                observed.act,
                RoleSet::ALL,
                RoleSet::ALL,
            );
            let cancels = machine.cancel != Cancel::Nobody;
            joined && (begins.is_some() || cancels && [INFORM, FAILURE].contains(&observed.act))
        };
        if not_known {
            return Denied::Unchecked(Unchecked::BegunElsewhere);
        }
        denied
    }

    /// Infers the state from an answer.
    fn infer_state(
        &mut self,
        at: SlotIndex,
        machine: &Machine,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) {
        let Some(slot) = self.table.slot_mut(at) else {
            return;
        };
        let main = slot.parent.unwrap_or(at);
        let conversation = &mut slot.conversation;
        let (known, state) = match machine.scope {
            Scope::Participant => {
                let known = conversation.party(&self.names, observed.sender);
                // It may also answer a cancel that the monitor has not seen.
                let cancels = conversation.joined && machine.cancel != Cancel::Nobody;
                let state = match observed.act {
                    INFORM | FAILURE if cancels => ELSEWHERE,
                    act => after(machine, act),
                };
                (known.map(|(at, _)| at), state)
            }
            // The roles of the agents are unknown too.
            Scope::Conversation => (conversation.parties.len().checked_sub(1), ELSEWHERE),
        };
        let added = conversation.growth(1, 0, 0) + Names::cost(observed.sender.len());
        let grown = crate::conversation::table::Slot::COST + conversation.allocated() + added;
        let peer = match known.and_then(|known| conversation.parties.get(known)) {
            Some(party) => party.peer,
            None if conversation.parties.len() == self.limits.participants => return,
            None if grown > self.limits.share_of_bytes() => return,
            None if machine.scope == Scope::Conversation => None,
            None => Some(conversation.acquire(&mut self.names, observed.sender)),
        };
        let mut party = Party::new(peer, state);
        party.acts[side_index(Side::Other)] = Some(ActNumber::of(observed.act));
        party.ask(Side::Other, observed.reply_with, observed.reply_with_text);
        match known.and_then(|known| conversation.parties.get_mut(known)) {
            Some(known) => *known = party,
            None => {
                conversation.add(party);
            }
        }
        self.charge(at);
        self.touch(main, now.millis());
    }
}

/// Returns the state to which this answer leads from any reachable state, or [`ELSEWHERE`] if there
/// are several. Timeouts do not count: the `reply-by` of the question is unknown.
fn after(machine: &Machine, act: Act<'_>) -> StateId {
    let initiator = RoleSet::of(machine.initiator);
    let mut reached = vec![machine.initial];
    let (mut next, mut found) = (0, None);
    while let Some(state) = reached.get(next).and_then(|id| machine.state(*id)) {
        next += 1;
        if let Some(step) = step(&state.steps, act, !initiator, initiator) {
            if found.is_some_and(|found| found != step.target) {
                return ELSEWHERE;
            }
            found = Some(step.target);
        }
        for step in &state.transitions {
            if !reached.contains(&step.target) {
                reached.push(step.target);
            }
        }
    }
    found.unwrap_or(ELSEWHERE)
}
