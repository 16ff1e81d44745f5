//! The result of a check, before it becomes a verdict.

use crate::conversation::Conversation;
use crate::conversation::ids::SlotIndex;
use crate::conversation::state::is_final;
use crate::protocol::index::{MachineIndex, StateId};
use crate::protocol::machine::Machine;
use crate::verdict::{Unchecked, ViolationKind as Kind};

/// The reason that a message was not accepted.
pub(crate) enum Denied {
    Fault(Fault, SlotIndex),
    NotOpened(MachineIndex),
    /// Refused without a conversation; with a similar protocol, if there is one.
    Refused(Kind, Option<MachineIndex>),
    Unchecked(Unchecked),
}

/// The result of an accepted message.
pub(crate) struct Passed {
    pub(crate) machine: MachineIndex,
    pub(crate) state: StateId,
    pub(crate) opened: bool,
    pub(crate) complete: bool,
    pub(crate) late: bool,
    pub(crate) void: bool,
    pub(crate) elsewhere: bool,
}

impl Passed {
    /// The result of a message that changes nothing.
    #[inline]
    pub(crate) fn in_state_of(
        conversation: &Conversation,
        machine: &Machine,
        index: MachineIndex,
    ) -> Self {
        let parties = &conversation.parties;
        Self {
            machine: index,
            state: parties.first().map_or(machine.initial, |party| party.state),
            opened: false,
            complete: conversation.unnamed().is_none()
                && parties.iter().all(|party| is_final(machine, party.state)),
            late: false,
            void: false,
            elsewhere: conversation.joined,
        }
    }
}

/// The kind of a violation, and the party with the violated state.
#[derive(Debug, Clone)]
pub(crate) struct Fault {
    pub(crate) kind: Kind,
    pub(crate) state: Option<StateId>,
    pub(crate) participant: Option<String>,
}

impl Fault {
    pub(crate) fn plain(kind: Kind) -> Self {
        Self {
            kind,
            state: None,
            participant: None,
        }
    }
}
