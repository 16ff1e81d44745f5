//! A protocol as a Mermaid state diagram.

use std::fmt::Write as _;

use fipa::monitor::Machine;
use fipa_acl::escape;

use super::{CONDITIONS, act, conditions, defaults, role, within};
use crate::output::mermaid;

/// Draws a protocol, with the transitions that every protocol has if `with_defaults` is set.
pub(super) fn diagram(machine: &Machine, with_defaults: bool) -> String {
    let mut out = "stateDiagram-v2\n".to_owned();
    let number = |id: &str| machine.states().iter().position(|state| state.id() == id);
    // Writing to a string cannot fail.
    for (at, state) in machine.states().iter().enumerate() {
        let _ = writeln!(out, "    state \"{}\" as s{at}", escaped(state.id()));
    }
    let initial = number(machine.initial().id()).unwrap_or(0);
    let _ = writeln!(out, "    [*] --> s{initial}");
    for (at, state) in machine.states().iter().enumerate() {
        for step in state.transitions() {
            let target = number(machine.target(step)).unwrap_or(at);
            let conditions = conditions(step);
            let to = if machine.roles().len() > 2 {
                format!(" to {}", role(step.to()))
            } else {
                String::new()
            };
            let label = format!("{} from {}{to}{conditions}", act(step), role(step.from()));
            let _ = writeln!(out, "    s{at} --> s{target} : {}", escaped(&label));
        }
        if let Some(timeout) = state.timeout() {
            let target = number(machine.timeout_target(timeout)).unwrap_or(at);
            let after = super::after(timeout.after());
            let _ = writeln!(out, "    s{at} --> s{target} : after {after}");
        }
        for sub in state.subprotocols() {
            let answers = sub
                .proxied_to()
                .map(|to| format!(", answers to {}", role(to)));
            let answers = answers.unwrap_or_default();
            let label = format!("{} started by {}{answers}", within(sub), role(sub.from()));
            let _ = writeln!(out, "    s{at} --> s{at} : {}", escaped(&label));
        }
        if state.is_final() {
            let _ = writeln!(out, "    s{at} --> [*]");
        }
    }
    if with_defaults {
        let all = defaults::of(machine);
        let number = |name: &str| all.iter().position(|state| state.name == name);
        for (at, state) in all.iter().enumerate() {
            let _ = writeln!(out, "    state \"{}\" as d{at}", escaped(state.name));
        }
        for (at, state) in all.iter().enumerate() {
            for step in &state.steps {
                // The state before is one of the protocol.
                let target = step.target.map_or(Some(0), number).unwrap_or(at);
                let _ = writeln!(out, "    d{at} --> d{target} : {}", escaped(&step.label));
            }
            if state.is_final {
                let _ = writeln!(out, "    d{at} --> [*]");
            }
        }
    }
    let _ = writeln!(out, "    note right of s{initial}");
    for line in CONDITIONS {
        let _ = writeln!(out, "        {}", escaped(line));
    }
    out.push_str("    end note\n");
    out
}

fn escaped(text: &str) -> String {
    mermaid(&escape(text))
}
