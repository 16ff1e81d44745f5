//! States, steps and faults of the model.

use std::collections::BTreeSet;

use stateright::{Model, Property};

use crate::faults::Fault;
use crate::invariants::{History, Turns};
use crate::{
    Act, Action, Admission, Algorithm, AnyAlgorithm, ClaimId, Content, Conversation, Event, Fence,
    LockDialect, LockMessage, LockPeer, Locks, Millis, NotAdmitted, Options, OwnerState, Resource,
};

/// The time of each state. It exceeds every span, so that no time before it is cut off at 0.
const NOW: Millis = 64;

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Time {
    /// Messages are delayed for any time. Number of ticks.
    Free(u8),
    /// Messages arrive before time passes.
    Prompt,
}

/// Number of faults of each kind.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub(super) struct Faults {
    pub(super) losses: u8,
    pub(super) duplicates: u8,
    pub(super) crashes: u8,
    pub(super) pauses: u8,
    pub(super) restarts: u8,
    pub(super) withdrawals: u8,
    /// Restarts of the owner on the other host, which has a state file of its own.
    pub(super) moves: u8,
    /// Commands that reach a device, with the fence of any grant.
    pub(super) commands: u8,
}

/// What an owner knows at its start, beside its state file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Memory {
    /// Each host has a clock.
    Clocks,
    /// The clock of the second host is set, that of the first is not.
    SecondClock,
    /// No clock is set.
    NoClock,
    /// No clock is set, and an owner without a file was told to forget its earlier lives.
    Forgets,
}

#[derive(Debug, Clone)]
pub(super) struct System {
    pub(super) kind: Algorithm,
    /// Number of claims of each agent. Agent 0 is the owner.
    pub(super) claims: Vec<u8>,
    pub(super) time: Time,
    pub(super) faults: Faults,
    /// Whether the owner probes. Otherwise no agent does.
    pub(super) probes: bool,
    pub(super) lease: Millis,
    pub(super) memory: Memory,
    pub(super) fault: Fault,
    /// Whether agent 0 is like one of `distributed_locking`: it owns the resource without fences. Then the others start
    /// in steps of their own, with a directory that lists those that have started.
    pub(super) foreign_owner: bool,
    /// A further agent of that kind.
    pub(super) foreigner: Option<u8>,
    /// Whether grants before an open request are counted. Then messages arrive in one order, agent 1 is killed while
    /// it holds, and the others make their first request after that.
    pub(super) turns: bool,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct State {
    agents: Vec<Agent>,
    network: BTreeSet<(LockPeer, LockPeer, LockMessage)>,
    history: History,
    /// State files of the owner on two hosts, and its host.
    files: [Option<OwnerState>; 2],
    host: usize,
    /// Number of the owner's lives.
    lives: u64,
    /// Fences in the order of their grants, while commands are left.
    grants: Vec<Fence>,
    /// A device of agent 1, and the latest grant of which it has admitted a fence.
    device: Admission,
    admitted: Option<usize>,
    ticks: u8,
    remaining: Faults,
    /// Registrations that have ended, and the agents that have no proof of it.
    unnoticed: BTreeSet<(LockPeer, u8)>,
    /// Registrations, and the agents whose directory does not list them yet.
    unlisted: BTreeSet<(LockPeer, u8)>,
    turns: Turns,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
struct Agent {
    me: LockPeer,
    /// A crashed agent has none.
    locks: Option<Locks<AnyAlgorithm>>,
    paused: bool,
    claim: Option<ClaimId>,
    acquired: bool,
    remaining: u8,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) enum Step {
    Lock(u8),
    Release(u8),
    Withdraw(u8),
    Deliver(LockPeer, LockPeer, LockMessage),
    Tick,
    Notice(LockPeer, u8),
    List(LockPeer, u8),
    Resume(u8),
    Lose(LockPeer, LockPeer, LockMessage),
    Duplicate(LockPeer, LockPeer, LockMessage),
    Crash(u8),
    Return(u8),
    Pause(u8),
    Restart,
    Move,
    Command(usize),
}

impl Step {
    pub(super) fn is_fault(&self) -> bool {
        matches!(
            self,
            Self::Lose(..)
                | Self::Duplicate(..)
                | Self::Crash(_)
                | Self::Pause(_)
                | Self::Restart
                | Self::Move
                | Self::Command(_)
                | Self::Withdraw(_)
        )
    }
}

pub(super) fn resource() -> Resource {
    Resource::new("bay").unwrap()
}

fn name(agent: u8) -> &'static str {
    ["a", "b", "c", "d"][usize::from(agent)]
}

impl System {
    fn options(&self, agent: u8) -> Options {
        Options {
            lease: self.lease,
            probe_interval: if self.probes && agent == 0 { 1 } else { 60 },
            probe_timeout: 2,
            retry: 2,
            discovery: 4,
            claim: 1,
            first_conversation: 0,
            fault: match self.is_foreign(agent) {
                true => Fault::Foreign,
                false => self.fault,
            },
            ..Options::default()
        }
    }

    fn is_foreign(&self, agent: u8) -> bool {
        (self.foreign_owner && agent == 0) || self.foreigner == Some(agent)
    }

    fn dialect(&self, peer: &LockPeer) -> LockDialect {
        let is = (0..)
            .take(self.claims.len())
            .find(|agent| name(*agent) == peer.name());
        match is.is_some_and(|agent| self.is_foreign(agent)) {
            true => LockDialect::Legacy,
            false => LockDialect::Own,
        }
    }

    fn agent(&self, agent: u8, registration: u64) -> Agent {
        let me = LockPeer::new(name(agent), registration).unwrap();
        let mut options = self.options(agent);
        options.first_conversation = registration * 32;
        Agent {
            locks: Some(Locks::new(me.clone(), self.kind, options)),
            me,
            paused: false,
            claim: None,
            acquired: false,
            remaining: self.claims[usize::from(agent)],
        }
    }

    fn initial(&self) -> State {
        let count = self.claims.len() as u8;
        let device = Admission::new(name(0), resource().as_str()).unwrap();
        let mut agents: Vec<_> = (0..count).map(|agent| self.agent(agent, 1)).collect();
        if self.foreign_owner {
            for agent in agents.iter_mut().skip(1) {
                agent.locks = None;
            }
        }
        let mut state = State {
            history: History::new(resource(), agents[0].me.clone()),
            agents,
            network: BTreeSet::new(),
            files: [Some(OwnerState::first()), None],
            host: 0,
            lives: 0,
            grants: Vec::new(),
            device,
            admitted: None,
            ticks: 0,
            remaining: self.faults,
            unnoticed: BTreeSet::new(),
            unlisted: BTreeSet::new(),
            turns: Turns::default(),
        };
        if self.foreign_owner {
            return state;
        }
        let peers: Vec<_> = state.agents.iter().map(|agent| agent.me.clone()).collect();
        let life = self.life(&mut state);
        for agent in 0..count {
            let mut out = Vec::new();
            let locks = state.locks(agent);
            for peer in &peers {
                locks.join(NOW, peer, LockDialect::Own, &mut out);
            }
            if agent == 0 {
                locks.own(NOW, &resource(), &life, &mut out);
            } else {
                locks.owner_known(NOW, &resource(), &peers[0], LockDialect::Own, &mut out);
            }
        }
        let out = &mut Vec::new();
        let locks = state.locks(0);
        locks.rebase(1);
        locks.handle_timeout(NOW, out);
        assert!(
            out.iter()
                .any(|action| matches!(action, Action::Event(Event::Owning { .. })))
        );
        state
    }

    /// Begins a life of the owner, and writes its state file.
    fn life(&self, state: &mut State) -> OwnerState {
        state.lives += 1;
        let absence = match self.faults.moves {
            0 => 0,
            _ => self.lease,
        };
        let file = state.files[state.host].as_ref();
        let file = file.map(|file| file.to_string().parse::<OwnerState>().unwrap());
        let forgets = self.memory == Memory::Forgets || self.fault == Fault::FileOnly;
        let life = match file {
            Some(file) => file.next_life(self.lease).with_absence(absence),
            None if forgets => {
                if self.memory == Memory::Forgets {
                    state.history.owner_forgot();
                }
                let first = OwnerState::first().next_life(self.lease);
                first.with_absence(absence)
            }
            None => OwnerState::without_memory(self.lease).with_absence(absence),
        };
        let has_clock = match self.memory {
            Memory::Clocks => self.fault != Fault::FileOnly,
            Memory::SecondClock => state.host == 1,
            Memory::NoClock | Memory::Forgets => false,
        };
        let life = life
            .with_run(state.lives)
            .with_clock(has_clock.then_some(state.lives));
        if !life.needs_report() {
            state.files[state.host] = Some(life);
        }
        life
    }

    /// Ends the owner's life, and begins the next one.
    fn restart_owner(&self, state: &mut State) {
        self.end(state, 0);
        self.again(state, 0);
        state.history.owner_restarted(state.agents[0].me.clone());
        let life = self.life(state);
        self.call(state, 0, |locks, out| {
            locks.own(NOW, &resource(), &life, out)
        });
    }

    /// A command with the fence of a grant reaches the device.
    fn command(&self, state: &mut State, grant: usize) {
        let fence = state.grants[grant].clone();
        let (seen, tell) = match state.device.check(&fence) {
            Ok(()) => {
                let last = state.admitted;
                state.history.admitted_by_device(&fence, grant, last);
                state.admitted = last.max(Some(grant));
                (fence, false)
            }
            Err(NotAdmitted::OtherRun { highest }) => (highest, true),
            Err(_) => return,
        };
        self.call(state, 1, |locks, out| locks.saw(NOW, &seen, tell, out));
    }

    /// Performs the actions of an agent.
    fn perform(&self, state: &mut State, agent: u8, actions: Vec<Action>) {
        if agent == 0 {
            state.history.owner_acts(&actions);
        }
        let from = state.agents[usize::from(agent)].me.clone();
        for action in actions {
            match action {
                Action::Send { to, message } => {
                    if state
                        .agents
                        .iter()
                        .any(|agent| agent.me == to && agent.locks.is_some())
                    {
                        state.network.insert((to, from.clone(), message));
                    }
                }
                Action::Event(event) => {
                    if let (true, Event::Acquired { .. }) = (self.turns, &event) {
                        state.turns.granted(&from);
                        state.history.overtaken(&state.turns, 1);
                    }
                    let agent = &mut state.agents[usize::from(agent)];
                    match event {
                        Event::Granted { grant, .. } if self.faults.commands > 0 => {
                            state.grants.extend(grant.fence);
                        }
                        Event::Raised { resource, epoch } => {
                            let file = &mut state.files[state.host];
                            let life = file.unwrap_or(OwnerState::without_memory(self.lease));
                            *file = Some(life.with_absence(self.lease).raised(epoch));
                            self.call(state, 0, |locks, out| {
                                locks.stored(NOW, &resource, epoch, out);
                            });
                        }
                        Event::Acquired { claim } if agent.claim == Some(claim) => {
                            agent.acquired = true;
                        }
                        Event::Failed { claim, .. } | Event::Lost { claim, .. }
                            if agent.claim == Some(claim) =>
                        {
                            agent.claim = None;
                            agent.acquired = false;
                        }
                        // The event of the call that makes the claim precedes its return.
                        Event::Acquired { .. } => agent.acquired = true,
                        _ => {}
                    }
                }
            }
        }
    }

    fn call(
        &self,
        state: &mut State,
        agent: u8,
        call: impl FnOnce(&mut Locks<AnyAlgorithm>, &mut Vec<Action>),
    ) {
        let mut actions = Vec::new();
        let Some(locks) = &mut state.agents[usize::from(agent)].locks else {
            return;
        };
        call(locks, &mut actions);
        self.perform(state, agent, actions);
    }

    fn deliver(&self, state: &mut State, to: &LockPeer, from: &LockPeer, message: &LockMessage) {
        let agent = state.agents.iter().position(|agent| agent.me == *to);
        let Some(agent) = agent else {
            return;
        };
        if agent == 0 {
            state.history.owner_receives(from, message);
        }
        if let Content::Lock {
            act: Act::Request { .. } | Act::RequestToken { .. },
            ..
        } = message.content
        {
            state.turns.reached(from, to);
        }
        let mut message = message.clone();
        message.dialect = self.dialect(from);
        self.call(state, agent as u8, |locks, out| {
            locks.handle(NOW, from, &message, out);
        });
    }

    fn tick(&self, state: &mut State) {
        for agent in &mut state.agents {
            if let Some(locks) = &mut agent.locks {
                locks.rebase(1);
            }
        }
        state.network = std::mem::take(&mut state.network)
            .into_iter()
            .map(|(to, from, message)| (to, from, rebased(message)))
            .collect();
        for agent in 0..state.agents.len() as u8 {
            self.time_out(state, agent);
        }
    }

    fn time_out(&self, state: &mut State, agent: u8) {
        let of = &state.agents[usize::from(agent)];
        let due = of.locks.as_ref().and_then(Locks::poll_timeout);
        if !of.paused && due.is_some_and(|due| due <= NOW) {
            self.call(state, agent, |locks, out| locks.handle_timeout(NOW, out));
        }
    }

    /// Ends a registration.
    fn end(&self, state: &mut State, agent: u8) {
        let count = state.agents.len() as u8;
        let ended = &mut state.agents[usize::from(agent)];
        ended.locks = None;
        ended.claim = None;
        ended.acquired = false;
        ended.paused = false;
        let peer = ended.me.clone();
        state.history.holds(&peer, None);
        state.turns.departed(&peer);
        state.network.retain(|(to, _, _)| *to != peer);
        for other in (0..count).filter(|other| *other != agent) {
            if state.agents[usize::from(other)].locks.is_some() {
                state.unnoticed.insert((peer.clone(), other));
            }
        }
        state.unnoticed.retain(|(_, other)| *other != agent);
    }

    /// Registers an agent again.
    fn again(&self, state: &mut State, agent: u8) {
        let registration = state.agents[usize::from(agent)].me.registration() + 1;
        let remaining = state.agents[usize::from(agent)].remaining;
        state.agents[usize::from(agent)] = Agent {
            remaining,
            ..self.agent(agent, registration)
        };
        if self.foreign_owner {
            return self.start_among_strangers(state, agent);
        }
        let peers: Vec<_> = state
            .agents
            .iter()
            .filter(|other| other.locks.is_some())
            .map(|other| other.me.clone())
            .collect();
        let owner = state.agents[0]
            .locks
            .is_some()
            .then(|| state.agents[0].me.clone());
        self.call(state, agent, |locks, out| {
            for peer in &peers {
                locks.join(NOW, peer, LockDialect::Own, out);
            }
            if let Some(owner) = owner.filter(|_| agent != 0) {
                locks.owner_known(NOW, &resource(), &owner, LockDialect::Own, out);
            }
        });
    }

    /// The agent knows the agent that owns the resource, and its directory lists the others.
    fn start_among_strangers(&self, state: &mut State, agent: u8) {
        let (owner, me) = (
            state.agents[0].me.clone(),
            state.agents[usize::from(agent)].me.clone(),
        );
        let others = (1..).zip(state.agents.iter().skip(1));
        let others: Vec<_> = others
            .filter(|(other, of)| *other != agent && of.locks.is_some())
            .map(|(other, of)| (other, of.me.clone()))
            .collect();
        self.call(state, agent, |locks, out| {
            locks.join(NOW, &owner, LockDialect::Legacy, out);
        });
        for (other, peer) in others {
            self.list(state, &peer, agent);
            state.unlisted.insert((me.clone(), other));
        }
    }

    /// The directory of an agent lists another one.
    fn list(&self, state: &mut State, peer: &LockPeer, agent: u8) {
        let dialect = self.dialect(peer);
        if self.is_foreign(agent) {
            // It asks all agents that it knows, and greets none.
            self.call(state, agent, |locks, out| {
                locks.join(NOW, peer, dialect, out)
            });
            return;
        }
        let is_member = state.locks(agent).is_member(peer);
        if !is_member {
            state.locks(agent).expect(NOW, peer);
            let conversation = Conversation::new(format!("{}_probe", name(agent)).into(), 0);
            let message = LockMessage {
                conversation,
                dialect: LockDialect::Own,
                algorithm: None,
                content: Content::Probe,
            };
            let to = peer.clone();
            self.perform(state, agent, vec![Action::Send { to, message }]);
        }
    }

    fn observe(&self, state: &mut State) {
        if self.foreign_owner {
            for agent in &state.agents {
                state.history.holds_unfenced(&agent.me, agent.acquired);
            }
            return;
        }
        let (held, not): (Vec<_>, Vec<_>) = state
            .agents
            .iter()
            .partition(|agent| agent.fence().is_some());
        for agent in not.into_iter().chain(held) {
            let fence = agent.fence();
            state.history.holds(&agent.me, fence.as_ref());
            if let (Some(fence), Some(owner)) = (fence, &state.agents[0].locks) {
                let accepted = owner.admit(NOW, &resource(), &fence);
                state.history.admitted(&fence, accepted);
            }
        }
    }

    pub(super) fn initial_state(&self) -> State {
        self.initial()
    }

    pub(super) fn is_done(state: &State) -> bool {
        state
            .agents
            .iter()
            .all(|agent| agent.locks.is_none() || (agent.claim.is_none() && agent.remaining == 0))
    }

    /// Where grants are counted, the others begin after the crash.
    fn may_lock(&self, state: &State, agent: u8) -> bool {
        !self.turns || agent == 1 || state.remaining.crashes == 0
    }

    /// Where grants are counted, the agent that holds first is killed.
    fn may_release(&self, state: &State, agent: u8) -> bool {
        !self.turns || agent != 1 || state.remaining.crashes == 0
    }

    /// A crash of an agent that holds the resource. Other crashes have their own configurations.
    fn may_crash(&self, agent: &Agent) -> bool {
        !self.turns || agent.acquired
    }
}

impl State {
    fn locks(&mut self, agent: u8) -> &mut Locks<AnyAlgorithm> {
        self.agents[usize::from(agent)]
            .locks
            .as_mut()
            .expect("not crashed")
    }

    fn is_paused(&self, peer: &LockPeer) -> bool {
        self.agents
            .iter()
            .any(|agent| agent.me == *peer && agent.paused)
    }

    pub(super) fn broken(&self) -> Option<&crate::invariants::Violation> {
        self.history.violation()
    }
}

impl Agent {
    fn fence(&self) -> Option<Fence> {
        self.locks.as_ref()?.fence(NOW, self.claim?, &resource())
    }
}

fn rebased(mut message: LockMessage) -> LockMessage {
    if let Content::Lock {
        act:
            Act::Confirm { asked: Some(asked) }
            | Act::Ask { asked, .. }
            | Act::Renew { asked, .. }
            | Act::Granted { asked, .. }
            | Act::Refused { asked, .. },
        ..
    } = &mut message.content
    {
        *asked = asked.saturating_sub(1);
    }
    message
}

impl Model for System {
    type State = State;
    type Action = Step;

    fn init_states(&self) -> Vec<State> {
        vec![self.initial()]
    }

    fn actions(&self, state: &State, actions: &mut Vec<Step>) {
        // A broken state is the end of a counterexample.
        if state.broken().is_some() {
            return;
        }
        let remaining = state.remaining;
        let deliverable = if self.turns { 1 } else { usize::MAX };
        for (to, from, message) in state.network.iter().take(deliverable) {
            let (to, from, message) = (to.clone(), from.clone(), message.clone());
            if remaining.losses > 0 {
                actions.push(Step::Lose(to.clone(), from.clone(), message.clone()));
            }
            if state.is_paused(&to) {
                continue;
            }
            if remaining.duplicates > 0 {
                actions.push(Step::Duplicate(to.clone(), from.clone(), message.clone()));
            }
            actions.push(Step::Deliver(to, from, message));
        }
        for (number, agent) in (0..).zip(&state.agents) {
            if agent.locks.is_none() {
                actions.push(Step::Return(number));
                continue;
            }
            if agent.paused {
                actions.push(Step::Resume(number));
                continue;
            }
            match (agent.claim, agent.acquired) {
                (None, _) if agent.remaining > 0 && self.may_lock(state, number) => {
                    actions.push(Step::Lock(number));
                }
                (Some(_), true) if self.may_release(state, number) => {
                    actions.push(Step::Release(number));
                }
                (Some(_), false) if remaining.withdrawals > 0 => {
                    actions.push(Step::Withdraw(number))
                }
                _ => {}
            }
            if number > 0 && remaining.crashes > 0 && self.may_crash(agent) {
                actions.push(Step::Crash(number));
            }
            // An agent of a queue can also be stopped while it waits for its turn.
            let waits = self.kind == Algorithm::OwnerQueue && agent.claim.is_some();
            if remaining.pauses > 0 && (agent.acquired || waits) {
                actions.push(Step::Pause(number));
            }
        }
        if remaining.restarts > 0 {
            actions.push(Step::Restart);
        }
        if remaining.moves > 0 {
            actions.push(Step::Move);
        }
        if remaining.commands > 0 {
            actions.extend((0..state.grants.len()).map(Step::Command));
        }
        for (peer, agent) in &state.unnoticed {
            actions.push(Step::Notice(peer.clone(), *agent));
        }
        for (peer, agent) in &state.unlisted {
            actions.push(Step::List(peer.clone(), *agent));
        }
        let may_pass = match self.time {
            Time::Free(ticks) => state.ticks < ticks,
            Time::Prompt => state.network.iter().all(|(to, ..)| state.is_paused(to)),
        };
        if may_pass {
            actions.push(Step::Tick);
        }
    }

    fn next_state(&self, before: &State, step: Step) -> Option<State> {
        let mut next = before.clone();
        let state = &mut next;
        match step {
            Step::Lock(number) => {
                let owner = self.foreign_owner.then(|| state.agents[0].me.clone());
                let agent = &mut state.agents[usize::from(number)];
                agent.remaining -= 1;
                let mut actions = Vec::new();
                let locks = agent.locks.as_mut()?;
                if let Some(owner) = owner {
                    locks.owner_known(NOW, &resource(), &owner, LockDialect::Legacy, &mut actions);
                }
                agent.claim = Some(locks.lock(NOW, &resource(), None, &mut actions));
                if self.turns {
                    let me = agent.me.clone();
                    let others = state.agents.iter().filter(|other| other.locks.is_some());
                    let others = others.map(|other| other.me.clone());
                    let unreached = others.filter(|other| *other != me).collect();
                    state.turns.requested(&me, unreached);
                }
                self.perform(state, number, actions);
            }
            Step::Release(number) | Step::Withdraw(number) => {
                if matches!(step, Step::Withdraw(_)) {
                    state.remaining.withdrawals -= 1;
                }
                let agent = &mut state.agents[usize::from(number)];
                agent.acquired = false;
                let claim = agent.claim.take()?;
                let me = agent.me.clone();
                state.turns.ended(&me);
                self.call(state, number, |locks, out| locks.release(NOW, claim, out));
            }
            Step::Deliver(to, from, message) => {
                let key = (to, from, message);
                state.network.remove(&key);
                self.deliver(state, &key.0, &key.1, &key.2);
            }
            Step::Duplicate(to, from, message) => {
                state.remaining.duplicates -= 1;
                self.deliver(state, &to, &from, &message);
            }
            Step::Lose(to, from, message) => {
                state.remaining.losses -= 1;
                state.network.remove(&(to, from, message));
            }
            Step::Tick => {
                if let Time::Free(_) = self.time {
                    state.ticks += 1;
                }
                self.tick(state);
            }
            Step::Notice(peer, number) => {
                state.unnoticed.remove(&(peer.clone(), number));
                if number == 0 {
                    state.history.departed(&peer);
                }
                self.call(state, number, |locks, out| locks.depart(NOW, &peer, out));
            }
            Step::List(peer, number) => {
                state.unlisted.remove(&(peer.clone(), number));
                self.list(state, &peer, number);
            }
            Step::Pause(number) => {
                state.remaining.pauses -= 1;
                state.agents[usize::from(number)].paused = true;
            }
            Step::Resume(number) => {
                state.agents[usize::from(number)].paused = false;
                self.time_out(state, number);
            }
            Step::Crash(number) => {
                state.remaining.crashes -= 1;
                state.turns.disturbed();
                self.end(state, number);
            }
            Step::Return(number) => self.again(state, number),
            Step::Restart => {
                state.remaining.restarts -= 1;
                self.restart_owner(state);
            }
            Step::Move => {
                state.remaining.moves -= 1;
                state.host = 1 - state.host;
                state.history.owner_moved();
                self.restart_owner(state);
            }
            Step::Command(grant) => {
                state.remaining.commands -= 1;
                self.command(state, grant);
            }
        }
        self.observe(state);
        Some(next)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![Property::always(
            "the invariants hold",
            |_, state: &State| state.broken().is_none(),
        )]
    }
}
