//! Bounds of the participants, the roles and the bytes that a message adds to its conversation.

use std::borrow::Cow;

use crate::MonitorLimits;
use crate::check::judge::{Move, MoveTarget, unbound};
use crate::check::observed::ObservedMessage;
use crate::conversation::Conversation;
use crate::conversation::names::Names;
use crate::conversation::party::Party;
use crate::conversation::rare::Copied;
use crate::conversation::table::Slot;
use crate::limits::MAX_DESIGNATED;
use crate::protocol::machine::{Machine, Scope};
use crate::protocol::role::{MessageRoles, RoleSet};

/// The parts that an accepted message adds to its conversation.
pub(crate) struct Additions<'a> {
    pub(crate) machine: &'a Machine,
    pub(crate) conversation: &'a Conversation,
    pub(crate) names: &'a Names,
    pub(crate) observed: &'a ObservedMessage<'a>,
    pub(crate) moves: &'a [Move],
    /// Whether further copies of the message may follow.
    pub(crate) is_copied: bool,
}

/// The role bindings that a message adds at most, with one state for all participants.
#[derive(Debug, Default)]
struct NewBindings {
    /// Of the sender: 0 or 1.
    sender: usize,
    /// Of the receivers: one each, or none.
    receivers: usize,
    /// Of the agents in the `reply-to` of a participant: each role of the participant.
    delegates: usize,
}

impl NewBindings {
    fn count(&self) -> usize {
        self.sender + self.receivers + self.delegates
    }
}

impl Additions<'_> {
    /// Whether the conversation is within the limits with them.
    #[inline]
    pub(crate) fn fit(&self, limits: &MonitorLimits) -> bool {
        let conversation = self.conversation;
        let is_new = |party_move: &&Move| party_move.target.is_new();
        let added = self.moves.iter().filter(is_new).count();
        let bindings = self.bindings();
        let has_reply_to = !self.observed.reply_to.is_empty();
        let adds = added > 0 || has_reply_to || self.observed.undelivered_to.is_some();
        let growth = if adds || self.machine.scope == Scope::Conversation {
            self.growth(&bindings)
        } else {
            0
        };
        let size = || Slot::COST + conversation.allocated() + growth;
        conversation.parties.len() + added <= limits.participants
            && conversation.bound.len() + bindings.count() <= limits.participants + 1
            && !self.is_crowded()
            && (growth == 0 || size() <= limits.share_of_bytes())
    }

    /// Whether the message names more agents in `reply-to` than a conversation keeps.
    fn is_crowded(&self) -> bool {
        let (conversation, names) = (self.conversation, self.names);
        let reply_to = self.observed.reply_to;
        if reply_to.is_empty() {
            return false;
        }
        let new = |name: &&Cow<'_, str>| {
            !conversation.is_designated(names, name)
                && !conversation
                    .delegates()
                    .iter()
                    .any(|(_, known)| names.is(*known, name))
        };
        let known = conversation.reply_to().len() + conversation.delegates().len();
        known + reply_to.iter().filter(new).count() > MAX_DESIGNATED
    }

    fn bindings(&self) -> NewBindings {
        let (machine, conversation) = (self.machine, self.conversation);
        let (names, observed) = (self.names, self.observed);
        let Some(first) = self
            .moves
            .first()
            .filter(|_| machine.scope == Scope::Conversation)
        else {
            return NewBindings::default();
        };
        let free = unbound(machine, conversation);
        let MessageRoles { from, to } = first.next_state.roles;
        // A pattern of several roles binds none.
        let binds = |roles: RoleSet| roles.only().is_some_and(|role| free.contains(role));
        let sender = usize::from(binds(from));
        let reply_to = observed.reply_to.len();
        let leads = || conversation.speaks_for_initiator(names, observed.sender);
        let delegates = match reply_to {
            0 => 0,
            _ if leads() => 0,
            _ => {
                let bound = conversation.bound.iter();
                let held = bound.filter(|bound| names.is(bound.agent, observed.sender));
                (held.count() + sender) * reply_to
            }
        };
        NewBindings {
            sender,
            receivers: if binds(to) {
                observed.receivers.len()
            } else {
                0
            },
            delegates,
        }
    }

    /// Returns an upper bound of the bytes that a message adds to a conversation: with new participants, roles
    /// or agents in `reply-to`, as the first of several copies, or as the report of undelivered messages.
    fn growth(&self, bindings: &NewBindings) -> usize {
        let (conversation, observed) = (self.conversation, self.observed);
        let name = |name: &Cow<'_, str>| Names::cost(name.len());
        let sender = Names::cost(observed.sender.len());
        let reply_to = observed.reply_to;
        let designated = reply_to.iter().map(name).sum::<usize>();
        let reported = self
            .moves
            .iter()
            .filter(|party_move| party_move.reported)
            .count()
            * Party::GROWTH_BY_REPORT;
        let growth = match self.machine.scope {
            Scope::Participant => {
                let new = self
                    .moves
                    .iter()
                    .filter_map(|party_move| match party_move.target {
                        MoveTarget::Receiver(number) => observed.receivers.get(number).map(name),
                        MoveTarget::Sender => Some(sender),
                        MoveTarget::Party(_) | MoveTarget::Unnamed => None,
                    });
                let growth = conversation.growth(new.clone().count(), 0, reply_to.len());
                growth + new.sum::<usize>() + designated
            }
            Scope::Conversation => {
                let receivers = match bindings.receivers {
                    0 => &[],
                    _ => observed.receivers,
                };
                // The agents in `reply-to` have a name each, and one for each binding.
                let held = bindings.delegates.checked_div(reply_to.len());
                let copies = match self.is_copied {
                    true => Copied::MAX * size_of::<Copied>() + size_of::<u64>(),
                    false => 0,
                };
                conversation.growth(0, bindings.count(), reply_to.len())
                    + bindings.sender * sender
                    + receivers.iter().map(name).sum::<usize>()
                    + held.unwrap_or(0).max(1) * designated
                    + copies
            }
        };
        growth + reported
    }
}
