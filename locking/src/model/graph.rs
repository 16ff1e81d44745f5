//! The whole graph of a model, for the liveness that a checker of invariants cannot see.

use std::collections::HashMap;
use std::collections::VecDeque;
use std::collections::hash_map::Entry;
use std::hash::{BuildHasher, BuildHasherDefault, DefaultHasher};

use stateright::Model;

use super::system::{State, Step, System};

/// States and the steps between them that are no faults.
pub(super) struct Graph {
    /// For each state: the state and the number of the step that led there first.
    parents: Vec<(u32, u16)>,
    done: Vec<bool>,
    /// Source and target of each step.
    edges: Vec<(u32, u32)>,
    /// A state that breaks an invariant, over the shortest path to one.
    pub(super) broken: Option<u32>,
}

fn fingerprint(state: &State) -> u64 {
    BuildHasherDefault::<DefaultHasher>::default().hash_one(state)
}

impl Graph {
    /// Explores every reachable state, breadth first, up to one that breaks an invariant.
    ///
    /// # Panics
    ///
    /// Panics when there are more states than `limit`.
    pub(super) fn explore(system: &System, limit: usize) -> Self {
        let mut graph = Self {
            parents: Vec::new(),
            done: Vec::new(),
            edges: Vec::new(),
            broken: None,
        };
        let mut ids = HashMap::new();
        let mut pending = VecDeque::new();
        for state in system.init_states() {
            ids.insert(fingerprint(&state), 0);
            graph.parents.push((u32::MAX, 0));
            pending.push_back(state);
        }
        let mut steps = Vec::new();
        while let Some(state) = pending.pop_front() {
            let id = graph.done.len() as u32;
            graph.done.push(System::is_done(&state));
            if state.broken().is_some() {
                graph.broken = Some(id);
                break;
            }
            system.actions(&state, &mut steps);
            for (number, step) in (0_u16..).zip(steps.drain(..)) {
                let is_fault = step.is_fault();
                let Some(next) = system.next_state(&state, step) else {
                    continue;
                };
                let target = match ids.entry(fingerprint(&next)) {
                    Entry::Occupied(known) => *known.get(),
                    Entry::Vacant(new) => {
                        graph.parents.push((id, number));
                        pending.push_back(next);
                        *new.insert(graph.parents.len() as u32 - 1)
                    }
                };
                assert!(graph.parents.len() <= limit, "more than {limit} states");
                if !is_fault {
                    graph.edges.push((id, target));
                }
            }
        }
        graph
    }

    pub(super) fn states(&self) -> usize {
        self.parents.len()
    }

    /// Searches backward from the states in which all claims have ended. Returns a state from which
    /// none of them can be reached without a fault.
    pub(super) fn stuck(&self) -> Option<u32> {
        let mut sources: Vec<Vec<u32>> = vec![Vec::new(); self.states()];
        for (source, target) in &self.edges {
            sources[*target as usize].push(*source);
        }
        let mut live = self.done.clone();
        let mut pending: Vec<_> = (0..live.len()).filter(|id| live[*id]).collect();
        while let Some(id) = pending.pop() {
            for source in &sources[id] {
                if !std::mem::replace(&mut live[*source as usize], true) {
                    pending.push(*source as usize);
                }
            }
        }
        live.iter().position(|live| !live).map(|id| id as u32)
    }

    /// The steps to a state, and the state.
    pub(super) fn path(&self, system: &System, id: u32) -> (Vec<Step>, State) {
        let mut numbers = Vec::new();
        let mut at = id;
        while let Some((parent, number)) = self.parents.get(at as usize)
            && *parent != u32::MAX
        {
            numbers.push(*number);
            at = *parent;
        }
        let mut state = system.initial_state();
        let mut path = Vec::new();
        let mut steps = Vec::new();
        for number in numbers.into_iter().rev() {
            steps.clear();
            system.actions(&state, &mut steps);
            let step = steps.swap_remove(usize::from(number));
            path.push(step.clone());
            state = system
                .next_state(&state, step)
                .expect("a step of the graph");
        }
        (path, state)
    }
}
