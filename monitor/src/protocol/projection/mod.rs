//! Projection of a protocol with several roles onto each role.
//!
//! A file with `scope="conversation"` describes a protocol *globally*: its states change with the
//! messages of all roles. An agent sees only the messages that it sends and receives. The projection
//! onto a role is the state machine of these messages. It is computed as for multiparty session types:
//! the messages between other roles are hidden, and the result is made deterministic (Honda, Yoshida
//! and Carbone, *Multiparty Asynchronous Session Types*, POPL 2008; Deniélou and Yoshida, *Multiparty
//! Session Types Meet Communicating Automata*, ESOP 2012). A [`Monitor`](crate::Monitor) of an agent
//! checks each message against the projection onto the role of the agent. So the agent need not
//! receive the first message of the conversation.
//!
//! # The class of protocols
//!
//! [`Projection::new`] accepts a protocol if
//!
//! 1. every transition is between two single roles, with performatives that can be listed: no `.*` as
//!    a role, and no pattern of user-defined performatives;
//! 2. with three or more roles, there is no *mixed choice*: in a state, one role decides the next
//!    message. Two roles may both send if their messages are independent: each is possible after the
//!    other, in the same state. With two roles, messages that cross are told apart by `in-reply-to`;
//! 3. every role is told before it acts: if a role may send a message, it may send it in all states
//!    that it cannot tell apart from the present one. A timeout counts as told, because each agent has
//!    a clock.
//!
//! In this class, the roles together do what the global protocol says, and no message arrives that its
//! receiver does not expect at some time (Deniélou and Yoshida 2012, there for local choices). Both
//! conditions are decidable, because the machines are finite. Messages of different senders may arrive
//! in another order than they were sent. The monitor keeps such an early message until its turn.
//!
//! Protocols outside the class are only watched, by the global state: see [`Defect`] for the reasons.
//! [`Projection::explore`] runs the roles against each other with bounded queues, as communicating
//! automata (Brand and Zafiropulo, *On Communicating Finite-State Machines*, J. ACM 30, 1983), and finds
//! deadlocks and messages that no role expects.

mod explore;
mod local;

use std::collections::{BTreeSet, HashMap};

use local::LocalIndex;

use crate::protocol::act::{Act, Acts};
use crate::protocol::index::StateId;
use crate::protocol::machine::{Machine, Roles, Scope, State, Transition};
use crate::protocol::role::{Role, RoleSet};
pub use local::{Local, LocalState, LocalStep};
pub(crate) use local::{LocalRun, NotLocal, Observed};

/// Maximum number of states of the projection onto a role.
const MAX_LOCAL: usize = 4_096;

/// A protocol as each of its roles sees it.
#[derive(Debug, Clone)]
pub struct Projection {
    pub(crate) locals: Vec<Local>,
}

/// The reason that a protocol cannot be projected, or that its roles do not fit each other.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Defect {
    /// A transition stands for several roles or performatives that cannot be listed.
    #[error(
        "the transition with {what}={pattern:?} in state {state:?} does not name single roles or \
         performatives"
    )]
    Pattern {
        /// The state.
        state: String,
        /// The attribute.
        what: &'static str,
        /// Its value.
        pattern: String,
    },
    /// Several roles decide the next message, and their messages exclude each other.
    #[error("in state {state:?}, {one} and {other} both decide the next message")]
    MixedChoice {
        /// The state.
        state: String,
        /// One of the roles.
        one: String,
        /// The other role.
        other: String,
    },
    /// A role cannot know when to speak.
    #[error(
        "{role} cannot know when to send {performative}: it may in state {state:?}, and not in \
         {other:?}, and receives no message between them"
    )]
    NotTold {
        /// The role.
        role: String,
        /// The message.
        performative: String,
        /// A state in which the role may send it.
        state: String,
        /// A state in which the role may not send it.
        other: String,
    },
    /// All roles wait, and the protocol has not ended.
    #[error("deadlock: {}", listed(.waiting))]
    Deadlock {
        /// The roles that wait, each with its state.
        waiting: Vec<(String, String)>,
    },
    /// A message arrives that its receiver does not expect.
    #[error("{to} does not expect {performative} from {from} in state {state:?}")]
    Unexpected {
        /// The performative.
        performative: String,
        /// The sending role.
        from: String,
        /// The receiving role.
        to: String,
        /// The state of the receiver.
        state: String,
    },
    /// No order of messages leads to a state.
    #[error("no order of messages leads to state {0:?}")]
    Unreachable(String),
    /// The projection has too many states.
    #[error("the projection onto {role} has more than {MAX_LOCAL} states")]
    TooLarge {
        /// The role.
        role: String,
    },
}

fn listed(waiting: &[(String, String)]) -> String {
    let all = waiting
        .iter()
        .map(|(role, state)| format!("{role} waits in state {state:?}"));
    all.collect::<Vec<_>>().join(", ")
}

/// A message between two roles.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) struct Label {
    pub(crate) from: Role,
    pub(crate) to: Role,
    pub(crate) act: Performed,
}

/// A performative that is listed.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum Performed {
    Standard(u8),
    Other(String),
}

impl Performed {
    pub(crate) fn is(&self, act: Act<'_>) -> bool {
        match (self, act) {
            (Self::Standard(one), Act::Standard(other)) => *one == other,
            (Self::Other(one), Act::Other(other)) => one.eq_ignore_ascii_case(other),
            _ => false,
        }
    }

    pub(crate) fn name(&self) -> &str {
        match self {
            Self::Standard(number) => Act::Standard(*number).name(),
            Self::Other(name) => name,
        }
    }
}

/// The transitions of each global state, with single roles and performatives.
type Steps = Vec<Vec<(Label, StateId)>>;

impl Projection {
    /// Projects a protocol onto its roles.
    ///
    /// # Errors
    /// The protocol is outside the class that this module describes. The error has all reasons.
    pub fn new(machine: &Machine) -> Result<Self, Vec<Defect>> {
        let mut defects = Vec::new();
        let steps = steps(machine, &mut defects);
        if machine.roles.len() > 2 {
            mixed_choices(machine, &steps, &mut defects);
        }
        let mut locals = Vec::new();
        if defects.is_empty() {
            for role in (0..).map(Role::new).take(machine.roles.len()) {
                locals.extend(project(machine, &steps, role, &mut defects));
            }
        }
        if defects.is_empty() {
            Ok(Self { locals })
        } else {
            Err(defects)
        }
    }

    /// The protocol as each role sees it, in the order of [`Machine::roles`].
    #[must_use]
    pub fn locals(&self) -> &[Local] {
        &self.locals
    }

    /// The roles that send this performative in some state.
    pub(crate) fn senders_of(&self, act: Act<'_>) -> RoleSet {
        let sends = |local: &&Local| {
            let mut steps = local.states().iter().flat_map(LocalState::steps);
            steps.any(|step| step.label.from == local.role && step.label.act.is(act))
        };
        let senders = self.locals.iter().filter(sends);
        senders.map(|local| local.role).collect()
    }

    /// Runs all roles against each other, with queues of bounded length between them, and returns the
    /// deadlocks and unexpected messages that it finds.
    ///
    /// The number of explored configurations is bounded. In the class that this module describes,
    /// there are no defects.
    #[must_use]
    pub fn explore(&self, machine: &Machine) -> Vec<Defect> {
        explore::explore(self, machine)
    }

    /// Finds all defects of a protocol: those that keep it outside the class, and those of its roles
    /// among each other. A protocol with a state for each participant has two roles, which see all
    /// messages, so it has none.
    #[must_use]
    pub fn defects(machine: &Machine) -> Vec<Defect> {
        if machine.scope == Scope::Participant {
            return Vec::new();
        }
        let mut defects = Vec::new();
        let steps = steps(machine, &mut defects);
        if !defects.is_empty() {
            return defects;
        }
        if machine.roles.len() > 2 {
            mixed_choices(machine, &steps, &mut defects);
        }
        let mut locals = Vec::new();
        for role in (0..).map(Role::new).take(machine.roles.len()) {
            locals.extend(project(machine, &steps, role, &mut defects));
        }
        if locals.len() == machine.roles.len() && machine.roles.len() > 2 {
            defects.extend(Self { locals }.explore(machine));
        }
        defects
    }
}

/// Lists the transitions of each state.
fn steps(machine: &Machine, defects: &mut Vec<Defect>) -> Steps {
    let listed = |state: &State| {
        let mut all = Vec::new();
        for step in &state.steps {
            match labels(step) {
                Ok(labels) => all.extend(labels.into_iter().map(|label| (label, step.target))),
                Err((what, pattern)) => defects.push(Defect::Pattern {
                    state: state.id.clone(),
                    what,
                    pattern: pattern.to_owned(),
                }),
            }
        }
        all
    };
    machine.states.iter().map(listed).collect()
}

fn labels(step: &Transition) -> Result<Vec<Label>, (&'static str, &str)> {
    let single = |what, roles: &Roles| match roles.anyone || roles.mask.is_empty() {
        true => Err(what),
        false => Ok(roles.mask.iter()),
    };
    let from = single("from", &step.from).map_err(|what| (what, step.from.text.as_str()))?;
    let to = single("to", &step.to).map_err(|what| (what, step.to.text.as_str()))?;
    let acts = performed(&step.acts).ok_or(("performative", step.acts.text()))?;
    let mut labels = Vec::new();
    for from in from {
        for to in to.clone().filter(|to| *to != from) {
            let act = acts.iter().cloned();
            labels.extend(act.map(|act| Label { from, to, act }));
        }
    }
    Ok(labels)
}

fn performed(acts: &Acts) -> Option<Vec<Performed>> {
    let standard = (0..22_u8).filter(|number| acts.contains(Act::Standard(*number)));
    let standard: Vec<Performed> = standard.map(Performed::Standard).collect();
    if !standard.is_empty() {
        return Some(standard);
    }
    let text = acts.text();
    crate::protocol::act::is_word(text).then(|| vec![Performed::Other(text.to_owned())])
}

/// Finds the states in which several roles decide.
fn mixed_choices(machine: &Machine, steps: &Steps, defects: &mut Vec<Defect>) {
    let after = |state: StateId, label: &Label| {
        let steps = steps.get(state.index())?;
        let found = steps.iter().find(|(known, _)| known == label);
        found.map(|(_, target)| *target)
    };
    for (state, all) in machine.states.iter().zip(steps) {
        let mut known = BTreeSet::new();
        for (at, (one, one_target)) in all.iter().enumerate() {
            for (other, other_target) in all.iter().skip(at + 1) {
                let first = after(*one_target, other);
                let independent = first.is_some() && first == after(*other_target, one);
                if one.from != other.from && !independent && known.insert((one.from, other.from)) {
                    defects.push(Defect::MixedChoice {
                        state: state.id.clone(),
                        one: role_name(machine, one.from).to_owned(),
                        other: role_name(machine, other.from).to_owned(),
                    });
                }
            }
        }
    }
}

pub(crate) fn role_name(machine: &Machine, role: Role) -> &str {
    let role = machine.roles.get(role.index());
    role.map_or("", String::as_str)
}

/// A set of global states that a role cannot tell apart.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
struct Unseen {
    /// The states that messages lead to.
    by_messages: BTreeSet<StateId>,
    /// The states that timeouts lead to.
    by_timeouts: BTreeSet<StateId>,
}

impl Unseen {
    /// Adds all states that messages between other roles, and timeouts, lead to.
    fn closed(machine: &Machine, steps: &Steps, role: Role, from: BTreeSet<StateId>) -> Self {
        let hidden = |all: &mut BTreeSet<StateId>| {
            let mut next: Vec<StateId> = all.iter().copied().collect();
            while let Some(state) = next.pop() {
                let steps = steps.get(state.index());
                for (label, target) in steps.into_iter().flatten() {
                    if label.from != role && label.to != role && all.insert(*target) {
                        next.push(*target);
                    }
                }
            }
        };
        let mut by_messages = from;
        hidden(&mut by_messages);
        let mut by_timeouts = BTreeSet::new();
        loop {
            let known = by_messages.len() + by_timeouts.len();
            let all = by_messages
                .union(&by_timeouts)
                .filter_map(|state| machine.state(*state));
            let targets = all.filter_map(|state| Some(state.timeout?.target));
            let targets: Vec<StateId> = targets.collect();
            by_timeouts.extend(targets);
            hidden(&mut by_timeouts);
            by_timeouts.retain(|state| !by_messages.contains(state));
            if by_messages.len() + by_timeouts.len() == known {
                return Self {
                    by_messages,
                    by_timeouts,
                };
            }
        }
    }

    fn all(&self) -> impl Iterator<Item = StateId> + Clone {
        self.by_messages.union(&self.by_timeouts).copied()
    }
}

/// Projects a protocol onto a role: determinizes it by subsets of states.
fn project(
    machine: &Machine,
    steps: &Steps,
    role: Role,
    defects: &mut Vec<Defect>,
) -> Option<Local> {
    let first = Unseen::closed(machine, steps, role, BTreeSet::from([machine.initial]));
    let mut numbers = HashMap::from([(first.clone(), LocalIndex::FIRST)]);
    let mut sets = vec![first];
    let mut states: Vec<LocalState> = Vec::new();
    while let Some(set) = sets.get(states.len()).cloned() {
        not_told(machine, steps, role, &set, defects);
        let mut targets: Vec<(Label, BTreeSet<StateId>)> = Vec::new();
        for state in set.all() {
            for (label, target) in steps.get(state.index()).into_iter().flatten() {
                if label.from != role && label.to != role {
                    continue;
                }
                match targets.iter_mut().find(|(known, _)| known == label) {
                    Some((_, known)) => {
                        known.insert(*target);
                    }
                    None => targets.push((label.clone(), BTreeSet::from([*target]))),
                }
            }
        }
        let mut local = LocalState::of(machine, set.all());
        for (label, target) in targets {
            let target = Unseen::closed(machine, steps, role, target);
            let next = LocalIndex::new(sets.len());
            let number = *numbers.entry(target.clone()).or_insert(next);
            if number == next {
                sets.push(target);
            }
            if sets.len() > MAX_LOCAL {
                let role = role_name(machine, role).to_owned();
                defects.push(Defect::TooLarge { role });
                return None;
            }
            local.steps.push(LocalStep {
                label,
                target: number,
            });
        }
        states.push(local);
    }
    Some(Local {
        role,
        name: role_name(machine, role).to_owned(),
        roles: machine.roles.clone(),
        states,
    })
}

/// Finds the messages that a role may send in one of these states and not in another.
fn not_told(machine: &Machine, steps: &Steps, role: Role, set: &Unseen, defects: &mut Vec<Defect>) {
    let sends = |state: StateId, label: &Label| {
        let steps = steps.get(state.index()).into_iter().flatten();
        steps.clone().any(|(known, _)| known == label)
    };
    let mut known: Vec<&Label> = Vec::new();
    for state in &set.by_messages {
        for (label, _) in steps.get(state.index()).into_iter().flatten() {
            if label.from != role || known.contains(&label) {
                continue;
            }
            known.push(label);
            let silent = set.by_messages.iter().find(|other| !sends(**other, label));
            if let Some(other) = silent {
                let id = |state| machine.state(state).map_or("", State::id).to_owned();
                let defect = Defect::NotTold {
                    role: role_name(machine, role).to_owned(),
                    performative: label.act.name().to_owned(),
                    state: id(*state),
                    other: id(*other),
                };
                if !defects.contains(&defect) {
                    defects.push(defect);
                }
            }
        }
    }
}
