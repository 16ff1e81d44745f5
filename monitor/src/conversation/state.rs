//! States of a party: those of its protocol, and those that are common to all protocols.

use crate::protocol::index::StateId;
use crate::protocol::machine::Machine;

/// State of every protocol after `not-understood`.
pub(crate) const AFTER_NOT_UNDERSTOOD: StateId = StateId::common(0);

/// State of every protocol after `cancel`, before the answer to it.
pub(crate) const CANCELLING: StateId = StateId::common(1);

/// State of every protocol after the answer `inform` to a `cancel`.
pub(crate) const CANCELLED: StateId = StateId::common(2);

/// State of every protocol after the message transport service reported a failure.
pub(crate) const FAILED: StateId = StateId::common(3);

/// State that the monitor does not know: see `check::delegated`.
pub(crate) const ELSEWHERE: StateId = StateId::common(4);

/// Returns the name of a state.
pub(crate) fn state_name(machine: &Machine, state: StateId) -> &str {
    match state {
        AFTER_NOT_UNDERSTOOD => "not-understood",
        CANCELLING => "cancelling",
        CANCELLED => "cancelled",
        FAILED => "undelivered",
        ELSEWHERE => "elsewhere",
        own => machine.state(own).map_or("", |state| state.id()),
    }
}

pub(crate) fn is_final(machine: &Machine, state: StateId) -> bool {
    match state {
        AFTER_NOT_UNDERSTOOD | CANCELLED | FAILED => true,
        CANCELLING => false,
        own => machine.state(own).is_some_and(|state| state.is_final()),
    }
}

/// Whether no further message can follow.
pub(crate) fn is_over(machine: &Machine, state: StateId) -> bool {
    match state {
        AFTER_NOT_UNDERSTOOD | CANCELLED | FAILED => true,
        CANCELLING => false,
        own => machine.state(own).is_some_and(|state| state.is_over()),
    }
}
