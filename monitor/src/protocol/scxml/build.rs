//! Builds a machine from a document: resolves all names, makes all checks, collects all mistakes.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{Pattern, PatternError};

use super::document::{self, Document};
use super::{Ambiguity, Doubt, MAX_MISTAKES, Mistake, Problem, Warning};
use crate::protocol::act::{Acts, is_word, near_standard};
use crate::protocol::index::StateId;
use crate::protocol::machine::{
    After, Cancel, Guard, MAX_ROLES, Machine, Roles, Scope, State, Subprotocol, Timeout, Transition,
};
use crate::protocol::projection::Projection;
use crate::protocol::role::{Role, RoleSet};
use crate::protocol::spelling::one_edit_apart;

/// Maximum number of transitions of a state, including those behind optional transitions.
const MAX_STEPS: usize = 100;

pub(super) fn machine(
    document: &Document,
    file_name: &str,
) -> (Result<Machine, Vec<Mistake>>, Vec<Warning>) {
    let mut builder = Builder {
        document,
        mistakes: Vec::new(),
        warnings: Vec::new(),
        roles: Vec::new(),
        ids: HashMap::new(),
        known_acts: HashMap::new(),
        known_roles: HashMap::new(),
    };
    let built = builder.machine(file_name);
    let built = match built {
        Some(machine) if builder.mistakes.is_empty() => Ok(machine),
        _ => Err(builder.mistakes),
    };
    (built, builder.warnings)
}

struct Builder<'d> {
    document: &'d Document,
    mistakes: Vec<Mistake>,
    warnings: Vec<Warning>,
    roles: Vec<String>,
    ids: HashMap<&'d str, StateId>,
    /// Compiled patterns. Most files repeat the same few.
    known_acts: HashMap<&'d str, Acts>,
    known_roles: HashMap<&'d str, Roles>,
}

impl<'d> Builder<'d> {
    /// Builds the machine. It is valid only if there are no mistakes.
    fn machine(&mut self, file_name: &str) -> Option<Machine> {
        let document = self.document;
        if document.states.is_empty() {
            self.wrong(document.line, Problem::NoState);
            return None;
        }
        self.name_states();
        self.name_roles()?;
        let initial = match &document.initial {
            Some(id) => self.state(document.line, id),
            None => {
                let problem = Problem::Missing {
                    element: "scxml",
                    attribute: "initial",
                };
                self.wrong(document.line, problem);
                None
            }
        };
        let mut states = Vec::new();
        for state in &document.states {
            states.push(self.build_state(state));
        }
        let mut machine = Machine {
            name: document
                .name
                .clone()
                .unwrap_or_else(|| file_name.to_owned()),
            aliases: self.aliases(),
            title: document.title.clone(),
            scope: self.scope(),
            cancel: self.cancel(),
            failure_by_parties: !document.extended,
            roles: self.roles.clone(),
            initiator: Role::new(0),
            initial: initial?,
            states,
            projection: None,
        };
        self.bound_roles(&machine);
        self.skip_optional(&mut machine);
        self.reachable(&machine);
        self.unambiguous(&machine);
        machine.initiator = self.beginner(&machine)?;
        if machine.scope == Scope::Conversation
            && machine.roles.len() > 2
            && self.mistakes.is_empty()
        {
            machine.projection = Projection::new(&machine).ok().map(Arc::new);
        }
        Some(machine)
    }

    fn name_states(&mut self) {
        for (index, state) in (0..).map(StateId::new).zip(&self.document.states) {
            if let Some(first) = self.ids.get(state.id.as_str()) {
                let first = self.document.states.get(first.index());
                let problem = Problem::DuplicateState {
                    id: state.id.clone(),
                    first: first.map_or(0, |state| state.line),
                };
                self.wrong(state.line, problem);
            } else {
                self.ids.insert(&state.id, index);
            }
        }
    }

    /// Collects the roles: all `from` and `to` that are plain names.
    fn name_roles(&mut self) -> Option<()> {
        let document = self.document;
        for state in &document.states {
            let of_transitions = state
                .transitions
                .iter()
                .flat_map(|transition| [&transition.from, &transition.to]);
            let named = of_transitions.flatten();
            for role in named.filter(|role| is_word(role)) {
                if !self.roles.contains(role) {
                    self.roles.push(role.clone());
                }
            }
            if self.roles.len() > MAX_ROLES {
                let problem = Problem::TooMany {
                    what: "roles",
                    limit: MAX_ROLES,
                };
                self.wrong(state.line, problem);
                return None;
            }
        }
        Some(())
    }

    fn build_state(&mut self, state: &'d document::State) -> State {
        let is_final = match &state.is_final {
            None => false,
            Some(text) => self.yes_or_no(state.line, "final", text),
        };
        let mut transitions = Vec::new();
        let mut timeout = None;
        for transition in &state.transitions {
            if let Some(after) = &transition.after {
                if timeout.is_some() {
                    self.wrong(transition.line, Problem::TwoTimeouts(state.id.clone()));
                }
                timeout = self.timeout(transition, after);
            } else if let Some(transition) = self.transition(transition) {
                transitions.push(transition);
            }
        }
        let mut subprotocols = Vec::new();
        for subprotocol in &state.subprotocols {
            subprotocols.extend(self.subprotocol(subprotocol));
        }
        let empty = state.transitions.is_empty() && state.subprotocols.is_empty();
        if empty && !is_final {
            self.wrong(state.line, Problem::DeadEnd(state.id.clone()));
        }
        State {
            id: state.id.clone(),
            is_final,
            steps: transitions.clone(),
            embedded: subprotocols.clone(),
            transitions,
            subprotocols,
            timeout,
        }
    }

    fn transition(&mut self, read: &'d document::Transition) -> Option<Transition> {
        let acts = self.required(read.line, "performative", &read.performative);
        let from = self.required(read.line, "from", &read.from);
        let to = self.required(read.line, "to", &read.to);
        let target = self.state(read.line, &read.target);
        let optional = match &read.optional {
            None => false,
            Some(text) => self.yes_or_no(read.line, "optional", text),
        };
        let acts = acts.and_then(|text| self.acts(read.line, text));
        let from = from.and_then(|text| self.roles(read.line, "from", text));
        let to = to.and_then(|text| self.roles(read.line, "to", text));
        if let (Some(from), Some(to)) = (&from, &to)
            && from.one().is_some_and(|role| to.one() == Some(role))
        {
            self.wrong(read.line, Problem::ToItself(from.text.clone()));
        }
        let guard = self.guard(read);
        Some(Transition {
            acts: acts?,
            from: from?,
            to: to?,
            target: target?,
            optional,
            guard,
        })
    }

    fn guard(&mut self, read: &'d document::Transition) -> Guard {
        let mut guard = Guard::default();
        if let Some(text) = &read.at_most {
            match text.parse() {
                Ok(most) => guard.at_most = Some(most),
                Err(_) => self.value(read.line, "at-most", text, "a number from 1 to 65535"),
            }
        }
        match read.when.as_deref() {
            None => {}
            Some("all") => guard.when_all = true,
            Some(other) => self.value(read.line, "when", other, "all"),
        }
        let per_participant = self.document.scope.as_deref() == Some("participant");
        if guard != Guard::default() && !per_participant {
            self.wrong(read.line, Problem::GuardOfScope);
        }
        guard
    }

    fn timeout(&mut self, read: &'d document::Transition, after: &str) -> Option<Timeout> {
        let when = match after {
            "reply-by" => Some(After::ReplyBy),
            span => duration(span).map(After::Span),
        };
        if when.is_none() {
            self.value(
                read.line,
                "after",
                after,
                "reply-by, or a span such as 500ms, 30s, 10min or 1h (at most 24h)",
            );
        }
        let target = self.state(read.line, &read.target);
        Some(Timeout {
            after: when?,
            target: target?,
        })
    }

    fn subprotocol(&mut self, read: &'d document::Subprotocol) -> Option<Subprotocol> {
        let name = match Pattern::ignoring_case(&read.name) {
            Ok(name) => Some(name),
            Err(error) => self.no_pattern(read.line, "name", &read.name, &error),
        };
        let from = self.roles(read.line, "from", &read.from);
        let proxied_to = match &read.proxied_to {
            Some(text) => Some(self.roles(read.line, "proxied_to", text)?),
            None => None,
        };
        Some(Subprotocol {
            text: read.name.clone(),
            name: name?,
            from: from?,
            proxied_to,
        })
    }

    fn acts(&mut self, line: usize, text: &'d str) -> Option<Acts> {
        if let Some(known) = self.known_acts.get(text) {
            return Some(known.clone());
        }
        match Acts::new(text) {
            Ok(acts) => {
                // The words of a choice such as `agree|refuse`.
                for word in text.split(['|', '(', ')']) {
                    if let Some(standard) = near_standard(word)
                        && self.warnings.len() < MAX_MISTAKES
                    {
                        let performative = word.to_owned();
                        let doubt = Doubt::NearPerformative {
                            performative,
                            standard,
                        };
                        self.warnings.push(Warning { line, doubt });
                    }
                }
                self.known_acts.insert(text, acts.clone());
                Some(acts)
            }
            Err(error) => self.no_pattern(line, "performative", text, &error),
        }
    }

    fn roles(&mut self, line: usize, attribute: &'static str, text: &'d str) -> Option<Roles> {
        if let Some(known) = self.known_roles.get(text) {
            return Some(known.clone());
        }
        let pattern = match Pattern::new(text) {
            Ok(pattern) => pattern,
            Err(error) => return self.no_pattern(line, attribute, text, &error),
        };
        let mut mask = RoleSet::NONE;
        for (number, role) in (0..).map(Role::new).zip(&self.roles) {
            if pattern.matches(role) {
                mask |= RoleSet::of(number);
            }
        }
        let anyone = text == ".*";
        if mask.is_empty() && !anyone {
            self.wrong(line, Problem::UnboundRole(text.to_owned()));
            return None;
        }
        let roles = Roles {
            text: text.to_owned(),
            mask,
            anyone,
        };
        self.known_roles.insert(text, roles.clone());
        Some(roles)
    }

    /// Checks that every sending role begins the protocol or receives a message.
    fn bound_roles(&mut self, machine: &Machine) {
        let all = || machine.states.iter().flat_map(|state| &state.transitions);
        let begin = &machine.initial().transitions;
        for (number, role) in (0..).map(Role::new).zip(&machine.roles) {
            let bit = RoleSet::of(number);
            let first = begin.iter().any(|step| step.from.mask.contains(number));
            let addressed = all().any(|step| step.to.includes(bit));
            let states = machine.states.iter().enumerate();
            let mut sent = states.flat_map(|(at, state)| {
                let steps = state.transitions.iter();
                steps
                    .filter(|step| step.from.text == *role)
                    .map(move |step| (at, step))
            });
            if let Some((state, step)) = sent.next().filter(|_| !first && !addressed) {
                let line = self.line_of_step(state, step);
                self.wrong(line, Problem::UnboundRole(role.clone()));
            }
        }
    }

    /// Adds to each state the transitions of the states behind its optional transitions.
    fn skip_optional(&mut self, machine: &mut Machine) {
        for index in 0..machine.states.len() {
            let (mut steps, mut embedded) = (Vec::new(), Vec::new());
            let mut reached = vec![index];
            let mut next = 0;
            while let Some(state) = reached.get(next).and_then(|at| machine.states.get(*at)) {
                next += 1;
                steps.extend(state.transitions.iter().cloned());
                embedded.extend(state.subprotocols.iter().cloned());
                for transition in state.transitions.iter().filter(|step| step.optional) {
                    let target = transition.target.index();
                    if target == index {
                        let id = state.id.clone();
                        self.wrong(self.line_of(index), Problem::OptionalCircle(id));
                    }
                    if !reached.contains(&target) {
                        reached.push(target);
                    }
                }
                if steps.len() > MAX_STEPS {
                    let problem = Problem::TooMany {
                        what: "transitions of a state",
                        limit: MAX_STEPS,
                    };
                    self.wrong(self.line_of(index), problem);
                    return;
                }
            }
            if let Some(state) = machine.states.get_mut(index) {
                (state.steps, state.embedded) = (steps, embedded);
            }
        }
    }

    fn reachable(&mut self, machine: &Machine) {
        let mut reached = vec![false; machine.states.len()];
        let mut next = vec![machine.initial];
        while let Some(id) = next.pop() {
            let Some((state, seen)) = machine
                .state(id)
                .zip(reached.get_mut(id.index()))
                .filter(|(_, seen)| !**seen)
            else {
                continue;
            };
            *seen = true;
            next.extend(state.transitions.iter().map(|step| step.target));
            next.extend(state.timeout.map(|timeout| timeout.target));
        }
        for (state, _) in self
            .document
            .states
            .iter()
            .zip(reached)
            .filter(|(_, reached)| !reached)
        {
            let problem = Problem::UnreachableState(state.id.clone());
            self.mistakes.push(Mistake {
                line: state.line,
                problem,
            });
        }
    }

    fn unambiguous(&mut self, machine: &Machine) {
        for (index, state) in machine.states.iter().enumerate() {
            for (index_of_one, one) in state.steps.iter().enumerate() {
                for other in state.steps.iter().take(index_of_one) {
                    let apart = one.target == other.target
                        || !one.from.overlaps(&other.from)
                        || !one.to.overlaps(&other.to);
                    if apart {
                        continue;
                    }
                    if let Some(performative) = one.acts.common(&other.acts) {
                        let problem = Problem::Ambiguous(Box::new(Ambiguity {
                            state: state.id.clone(),
                            performative,
                            from: one.from.text.clone(),
                            to: one.to.text.clone(),
                            target: machine.target(one).to_owned(),
                            other_target: machine.target(other).to_owned(),
                            other_line: self.line_of_step(index, other),
                        }));
                        self.wrong(self.line_of_step(index, one), problem);
                        // One per transition is enough: further ones have the same cause.
                        break;
                    }
                }
            }
        }
    }

    fn beginner(&mut self, machine: &Machine) -> Option<Role> {
        let line = self.line_of(machine.initial.index());
        let initial = machine.state(machine.initial)?;
        let mask = initial
            .steps
            .iter()
            .fold(RoleSet::NONE, |mask, step| mask | step.from.mask);
        if mask.iter().count() > 1 {
            let roles = (0..).map(Role::new).zip(&self.roles);
            let roles = roles.filter(|(number, _)| mask.contains(*number));
            let roles: Vec<&str> = roles.map(|(_, role)| role.as_str()).collect();
            self.wrong(line, Problem::Beginners(roles.join(", ")));
        }
        if machine.scope == Scope::Participant && self.roles.len() != 2 {
            let problem = Problem::RolesOfScope(self.roles.len(), self.roles.join(", "));
            self.wrong(self.document.line, problem);
        }
        Some(mask.iter().next().unwrap_or(Role::new(0)))
    }

    fn aliases(&mut self) -> Vec<String> {
        let aliases = self.document.aliases.as_deref().unwrap_or_default();
        aliases.split_whitespace().map(str::to_owned).collect()
    }

    fn scope(&mut self) -> Scope {
        match self.document.scope.as_deref() {
            None | Some("conversation") => Scope::Conversation,
            Some("participant") => Scope::Participant,
            Some(other) => {
                let line = self.document.line;
                self.value(line, "scope", other, "participant or conversation");
                Scope::Conversation
            }
        }
    }

    fn cancel(&mut self) -> Cancel {
        match self.document.cancel.as_deref() {
            None if self.document.extended => Cancel::Initiator,
            None | Some("anyone") => Cancel::Anyone,
            Some("initiator") => Cancel::Initiator,
            Some("nobody") => Cancel::Nobody,
            Some(other) => {
                let line = self.document.line;
                self.value(line, "cancel", other, "initiator, anyone or nobody");
                Cancel::Nobody
            }
        }
    }

    fn yes_or_no(&mut self, line: usize, attribute: &'static str, text: &str) -> bool {
        match text {
            "yes" | "true" | "1" => true,
            "no" | "false" | "0" => false,
            other => {
                self.value(line, attribute, other, "yes, true, 1, no, false or 0");
                false
            }
        }
    }

    fn state(&mut self, line: usize, id: &str) -> Option<StateId> {
        let known = self.ids.get(id).copied();
        if known.is_none() {
            let alike = |known: &&&str| known.eq_ignore_ascii_case(id) || one_edit_apart(known, id);
            let nearest = self.ids.keys().filter(alike).min();
            let problem = Problem::UnknownState {
                id: id.to_owned(),
                nearest: nearest.map(|id| (*id).to_owned()),
            };
            self.wrong(line, problem);
        }
        known
    }

    fn required(
        &mut self,
        line: usize,
        attribute: &'static str,
        value: &'d Option<String>,
    ) -> Option<&'d str> {
        let value = value.as_deref().filter(|value| !value.is_empty());
        if value.is_none() {
            let element = "transition";
            self.wrong(line, Problem::Missing { element, attribute });
        }
        value
    }

    fn no_pattern<T>(
        &mut self,
        line: usize,
        attribute: &'static str,
        text: &str,
        error: &PatternError,
    ) -> Option<T> {
        let problem = Problem::Pattern {
            attribute,
            value: text.to_owned(),
            reason: match error {
                PatternError::TooBig => "it is too large when compiled".to_owned(),
                // The last line of the error is the reason. The lines above show the position.
                other => other
                    .to_string()
                    .lines()
                    .last()
                    .unwrap_or_default()
                    .to_owned(),
            },
        };
        self.wrong(line, problem);
        None
    }

    fn value(&mut self, line: usize, attribute: &'static str, value: &str, expected: &'static str) {
        let problem = Problem::Value {
            attribute,
            value: value.to_owned(),
            expected,
        };
        self.wrong(line, problem);
    }

    fn line_of(&self, state: usize) -> usize {
        let state = self.document.states.get(state);
        state.map_or(self.document.line, |state| state.line)
    }

    /// Returns the line of a step: that of its transition or, if the step is from behind an optional
    /// transition, that of the state.
    fn line_of_step(&self, state: usize, step: &Transition) -> usize {
        let own = self.document.states.get(state).and_then(|state| {
            let mut messages = state.transitions.iter().filter(|one| one.after.is_none());
            messages.find(|one| {
                one.performative.as_deref() == Some(step.acts.text())
                    && one.from.as_deref() == Some(&step.from.text)
                    && self.ids.get(one.target.as_str()) == Some(&step.target)
            })
        });
        own.map_or(self.line_of(state), |transition| transition.line)
    }

    fn wrong(&mut self, line: usize, problem: Problem) {
        self.mistakes.push(Mistake { line, problem });
    }
}

/// Parses a span of at most a day.
fn duration(text: &str) -> Option<Duration> {
    const DAY: u64 = 24 * 60 * 60 * 1000;
    let digits = text.find(|c: char| !c.is_ascii_digit())?;
    let (number, unit) = text.split_at(digits);
    let factor = match unit {
        "ms" => 1,
        "s" => 1000,
        "min" => 60 * 1000,
        "h" => 60 * 60 * 1000,
        _ => return None,
    };
    let ms = number.parse::<u64>().ok()?.checked_mul(factor)?;
    (1..=DAY).contains(&ms).then_some(Duration::from_millis(ms))
}
