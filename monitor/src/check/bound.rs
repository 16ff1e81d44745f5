//! Bounds of the participants, the roles and the bytes that a message adds to its conversation.

use std::borrow::Cow;

use crate::Header;
use crate::check::judge::{Move, MoveTarget, unbound};
use crate::check::observed::ObservedMessage;
use crate::conversation::Conversation;
use crate::conversation::names::Names;
use crate::conversation::party::Party;
use crate::conversation::rare::Copied;
use crate::limits::MAX_DESIGNATED;
use crate::protocol::machine::{Machine, Scope};

/// Whether the message names more agents in `reply-to` than a conversation keeps.
pub(crate) fn is_crowded(conversation: &Conversation, names: &Names, header: &Header<'_>) -> bool {
    let reply_to = header.reply_to_names();
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
    let kept = conversation.reply_to().len() + conversation.delegates().len();
    kept + reply_to.iter().filter(new).count() > MAX_DESIGNATED
}

/// The role bindings that a message adds at most, with one state for all participants.
#[derive(Debug, Default)]
pub(crate) struct NewBindings {
    /// Of the sender: 0 or 1.
    sender: usize,
    /// Of the receivers: one each, or none.
    receivers: usize,
    /// Of the agents in the `reply-to` of a participant: each role of the participant.
    delegates: usize,
}

impl NewBindings {
    pub(crate) fn by(
        machine: &Machine,
        conversation: &Conversation,
        names: &Names,
        observed: &ObservedMessage<'_>,
        moves: &[Move],
        header: &Header<'_>,
    ) -> Self {
        let Some(made) = moves
            .first()
            .filter(|_| machine.scope == Scope::Conversation)
        else {
            return Self::default();
        };
        let free = unbound(machine, conversation);
        let (from, to) = made.next_state.roles;
        // A pattern of several roles binds none.
        let binds = |roles: u32| roles & free != 0 && roles.count_ones() == 1;
        let sender = usize::from(binds(from));
        let reply_to = header.reply_to_names().len();
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
        Self {
            sender,
            receivers: if binds(to) {
                observed.receivers.len()
            } else {
                0
            },
            delegates,
        }
    }

    pub(crate) fn count(&self) -> usize {
        self.sender + self.receivers + self.delegates
    }
}

/// Returns an upper bound of the bytes that a message adds to a conversation: with new participants, roles
/// or agents in `reply-to`, as the first of several copies, or as the report of undelivered messages.
pub(crate) fn growth_by(
    machine: &Machine,
    conversation: &Conversation,
    observed: &ObservedMessage<'_>,
    (moves, bindings, is_copied): (&[Move], &NewBindings, bool),
    header: &Header<'_>,
) -> usize {
    let name = |name: &Cow<'_, str>| Names::cost(name.len());
    let sender = Names::cost(observed.sender.len());
    let reply_to = header.reply_to_names();
    let designated = reply_to.iter().map(name).sum::<usize>();
    let reported = moves.iter().filter(|made| made.reported).count() * Party::GROWTH_BY_REPORT;
    let growth = match machine.scope {
        Scope::Participant => {
            let new = moves.iter().filter_map(|made| match made.target {
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
            let copies = match is_copied {
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
