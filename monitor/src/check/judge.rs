//! Checks a message against its conversation and computes the moves of all concerned parties. This
//! module does not change the conversation.

use std::collections::HashMap;

use fipa_acl::is_pattern;

use crate::check::next_state::{NextState, PartyMessage, next_state};
use crate::check::observed::ObservedMessage;
use crate::check::outcome::Fault;
use crate::conversation::Conversation;
use crate::conversation::ids::Name;
use crate::conversation::names::Names;
use crate::conversation::party::{Party, Side, side_index};
use crate::conversation::state::{AFTER_NOT_UNDERSTOOD, CANCELLED, CANCELLING, ELSEWHERE, FAILED};
use crate::protocol::act::{FAILURE, INFORM};
use crate::protocol::machine::{Cancel, Guard, Machine, Scope, step};
use crate::protocol::role::RoleSet;
use crate::verdict::ViolationKind as Kind;

/// The state transition of one party.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Move {
    pub(crate) target: MoveTarget,
    pub(crate) side: Side,
    pub(crate) next_state: NextState,
    /// Whether a message transport service reported a failure, so no party has sent a message.
    pub(crate) reported: bool,
}

/// The party that a move changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MoveTarget {
    /// The party with this index.
    Party(usize),
    /// A new party: the receiver with this index.
    Receiver(usize),
    /// The members of a multicast that have not answered yet.
    Unnamed,
    /// A new party: the sender, a member of a multicast.
    Sender,
}

impl MoveTarget {
    /// Whether the move adds a party with a name.
    pub(crate) fn is_new(self) -> bool {
        matches!(self, Self::Receiver(_) | Self::Sender)
    }
}

/// Writes all moves to `moves`, or returns the first fault.
pub(crate) fn judge(
    machine: &Machine,
    conversation: &Conversation,
    names: &Names,
    observed: &ObservedMessage<'_>,
    moves: &mut Vec<Move>,
) -> Result<(), Fault> {
    moves.clear();
    let judge = Judge {
        machine,
        conversation,
        names,
        observed,
    };
    match machine.scope {
        Scope::Participant => {
            judge.per_participant(moves)?;
            judge.guards(moves)
        }
        Scope::Conversation => judge.per_conversation(moves),
    }
}

struct Judge<'a> {
    machine: &'a Machine,
    conversation: &'a Conversation,
    names: &'a Names,
    observed: &'a ObservedMessage<'a>,
}

impl Judge<'_> {
    fn per_participant(&self, moves: &mut Vec<Move>) -> Result<(), Fault> {
        let sender = self.observed.sender;
        if self.names.is(self.conversation.initiator, sender) {
            return self.by_initiator(moves);
        }
        let known = self.party(sender);
        let known = known.map(|(at, party)| (MoveTarget::Party(at), party));
        // A service is no member of the multicast.
        let unnamed = self.conversation.unnamed();
        let unnamed = unnamed.filter(|_| self.observed.undelivered_to.is_none());
        let Some((target, party)) = known.or(unnamed.map(|party| (MoveTarget::Sender, party)))
        else {
            if self.conversation.is_designated(self.names, sender) {
                return self.by_initiator(moves);
            }
            if let Some(lost) = self.observed.undelivered_to
                && self.all_take_part()
            {
                self.reported_failure(lost, moves);
                return Ok(());
            }
            return Err(Fault::plain(Kind::Stranger));
        };
        self.by_participant(target, party, moves).or_else(|fault| {
            // A participant may also have been named in a `reply-to`.
            if !self.conversation.is_designated(self.names, sender) {
                return Err(fault);
            }
            self.by_initiator(moves).map_err(|other| match fault.kind {
                Kind::WrongReceiver => other,
                _ => fault,
            })
        })
    }

    /// Checks a message of the initiator, or of an agent that continues in its place. The latter can
    /// address only agents that already take part.
    fn by_initiator(&self, moves: &mut Vec<Move>) -> Result<(), Fault> {
        let fresh = Party::new(None, self.machine.initial);
        let conversation = self.conversation;
        let began =
            !conversation.joined && self.names.is(conversation.initiator, self.observed.sender);
        // The monitored agent does not know the answers of the other receivers of the same message.
        let own = self
            .observed
            .own_receiver
            .and_then(|at| self.observed.receivers.get(at));
        for (number, receiver) in self.observed.receivers.iter().enumerate() {
            if own.is_some_and(|agent| receiver != agent && !is_pattern(receiver)) {
                continue;
            }
            let (target, party) = match self.party(receiver) {
                Some((at, party)) => (MoveTarget::Party(at), party),
                None if is_pattern(receiver) && (began || conversation.unnamed().is_some()) => {
                    let unnamed = conversation.unnamed();
                    (MoveTarget::Unnamed, unnamed.unwrap_or(&fresh))
                }
                None if began => (MoveTarget::Receiver(number), &fresh),
                None => return Err(self.fault(Kind::WrongReceiver, &fresh, receiver)),
            };
            let message = self.message(Side::Initiator);
            let mut led = next_state(self.machine, party, &message)
                .map(|next_state| (Side::Initiator, next_state));
            // An agent that sends to itself has both roles.
            if led.is_err() && **receiver == *self.observed.sender {
                let answer = next_state(self.machine, party, &self.message(Side::Other));
                led = answer.map(|next_state| (Side::Other, next_state)).or(led);
            }
            let (side, next_state) = led.map_err(|kind| self.fault(kind, party, receiver))?;
            // Several patterns have one state, and so have a participant and its delegates.
            let shared = target == MoveTarget::Unnamed || !conversation.delegates().is_empty();
            let again = shared && moves.iter().any(|party_move| party_move.target == target);
            if !again {
                let reported = false;
                moves.push(Move {
                    target,
                    side,
                    next_state,
                    reported,
                });
            }
        }
        Ok(())
    }

    fn by_participant(
        &self,
        target: MoveTarget,
        party: &Party,
        moves: &mut Vec<Move>,
    ) -> Result<(), Fault> {
        let mut receivers = self.observed.receivers.iter();
        let misdirected = receivers.any(|receiver| !self.gets_replies(receiver));
        let name = self.observed.sender;
        if misdirected {
            return Err(self.fault(Kind::WrongReceiver, party, name));
        }
        let next_state = next_state(self.machine, party, &self.message(Side::Other))
            .map_err(|kind| self.fault(kind, party, name))?;
        let next_state = match self.may_answer_unseen_cancel(party, &next_state) {
            true => NextState::to(ELSEWHERE),
            false => next_state,
        };
        moves.push(Move {
            target,
            side: Side::Other,
            next_state,
            reported: false,
        });
        Ok(())
    }

    /// Whether a message that fits the protocol may as well be the answer to a cancel that the monitor has
    /// not seen: the monitored agent has joined the conversation, for example after a restart. An agent
    /// that waits for the answer to its cancel sends nothing else.
    fn may_answer_unseen_cancel(&self, party: &Party, next_state: &NextState) -> bool {
        self.conversation.joined
            && self.machine.cancel != Cancel::Nobody
            && [INFORM, FAILURE].contains(&self.observed.act)
            && self.machine.state(next_state.state).is_some()
            && !next_state.void
            && !next_state.answers_cancel
            && party.acts[side_index(Side::Initiator)].is_none()
    }

    /// Handles the report of a message transport service: a message of the receiver was not delivered to
    /// the agent `lost`. Until it is sent again, the protocol has ended with it.
    fn reported_failure(&self, lost: &str, moves: &mut Vec<Move>) {
        let lost_party = self.party(lost);
        let leads = self.gets_replies(lost);
        for receiver in self.observed.receivers {
            let initiator = self.names.is(self.conversation.initiator, receiver);
            let designated = self.conversation.is_designated(self.names, receiver);
            let is_own = |party: &Party| !initiator && self.names.is(party.peer, receiver);
            let own = self.party(receiver).filter(|_| leads);
            let own = own.filter(|(_, party)| is_own(party));
            let own = own.map(|(at, party)| (at, party, Side::Other));
            let led = lost_party.filter(|(_, party)| (initiator || designated) && !is_own(party));
            let led = led.map(|(at, party)| (at, party, Side::Initiator));
            let may_be_lost = |(_, party, side): &(usize, &Party, Side)| {
                let asked = party.asked[side_index(*side)];
                let answers = self.observed.in_reply_to == 0
                    || asked == 0
                    || self.observed.in_reply_to == asked;
                party.may_have_last(*side) && answers
            };
            let mut concerned = own.into_iter().chain(led).filter(may_be_lost);
            let (Some((at, party, side)), None) = (concerned.next(), concerned.next()) else {
                continue;
            };
            let party_move = failed(at, party, side);
            // Several agents may speak for the initiator.
            let is_shared = lost_party.is_some_and(|(lost, _)| lost == at);
            if !is_shared || !moves.iter().any(|other| other.target == party_move.target) {
                moves.push(party_move);
            }
        }
    }

    fn all_take_part(&self) -> bool {
        let mut receivers = self.observed.receivers.iter();
        receivers.all(|receiver| self.gets_replies(receiver) || self.party(receiver).is_some())
    }

    /// Whether participants may send messages to this agent.
    fn gets_replies(&self, agent: &str) -> bool {
        self.names.is(self.conversation.initiator, agent)
            || self.conversation.is_designated(self.names, agent)
    }

    fn per_conversation(&self, moves: &mut Vec<Move>) -> Result<(), Fault> {
        let conversation = self.conversation;
        let Some(party) = conversation.parties.first() else {
            return Err(Fault::plain(Kind::NotOpened));
        };
        let sender = self.observed.sender;
        let side = if conversation.speaks_for_initiator(self.names, sender) {
            Side::Initiator
        } else {
            Side::Other
        };
        let unbound = unbound(self.machine, conversation);
        let known_roles = self.known_roles();
        let has = self.roles_of(sender);
        let (mut to, mut all_bound, mut stranger) = (RoleSet::ALL, !has.is_empty(), false);
        for receiver in self.observed.receivers {
            let roles = match &known_roles {
                None => self.roles_of(receiver),
                Some(known) => {
                    let name = self.names.known(receiver);
                    let roles = name.and_then(|name| known.get(&name));
                    roles.copied().unwrap_or(RoleSet::NONE)
                }
            };
            to &= roles | unbound;
            all_bound &= !roles.is_empty();
            stranger |= (roles | unbound).is_empty();
        }
        let message = PartyMessage {
            from: has | unbound,
            to,
            known: all_bound,
            answers: conversation.bound.len() == 2,
            ..self.message(side)
        };
        if let Some(lost) = self.observed.undelivered_to.filter(|_| has.is_empty()) {
            if stranger {
                return Err(Fault::plain(Kind::Stranger));
            }
            if !self.roles_of(lost).is_empty()
                && let Some(receiver) = self.observed.receivers.first()
            {
                let leads = conversation.speaks_for_initiator(self.names, receiver);
                let side = if leads { Side::Initiator } else { Side::Other };
                moves.push(failed(0, party, side));
            }
            return Ok(());
        }
        let outside = (has | unbound).is_empty();
        let next_state = match next_state(self.machine, party, &message) {
            Ok(next_state) => next_state,
            Err(kind) => {
                let kind = match kind {
                    _ if outside => Kind::Stranger,
                    Kind::Unexpected | Kind::OutOfOrder if stranger => Kind::WrongReceiver,
                    kind => kind,
                };
                let state = Some(party.state);
                let participant = None;
                return Err(Fault {
                    kind,
                    state,
                    participant,
                });
            }
        };
        moves.push(Move {
            target: MoveTarget::Party(0),
            side,
            next_state,
            reported: false,
        });
        Ok(())
    }

    fn roles_of(&self, agent: &str) -> RoleSet {
        let bound = self.conversation.bound.iter();
        let held = bound.filter(|bound| self.names.is(bound.agent, agent));
        let roles: RoleSet = held.map(|bound| bound.role).collect();
        if self.conversation.is_designated(self.names, agent) {
            return roles | RoleSet::of(self.machine.initiator);
        }
        roles
    }

    fn message(&self, side: Side) -> PartyMessage<'_> {
        let initiator = RoleSet::of(self.machine.initiator);
        let (from, to) = match side {
            Side::Initiator => (initiator, !initiator),
            Side::Other => (!initiator, initiator),
        };
        PartyMessage {
            act: self.observed.act,
            side,
            from,
            to,
            reply_with: self.observed.reply_with,
            in_reply_to: self.observed.in_reply_to,
            answers: true,
            own: self.observed.own,
            known: true,
        }
    }

    /// The roles of all agents, if the message has so many receivers that a search for each takes
    /// longer.
    fn known_roles(&self) -> Option<HashMap<Name, RoleSet>> {
        const FEW: usize = 8;
        if self.observed.receivers.len() <= FEW {
            return None;
        }
        let mut known = HashMap::new();
        for bound in self.conversation.bound.iter() {
            *known.entry(bound.agent).or_insert(RoleSet::NONE) |= RoleSet::of(bound.role);
        }
        for agent in self.conversation.reply_to() {
            *known.entry(*agent).or_insert(RoleSet::NONE) |= RoleSet::of(self.machine.initiator);
        }
        Some(known)
    }

    /// Checks the rules about several participants.
    fn guards(&self, moves: &[Move]) -> Result<(), Fault> {
        let Some(guarded) = moves
            .iter()
            .find(|party_move| party_move.next_state.guard != Guard::default())
        else {
            return Ok(());
        };
        let conversation = self.conversation;
        // The states of the others are unknown, if their messages go to another agent.
        let others_known = !conversation.joined && conversation.reply_to().is_empty();
        if !others_known {
            return Ok(());
        }
        // One message leads to one guarded state: its performative and roles are the same for all.
        let NextState {
            state: target,
            guard,
            ..
        } = guarded.next_state;
        let mut moved = vec![false; conversation.parties.len()];
        for party_move in moves {
            if let MoveTarget::Party(at) = party_move.target
                && let Some(moved) = moved.get_mut(at)
            {
                *moved = true;
            }
        }
        let parties = conversation.parties.iter().zip(&moved);
        let others = || parties.clone().filter(|(_, moved)| !**moved);
        let refuse = |party: &Party| {
            let peer = self.names.text(party.peer);
            Err(self.fault(Kind::Guard, party, peer))
        };
        if let Some(at_most) = guard.at_most {
            let reach = moves
                .iter()
                .filter(|party_move| party_move.next_state.state == target);
            let there = others().filter(|(party, _)| party.state == target);
            if reach.count() + there.clone().count() > usize::from(at_most.get()) {
                let mut blocking = there
                    .map(|(party, _)| party)
                    .chain(conversation.parties.iter());
                if let Some(party) = blocking.next() {
                    return refuse(party);
                }
                return Err(Fault::plain(Kind::Guard));
            }
        }
        if guard.when_all {
            let message = self.message(guarded.side);
            let ready = |party: &Party| match self.machine.state(party.state) {
                Some(own) => {
                    let step = step(&own.steps, message.act, message.from, message.to);
                    party.state == target || step.is_some_and(|step| step.guard.when_all)
                }
                None => true,
            };
            if let Some((party, _)) = others().find(|(party, _)| !ready(party)) {
                return refuse(party);
            }
        }
        Ok(())
    }

    fn party(&self, name: &str) -> Option<(usize, &Party)> {
        self.conversation.party(self.names, name)
    }

    fn fault(&self, kind: Kind, party: &Party, participant: &str) -> Fault {
        Fault {
            kind,
            state: Some(party.state),
            participant: Some(participant.to_owned()),
        }
    }
}

/// Returns the roles that no agent has.
pub(crate) fn unbound(machine: &Machine, conversation: &Conversation) -> RoleSet {
    let bound: RoleSet = conversation.bound.iter().map(|bound| bound.role).collect();
    RoleSet::first(machine.roles.len()) & !bound
}

/// Returns the move of a party of which a message of this side was not delivered.
pub(crate) fn failed(at: usize, party: &Party, side: Side) -> Move {
    let failed = |resume| NextState {
        resume,
        ..NextState::to(FAILED)
    };
    let next_state = match party.state {
        // An ended conversation does not continue.
        ended @ (AFTER_NOT_UNDERSTOOD | CANCELLED) => NextState {
            resume: party.resume,
            echo: party.echo,
            ..NextState::to(ended)
        },
        // The cancel was not delivered.
        CANCELLING => NextState::to(party.resume),
        FAILED => failed(party.resume),
        state => failed(state),
    };
    Move {
        target: MoveTarget::Party(at),
        side,
        next_state,
        reported: true,
    }
}
