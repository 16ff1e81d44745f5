//! A protocol as a state machine, checked: what [`crate::scxml`] reads and conversations follow.

use std::time::Duration;

use regex::Regex;

use crate::act::{Act, Acts, CANCEL, NOT_UNDERSTOOD};

/// Most roles of a protocol.
pub(crate) const MAX_ROLES: usize = 32;

/// An interaction protocol as a state machine.
///
/// Made by [`Machine::read`]; every state it names exists and can be reached, and no message can
/// mean two things in one state.
#[derive(Debug, Clone)]
pub struct Machine {
    pub(crate) name: String,
    pub(crate) aliases: Vec<String>,
    pub(crate) title: Option<String>,
    pub(crate) scope: Scope,
    pub(crate) cancel: Cancel,
    /// Whether any party may end the conversation with `failure`, as fipa_acl has it; otherwise
    /// only somebody outside (a message transport service) may, and parties where the states say so.
    pub(crate) failure_by_parties: bool,
    pub(crate) roles: Vec<String>,
    /// Index of the role that begins.
    pub(crate) initiator: u8,
    pub(crate) initial: u16,
    pub(crate) states: Vec<State>,
}

/// What has a state of its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Scope {
    /// The whole conversation is in one state, as in fipa_acl.
    Conversation,
    /// Each participant is in a state of its own with the initiator.
    Participant,
}

/// Who may cancel a conversation with the cancel meta-protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Cancel {
    /// Who began it, as the standard has it.
    Initiator,
    /// Anybody who takes part, as fipa_acl has it.
    Anyone,
    /// Nobody: the protocol defines no cancelling.
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
    /// The transitions, and those of states that are reached by leaving out optional steps.
    pub(crate) steps: Vec<Transition>,
    /// Likewise.
    pub(crate) embedded: Vec<Subprotocol>,
}

/// A message that leads from one state to another.
#[derive(Debug, Clone)]
pub struct Transition {
    pub(crate) acts: Acts,
    pub(crate) from: Roles,
    pub(crate) to: Roles,
    pub(crate) target: u16,
    pub(crate) optional: bool,
}

/// A protocol that may run within a state of another.
#[derive(Debug, Clone)]
pub struct Subprotocol {
    pub(crate) text: String,
    pub(crate) name: Regex,
    pub(crate) from: Roles,
    pub(crate) proxied_to: Option<Roles>,
}

/// What happens when no message comes in time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeout {
    pub(crate) after: After,
    pub(crate) target: u16,
}

/// When time is up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum After {
    /// At the `reply-by` of the message that led to the state, if it has one.
    ReplyBy,
    /// So long after the state was entered.
    Span(Duration),
}

/// A set of roles, written as one role or as a pattern of their names.
#[derive(Debug, Clone)]
pub(crate) struct Roles {
    pub(crate) text: String,
    /// A bit for each role of the machine.
    pub(crate) mask: u32,
    /// Whether it stands for anybody, with a role or without (`.*`).
    pub(crate) anyone: bool,
}

impl Machine {
    /// The standard name: what messages have as `protocol`.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Other names under which peers know it.
    #[must_use]
    pub fn aliases(&self) -> &[String] {
        &self.aliases
    }

    /// What it is, in a line, if the file says so.
    #[must_use]
    pub fn title(&self) -> Option<&str> {
        self.title.as_deref()
    }

    /// What has a state of its own.
    #[must_use]
    pub fn scope(&self) -> Scope {
        self.scope
    }

    /// Who may cancel.
    #[must_use]
    pub fn cancel(&self) -> Cancel {
        self.cancel
    }

    /// The roles, in the order in which the file names them.
    #[must_use]
    pub fn roles(&self) -> &[String] {
        &self.roles
    }

    /// The role that begins.
    #[must_use]
    pub fn initiator(&self) -> &str {
        let role = self.roles.get(usize::from(self.initiator));
        role.map_or("", String::as_str)
    }

    /// The state in which it begins.
    #[must_use]
    pub fn initial(&self) -> &State {
        // `states` is never empty and `initial` one of them: see `scxml::build`.
        self.state(self.initial).unwrap_or(&self.states[0])
    }

    /// The states, in the order of the file.
    #[must_use]
    pub fn states(&self) -> &[State] {
        &self.states
    }

    /// Whether messages may name the protocol so. Case does not matter.
    #[must_use]
    pub fn is_called(&self, name: &str) -> bool {
        self.name.eq_ignore_ascii_case(name)
            || self
                .aliases
                .iter()
                .any(|alias| alias.eq_ignore_ascii_case(name))
    }

    /// The state to which a transition of this machine leads.
    #[must_use]
    pub fn target(&self, transition: &Transition) -> &str {
        self.state(transition.target).map_or("", State::id)
    }

    /// The state to which a time-out of this machine leads.
    #[must_use]
    pub fn timeout_target(&self, timeout: Timeout) -> &str {
        self.state(timeout.target).map_or("", State::id)
    }

    /// Whether the initiator may say this to somebody else, in whatever state.
    pub(crate) fn is_said_by_initiator(&self, act: Act<'_>) -> bool {
        let initiator = 1_u32 << self.initiator;
        let says = |state: &State| step(&state.transitions, act, initiator, !initiator).is_some();
        [CANCEL, NOT_UNDERSTOOD].contains(&act) || self.states.iter().any(says)
    }

    /// Whether somebody else may say this to the initiator, in whatever state.
    pub(crate) fn is_answer(&self, act: Act<'_>) -> bool {
        let initiator = 1_u32 << self.initiator;
        let answers =
            |state: &State| step(&state.transitions, act, !initiator, initiator).is_some();
        act == NOT_UNDERSTOOD || self.states.iter().any(answers)
    }

    #[inline]
    pub(crate) fn state(&self, id: u16) -> Option<&State> {
        self.states.get(usize::from(id))
    }
}

impl State {
    /// Its name in the file.
    #[must_use]
    pub fn id(&self) -> &str {
        &self.id
    }

    /// Whether the protocol may end here. There can be ways out all the same.
    #[must_use]
    pub fn is_final(&self) -> bool {
        self.is_final
    }

    /// The transitions that the file gives the state.
    #[must_use]
    pub fn transitions(&self) -> &[Transition] {
        &self.transitions
    }

    /// The protocols that may run within it.
    #[must_use]
    pub fn subprotocols(&self) -> &[Subprotocol] {
        &self.subprotocols
    }

    /// What happens when no message comes in time.
    #[must_use]
    pub fn timeout(&self) -> Option<Timeout> {
        self.timeout
    }

    /// Whether nothing can follow but an answer to the last message.
    pub(crate) fn is_over(&self) -> bool {
        self.is_final && self.steps.is_empty() && self.embedded.is_empty()
    }
}

impl Transition {
    /// The performative as the file has it: a name, or a regular expression for several.
    #[must_use]
    pub fn performative(&self) -> &str {
        self.acts.text()
    }

    /// The role that sends.
    #[must_use]
    pub fn from(&self) -> &str {
        &self.from.text
    }

    /// The role that receives.
    #[must_use]
    pub fn to(&self) -> &str {
        &self.to.text
    }

    /// Whether the step may be left out, and its next one taken at once.
    #[must_use]
    pub fn is_optional(&self) -> bool {
        self.optional
    }
}

impl Subprotocol {
    /// The name of the protocol, or a regular expression for several.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.text
    }

    /// The role that begins it.
    #[must_use]
    pub fn from(&self) -> &str {
        &self.from.text
    }

    /// The role to which answers are passed on, with any performative.
    #[must_use]
    pub fn proxied_to(&self) -> Option<&str> {
        self.proxied_to.as_ref().map(|roles| roles.text.as_str())
    }

    pub(crate) fn admits(&self, machine: &Machine) -> bool {
        let mut names = std::iter::once(&machine.name).chain(&machine.aliases);
        names.any(|name| self.name.is_match(name))
    }
}

impl Timeout {
    /// When time is up.
    #[must_use]
    pub fn after(self) -> After {
        self.after
    }
}

impl Roles {
    #[inline]
    pub(crate) fn includes(&self, mask: u32) -> bool {
        self.anyone || self.mask & mask != 0
    }

    pub(crate) fn overlaps(&self, other: &Self) -> bool {
        self.anyone || other.anyone || self.mask & other.mask != 0
    }
}

/// The first step that takes this message.
#[inline]
pub(crate) fn step<'m>(
    steps: &'m [Transition],
    act: Act<'_>,
    from: u32,
    to: u32,
) -> Option<&'m Transition> {
    steps
        .iter()
        .find(|step| step.acts.contains(act) && step.from.includes(from) && step.to.includes(to))
}
