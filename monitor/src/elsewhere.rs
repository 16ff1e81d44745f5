//! Conversations that began between others. The agent that watches itself comes into them because a
//! `reply-to` names it, as the recruiter's does (FIPA00034), and may go on with those who answer it.
//!
//! It does not know what was said before, nor what others say to each other meanwhile. So it takes
//! the state from what it is told, where that can only lead to one; an answer that does not fit that
//! state is no violation, but tells of another one. What the agent says itself must fit.
//!
//! Likewise for who has named somebody else in a `reply-to` himself: what that one and the others say to
//! each other, he does not hear.
//!
//! What must not live here: what conversations allow that are known from their beginning to their end.

use std::sync::Arc;
use std::time::SystemTime;

use crate::act::Act;
use crate::change::millis;
use crate::conversation::{Conversation, ELSEWHERE, NONE, Party, Side, act_number, side_index};
use crate::judge::Heard;
use crate::machine::{Machine, Scope, step};
use crate::monitor::{Denied, Monitor};
use crate::verdict::{Unchecked, ViolationKind as Kind};

impl Monitor {
    /// Whether the conversation began between others.
    pub(crate) fn is_joined(&self, at: u32) -> bool {
        let slot = self.table.slot(at);
        slot.is_some_and(|slot| slot.conversation.joined)
    }

    /// Whether others may go on with the conversation where the agent that watches itself does not
    /// hear it: it began between others, or the agent has named somebody else for the replies.
    pub(crate) fn goes_on_elsewhere(&self, at: u32) -> bool {
        let slot = self.table.slot(at);
        slot.zip(self.agent.as_deref())
            .is_some_and(|(slot, agent)| {
                let Conversation {
                    joined,
                    initiator,
                    reply_to,
                    ..
                } = &slot.conversation;
                *joined || !reply_to.is_empty() && self.names.is(*initiator, agent)
            })
    }

    /// Comes into a conversation with what the agent is told in it, if that answers anything.
    pub(crate) fn join(
        &mut self,
        id: &str,
        parent: u32,
        machine: u16,
        heard: &Heard<'_>,
        now: SystemTime,
    ) {
        let library = Arc::clone(&self.library);
        let protocol = library.machine(machine);
        let Some(protocol) = protocol.filter(|protocol| protocol.is_answer(heard.act)) else {
            return;
        };
        self.make_room(parent);
        let at = self.table.insert(id, parent, machine, millis(now));
        let agent = self.agent.as_deref().unwrap_or_default();
        let initiator = self.names.acquire(agent);
        if let Some(slot) = self.table.slot_mut(at) {
            slot.conversation.initiator = initiator;
            slot.conversation.joined = true;
        }
        self.told(at, protocol, heard, now);
    }

    /// What to say of a message that does not fit a conversation with which others may go on.
    pub(crate) fn elsewhere(
        &mut self,
        at: u32,
        heard: &Heard<'_>,
        denied: Denied,
        now: SystemTime,
    ) -> Denied {
        let library = Arc::clone(&self.library);
        let slot = self.table.slot(at).filter(|_| self.goes_on_elsewhere(at));
        let machine = slot.and_then(|slot| library.machine(slot.conversation.machine));
        let Some((slot, machine)) = slot.zip(machine) else {
            return denied;
        };
        let joined = slot.conversation.joined;
        // Who has asked knows whom, and what came already.
        let asked = !joined && slot.conversation.takes_part(&self.names, heard.sender);
        let known = |kind| [Kind::Repeated, Kind::WrongReceiver].contains(&kind);
        let asked = asked && !matches!(&denied, Denied::Fault(fault, _) if known(fault.kind));
        let not_known = if !joined && !asked {
            false
        } else if heard.own {
            let unknown = |party: &Party| {
                let mut receivers = heard.receivers.iter();
                let mut told = || receivers.any(|receiver| self.names.is(party.peer, receiver));
                // Where it goes on after what was not delivered is not known, either.
                [party.state, party.resume].contains(&ELSEWHERE) && (party.peer == NONE || told())
            };
            slot.conversation.parties.iter().any(unknown) && machine.is_said_by_initiator(heard.act)
        } else if machine.is_answer(heard.act) {
            self.told(at, machine, heard, now);
            true
        } else {
            // Others may begin it with the agent as well.
            joined && step(&machine.initial().steps, heard.act, u32::MAX, u32::MAX).is_some()
        };
        if not_known {
            return Denied::Unchecked(Unchecked::BegunElsewhere);
        }
        denied
    }

    /// Takes the state from an answer.
    fn told(&mut self, at: u32, machine: &Machine, heard: &Heard<'_>, now: SystemTime) {
        let Some(slot) = self.table.slot_mut(at) else {
            return;
        };
        let main = if slot.parent == NONE { at } else { slot.parent };
        let parties = &mut slot.conversation.parties;
        let (known, state) = match machine.scope {
            Scope::Participant => {
                let by = |party: &Party| self.names.is(party.peer, heard.sender);
                (parties.iter().position(by), after(machine, heard.act))
            }
            // Who has which role in it is not known either.
            Scope::Conversation => (parties.len().checked_sub(1), ELSEWHERE),
        };
        let peer = match known.and_then(|known| parties.get(known)) {
            Some(party) => party.peer,
            None if parties.len() == self.limits.participants => return,
            None if machine.scope == Scope::Conversation => NONE,
            None => self.names.acquire(heard.sender),
        };
        let index = side_index(Side::Other);
        let mut party = Party::new(peer, state);
        party.acts[index] = act_number(heard.act);
        party.asked[index] = heard.reply_with;
        match known.and_then(|known| parties.get_mut(known)) {
            Some(place) => *place = party,
            None => parties.push(party),
        }
        self.touch(main, millis(now));
    }
}

/// The state to which this answer leads, whatever was said before it; unknown, where there are
/// several. What is said when time is up does not count: who does not know the question does not
/// know its `reply-by`.
fn after(machine: &Machine, act: Act<'_>) -> u16 {
    let initiator = 1_u32 << machine.initiator;
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
