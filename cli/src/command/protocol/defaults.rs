//! The states and transitions that every protocol has beside its own: not-understood, cancel, and the
//! report of an undelivered message.

use fipa::monitor::{Cancel, Machine};

/// A state that the monitor adds to every protocol, or the one that stands for all states of the protocol.
pub(super) struct DefaultState {
    pub(super) name: &'static str,
    pub(super) is_final: bool,
    pub(super) steps: Vec<DefaultStep>,
}

/// A transition from a default state, or to one.
pub(super) struct DefaultStep {
    pub(super) label: String,
    /// The name of a default state, or `None` for the state before.
    pub(super) target: Option<&'static str>,
}

const ANY: &str = "any state";
const NOT_UNDERSTOOD: &str = "not-understood";
const CANCELLING: &str = "cancelling";
const CANCELLED: &str = "cancelled";
const UNDELIVERED: &str = "undelivered";

fn step(label: &str, target: Option<&'static str>) -> DefaultStep {
    DefaultStep {
        label: label.to_owned(),
        target,
    }
}

/// Returns the default states. The first stands for any state of the protocol.
pub(super) fn of(machine: &Machine) -> Vec<DefaultState> {
    let canceling = match machine.cancel() {
        Cancel::Initiator => Some(machine.initiator()),
        Cancel::Anyone => Some("any role"),
        _ => None,
    };
    let mut any = vec![
        step("not-understood from any role", Some(NOT_UNDERSTOOD)),
        step(
            "failure from a message transport service",
            Some(UNDELIVERED),
        ),
    ];
    if let Some(role) = canceling {
        any.push(step(&format!("cancel from {role}"), Some(CANCELLING)));
    }
    let state = |name, is_final, steps| DefaultState {
        name,
        is_final,
        steps,
    };
    let mut all = vec![
        state(ANY, false, any),
        state(NOT_UNDERSTOOD, true, Vec::new()),
        state(
            UNDELIVERED,
            true,
            vec![step("the message is sent again", None)],
        ),
    ];
    if canceling.is_some() {
        all.push(state(
            CANCELLING,
            false,
            vec![
                step("inform from the other side", Some(CANCELLED)),
                step("failure from the other side", None),
                step("not-understood", Some(NOT_UNDERSTOOD)),
            ],
        ));
        all.push(state(CANCELLED, true, Vec::new()));
    }
    all
}
