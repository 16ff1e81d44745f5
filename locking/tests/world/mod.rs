//! Agents, a network and clocks, all virtual.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use fastrand::Rng;
use fipa_locking::invariants::{History, Turns, all_or_none};
use fipa_locking::{
    Act, Action, Algorithm, AnyAlgorithm, ClaimId, Content, Event, LockDialect, LockMessage,
    LockPeer, Locks, Millis, Options, OwnerState, Resource,
};

use crate::protocols::Checked;

const LEASE: Millis = 400;
/// Time after which the faults end.
const FAULTS_END: Millis = 20_000;
/// Time after which every claim has ended.
const END: Millis = 200_000;

#[derive(Clone, Copy)]
pub(crate) struct Setup {
    pub(crate) kind: Algorithm,
    pub(crate) agents: usize,
    /// Resource `n` belongs to agent `n`.
    pub(crate) resources: usize,
    pub(crate) faults: bool,
    /// Whether the only faults are agents that are killed and return.
    pub(crate) kills_only: bool,
    /// Whether monitors check all messages. Then messages keep their order, and none is repeated by the network.
    pub(crate) checked: bool,
    /// Claims of each agent.
    pub(crate) claims: u64,
}

pub(crate) struct World {
    setup: Setup,
    rng: Rng,
    now: Millis,
    agents: Vec<Agent>,
    resources: Vec<Resource>,
    histories: Vec<History>,
    files: Vec<OwnerState>,
    /// Events by time and order.
    events: BTreeMap<(Millis, u64), Occurrence>,
    sequence: u64,
    /// Links that drop messages.
    cut: BTreeSet<(usize, usize)>,
    /// Time of the last arrival of each link, if messages keep their order.
    arrivals: BTreeMap<(LockPeer, LockPeer), Millis>,
    /// The last events, when one seed is repeated.
    log: Option<VecDeque<String>>,
    pub(crate) messages: u64,
    pub(crate) acquired: u64,
    /// The grants of the first resource.
    pub(crate) turns: Turns,
}

struct Agent {
    me: LockPeer,
    locks: Option<Locks<AnyAlgorithm>>,
    /// Clock: rate in per mille, and offset.
    rate: u64,
    offset: Millis,
    paused_until: Millis,
    monitor: Option<Checked>,
    claim: Option<ActiveClaim>,
    claims_left: u64,
    /// Messages that arrived during a pause.
    inbox: Vec<(LockPeer, LockMessage)>,
}

struct ActiveClaim {
    id: ClaimId,
    resources: Vec<Resource>,
    acquired: bool,
}

enum Occurrence {
    Arrive {
        to: LockPeer,
        from: LockPeer,
        message: LockMessage,
    },
    Claim(usize),
    Release(usize, ClaimId),
    Fault,
    Resume(usize),
    Return(usize),
    Heal(usize, usize),
    Notice {
        agent: usize,
        ended: LockPeer,
    },
}

fn peer(agent: usize, registration: u64) -> LockPeer {
    LockPeer::new(&format!("agent{agent}"), registration).unwrap()
}

/// The log of the seed that is repeated, when it has failed.
impl Drop for World {
    fn drop(&mut self) {
        if std::thread::panicking() {
            for line in self.log.iter().flatten() {
                eprintln!("{line}");
            }
        }
    }
}

impl World {
    pub(crate) fn new(setup: Setup, seed: u64) -> Self {
        let mut rng = Rng::with_seed(seed);
        let resources: Vec<_> = (0..setup.resources)
            .map(|number| Resource::new(&format!("bay{number}")).unwrap())
            .collect();
        let agents = (0..setup.agents)
            .map(|agent| Agent {
                me: peer(agent, 1),
                locks: None,
                rate: rng.u64(990..=1009),
                offset: rng.u64(0..100_000),
                paused_until: 0,
                monitor: setup
                    .checked
                    .then(|| Checked::new(setup.kind, &peer(agent, 1))),
                claim: None,
                claims_left: setup.claims,
                inbox: Vec::new(),
            })
            .collect();
        let histories = (0..setup.resources)
            .map(|number| History::new(resources[number].clone(), peer(number, 1)))
            .collect();
        let mut world = Self {
            setup,
            rng,
            now: 0,
            agents,
            files: vec![OwnerState::first(); setup.resources],
            resources,
            histories,
            events: BTreeMap::new(),
            sequence: 0,
            cut: BTreeSet::new(),
            arrivals: BTreeMap::new(),
            log: std::env::var_os("FIPA_LOCKS_SEED").map(|_| VecDeque::new()),
            messages: 0,
            acquired: 0,
            turns: Turns::default(),
        };
        for agent in 0..setup.agents {
            world.start(agent);
        }
        // Discovery ends before the first claim.
        for agent in 0..setup.agents {
            let after = 1_000 + world.rng.u64(0..300);
            world.at(after, Occurrence::Claim(agent));
        }
        if setup.faults {
            world.at(1_500, Occurrence::Fault);
        }
        world
    }

    fn options(&self, registration: u64) -> Options {
        let mut options = Options::default();
        options.lease = LEASE;
        options.probe_interval = 200;
        options.probe_timeout = 100;
        options.retry = 50;
        options.discovery = 500;
        options.claim = 100;
        options.first_conversation = registration * 1_000_000;
        options
    }

    fn at(&mut self, after: Millis, occurrence: Occurrence) {
        self.sequence += 1;
        self.events
            .insert((self.now + after, self.sequence), occurrence);
    }

    fn log(&mut self, text: impl FnOnce() -> String) {
        let now = self.now;
        if let Some(log) = &mut self.log {
            log.push_back(format!("{now} {}", text()));
            if log.len() > 2_000 {
                log.pop_front();
            }
        }
    }

    fn clock(&self, agent: usize) -> Millis {
        let agent = &self.agents[agent];
        agent.offset + self.now * agent.rate / 1000
    }

    /// Starts an agent in its present registration.
    fn start(&mut self, agent: usize) {
        let me = self.agents[agent].me.clone();
        let options = self.options(me.registration());
        self.agents[agent].locks = Some(Locks::new(me, self.setup.kind, options));
        let peers: Vec<_> = self.agents.iter().map(|agent| agent.me.clone()).collect();
        let alive: Vec<_> = self
            .agents
            .iter()
            .map(|agent| agent.locks.is_some() || self.now == 0)
            .collect();
        self.call(agent, |locks, now, out| {
            for (peer, _) in peers.iter().zip(alive).filter(|(_, alive)| *alive) {
                locks.join(now, peer, LockDialect::Own, out);
            }
        });
        if agent < self.setup.resources {
            let text = self.files[agent].to_string();
            let file = match self.now {
                0 => OwnerState::first(),
                _ => text.parse().unwrap(),
            };
            let file = file.next_life(LEASE);
            self.files[agent] = file;
            let resource = self.resources[agent].clone();
            self.call(agent, |locks, now, out| {
                locks.own(now, &resource, &file, out)
            });
        }
    }

    fn call(
        &mut self,
        agent: usize,
        call: impl FnOnce(&mut Locks<AnyAlgorithm>, Millis, &mut Vec<Action>),
    ) {
        let now = self.clock(agent);
        let mut out = Vec::new();
        if let Some(locks) = &mut self.agents[agent].locks {
            call(locks, now, &mut out);
        }
        self.perform(agent, out);
    }

    fn perform(&mut self, agent: usize, actions: Vec<Action>) {
        if let Some(history) = self.histories.get_mut(agent) {
            history.owner_acts(&actions);
        }
        for action in actions {
            self.log(|| format!("agent{agent}: {action:?}"));
            match action {
                Action::Send { to, message } => self.send(agent, to, message),
                Action::Event(event) => self.event(agent, event),
            }
        }
    }

    fn send(&mut self, agent: usize, to: LockPeer, message: LockMessage) {
        self.messages += 1;
        let from = self.agents[agent].me.clone();
        if let Some(monitor) = &mut self.agents[agent].monitor {
            monitor.check(self.now, &from, &to, &message);
            let faulty = self.setup.faults && !self.setup.kills_only && self.now < FAULTS_END;
            if faulty && self.rng.u8(..100) < 5 {
                return;
            }
            let link = self.arrivals.entry((from.clone(), to.clone())).or_default();
            *link = (*link).max(self.now + self.rng.u64(1..12));
            let delay = *link - self.now;
            self.at(delay, Occurrence::Arrive { to, from, message });
            return;
        }
        let receiver = self
            .agents
            .iter()
            .position(|agent| agent.me.name() == to.name());
        if receiver.is_some_and(|to| self.cut.contains(&(agent, to))) {
            return;
        }
        let faulty = self.setup.faults && !self.setup.kills_only && self.now < FAULTS_END;
        if faulty && self.rng.u8(..100) < 5 {
            return;
        }
        let copies = 1 + u8::from(faulty && self.rng.u8(..100) < 5);
        for _ in 0..copies {
            let delay = match faulty && self.rng.u8(..100) < 10 {
                true => self.rng.u64(0..1_500),
                false => self.rng.u64(1..12),
            };
            let (to, from, message) = (to.clone(), from.clone(), message.clone());
            self.at(delay, Occurrence::Arrive { to, from, message });
        }
    }

    fn event(&mut self, agent: usize, event: Event) {
        match event {
            Event::Acquired { claim } => {
                self.acquired += 1;
                self.turns.granted(&self.agents[agent].me);
                let Some(active) = &mut self.agents[agent].claim else {
                    panic!("{claim:?} is acquired, but not open");
                };
                assert_eq!(active.id, claim);
                active.acquired = true;
                if self.setup.claims > 0 {
                    let hold = self.rng.u64(1..600);
                    self.at(hold, Occurrence::Release(agent, claim));
                }
            }
            Event::Failed { claim, .. } | Event::Lost { claim, .. }
                if self.is_open(agent, claim) =>
            {
                self.agents[agent].claim = None;
                self.turns.ended(&self.agents[agent].me);
                self.claim_later(agent);
            }
            _ => {}
        }
    }

    fn is_open(&self, agent: usize, claim: ClaimId) -> bool {
        let open = self.agents[agent].claim.as_ref();
        open.is_some_and(|active| active.id == claim)
    }

    fn claim_later(&mut self, agent: usize) {
        let pause = self.rng.u64(1..200);
        self.at(pause, Occurrence::Claim(agent));
    }

    fn claim(&mut self, agent: usize) {
        let now = self.clock(agent);
        let of = &mut self.agents[agent];
        if of.claim.is_some() || of.claims_left == 0 {
            return;
        }
        let Some(locks) = &mut of.locks else {
            return;
        };
        of.claims_left -= 1;
        let mut resources = self.resources.clone();
        if self.rng.bool() {
            self.rng.shuffle(&mut resources);
            resources.truncate(1);
        }
        let with_deadlines = self.setup.faults && !self.setup.kills_only;
        let within = match with_deadlines && self.rng.u8(..4) == 0 {
            true => Some(self.rng.u64(1..2_000)),
            false => None,
        };
        let mut out = Vec::new();
        let id = locks.lock_all(now, &resources, within, &mut out);
        of.claim = Some(ActiveClaim {
            id,
            resources,
            acquired: false,
        });
        let me = of.me.clone();
        let others = self.agents.iter().filter(|other| other.locks.is_some());
        let others = others.map(|other| other.me.clone());
        let unreached = others.filter(|other| *other != me).collect();
        self.turns.requested(&me, unreached);
        self.perform(agent, out);
    }

    fn release(&mut self, agent: usize, claim: ClaimId) {
        let of = &mut self.agents[agent];
        if of
            .claim
            .as_ref()
            .is_some_and(|active| active.id == claim && active.acquired)
        {
            of.claim = None;
            self.call(agent, |locks, now, out| locks.release(now, claim, out));
            self.claim_later(agent);
        }
    }

    fn arrive(&mut self, to: &LockPeer, from: LockPeer, message: LockMessage) {
        let Some(agent) = self.agents.iter().position(|agent| agent.me == *to) else {
            return;
        };
        if self.agents[agent].locks.is_none() {
            return;
        }
        let of = &mut self.agents[agent];
        // Messages that arrive before the end of a pause is handled follow those of the pause.
        if of.paused_until > self.now || !of.inbox.is_empty() {
            of.inbox.push((from, message));
            return;
        }
        if let Some(history) = self.histories.get_mut(agent) {
            history.owner_receives(&from, &message);
        }
        self.log(|| format!("agent{agent} from {from:?}: {message:?}"));
        self.reached(agent, &from, &message);
        if let Some(monitor) = &mut self.agents[agent].monitor {
            monitor.check(self.now, &from, to, &message);
        }
        self.call(agent, |locks, now, out| {
            locks.handle(now, &from, &message, out)
        });
    }

    /// Records that a request has reached an agent.
    fn reached(&mut self, agent: usize, from: &LockPeer, message: &LockMessage) {
        let Content::Lock { act, .. } = &message.content else {
            return;
        };
        match act {
            Act::Ask { .. } => self.turns.reached_all(from),
            Act::Request { .. } | Act::RequestToken { .. } => {
                self.turns.reached(from, &self.agents[agent].me);
            }
            _ => {}
        }
    }

    fn fault(&mut self) {
        if self.now >= FAULTS_END {
            return;
        }
        let agent = self.rng.usize(..self.setup.agents);
        let alive = self.agents[agent].locks.is_some();
        let kind = if self.setup.kills_only {
            2
        } else {
            self.rng.u8(..6)
        };
        match kind {
            0 | 1 if alive => {
                let pause = self.rng.u64(1..1_500);
                self.agents[agent].paused_until = self.now + pause;
                self.at(pause, Occurrence::Resume(agent));
            }
            2 if alive => self.crash(agent),
            3 | 4 if !self.setup.checked => {
                let other = self.rng.usize(..self.setup.agents);
                self.cut.insert((agent, other));
                let until = self.rng.u64(1..1_500);
                self.at(until, Occurrence::Heal(agent, other));
            }
            _ => {}
        }
        // After a kill, some requests have time to be overtaken.
        let longest = if self.setup.kills_only { 6_000 } else { 1_000 };
        let pause = self.rng.u64(1..longest);
        self.at(pause, Occurrence::Fault);
    }

    fn crash(&mut self, agent: usize) {
        let of = &mut self.agents[agent];
        let ended = of.me.clone();
        of.locks = None;
        of.inbox.clear();
        of.paused_until = 0;
        of.claim = None;
        self.turns.disturbed();
        self.turns.departed(&ended);
        for history in &mut self.histories {
            history.holds(&ended, None);
        }
        // The directory of some hosts has the proof at once, that of others later.
        for other in (0..self.setup.agents).filter(|other| *other != agent) {
            let after = self.rng.u64(1..1_500);
            let ended = ended.clone();
            self.at(
                after,
                Occurrence::Notice {
                    agent: other,
                    ended,
                },
            );
        }
        let back = self.rng.u64(1..1_500);
        self.at(back, Occurrence::Return(agent));
    }

    fn come_back(&mut self, agent: usize) {
        let registration = self.agents[agent].me.registration() + 1;
        let me = peer(agent, registration);
        if self.setup.checked {
            self.agents[agent].monitor = Some(Checked::new(self.setup.kind, &me));
        }
        self.agents[agent].me = me;
        if let Some(history) = self.histories.get_mut(agent) {
            history.owner_restarted(peer(agent, registration));
        }
        self.start(agent);
        self.claim_later(agent);
    }

    fn occur(&mut self, occurrence: Occurrence) {
        match occurrence {
            Occurrence::Arrive { to, from, message } => self.arrive(&to, from, message),
            Occurrence::Claim(agent) if self.agents[agent].paused_until > self.now => {
                self.claim_later(agent);
            }
            Occurrence::Claim(agent) => self.claim(agent),
            Occurrence::Release(agent, claim) => {
                if self.agents[agent].paused_until > self.now {
                    self.at(100, Occurrence::Release(agent, claim));
                } else {
                    self.release(agent, claim);
                }
            }
            Occurrence::Fault => self.fault(),
            Occurrence::Resume(agent) => {
                if self.agents[agent].paused_until <= self.now {
                    let me = self.agents[agent].me.clone();
                    for (from, message) in std::mem::take(&mut self.agents[agent].inbox) {
                        self.arrive(&me, from, message);
                    }
                }
            }
            Occurrence::Return(agent) => self.come_back(agent),
            Occurrence::Heal(from, to) => {
                self.cut.remove(&(from, to));
            }
            Occurrence::Notice { agent, ended } => {
                // The process may have started since: its new registration learns of the old one by
                // its directory too.
                if let Some(history) = self.histories.get_mut(agent) {
                    history.departed(&ended);
                }
                self.call(agent, |locks, now, out| locks.depart(now, &ended, out));
            }
        }
    }

    /// True time of the next timeout of an agent.
    fn next_timeout(&self) -> Option<(Millis, usize)> {
        let due = self
            .agents
            .iter()
            .enumerate()
            .filter_map(|(number, agent)| {
                let due = agent.locks.as_ref()?.poll_timeout()?;
                let due = due.saturating_sub(agent.offset);
                // The first true time at which the agent's clock has the value.
                let due = (due * 1000).div_ceil(agent.rate);
                Some((due.max(agent.paused_until).max(self.now), number))
            });
        due.min()
    }

    /// Performs the next event. Returns whether there was one.
    fn step(&mut self) -> bool {
        let event = self.events.first_key_value().map(|(key, _)| key.0);
        let timeout = self.next_timeout();
        match (event, timeout) {
            (Some(at), timeout) if timeout.is_none_or(|(due, _)| at <= due) => {
                self.now = at.max(self.now);
                if let Some((_, occurrence)) = self.events.pop_first() {
                    self.occur(occurrence);
                }
            }
            (_, Some((due, agent))) => {
                self.now = due;
                self.call(agent, |locks, now, out| locks.handle_timeout(now, out));
            }
            _ => return false,
        }
        true
    }

    /// Runs until every claim has ended.
    pub(crate) fn run(&mut self) -> Result<(), String> {
        while self.now < END {
            if !self.step() {
                break;
            }
            self.observe()?;
            let calm = !self.setup.faults || self.now > FAULTS_END;
            let idle = |agent: &Agent| agent.claim.is_none() && agent.claims_left == 0;
            if calm && self.agents.iter().all(idle) {
                return Ok(());
            }
        }
        let open: Vec<_> = self
            .agents
            .iter()
            .filter(|agent| agent.claim.is_some())
            .map(|agent| format!("{:?}: {:#?}", agent.me, agent.locks))
            .collect();
        Err(format!(
            "open claims at {} ms: {}",
            self.now,
            open.join("\n")
        ))
    }

    fn observe(&mut self) -> Result<(), String> {
        let all = self.agents.len();
        // First all agents that hold nothing any more.
        for (ended_only, number) in (0..2 * all).map(|index| (index < all, index % all)) {
            let now = self.clock(number);
            let agent = &self.agents[number];
            let (Some(locks), claim) = (&agent.locks, &agent.claim) else {
                continue;
            };
            for (owner, resource) in self.resources.iter().enumerate() {
                let fence = claim
                    .as_ref()
                    .and_then(|claim| locks.fence(now, claim.id, resource));
                if ended_only && fence.is_some() {
                    continue;
                }
                self.histories[owner].holds(&agent.me, fence.as_ref());
                let at = self.clock(owner);
                if let (Some(fence), Some(core)) = (fence, &self.agents[owner].locks)
                    // An owner that is late ends a lease at its next event.
                    && core.poll_timeout().is_none_or(|due| due > at)
                {
                    let accepted = core.admit(at, resource, &fence);
                    self.histories[owner].admitted(&fence, accepted);
                }
            }
            if let Some(claim) = claim
                && claim.acquired
                && !claim.resources.is_empty()
                && locks.poll_timeout().is_none_or(|due| due > now)
                && !all_or_none(locks, now, claim.id, &claim.resources)
            {
                return Err(format!("{:?} holds a part of its claim", agent.me));
            }
        }
        match self.histories.iter().find_map(History::violation) {
            Some(violation) => Err(format!("at {} ms: {violation}", self.now)),
            None => Ok(()),
        }
    }

    /// Counts the messages of one claim of an agent, from the request until nothing is under way.
    pub(crate) fn messages_of_one_acquisition(&mut self, agent: usize) -> u64 {
        let until = self.now + 2_000;
        self.run_until(until);
        let before = self.messages;
        let now = self.clock(agent);
        let resource = self.resources[0].clone();
        let mut out = Vec::new();
        let locks = self.agents[agent].locks.as_mut().unwrap();
        let id = locks.lock(now, &resource, None, &mut out);
        self.agents[agent].claim = Some(ActiveClaim {
            id,
            resources: vec![resource],
            acquired: false,
        });
        self.perform(agent, out);
        // Shorter than a third of the lease, so that nothing is renewed.
        let until = self.now + 100;
        self.run_until(until);
        assert!(self.agents[agent].claim.as_ref().unwrap().acquired);
        self.release(agent, id);
        let until = self.now + 100;
        self.run_until(until);
        self.messages - before
    }

    fn run_until(&mut self, until: Millis) {
        loop {
            let event = self.events.first_key_value().map(|(key, _)| key.0);
            let timeout = self.next_timeout().map(|(due, _)| due);
            match event.into_iter().chain(timeout).min() {
                Some(at) if at <= until => {
                    self.step();
                    self.observe().unwrap();
                }
                _ => break,
            }
        }
        self.now = until;
    }
}
