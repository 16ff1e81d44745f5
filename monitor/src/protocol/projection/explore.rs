//! The roles of a protocol as communicating automata: explores what they do together.

use std::collections::{HashSet, VecDeque};

use super::local::LocalIndex;
use super::{Defect, Local, LocalState, Performed, Projection};
use crate::protocol::machine::Machine;

/// Maximum number of messages that wait between two roles.
const QUEUE: usize = 2;
/// Maximum number of explored configurations.
const MAX_CONFIGURATIONS: usize = 20_000;
/// Maximum number of defects.
const MAX_DEFECTS: usize = 8;

/// The states of all roles, and the messages under way from each role to each other one.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Configuration {
    states: Vec<LocalIndex>,
    queues: Vec<VecDeque<Performed>>,
}

pub(super) fn explore(projection: &Projection, machine: &Machine) -> Vec<Defect> {
    let locals = &projection.locals;
    let roles = locals.len();
    let first = Configuration {
        states: vec![LocalIndex::FIRST; roles],
        queues: vec![VecDeque::new(); roles * roles],
    };
    let mut known = HashSet::from([first.clone()]);
    let mut next = VecDeque::from([first]);
    let mut defects = Vec::new();
    let mut reached: HashSet<&str> = HashSet::new();
    let mut complete = true;
    while let Some(configuration) = next.pop_front() {
        for (local, state) in locals.iter().zip(&configuration.states) {
            let names = local.state(*state).map_or(&[][..], LocalState::names);
            reached.extend(names.iter().map(String::as_str));
        }
        let (following, full) = configuration.following(locals);
        if following.is_empty() && !full {
            for defect in configuration.stuck(locals, machine) {
                if defects.len() < MAX_DEFECTS && !defects.contains(&defect) {
                    defects.push(defect);
                }
            }
        }
        for configuration in following {
            if known.len() == MAX_CONFIGURATIONS {
                complete = false;
                break;
            }
            if known.insert(configuration.clone()) {
                next.push_back(configuration);
            }
        }
    }
    if complete {
        let ids = machine.states.iter().map(|state| state.id.as_str());
        let missing = ids.filter(|id| !reached.contains(id));
        defects.extend(missing.map(|id| Defect::Unreachable(id.to_owned())));
    }
    defects
}

impl Configuration {
    /// The configurations after one message is sent or received, and whether a full queue prevents
    /// one.
    fn following(&self, locals: &[Local]) -> (Vec<Self>, bool) {
        let (mut all, mut full) = (Vec::new(), false);
        for (at, (local, state)) in locals.iter().zip(&self.states).enumerate() {
            let steps = local.state(*state).map_or(&[][..], LocalState::steps);
            for step in steps {
                let queue = step.label.from.index() * locals.len();
                let queue = queue + step.label.to.index();
                let sends = step.label.from == local.role;
                let Some(waiting) = self.queues.get(queue) else {
                    continue;
                };
                if sends && waiting.len() == QUEUE {
                    full = true;
                    continue;
                }
                if !sends && waiting.front() != Some(&step.label.act) {
                    continue;
                }
                let mut after = self.clone();
                if let (Some(queue), Some(state)) =
                    (after.queues.get_mut(queue), after.states.get_mut(at))
                {
                    match sends {
                        true => queue.push_back(step.label.act.clone()),
                        false => drop(queue.pop_front()),
                    }
                    *state = step.target;
                    all.push(after);
                }
            }
        }
        (all, full)
    }

    /// The defects of a configuration in which no role can go on.
    fn stuck(&self, locals: &[Local], machine: &Machine) -> Vec<Defect> {
        let shown = |local: &Local, state: LocalIndex| {
            let state = local.state(state);
            state.map_or_else(String::new, |state| state.names().join("|"))
        };
        let mut defects = Vec::new();
        for (at, queue) in self.queues.iter().enumerate() {
            let (from, to) = (at / locals.len(), at % locals.len());
            if let (Some(act), Some(local), Some(state)) =
                (queue.front(), locals.get(to), self.states.get(to))
            {
                defects.push(Defect::Unexpected {
                    performative: act.name().to_owned(),
                    from: machine.roles.get(from).cloned().unwrap_or_default(),
                    to: local.role().to_owned(),
                    state: shown(local, *state),
                });
            }
        }
        let waiting = locals.iter().zip(&self.states).filter(|(local, state)| {
            let state = local.state(**state);
            state.is_some_and(|state| !state.is_final())
        });
        let waiting: Vec<(String, String)> = waiting
            .map(|(local, state)| (local.role().to_owned(), shown(local, *state)))
            .collect();
        if defects.is_empty() && !waiting.is_empty() {
            defects.push(Defect::Deadlock { waiting });
        }
        defects
    }
}
