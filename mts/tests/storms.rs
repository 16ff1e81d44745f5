//! Services that have a letter sent again and again: each cause for which a letter goes again has a
//! limit that does not depend on the answers of other services.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Directory, Entry, MemoryDirectory, MtsId, Reach, Registration, View};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Introduction,
    Kind, Location, Mandate, Parcel, Principal, Report, Stream, TransportError, TransportErrorKind,
};

const OWN: Incarnation = Incarnation::from_u64(1);
const ROVER: Incarnation = Incarnation::from_u64(2);
const ARM: Incarnation = Incarnation::from_u64(3);
/// The service that has `arm`, and never delivers a letter: a gateway of another host or, behind a
/// custodian, a process of this one.
const LIAR: Incarnation = Incarnation::from_u64(9);
/// The service that hands letters to a custodian.
const BEFORE: Incarnation = Incarnation::from_u64(8);
/// Transit time of parcels and answers.
const DELAY: Duration = Duration::from_micros(100);
/// Duration of a storm. The deadline of the letter is longer.
const TIME: Duration = Duration::from_secs(20);

/// An event that the liar causes.
enum Reaction {
    /// The end of the attempt.
    Conclusion(Conclusion),
    /// A parcel from this service.
    Parcel(Incarnation, Parcel),
    /// A connection with the liar.
    Introduction,
    /// Another registration of the receiver.
    Registration,
}

fn answer(answer: Answer) -> Reaction {
    Reaction::Conclusion(Conclusion::Answered(answer))
}

fn about(parcel: &Parcel, body: Body) -> Parcel {
    Parcel {
        body,
        ..parcel.clone()
    }
}

/// The reactions of the liar to a parcel. Each follows the one before.
type Liar = fn(&Parcel) -> Vec<Reaction>;

const RETURNED: Answer = Answer::Returned { uncertain: false };

fn returned(_: &Parcel) -> Vec<Reaction> {
    vec![answer(RETURNED)]
}

fn out_of_order(parcel: &Parcel) -> Vec<Reaction> {
    let last = parcel.after;
    vec![answer(Answer::OutOfOrder { last })]
}

fn busy_and_credit(parcel: &Parcel) -> Vec<Reaction> {
    let credit = about(parcel, Body::Credit);
    vec![answer(Answer::Busy), Reaction::Parcel(LIAR, credit)]
}

fn custody_and_returned(parcel: &Parcel) -> Vec<Reaction> {
    let report = Body::Report(Report::Returned { uncertain: false });
    let report = Reaction::Parcel(LIAR, about(parcel, report));
    vec![answer(Answer::Custody), report]
}

fn custody_and_unknown(parcel: &Parcel) -> Vec<Reaction> {
    let outcome = fipa_transport::Outcome::Failed {
        reason: FailureReason::NoSuchAgent,
        attempts: Vec::new(),
    };
    let report = Body::Report(Report::Settled(outcome));
    let report = Reaction::Parcel(LIAR, about(parcel, report));
    vec![answer(Answer::Custody), report, Reaction::Registration]
}

fn broken_and_connected_again(_: &Parcel) -> Vec<Reaction> {
    let error = TransportError::new(TransportErrorKind::Broken, "");
    let broken = Reaction::Conclusion(Conclusion::Unconfirmed(error));
    vec![broken, Reaction::Introduction]
}

fn moved(_: &Parcel) -> Vec<Reaction> {
    vec![Reaction::Registration, answer(Answer::Moved)]
}

fn unknown_and_registered_again(_: &Parcel) -> Vec<Reaction> {
    let unknown = Answer::failed(FailureReason::NoSuchAgent, "");
    vec![answer(unknown), Reaction::Registration]
}

/// Takes letters into custody, and denies at once that it has them.
fn custody_and_denied(parcel: &Parcel) -> Vec<Reaction> {
    vec![answer(match parcel.body {
        Body::Letter(_) => Answer::Custody,
        _ => Answer::Returned { uncertain: false },
    })]
}

/// The service before the custodian lowers the predecessor after each return.
fn out_of_order_and_lowered(parcel: &Parcel) -> Vec<Reaction> {
    let note = Parcel {
        after: parcel.after.saturating_sub(1),
        // The hand-over to this service, which is not that to the liar.
        transfer: 1,
        ..about(parcel, Body::Predecessor)
    };
    let last = parcel.after.saturating_sub(1);
    let out_of_order = answer(Answer::OutOfOrder { last });
    vec![out_of_order, Reaction::Parcel(BEFORE, note)]
}

/// All of it in turn.
fn everything(parcel: &Parcel) -> Vec<Reaction> {
    let all: [Liar; 6] = [
        returned,
        out_of_order,
        busy_and_credit,
        custody_and_returned,
        broken_and_connected_again,
        custody_and_denied,
    ];
    match &parcel.body {
        Body::Letter(_) => all[parcel.transfer as usize % all.len()](parcel),
        _ => custody_and_denied(parcel),
    }
}

/// A view of a directory that shows its agents on the host of the liar.
struct Abroad(Arc<MemoryDirectory>);

fn abroad(entry: &Arc<Entry>) -> Arc<Entry> {
    let mut entry = Entry::clone(entry);
    entry.reach = Reach::Remote { gateway: LIAR };
    Arc::new(entry)
}

impl View for Abroad {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        self.0.named(name).as_ref().map(abroad)
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.0.registered(incarnation).as_ref().map(abroad)
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        self.0.all().iter().map(abroad).collect()
    }
}

/// The core of a service that sends or forwards to the liar.
struct Service {
    core: Core,
    forwards: bool,
    directory: Arc<MemoryDirectory>,
    registration: Incarnation,
    begin: Instant,
    now: Instant,
    liar: Liar,
    /// Reactions that are still to happen, with their attempt.
    coming: BinaryHeap<Reverse<(Instant, usize)>>,
    reactions: Vec<Option<(AttemptId, Reaction)>>,
    /// Whether the service before hands a letter over again that comes back.
    insists: bool,
    copy: Option<Parcel>,
    /// Times at which the letter left, and its length.
    dispatched_at: Vec<Instant>,
    len: usize,
}

fn hop(service: Incarnation) -> Hop {
    let location: Location = format!("tcp://192.0.2.{}:1", service.as_u64())
        .parse()
        .unwrap();
    Hop {
        location: location.with_incarnation(service),
        principal: Principal::Certificate([u8::try_from(service.as_u64()).unwrap(); 32]),
    }
}

fn letter(len: usize) -> Letter {
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content(vec![7; len])
        .build()
        .unwrap();
    letter_for(&message, SystemTime::UNIX_EPOCH).unwrap()
}

impl Service {
    fn new(forwards: bool, liar: Liar) -> Self {
        let directory = Arc::new(MemoryDirectory::new(MtsId::new("liar", LIAR)));
        let config = CoreConfig {
            forwards,
            ..CoreConfig::new("mts", OWN, vec![Kind::Tcp])
        };
        let view: Arc<dyn View> = match forwards {
            true => directory.clone(),
            false => Arc::new(Abroad(directory.clone())),
        };
        let mut core = Core::new(config, view);
        core.register("rover".into(), ROVER);
        let begin = Instant::now();
        let mut service = Self {
            core,
            forwards,
            directory,
            registration: ARM,
            begin,
            now: begin,
            liar,
            coming: BinaryHeap::new(),
            reactions: Vec::new(),
            insists: false,
            copy: None,
            dispatched_at: Vec::new(),
            len: 0,
        };
        service.register(ARM);
        for peer in [LIAR, BEFORE] {
            service.introduce(peer);
        }
        service
    }

    fn register(&mut self, registration: Incarnation) {
        let agent = Registration::new("arm", registration, vec![hop(LIAR).location]);
        self.directory.register(agent).unwrap();
        self.registration = registration;
    }

    fn introduce(&mut self, peer: Incarnation) {
        let introduction = Introduction {
            name: format!("peer-{peer}").into(),
            hop: hop(peer),
            dialed: None,
            mandate: Mandate::Unproved,
        };
        let now = self.clocks();
        self.core.handle_introduced(now, &introduction);
    }

    fn clocks(&self) -> Now {
        Now {
            instant: self.now,
            utc: SystemTime::UNIX_EPOCH + (self.now - self.begin),
        }
    }

    /// Sends a letter with content of this length from this service.
    fn send(mut self, len: usize) -> Self {
        let submission = Submission {
            sender: ROVER,
            letter: letter(len),
            receivers: vec!["arm".into()],
            deadline: TIME * 2,
        };
        self.core.submit(self.clocks(), submission);
        self.run();
        self
    }

    /// Takes a letter with this predecessor into custody, from the service before.
    fn forward(mut self, after: u64, len: usize) -> Self {
        let copy = Parcel {
            receiver: "arm".into(),
            stream: Stream::between(ROVER, ARM),
            sequence: after + 1,
            after,
            transfer: 1,
            remaining: TIME * 2,
            body: Body::Letter(letter(len)),
        };
        self.copy = Some(copy.clone());
        self.arrive(BEFORE, copy);
        self.run();
        self
    }

    /// The service before hands the letter over again whenever it comes back.
    fn insisting(mut self) -> Self {
        self.insists = true;
        self
    }

    fn arrive(&mut self, from: Incarnation, parcel: Parcel) {
        let mut from = hop(from);
        if self.forwards && from.location.incarnation() == LIAR {
            from.principal = Principal::Host;
        }
        let arrival = Arrival {
            parcel,
            from,
            ticket: None,
        };
        let now = self.clocks();
        let _ = self.core.handle_arrival(now, Kind::Tcp, arrival);
    }

    fn run(&mut self) {
        let end = self.begin + TIME;
        loop {
            self.carry_out();
            let coming = self.coming.peek().map(|Reverse((at, _))| *at);
            let timer = self.core.poll_timeout();
            let next = coming.into_iter().chain(timer).min();
            let Some(next) = next.filter(|next| *next <= end) else {
                return;
            };
            self.now = self.now.max(next);
            assert!(self.dispatched_at.len() < 10_000, "a storm");
            if coming.is_some_and(|at| at <= self.now) {
                let Some(Reverse((_, number))) = self.coming.pop() else {
                    return;
                };
                if let Some((attempt, reaction)) = self.reactions[number].take() {
                    self.react(attempt, reaction);
                }
            } else {
                let now = self.clocks();
                self.core.handle_timeout(now);
            }
        }
    }

    fn react(&mut self, attempt: AttemptId, reaction: Reaction) {
        let now = self.clocks();
        match reaction {
            Reaction::Conclusion(conclusion) => {
                self.core.handle_conclusion(now, attempt, conclusion);
            }
            Reaction::Parcel(from, parcel) => self.arrive(from, parcel),
            Reaction::Introduction => self.introduce(LIAR),
            Reaction::Registration => {
                self.directory.deregister("arm", self.registration).unwrap();
                self.register(Incarnation::from_u64(self.registration.as_u64() + 100));
                self.core.handle_directory_change(now);
            }
        }
    }

    fn follows(&mut self, attempt: AttemptId, reactions: Vec<Reaction>) {
        for (place, reaction) in (1..).zip(reactions) {
            let at = self.now + DELAY * place;
            self.coming.push(Reverse((at, self.reactions.len())));
            self.reactions.push(Some((attempt, reaction)));
        }
    }

    fn carry_out(&mut self) {
        while let Some(action) = self.core.poll_action() {
            let now = self.clocks();
            match action {
                Action::Dispatch {
                    attempt,
                    location,
                    parcel,
                } if location.incarnation() == LIAR => {
                    if let Body::Letter(letter) = &parcel.body {
                        self.dispatched_at.push(self.now);
                        self.len = letter.len();
                    }
                    let reactions = (self.liar)(&parcel);
                    self.follows(attempt, reactions);
                }
                Action::Dispatch {
                    attempt, parcel, ..
                } => {
                    let mut reactions = vec![answer(Answer::Accepted)];
                    let returned = Body::Report(Report::Returned { uncertain: false });
                    if let Some(copy) = self.copy.as_mut().filter(|_| self.insists)
                        && parcel.body == returned
                    {
                        copy.transfer += 1;
                        reactions.push(Reaction::Parcel(BEFORE, copy.clone()));
                    }
                    self.follows(attempt, reactions);
                }
                Action::Abandon { attempt, error, .. } => {
                    let ended = Conclusion::Unconfirmed(error);
                    self.core.handle_conclusion(now, attempt, ended);
                }
                Action::Refresh { number } => self.core.handle_refreshed(now, number),
                _ => {}
            }
        }
    }

    /// Checks that the letter left again, and at no time more often than it may.
    fn check(&self, what: &str) {
        assert!(
            self.dispatched_at.len() > 1,
            "{what}: the letter does not go again"
        );
        for (count, at) in (1_u32..).zip(&self.dispatched_at) {
            let seconds = (*at - self.dispatched_at[0]).as_secs_f64();
            let content = f64::from(count - 1) * self.len as f64;
            assert!(
                f64::from(count) <= 16.0 + 4.0 * seconds,
                "{what}: {count} times within {seconds} s"
            );
            assert!(
                content <= 4.0 * self.len as f64 + f64::from(1 << 20) * seconds,
                "{what}: {count} times {} bytes within {seconds} s",
                self.len
            );
        }
    }
}

const SENDER: [(&str, Liar); 10] = [
    ("returned", returned),
    ("out of order", out_of_order),
    ("busy and credit", busy_and_credit),
    ("custody and report returned", custody_and_returned),
    ("custody and report unknown", custody_and_unknown),
    ("broken connection", broken_and_connected_again),
    ("moved", moved),
    ("no such agent", unknown_and_registered_again),
    ("denied custody question", custody_and_denied),
    ("everything", everything),
];

#[test]
fn no_answer_makes_a_sender_storm() {
    for (what, liar) in SENDER {
        Service::new(false, liar).send(10).check(what);
    }
}

/// Content is repeated less often than a short letter.
#[test]
fn no_answer_makes_a_sender_repeat_much_content() {
    for (what, liar) in SENDER {
        Service::new(false, liar).send(500_000).check(what);
    }
}

const CUSTODIAN: [(&str, Liar); 7] = [
    ("returned", returned),
    ("out of order", out_of_order),
    ("busy and credit", busy_and_credit),
    ("custody and report returned", custody_and_returned),
    ("broken connection", broken_and_connected_again),
    ("denied custody question", custody_and_denied),
    ("everything", everything),
];

#[test]
fn no_answer_makes_a_custodian_storm() {
    for (what, liar) in CUSTODIAN {
        for len in [10, 500_000] {
            Service::new(true, liar).forward(0, len).check(what);
        }
    }
}

/// The letter leaves the custodian and comes again: its repetitions count over all visits.
#[test]
fn a_letter_that_comes_to_a_custodian_again_has_no_fresh_start() {
    for (what, liar) in CUSTODIAN {
        let service = Service::new(true, liar).insisting();
        service.forward(7, 10).check(what);
    }
}

/// A hostile service before the custodian sends notes, and another one behind it refuses the letter.
#[test]
fn lower_predecessors_make_no_custodian_storm() {
    let service = Service::new(true, out_of_order_and_lowered);
    let service = service.forward(1 << 40, 500_000);
    service.check("lowered predecessor");
    let at_once = service.dispatched_at.iter();
    let at_once = at_once.take_while(|at| **at - service.dispatched_at[0] < DELAY * 20);
    assert_eq!(at_once.count(), 1 + 4, "a lower predecessor ends a pause");
}

/// One stream that comes back holds up no other stream to the same service.
#[test]
fn only_the_lane_of_the_letter_pauses() {
    let service = Service::new(false, |parcel| match &*parcel.receiver {
        "arm" => returned(parcel),
        _ => vec![answer(Answer::Accepted)],
    });
    let lamp = Registration::new("lamp", Incarnation::from_u64(4), vec![hop(LIAR).location]);
    service.directory.register(lamp).unwrap();
    let mut service = service.send(10);
    let submission = Submission {
        sender: ROVER,
        letter: letter(10),
        receivers: vec!["lamp".into()],
        deadline: TIME,
    };
    let now = service.clocks();
    service.core.submit(now, submission);
    let dispatched = std::iter::from_fn(|| service.core.poll_action());
    let mut dispatched = dispatched.filter_map(|action| match action {
        Action::Dispatch { parcel, .. } => Some(parcel.receiver),
        _ => None,
    });
    assert_eq!(dispatched.next().as_deref(), Some("lamp"));
}

/// An honest receiver with a full queue gets the next letters as soon as it has room.
#[test]
fn a_credit_after_progress_ends_the_pause() {
    let mut service = Service::new(false, |_| Vec::new());
    let now = service.clocks();
    for _ in 0..2 {
        let submission = Submission {
            sender: ROVER,
            letter: letter(10),
            receivers: vec!["arm".into()],
            deadline: TIME,
        };
        service.core.submit(now, submission);
    }
    let dispatched = |service: &mut Service| {
        let actions = std::iter::from_fn(|| service.core.poll_action());
        let dispatched = actions.filter_map(|action| match action {
            Action::Dispatch {
                attempt, parcel, ..
            } => Some((attempt, parcel)),
            _ => None,
        });
        dispatched.collect::<Vec<_>>()
    };
    let sent = dispatched(&mut service);
    let [(first, _), (second, parcel)] = &sent[..] else {
        panic!("{sent:?}");
    };
    let busy = || Conclusion::Answered(Answer::Busy);
    let accepted = Conclusion::Answered(Answer::Accepted);
    service.core.handle_conclusion(now, *first, accepted);
    service.core.handle_conclusion(now, *second, busy());
    assert_eq!(dispatched(&mut service).len(), 0);
    service.arrive(LIAR, about(parcel, Body::Credit));
    let again = dispatched(&mut service);
    let [(attempt, parcel)] = &again[..] else {
        panic!("{again:?}");
    };
    // No letter was settled since that credit.
    service.core.handle_conclusion(now, *attempt, busy());
    service.arrive(LIAR, about(parcel, Body::Credit));
    assert_eq!(dispatched(&mut service).len(), 0);
}
