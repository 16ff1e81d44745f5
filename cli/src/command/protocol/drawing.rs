//! A protocol as SVG.

use fipa::monitor::{Machine, State};
use fipa_acl::escape;
use fipa_drawing::{Automaton, Row};

use super::{CONDITIONS, act, conditions, defaults, role, within};

/// Draws a protocol, with the transitions that every protocol has if `with_defaults` is set, and with the state of this
/// name marked.
pub(in crate::command) fn svg(
    machine: &Machine,
    with_defaults: bool,
    current: Option<&str>,
) -> String {
    let title = match machine.title() {
        Some(title) => format!("{}: {title}", machine.name()),
        None => machine.name().to_owned(),
    };
    let roles = roles(machine);
    let own = machine.states().iter().map(|state| fipa_drawing::State {
        name: escaped(state.id()),
        is_final: state.is_final(),
        rows: rows(machine, state, &roles),
    });
    let mut states: Vec<fipa_drawing::State> = own.collect();
    if with_defaults {
        states.extend(added(machine));
    }
    let initial = number(machine, machine.initial().id());
    Automaton {
        title: escaped(&title),
        roles: roles.iter().map(|role| escaped(role)).collect(),
        states,
        initial: initial.unwrap_or_default(),
        current: current.and_then(|state| number(machine, state)),
        legend: CONDITIONS.map(str::to_owned).into(),
    }
    .svg()
}

/// Returns the roles, the initiator first.
fn roles(machine: &Machine) -> Vec<&str> {
    let initiator = machine.initiator();
    let all = machine.roles().iter().map(String::as_str);
    let others = all.filter(|role| *role != initiator);
    std::iter::once(initiator).chain(others).collect()
}

fn rows(machine: &Machine, state: &State, roles: &[&str]) -> Vec<Row> {
    let index = |role: &str| roles.iter().position(|other| *other == role);
    let messages = state.transitions().iter().map(|step| {
        let conditions = conditions(step);
        let to = if machine.roles().len() > 2 {
            format!(" to {}", role(step.to()))
        } else {
            String::new()
        };
        Row {
            text: escaped(&format!(
                "{}: {}{to}{conditions}",
                role(step.from()),
                act(step)
            )),
            role: index(step.from()),
            dashed: step.is_optional(),
            target: number(machine, machine.target(step)),
        }
    });
    let timeouts = state.timeout().map(|timeout| Row {
        text: format!("after {}", super::after(timeout.after())),
        role: None,
        dashed: true,
        target: number(machine, machine.timeout_target(timeout)),
    });
    let within = state.subprotocols().iter().map(|sub| {
        let answers = sub
            .proxied_to()
            .map(|to| format!(", answers to {}", role(to)));
        let answers = answers.unwrap_or_default();
        Row {
            text: escaped(&format!(
                "{}: starts {}{answers}",
                role(sub.from()),
                within(sub)
            )),
            role: index(sub.from()),
            dashed: false,
            target: None,
        }
    });
    messages.chain(timeouts).chain(within).collect()
}

/// Returns the states that every protocol has.
fn added(machine: &Machine) -> Vec<fipa_drawing::State> {
    let first = machine.states().len();
    let all = defaults::of(machine);
    let number = |name| all.iter().position(|state| state.name == name);
    let states = all.iter().map(|state| {
        let rows = state.steps.iter().map(|step| Row {
            text: escaped(&step.label),
            role: None,
            dashed: false,
            // The state before is one of the protocol.
            target: step.target.map_or(Some(0), number).map(|at| first + at),
        });
        fipa_drawing::State {
            name: escaped(state.name),
            is_final: state.is_final,
            rows: rows.collect(),
        }
    });
    states.collect()
}

fn number(machine: &Machine, id: &str) -> Option<usize> {
    machine.states().iter().position(|state| state.id() == id)
}

fn escaped(text: &str) -> String {
    escape(text).into_owned()
}
