//! A simulated world: hosts, processes, links, time.

use std::cmp::Reverse;
mod checks;
mod links;
mod moves;
mod view;
mod watching;
mod weather;

use std::collections::{BTreeMap, BinaryHeap, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, SendId, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Entry, Role};
use fipa_transport::{
    AttemptId, Conclusion, Incarnation, Kind, Outcome, Parcel, Ticket, WayError, WayFault,
};
use parking_lot::Mutex;

use self::view::{Registered, Registry, View};
use self::watching::Watching;
pub(crate) use self::weather::Weather;

const PROCESSES: usize = 3;
const AGENTS: usize = 2;
const LETTERS: u64 = 120;
/// Letters are sent within this time; then the world may come to rest.
const ACTIVE_MS: u64 = 3000;
const DEADLINE: Duration = Duration::from_millis(2500);
/// Outcomes may come this much after the deadline: one turn of the core's timer.
const SLACK: Duration = Duration::from_millis(5);

type Breach = String;

/// A process: robot process or gateway.
struct Process {
    host: usize,
    gateway: bool,
    incarnation: Incarnation,
    core: Core,
    agents: Vec<(Arc<str>, Incarnation)>,
    /// Attempts that have not been concluded: dead receivers break them off.
    open: BTreeMap<AttemptId, usize>,
    /// Arrivals answered later: who waits for the answer, and since which of its lives.
    tickets: HashMap<Ticket, (usize, AttemptId)>,
    next_ticket: u64,
    alive: bool,
    wake: Option<Instant>,
}

enum Event {
    Send,
    Arrive {
        from: usize,
        to: usize,
        kind: Kind,
        attempt: AttemptId,
        parcel: Parcel,
        mute: bool,
        copy: bool,
    },
    Conclude {
        at: usize,
        attempt: AttemptId,
        conclusion: Conclusion,
    },
    Timer {
        at: usize,
    },
    Read {
        at: usize,
        agent: Incarnation,
    },
    Deadline {
        number: u64,
    },
    Die,
    Forgotten {
        process: usize,
    },
    Reborn {
        process: usize,
    },
    /// An agent leaves its process.
    Move,
    /// It is registered in another one.
    Settle {
        name: Arc<str>,
    },
    /// What has changed becomes known on a host, to these processes as a departure.
    News {
        host: usize,
        departed: Vec<(usize, Arc<Entry>)>,
    },
    CutOff,
    JoinedAgain {
        host: usize,
    },
    Outage {
        host: usize,
        kind: Kind,
    },
    OutageEnds {
        host: usize,
        kind: Kind,
    },
}

/// What is remembered of a sent letter, by its number.
struct Sent {
    process: usize,
    sender: Incarnation,
    expected: usize,
    outcomes: BTreeMap<Arc<str>, Outcome>,
}

pub(crate) struct World {
    weather: Weather,
    random: fastrand::Rng,
    start: Instant,
    now: Instant,
    events: BinaryHeap<Reverse<(Instant, u64)>>,
    due: HashMap<u64, Event>,
    next_event: u64,
    registry: Arc<Mutex<Registry>>,
    processes: Vec<Process>,
    /// When the last parcel on a link arrives: links keep their order.
    links: HashMap<(usize, usize, Kind), Instant>,
    down: HashSet<(usize, Kind)>,
    /// Hosts that nothing gets to or from.
    cut_off: HashSet<usize>,
    sends: HashMap<(usize, SendId), u64>,
    sent: BTreeMap<u64, Sent>,
    /// Which letters each life of each agent took, in order.
    taken: HashMap<Incarnation, Vec<u64>>,
    names: HashMap<Incarnation, Arc<str>>,
    /// Agents that are about to read.
    reading: HashSet<Incarnation>,
    failures_told: u64,
    /// Letters that came to the host to which their receiver had moved.
    followed: u64,
    /// Whether anybody watches: in some worlds, so that the others show that it makes no
    /// difference.
    watched: bool,
    /// Who watches, by host.
    watching: Vec<Watching>,
}

impl World {
    pub(crate) fn new(seed: u64, weather: Weather) -> Self {
        let start = Instant::now();
        let mut world = Self {
            weather,
            random: fastrand::Rng::with_seed(seed),
            start,
            now: start,
            events: BinaryHeap::new(),
            due: HashMap::new(),
            next_event: 0,
            registry: Arc::default(),
            processes: Vec::new(),
            links: HashMap::new(),
            down: HashSet::new(),
            cut_off: HashSet::new(),
            sends: HashMap::new(),
            sent: BTreeMap::new(),
            taken: HashMap::new(),
            names: HashMap::new(),
            reading: HashSet::new(),
            failures_told: 0,
            followed: 0,
            watched: seed.is_multiple_of(4),
            watching: (0..weather.hosts).map(|_| Watching::default()).collect(),
        };
        for host in 0..weather.hosts {
            world.birth(host, true, &[format!("gateway{host}")]);
            for process in 0..PROCESSES {
                let names: Vec<String> = (0..AGENTS)
                    .map(|agent| format!("h{host}_p{process}_{agent}"))
                    .collect();
                world.birth(host, false, &names);
            }
        }
        for _ in 0..LETTERS {
            let at = world.some_time();
            world.at(at, Event::Send);
        }
        for _ in 0..weather.deaths {
            let at = world.some_time();
            world.at(at, Event::Die);
        }
        for _ in 0..weather.moves {
            let at = world.some_time();
            world.at(at, Event::Move);
        }
        for _ in 0..weather.partitions {
            let at = world.some_time();
            world.at(at, Event::CutOff);
        }
        for _ in 0..weather.outages {
            let at = world.some_time();
            let host = world.random.usize(..weather.hosts);
            let kind = *world
                .random
                .choice(&[Kind::Shm, Kind::Tcp, Kind::Udp])
                .expect("a kind");
            world.at(at, Event::Outage { host, kind });
        }
        world
    }

    pub(crate) fn letters(&self) -> usize {
        self.sent.len()
    }

    pub(crate) fn followed(&self) -> u64 {
        self.followed
    }

    fn incarnation(&mut self) -> Incarnation {
        Incarnation::from_u64(self.random.u64(1..))
    }

    fn some_time(&mut self) -> Instant {
        self.start + Duration::from_micros(self.random.u64(..ACTIVE_MS * 1000))
    }

    fn at(&mut self, at: Instant, event: Event) {
        self.next_event += 1;
        self.due.insert(self.next_event, event);
        self.events.push(Reverse((at, self.next_event)));
    }

    fn after_ms(&mut self, most: u64, event: Event) {
        let delay = Duration::from_micros(self.random.u64(..=most * 1000));
        self.at(self.now + delay, event);
    }

    fn clocks(&self) -> Now {
        Now {
            instant: self.now,
            utc: SystemTime::UNIX_EPOCH + (self.now - self.start),
        }
    }

    fn birth(&mut self, host: usize, gateway: bool, names: &[String]) -> usize {
        let incarnation = self.incarnation();
        let registry = Arc::clone(&self.registry);
        let order = vec![Kind::Shm, Kind::Udp, Kind::Tcp];
        let name = if gateway {
            names[0].clone()
        } else {
            format!("mts{host}")
        };
        let config = CoreConfig {
            forwards: gateway,
            queue: self.weather.queue,
            window: 8,
            lane: 32,
            attempt_timeout: Duration::from_millis(300),
            ..CoreConfig::new(name, incarnation, order)
        };
        let view = View {
            registry,
            host,
            gateway,
        };
        let mut process = Process {
            host,
            gateway,
            incarnation,
            core: Core::new(config, Arc::new(view)),
            agents: Vec::new(),
            open: BTreeMap::new(),
            tickets: HashMap::new(),
            next_ticket: 0,
            alive: true,
            wake: None,
        };
        process.core.watch(self.watched);
        for name in names {
            let name: Arc<str> = name.as_str().into();
            let agent = if gateway {
                incarnation
            } else {
                self.incarnation()
            };
            if !gateway {
                process.core.register(Arc::clone(&name), agent);
                process.agents.push((Arc::clone(&name), agent));
            }
            let role = if gateway { Role::Gateway } else { Role::Agent };
            self.names.insert(agent, Arc::clone(&name));
            let registered = Registered {
                name,
                incarnation: agent,
                host,
                mts: incarnation,
                role,
                known: Vec::new(),
                left: Vec::new(),
            };
            self.registry.lock().entries.push(registered);
        }
        self.processes.push(process);
        self.processes.len() - 1
    }

    pub(crate) fn run(&mut self) -> Result<(), Breach> {
        let end =
            self.start + Duration::from_millis(ACTIVE_MS) + DEADLINE + Duration::from_secs(20);
        while let Some(Reverse((at, number))) = self.events.pop() {
            if at > end {
                break;
            }
            self.now = at;
            self.registry.lock().now = Some(at);
            let Some(event) = self.due.remove(&number) else {
                continue;
            };
            self.happen(event)?;
        }
        self.check_end()?;
        self.check_watched()
    }

    fn happen(&mut self, event: Event) -> Result<(), Breach> {
        match event {
            Event::Send => self.send(),
            Event::Arrive {
                from,
                to,
                kind,
                attempt,
                parcel,
                mute,
                copy,
            } => self.arrive((from, to), kind, attempt, parcel, mute, copy),
            Event::Conclude {
                at,
                attempt,
                conclusion,
            } => {
                let now = self.clocks();
                let process = &mut self.processes[at];
                if process.alive && process.open.remove(&attempt).is_some() {
                    process.core.handle_conclusion(now, attempt, conclusion);
                    self.carry_out(at)?;
                }
                Ok(())
            }
            Event::Timer { at } => {
                let now = self.clocks();
                if self.processes[at].alive {
                    self.processes[at].wake = None;
                    self.processes[at].core.handle_timeout(now);
                    self.carry_out(at)?;
                }
                Ok(())
            }
            Event::Read { at, agent } => self.read(at, agent),
            Event::Deadline { number } => self.check_deadline(number),
            Event::Die => self.die(),
            Event::Forgotten { process } => {
                let mts = self.processes[process].incarnation;
                self.registry
                    .lock()
                    .entries
                    .retain(|entry| entry.mts != mts);
                self.directory_changed()
            }
            Event::Reborn { process } => {
                let (host, gateway) = (
                    self.processes[process].host,
                    self.processes[process].gateway,
                );
                let names: Vec<String> = if gateway {
                    vec![format!("gateway{host}")]
                } else {
                    self.processes[process]
                        .agents
                        .iter()
                        .map(|(n, _)| n.to_string())
                        .collect()
                };
                self.birth(host, gateway, &names);
                self.directory_changed()
            }
            Event::Move => self.leave(),
            Event::Settle { name } => self.settle(name),
            Event::News { host, departed } => self.news(host, &departed),
            Event::CutOff => {
                self.cut_off();
                Ok(())
            }
            Event::JoinedAgain { host } => {
                self.cut_off.remove(&host);
                Ok(())
            }
            Event::Outage { host, kind } => {
                self.down.insert((host, kind));
                self.after_ms(800, Event::OutageEnds { host, kind });
                Ok(())
            }
            Event::OutageEnds { host, kind } => {
                self.down.remove(&(host, kind));
                Ok(())
            }
        }
    }

    fn directory_changed(&mut self) -> Result<(), Breach> {
        let now = self.clocks();
        for at in 0..self.processes.len() {
            if self.processes[at].alive {
                self.processes[at].core.handle_directory_change(now);
                self.carry_out(at)?;
            }
        }
        Ok(())
    }

    fn send(&mut self) -> Result<(), Breach> {
        let living: Vec<usize> = (0..self.processes.len())
            .filter(|&at| self.processes[at].alive && !self.processes[at].gateway)
            .collect();
        let Some(&at) = self.random.choice(&living) else {
            return Ok(());
        };
        let agents = self.processes[at].agents.iter();
        let Some((name, sender)) = self.random.choice(agents).cloned() else {
            return Ok(());
        };
        let host = self.random.usize(..self.weather.hosts);
        // Few pairs and bursts: order is worth nothing if nobody sends twice.
        // Few patterns: to compile them takes longer than all the rest.
        let receiver = match self.random.u32(..30) {
            0 => format!("h{host}_.*"),
            1..=3 => "nobody".to_owned(),
            _ => format!("h{host}_p{}_{}", self.random.usize(..PROCESSES), 0),
        };
        for _ in 0..self.random.u32(1..6) {
            let number = self.sent.len() as u64 + 1;
            let message = Message::builder(Performative::Inform)
                .sender(AgentId::new(&*name).expect("a name"))
                .receiver(AgentId::new(&receiver).expect("a name"))
                .content(number.to_string())
                .build()
                .expect("a message");
            let letter = letter_for(&message, self.clocks().utc).expect("a letter");
            let submission = Submission {
                sender,
                letter,
                receivers: vec![receiver.as_str().into()],
                deadline: DEADLINE,
            };
            let now = self.clocks();
            let (send, expected) = self.processes[at].core.send(now, submission);
            self.sends.insert((at, send), number);
            let outcomes = BTreeMap::new();
            self.sent.insert(
                number,
                Sent {
                    process: at,
                    sender,
                    expected,
                    outcomes,
                },
            );
            self.at(self.now + DEADLINE + SLACK, Event::Deadline { number });
            self.carry_out(at)?;
        }
        Ok(())
    }

    /// Does what a core wants done.
    fn carry_out(&mut self, at: usize) -> Result<(), Breach> {
        while let Some(action) = self.processes[at].core.poll_action() {
            match action {
                Action::Dispatch {
                    attempt,
                    location,
                    parcel,
                } => {
                    self.dispatch(at, attempt, &location, parcel);
                }
                Action::Abandon { attempt, .. } => {
                    self.processes[at].open.remove(&attempt);
                }
                Action::Answer { ticket, answer, .. } => {
                    if let Some((sender, attempt)) = self.processes[at].tickets.remove(&ticket)
                        && !self.is_cut(at, sender)
                    {
                        let conclusion = Conclusion::Answered(answer);
                        self.after_ms(
                            2,
                            Event::Conclude {
                                at: sender,
                                attempt,
                                conclusion,
                            },
                        );
                    }
                }
                Action::Outcome {
                    send,
                    receiver,
                    outcome,
                } => {
                    let Some(number) = self.sends.get(&(at, send)) else {
                        return Err(format!("an outcome of a letter nobody sent: {outcome}"));
                    };
                    let sent = self.sent.get_mut(number).expect("it was sent");
                    if let Some(first) = sent.outcomes.insert(receiver, outcome.clone()) {
                        return Err(format!("letter {number}: {first}, then {outcome}"));
                    }
                }
                // Everybody knows everybody here.
                Action::Heard { .. } | Action::Doubtful { .. } => {}
                Action::Notice(notice) => {
                    let Now { instant, utc } = self.clocks();
                    let watching = &mut self.watching[self.processes[at].host];
                    watching.hear((instant, utc), at, &notice)?;
                }
                Action::Deliverable { agent } => {
                    if self.reading.insert(agent) {
                        self.after_ms(1 + self.weather.reading_pause_ms, Event::Read { at, agent });
                    }
                }
            }
        }
        let due = self.processes[at].core.poll_timeout();
        if let Some(due) = due
            && self.processes[at].wake.is_none_or(|wake| due < wake)
        {
            self.processes[at].wake = Some(due);
            self.at(due.max(self.now), Event::Timer { at });
        }
        Ok(())
    }

    fn read(&mut self, at: usize, agent: Incarnation) -> Result<(), Breach> {
        if !self.processes[at].alive {
            return Ok(());
        }
        // All at once when there is no pause to keep, so that queues do not fill in calm weather.
        let most = if self.weather.reading_pause_ms > 1 {
            1
        } else {
            usize::MAX
        };
        let mut read = 0;
        while read < most && self.take(at, agent)? {
            read += 1;
        }
        self.reading.remove(&agent);
        if self.processes[at].core.waiting(agent) > 0 {
            self.reading.insert(agent);
            self.after_ms(1 + self.weather.reading_pause_ms, Event::Read { at, agent });
        }
        self.carry_out(at)
    }

    fn take(&mut self, at: usize, agent: Incarnation) -> Result<bool, Breach> {
        let Some(received) = self.processes[at].core.take(agent) else {
            return Ok(false);
        };
        let message = Message::decode(received.letter.payload()).expect("a message");
        if *message.performative() == Performative::Failure {
            self.failures_told += 1;
            return Ok(true);
        }
        let content = message.content().expect("content");
        let number: u64 = std::str::from_utf8(content)
            .expect("text")
            .parse()
            .expect("a number");
        let taken = self.taken.entry(agent).or_default();
        let sender = self.sent[&number].sender;
        let earlier = taken
            .iter()
            .rev()
            .find(|other| self.sent[other].sender == sender);
        if earlier.is_some_and(|earlier| *earlier >= number) {
            return Err(format!(
                "letter {number} was taken after {earlier:?} of the same sender"
            ));
        }
        taken.push(number);
        let name = &self.names[&agent];
        let copies: usize = self
            .taken
            .iter()
            .filter(|(life, _)| self.names[life] == *name)
            .map(|(_, taken)| taken.iter().filter(|other| **other == number).count())
            .sum();
        if copies > 1 {
            return Err(format!(
                "letter {number} was taken {copies} times by {name}"
            ));
        }
        Ok(true)
    }

    /// A process dies: what it had is gone, what was under way to it breaks off, and after a
    /// moment the directory has noticed.
    fn die(&mut self) -> Result<(), Breach> {
        let living: Vec<usize> = (0..self.processes.len())
            .filter(|&at| self.processes[at].alive)
            .collect();
        let Some(&dead) = self.random.choice(&living) else {
            return Ok(());
        };
        // What lay in its queues had been delivered: that is where the promise ends.
        for (_, agent) in self.processes[dead].agents.clone() {
            while self.take(dead, agent)? {}
        }
        self.processes[dead].alive = false;
        for at in 0..self.processes.len() {
            let broken_off: Vec<AttemptId> = self.processes[at]
                .open
                .iter()
                .filter(|(_, to)| **to == dead)
                .map(|(attempt, _)| *attempt)
                .collect();
            for attempt in broken_off {
                let error = WayError::new(WayFault::Broken, "the process died");
                let conclusion = Conclusion::Unconfirmed(error);
                self.after_ms(
                    20,
                    Event::Conclude {
                        at,
                        attempt,
                        conclusion,
                    },
                );
            }
        }
        self.after_ms(200, Event::Forgotten { process: dead });
        if self.random.f64() < 0.8 {
            let delay = Duration::from_millis(self.random.u64(210..600));
            self.at(self.now + delay, Event::Reborn { process: dead });
        }
        Ok(())
    }
}
