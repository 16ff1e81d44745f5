//! Counts the observed letters per agent and per host. No I/O and no clock.
//!
//! All tables are bounded: a process of the domain can invent any number of names. Letters of further agents are
//! counted together.

use std::collections::{HashMap, HashSet};
use std::time::{Duration, Instant};

use fipa::Outcome;
use fipa::admin::watch::{Fate, Passage};

use super::window::{Counter, Counts, Slots};

/// Maximum number of agents that are counted on their own.
pub(super) const MAX_AGENTS: usize = 1000;
/// Maximum number of hosts that are counted on their own.
pub(super) const MAX_HOSTS: usize = 256;
/// Maximum number of letters without an outcome that are remembered.
const MAX_OPEN: usize = 65_536;
/// Time after which an agent is removed that is not registered and exchanges no letters.
const KEPT: Duration = Duration::from_secs(60);

/// A letter, and the host of the agent at its other end if that is not this host.
#[derive(Debug)]
pub(super) struct Observed<'a> {
    pub(super) passage: &'a Passage,
    pub(super) host: Option<&'a str>,
}

/// The counters of all letters.
#[derive(Debug)]
pub(super) struct Meter {
    slots: Slots,
    all: Counter,
    agents: HashMap<String, Counter>,
    /// The letters of agents beyond [`MAX_AGENTS`]; `None` until there are any.
    others: Option<Counter>,
    hosts: HashMap<String, Counter>,
    /// The registered agents of this host.
    registered: HashSet<String>,
    /// The numbers of the letters that the receiver does not have yet.
    open: HashSet<u64>,
    /// Time of the last removal of idle agents for lack of room.
    cleaned: Option<Instant>,
    lost: u64,
}

impl Meter {
    /// Begins now. Rates and percentiles cover a window of this length.
    pub(super) fn new(now: Instant, window: Duration) -> Self {
        Self {
            slots: Slots::new(now, window),
            all: Counter::new(now),
            agents: HashMap::new(),
            others: None,
            hosts: HashMap::new(),
            registered: HashSet::new(),
            open: HashSet::new(),
            cleaned: None,
            lost: 0,
        }
    }

    /// Handles a new letter.
    pub(super) fn letter(&mut self, now: Instant, observed: &Observed<'_>, violates: bool) {
        let passage = observed.passage;
        let sent = Counts {
            sent: 1,
            violations: u64::from(violates),
            ..Counts::default()
        };
        self.add_for_sender(now, observed, sent);
        if has_arrived(passage) {
            self.arrive(now, observed);
        } else if self.open.len() < MAX_OPEN {
            self.open.insert(passage.number);
        }
        if passage.from_elsewhere
            && let Some(via) = passage.via
        {
            self.carry(now, observed, via);
        }
        self.outcome(now, observed);
    }

    /// Handles news of a letter.
    pub(super) fn later(&mut self, now: Instant, observed: &Observed<'_>) {
        let passage = observed.passage;
        let is_final = matches!(passage.fate, Fate::Settled(_));
        if has_arrived(passage) {
            if self.open.remove(&passage.number) {
                self.arrive(now, observed);
            }
        } else if is_final {
            self.open.remove(&passage.number);
        }
        self.outcome(now, observed);
    }

    /// Handles the loss of records.
    pub(super) fn lose(&mut self, records: u64) {
        self.lost = self.lost.saturating_add(records);
    }

    /// Takes the registered agents of this host, and removes the others that are idle.
    pub(super) fn register<'a>(&mut self, now: Instant, agents: impl Iterator<Item = &'a str>) {
        self.registered = agents.take(MAX_AGENTS).map(str::to_owned).collect();
        let registered = &self.registered;
        self.agents
            .retain(|name, counter| registered.contains(name) || counter.idle(now) < KEPT);
        for name in &self.registered {
            if self.agents.len() >= MAX_AGENTS {
                break;
            }
            if !self.agents.contains_key(name) {
                self.agents.insert(name.clone(), Counter::new(now));
            }
        }
    }

    fn arrive(&mut self, now: Instant, observed: &Observed<'_>) {
        let received = Counts {
            received: 1,
            ..Counts::default()
        };
        let slots = self.slots;
        self.all.add(now, slots, received);
        let passage = observed.passage;
        self.agent(now, &passage.receiver).add(now, slots, received);
        if !passage.from_elsewhere
            && let Some(host) = observed.host.and_then(|host| self.host(now, host))
        {
            host.add(now, slots, received);
        }
    }

    /// Counts the outcome that the sender got. A letter has one.
    fn outcome(&mut self, now: Instant, observed: &Observed<'_>) {
        let (passage, slots) = (observed.passage, self.slots);
        let outcome = match &passage.fate {
            Fate::Settled(outcome) => outcome,
            // The sender is on another host, which sends no records.
            Fate::Passed(outcome) if passage.from_elsewhere && !outcome.is_success() => outcome,
            _ => return,
        };
        if let Outcome::Failed { .. } = outcome {
            let failed = Counts {
                failed: 1,
                ..Counts::default()
            };
            return self.add_for_sender(now, observed, failed);
        }
        if let Some(via) = outcome.via() {
            self.carry(now, observed, via);
        }
        if let Some(time) = passage.delivery_time() {
            self.all.time(now, time);
            if let Some(sender) = agent_of(passage) {
                self.agent(now, sender).time(now, time);
            }
            if let Some(host) = observed.host.and_then(|host| self.host(now, host)) {
                host.time(now, time);
                host.add(now, slots, Counts::default());
            }
        }
    }

    fn add_for_sender(&mut self, now: Instant, observed: &Observed<'_>, counts: Counts) {
        let slots = self.slots;
        self.all.add(now, slots, counts);
        if let Some(sender) = agent_of(observed.passage) {
            self.agent(now, sender).add(now, slots, counts);
        }
        if let Some(host) = observed.host.and_then(|host| self.host(now, host)) {
            // A host sends the letters of its agents, and receives those to its agents.
            let of_host = Counts {
                sent: counts.sent * u64::from(observed.passage.from_elsewhere),
                ..counts
            };
            host.add(now, slots, of_host);
        }
    }

    fn carry(&mut self, now: Instant, observed: &Observed<'_>, via: fipa::Kind) {
        let (passage, slots) = (observed.passage, self.slots);
        if let Some(sender) = agent_of(passage) {
            self.agent(now, sender).carry(now, slots, via);
        }
        self.agent(now, &passage.receiver).carry(now, slots, via);
        if let Some(host) = observed.host.and_then(|host| self.host(now, host)) {
            host.carry(now, slots, via);
        }
    }

    /// The counter of this agent, or that of all agents without room.
    fn agent(&mut self, now: Instant, name: &str) -> &mut Counter {
        let is_full = self.agents.len() >= MAX_AGENTS;
        if is_full && !self.agents.contains_key(name) {
            self.clean(now);
        }
        let has_room = self.agents.len() < MAX_AGENTS;
        if has_room && !self.agents.contains_key(name) {
            self.agents.insert(name.to_owned(), Counter::new(now));
        }
        match self.agents.get_mut(name) {
            Some(counter) => counter,
            None => self.others.get_or_insert_with(|| Counter::new(now)),
        }
    }

    /// Makes room: removes the agents that are not registered and idle. Does so once per window, because it takes
    /// time for each agent.
    fn clean(&mut self, now: Instant) {
        let window = self.slots.window();
        let is_recent = |at: Instant| now.saturating_duration_since(at) < window;
        if self.cleaned.is_some_and(is_recent) {
            return;
        }
        self.cleaned = Some(now);
        let registered = &self.registered;
        self.agents
            .retain(|name, counter| registered.contains(name) || counter.idle(now) <= window);
    }

    fn host(&mut self, now: Instant, name: &str) -> Option<&mut Counter> {
        if self.hosts.len() < MAX_HOSTS && !self.hosts.contains_key(name) {
            self.hosts.insert(name.to_owned(), Counter::new(now));
        }
        self.hosts.get_mut(name)
    }

    pub(super) fn slots(&self) -> Slots {
        self.slots
    }

    pub(super) fn all(&self) -> &Counter {
        &self.all
    }

    pub(super) fn agents(&self) -> impl Iterator<Item = (&str, &Counter)> {
        self.agents.iter().map(|(name, it)| (name.as_str(), it))
    }

    pub(super) fn others(&self) -> Option<&Counter> {
        self.others.as_ref()
    }

    pub(super) fn of_host(&self, name: &str) -> Option<&Counter> {
        self.hosts.get(name)
    }

    pub(super) fn lost(&self) -> u64 {
        self.lost
    }
}

/// The agent that sends the letter; `None` if a message transport service does, to report a failure.
fn agent_of(passage: &Passage) -> Option<&str> {
    passage.sender().filter(|_| !passage.from_service)
}

/// Whether the receiver, or a peer that cannot confirm, has the letter.
fn has_arrived(passage: &Passage) -> bool {
    match &passage.fate {
        Fate::UnderWay => false,
        Fate::Taken => true,
        Fate::Settled(outcome) => outcome.is_success(),
        Fate::Passed(outcome) => passage.from_elsewhere && outcome.is_success(),
    }
}

#[cfg(test)]
pub(super) mod tests;
