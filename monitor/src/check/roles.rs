//! Conversations of an agent in protocols with three or more roles. The monitor checks them against the
//! projection of the protocol onto the role of the agent.

use std::sync::Arc;

use crate::Moment;
use crate::check::judge::unbound;
use crate::check::observed::{ObservedMessage, SentMessage};
use crate::check::open::Opening;
use crate::check::outcome::{Denied, Fault, Passed};
use crate::conversation::Conversation;
use crate::conversation::bindings::RoleBinding;
use crate::conversation::ids::SlotIndex;
use crate::conversation::names::Names;
use crate::conversation::party::Party;
use crate::conversation::rare::LastSent;
use crate::conversation::state::AFTER_NOT_UNDERSTOOD;
use crate::monitor::Monitor;
use crate::protocol::act::{ActNumber, CANCEL, FAILURE, NOT_UNDERSTOOD};
use crate::protocol::index::StateId;
use crate::protocol::machine::Machine;
use crate::protocol::projection::{LocalRun, NotLocal, Observed, Projection};
use crate::protocol::role::{Role, RoleSet};
use crate::verdict::{Unchecked, ViolationKind as Kind};

impl Monitor {
    /// Begins a conversation with the first message that the agent sends or receives in it.
    pub(crate) fn open_local(
        &mut self,
        opening: Opening<'_>,
        machine: &Machine,
        projection: &Projection,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        let id = opening.id;
        if begun(projection, observed).is_none() {
            let certain = observed.own && self.is_certain(id);
            return Err(if certain || !machine.may_follow(observed.act) {
                Denied::NotOpened(opening.machine)
            } else {
                self.remember_removed(id);
                Denied::Unchecked(Unchecked::UnknownHistory)
            });
        }
        let is_certain = self.is_certain(id);
        let at = self.insert(opening, observed, now)?;
        if let Some(slot) = self.table.slot_mut(at) {
            let conversation = &mut slot.conversation;
            conversation.initiator = Some(conversation.acquire(&mut self.names, observed.sender));
            conversation.add(Party::new(None, machine.initial));
            conversation.rare().local = Some(LocalRun::new(projection.locals(), RoleSet::ALL));
            conversation.rare().may_continue = !is_certain;
        }
        let passed = self.advance_local(at, projection, observed, now);
        passed.map(|passed| Passed {
            opened: true,
            ..passed
        })
    }

    /// Whether this is the first message of the protocol that a role of the monitored agent sees.
    pub(crate) fn begins_for_role(
        &self,
        machine: &Machine,
        observed: &ObservedMessage<'_>,
    ) -> bool {
        let projection = machine.projection.as_deref();
        let Some(projection) = projection.filter(|_| self.agent.is_some()) else {
            return false;
        };
        !begun_roles(projection, observed).is_empty()
    }

    /// A violation is none if the state is uncertain: the conversation may have begun before the monitor, a
    /// message waits for its turn, the role of the monitored agent or that of another one is uncertain, or
    /// there is another conversation with this identifier. An agent that guesses an identifier can cause all
    /// but the first.
    pub(crate) fn recheck_local(&self, id: &str, at: SlotIndex, denied: Denied) -> Denied {
        let uncertain = |at: SlotIndex| {
            let slot = self.table.slot(at);
            let rare = slot.and_then(|slot| slot.conversation.rare.as_deref());
            rare.is_some_and(|rare| {
                let waits = || rare.local.as_ref().is_some_and(LocalRun::waits);
                rare.may_continue || rare.contested || !rare.uncertain_roles.is_empty() || waits()
            })
        };
        match denied {
            Denied::Fault(..) if uncertain(at) || self.table.find_all(id).count() > 1 => {
                Denied::Unchecked(Unchecked::UnknownHistory)
            }
            denied => denied,
        }
    }

    /// Whether the message fits the conversation as the role of the agent sees it.
    #[inline]
    pub(crate) fn fits_role(
        &self,
        conversation: &Conversation,
        observed: &ObservedMessage<'_>,
    ) -> bool {
        conversation.is_local()
            && observed.undelivered_to.is_none()
            && self.fits_local(conversation, observed)
    }

    fn fits_local(&self, conversation: &Conversation, observed: &ObservedMessage<'_>) -> bool {
        let machine = self.library.machine(conversation.machine);
        let named = observed.protocol;
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
        at: SlotIndex,
        projection: &Projection,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        if observed.undelivered_to.is_some() {
            return Err(Denied::Unchecked(Unchecked::BegunElsewhere));
        }
        let library = Arc::clone(&self.library);
        let fault = |kind, state| {
            let fault = Fault {
                state: Some(state),
                ..Fault::plain(kind)
            };
            Err(Denied::Fault(fault, at))
        };
        let Some(slot) = self.table.slot_mut(at) else {
            return fault(Kind::NotOpened, StateId::FIRST);
        };
        let conversation = &mut slot.conversation;
        let index = conversation.machine;
        let Some(machine) = library.machine(index) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        let state = conversation
            .parties
            .first()
            .map_or(StateId::FIRST, |party| party.state);
        if state == AFTER_NOT_UNDERSTOOD {
            // Other agents may not have received it yet.
            return match observed.own {
                true => fault(Kind::Ended, state),
                false => Err(Denied::Unchecked(Unchecked::BegunElsewhere)),
            };
        }
        let (free, message) = observed_by_role(machine, conversation, &self.names, observed);
        let peers = message.peers;
        let takes_part = observed.own || conversation.takes_part(&self.names, observed.sender);
        let bound = conversation.bound.len();
        let last_sent = |ends, bound_after| LastSent {
            act: ActNumber::of(observed.act),
            reply_with: observed.reply_with,
            state,
            ends,
            bound,
            bound_after,
        };
        let Some(run) = conversation.rare().local.as_mut() else {
            return fault(Kind::NotOpened, state);
        };
        let locals = projection.locals();
        let own_roles = run.roles();
        match run.take(locals, message) {
            Ok((_, peer)) => {
                let (kept_roles, is_certain) = (run.roles(), run.is_certain());
                let local = run.state(locals);
                let state = local.map_or(state, |local| local.global_in(machine));
                if let Some(party) = conversation.parties.first_mut() {
                    party.state = state;
                }
                if let Some(role) = peer.filter(|role| free.contains(*role)) {
                    let uncertain = || {
                        // The sender of this message, or that of an earlier one, may be an outsider.
                        (own_roles | begun_roles(projection, observed)) & !kept_roles
                    };
                    bind(conversation, &mut self.names, observed, role, uncertain);
                }
                if observed.own {
                    conversation.release_asked(&mut self.names, |_| true);
                }
                let complete = local.is_some_and(|local| local.is_final());
                let bound_after = conversation.bound.len();
                let rare = conversation.rare();
                rare.undelivered &= !is_certain;
                if observed.own {
                    // The agent knows its role.
                    rare.uncertain_roles &= projection.senders_of(observed.act);
                    rare.last_sent = Some(last_sent(false, bound_after));
                } else if rare.local.as_ref().is_none_or(|run| !run.has_last()) {
                    rare.last_sent = None;
                }
                let passed = Passed {
                    complete,
                    ..Passed::in_state_of(conversation, machine, index)
                };
                self.touch(at, now.millis());
                self.charge(at);
                Ok(passed)
            }
            // The rules of all protocols are between two agents, and the others do not see it.
            Err(_) if observed.act == NOT_UNDERSTOOD && takes_part => {
                if let Some(party) = conversation.parties.first_mut() {
                    party.state = AFTER_NOT_UNDERSTOOD;
                }
                let rare = conversation.rare();
                rare.last_sent = observed.own.then(|| last_sent(true, bound));
                // The sender may have claimed its role.
                rare.contested |= rare.claimed && !observed.own;
                let passed = Passed::in_state_of(conversation, machine, index);
                self.touch(at, now.millis());
                Ok(passed)
            }
            // An agent without a role yet may have one.
            Err(_)
                if (observed.own || !peers.is_empty())
                    && [CANCEL, FAILURE, NOT_UNDERSTOOD].contains(&observed.act) =>
            {
                Err(Denied::Unchecked(Unchecked::BegunElsewhere))
            }
            // The undelivered message has arrived only if the agent has the role that it claims.
            Err(_) if observed.own && conversation.rare().uncertain => {
                Err(Denied::Unchecked(Unchecked::UnknownHistory))
            }
            // Another agent may have claimed the role of the sender.
            Err(_) if !takes_part && conversation.rare().claimed => {
                conversation.rare().contested = true;
                Err(Denied::Unchecked(Unchecked::UnknownHistory))
            }
            Err(NotLocal::Ended) => fault(Kind::Ended, state),
            Err(NotLocal::Unexpected) if peers.is_empty() && !observed.own => {
                fault(Kind::Stranger, state)
            }
            Err(NotLocal::Unexpected) if peers.is_empty() => fault(Kind::WrongReceiver, state),
            Err(NotLocal::Unexpected) => fault(Kind::Unexpected, state),
        }
    }
}

/// Gives a free role to the other side of a message. A sender that the monitored agent knows only from this
/// message claims the role, and `uncertain` are the roles of the monitored agent that the message excludes.
fn bind(
    conversation: &mut Conversation,
    names: &mut Names,
    observed: &ObservedMessage<'_>,
    role: Role,
    uncertain: impl FnOnce() -> RoleSet,
) {
    let agents = match observed.own {
        true => observed.receivers,
        false => &[observed.sender.into()][..],
    };
    for name in agents {
        let agent = conversation.acquire(names, name);
        conversation.bound.push(RoleBinding { role, agent });
    }
    let began = names.is(conversation.initiator, observed.sender);
    let rare = conversation.rare();
    // The monitored agent has asked the sender to take the role: the sender has no role of which it has
    // asked only others.
    let is_asked = rare.asked.iter().any(|asked| asked.role == role);
    if !observed.own && !began && !is_asked {
        rare.claimed = true;
        rare.uncertain |= rare.undelivered;
        rare.uncertain_roles |= uncertain();
    }
    conversation.release_asked(names, |asked| asked == role);
}

/// Returns a conversation after this message, if the message can be the first one that the monitored agent
/// sees.
fn begun(projection: &Projection, observed: &ObservedMessage<'_>) -> Option<LocalRun> {
    let mut run = LocalRun::new(projection.locals(), RoleSet::ALL);
    let message = Observed {
        act: observed.act,
        own: observed.own,
        peers: RoleSet::ALL,
    };
    run.take(projection.locals(), message).ok()?;
    Some(run)
}

/// Returns the roles of the monitored agent of which this is the first message of the protocol.
fn begun_roles(projection: &Projection, observed: &ObservedMessage<'_>) -> RoleSet {
    let run = begun(projection, observed).filter(|run| !run.waits());
    run.map_or(RoleSet::NONE, |run| run.roles())
}

/// Takes a message of the monitored agent back, if it is its last one in the conversation, and if no
/// message has shown that it arrived.
pub(crate) fn take_back_local(
    machine: &Machine,
    conversation: &mut Conversation,
    names: &mut Names,
    sent: &SentMessage<'_>,
) -> bool {
    let Some(rare) = conversation.rare.as_deref_mut() else {
        return false;
    };
    let is_it = |last: &mut LastSent| last.act == sent.act && last.reply_with == sent.reply_with;
    let Some((sent, run)) = rare.last_sent.take_if(is_it).zip(rare.local.as_mut()) else {
        return false;
    };
    let mut state = sent.state;
    if !sent.ends {
        run.take_back();
        let locals = machine.projection.as_deref().map(Projection::locals);
        let local = locals.and_then(|locals| run.state(locals));
        state = local.map_or(state, |local| local.global_in(machine));
        // It may be sent to another agent instead.
        let asked = conversation.bound.remove(sent.bound..sent.bound_after);
        conversation.release_asked(names, |_| true);
        let rare = conversation.rare();
        (rare.asked, rare.undelivered) = (asked, true);
    }
    if let Some(party) = conversation.parties.first_mut() {
        party.state = state;
    }
    true
}

/// Returns the roles that no agent has, and the message with the roles that the other side may have. An
/// agent with a role has no other one, and no other agent has the role of the monitored one.
fn observed_by_role<'a>(
    machine: &Machine,
    conversation: &Conversation,
    names: &Names,
    observed: &ObservedMessage<'a>,
) -> (RoleSet, Observed<'a>) {
    let run = conversation.rare.as_deref();
    let run = run.and_then(|rare| rare.local.as_ref());
    let own_role = run
        .and_then(LocalRun::role)
        .map_or(RoleSet::NONE, RoleSet::of);
    let free = unbound(machine, conversation) & !own_role;
    // Roles of which an undelivered message has asked others.
    let asked_others = |name: &str| {
        let asked = conversation.rare.as_deref().map(|rare| &rare.asked);
        let asked = || asked.into_iter().flatten();
        let others: RoleSet = asked().map(|asked| asked.role).collect();
        let own = asked().filter(|asked| names.is(asked.agent, name));
        others & !own.map(|asked| asked.role).collect::<RoleSet>()
    };
    let may = |name: &str| {
        let bound = conversation.bound.iter();
        let held = bound.filter(|bound| names.is(bound.agent, name));
        let held: RoleSet = held.map(|bound| bound.role).collect();
        match held.is_empty() {
            false => held,
            true if observed.own => free,
            true => free & !asked_others(name),
        }
    };
    let peers = match observed.own {
        true => {
            let receivers = observed.receivers.iter();
            receivers.fold(RoleSet::ALL, |all, name| all & may(name))
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
