//! Delivery cores of two honest hosts with lossless links between them, and two malicious services:
//! the gateway of another host (`LIAR`), and a process of the first host (`MOLE`). Malicious
//! services send parcels with any fields at any time.
//!
//! * No arrival makes a core panic or loop endlessly.
//! * Each letter of an honest agent has one outcome, by its deadline.
//! * The receiver of a *delivered* letter has taken it.
//! * Agents take the letters of honest agents once, and in order.
//! * Letters to the honest agents `arm` and `rover` are delivered if their deadline is long enough
//!   and no queue is full.
//! * A letter of an honest agent leaves each service at most 16 times and 4 times a second more, and
//!   its content is repeated at most 4 times and with 1 MiB a second more.
//!
//! The cores accept the stream sender that a process of the same user names. So letters of the
//! malicious process have no honest agent as the sender of their stream.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use fipa_acl::{AgentId, Envelope, Letter, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission, SubmissionId, Unframed};
use fipa_mts::letter_for;
use fipa_sds::{Directory, Entry, MtsId, Reach, Role, Source, Subscriber};
use fipa_transport::{
    Answer, Arrival, Attempt, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation,
    Introduction, Kind, LegacySource, Location, Mandate, Outcome, Parcel, Principal, Reaction,
    Report, Signature, Stream, Ticket, TransportError, TransportErrorKind,
};

use crate::input::Input;

const UNKNOWN: Incarnation = Incarnation::UNKNOWN;
/// Gateways of both honest hosts, and processes with honest agents.
const GATEWAY: Incarnation = Incarnation::from_u64(1);
const PROCESS: Incarnation = Incarnation::from_u64(2);
const FAR_GATEWAY: Incarnation = Incarnation::from_u64(3);
const FAR_PROCESS: Incarnation = Incarnation::from_u64(4);
/// A malicious gateway and a malicious process, each with an agent.
const LIAR: Incarnation = Incarnation::from_u64(5);
const MOLE: Incarnation = Incarnation::from_u64(6);
/// Agents of the honest processes. The agent `eye` reads only on some inputs.
const ARM: Incarnation = Incarnation::from_u64(11);
const EYE: Incarnation = Incarnation::from_u64(12);
const ROVER: Incarnation = Incarnation::from_u64(13);
const LIAR_AGENT: Incarnation = Incarnation::from_u64(14);
const MOLE_AGENT: Incarnation = Incarnation::from_u64(15);
const STRANGER: Incarnation = Incarnation::from_u64(99);

const SERVICES: [Incarnation; 4] = [GATEWAY, PROCESS, FAR_GATEWAY, FAR_PROCESS];
/// Incarnations that malicious services use.
const NAMED: [Incarnation; 13] = [
    ARM,
    ROVER,
    EYE,
    LIAR_AGENT,
    MOLE_AGENT,
    GATEWAY,
    PROCESS,
    FAR_GATEWAY,
    FAR_PROCESS,
    LIAR,
    MOLE,
    STRANGER,
    UNKNOWN,
];
const NAMES: [&str; 9] = [
    "arm", "rover", "eye", "liar", "mole", "gw", "far-gw", "nobody", "",
];

/// Transit time of parcels and answers.
const DELAY: Duration = Duration::from_millis(1);
/// Minimum deadline with which a letter is delivered despite the malicious services.
const ENOUGH: Duration = Duration::from_secs(8);
/// Maximum number of events of the honest services for one input.
const MOST_EVENTS: usize = 60_000;

/// The directory of one service.
struct View(Vec<Arc<Entry>>);

impl Directory for View {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        self.0.iter().find(|it| &*it.name == name).cloned()
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let mut all = self.0.iter();
        all.find(|it| incarnation.is_known() && it.incarnation == incarnation)
            .cloned()
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        self.0.iter().cloned().collect()
    }

    fn generation(&self) -> u64 {
        0
    }

    fn subscribe(&self, _: &Subscriber) {}
}

fn at(service: Incarnation, kind: Kind) -> Location {
    let address = match kind {
        Kind::Shm => format!("{service}"),
        _ => format!("192.0.2.{}:1", service.as_u64() % 250),
    };
    let location = Location::new(kind, &address).expect("an address");
    location.with_incarnation(service)
}

/// Returns the directory of an honest service.
fn view(of: Incarnation) -> View {
    let near = [GATEWAY, PROCESS].contains(&of);
    let is_gateway = [GATEWAY, FAR_GATEWAY].contains(&of);
    let own_gateway = if near { GATEWAY } else { FAR_GATEWAY };
    let agents = [
        ("arm", ARM, PROCESS, GATEWAY),
        ("eye", EYE, PROCESS, GATEWAY),
        ("rover", ROVER, FAR_PROCESS, FAR_GATEWAY),
        ("mole", MOLE_AGENT, MOLE, GATEWAY),
        ("liar", LIAR_AGENT, LIAR, LIAR),
    ];
    let entries = agents.map(|(name, incarnation, mts, gateway)| {
        let here = gateway == own_gateway;
        let (reach, location) = match (here, is_gateway) {
            (true, _) => (Reach::Local, at(mts, Kind::Shm)),
            (false, true) => (Reach::Remote { gateway }, at(gateway, Kind::Tcp)),
            (false, false) => (
                Reach::Remote {
                    gateway: own_gateway,
                },
                at(own_gateway, Kind::Shm),
            ),
        };
        Arc::new(Entry {
            name: name.into(),
            agent_type: String::new(),
            incarnation,
            locations: vec![location],
            mts: MtsId::new("mts", mts),
            description: String::new(),
            registered: SystemTime::UNIX_EPOCH,
            source: Source::Host,
            reach,
            peer: fipa_transport::PeerId::THIS_HOST,
            role: Role::Agent,
        })
    });
    View(entries.into())
}

struct Service {
    core: Core,
    /// Attempts without a conclusion.
    open: BTreeMap<AttemptId, Location>,
    /// Services and attempts of the arrivals whose answer is pending.
    tickets: BTreeMap<u64, (Incarnation, AttemptId)>,
}

/// An event for an honest service.
enum Coming {
    Parcel {
        from: Incarnation,
        kind: Kind,
        attempt: AttemptId,
        parcel: Box<Parcel>,
    },
    Conclusion(AttemptId, Conclusion),
}

struct Sent {
    sender: Incarnation,
    receiver: Incarnation,
    deadline: Instant,
    /// Whether the letter has to be delivered.
    must: bool,
    outcome: Option<Outcome>,
    taken: bool,
}

/// A way in which the malicious services answer every letter.
#[derive(Clone, Copy)]
enum Habit {
    /// No way: the input decides about each answer.
    None,
    Returned,
    OutOfOrder,
    BusyAndCredit,
    CustodyAndReturned,
    CustodyAndDenied,
    Broken,
    /// Each letter in another way.
    Mixed,
}

const HABITS: [Habit; 8] = [
    Habit::None,
    Habit::Returned,
    Habit::OutOfOrder,
    Habit::BusyAndCredit,
    Habit::CustodyAndReturned,
    Habit::CustodyAndDenied,
    Habit::Broken,
    Habit::Mixed,
];

/// A letter at a service: the service, the stream's sender, and the sequence.
type Copies = (Incarnation, Incarnation, u64);

/// The number of times that a letter left a service.
struct Repetitions {
    first: Instant,
    count: u32,
}

struct World {
    now: Instant,
    habit: Habit,
    repetitions: BTreeMap<Copies, Repetitions>,
    /// Attempts with a letter.
    letters: BTreeMap<(Incarnation, AttemptId), Copies>,
    services: BTreeMap<Incarnation, Service>,
    coming: VecDeque<(Instant, Incarnation, Coming)>,
    /// Attempts of honest services at malicious ones. The input decides about the answers.
    held: Vec<(Incarnation, AttemptId, Parcel)>,
    sends: BTreeMap<(Incarnation, SubmissionId), u64>,
    sent: Vec<Sent>,
    last_taken: BTreeMap<(Incarnation, Incarnation), u64>,
    /// Introductions of the malicious gateway that [`part`](Self::part) can revoke.
    introduced: Vec<(Incarnation, Introduction)>,
    next_ticket: u64,
    events: usize,
}

fn certificate(service: Incarnation) -> Principal {
    Principal::Certificate([service.as_u64() as u8; 32])
}

/// Returns the link of an honest service or of the malicious process.
fn hop(from: Incarnation, kind: Kind) -> Hop {
    Hop {
        location: at(from, kind),
        principal: match kind {
            Kind::Shm => Principal::Host,
            _ => certificate(from),
        },
    }
}

fn letter(sender: &str, receiver: &str, number: u64) -> Letter {
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new(sender).expect("a name"))
        .receiver(AgentId::new(receiver).expect("a name"))
        .content(number.to_le_bytes().to_vec())
        .build()
        .expect("a message");
    letter_for(&message, SystemTime::UNIX_EPOCH).expect("a letter")
}

fn number_of(letter: &Letter) -> Option<u64> {
    let message = Message::decode(letter.payload()).ok()?;
    let content: [u8; 8] = message.content()?.as_ref().try_into().ok()?;
    Some(u64::from_le_bytes(content))
}

/// Streams of the malicious gateway in which letters fail between others, so that a mutation of one
/// number makes a false predecessor of a letter that failed.
#[must_use]
pub fn seeds() -> Vec<Vec<u8>> {
    // The positions of the names and registrations in `NAMES` and `NAMED` agree for these.
    let (arm, rover, liar) = (0, 1, 3);
    // A letter that the malicious gateway sends with its certificate; see `lie`.
    let letter = |to_far: bool, sequence, after, time| {
        let receiver = if to_far { rover } else { arm };
        let how = if to_far { 6 } else { 4 };
        let header = [4, how, 6, liar, receiver, liar, receiver, receiver];
        [&header[..], &[sequence, after, sequence, time]].concat()
    };
    let (at_once, later) = (0, 200);
    let pass = vec![2, 20];
    let mut seeds = Vec::new();
    for to_far in [false, true] {
        let letter = |sequence, after, time| letter(to_far, sequence, after, time);
        // Its first letter fails, and the later ones come after letters that failed.
        seeds.push([letter(1, 0, at_once), letter(2, 0, later)].concat());
        seeds.push(
            [
                letter(1, 0, at_once),
                letter(2, 1, at_once),
                letter(3, 2, later),
            ]
            .concat(),
        );
        seeds.push([letter(2, 1, at_once), pass.clone(), letter(1, 0, later)].concat());
        seeds.push(
            [
                letter(1, 0, later),
                letter(3, 2, at_once),
                letter(2, 1, later),
            ]
            .concat(),
        );
    }
    // A letter of an agent of each host to the malicious gateway, which has a habit meanwhile.
    for habit in 0..HABITS.len() as u8 {
        for from in [0, 1] {
            let send = [0, from, 3, 200];
            seeds.push([&[10, 192 + habit][..], &send, &pass, &pass].concat());
        }
    }
    seeds
}

/// Runs the actions that the bytes encode, then lets every deadline pass.
pub fn play(bytes: &[u8]) {
    let mut input = Input(bytes);
    let mut world = World::new();
    while !input.is_empty() && world.events < MOST_EVENTS / 2 {
        world.act(&mut input);
        world.settle();
    }
    world.finish();
}

impl World {
    fn new() -> Self {
        let now = Instant::now();
        let mut world = Self {
            now,
            habit: Habit::None,
            repetitions: BTreeMap::new(),
            letters: BTreeMap::new(),
            services: BTreeMap::new(),
            coming: VecDeque::new(),
            held: Vec::new(),
            sends: BTreeMap::new(),
            sent: Vec::new(),
            last_taken: BTreeMap::new(),
            introduced: Vec::new(),
            next_ticket: 0,
            events: 0,
        };
        for service in SERVICES {
            let forwards = [GATEWAY, FAR_GATEWAY].contains(&service);
            let config = CoreConfig {
                forwards,
                queue: 16,
                window: 4,
                lane: 64,
                ..CoreConfig::new(
                    format!("mts-{service}"),
                    service,
                    vec![Kind::Shm, Kind::Tcp],
                )
            };
            let mut core = Core::new(config, Arc::new(view(service)));
            let agents: &[(&str, Incarnation)] = match service {
                PROCESS => &[("arm", ARM), ("eye", EYE)],
                FAR_PROCESS => &[("rover", ROVER)],
                GATEWAY => &[("gw", GATEWAY)],
                _ => &[("far-gw", FAR_GATEWAY)],
            };
            for (name, agent) in agents {
                core.register((*name).into(), *agent);
            }
            let service_of = Service {
                core,
                open: BTreeMap::new(),
                tickets: BTreeMap::new(),
            };
            world.services.insert(service, service_of);
        }
        for (gateway, other) in [(GATEWAY, FAR_GATEWAY), (FAR_GATEWAY, GATEWAY)] {
            for peer in [other, LIAR] {
                let introduction = Introduction {
                    name: format!("mts-{peer}").into(),
                    hop: hop(peer, Kind::Tcp),
                    dialed: None,
                    mandate: Mandate::Unproved,
                };
                let clocks = world.clocks();
                let core = &mut world.service(gateway).core;
                core.handle_introduced(clocks, &introduction);
            }
        }
        world
    }

    fn clocks(&self) -> Now {
        Now {
            instant: self.now,
            utc: SystemTime::UNIX_EPOCH,
        }
    }

    fn service(&mut self, service: Incarnation) -> &mut Service {
        self.services.get_mut(&service).expect("an honest service")
    }

    fn act(&mut self, input: &mut Input<'_>) {
        match input.byte() % 16 {
            0 | 1 => self.send(input),
            2 | 3 => {
                let ms = u64::from(input.byte());
                self.pass(Duration::from_millis(ms * ms / 8));
            }
            4..=9 => self.lie(input),
            10 => self.answer_falsely(input),
            11 => self.introduce(input),
            12 => self.part(input),
            13 => self.legacy(input),
            14 => self.read(PROCESS, EYE),
            _ => {
                let at = input.one_of(&SERVICES);
                let service = input.one_of(&NAMED);
                let now = self.clocks();
                let core = &mut self.service(at).core;
                match input.below(3) {
                    0 => core.handle_directory_change(now),
                    1 => core.handle_reachable(now, None),
                    _ => core.handle_reachable(now, Some(service)),
                }
            }
        }
    }

    /// Sends a letter from an honest agent.
    fn send(&mut self, input: &mut Input<'_>) {
        let (at, name, sender) = input.one_of(&[
            (PROCESS, "arm", ARM),
            (FAR_PROCESS, "rover", ROVER),
            (PROCESS, "eye", EYE),
        ]);
        let (to, receiver) = input.one_of(&[
            ("rover", ROVER),
            ("arm", ARM),
            ("eye", EYE),
            ("liar", LIAR_AGENT),
            ("mole", MOLE_AGENT),
        ]);
        let deadline = input.time().min(Duration::from_secs(60));
        let now = self.clocks();
        let number = self.sent.len() as u64;
        let submission = Submission {
            sender,
            letter: letter(name, to, number),
            receivers: vec![to.into()],
            deadline,
        };
        let honest = [ARM, ROVER].contains(&receiver);
        let (submission, count) = self.service(at).core.submit(now, submission);
        // The view does not change, so a refresh adds nothing.
        assert!(count.is_none_or(|count| count == 1));
        self.sends.insert((at, submission), number);
        self.sent.push(Sent {
            sender,
            receiver,
            deadline: now.instant + deadline,
            must: honest && deadline >= ENOUGH,
            outcome: None,
            taken: false,
        });
    }

    /// Sends a parcel from a malicious service.
    fn lie(&mut self, input: &mut Input<'_>) {
        let how = input.byte();
        let is_mole = how & 1 == 1;
        let at = match (is_mole, how & 2) {
            (true, 0) => PROCESS,
            (false, 0) | (true, _) => GATEWAY,
            (false, _) => FAR_GATEWAY,
        };
        let (from, via) = match is_mole {
            true => (hop(MOLE, Kind::Shm), Kind::Shm),
            false => (self.lying_hop(how >> 2, input), Kind::Tcp),
        };
        let body = match input.below(8) {
            0 => Body::Credit,
            1 => Body::Predecessor,
            2..=4 => Body::Report(match input.below(8) {
                0 => Report::Returned { uncertain: false },
                1 => Report::Returned { uncertain: true },
                2 => Report::Moved,
                _ => Report::Settled(lying_outcome(input)),
            }),
            5 => {
                let envelope = Bytes::copy_from_slice(input.bytes(200));
                let payload = Bytes::copy_from_slice(input.bytes(200));
                Body::Letter(Letter::new(envelope, payload))
            }
            _ => {
                let (sender, receiver) = (input.one_of(&NAMES[..6]), input.one_of(&NAMES[..6]));
                Body::Letter(letter(sender, receiver, u64::MAX))
            }
        };
        let mut stream = Stream::between(input.one_of(&NAMED), input.one_of(&NAMED));
        if is_mole && matches!(body, Body::Letter(_)) {
            stream.sender = input.one_of(&[MOLE_AGENT, MOLE, UNKNOWN, STRANGER]);
        }
        let parcel = Parcel {
            receiver: input.one_of(&NAMES).into(),
            stream,
            sequence: input.number(),
            after: input.number(),
            transfer: input.number(),
            remaining: input.time(),
            body,
        };
        self.next_ticket += 1;
        let at_once = via == Kind::Shm && self.next_ticket.is_multiple_of(2);
        let ticket = (!at_once).then_some(Ticket(self.next_ticket));
        let arrival = Arrival {
            parcel,
            from,
            ticket,
        };
        let now = self.clocks();
        let core = &mut self.service(at).core;
        let verdict = core.handle_arrival(now, via, arrival);
        assert!(!at_once || verdict != Reaction::Later);
        self.carry_out(at);
    }

    /// Returns a link of the malicious gateway: with or without its certificate, with its own or
    /// another incarnation.
    fn lying_hop(&mut self, how: u8, input: &mut Input<'_>) -> Hop {
        let named = match how & 3 {
            0 => input.one_of(&NAMED),
            _ => LIAR,
        };
        let principal = match how & 4 {
            0 => certificate(LIAR),
            _ => Principal::Unproved,
        };
        let location = match how & 8 {
            0 => at(named, Kind::Tcp),
            _ => at(named, input.one_of(&[Kind::Udp, Kind::Quic, Kind::Tcp])),
        };
        Hop {
            location,
            principal,
        }
    }

    /// Answers a letter of an honest service to a malicious one out of habit.
    fn answer_out_of_habit(
        &mut self,
        at: Incarnation,
        attempt: AttemptId,
        to: Hop,
        parcel: Parcel,
    ) {
        let which = match self.habit {
            Habit::Mixed => HABITS[1 + parcel.transfer as usize % (HABITS.len() - 2)],
            habit => habit,
        };
        let is_letter = matches!(parcel.body, Body::Letter(_));
        let returned = Answer::Returned { uncertain: false };
        let answered = Conclusion::Answered;
        let (conclusion, note) = match which {
            Habit::None | Habit::Mixed => return self.held.push((at, attempt, parcel)),
            _ if !is_letter => (answered(returned), None),
            Habit::Returned => (answered(returned), None),
            Habit::OutOfOrder => {
                let last = parcel.after;
                (answered(Answer::OutOfOrder { last }), None)
            }
            Habit::BusyAndCredit => (answered(Answer::Busy), Some(Body::Credit)),
            Habit::CustodyAndReturned => {
                let report = Report::Returned { uncertain: false };
                (answered(Answer::Custody), Some(Body::Report(report)))
            }
            Habit::CustodyAndDenied => (answered(Answer::Custody), None),
            Habit::Broken => {
                let error = TransportError::new(TransportErrorKind::Broken, "");
                (Conclusion::Unconfirmed(error), None)
            }
        };
        let conclusion = Coming::Conclusion(attempt, conclusion);
        self.coming.push_back((self.now + DELAY, at, conclusion));
        if let Some(body) = note {
            let note = Coming::Parcel {
                from: to.location.incarnation(),
                kind: to.location.kind(),
                attempt: AttemptId(u64::MAX),
                parcel: Box::new(Parcel { body, ..parcel }),
            };
            self.coming.push_back((self.now + DELAY, at, note));
        }
    }

    /// Records that a letter leaves a service.
    fn check_repetitions(&mut self, at: Incarnation, attempt: AttemptId, parcel: &Parcel) {
        let (Body::Letter(letter), true) = (
            &parcel.body,
            [ARM, EYE, ROVER].contains(&parcel.stream.sender),
        ) else {
            return;
        };
        let first = Repetitions {
            first: self.now,
            count: 0,
        };
        let key = (at, parcel.stream.sender, parcel.sequence);
        self.letters.insert((at, attempt), key);
        let repetitions = self.repetitions.entry(key).or_insert(first);
        repetitions.count += 1;
        let (count, len) = (f64::from(repetitions.count), letter.len() as f64);
        let seconds = (self.now - repetitions.first).as_secs_f64();
        assert!(
            count <= 16.0 + 4.0 * seconds
                && (count - 1.0) * len <= 4.0 * len + (1 << 20) as f64 * seconds,
            "a letter of {len} bytes leaves {at} {count} times within {seconds} s"
        );
    }

    /// Answers a parcel of an honest service from a malicious one, or begins to answer all letters alike.
    fn answer_falsely(&mut self, input: &mut Input<'_>) {
        let how = input.byte();
        if how >= 192 {
            self.habit = HABITS[usize::from(how) % HABITS.len()];
            for (at, attempt, parcel) in std::mem::take(&mut self.held) {
                let to = self.service(at).open.get(&attempt).cloned();
                if let Some(to) = to.map(|to| hop(to.incarnation(), to.kind())) {
                    self.answer_out_of_habit(at, attempt, to, parcel);
                }
            }
            return;
        }
        if self.held.is_empty() {
            return;
        }
        let which = usize::from(how) % self.held.len();
        let (at, attempt, parcel) = self.held.swap_remove(which);
        let conclusion = match input.below(10) {
            0 => Conclusion::Answered(Answer::Accepted),
            1 => Conclusion::Answered(Answer::Custody),
            2 => Conclusion::Answered(Answer::Busy),
            3 => Conclusion::Answered(Answer::OutOfOrder {
                last: input.number(),
            }),
            4 => Conclusion::Answered(Answer::Returned {
                uncertain: input.byte() & 1 == 1,
            }),
            5 => Conclusion::Answered(Answer::Moved),
            6 => {
                let detail = String::from_utf8_lossy(input.bytes(40));
                Conclusion::Answered(Answer::failed(reason(input), detail))
            }
            7 => Conclusion::NotSent(way_error(input)),
            8 => Conclusion::Unconfirmed(way_error(input)),
            _ => {
                // The malicious gateway forwards the parcel to an honest gateway.
                self.held.push((at, attempt, parcel.clone()));
                let arrival = Arrival {
                    parcel,
                    from: hop(LIAR, Kind::Tcp),
                    ticket: Some(Ticket(u64::MAX)),
                };
                let now = self.clocks();
                let to = input.one_of(&[GATEWAY, FAR_GATEWAY]);
                let core = &mut self.service(to).core;
                core.handle_arrival(now, Kind::Tcp, arrival);
                return self.carry_out(to);
            }
        };
        self.conclude(at, attempt, conclusion);
    }

    fn introduce(&mut self, input: &mut Input<'_>) {
        let at = input.one_of(&[GATEWAY, FAR_GATEWAY]);
        let how = input.byte();
        let introduction = Introduction {
            name: input.one_of(&["mts-3", "mts-1", "liar", "gw"]).into(),
            hop: self.lying_hop(how, input),
            dialed: None,
            mandate: Mandate::Unproved,
        };
        let now = self.clocks();
        self.service(at).core.handle_introduced(now, &introduction);
        self.introduced.push((at, introduction));
        self.carry_out(at);
    }

    fn part(&mut self, input: &mut Input<'_>) {
        if self.introduced.is_empty() {
            return;
        }
        let which = input.below(self.introduced.len().min(256));
        let (at, introduction) = self.introduced.swap_remove(which);
        let now = self.clocks();
        self.service(at)
            .core
            .handle_disconnected(now, &introduction);
        self.carry_out(at);
    }

    /// Delivers a letter without a parcel from a legacy peer.
    fn legacy(&mut self, input: &mut Input<'_>) {
        let at = input.one_of(&[GATEWAY, FAR_GATEWAY, PROCESS]);
        let signature = input.one_of(&[Signature::FipaServices, Signature::JadeProxy]);
        let source = LegacySource {
            address: [192, 0, 2, input.byte() % 4].into(),
            signature,
        };
        let letter = match input.below(3) {
            0 => Letter::new(
                Bytes::copy_from_slice(input.bytes(255)),
                Bytes::copy_from_slice(input.bytes(255)),
            ),
            1 => letter(
                input.one_of(&NAMES[..6]),
                input.one_of(&NAMES[..6]),
                u64::MAX,
            ),
            _ => {
                let mut envelope = Envelope::default();
                let count = input.below(80);
                for _ in 0..count {
                    let name = String::from_utf8_lossy(input.bytes(12)).into_owned();
                    if let Ok(name) = AgentId::new(&*name) {
                        envelope.base.to.push(name);
                    }
                }
                let inner = letter("liar", "arm", u64::MAX);
                match envelope.encode(
                    fipa_acl::Representation::BitEfficient,
                    fipa_acl::Dialect::Standard,
                ) {
                    Ok(envelope) => Letter::new(envelope, inner.payload().clone()),
                    Err(_) => inner,
                }
            }
        };
        let now = self.clocks();
        let core = &mut self.service(at).core;
        let view = Arc::clone(core.view());
        let Ok(mut unframed) = Unframed::read(letter, Kind::Tcp, source, &*view) else {
            return;
        };
        while !unframed.is_handled() {
            let core = &mut self.service(at).core;
            core.handle_unframed(now, Duration::from_secs(5), &mut unframed);
            self.carry_out(at);
        }
    }

    /// Carries out the actions of a service's core.
    fn carry_out(&mut self, at: Incarnation) {
        while let Some(action) = self.service(at).core.poll_action() {
            self.events += 1;
            assert!(
                self.events < MOST_EVENTS,
                "one input causes too many events"
            );
            match action {
                Action::Dispatch {
                    attempt,
                    location,
                    parcel,
                } => {
                    let to = location.incarnation();
                    self.service(at).open.insert(attempt, location.clone());
                    self.check_repetitions(at, attempt, &parcel);
                    if SERVICES.contains(&to) {
                        let parcel = Coming::Parcel {
                            from: at,
                            kind: location.kind(),
                            attempt,
                            parcel: Box::new(parcel),
                        };
                        self.coming.push_back((self.now + DELAY, to, parcel));
                    } else if [LIAR, MOLE].contains(&to) {
                        let to = hop(to, location.kind());
                        self.answer_out_of_habit(at, attempt, to, parcel);
                    } else {
                        let error = TransportError::new(TransportErrorKind::Unreachable, "");
                        let conclusion = Coming::Conclusion(attempt, Conclusion::NotSent(error));
                        self.coming.push_back((self.now + DELAY, at, conclusion));
                    }
                }
                Action::Abandon { attempt, error, .. } => {
                    self.conclude(at, attempt, Conclusion::Unconfirmed(error));
                }
                Action::Answer { ticket, answer, .. } => {
                    if let Some((to, attempt)) = self.service(at).tickets.remove(&ticket.0) {
                        let answer = Conclusion::Answered(answer);
                        let coming = Coming::Conclusion(attempt, answer);
                        self.coming.push_back((self.now + DELAY, to, coming));
                    }
                }
                Action::Outcome {
                    submission,
                    outcome,
                    ..
                } => {
                    if let Some(number) = self.sends.get(&(at, submission)) {
                        let sent = &mut self.sent[*number as usize];
                        assert!(sent.outcome.is_none(), "a second outcome: {outcome:?}");
                        sent.outcome = Some(outcome);
                    }
                }
                Action::Deliverable { agent } if agent == EYE => {}
                Action::Deliverable { agent } => self.read(at, agent),
                Action::Refresh { number } => {
                    let now = self.clocks();
                    self.service(at).core.handle_refreshed(now, number);
                }
                Action::Resolved { outcomes, .. } => assert_eq!(outcomes, 1),
                Action::ContactSeen { .. }
                | Action::ContactSeenAgain { .. }
                | Action::Taken { .. }
                | Action::Suspect { .. }
                | Action::Notice(_) => {}
            }
        }
    }

    fn conclude(&mut self, at: Incarnation, attempt: AttemptId, conclusion: Conclusion) {
        let now = self.clocks();
        let letter = self.letters.remove(&(at, attempt));
        if matches!(conclusion, Conclusion::NotSent(_))
            && let Some(repetitions) = letter.and_then(|key| self.repetitions.get_mut(&key))
        {
            repetitions.count -= 1;
        }
        let service = self.service(at);
        if service.open.remove(&attempt).is_some() {
            service.core.handle_conclusion(now, attempt, conclusion);
        }
        self.held
            .retain(|(other, held, _)| (*other, *held) != (at, attempt));
        self.carry_out(at);
    }

    fn read(&mut self, at: Incarnation, agent: Incarnation) {
        while let Some(received) = self.service(at).core.take(agent) {
            let number = match number_of(&received.letter) {
                Some(number) if received.via.is_some() => number,
                _ => continue,
            };
            let Some(sent) = self.sent.get_mut(number as usize) else {
                continue;
            };
            assert_eq!(
                sent.receiver, agent,
                "letter {number} is not for this agent"
            );
            assert!(!sent.taken, "letter {number} is taken twice");
            sent.taken = true;
            let last = self.last_taken.entry((sent.sender, agent)).or_default();
            assert!(number >= *last, "letter {number} is taken after {last}");
            *last = number;
        }
        self.carry_out(at);
    }

    /// Processes all events and timeouts that are due.
    fn settle(&mut self) {
        for at in SERVICES {
            self.carry_out(at);
        }
        loop {
            let now = self.clocks();
            let due: Vec<Incarnation> = self
                .services
                .iter()
                .filter(|(_, it)| it.core.poll_timeout().is_some_and(|due| due <= self.now))
                .map(|(at, _)| *at)
                .collect();
            let next = self.coming.front().is_some_and(|(at, ..)| *at <= self.now);
            if due.is_empty() && !next {
                return;
            }
            self.events += 1;
            assert!(
                self.events < MOST_EVENTS,
                "one input causes too many events"
            );
            for at in due {
                self.service(at).core.handle_timeout(now);
                self.carry_out(at);
            }
            if next && let Some((_, to, coming)) = self.coming.pop_front() {
                self.arrive(to, coming);
            }
        }
    }

    fn arrive(&mut self, to: Incarnation, coming: Coming) {
        let (from, kind, attempt, parcel) = match coming {
            // A malicious service ignores the answers to its notes.
            Coming::Conclusion(..) if !SERVICES.contains(&to) => return,
            Coming::Conclusion(attempt, conclusion) => {
                return self.conclude(to, attempt, conclusion);
            }
            Coming::Parcel {
                from,
                kind,
                attempt,
                parcel,
            } => (from, kind, attempt, parcel),
        };
        self.next_ticket += 1;
        let ticket = Ticket(self.next_ticket);
        // Shared memory has few slots for late answers.
        let at_once = kind == Kind::Shm && self.next_ticket.is_multiple_of(2);
        let arrival = Arrival {
            parcel: *parcel,
            from: hop(from, kind),
            ticket: (!at_once).then_some(ticket),
        };
        let now = self.clocks();
        let service = self.service(to);
        match service.core.handle_arrival(now, kind, arrival) {
            Reaction::Now(answer) => {
                let coming = Coming::Conclusion(attempt, Conclusion::Answered(answer));
                self.coming.push_back((self.now + DELAY, from, coming));
            }
            Reaction::Later => {
                service.tickets.insert(ticket.0, (from, attempt));
            }
        }
        self.carry_out(to);
    }

    fn next(&self) -> Option<Instant> {
        let timers = self.services.values().map(|it| it.core.poll_timeout());
        let coming = self.coming.front().map(|(at, ..)| *at);
        timers.chain([coming]).flatten().min()
    }

    fn pass(&mut self, time: Duration) {
        self.settle();
        let until = self.now + time;
        while let Some(next) = self.next().filter(|next| *next <= until) {
            self.now = self.now.max(next);
            self.settle();
            self.check_deadlines();
        }
        self.now = until;
        self.settle();
        self.check_deadlines();
    }

    fn check_deadlines(&self) {
        for (number, sent) in self.sent.iter().enumerate() {
            let overdue = sent.outcome.is_none() && sent.deadline < self.now;
            assert!(!overdue, "letter {number} has no outcome at its deadline");
        }
    }

    fn finish(&mut self) {
        let last = self.sent.iter().map(|sent| sent.deadline).max();
        if let Some(last) = last {
            self.pass(last.saturating_duration_since(self.now) + DELAY);
        }
        self.read(PROCESS, EYE);
        for (number, sent) in self.sent.iter().enumerate() {
            let outcome = sent.outcome.as_ref();
            let outcome = outcome.unwrap_or_else(|| panic!("letter {number} has no outcome"));
            let honest = [ARM, ROVER, EYE].contains(&sent.receiver);
            if !honest {
                continue;
            }
            if matches!(outcome, Outcome::Delivered { .. }) {
                assert!(sent.taken, "letter {number} is delivered but not taken");
            }
            let refused = matches!(
                outcome,
                Outcome::Failed {
                    reason: FailureReason::Refused,
                    ..
                }
            );
            assert!(!refused, "letter {number} is refused: {outcome}");
            let delivered = matches!(outcome, Outcome::Delivered { .. });
            let full = matches!(
                outcome,
                Outcome::Failed {
                    reason: FailureReason::QueueFull,
                    ..
                }
            );
            assert!(
                delivered || full || !sent.must,
                "letter {number} of {} for {}: {outcome}",
                sent.sender,
                sent.receiver
            );
        }
    }
}

fn reason(input: &mut Input<'_>) -> FailureReason {
    input.one_of(&[
        FailureReason::Refused,
        FailureReason::NoSuchAgent,
        FailureReason::QueueFull,
        FailureReason::Unreachable,
        FailureReason::TooLarge,
        FailureReason::TimedOut,
        FailureReason::Unconfirmed,
        FailureReason::Loop,
        FailureReason::Closed,
    ])
}

fn way_error(input: &mut Input<'_>) -> TransportError {
    let fault = input.one_of(&[
        TransportErrorKind::Unreachable,
        TransportErrorKind::Congested,
        TransportErrorKind::NoRoom,
        TransportErrorKind::Broken,
        TransportErrorKind::TooLarge,
        TransportErrorKind::WrongIncarnation,
        TransportErrorKind::Refused,
        TransportErrorKind::TimedOut,
        TransportErrorKind::Inexpressible,
    ]);
    TransportError::new(fault, String::from_utf8_lossy(input.bytes(20)))
}

fn lying_outcome(input: &mut Input<'_>) -> Outcome {
    let via = input.one_of(&[Kind::Shm, Kind::Tcp, Kind::Udp]);
    let attempts = (0..input.below(3)).map(|_| Attempt {
        via,
        location: at(input.one_of(&NAMED), Kind::Tcp),
        error: way_error(input),
    });
    let attempts = attempts.collect();
    match input.below(3) {
        0 => Outcome::Delivered { via, attempts },
        1 => Outcome::Sent { via, attempts },
        _ => Outcome::Failed {
            reason: reason(input),
            attempts,
        },
    }
}
