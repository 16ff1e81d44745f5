//! Protocols as checked state machines. [`crate::protocol::scxml`] reads them.

use std::num::NonZeroU16;
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::Pattern;

use crate::protocol::act::{Act, Acts, CANCEL, FAILURE, INFORM, NOT_UNDERSTOOD};
use crate::protocol::index::StateId;
use crate::protocol::projection::Projection;
use crate::protocol::role::{Role, RoleSet};

/// Maximum number of roles of a protocol.
pub(crate) const MAX_ROLES: usize = 32;

/// An interaction protocol as a state machine.
///
/// [`Machine::read`] makes one. Every state exists and is reachable, and in each state a message
/// leads to one state only.
#[derive(Debug, Clone)]
pub struct Machine {
    pub(crate) name: String,
    pub(crate) aliases: Vec<String>,
    pub(crate) title: Option<String>,
    pub(crate) scope: Scope,
    pub(crate) cancel: Cancel,
    /// Whether any party may end the conversation with `failure`, as in fipa_acl. Otherwise, a party
    /// may send `failure` only in a transition of the machine, and a message transport service at any
    /// time.
    pub(crate) failure_by_parties: bool,
    pub(crate) roles: Vec<String>,
    /// Index of the initiating role.
    pub(crate) initiator: Role,
    pub(crate) initial: StateId,
    pub(crate) states: Vec<State>,
    /// The protocol as each role sees it, if it has three or more roles and can be projected.
    pub(crate) projection: Option<Arc<Projection>>,
}

/// The scope of the state of a protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Scope {
    /// The conversation has one state, as in fipa_acl.
    Conversation,
    /// Each participant has a state of its own with the initiator.
    Participant,
}

/// The agents that may cancel a conversation with the cancel meta-protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Cancel {
    /// The initiator, as in the standard.
    Initiator,
    /// Any participant, as in fipa_acl.
    Anyone,
    /// No agent: the protocol cannot be canceled.
    Nobody,
}

/// A state of a [`Machine`].
#[derive(Debug, Clone)]
pub struct State {
    pub(crate) id: String,
    pub(crate) is_final: bool,
    pub(crate) transitions: Vec<Transition>,
    pub(crate) subprotocols: Vec<Subprotocol>,
    pub(crate) timeout: Option<Timeout>,
    /// The transitions of this state and of the states behind its optional transitions.
    pub(crate) steps: Vec<Transition>,
    /// The subprotocols of this state and of the states behind its optional transitions.
    pub(crate) embedded: Vec<Subprotocol>,
}

/// A transition from one state to another by a message.
#[derive(Debug, Clone)]
pub struct Transition {
    pub(crate) acts: Acts,
    pub(crate) from: Roles,
    pub(crate) to: Roles,
    pub(crate) target: StateId,
    pub(crate) optional: bool,
    pub(crate) guard: Guard,
}

/// The conditions of a transition about the other participants. There are none by default.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Guard {
    /// Maximum number of participants in the target state; none for any number.
    pub(crate) at_most: Option<NonZeroU16>,
    /// Whether all participants must be in a state with the same transition, or in its target.
    pub(crate) when_all: bool,
}

/// A protocol that may run within a state of another protocol.
#[derive(Debug, Clone)]
pub struct Subprotocol {
    pub(crate) text: String,
    pub(crate) name: Pattern,
    pub(crate) from: Roles,
    pub(crate) proxied_to: Option<Roles>,
}

/// A transition that is taken when no message arrives in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeout {
    pub(crate) after: After,
    pub(crate) target: StateId,
}

/// The time of a timeout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum After {
    /// The `reply-by` of the message that led to the state. Without one, there is no timeout.
    ReplyBy,
    /// A span after the message that led to the state.
    Span(Duration),
}

/// A set of roles, written as one role or as a pattern of their names.
#[derive(Debug, Clone)]
pub(crate) struct Roles {
    pub(crate) text: String,
    /// A bit for each role of the machine.
    pub(crate) mask: RoleSet,
    /// Whether it stands for any agent, with a role or without (`.*`).
    pub(crate) anyone: bool,
}

impl Machine {
    /// The name: the `protocol` of its messages.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Other names that messages may have as `protocol`.
    #[must_use]
    pub fn aliases(&self) -> &[String] {
        &self.aliases
    }

    /// A description in one line, if the file has one.
    #[must_use]
    pub fn title(&self) -> Option<&str> {
        self.title.as_deref()
    }

    /// The scope of its state.
    #[must_use]
    pub fn scope(&self) -> Scope {
        self.scope
    }

    /// The agents that may cancel it.
    #[must_use]
    pub fn cancel(&self) -> Cancel {
        self.cancel
    }

    /// The roles, in the order of the file.
    #[must_use]
    pub fn roles(&self) -> &[String] {
        &self.roles
    }

    /// The initiating role.
    #[must_use]
    pub fn initiator(&self) -> &str {
        let role = self.roles.get(self.initiator.index());
        role.map_or("", String::as_str)
    }

    /// The initial state.
    #[must_use]
    pub fn initial(&self) -> &State {
        // `scxml::build` ensures that `initial` is the index of a state.
        self.state(self.initial).unwrap_or(&self.states[0])
    }

    /// The protocol as each role sees it, if it has three or more roles: see
    /// [`projection`](crate::protocol::projection). `None` if it has two roles, which see all messages, or if
    /// it cannot be projected. [`Projection::defects`] has the reasons.
    #[must_use]
    pub fn projection(&self) -> Option<&Projection> {
        self.projection.as_deref()
    }

    /// The states, in the order of the file.
    #[must_use]
    pub fn states(&self) -> &[State] {
        &self.states
    }

    /// Whether `name` is the name or an alias of the protocol. Case is ignored.
    #[must_use]
    #[inline]
    pub fn is_called(&self, name: &str) -> bool {
        // Comparing bytes is several times as fast, and nearly all messages have this name.
        self.name == name || self.is_called_in_any_case(name)
    }

    fn is_called_in_any_case(&self, name: &str) -> bool {
        let mut names = std::iter::once(&self.name).chain(&self.aliases);
        names.any(|known| known.eq_ignore_ascii_case(name))
    }

    /// The state to which a transition of this machine leads.
    #[must_use]
    pub fn target(&self, transition: &Transition) -> &str {
        self.state(transition.target).map_or("", State::id)
    }

    /// The state to which a timeout of this machine leads.
    #[must_use]
    pub fn timeout_target(&self, timeout: Timeout) -> &str {
        self.state(timeout.target).map_or("", State::id)
    }

    /// Whether the initiator may send this to another agent in any state.
    pub(crate) fn is_sent_by_initiator(&self, act: Act<'_>) -> bool {
        let initiator = RoleSet::of(self.initiator);
        let sends = |state: &State| step(&state.transitions, act, initiator, !initiator).is_some();
        [CANCEL, NOT_UNDERSTOOD].contains(&act) || self.states.iter().any(sends)
    }

    /// Whether any agent may send this after the first message.
    pub(crate) fn may_follow(&self, act: Act<'_>) -> bool {
        let contains = |state: &State| {
            let proxied = state.embedded.iter().any(|sub| sub.proxied_to.is_some());
            proxied || state.steps.iter().any(|step| step.acts.contains(act))
        };
        let later = (0..)
            .map(StateId::new)
            .zip(&self.states)
            .any(|(at, state)| {
                // The transitions of the initial state follow only if another state leads back to it.
                (at != self.initial || self.returns()) && contains(state)
            });
        let cancels = act == CANCEL && self.cancel != Cancel::Nobody;
        later || cancels || [NOT_UNDERSTOOD, FAILURE, INFORM].contains(&act)
    }

    /// The states to which a message that looks like the first one leads later: see [`step`].
    pub(crate) fn later_targets(&self, act: Act<'_>, first: &Transition) -> Vec<StateId> {
        let later = self.later_steps(act, first).map(|step| step.target);
        let mut targets: Vec<StateId> = later.filter(|target| *target != first.target).collect();
        targets.sort_unstable();
        targets.dedup();
        targets
    }

    /// Whether a message like the first one may come later. If it leads to the state after the first
    /// one, only the state before it is uncertain.
    pub(crate) fn may_repeat(&self, act: Act<'_>, first: &Transition) -> bool {
        self.later_steps(act, first).next().is_some()
    }

    fn later_steps<'m>(
        &'m self,
        act: Act<'m>,
        first: &'m Transition,
    ) -> impl Iterator<Item = &'m Transition> {
        let later = (0..).map(StateId::new).zip(&self.states);
        let later = later.filter(|(at, _)| *at != self.initial || self.returns());
        later
            .flat_map(|(_, state)| &state.transitions)
            .filter(move |step| step.acts.contains(act) && step.from.overlaps(&first.from))
    }

    fn returns(&self) -> bool {
        let mut all = self.states.iter().flat_map(|state| &state.transitions);
        all.any(|step| step.target == self.initial)
    }

    /// Whether another agent may send this to the initiator in any state.
    pub(crate) fn is_answer(&self, act: Act<'_>) -> bool {
        let initiator = RoleSet::of(self.initiator);
        let answers =
            |state: &State| step(&state.transitions, act, !initiator, initiator).is_some();
        act == NOT_UNDERSTOOD || self.states.iter().any(answers)
    }

    /// Whether a received message of this performative shows that the receiver leads the conversation: the
    /// initiator does not send it.
    pub(crate) fn shows_initiator(&self, act: Act<'_>) -> bool {
        self.is_answer(act) && (act == NOT_UNDERSTOOD || !self.is_sent_by_initiator(act))
    }

    #[inline]
    pub(crate) fn state(&self, id: StateId) -> Option<&State> {
        self.states.get(id.index())
    }
}

impl State {
    /// Identifier of the state in the file.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Whether the protocol may end in this state. The state may still have transitions.
    #[must_use]
    pub fn is_final(&self) -> bool {
        self.is_final
    }

    /// The transitions of the state in the file.
    #[must_use]
    pub fn transitions(&self) -> &[Transition] {
        &self.transitions
    }

    /// The protocols that may run within the state.
    #[must_use]
    pub fn subprotocols(&self) -> &[Subprotocol] {
        &self.subprotocols
    }

    /// The transition that is taken when no message arrives in time.
    #[must_use]
    pub fn timeout(&self) -> Option<Timeout> {
        self.timeout
    }

    /// Whether only an answer to the last message can follow.
    pub(crate) fn is_over(&self) -> bool {
        self.is_final && self.steps.is_empty() && self.embedded.is_empty()
    }
}

impl Transition {
    /// The performative in the file: a name, or a regular expression for several.
    #[must_use]
    pub fn performative(&self) -> &str {
        self.acts.text()
    }

    /// The sending role, or a regular expression for several.
    #[must_use]
    pub fn from(&self) -> &str {
        &self.from.text
    }

    /// The receiving role, or a regular expression for several.
    #[must_use]
    pub fn to(&self) -> &str {
        &self.to.text
    }

    /// Whether the transition may be skipped: the transitions of its target are then allowed too.
    #[must_use]
    pub fn is_optional(&self) -> bool {
        self.optional
    }

    /// The maximum number of participants that may be in the target state at the same time.
    #[must_use]
    pub fn at_most(&self) -> Option<u16> {
        self.guard.at_most.map(NonZeroU16::get)
    }

    /// Whether the transition needs all participants: each is in a state with the same transition, or
    /// in its target. A participant in a state common to all protocols, for example `undelivered`,
    /// does not count.
    #[must_use]
    pub fn needs_all(&self) -> bool {
        self.guard.when_all
    }
}

impl Subprotocol {
    /// The name of the protocol, or a regular expression for several.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.text
    }

    /// The role that may begin the protocol.
    #[must_use]
    pub fn from(&self) -> &str {
        &self.from.text
    }

    /// The role to which answers with any performative may be forwarded.
    #[must_use]
    pub fn proxied_to(&self) -> Option<&str> {
        self.proxied_to.as_ref().map(|roles| roles.text.as_str())
    }

    pub(crate) fn admits(&self, machine: &Machine) -> bool {
        let mut names = std::iter::once(&machine.name).chain(&machine.aliases);
        names.any(|name| self.name.matches(name))
    }
}

impl Timeout {
    /// The time of the timeout.
    #[must_use]
    pub fn after(self) -> After {
        self.after
    }
}

impl Roles {
    /// Returns the role, if it is the only one.
    pub(crate) fn one(&self) -> Option<Role> {
        self.mask.only().filter(|_| !self.anyone)
    }

    #[inline]
    pub(crate) fn includes(&self, roles: RoleSet) -> bool {
        self.anyone || self.mask.intersects(roles)
    }

    pub(crate) fn overlaps(&self, other: &Self) -> bool {
        self.anyone || other.anyone || self.mask.intersects(other.mask)
    }
}

/// Returns the first transition for this message.
#[inline]
pub(crate) fn step<'m>(
    steps: &'m [Transition],
    act: Act<'_>,
    from: RoleSet,
    to: RoleSet,
) -> Option<&'m Transition> {
    steps
        .iter()
        .find(|step| step.acts.contains(act) && step.from.includes(from) && step.to.includes(to))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_protocol_is_called_by_its_names_in_any_case() {
        let library = crate::Library::standard();
        let request = library.find("fipa-request").unwrap();
        assert!(request.is_called("fipa-request") && request.is_called("FIPA-Request"));
        assert!(!request.is_called("fipa-request-when"));
    }

    #[test]
    fn the_initiator_may_be_any_role_of_the_file() {
        let text = r#"<scxml initial="1">
            <state id="0"><transition performative="agree" from="b" to="a" target="2"/></state>
            <state id="1"><transition performative="request" from="a" to="b" target="0"/></state>
            <state id="2" final="yes"/></scxml>"#;
        let machine = Machine::read("own", text).unwrap();
        assert_eq!((machine.initiator(), machine.initiator.get()), ("a", 1));
        let [request, agree] = ["request", "agree"].map(Act::named);
        assert!(machine.is_sent_by_initiator(request) && !machine.is_sent_by_initiator(agree));
        assert!(machine.is_answer(agree) && !machine.is_answer(request));
        assert!(machine.shows_initiator(agree) && !machine.shows_initiator(request));
    }

    #[test]
    fn any_role_overlaps_each_role() {
        let roles = |count: usize, anyone| Roles {
            text: String::new(),
            mask: RoleSet::first(count) & !RoleSet::first(count / 2),
            anyone,
        };
        let (one, other, any) = (roles(1, false), roles(4, false), roles(0, true));
        assert!(one.overlaps(&one) && other.overlaps(&roles(3, false)));
        assert!(any.overlaps(&one) && one.overlaps(&any) && any.overlaps(&any));
        assert!(!one.overlaps(&other) && !other.overlaps(&one));
    }
}
