//! A simulation of hosts, processes, links and time.

mod checks;
mod faults;
mod gates;
mod liar;
mod links;
mod moves;
mod repetitions;
mod traffic;
mod view;
mod watching;
mod weather;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap, HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_mts::core::{Action, Core, CoreConfig, Now, SubmissionId};
use fipa_sds::{Entry, Role};
use fipa_transport::counts::{Counts, SharedCounts};
use fipa_transport::{AttemptId, Conclusion, Incarnation, Kind, Ticket};
use parking_lot::Mutex;

use self::checks::{Breaches, Invariant};
use self::gates::{Denied, Refused, Rules};
use self::liar::Liars;
use self::links::{Flight, Flown, Link};
use self::repetitions::Repetitions;
use self::traffic::Sent;
use self::view::{Registered, Registry, View};
use self::watching::Watching;
pub(crate) use self::weather::{Deadlines, Weather};

const PROCESSES: usize = 3;
const AGENTS: usize = 2;
/// Minimum time during which letters are sent; they continue for a while after the simulation has
/// healed.
const ACTIVE_MS: u64 = 3000;
/// Timeout of an attempt.
const ATTEMPT_TIMEOUT: Duration = Duration::from_millis(300);

/// Maps with the same iteration order in every run.
type Map<K, V> = HashMap<K, V, foldhash::fast::FixedState>;
type Set<T> = HashSet<T, foldhash::fast::FixedState>;

/// An inconsistency that ends a run.
type Breach = String;

/// A process: robot process or gateway.
struct Process {
    host: usize,
    gateway: bool,
    /// Whether it is hostile; its core is not used then.
    hostile: bool,
    incarnation: Incarnation,
    core: Core,
    counts: Arc<Counts>,
    agents: Vec<(Arc<str>, Incarnation)>,
    /// Attempts without a conclusion; the death of their receiver breaks them off.
    open: BTreeMap<AttemptId, Flight>,
    /// Deferred arrivals: the process that waits for the answer, and its attempt.
    tickets: Map<Ticket, (usize, AttemptId)>,
    next_ticket: u64,
    alive: bool,
    /// Time since which it refuses to send, because its service has ended.
    closed: Option<Instant>,
    wake: Option<Instant>,
}

enum Event {
    Send,
    /// A hostile member sends a message.
    Lie,
    /// The next letter of a pair that sends without a pause.
    Stream {
        pair: usize,
    },
    Arrive(Box<Flown>),
    Conclude {
        at: usize,
        attempt: AttemptId,
        conclusion: Conclusion,
    },
    Timer {
        at: usize,
    },
    /// A refresh of a process's view of the directory ends.
    Refreshed {
        at: usize,
        number: u64,
        /// Time at which it began.
        began: Instant,
    },
    Read {
        at: usize,
        agent: Incarnation,
    },
    Deadline {
        number: u64,
    },
    /// The deadline for the delivery of this letter.
    Liveness {
        number: u64,
    },
    Die,
    Restart,
    GatewayDies,
    /// A process starts to close: a robot process, or a gateway.
    Close {
        gateway: bool,
    },
    /// A process that closed ends.
    Closed {
        process: usize,
    },
    Forgotten {
        process: usize,
        returns: bool,
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
    /// A change becomes known on a host, and to these processes as a departure.
    News {
        host: usize,
        departed: Vec<(usize, Arc<Entry>)>,
        ended: Vec<Incarnation>,
    },
    Readdress,
    CutOff,
    JoinedAgain {
        host: usize,
    },
    Stall,
    Outage,
    OutageEnds {
        host: usize,
        kind: Kind,
    },
}

/// Bytes received, and the steps of cores for them.
#[derive(Debug, Default)]
struct Work {
    bytes: u64,
    steps: u64,
    /// Maximum number of steps for one arrival.
    most: u64,
}

impl Work {
    #[cfg(debug_assertions)]
    fn count(&mut self, bytes: usize, steps: u64) {
        self.bytes += bytes as u64;
        self.steps += steps;
        self.most = self.most.max(steps);
    }
}

pub(crate) struct World {
    seed: u64,
    /// Faults until the simulation heals.
    forecast: Weather,
    /// Current faults.
    weather: Weather,
    random: fastrand::Rng,
    start: Instant,
    now: Instant,
    /// Time after which no fault begins.
    heals: Instant,
    /// Time at which the last fault that has begun is over.
    quiet: Instant,
    events: BinaryHeap<Reverse<(Instant, u64)>>,
    due: Map<u64, Event>,
    next_event: u64,
    registry: Arc<Mutex<Registry>>,
    processes: Vec<Process>,
    by_incarnation: Map<Incarnation, usize>,
    links: Map<(usize, usize, Kind), Link>,
    /// Attempts whose letter may arrive another time: it was accepted, or may have been.
    may_repeat: Set<(usize, AttemptId)>,
    down: Set<(usize, Kind)>,
    /// Disconnected hosts.
    cut_off: Set<usize>,
    /// End of the stall of TCP to and from a host.
    stalled: Map<usize, Instant>,
    denied: Vec<(usize, Denied)>,
    refused: Refused,
    /// Names of agents that send without a pause, and of their receivers.
    pairs: Vec<(Arc<str>, Arc<str>)>,
    sends: Map<(usize, SubmissionId), u64>,
    sent: BTreeMap<u64, Sent>,
    /// Letters without an outcome, by the sender's registration and the receiver's name.
    open: Map<(Incarnation, Arc<str>), BTreeSet<u64>>,
    /// Bytes of letters without an outcome.
    open_bytes: usize,
    /// Letters that a registration has accepted into its queue.
    accepted: Set<(Incarnation, u64)>,
    /// The registration of a name that has taken a letter.
    taken: Map<(Arc<str>, u64), Incarnation>,
    /// The last letter of each sender that a registration has taken.
    last_taken: Map<(Incarnation, Incarnation), u64>,
    names: Map<Incarnation, Arc<str>>,
    /// All registrations of honest agents.
    honest: Set<Incarnation>,
    liars: Option<Liars>,
    /// Received bytes, and the steps of cores for them.
    work: Work,
    repetitions: Repetitions,
    /// Gateways that have or had a connection with each other.
    met: Set<(usize, usize)>,
    /// Agents that are about to read.
    reading: Set<Incarnation>,
    failures_told: u64,
    /// Number of letters that another registration of their receiver took than the one that was
    /// current when they were sent.
    followed: u64,
    /// Number of letters whose receiver became known by a refresh.
    found: u64,
    /// Maximum delivery time of a letter sent after the faults.
    slowest: Duration,
    /// Number of letters that had to be delivered within the bound.
    bounded: u64,
    breaches: Breaches,
    /// Whether events are printed.
    traced: bool,
    /// Whether watchers are active: only in some runs, so that the others show that watching has no
    /// effect.
    watched: bool,
    /// The watchers, by host.
    watching: Vec<Watching>,
}

impl World {
    pub(crate) fn new(seed: u64, weather: Weather) -> Self {
        let start = Instant::now();
        let mut random = fastrand::Rng::with_seed(seed);
        let heals = start + Duration::from_millis(random.u64(ACTIVE_MS / 2..=ACTIVE_MS));
        let mut world = Self {
            seed,
            forecast: weather,
            weather,
            random,
            start,
            now: start,
            heals,
            quiet: heals,
            events: BinaryHeap::new(),
            due: Map::default(),
            next_event: 0,
            registry: Arc::default(),
            processes: Vec::new(),
            by_incarnation: Map::default(),
            links: Map::default(),
            may_repeat: Set::default(),
            down: Set::default(),
            cut_off: Set::default(),
            stalled: Map::default(),
            denied: Vec::new(),
            refused: Arc::default(),
            pairs: Vec::new(),
            sends: Map::default(),
            sent: BTreeMap::new(),
            open: Map::default(),
            open_bytes: 0,
            accepted: Set::default(),
            taken: Map::default(),
            last_taken: Map::default(),
            names: Map::default(),
            honest: Set::default(),
            liars: None,
            met: Set::default(),
            work: Work::default(),
            repetitions: Repetitions::default(),
            reading: Set::default(),
            failures_told: 0,
            followed: 0,
            found: 0,
            slowest: Duration::ZERO,
            bounded: 0,
            breaches: Breaches::new(),
            traced: std::env::var_os("FIPA_SIM_TRACE").is_some(),
            watched: seed.is_multiple_of(4),
            watching: (0..weather.hosts).map(|_| Watching::default()).collect(),
        };
        world.draw_denials();
        world.registry.lock().now = Some(start);
        for host in 0..weather.hosts {
            let known = vec![start; weather.hosts];
            world.birth(host, true, &[format!("gateway{host}")], &known);
            for process in 0..PROCESSES {
                let names: Vec<String> = (0..AGENTS)
                    .map(|agent| format!("h{host}_p{process}_{agent}"))
                    .collect();
                world.birth(host, false, &names, &known);
            }
        }
        if weather.liars {
            world.admit_liars();
        }
        world.plan_traffic();
        world.plan_faults();
        world
    }

    pub(crate) fn letters(&self) -> usize {
        self.sent.len()
    }

    pub(crate) fn followed(&self) -> u64 {
        self.followed
    }

    pub(crate) fn found(&self) -> u64 {
        self.found
    }

    /// Steps of cores per received byte, and maximum for one arrival.
    pub(crate) fn work(&self) -> (f64, u64) {
        let Work { bytes, steps, most } = self.work;
        (steps as f64 / bytes.max(1) as f64, most)
    }

    /// Number of letters for which the liveness bound was checked, and their maximum delivery time.
    pub(crate) fn liveness(&self) -> (u64, Duration) {
        (self.bounded, self.slowest)
    }

    fn incarnation(&mut self) -> Incarnation {
        Incarnation::from_u64(self.random.u64(1..))
    }

    fn at(&mut self, at: Instant, event: Event) -> u64 {
        self.next_event += 1;
        self.due.insert(self.next_event, event);
        self.events.push(Reverse((at, self.next_event)));
        self.next_event
    }

    fn after_ms(&mut self, most: u64, event: Event) -> Instant {
        let at = self.now + Duration::from_micros(self.random.u64(..=most * 1000));
        self.at(at, event);
        at
    }

    /// Extends the time of faults to then.
    fn fault_until(&mut self, end: Instant) {
        self.quiet = self.quiet.max(end);
    }

    /// Prints an event if tracing is on.
    fn trace(&self, text: impl FnOnce() -> String) {
        if self.traced {
            println!("{:?} {}", self.now - self.start, text());
        }
    }

    fn clocks(&self) -> Now {
        Now {
            instant: self.now,
            utc: SystemTime::UNIX_EPOCH + (self.now - self.start),
        }
    }

    fn birth(&mut self, host: usize, gateway: bool, names: &[String], known: &[Instant]) {
        let incarnation = self.incarnation();
        let name = if gateway {
            names[0].clone()
        } else {
            format!("mts{host}")
        };
        let config = CoreConfig {
            forwards: gateway,
            queue: self.weather.queue,
            window: 8,
            lane: self.weather.lane,
            queue_bytes: self.weather.queue_bytes,
            lane_bytes: self.weather.lane_bytes,
            custody_bytes: self.weather.custody_bytes,
            attempt_timeout: ATTEMPT_TIMEOUT,
            legacy_attempt_timeout: ATTEMPT_TIMEOUT,
            ..CoreConfig::new(name, incarnation, self.weather.order.to_vec())
        };
        let view = View {
            registry: Arc::clone(&self.registry),
            host,
            gateway,
            mts: incarnation,
        };
        let counts = Arc::new(Counts::default());
        let core = Core::new(config, Arc::new(view)).gated(Arc::new(self.rules(host, gateway)));
        let mut process = Process {
            host,
            gateway,
            hostile: false,
            incarnation,
            core: core.counting(Arc::clone(&counts) as SharedCounts),
            counts,
            agents: Vec::new(),
            open: BTreeMap::new(),
            tickets: Map::default(),
            next_ticket: 0,
            alive: true,
            closed: None,
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
                self.honest.insert(agent);
                process.core.register(Arc::clone(&name), agent);
                process.agents.push((Arc::clone(&name), agent));
            }
            let role = if gateway { Role::Gateway } else { Role::Agent };
            self.names.insert(agent, Arc::clone(&name));
            self.registry.lock().register(Registered {
                name,
                incarnation: agent,
                host,
                mts: incarnation,
                role,
                since: self.now,
                ended: None,
                known: known.to_vec(),
                left_at: Vec::new(),
            });
        }
        let at = self.processes.len();
        self.by_incarnation.insert(incarnation, at);
        self.processes.push(process);
    }

    /// The access rules of a process on this host.
    fn rules(&self, host: usize, gateway: bool) -> Rules {
        let w = self.weather;
        let (share, place) = match gateway {
            true => (w.refused_by_gateways, host as u64),
            false => (w.refused_by_receivers, 1000),
        };
        let denied = self.denied.iter().filter(|(at, _)| gateway && *at == host);
        Rules {
            seed: self.seed.wrapping_mul(4099).wrapping_add(place),
            share,
            denied: denied.map(|(_, denied)| denied.clone()).collect(),
            rate: (gateway && w.rate > 0.0).then_some((w.rate, self.heals)),
            strangers: w.reading_pause_ms == 1,
            taken: Mutex::default(),
            refused: Arc::clone(&self.refused),
        }
    }

    /// Runs until no event is left.
    ///
    /// # Errors
    /// Returns the first violation of each invariant.
    pub(crate) fn run(&mut self) -> Result<(), Breaches> {
        if let Err(breach) = self.play() {
            self.breach(Invariant::World, || breach);
        }
        match self.breaches.is_empty() {
            true => Ok(()),
            false => Err(std::mem::take(&mut self.breaches)),
        }
    }

    fn play(&mut self) -> Result<(), Breach> {
        let end = self.start + fipa_mts::core::MAX_DEADLINE + Duration::from_secs(60);
        while let Some(Reverse((at, number))) = self.events.pop() {
            if at > end {
                break;
            }
            let Some(event) = self.due.remove(&number) else {
                continue;
            };
            if self.now < self.heals && at >= self.heals {
                self.weather = self.weather.healed();
            }
            self.now = at;
            self.registry.lock().now = Some(at);
            self.happen(event)?;
        }
        self.check_end();
        self.check_watched()
    }

    fn happen(&mut self, event: Event) -> Result<(), Breach> {
        match event {
            Event::Send => self.send_burst(),
            Event::Lie => self.lie(),
            Event::Stream { pair } => self.send_on(pair),
            Event::Arrive(flown) => self.arrive(*flown),
            Event::Conclude {
                at,
                attempt,
                conclusion,
            } => {
                let now = self.clocks();
                let process = &mut self.processes[at];
                if process.alive && !process.hostile && process.open.remove(&attempt).is_some() {
                    self.trace(|| format!("{at} has {conclusion:?} of {attempt:?}"));
                    self.note_end(at, attempt, &conclusion);
                    let process = &mut self.processes[at];
                    process.core.handle_conclusion(now, attempt, conclusion);
                    self.carry_out(at)?;
                }
                Ok(())
            }
            Event::Timer { at } => {
                let now = self.clocks();
                let process = &mut self.processes[at];
                if process.alive && process.wake.is_some_and(|wake| wake <= now.instant) {
                    process.wake = None;
                    process.core.handle_timeout(now);
                    self.carry_out(at)?;
                }
                Ok(())
            }
            Event::Refreshed { at, number, began } => {
                if self.processes[at].alive {
                    self.refreshed(at, number, began);
                    self.carry_out(at)?;
                }
                Ok(())
            }
            Event::Read { at, agent } => self.read(at, agent),
            Event::Deadline { number } => {
                self.check_deadline(number);
                Ok(())
            }
            Event::Liveness { number } => {
                self.check_liveness(number);
                Ok(())
            }
            Event::Die => self.die(),
            Event::Restart => self.restart(),
            Event::GatewayDies => self.gateway_dies(),
            Event::Close { gateway } => self.close(gateway),
            Event::Closed { process } => self.closed(process),
            Event::Forgotten { process, returns } => self.forgotten(process, returns),
            Event::Reborn { process } => self.reborn(process),
            Event::Move => self.leave(),
            Event::Settle { name } => self.settle(name),
            Event::News {
                host,
                departed,
                ended,
            } => self.news(host, departed, &ended),
            Event::Readdress => self.readdress(),
            Event::CutOff => {
                self.cut_off();
                Ok(())
            }
            Event::JoinedAgain { host } => {
                self.cut_off.remove(&host);
                Ok(())
            }
            Event::Stall => {
                self.stall();
                Ok(())
            }
            Event::Outage => {
                self.outage();
                Ok(())
            }
            Event::OutageEnds { host, kind } => {
                self.down.remove(&(host, kind));
                Ok(())
            }
        }
    }

    /// Carries out the actions of a core.
    fn carry_out(&mut self, at: usize) -> Result<(), Breach> {
        while let Some(action) = self.processes[at].core.poll_action() {
            match action {
                Action::Dispatch {
                    attempt,
                    location,
                    parcel,
                } => self.dispatch(at, attempt, &location, parcel),
                Action::Abandon { attempt, error, .. } => self.abandon(at, attempt, error),
                Action::Answer { ticket, answer, .. } => self.answer(at, ticket, answer),
                Action::Outcome {
                    submission,
                    receiver,
                    outcome,
                } => self.outcome((at, submission), receiver, outcome)?,
                // Every process knows all others here.
                Action::ContactSeen { .. }
                | Action::ContactSeenAgain { .. }
                | Action::Taken { .. }
                | Action::Suspect { .. } => {}
                Action::Notice(notice) => {
                    let Now { instant, utc } = self.clocks();
                    let watching = &mut self.watching[self.processes[at].host];
                    watching.hear((instant, utc), at, &notice)?;
                }
                Action::Refresh { number } => {
                    let began = self.now;
                    match self.weather.refresh_ms {
                        0 => self.refreshed(at, number, began),
                        most => {
                            let refreshed = Event::Refreshed { at, number, began };
                            self.after_ms(most, refreshed);
                        }
                    }
                }
                Action::Resolved {
                    submission,
                    outcomes,
                } => self.resolved((at, submission), outcomes),
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

    /// Ends a refresh of a process's view, which shows the registrations on its host from before
    /// the refresh began.
    fn refreshed(&mut self, at: usize, number: u64, began: Instant) {
        self.trace(|| format!("{at} has refreshed its view, number {number}"));
        let now = self.clocks();
        let process = &mut self.processes[at];
        self.registry.lock().refreshed(process.incarnation, began);
        process.core.handle_refreshed(now, number);
    }

    fn robots(&self) -> impl Iterator<Item = usize> {
        let robot = |at: &usize| {
            let process = &self.processes[*at];
            process.alive && !process.gateway && !process.hostile
        };
        (0..self.processes.len()).filter(robot)
    }

    fn view(&self, at: usize) -> View {
        View {
            registry: Arc::clone(&self.registry),
            host: self.processes[at].host,
            gateway: self.processes[at].gateway,
            mts: self.processes[at].incarnation,
        }
    }
}
