//! A reference implementation of the rules, written for correctness and not for speed. It shares only
//! the transitions of the files with the monitor. It keeps all messages and decides from them.

use std::collections::{HashMap, HashSet, VecDeque};

use fipa_monitor::{Cancel, Library, Machine, Scope, Transition};

mod talk;

use talk::{Spot, Step, Talk, View, is_answered, judge, state};
pub(crate) use talk::{matches, options};

/// The parameters of a message.
#[derive(Debug, Clone)]
pub(crate) struct Words {
    pub(crate) act: &'static str,
    pub(crate) from: &'static str,
    pub(crate) to: Vec<&'static str>,
    pub(crate) protocol: Option<String>,
    pub(crate) id: String,
    pub(crate) reply_with: Option<String>,
    pub(crate) in_reply_to: Option<String>,
    pub(crate) reply_to: Vec<&'static str>,
    /// The agent that did not get a message, if this is the report of a service.
    pub(crate) undelivered_to: Option<&'static str>,
    /// Milliseconds.
    pub(crate) reply_by: Option<u64>,
}

/// The verdict of the reference: the new state with opened, ended, complete, late; or the violation.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum ReferenceVerdict {
    Accepted(String, [bool; 4]),
    Violation(&'static str),
    Unchecked,
}

/// The machine of a conversation, its initiator and the agents that may continue in its place, and the
/// state of each participant.
pub(crate) type Overview<'l> = (&'l Machine, Vec<&'static str>, Vec<(&'static str, String)>);

pub(crate) struct Reference<'l> {
    library: &'l Library,
    agent: Option<&'static str>,
    /// Conversations by their identifiers, in the order of their beginnings.
    talks: HashMap<String, Vec<Conversation<'l>>>,
    /// Identifiers of conversations that the monitor does not know any more.
    removed: HashSet<String>,
    /// The last refused messages: identifier, sender, receiver.
    refused: VecDeque<(String, &'static str, &'static str)>,
}

#[derive(Clone)]
struct Conversation<'l> {
    machine: &'l Machine,
    initiator: &'static str,
    /// The monitored agent.
    agent: Option<&'static str>,
    /// One for each participant, or a single one without a name.
    talks: Vec<(&'static str, Talk)>,
    /// The state of the members of a multicast.
    multicast: Option<Talk>,
    roles: Vec<(String, &'static str)>,
    designated: Vec<&'static str>,
    /// Whether it began between other agents, which answer the monitored agent.
    joined: bool,
    /// Participants and the agents that continue in their places.
    delegates: Vec<(&'static str, &'static str)>,
    /// Whether it may have begun before the monitor.
    may_continue: bool,
    /// If so, other states to which the first message to a participant may have led.
    alternatives: Vec<(&'static str, String)>,
    /// Time of the last accepted message.
    touched: u64,
    /// Embedded conversations, the latest first.
    inner: Vec<Self>,
}

impl<'l> Reference<'l> {
    pub(crate) fn new(library: &'l Library, agent: Option<&'static str>) -> Self {
        Self {
            library,
            agent,
            talks: HashMap::new(),
            removed: HashSet::new(),
            refused: VecDeque::new(),
        }
    }

    pub(crate) fn forget(&mut self, id: &str) {
        self.talks.remove(id);
    }

    /// Returns the states of a conversation, to choose a message that fits.
    pub(crate) fn states(&self, id: &str) -> Option<Overview<'l>> {
        let conversation = self.talks.get(id)?.last()?;
        let talks = conversation.talks.iter();
        let states = talks.map(|(peer, talk)| (*peer, talk.name()));
        let designated = conversation.designated.iter().copied();
        let initiators = [conversation.initiator].into_iter().chain(designated);
        Some((conversation.machine, initiators.collect(), states.collect()))
    }

    pub(crate) fn check(&mut self, words: &Words, now: u64) -> ReferenceVerdict {
        let mut own = words.clone();
        own.to = Vec::new();
        own.undelivered_to = words.undelivered_to.filter(|_| words.act == "failure");
        for name in &words.to {
            if !own.to.contains(name) {
                own.to.push(name);
            }
        }
        // The agent is a member of the group that the message names.
        if let Some(agent) = self.agent
            && words.from != agent
            && !own.to.contains(&agent)
        {
            own.to = vec![agent];
        }
        let verdict = self.check_own(&own, now);
        if own.undelivered_to.is_some() && matches!(verdict, ReferenceVerdict::Violation(_)) {
            return ReferenceVerdict::Unchecked;
        }
        if !matches!(verdict, ReferenceVerdict::Violation(_)) {
            return verdict;
        }
        for name in &words.to {
            if words.act != "not-understood" {
                let key = (words.id.clone(), words.from, *name);
                self.refused.push_back(key);
                if self.refused.len() > 1_024 {
                    self.refused.pop_front();
                }
            }
        }
        if words.act == "not-understood" {
            let answered = |(id, from, to): &(String, &str, &str)| {
                *id == words.id && *to == words.from && words.to.contains(from)
            };
            if let Some(at) = self.refused.iter().position(answered) {
                self.refused.remove(at);
                return ReferenceVerdict::Unchecked;
            }
        }
        verdict
    }

    fn check_own(&mut self, words: &Words, now: u64) -> ReferenceVerdict {
        let library = self.library;
        let alike = self.talks.entry(words.id.clone()).or_default();
        let ranked = alike.iter().enumerate();
        let best = ranked
            .map(|(at, conversation)| {
                let rank = conversation.rank(words);
                let joined = rank == 0 && conversation.joined;
                (rank, joined, conversation.has_protocol(library, words), at)
            })
            .max();
        let at = match best {
            Some((2, .., at)) => Some(at),
            _ if words.undelivered_to.is_some() => return ReferenceVerdict::Unchecked,
            Some((.., at)) if !words.begins_in(library) => {
                Some(at).filter(|_| !self.removed.contains(&words.id))
            }
            Some((.., at)) => Some(at).filter(|at| !alike[*at].is_another(library, words)),
            None => None,
        };
        if let Some(at) = at {
            let conversation = &mut alike[at];
            let verdict = match conversation.check_any(library, words, now) {
                // It may have begun before the monitor.
                Err((_, true)) if !conversation.alternatives.is_empty() => {
                    alike.remove(at);
                    self.removed.insert(words.id.clone());
                    return ReferenceVerdict::Unchecked;
                }
                Err((wrong, _)) => ReferenceVerdict::Violation(wrong),
                Ok(verdict) => verdict,
            };
            return verdict;
        }
        let named = words.protocol.as_ref();
        let Some(machine) = named.and_then(|name| library.find(name)) else {
            return ReferenceVerdict::Unchecked;
        };
        if begins(machine, words.act) {
            let mut conversation = Conversation::new(machine, words.from, self.agent);
            if self.removed.contains(&words.id) {
                conversation.may_continue = may_repeat(machine, words.act);
            }
            evict_alike(alike, &mut self.removed, words, self.agent);
            return match conversation.check(words, now) {
                Ok(verdict) => {
                    alike.push(conversation);
                    verdict
                }
                Err(_) => ReferenceVerdict::Violation("not-opened"),
            };
        }
        if !may_follow(machine, words.act) {
            return ReferenceVerdict::Violation("not-opened");
        }
        match self.agent {
            Some(agent) if agent != words.from => {
                if shows_initiator(machine, words.act) {
                    evict_alike(alike, &mut self.removed, words, self.agent);
                    let joined = Conversation::joined(machine, agent, words, now);
                    alike.push(joined);
                } else {
                    self.removed.insert(words.id.clone());
                }
                ReferenceVerdict::Unchecked
            }
            _ if self.removed.contains(&words.id) => ReferenceVerdict::Unchecked,
            _ => ReferenceVerdict::Violation("not-opened"),
        }
    }
}

impl Words {
    /// Whether the message can begin its protocol.
    fn begins_in(&self, library: &Library) -> bool {
        let named = self.protocol.as_ref();
        let machine = named.and_then(|name| library.find(name));
        machine.is_some_and(|machine| begins(machine, self.act))
    }
}

/// Keeps at most eight conversations with one identifier.
fn evict_alike(
    alike: &mut Vec<Conversation<'_>>,
    removed: &mut HashSet<String>,
    words: &Words,
    agent: Option<&str>,
) {
    if alike.len() < 8 {
        return;
    }
    let mut of_peers = alike.iter().enumerate().filter(|(_, one)| {
        // Those that the monitored agent began stay.
        agent.is_none() || one.joined || Some(one.initiator) != agent
    });
    let first = of_peers.next().expect("an agent has fewer identifiers");
    let oldest = of_peers.fold(first, |oldest, other| {
        if other.1.touched < oldest.1.touched {
            other
        } else {
            oldest
        }
    });
    let at = oldest.0;
    removed.insert(words.id.clone());
    alike.remove(at);
}

/// Whether the performative may come after the first message.
fn may_follow(machine: &Machine, act: &str) -> bool {
    let initial = machine.initial().id();
    let all = || {
        let states = machine.states().iter();
        states.flat_map(|state| state.transitions())
    };
    let returns = all().any(|step| machine.target(step) == initial);
    let later = machine.states().iter().any(|state| {
        (returns || state.id() != initial)
            && (options(machine, state.id())
                .iter()
                .any(|step| matches(step.performative(), act))
                || embedded(machine, state.id())
                    .iter()
                    .any(|sub| sub.proxied_to().is_some()))
    });
    later
        || ["not-understood", "failure", "inform"].contains(&act)
        || act == "cancel" && machine.cancel() != Cancel::Nobody
}

/// The subprotocols of a state and those behind optional transitions.
fn embedded<'m>(machine: &'m Machine, id: &str) -> Vec<&'m fipa_monitor::Subprotocol> {
    let here = state(machine, id);
    let mut all: Vec<_> = here.subprotocols().iter().collect();
    for step in here.transitions().iter().filter(|step| step.is_optional()) {
        all.extend(embedded(machine, machine.target(step)));
    }
    all
}

/// The transition of a first message, and the later ones of messages like it.
fn first_and_later<'m>(machine: &'m Machine, act: &str) -> (&'m Transition, Vec<&'m Transition>) {
    let first = options(machine, machine.initial().id());
    let mut first = first.into_iter();
    let first = first.find(|step| matches(step.performative(), act));
    let first = first.expect("it begins the protocol");
    let overlap = |one: &str, other: &str| {
        let mut roles = machine.roles().iter();
        one == ".*" || other == ".*" || roles.any(|role| matches(one, role) && matches(other, role))
    };
    let states = machine.states().iter();
    let later = states.filter(|state| state.id() != machine.initial().id());
    let steps = later.flat_map(|state| state.transitions());
    let alike = steps
        .filter(|step| matches(step.performative(), act) && overlap(step.from(), first.from()));
    (first, alike.collect())
}

/// Whether a message like the first one may come later.
fn may_repeat(machine: &Machine, act: &str) -> bool {
    !first_and_later(machine, act).1.is_empty()
}

/// The states to which a message like the first one leads later.
fn later_targets(machine: &Machine, act: &str) -> Vec<String> {
    let (first, later) = first_and_later(machine, act);
    let targets = later.iter().map(|step| machine.target(step));
    let mut targets: Vec<String> = targets
        .filter(|target| *target != machine.target(first))
        .map(str::to_owned)
        .collect();
    targets.sort();
    targets.dedup();
    targets
}

fn begins(machine: &Machine, act: &str) -> bool {
    let first = options(machine, machine.initial().id());
    first.iter().any(|first| matches(first.performative(), act))
}

/// Whether the performative is an answer, and no message of the initiator.
fn shows_initiator(machine: &Machine, act: &str) -> bool {
    act == "not-understood" || is_answer(machine, act) && !is_sent_by_initiator(machine, act)
}

/// Whether the initiator sends the performative to another agent in any state.
fn is_sent_by_initiator(machine: &Machine, act: &str) -> bool {
    let states = machine.states().iter();
    let mut all = states.flat_map(|state| state.transitions());
    let initiator = machine.initiator();
    act == "cancel"
        || all.any(|step| {
            let mut others = machine.roles().iter().filter(|role| *role != initiator);
            matches(step.performative(), act)
                && matches(step.from(), initiator)
                && others.any(|role| matches(step.to(), role))
        })
}

/// Whether the performative is an answer in any state.
fn is_answer(machine: &Machine, act: &str) -> bool {
    let mut all = machine
        .states()
        .iter()
        .flat_map(|state| state.transitions());
    act == "not-understood" || all.any(|step| is_answered(machine, step, act))
}

impl<'l> Conversation<'l> {
    fn new(machine: &'l Machine, initiator: &'static str, agent: Option<&'static str>) -> Self {
        let mut talks = Vec::new();
        if machine.scope() == Scope::Conversation {
            talks.push(("", Talk::new(machine)));
        }
        Self {
            machine,
            initiator,
            agent,
            talks,
            multicast: None,
            roles: Vec::new(),
            designated: Vec::new(),
            joined: false,
            delegates: Vec::new(),
            may_continue: false,
            alternatives: Vec::new(),
            touched: 0,
            inner: Vec::new(),
        }
    }

    fn joined(machine: &'l Machine, agent: &'static str, words: &Words, now: u64) -> Self {
        let mut conversation = Self::new(machine, agent, Some(agent));
        conversation.joined = true;
        conversation.learn(words, now);
        conversation
    }

    /// 2 if the sender and a receiver take part, 1 if the sender does.
    fn rank(&self, words: &Words) -> u8 {
        let all = || std::iter::once(self).chain(&self.inner);
        let has = |one: &Self, name: &str| one.takes_part(name) || one.designated.contains(&name);
        let from = words.undelivered_to.unwrap_or(words.from);
        if !all().any(|one| one.multicast.is_some() || has(one, from)) {
            return 0;
        }
        let receives = |one: &Self| words.to.iter().any(|name| has(one, name));
        let linked = |one: &Self| {
            let multicast = one.multicast.is_some();
            if one.machine.scope() == Scope::Conversation {
                return (multicast || has(one, from)) && receives(one);
            }
            let leads = |name: &str| one.initiator == name || one.designated.contains(&name);
            let answers = |name: &str| multicast || one.place(name).is_some();
            leads(from) && words.to.iter().any(|name| answers(name))
                || answers(from) && words.to.iter().any(|name| leads(name))
        };
        let across = !self.inner.is_empty() && all().any(receives);
        1 + u8::from(all().any(linked) || across)
    }

    fn has_protocol(&self, library: &'l Library, words: &Words) -> bool {
        let Some(name) = &words.protocol else {
            return true;
        };
        let mut all = std::iter::once(self).chain(&self.inner);
        all.any(|one| one.machine.is_called(name) || one.may_begin(library, name, words.from))
    }

    /// Whether the message begins another conversation.
    fn is_another(&self, library: &'l Library, words: &Words) -> bool {
        let Some(name) = &words.protocol else {
            return false;
        };
        let Some(machine) = library.find(name) else {
            return false;
        };
        let leads = |one: &Self, main: bool| {
            !one.joined
                && (main && one.initiator == words.from || one.designated.contains(&words.from))
        };
        let held_back = leads(self, true)
            || self.inner.iter().any(|inner| leads(inner, false))
            || std::iter::once(self)
                .chain(&self.inner)
                .any(|one| one.may_begin(library, name, words.from));
        begins(machine, words.act) && !held_back
    }

    fn place(&self, name: &str) -> Option<usize> {
        place(&self.talks, name).or_else(|| {
            let mut delegates = self.delegates.iter();
            let (peer, _) = delegates.find(|(_, delegate)| *delegate == name)?;
            place(&self.talks, peer)
        })
    }

    fn learn(&mut self, words: &Words, now: u64) {
        self.touched = now;
        let talk = Talk::joined(self.machine, words, self.joined);
        let peer = match self.machine.scope() {
            Scope::Participant => match self.place(words.from) {
                Some(at) => self.talks[at].0,
                None => words.from,
            },
            _ => "",
        };
        match self.talks.iter_mut().find(|(known, _)| *known == peer) {
            Some(known) => known.1 = talk,
            None => self.talks.push((peer, talk)),
        }
    }

    /// Whether the conversation may have messages that the monitored agent does not receive.
    fn may_continue_elsewhere(&self) -> bool {
        self.joined || !self.designated.is_empty() && self.agent == Some(self.initiator)
    }

    /// Reconsiders a violation in a conversation that began between other agents.
    fn elsewhere(
        &mut self,
        words: &Words,
        wrong: &'static str,
        now: u64,
    ) -> Result<ReferenceVerdict, &'static str> {
        let machine = self.machine;
        let asked = self.may_continue_elsewhere() && self.takes_part(words.from);
        let excused = if !self.joined && (!asked || ["repeated", "wrong-receiver"].contains(&wrong))
        {
            false
        } else if self.agent == Some(words.from) {
            let mut unknown = self.talks.iter().filter(|(_, talk)| talk.is_unknown());
            unknown.any(|(peer, _)| peer.is_empty() || words.to.contains(peer))
                && (words.act == "not-understood" || is_sent_by_initiator(machine, words.act))
        } else if is_answer(machine, words.act) {
            self.learn(words, now);
            true
        } else {
            let cancels = machine.cancel() != Cancel::Nobody;
            self.joined
                && (begins(machine, words.act)
                    || cancels && ["inform", "failure"].contains(&words.act))
        };
        if excused {
            Ok(ReferenceVerdict::Unchecked)
        } else {
            Err(wrong)
        }
    }

    /// Checks a message of this conversation, or of an embedded one.
    fn check_any(
        &mut self,
        library: &'l Library,
        words: &Words,
        now: u64,
    ) -> Result<ReferenceVerdict, (&'static str, bool)> {
        let name = match &words.protocol {
            Some(name) if !self.machine.is_called(name) && !self.is_canceled(library, words) => {
                name.clone()
            }
            _ => {
                let verdict = self.check(words, now);
                let verdict = verdict.or_else(|wrong| match words.undelivered_to {
                    Some(_) => Ok(ReferenceVerdict::Unchecked),
                    None => self.elsewhere(words, wrong, now),
                });
                return verdict.map_err(|wrong| (wrong, true));
            }
        };
        let verdict = self.check_inner(library, &name, words, now);
        if matches!(&verdict, Ok(ReferenceVerdict::Accepted(..))) {
            self.touched = now;
        }
        verdict.map_err(|wrong| (wrong, false))
    }

    /// Whether a message of the cancel protocol belongs to this conversation, which has another one.
    fn is_canceled(&self, library: &Library, words: &Words) -> bool {
        let Some(name) = &words.protocol else {
            return false;
        };
        let all = || std::iter::once(self).chain(&self.inner);
        ["cancel", "inform", "failure", "not-understood"].contains(&words.act)
            && library
                .find(name)
                .is_some_and(|it| it.name() == "fipa-cancel")
            && !all().any(|it| it.may_begin(library, name, words.from))
            && !self.inner.iter().any(|it| it.machine.is_called(name))
    }

    fn check_inner(
        &mut self,
        library: &'l Library,
        name: &str,
        words: &Words,
        now: u64,
    ) -> Result<ReferenceVerdict, &'static str> {
        let may_begin = self.may_begin(library, name, words.from)
            || self
                .inner
                .iter()
                .any(|inner| inner.may_begin(library, name, words.from));
        let (mut first_wrong, mut open) = (None, None);
        for (at, inner) in self.inner.iter_mut().enumerate() {
            if inner.machine.is_called(name) {
                match inner.check(words, now) {
                    Ok(verdict) => return Ok(verdict),
                    Err(wrong) if inner.may_continue_elsewhere() => open = Some((at, wrong)),
                    Err(wrong) => first_wrong = first_wrong.or(Some(wrong)),
                }
            }
        }
        if !may_begin {
            if let Some(wrong) = first_wrong {
                return Err(wrong);
            }
            if let Some((at, wrong)) = open {
                let verdict = self.inner[at].elsewhere(words, wrong, now);
                self.touched = self.touched.max(self.inner[at].touched);
                return verdict;
            }
            if let Some(agent) = self.agent
                && !self.takes_part(words.from)
                && self.others_may_begin(library, name, agent)
            {
                let machine = library.find(name).filter(|_| words.from != agent);
                let machine = machine.filter(|machine| shows_initiator(machine, words.act));
                if let Some(machine) = machine.filter(|_| self.inner.len() < 64) {
                    let joined = Conversation::joined(machine, agent, words, now);
                    self.touched = now;
                    self.inner.insert(0, joined);
                }
                return Ok(ReferenceVerdict::Unchecked);
            }
            if self.joined {
                return Ok(ReferenceVerdict::Unchecked);
            }
            return Err("wrong-protocol");
        }
        let Some(machine) = library.find(name) else {
            return Ok(ReferenceVerdict::Unchecked);
        };
        if self.inner.len() == 64 {
            return Err("too-many");
        }
        let mut inner = Conversation::new(machine, words.from, self.agent);
        // The report of a service begins no conversation.
        let verdict = Some(()).filter(|()| begins(machine, words.act));
        let verdict = verdict.and_then(|()| inner.check(words, now).ok());
        let verdict = verdict.ok_or(first_wrong.unwrap_or("not-opened"))?;
        self.inner.insert(0, inner);
        Ok(verdict)
    }

    fn may_begin(&self, library: &Library, name: &str, from: &str) -> bool {
        self.is_begun(library, name, |peer| {
            let machine = self.machine;
            match machine.scope() {
                Scope::Participant if from == self.initiator => vec![machine.initiator()],
                Scope::Participant if from == peer => self.roles_but(&[machine.initiator()]),
                Scope::Participant => Vec::new(),
                _ => self.roles_of(from),
            }
        })
    }

    /// Whether it can have begun without a message to the monitored agent.
    fn others_may_begin(&self, library: &Library, name: &str, agent: &str) -> bool {
        let machine = self.machine;
        self.is_begun(library, name, |peer| match machine.scope() {
            Scope::Participant if agent == self.initiator => self.roles_but(&[machine.initiator()]),
            Scope::Participant if agent == peer => vec![machine.initiator()],
            Scope::Participant => self.roles_but(&[]),
            _ => self.roles_but(&self.roles_of(agent)),
        })
    }

    fn roles_of(&self, agent: &str) -> Vec<&str> {
        let held = self.roles.iter().filter(|(_, other)| *other == agent);
        held.map(|(role, _)| role.as_str()).collect()
    }

    fn roles_but(&self, held: &[&str]) -> Vec<&str> {
        let roles = self.machine.roles().iter().map(String::as_str);
        roles.filter(|role| !held.contains(role)).collect()
    }

    fn takes_part(&self, agent: &str) -> bool {
        agent == self.initiator
            || self.place(agent).is_some()
            || self.roles.iter().any(|(_, bound)| *bound == agent)
    }

    /// Whether agents with these roles may begin such an embedded conversation.
    fn is_begun<'s>(
        &'s self,
        library: &Library,
        name: &str,
        by: impl Fn(&str) -> Vec<&'s str>,
    ) -> bool {
        let names: Vec<&str> = match library.find(name) {
            Some(inner) => {
                let aliases = inner.aliases().iter().map(String::as_str);
                aliases.chain([inner.name()]).collect()
            }
            None => vec![name],
        };
        self.talks.iter().any(|(peer, talk)| {
            let Spot::At(id) = &talk.spot else {
                return false;
            };
            let roles = by(peer);
            let mut embedded = state(self.machine, id).subprotocols().iter();
            embedded.any(|sub| {
                roles.iter().any(|role| matches(sub.from(), role))
                    && names.iter().any(|name| matches(sub.name(), name))
            })
        })
    }
}

/// Among the states that a talk may be in: each of them.
const ANY_STATE: &str = "*";

fn place(talks: &[(&'static str, Talk)], name: &str) -> Option<usize> {
    talks.iter().position(|(peer, _)| *peer == name)
}

impl Conversation<'_> {
    fn check(&mut self, words: &Words, now: u64) -> Result<ReferenceVerdict, &'static str> {
        for (_, talk) in &mut self.talks {
            talk.expire(self.machine, now);
        }
        let before = self.clone();
        let verdict = match self.machine.scope() {
            Scope::Participant => self.check_per_participant(words, now),
            _ => self.check_per_conversation(words, now),
        }?;
        self.touched = now;
        if self.may_continue && matches!(&verdict, ReferenceVerdict::Accepted(..)) {
            self.keep_alternatives(words, &before);
        }
        Ok(verdict)
    }

    /// Returns the numbers of messages to the participants; `*` is a multicast.
    fn lengths(&self) -> HashMap<&'static str, usize> {
        let talks = self.talks.iter().map(|(peer, talk)| (*peer, talk));
        let talks = talks.chain(self.multicast.iter().map(|talk| ("*", talk)));
        let began = |(_, talk): &(&str, &Talk)| {
            self.machine.scope() == Scope::Participant || !talk.said.is_empty()
        };
        talks
            .filter(began)
            .map(|(peer, talk)| (peer, talk.said.len()))
            .collect()
    }

    fn keep_alternatives(&mut self, words: &Words, before: &Self) {
        let machine = self.machine;
        // The state before a failed message is unknown.
        let talks = self.talks.iter().filter(|(peer, talk)| {
            let before = place(&before.talks, peer).map_or(0, |at| before.talks[at].1.failures);
            talk.failures > before
        });
        let failed: Vec<&str> = talks.map(|(peer, _)| *peer).collect();
        let (before, after) = (before.lengths(), self.lengths());
        let known = std::mem::take(&mut self.alternatives).into_iter();
        let kept = known.filter_map(|(peer, id)| {
            let is_kept = id == ANY_STATE || failed.contains(&peer);
            if is_kept || before.get(peer) == after.get(peer) {
                return Some((peer, id));
            }
            let all = options(machine, &id);
            let step = all
                .iter()
                .find(|step| matches(step.performative(), words.act))?;
            Some((peer, machine.target(step).to_owned()))
        });
        self.alternatives = kept.collect();
        let failed = failed.iter().map(|peer| (*peer, ANY_STATE.to_owned()));
        self.alternatives.extend(failed);
        if begins(machine, words.act) {
            let new = after.keys().filter(|peer| !before.contains_key(*peer));
            for peer in new {
                let others = later_targets(machine, words.act).into_iter();
                self.alternatives.extend(others.map(|id| (*peer, id)));
            }
        }
    }

    fn view<'w>(&self, words: &'w Words, by_initiator: bool) -> View<'w> {
        let begins = self.machine.initiator();
        let (one, other): (Vec<String>, Vec<String>) = self
            .machine
            .roles()
            .iter()
            .cloned()
            .partition(|role| role == begins);
        let (from, to) = if by_initiator {
            (one, other)
        } else {
            (other, one)
        };
        View {
            words,
            by_initiator,
            from,
            to,
            known: true,
            compares: true,
            own: self.agent == Some(words.from),
        }
    }

    fn check_per_participant(
        &mut self,
        words: &Words,
        now: u64,
    ) -> Result<ReferenceVerdict, &'static str> {
        let designated = self.designated.contains(&words.from);
        if words.from == self.initiator {
            self.check_initiator(words, now)
        } else if self.place(words.from).is_some()
            || self.multicast.is_some() && words.undelivered_to.is_none()
        {
            match self.check_participant(words, now) {
                // The other of the two parts of the sender may fit.
                Err(wrong) if designated => {
                    self.check_initiator(words, now)
                        .map_err(|other| match wrong {
                            "wrong-receiver" => other,
                            wrong => wrong,
                        })
                }
                verdict => verdict,
            }
        } else if designated {
            self.check_initiator(words, now)
        } else {
            self.reported_from_outside(words)
        }
    }

    fn check_participant(
        &mut self,
        words: &Words,
        now: u64,
    ) -> Result<ReferenceVerdict, &'static str> {
        let machine = self.machine;
        let known = self.place(words.from);
        let talk = match (known, &self.multicast) {
            (Some(at), _) => self.talks[at].1.clone(),
            (None, Some(talk)) => talk.clone(),
            (None, None) => return Err("stranger"),
        };
        let addressed = |name: &&str| *name != self.initiator && !self.designated.contains(name);
        if words.to.iter().any(addressed) {
            return Err("wrong-receiver");
        }
        let mut step = judge(machine, &talk, &self.view(words, false))?;
        // It may answer a cancel of before the monitored agent joined.
        if self.joined
            && machine.cancel() != Cancel::Nobody
            && ["inform", "failure"].contains(&words.act)
            && matches!(step.spot, Spot::At(_))
            && !step.void
            && !step.answers_cancel
            && talk.last_of(true).is_none()
        {
            step = talk::to(Spot::Elsewhere);
        }
        // Also for a member of a pattern that has not answered before.
        let peer = known.map_or(words.from, |at| self.talks[at].0);
        self.guards(&[(peer, &step)], words, false)?;
        let at = known.unwrap_or_else(|| {
            self.talks.push((words.from, talk));
            self.talks.len() - 1
        });
        let (opened, late) = self.talks[at].1.go(machine, words, false, step, now);
        self.delegate(words, self.talks[at].0);
        Ok(self.verdict(Some(at), opened || known.is_none(), late))
    }

    /// Checks a message of the initiator, or of an agent that continues in its place and cannot add
    /// participants.
    fn check_initiator(
        &mut self,
        words: &Words,
        now: u64,
    ) -> Result<ReferenceVerdict, &'static str> {
        let machine = self.machine;
        let brings_in = words.from == self.initiator && !self.joined;
        // All receivers or none.
        let mut steps: Vec<(&'static str, bool, Step)> = Vec::new();
        let witness = self
            .agent
            .filter(|agent| words.to.contains(agent) && words.from != *agent);
        for name in &words.to {
            // The states with the other receivers are unknown.
            if witness.is_some_and(|agent| agent != *name && !name.contains('*')) {
                continue;
            }
            let place = self.place(name);
            let peer = place.map_or(*name, |at| self.talks[at].0);
            let talk = match place {
                Some(at) => self.talks[at].1.clone(),
                None if name.contains('*') && self.multicast.is_some() => {
                    self.multicast.clone().expect("there is one")
                }
                None if brings_in => Talk::new(machine),
                None => return Err("wrong-receiver"),
            };
            let mut side = true;
            let mut step = judge(machine, &talk, &self.view(words, true));
            if step.is_err()
                && *name == words.from
                && let Ok(other) = judge(machine, &talk, &self.view(words, false))
            {
                (side, step) = (false, Ok(other));
            }
            if !steps.iter().any(|(known, ..)| *known == peer) {
                steps.push((peer, side, step?));
            } else {
                step?;
            }
        }
        let led: Vec<(&str, &Step)> = steps.iter().map(|(name, _, step)| (*name, step)).collect();
        self.guards(&led, words, steps.first().is_none_or(|(_, side, _)| *side))?;
        let (mut opened, mut late, mut first) = (false, false, None);
        // A continuing agent may only have sent to itself, as a participant.
        let speaks = words.from == self.initiator || steps.iter().any(|(_, side, _)| *side);
        for (name, side, step) in steps {
            let known = place(&self.talks, name);
            if known.is_none() && name.contains('*') {
                opened |= self.multicast.is_none();
                let talk = self.multicast.get_or_insert_with(|| Talk::new(machine));
                let (began, was_late) = talk.go(machine, words, side, step, now);
                (opened, late) = (opened | began, late | was_late);
                first = first.or(Some(talk.name()));
                continue;
            }
            let at = known.unwrap_or_else(|| {
                opened = true;
                self.talks.push((name, Talk::new(machine)));
                self.talks.len() - 1
            });
            let (began, was_late) = self.talks[at].1.go(machine, words, side, step, now);
            (opened, late) = (opened | began, late | was_late);
            first = first.or(Some(self.talks[at].1.name()));
        }
        if speaks {
            self.designate(words);
        } else {
            self.delegate(words, words.from);
        }
        Ok(self.verdict_in(first, opened, late))
    }

    /// Adds the agents that a participant names in `reply-to`.
    fn delegate(&mut self, words: &Words, peer: &'static str) {
        for name in &words.reply_to {
            if *name != self.initiator && self.place(name).is_none() {
                self.delegates.push((peer, name));
            }
        }
    }

    /// Checks the rules about all participants.
    fn guards(
        &self,
        steps: &[(&str, &Step)],
        words: &Words,
        by_initiator: bool,
    ) -> Result<(), &'static str> {
        let guarded = steps.iter().find(|(_, step)| step.guard != (None, false));
        let Some((_, Step { spot, guard, .. })) = guarded else {
            return Ok(());
        };
        if self.joined || !self.designated.is_empty() {
            return Ok(());
        }
        let moved = |peer: &str| steps.iter().any(|(name, _)| *name == peer);
        let others = || self.talks.iter().filter(|(peer, _)| !moved(peer));
        let there = others().filter(|(_, talk)| talk.spot == *spot).count();
        let reach = steps.iter().filter(|(_, step)| step.spot == *spot).count();
        if guard
            .0
            .is_some_and(|most| there + reach > usize::from(most))
        {
            return Err("guard");
        }
        let view = self.view(words, by_initiator);
        let ready = |talk: &Talk| match &talk.spot {
            Spot::At(id) => {
                let all = options(self.machine, id);
                let step = all.iter().find(|step| view.fits(step));
                talk.spot == *spot || step.is_some_and(|step| step.needs_all())
            }
            _ => true,
        };
        if guard.1 && !others().all(|(_, talk)| ready(talk)) {
            return Err("guard");
        }
        Ok(())
    }

    fn designate(&mut self, words: &Words) {
        for name in &words.reply_to {
            if *name != self.initiator && !self.designated.contains(name) {
                self.designated.push(name);
            }
        }
    }

    /// Checks a message of an outside agent: the report of a message transport service, or a violation.
    fn reported_from_outside(&mut self, words: &Words) -> Result<ReferenceVerdict, &'static str> {
        let takes_part = |name: &str| {
            name == self.initiator || self.designated.contains(&name) || self.place(name).is_some()
        };
        let Some(lost) = words.undelivered_to else {
            return Err("stranger");
        };
        if !words.to.iter().all(|name| takes_part(name)) {
            return Err("stranger");
        }
        let lost_place = self.place(lost);
        let leads = lost == self.initiator || self.designated.contains(&lost);
        let (mut first, mut failed) = (None, Vec::new());
        let before: Vec<(&str, Talk)> = self.talks.clone();
        for name in &words.to {
            let concerned: Vec<(usize, bool)> = (0..before.len())
                .filter_map(|at| {
                    let (peer, talk) = &before[at];
                    let side = if *name == self.initiator {
                        true
                    } else if peer == name {
                        false
                    } else if self.designated.contains(name) {
                        true
                    } else {
                        return None;
                    };
                    let asked = talk.last_of(side).and_then(|said| said.reply_with.clone());
                    let answers = words.in_reply_to.is_none()
                        || asked.is_none()
                        || asked == words.in_reply_to;
                    let reached = if side { lost_place == Some(at) } else { leads };
                    (reached && talk.may_have_last(side) && answers).then_some((at, side))
                })
                .collect();
            if let [(only, side)] = concerned[..] {
                // A receiver that is named twice gets the message once.
                let talk = &mut self.talks[only].1;
                if !failed.contains(&only) {
                    talk.fail(side);
                    failed.push(only);
                }
                first = first.or(Some(talk.name()));
            }
        }
        Ok(self.verdict_in(first, false, false))
    }

    fn check_per_conversation(
        &mut self,
        words: &Words,
        now: u64,
    ) -> Result<ReferenceVerdict, &'static str> {
        let machine = self.machine;
        let free: Vec<String> = machine
            .roles()
            .iter()
            .filter(|role| !self.roles.iter().any(|(bound, _)| bound == *role))
            .cloned()
            .collect();
        let held = |name: &str| {
            let held = self.roles.iter().filter(|(_, agent)| *agent == name);
            let mut held: Vec<String> = held.map(|(role, _)| role.clone()).collect();
            if self.designated.contains(&name) {
                held.push(machine.initiator().to_owned());
            }
            held
        };
        let may = |name: &str| [held(name), free.clone()].concat();
        let mut to_roles = machine.roles().to_vec();
        for name in &words.to {
            to_roles.retain(|role| may(name).contains(role));
        }
        let has_part = self.roles.iter().any(|(_, agent)| *agent == words.from);
        let goes_on = self.designated.contains(&words.from) && !has_part;
        let by_initiator = words.from == self.initiator || goes_on;
        let knows = |name: &str| !held(name).is_empty();
        let unknown = |name: &str| may(name).is_empty();
        if let Some(lost) = words.undelivered_to
            && held(words.from).is_empty()
        {
            if words.to.iter().any(|name| may(name).is_empty()) {
                return Err("stranger");
            }
            if !held(lost).is_empty() {
                let receiver = words.to[0];
                let has_part = self.roles.iter().any(|(_, agent)| *agent == receiver);
                let goes_on = self.designated.contains(&receiver) && !has_part;
                self.talks[0].1.fail(receiver == self.initiator || goes_on);
            }
            return Ok(self.verdict(Some(0), false, false));
        }
        let view = View {
            from: may(words.from),
            to: to_roles,
            known: knows(words.from) && words.to.iter().all(|name| knows(name)),
            compares: self.roles.len() == 2,
            ..self.view(words, by_initiator)
        };
        let strange = words.to.iter().any(|name| unknown(name));
        let step = match judge(machine, &self.talks[0].1, &view) {
            Ok(step) => step,
            Err(_) if unknown(words.from) => return Err("stranger"),
            Err("unexpected" | "out-of-order") if strange => return Err("wrong-receiver"),
            Err(wrong) => return Err(wrong),
        };
        let mut give = Vec::new();
        if let Some((from, to)) = &step.roles {
            let single = |pattern: &str| {
                let mut fit = machine.roles().iter().filter(|role| matches(pattern, role));
                match (fit.next(), fit.next()) {
                    (Some(role), None) if pattern != ".*" && free.contains(role) => {
                        Some(role.clone())
                    }
                    _ => None,
                }
            };
            give.extend(single(from).map(|role| (role, words.from)));
            if let Some(role) = single(to) {
                give.extend(words.to.iter().map(|name| (role.clone(), *name)));
            }
        }
        self.roles.extend(give);
        let by_initiator = view.by_initiator;
        let (opened, late) = self.talks[0].1.go(machine, words, by_initiator, step, now);
        if by_initiator {
            self.designate(words);
        } else {
            let held: Vec<String> = self
                .roles
                .iter()
                .filter(|(_, agent)| *agent == words.from)
                .map(|(role, _)| role.clone())
                .collect();
            for name in &words.reply_to {
                for role in &held {
                    if !self.roles.contains(&(role.clone(), *name)) {
                        self.roles.push((role.clone(), *name));
                    }
                }
            }
        }
        Ok(self.verdict(Some(0), opened, late))
    }

    fn verdict(&self, at: Option<usize>, opened: bool, late: bool) -> ReferenceVerdict {
        self.verdict_in(at.map(|at| self.talks[at].1.name()), opened, late)
    }

    fn verdict_in(&self, name: Option<String>, opened: bool, late: bool) -> ReferenceVerdict {
        let machine = self.machine;
        let first = || self.talks.first().map(|(_, talk)| talk.name());
        let name = name
            .or_else(first)
            .unwrap_or_else(|| machine.initial().id().to_owned());
        let ended = match name.as_str() {
            "not-understood" | "cancelled" | "undelivered" => true,
            "cancelling" | "elsewhere" => false,
            own => state(machine, own).is_final(),
        };
        let complete =
            self.multicast.is_none() && self.talks.iter().all(|(_, talk)| talk.has_ended(machine));
        ReferenceVerdict::Accepted(name, [opened, ended, complete, late])
    }
}
