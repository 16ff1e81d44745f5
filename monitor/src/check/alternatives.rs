//! Conversations that may have begun before the monitor: the states to which their first message may have led.

use crate::Moment;
use crate::check::judge::{Move, MoveTarget};
use crate::check::next_state::NextState;
use crate::check::observed::ObservedMessage;
use crate::check::outcome::Denied;
use crate::conversation::Conversation;
use crate::conversation::ids::{PartyIndex, SlotIndex};
use crate::conversation::state::{CANCELLED, CANCELLING, FAILED};
use crate::monitor::Monitor;
use crate::protocol::index::StateId;
use crate::protocol::machine::{Machine, Scope, step};
use crate::protocol::role::RoleSet;
use crate::verdict::Unchecked;

impl Monitor {
    /// Reconsiders the refusal of a message in a conversation of which the monitor may not know all.
    #[cold]
    pub(crate) fn recheck(
        &mut self,
        at: SlotIndex,
        observed: &ObservedMessage<'_>,
        denied: Denied,
        now: Moment,
    ) -> Denied {
        if observed.undelivered_to.is_some() {
            return denied;
        }
        let denied = self.recheck_delegated(at, observed, denied, now);
        self.recheck_beginning(at, denied)
    }

    /// If a conversation may have begun before the monitor, a violation is none: it shows that the
    /// first message continued the conversation.
    fn recheck_beginning(&mut self, at: SlotIndex, denied: Denied) -> Denied {
        let slot = self.table.slot(at);
        let rare = slot.and_then(|slot| slot.conversation.rare.as_deref());
        let uncertain = rare.is_some_and(|rare| !rare.alternatives.is_empty());
        match denied {
            Denied::Fault(..) if uncertain => {
                self.forget(at);
                Denied::Unchecked(Unchecked::UnknownHistory)
            }
            denied => denied,
        }
    }
}

/// The parties of a conversation before a message.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PartiesBefore {
    /// Number of the parties with messages.
    count: usize,
    has_unnamed: bool,
}

impl PartiesBefore {
    /// Returns the parties of a conversation that may have begun before the monitor.
    #[inline]
    pub(crate) fn of(conversation: &Conversation, machine: &Machine) -> Option<Self> {
        let rare = conversation.rare.as_deref();
        let may_continue = rare.is_some_and(|rare| rare.may_continue);
        may_continue.then(|| Self::known(conversation, machine))
    }

    #[cold]
    fn known(conversation: &Conversation, machine: &Machine) -> Self {
        let mut parties = conversation.parties.iter();
        // With one state for all participants, the party exists before the first message.
        let is_new =
            machine.scope == Scope::Conversation && parties.all(|party| party.acts == [None; 2]);
        Self {
            count: if is_new {
                0
            } else {
                conversation.parties.len()
            },
            has_unnamed: conversation.unnamed().is_some(),
        }
    }
}

/// In a conversation that may have begun before the monitor: notes the other states to which the first
/// message to a party may have led, and removes those which a later message does not fit.
#[cold]
pub(crate) fn keep_alternatives(
    machine: &Machine,
    conversation: &mut Conversation,
    observed: &ObservedMessage<'_>,
    moves: &[Move],
    before: PartiesBefore,
) {
    let count = conversation.parties.len();
    let Some(rare) = conversation.rare.as_deref_mut() else {
        return;
    };
    let index = |at: usize| Some(PartyIndex::new(at));
    let step_of = |party: Option<PartyIndex>| {
        let mut steps = moves.iter().filter(|party_move| {
            let NextState { void, state, .. } = party_move.next_state;
            !void && !party_move.reported && state != FAILED
        });
        steps.find(|party_move| match party_move.target {
            MoveTarget::Party(at) => index(at) == party,
            MoveTarget::Unnamed => party.is_none(),
            MoveTarget::Receiver(_) | MoveTarget::Sender => false,
        })
    };
    // A cancel and its answers fit any state, but a message may also be a step of the protocol.
    let fits_any_state = |party_move: &Move| {
        let NextState { state, crossed, .. } = party_move.next_state;
        party_move.next_state.answers_cancel || [CANCELLING, CANCELLED].contains(&state) && !crossed
    };
    let alternatives = std::mem::take(&mut rare.alternatives);
    let remaining = alternatives.into_iter().flat_map(|(party, state)| {
        let party_move = step_of(party).filter(|_| state != FAILED);
        let stays = party_move.is_none_or(fits_any_state);
        let step = party_move.and_then(|_| {
            let state = machine.state(state)?;
            step(&state.steps, observed.act, RoleSet::ALL, RoleSet::ALL)
        });
        let stays = stays.then_some((party, state));
        stays
            .into_iter()
            .chain(step.map(|step| (party, step.target)))
    });
    let reported = moves.iter().filter(|party_move| party_move.reported);
    let reported = reported.filter_map(|party_move| match party_move.target {
        MoveTarget::Party(at) => Some(any_state_of(at)),
        MoveTarget::Unnamed | MoveTarget::Receiver(_) | MoveTarget::Sender => None,
    });
    rare.alternatives = remaining.chain(reported).collect();
    rare.alternatives.sort_unstable();
    rare.alternatives.dedup();
    let first = &machine.initial().steps;
    let Some(first) = step(first, observed.act, RoleSet::ALL, RoleSet::ALL) else {
        return;
    };
    let unnamed = (rare.unnamed.is_some() && !before.has_unnamed).then_some(None);
    let new = (before.count..count).map(index);
    let others = machine.later_targets(observed.act, first);
    for party in new.chain(unnamed) {
        let others = others.iter().map(|state| (party, *state));
        rare.alternatives.extend(others);
    }
}

/// The entry of [`Rare::alternatives`](crate::conversation::rare::Rare::alternatives) of a party after an
/// undelivered message: the state before the first known message is unknown, and a message that has ruled
/// out states has no effect.
pub(crate) fn any_state_of(party: usize) -> (Option<PartyIndex>, StateId) {
    (Some(PartyIndex::new(party)), FAILED)
}
