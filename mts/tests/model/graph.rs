//! The whole graph of a model, for the liveness that a checker of invariants cannot see.

use std::collections::{HashMap, VecDeque};
use std::hash::{BuildHasher, Hash};

use foldhash::fast::FixedState;
use stateright::Model;

use crate::protocol::{Action, Protocol};
use crate::state::State;

/// States and the steps between them that are no faults.
pub(crate) struct Graph {
    /// For each state: the state and the number of the action that led there first.
    parents: Vec<(u32, u16)>,
    done: Vec<bool>,
    /// Index in `edges` of the first edge of each state.
    starts: Vec<usize>,
    /// Target and class of each step.
    edges: Vec<(u32, u16)>,
    classes: Vec<Action>,
    /// The first state that violates each property that some state violates.
    pub(crate) violations: Vec<(&'static str, u32)>,
    /// All steps, faults included.
    pub(crate) steps: usize,
}

fn fingerprint(value: &impl Hash) -> u64 {
    FixedState::default().hash_one(value)
}

/// Maximum number of classes of steps: a set of classes is an array of bits.
const MAX_CLASSES: usize = 1024;
type Set = [u64; MAX_CLASSES / 64];

impl Graph {
    /// Explores every reachable state, breadth first.
    ///
    /// # Panics
    ///
    /// Panics when there are more states than `limit`.
    pub(crate) fn explore(model: &Protocol, limit: usize) -> Self {
        let mut graph = Self {
            parents: Vec::new(),
            done: Vec::new(),
            starts: Vec::new(),
            edges: Vec::new(),
            classes: Vec::new(),
            violations: Vec::new(),
            steps: 0,
        };
        let properties = model.properties();
        let mut class_of: HashMap<Action, u16, FixedState> = HashMap::default();
        let mut ids: HashMap<u64, u32, FixedState> = HashMap::default();
        let mut pending: VecDeque<State> = VecDeque::new();
        for state in model.init_states() {
            ids.insert(fingerprint(&state), graph.parents.len() as u32);
            graph.parents.push((u32::MAX, 0));
            pending.push_back(state);
        }
        let mut actions = Vec::new();
        while let Some(state) = pending.pop_front() {
            let id = graph.starts.len() as u32;
            graph.starts.push(graph.edges.len());
            graph.done.push(Protocol::is_done(&state));
            for property in &properties {
                if !(property.condition)(model, &state)
                    && !graph
                        .violations
                        .iter()
                        .any(|(name, _)| *name == property.name)
                {
                    graph.violations.push((property.name, id));
                }
            }
            model.actions(&state, &mut actions);
            for (number, action) in actions.drain(..).enumerate() {
                let Some(next) = model.next_state(&state, action) else {
                    continue;
                };
                graph.steps += 1;
                let target = *ids.entry(fingerprint(&next)).or_insert_with(|| {
                    graph.parents.push((id, number as u16));
                    pending.push_back(next);
                    graph.parents.len() as u32 - 1
                });
                assert!(graph.parents.len() <= limit, "more than {limit} states");
                if !action.is_fault() {
                    let class = action.class();
                    let classes = &mut graph.classes;
                    let class = *class_of.entry(class).or_insert_with(|| {
                        classes.push(class);
                        classes.len() as u16 - 1
                    });
                    graph.edges.push((target, class));
                }
            }
        }
        assert!(graph.classes.len() <= MAX_CLASSES);
        graph.starts.push(graph.edges.len());
        graph
    }

    pub(crate) fn states(&self) -> usize {
        self.parents.len()
    }

    fn edges(&self, id: usize) -> &[(u32, u16)] {
        &self.edges[self.starts[id]..self.starts[id + 1]]
    }

    /// Searches backward from the states in which every letter has an outcome. Returns a state
    /// from which none of them can be reached without a fault.
    pub(crate) fn stuck(&self) -> Option<u32> {
        let count = self.states();
        let mut starts = vec![0_usize; count + 1];
        for (target, _) in &self.edges {
            starts[*target as usize + 1] += 1;
        }
        for id in 0..count {
            starts[id + 1] += starts[id];
        }
        let mut fill = starts.clone();
        let mut sources = vec![0_u32; self.edges.len()];
        for id in 0..count {
            for (target, _) in self.edges(id) {
                sources[fill[*target as usize]] = id as u32;
                fill[*target as usize] += 1;
            }
        }
        let mut live = self.done.clone();
        let mut pending: Vec<usize> = (0..count).filter(|id| live[*id]).collect();
        while let Some(id) = pending.pop() {
            for source in &sources[starts[id]..starts[id + 1]] {
                if !std::mem::replace(&mut live[*source as usize], true) {
                    pending.push(*source as usize);
                }
            }
        }
        live.iter().position(|live| !live).map(|id| id as u32)
    }

    /// Returns a state of a cycle in which a fair run without faults can stay for ever although
    /// a letter is open.
    ///
    /// A run is fair if it does not leave a class of steps undone for ever that can be taken at
    /// any time. A strongly connected component allows such a run if and only if each class that
    /// each of its states allows is taken by a step within it.
    pub(crate) fn livelock(&self) -> Option<u32> {
        let component = self.components();
        let mut inside: HashMap<u32, (Set, Set, u32)> = HashMap::new();
        for id in (0..self.states()).filter(|id| !self.done[*id]) {
            let mut allowed: Set = [0; _];
            let mut taken: Set = [0; _];
            let mut cyclic = false;
            for (target, class) in self.edges(id) {
                let (word, bit) = (usize::from(*class) / 64, 1 << (class % 64));
                allowed[word] |= bit;
                let within = component[*target as usize] == component[id];
                if within && !self.done[*target as usize] {
                    taken[word] |= bit;
                    cyclic = true;
                }
            }
            if !cyclic {
                continue;
            }
            let entry = inside
                .entry(component[id])
                .or_insert((allowed, [0; _], id as u32));
            for word in 0..allowed.len() {
                entry.0[word] &= allowed[word];
                entry.1[word] |= taken[word];
            }
        }
        let fair = |allowed: &Set, taken: &Set| {
            let mut words = allowed.iter().zip(taken);
            words.all(|(allowed, taken)| allowed & !taken == 0)
        };
        inside
            .values()
            .filter(|(allowed, taken, _)| fair(allowed, taken))
            .map(|(_, _, id)| *id)
            .min()
    }

    /// The strongly connected component of each state (Tarjan's algorithm, without recursion).
    fn components(&self) -> Vec<u32> {
        const NONE: u32 = u32::MAX;
        let count = self.states();
        let mut component = vec![NONE; count];
        let mut index = vec![NONE; count];
        let mut low = vec![0_u32; count];
        let mut stack = Vec::new();
        let mut calls: Vec<(usize, usize)> = Vec::new();
        let mut next_index = 0;
        for root in 0..count {
            if index[root] != NONE {
                continue;
            }
            calls.push((root, 0));
            while let Some((id, edge)) = calls.pop() {
                if edge == 0 {
                    index[id] = next_index;
                    low[id] = next_index;
                    next_index += 1;
                    stack.push(id);
                }
                if let Some((target, _)) = self.edges(id).get(edge) {
                    let target = *target as usize;
                    calls.push((id, edge + 1));
                    if index[target] == NONE {
                        calls.push((target, 0));
                    } else if component[target] == NONE {
                        low[id] = low[id].min(index[target]);
                    }
                    continue;
                }
                if low[id] == index[id] {
                    while let Some(member) = stack.pop() {
                        component[member] = id as u32;
                        if member == id {
                            break;
                        }
                    }
                }
                if let Some((parent, _)) = calls.last() {
                    low[*parent] = low[*parent].min(low[id]);
                }
            }
        }
        component
    }

    /// The steps that lead to a state.
    pub(crate) fn path(&self, model: &Protocol, mut id: u32) -> Vec<(Action, State)> {
        let mut numbers = Vec::new();
        loop {
            let (parent, number) = self.parents[id as usize];
            if parent == u32::MAX {
                break;
            }
            numbers.push(number);
            id = parent;
        }
        let mut state = model.init_states()[id as usize].clone();
        let mut path = Vec::new();
        for number in numbers.into_iter().rev() {
            let mut actions = Vec::new();
            model.actions(&state, &mut actions);
            let action = actions[usize::from(number)];
            state = model
                .next_state(&state, action)
                .expect("it was taken before");
            path.push((action, state.clone()));
        }
        path
    }
}
