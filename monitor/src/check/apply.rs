//! Changes of a conversation by an accepted message or by a timeout.

use crate::check::alternatives::{PartiesBefore, keep_alternatives};
use crate::check::copies::{CopyKey, keep_copied};
use crate::check::judge::{Move, MoveTarget, unbound};
use crate::check::observed::ObservedMessage;
use crate::check::outcome::Passed;
use crate::clock::span_millis;
use crate::conversation::Conversation;
use crate::conversation::bindings::RoleBinding;
use crate::conversation::deadlines::{Deadline, Deadlines};
use crate::conversation::ids::PartyIndex;
use crate::conversation::names::Names;
use crate::conversation::party::{Party, Side, side_index};
use crate::conversation::state::{CANCELLING, FAILED};
use crate::protocol::act::{ActNumber, CANCEL};
use crate::protocol::index::StateId;
use crate::protocol::machine::{After, Machine, Scope};
use crate::protocol::role::{MessageRoles, Role, RoleSet};

/// Applies the timeouts that are due.
pub(crate) fn expire(machine: &Machine, conversation: &mut Conversation, now: u64) {
    for party in conversation.parties.iter_mut() {
        if party.deadline != 0 && party.deadline < now {
            expire_party(machine, party);
        }
    }
}

/// Applies the timeout of the party's state, which is due.
pub(crate) fn expire_party(machine: &Machine, party: &mut Party) {
    let timeout = machine.state(party.state).and_then(|state| state.timeout);
    if let Some(timeout) = timeout {
        party.before = party.state;
        party.state = timeout.target;
    }
}

/// Applies an accepted message to its conversation.
pub(crate) struct Change<'a> {
    pub(crate) machine: &'a Machine,
    pub(crate) names: &'a mut Names,
    pub(crate) deadlines: &'a mut Deadlines,
    pub(crate) observed: &'a ObservedMessage<'a>,
    pub(crate) deadline: Deadline,
    pub(crate) now: u64,
    /// The message's `reply-by`, or 0.
    pub(crate) due: u64,
    pub(crate) opened: bool,
    pub(crate) late: bool,
    pub(crate) void: bool,
    pub(crate) state: Option<StateId>,
}

impl Change<'_> {
    /// Makes the moves, and returns the result. `copy` is the copy of the message for one receiver.
    #[inline]
    pub(crate) fn apply(
        mut self,
        conversation: &mut Conversation,
        moves: &[Move],
        copy: Option<CopyKey>,
    ) -> Passed {
        let before = PartiesBefore::of(conversation, self.machine);
        for party_move in moves {
            if self.machine.scope == Scope::Conversation {
                self.bind(conversation, party_move.next_state.roles);
            }
            self.make_move(conversation, party_move);
        }
        if !self.observed.reply_to.is_empty() {
            if self.names_designated(conversation, moves) {
                self.designate(conversation);
            } else {
                self.delegate(conversation, moves);
            }
        }
        if let Some((copy, first)) = copy.zip(moves.first()) {
            keep_copied(conversation, copy, first.next_state.roles);
        }
        if let Some(before) = before {
            keep_alternatives(self.machine, conversation, self.observed, moves, before);
        }
        let passed = Passed::in_state_of(conversation, self.machine, conversation.machine);
        Passed {
            state: self.state.unwrap_or(passed.state),
            opened: self.opened,
            late: self.late,
            void: self.void,
            ..passed
        }
    }

    fn make_move(&mut self, conversation: &mut Conversation, party_move: &Move) {
        let fresh = |peer| Party::new(peer, self.machine.initial);
        let index = match party_move.target {
            MoveTarget::Party(index) => index,
            MoveTarget::Receiver(number) => {
                let receiver = self.observed.receivers.get(number);
                let peer = conversation.acquire(self.names, receiver.map_or("", |name| name));
                conversation.add(fresh(Some(peer)))
            }
            MoveTarget::Sender => {
                let peer = conversation.acquire(self.names, self.observed.sender);
                let unnamed = conversation.unnamed().cloned();
                let party = unnamed.unwrap_or_else(|| fresh(None));
                conversation.add(Party {
                    peer: Some(peer),
                    ..party
                })
            }
            MoveTarget::Unnamed => {
                let unnamed = conversation.rare().unnamed.take();
                self.opened |= unnamed.is_none();
                let mut party = match unnamed {
                    Some(party) => party,
                    None => Box::new(fresh(None)),
                };
                self.move_party(&mut party, party_move);
                conversation.rare().unnamed = Some(party);
                return;
            }
        };
        self.opened |= party_move.target.is_new();
        if let Some(party) = conversation.parties.get_mut(index) {
            self.opened |= party.acts == [None; 2] && !party_move.reported;
            self.move_party(party, party_move);
            if party.deadline != 0 {
                self.deadlines.push(Deadline {
                    due: party.deadline,
                    party: PartyIndex::new(index),
                    ..self.deadline
                });
            }
        }
    }

    fn move_party(&mut self, party: &mut Party, party_move: &Move) {
        let Move {
            side, next_state, ..
        } = party_move;
        let side = *side;
        if let Some(world) = next_state.world {
            party.settle(world);
        }
        let answers = party.last != side && !party_move.reported;
        self.late |= party.deadline != 0 && party.deadline < self.now && answers;
        let cancels = next_state.state == CANCELLING && party.state != CANCELLING;
        if next_state.void {
            if self.observed.act == CANCEL && next_state.echo && !party.echo {
                party.canceling_side = side;
                party.set_cancel(self.observed.reply_with);
            }
            (party.state, party.resume, party.echo) =
                (next_state.state, next_state.resume, next_state.echo);
            self.state = self.state.or(Some(party.state));
            (self.late, self.void) = (true, true);
            return;
        }
        if party_move.reported && party.state != FAILED && party.take_back_last(side) {
            self.state = self.state.or(Some(party.state));
            return;
        }
        if party_move.reported || next_state.state == FAILED {
            // The message that failed may be sent again, from the state before it.
            (party.state, party.resume, party.echo) =
                (next_state.state, next_state.resume, next_state.echo);
            self.state = self.state.or(Some(party.state));
            return;
        }
        party.begin_step(
            side,
            ActNumber::of(self.observed.act),
            self.observed.reply_with,
            cancels,
        );
        party.before = next_state.before.unwrap_or(party.state);
        if cancels {
            party.canceling_side = side;
            party.set_cancel(self.observed.reply_with);
        } else if !next_state.answers_cancel {
            let index = side_index(side);
            party.acts[index] = Some(ActNumber::of(self.observed.act));
            party.ask(
                side,
                self.observed.reply_with,
                self.observed.reply_with_text,
            );
        }
        (party.state, party.resume, party.echo) =
            (next_state.state, next_state.resume, next_state.echo);
        if !next_state.crossed {
            party.last = side;
        }
        let timeout = self
            .machine
            .state(party.state)
            .and_then(|state| state.timeout);
        party.deadline = match timeout.map(|timeout| timeout.after) {
            Some(After::Span(span)) => self.now.saturating_add(span_millis(span)),
            _ => self.due,
        };
        self.state = self.state.or(Some(party.state));
    }

    /// Binds free roles of a step to the sender and the receivers.
    fn bind(&mut self, conversation: &mut Conversation, roles: MessageRoles) {
        let free = unbound(self.machine, conversation);
        let names = &mut *self.names;
        let mut give = |roles: RoleSet, agent: &str| {
            if let Some(role) = roles.only().filter(|role| free.contains(*role)) {
                let agent = conversation.acquire(names, agent);
                conversation.bound.push(RoleBinding { role, agent });
            }
        };
        give(roles.from, self.observed.sender);
        for receiver in self.observed.receivers {
            give(roles.to, receiver);
        }
    }

    /// Whether the `reply-to` of the message counts: the sender is the initiator, or an agent that
    /// continues in its place.
    fn names_designated(&self, conversation: &Conversation, moves: &[Move]) -> bool {
        let sender = self.observed.sender;
        self.names.is(conversation.initiator, sender)
            || conversation.is_designated(self.names, sender)
                && moves
                    .iter()
                    .any(|party_move| party_move.side == Side::Initiator)
    }

    /// Adds the agents of the `reply-to`: they receive replies instead of the initiator.
    fn designate(&mut self, conversation: &mut Conversation) {
        for name in self.observed.reply_to {
            let known = conversation.reply_to().iter();
            let mut known = known.copied().chain(conversation.initiator);
            if !known.any(|agent| self.names.is(agent, name)) {
                let name = conversation.acquire(self.names, name);
                conversation.rare().reply_to.push(name);
            }
        }
    }

    /// Adds the agents of the `reply-to` of a participant: they receive messages instead of it
    /// (FIPA00061), and may continue in its place.
    fn delegate(&mut self, conversation: &mut Conversation, moves: &[Move]) {
        if self.machine.scope == Scope::Conversation {
            let sender = self.observed.sender;
            let bound = conversation.bound.iter();
            let held = bound.filter(|bound| self.names.is(bound.agent, sender));
            let held: Vec<Role> = held.map(|bound| bound.role).collect();
            for (name, role) in self
                .observed
                .reply_to
                .iter()
                .flat_map(|name| held.iter().map(move |role| (name, *role)))
            {
                let mut bound = conversation.bound.iter();
                if !bound.any(|bound| bound.role == role && self.names.is(bound.agent, name)) {
                    let agent = conversation.acquire(self.names, name);
                    conversation.bound.push(RoleBinding { role, agent });
                }
            }
            return;
        }
        let sender = conversation.party(self.names, self.observed.sender);
        let Some(at) = sender.map(|(at, _)| at) else {
            return;
        };
        let answers = |party_move: &Move| party_move.side == Side::Other;
        if !moves.iter().any(answers) {
            return;
        }
        let index = PartyIndex::new(at);
        for name in self.observed.reply_to {
            let known = self.names.is(conversation.initiator, name)
                || conversation.party(self.names, name).is_some();
            if !known {
                let name = conversation.acquire(self.names, name);
                conversation.rare().delegates.push((index, name));
            }
        }
    }
}
