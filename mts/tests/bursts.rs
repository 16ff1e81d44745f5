//! Many letters to agents of another host, on virtual time and without faults: outcomes follow the letters, and
//! the letters follow each other, whatever else uses the same routes.
//!
//! A process and a gateway on each of two hosts. Each hop has the window of its transport, and each process takes
//! time for each parcel.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap, HashMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission, SubmissionId};
use fipa_mts::{AccessGate, LetterParts, Link, letter_for};
use fipa_sds::{Directory, Entry, MemoryDirectory, MtsId, Reach, Registration, View};
use fipa_transport::{
    Arrival, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Kind, Location, Outcome,
    Parcel, Principal, Reaction, Ticket, TransportError, TransportErrorKind,
};

/// The services in the order of a letter's path.
const SENDER: usize = 0;
const RECEIVER: usize = 3;
const SERVICES: usize = 4;
/// Time from one service to the next.
const WITHIN_HOST: Duration = Duration::from_micros(20);
const BETWEEN_HOSTS: Duration = Duration::from_micros(500);
/// Time that a process takes for a parcel, or for the end of an attempt.
const WORK: Duration = Duration::from_micros(10);
/// Time from the arrival of a letter to its outcome on a path without load: each hop there and back, and the work.
const ROUND_TRIP: Duration = Duration::from_micros(2 * (20 + 500 + 20) + 20 * 10);
/// Time beyond it and beyond the queue.
const TIMEOUT: Duration = Duration::from_millis(20);
/// Maximum pause between two letters that are taken under steady load.
const LONGEST_GAP: Duration = Duration::from_millis(50);

/// The number of parcels of one sender without an answer: at which a letter is refused, at which another parcel
/// is, and at which answers do not wait.
fn window(kind: Kind) -> (usize, usize, usize) {
    match kind {
        Kind::Shm => (16, 20, 8),
        _ => (768, 1024, usize::MAX),
    }
}

fn service(at: usize) -> Incarnation {
    Incarnation::from_u64(100 + at as u64)
}

fn location(from: usize, to: usize) -> Location {
    let kind = kind(from, to);
    let address = match kind {
        Kind::Shm => service(to).to_string(),
        _ => format!("192.0.2.{to}:7100"),
    };
    let location = Location::new(kind, &address).unwrap();
    location.with_incarnation(service(to))
}

fn kind(from: usize, to: usize) -> Kind {
    match from.min(to) {
        1 => Kind::Tcp,
        _ => Kind::Shm,
    }
}

/// The directory as one service sees it.
struct Seen {
    directory: MemoryDirectory,
    reach: Reach,
}

impl Seen {
    fn show(&self, entry: &Entry) -> Arc<Entry> {
        let mut entry = entry.clone();
        if entry.name.starts_with("arm") {
            entry.reach = self.reach;
        } else {
            entry.reach = Reach::Remote {
                gateway: service(1),
            };
        }
        Arc::new(entry)
    }
}

impl View for Seen {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        self.directory.named(name).map(|it| self.show(&it))
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let entry = self.directory.registered(incarnation);
        entry.map(|it| self.show(&it))
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        self.directory
            .all()
            .iter()
            .map(|it| self.show(it))
            .collect()
    }
}

/// Refuses the letters that have a protocol.
struct Refusing;

impl AccessGate for Refusing {
    fn read(&self, letter: &Letter) -> LetterParts {
        let message = Message::decode(letter.payload()).unwrap();
        LetterParts {
            fault: message.protocol().map(str::to_owned),
            ..LetterParts::default()
        }
    }

    fn admits(&self, _: Instant, _: &str, parts: &LetterParts, _: Link) -> Result<(), String> {
        parts.fault.clone().map_or(Ok(()), Err)
    }
}

struct Service {
    core: Core,
    /// The attempts without a conclusion, with their target and whether they are letters.
    open: BTreeMap<AttemptId, (usize, bool)>,
    /// Arrivals without an answer, with their sender and attempt.
    tickets: HashMap<Ticket, (usize, AttemptId)>,
    next_ticket: u64,
    /// The time until which the process works.
    busy: Instant,
    wake: Option<Instant>,
}

/// The indices of two services.
#[derive(Debug, Clone, Copy)]
struct Ends {
    from: usize,
    to: usize,
}

#[derive(Debug)]
enum Event {
    Send {
        stream: usize,
        refused: bool,
    },
    Arrive {
        from: usize,
        to: usize,
        attempt: AttemptId,
        parcel: Box<Parcel>,
    },
    Conclude {
        at: usize,
        attempt: AttemptId,
        conclusion: Conclusion,
    },
    Timer {
        at: usize,
    },
}

struct Path {
    services: Vec<Service>,
    events: BinaryHeap<Reverse<(Instant, u64)>>,
    due: HashMap<u64, Event>,
    number: u64,
    start: Instant,
    now: Instant,
    /// The letters of each stream that were not taken yet, and the times at which letters were taken.
    queues: Vec<VecDeque<SubmissionId>>,
    taken: HashMap<SubmissionId, Instant>,
    gaps: Vec<(Option<Instant>, Duration)>,
    outcomes: Vec<(SubmissionId, Instant, Outcome)>,
    /// Parcels without room, by their sender.
    without_room: [usize; SERVICES],
}

fn rover() -> Incarnation {
    Incarnation::from_u64(1)
}

fn arm(stream: usize) -> Incarnation {
    Incarnation::from_u64(10 + stream as u64)
}

impl Path {
    fn new(streams: usize) -> Self {
        let start = Instant::now();
        let services = (0..SERVICES).map(|at| Self::service(at, streams, start));
        Self {
            services: services.collect(),
            events: BinaryHeap::new(),
            due: HashMap::new(),
            number: 0,
            start,
            now: start,
            queues: vec![VecDeque::new(); streams],
            taken: HashMap::new(),
            gaps: vec![(None, Duration::ZERO); streams],
            outcomes: Vec::new(),
            without_room: [0; SERVICES],
        }
    }

    fn service(at: usize, streams: usize, start: Instant) -> Service {
        let directory = MemoryDirectory::new(MtsId::new("mts", service(at)));
        for stream in 0..streams {
            let locations = match at {
                RECEIVER => Vec::new(),
                _ => vec![location(at, at + 1)],
            };
            let arm = Registration::new(format!("arm_{stream}"), arm(stream), locations);
            directory.register(arm).unwrap();
        }
        if at == RECEIVER - 1 {
            let rover = Registration::new("rover", rover(), vec![location(at, at - 1)]);
            directory.register(rover).unwrap();
        }
        let is_gateway = at != SENDER && at != RECEIVER;
        let config = CoreConfig {
            forwards: is_gateway,
            ..CoreConfig::new(format!("mts{at}"), service(at), vec![Kind::Shm, Kind::Tcp])
        };
        let reach = match at {
            0 | 1 => Reach::Remote {
                gateway: service(2),
            },
            _ => Reach::Local,
        };
        let mut core = Core::new(config, Arc::new(Seen { directory, reach }));
        match at {
            SENDER => core.register("rover".into(), rover()),
            RECEIVER => (0..streams)
                .for_each(|stream| core.register(format!("arm_{stream}").into(), arm(stream))),
            _ if at == RECEIVER - 1 => core = core.gated(Arc::new(Refusing)),
            _ => {}
        }
        Service {
            core,
            open: BTreeMap::new(),
            tickets: HashMap::new(),
            next_ticket: 0,
            busy: start,
            wake: None,
        }
    }

    fn at(&mut self, at: Instant, event: Event) {
        self.number += 1;
        self.due.insert(self.number, event);
        self.events.push(Reverse((at, self.number)));
    }

    fn send_at(&mut self, since: Duration, stream: usize, refused: bool) {
        self.at(self.start + since, Event::Send { stream, refused });
    }

    fn clocks(&self) -> Now {
        Now {
            instant: self.now,
            utc: SystemTime::UNIX_EPOCH + (self.now - self.start),
        }
    }

    /// Runs until nothing is left to do, at most a minute.
    fn run(&mut self) {
        while let Some(Reverse((at, number))) = self.events.pop() {
            assert!(
                at < self.start + Duration::from_secs(60),
                "the letters stand still"
            );
            let event = self.due.remove(&number).unwrap();
            let place = match &event {
                Event::Send { .. } => SENDER,
                Event::Arrive { to, .. } => *to,
                Event::Conclude { at, .. } | Event::Timer { at } => *at,
            };
            let busy = self.services[place].busy;
            if busy > at {
                // In the order of the events.
                self.due.insert(number, event);
                self.events.push(Reverse((busy, number)));
                continue;
            }
            self.now = at;
            if !matches!(event, Event::Timer { .. }) {
                self.services[place].busy = at + WORK;
            }
            self.happen(event);
        }
    }

    fn happen(&mut self, event: Event) {
        let now = self.clocks();
        match event {
            Event::Send { stream, refused } => self.send(stream, refused),
            Event::Arrive {
                from,
                to,
                attempt,
                parcel,
            } => self.arrive(Ends { from, to }, attempt, *parcel),
            Event::Conclude {
                at,
                attempt,
                conclusion,
            } => {
                if self.services[at].open.remove(&attempt).is_some() {
                    self.services[at]
                        .core
                        .handle_conclusion(now, attempt, conclusion);
                    self.carry_out(at);
                }
            }
            Event::Timer { at } => {
                if self.services[at].wake.is_some_and(|wake| wake <= self.now) {
                    self.services[at].wake = None;
                    self.services[at].core.handle_timeout(now);
                    self.carry_out(at);
                }
            }
        }
    }

    fn send(&mut self, stream: usize, refused: bool) {
        let name = format!("arm_{stream}");
        let mut message = Message::builder(Performative::Inform)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new(&*name).unwrap())
            .content("x".repeat(100));
        if refused {
            message = message.protocol("refused");
        }
        let now = self.clocks();
        let submission = Submission {
            sender: rover(),
            letter: letter_for(&message.build().unwrap(), now.utc).unwrap(),
            receivers: vec![name.into()],
            deadline: Duration::from_secs(30),
        };
        let (id, outcomes) = self.services[SENDER].core.submit(now, submission);
        assert_eq!(outcomes, Some(1));
        if !refused {
            self.queues[stream].push_back(id);
        }
        self.carry_out(SENDER);
    }

    fn arrive(&mut self, ends: Ends, attempt: AttemptId, parcel: Parcel) {
        let Ends { from, to } = ends;
        let kind = kind(from, to);
        let held = self.services[to].tickets.values();
        let held = held.filter(|(sender, _)| *sender == from).count();
        let is_gateway = to != SENDER && to != RECEIVER;
        let service = &mut self.services[to];
        service.next_ticket += 1;
        let ticket = Ticket(service.next_ticket);
        let arrival = Arrival {
            parcel,
            from: Hop {
                location: location(to, from),
                principal: match kind {
                    Kind::Shm => Principal::Host,
                    _ => Principal::Unproved,
                },
            },
            ticket: (is_gateway && held < window(kind).2).then_some(ticket),
        };
        let now = self.clocks();
        match self.services[to].core.handle_arrival(now, kind, arrival) {
            Reaction::Now(answer) => self.conclude(
                Ends { from: to, to: from },
                attempt,
                Conclusion::Answered(answer),
            ),
            Reaction::Later => {
                self.services[to].tickets.insert(ticket, (from, attempt));
            }
        }
        self.carry_out(to);
    }

    /// The end of an attempt travels back to its sender.
    fn conclude(&mut self, ends: Ends, attempt: AttemptId, conclusion: Conclusion) {
        let Ends { from, to } = ends;
        let at = self.now + travel(from, to);
        self.at(
            at,
            Event::Conclude {
                at: to,
                attempt,
                conclusion,
            },
        );
    }

    fn dispatch(&mut self, from: usize, attempt: AttemptId, to: &Location, parcel: Parcel) {
        let to = usize::try_from(to.incarnation().as_u64() - 100).unwrap();
        let is_letter = matches!(parcel.body, Body::Letter(_));
        let (letters, parcels, _) = window(kind(from, to));
        let open = self.services[from].open.values();
        let open = open.filter(|(other, _)| *other == to).count();
        self.services[from].open.insert(attempt, (to, is_letter));
        if open >= if is_letter { letters } else { parcels } {
            self.without_room[from] += 1;
            let full = TransportError::new(TransportErrorKind::Congested, "");
            self.services[from].open.remove(&attempt);
            let now = self.clocks();
            let core = &mut self.services[from].core;
            return core.handle_conclusion(now, attempt, Conclusion::NotSent(full));
        }
        let at = self.now + travel(from, to);
        let parcel = Box::new(parcel);
        self.at(
            at,
            Event::Arrive {
                from,
                to,
                attempt,
                parcel,
            },
        );
    }

    fn carry_out(&mut self, at: usize) {
        while let Some(action) = self.services[at].core.poll_action() {
            match action {
                Action::Dispatch {
                    attempt,
                    location,
                    parcel,
                } => {
                    self.dispatch(at, attempt, &location, parcel);
                }
                Action::Abandon { attempt, error, .. } => {
                    panic!("{at} gives up {attempt:?}: {error}");
                }
                Action::Answer { ticket, answer, .. } => {
                    let (from, attempt) = self.services[at].tickets.remove(&ticket).unwrap();
                    self.conclude(
                        Ends { from: at, to: from },
                        attempt,
                        Conclusion::Answered(answer),
                    );
                }
                Action::Outcome {
                    submission,
                    outcome,
                    ..
                } => {
                    self.outcomes.push((submission, self.now, outcome));
                }
                Action::Deliverable { agent } => self.read(agent),
                Action::Refresh { number } => {
                    let now = self.clocks();
                    self.services[at].core.handle_refreshed(now, number);
                }
                _ => {}
            }
        }
        let due = self.services[at].core.poll_timeout();
        if let Some(due) = due.filter(|due| self.services[at].wake.is_none_or(|wake| *due < wake)) {
            self.services[at].wake = Some(due);
            self.at(due.max(self.now), Event::Timer { at });
        }
    }

    fn read(&mut self, agent: Incarnation) {
        if agent == rover() {
            // A message about a letter that was refused.
            self.services[SENDER].core.take(agent);
            return;
        }
        let stream = usize::try_from(agent.as_u64() - 10).unwrap();
        assert!(self.services[RECEIVER].core.take(agent).is_some());
        let submission = self.queues[stream].pop_front().unwrap();
        self.taken.insert(submission, self.now);
        let (last, longest) = &mut self.gaps[stream];
        let gap = last.map_or(Duration::ZERO, |last| self.now - last);
        *longest = gap.max(*longest);
        *last = Some(self.now);
    }

    /// The longest time from the taking of a letter to its outcome.
    fn slowest_outcome(&self) -> Duration {
        let mut slowest = Duration::ZERO;
        for (submission, ended, outcome) in &self.outcomes {
            let Some(taken) = self.taken.get(submission) else {
                assert!(
                    matches!(
                        outcome,
                        Outcome::Failed {
                            reason: FailureReason::Refused,
                            ..
                        }
                    ),
                    "{outcome}"
                );
                continue;
            };
            assert!(matches!(outcome, Outcome::Delivered { .. }), "{outcome}");
            slowest = slowest.max(ended.saturating_duration_since(*taken));
        }
        slowest
    }
}

fn travel(from: usize, to: usize) -> Duration {
    match kind(from, to) {
        Kind::Tcp => BETWEEN_HOSTS,
        _ => WITHIN_HOST,
    }
}

/// Checks the outcomes of these letters, and that each follows its letter.
fn check(path: &Path, letters: u32, queue: Duration) {
    assert_eq!(path.outcomes.len(), letters as usize);
    let slowest = path.slowest_outcome();
    assert!(slowest <= ROUND_TRIP + queue + TIMEOUT, "{slowest:?}");
}

#[test]
fn outcomes_of_a_burst_follow_its_letters() {
    for (streams, letters) in [(1, 120), (1, 1000), (4, 2000), (10, 1200), (10, 5000)] {
        let mut path = Path::new(streams);
        for number in 0..letters {
            let stream = number as usize % streams;
            path.send_at(Duration::ZERO, stream, number % 600 == 599);
        }
        path.run();
        // The process of the sender takes them all before it handles the first outcome.
        check(&path, letters, WORK * letters);
        assert_eq!(streams > 1, path.without_room[SENDER] > 0);
        assert_eq!(streams > 1, path.without_room[SENDER + 1] > 0);
    }
}

/// The receiving gateway refuses some of the letters, and the letters behind them wait for the news.
#[test]
fn letters_under_steady_load_are_taken_without_pauses() {
    for (streams, refused, micros) in [(1, 600, 100), (1, 40, 100), (4, 40, 70), (10, 40, 50)] {
        let mut path = Path::new(streams);
        for number in 0..8000 {
            let at = Duration::from_micros(micros) * number;
            let stream = number as usize % streams;
            path.send_at(at, stream, number % refused == refused - 1);
        }
        path.run();
        check(&path, 8000, Duration::ZERO);
        let gap = path.gaps.iter().map(|(_, gap)| *gap).max();
        assert!(gap < Some(LONGEST_GAP), "{gap:?}");
    }
}
