//! The projection onto one role, and a conversation that runs it.

use super::{Label, Performed};
use crate::protocol::act::Act;
use crate::protocol::index::StateId;
use crate::protocol::machine::Machine;
use crate::protocol::role::{Role, RoleSet};

/// A protocol as one role sees it.
#[derive(Debug, Clone)]
pub struct Local {
    pub(crate) role: Role,
    pub(super) name: String,
    pub(super) roles: Vec<String>,
    pub(crate) states: Vec<LocalState>,
}

/// A state of a [`Local`]: the states of the protocol that the role cannot tell apart.
#[derive(Debug, Clone)]
pub struct LocalState {
    names: Vec<String>,
    pub(super) is_final: bool,
    globals: Vec<StateId>,
    pub(super) steps: Vec<LocalStep>,
}

/// Index of a state in [`Local::states`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(transparent)]
pub(super) struct LocalIndex(u16);

impl LocalIndex {
    pub(super) const FIRST: Self = Self(0);

    /// Saturates above the maximum number of states of a projection.
    pub(super) fn new(index: usize) -> Self {
        Self(u16::try_from(index).unwrap_or(u16::MAX))
    }

    fn index(self) -> usize {
        usize::from(self.0)
    }
}

/// A message that the role sends or receives.
#[derive(Debug, Clone)]
pub struct LocalStep {
    pub(super) label: Label,
    pub(super) target: LocalIndex,
}

impl Local {
    /// Name of the role.
    #[must_use]
    pub fn role(&self) -> &str {
        &self.name
    }

    /// The states. The first is the initial one.
    #[must_use]
    pub fn states(&self) -> &[LocalState] {
        &self.states
    }

    /// The role that sends the message of a step.
    #[must_use]
    pub fn from(&self, step: &LocalStep) -> &str {
        self.name_of(step.label.from)
    }

    /// The role that receives the message of a step.
    #[must_use]
    pub fn to(&self, step: &LocalStep) -> &str {
        self.name_of(step.label.to)
    }

    fn name_of(&self, role: Role) -> &str {
        let role = self.roles.get(role.index());
        role.map_or("", String::as_str)
    }

    pub(super) fn state(&self, at: LocalIndex) -> Option<&LocalState> {
        self.states.get(at.index())
    }
}

impl LocalState {
    pub(super) fn of(machine: &Machine, states: impl Iterator<Item = StateId> + Clone) -> Self {
        let all = || {
            states
                .clone()
                .filter_map(|at| Some((at, machine.state(at)?)))
        };
        Self {
            names: all().map(|(_, state)| state.id.clone()).collect(),
            is_final: all().any(|(_, state)| state.is_final),
            globals: states.clone().collect(),
            steps: Vec::new(),
        }
    }

    /// The states of the protocol that the role cannot tell apart.
    #[must_use]
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Whether the protocol may have ended.
    #[must_use]
    pub fn is_final(&self) -> bool {
        self.is_final
    }

    /// The messages that the role may send or receive.
    #[must_use]
    pub fn steps(&self) -> &[LocalStep] {
        &self.steps
    }

    /// A state of the protocol that stands for these. The monitor removes a conversation whose state
    /// is over, so this is such a state only if the role has nothing more to do.
    pub(crate) fn global_in(&self, machine: &Machine) -> StateId {
        let over = |at: &StateId| machine.state(*at).is_some_and(|state| state.is_over());
        let mut all = self.globals.iter().copied();
        let wanted = all.clone().find(|at| over(at) == self.is_over());
        wanted.or_else(|| all.next()).unwrap_or(machine.initial)
    }

    /// Whether the role has nothing more to send or receive.
    pub(crate) fn is_over(&self) -> bool {
        self.steps.is_empty()
    }
}

impl LocalStep {
    /// The performative.
    #[must_use]
    pub fn performative(&self) -> &str {
        self.label.act.name()
    }

    /// Index of the state after the message.
    #[must_use]
    pub fn target(&self) -> usize {
        self.target.index()
    }
}

/// A message of the monitored agent, with the roles that its sender and all its receivers may have.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Observed<'a> {
    pub(crate) act: Act<'a>,
    /// Whether the agent sends it.
    pub(crate) own: bool,
    /// Roles that the other side may have.
    pub(crate) peers: RoleSet,
}

/// A message that does not fit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NotLocal {
    /// The state does not allow it.
    Unexpected,
    /// The agent has nothing more to send or receive.
    Ended,
}

/// The conversation of an agent as its role sees it. The agent may have several roles until a message
/// tells them apart.
#[derive(Debug, Clone)]
pub(crate) struct LocalRun {
    parts: Vec<Part>,
    /// The parts without the last message of the agent, as long as it may not have arrived.
    without_last: Vec<Part>,
}

/// A possible role of the agent, and its state.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Part {
    role: Role,
    state: LocalIndex,
    /// Messages that came before their turn, because messages of other senders are under way.
    early: Vec<(Role, Performed)>,
}

/// Maximum number of early messages.
const MAX_EARLY: usize = 16;
/// Maximum number of states that are searched for the turn of an early message.
const MAX_SEARCHED: usize = 256;

impl LocalRun {
    /// A conversation that has not begun, in which the agent may have any of these roles.
    pub(crate) fn new(locals: &[Local], roles: RoleSet) -> Self {
        let parts = locals.iter().filter(|local| roles.contains(local.role));
        let part = |local: &Local| Part {
            role: local.role,
            state: LocalIndex::FIRST,
            early: Vec::new(),
        };
        Self {
            parts: parts.map(part).collect(),
            without_last: Vec::new(),
        }
    }

    /// The role of the agent, if it is certain.
    pub(crate) fn role(&self) -> Option<Role> {
        let first = self.parts.first()?.role;
        let mut parts = self.parts.iter();
        parts.all(|part| part.role == first).then_some(first)
    }

    /// The roles that the agent may have.
    pub(crate) fn roles(&self) -> RoleSet {
        self.parts.iter().map(|part| part.role).collect()
    }

    /// Whether the role and the state of the agent are certain.
    pub(crate) fn is_certain(&self) -> bool {
        self.parts.len() <= 1
    }

    /// Whether a message waits for its turn.
    pub(crate) fn waits(&self) -> bool {
        self.parts.iter().any(|part| !part.early.is_empty())
    }

    /// Bytes that the run has allocated.
    pub(crate) fn allocated(&self) -> usize {
        let parts = self.parts.iter().chain(&self.without_last);
        let early = parts.flat_map(|part| {
            let acts = part.early.iter().map(|(_, act)| match act {
                Performed::Standard(_) => 0,
                Performed::Other(name) => name.capacity(),
            });
            let buffer = part.early.capacity() * size_of::<(Role, Performed)>();
            std::iter::once(buffer).chain(acts)
        });
        let parts = self.parts.capacity() + self.without_last.capacity();
        parts * size_of::<Part>() + early.sum::<usize>()
    }

    /// Adds the possibility that the last message of the agent has not arrived. The next message shows
    /// whether it has.
    pub(crate) fn take_back(&mut self) {
        let mut parts = std::mem::take(&mut self.without_last);
        for part in self.parts.drain(..) {
            if !parts.contains(&part) {
                parts.push(part);
            }
        }
        self.parts = parts;
    }

    /// Whether the last message of the agent may not have arrived: no message has answered it.
    pub(crate) fn has_last(&self) -> bool {
        !self.without_last.is_empty()
    }

    /// Takes a message. Returns the role of the agent and that of the other side, if they are certain.
    pub(crate) fn take(
        &mut self,
        locals: &[Local],
        message: Observed<'_>,
    ) -> Result<(Option<Role>, Option<Role>), NotLocal> {
        let local = |part: &Part| locals.iter().find(|local| local.role == part.role);
        let taken = after(&self.parts, locals, message);
        if taken.is_empty() {
            let over = |part: &Part| {
                let state = local(part).and_then(|local| local.state(part.state));
                state.is_none_or(LocalState::is_over)
            };
            return Err(match self.parts.iter().all(over) {
                true => NotLocal::Ended,
                false => NotLocal::Unexpected,
            });
        }
        let same = |one: &dyn Fn(&(Part, Role)) -> Role| {
            let first = taken.first().map(one);
            first.filter(|first| taken.iter().all(|part| one(part) == *first))
        };
        let roles = (same(&|(part, _)| part.role), same(&|(_, peer)| *peer));
        let taken: Vec<Part> = taken.into_iter().map(|(part, _)| part).collect();
        let before = std::mem::replace(&mut self.parts, taken);
        self.without_last = match message.own {
            // An agent that sends a message knows its role.
            true => {
                let has = |part: &Part| self.parts.iter().any(|own| own.role == part.role);
                before.into_iter().filter(has).collect()
            }
            // A message that does not fit without the last one shows that it has arrived.
            false => {
                let without = after(&self.without_last, locals, message);
                without.into_iter().map(|(part, _)| part).collect()
            }
        };
        Ok(roles)
    }

    /// The state of the first possible role.
    pub(crate) fn state<'l>(&self, locals: &'l [Local]) -> Option<&'l LocalState> {
        let part = self.parts.first()?;
        let local = locals.iter().find(|local| local.role == part.role)?;
        local.state(part.state)
    }
}

/// The parts after a message, and the roles of the other side.
fn after(parts: &[Part], locals: &[Local], message: Observed<'_>) -> Vec<(Part, Role)> {
    let with_local = || {
        parts.iter().filter_map(|part| {
            let local = locals.iter().find(|local| local.role == part.role);
            Some((part, local?))
        })
    };
    let taken = with_local().filter_map(|(part, local)| part.after(local, message));
    let taken: Vec<(Part, Role)> = taken.collect();
    if !taken.is_empty() || message.own {
        return taken;
    }
    // An early message waits only if it fits no role now.
    let waiting = with_local().filter_map(|(part, local)| part.keeping(local, message));
    waiting.collect()
}

impl Part {
    /// The part after a message whose turn it is, and the role of the other side.
    fn after(&self, local: &Local, message: Observed<'_>) -> Option<(Self, Role)> {
        let state = local.state(self.state)?;
        let step = state.steps.iter().find(|step| {
            let peer = match message.own {
                true => step.label.to,
                false => step.label.from,
            };
            (step.label.from == self.role) == message.own
                && message.peers.contains(peer)
                && step.label.act.is(message.act)
        })?;
        let mut part = self.clone();
        part.state = step.target;
        part.take_early(local);
        let peer = match message.own {
            true => step.label.to,
            false => step.label.from,
        };
        Some((part, peer))
    }

    /// Takes the early messages whose turn it is.
    fn take_early(&mut self, local: &Local) {
        while let Some((at, target)) = self.next_early(local) {
            self.early.remove(at);
            self.state = target;
        }
    }

    fn next_early(&self, local: &Local) -> Option<(usize, LocalIndex)> {
        let state = local.state(self.state)?;
        let mut early = self.early.iter().enumerate();
        early.find_map(|(at, (from, act))| {
            // Messages of one sender arrive in their order.
            let first = !self.early.iter().take(at).any(|(other, _)| other == from);
            let mut steps = state.steps.iter().filter(|_| first);
            let step = steps.find(|step| step.label.from == *from && step.label.act == *act)?;
            Some((at, step.target))
        })
    }

    /// The part with a message whose turn comes after messages of other roles. It does not fit now.
    fn keeping(&self, local: &Local, message: Observed<'_>) -> Option<(Self, Role)> {
        if self.early.len() == MAX_EARLY {
            return None;
        }
        // The messages of the sender that wait already. Its messages arrive in their order.
        let of_sender = self.early.iter();
        let of_sender = of_sender.filter(|(from, _)| message.peers.only() == Some(*from));
        let waiting: Vec<&Performed> = of_sender.map(|(_, act)| act).collect();
        let mut reached = vec![(self.state, 0)];
        let mut next = 0;
        while let Some((at, taken)) = reached.get(next).copied() {
            next += 1;
            let steps = local.state(at).map_or(&[][..], LocalState::steps);
            for step in steps.iter().filter(|step| step.label.from != self.role) {
                let Label { from, act, .. } = &step.label;
                let fits = message.peers.contains(*from) && act.is(message.act);
                if fits && taken == waiting.len() {
                    let mut part = self.clone();
                    part.early.push((*from, act.clone()));
                    return Some((part, *from));
                }
                // Messages of other senders can be under way.
                let taken = match message.peers.only() == Some(*from) {
                    true if waiting.get(taken) == Some(&act) => taken + 1,
                    true => continue,
                    false => taken,
                };
                let after = (step.target, taken);
                if !reached.contains(&after) && reached.len() < MAX_SEARCHED {
                    reached.push(after);
                }
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_run_allocates_is_counted() {
        let text = r#"<scxml initial="1">
            <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="request" from="a" to="c" target="3"/></state>
            <state id="3"><transition performative="own-act" from="c" to="b" target="4"/></state>
            <state id="4"><transition performative="agree" from="b" to="a" target="5"/></state>
            <state id="5" final="yes"/></scxml>"#;
        let machine = Machine::read("own", text).unwrap();
        let locals = machine.projection().map_or(&[][..], |it| it.locals());
        let message = |act| Observed {
            act,
            own: false,
            peers: RoleSet::ALL,
        };
        let mut run = LocalRun::new(locals, RoleSet::ALL);
        let parts = |run: &LocalRun| run.parts.capacity() * size_of::<Part>();
        assert!(run.parts.len() == 3 && run.allocated() == parts(&run));
        // The message waits for the request.
        run.take(locals, message(Act::Other("own-act"))).unwrap();
        assert!(run.waits());
        let [part] = &run.parts[..] else {
            panic!("{run:?}")
        };
        let early = part.early.capacity() * size_of::<(Role, Performed)>() + "own-act".len();
        assert_eq!(run.allocated(), parts(&run) + early);
        // A sent message may not have arrived.
        let mut run = LocalRun::new(locals, RoleSet::ALL);
        let request = Observed {
            own: true,
            ..message(Act::named("request"))
        };
        run.take(locals, request).unwrap();
        let before = run.without_last.capacity() * size_of::<Part>();
        assert!(before > 0);
        assert_eq!(run.allocated(), parts(&run) + before);
    }
}
