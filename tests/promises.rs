//! The guarantees that the simulation checks, on real sockets with QUIC among the transports. Letters
//! of two streams go from a process through two gateways to another process, while links between the
//! gateways are cut and transports closed at random moments. The deadlines lie between 10 ms and 60 s,
//! some letters are large, and the far gateway refuses some. Each letter has one outcome with its
//! transport. The receiver gets the delivered letters and no failed ones, none twice or out of order.
//! After the last fault, every stream delivers all letters.
//!
//! A run prints its `FIPA_PROMISES_SEED`, which repeats its decisions. `FIPA_PROMISES_SEEDS` is the
//! number of runs.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod services;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use fastrand::Rng;
use fipa::{AgentId, FailureReason, Kind, Letter, Message, Outcome, Performative};
use fipa_mts::core::Submission;
use fipa_mts::{AccessGate, LetterParts, Sending, letter_for};
use fipa_testbed::until_async;
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, LegacySource, Parcel, Reaction,
    Sink, Stream, Transport,
};
use fipa_transport_net::{Identity, NetLimits, QuicConfig, QuicTransport, TcpConfig, TcpTransport};
use parking_lot::Mutex;
use services::links::{Link, LinkState};
use services::{ARM, ROVER, Security, TestService, host, letter, mutual_keys, number};
use tokio::runtime::Handle;
use tokio::task::spawn_blocking;
use tokio::time::{sleep, timeout};

const ORDER: [Kind; 4] = [Kind::Shm, Kind::Unix, Kind::Quic, Kind::Tcp];
/// The transports between the gateways.
const OUTSIDE: [Kind; 2] = [Kind::Quic, Kind::Tcp];
/// The agents that send, each on a stream of its own to the arm.
const SENDERS: [(&str, Incarnation); 2] =
    [("rover", ROVER), ("scout", Incarnation::from_u64(0x5c0))];
/// Maximum number of letters of a stream without an outcome.
const WINDOW: usize = 8;
/// Deadline from which a letter survives every cut.
const AMPLE: Duration = Duration::from_secs(10);
/// Number of changes of a link.
const CHANGES: usize = 12;
/// Number of letters of each stream delivered in a row that count as recovered traffic.
const IN_A_ROW: usize = 20;
/// Number of letters of each stream after the last fault, all of which are delivered or refused.
const LAST: usize = 100;
/// Maximum number of failed attempts of such a letter.
const RETRIES: usize = 8;
const WATCHDOG: Duration = Duration::from_secs(120);

/// A letter to be sent.
#[derive(Debug, Clone, Copy)]
struct Draft {
    deadline: Duration,
    size: usize,
    /// Whether the far gateway refuses it.
    refused: bool,
}

impl Draft {
    fn new(random: &mut Rng) -> Self {
        // Log-uniform: as many between 10 and 100 ms as between 1 and 10 s.
        let milliseconds = 10.0 * 6000_f64.powf(random.f64());
        Self {
            deadline: Duration::from_millis(milliseconds as u64),
            size: match random.u8(..) {
                0 => 2_000_000,
                1..4 => 100_000,
                _ => 0,
            },
            refused: random.u8(..20) == 0,
        }
    }

    fn letter(self, sender: &str, number: usize) -> Letter {
        let performative = match self.refused {
            true => Performative::Cancel,
            false => Performative::Inform,
        };
        // Leading zeros make the content large; it still parses as the number.
        let content = format!("{}{number}", "0".repeat(self.size));
        let message = Message::builder(performative)
            .sender(AgentId::new(sender).unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .content(content)
            .build();
        letter_for(&message.unwrap(), SystemTime::now()).unwrap()
    }
}

/// The access rule of the far gateway: it refuses `cancel`.
struct NoCancel;

impl AccessGate for NoCancel {
    fn read(&self, letter: &Letter) -> LetterParts {
        let message = Message::decode(letter.payload()).unwrap();
        LetterParts {
            performative: message.performative().to_string(),
            ..LetterParts::default()
        }
    }

    fn admits(
        &self,
        _: Instant,
        _: &str,
        letter: &LetterParts,
        _: fipa_mts::Link,
    ) -> Result<(), String> {
        match letter.performative == Performative::Cancel.to_string() {
            true => Err("cancel is not allowed here".to_owned()),
            false => Ok(()),
        }
    }
}

/// The outcomes and received letters of one stream.
#[derive(Default)]
struct StreamRecord {
    outcomes: BTreeMap<usize, Outcome>,
    taken: Vec<usize>,
    refused: usize,
    in_a_row: usize,
}

impl StreamRecord {
    fn note(&mut self, number: usize, draft: Draft, outcome: Outcome) {
        self.in_a_row = match outcome {
            Outcome::Delivered { .. } => self.in_a_row + 1,
            _ if draft.refused || draft.deadline < AMPLE => self.in_a_row,
            _ => 0,
        };
        self.refused += usize::from(is_refusal(&outcome));
        assert_eq!(self.outcomes.insert(number, outcome), None);
    }

    fn check(&self) {
        let mut pairs = self.taken.windows(2);
        let wrong = pairs.find(|two| two[0] >= two[1]);
        assert_eq!(wrong, None, "received twice or out of order");
        for (number, outcome) in &self.outcomes {
            let taken = self.taken.binary_search(number).is_ok();
            match outcome {
                Outcome::Delivered { via, attempts } => {
                    assert!(taken, "{number}: lost, but reported as delivered");
                    let mut kinds = attempts.iter().map(|it| it.via).chain([*via]);
                    assert!(
                        kinds.all(|kind| ORDER.contains(&kind)),
                        "{number}: {outcome}"
                    );
                }
                Outcome::Failed {
                    reason: FailureReason::Unconfirmed,
                    ..
                } => {}
                other => assert!(!taken, "{number} was received, but {other}"),
            }
        }
    }

    /// Whether all delivered letters are received.
    fn is_taken(&self) -> bool {
        let delivered = self.outcomes.iter();
        let mut delivered = delivered.filter(|(_, it)| matches!(it, Outcome::Delivered { .. }));
        delivered.all(|(number, _)| self.taken.contains(number))
    }

    fn went_by(&self, kind: Kind) -> usize {
        let outcomes = self.outcomes.values();
        outcomes.filter(|it| it.via() == Some(kind)).count()
    }
}

fn is_refusal(outcome: &Outcome) -> bool {
    let refused = FailureReason::Refused;
    matches!(outcome, Outcome::Failed { reason, .. } if *reason == refused)
}

/// The streams' records, in the order of [`SENDERS`].
type StreamRecords = Arc<Mutex<[StreamRecord; SENDERS.len()]>>;

/// Sends letters of one stream until `stop` is set, and then the last ones.
async fn send_all(
    mts: fipa_mts::Mts,
    stream: usize,
    mut random: Rng,
    stop: Arc<AtomicBool>,
    records: StreamRecords,
) {
    let mut under_way = VecDeque::new();
    let mut last = LAST;
    for number in 0.. {
        let mut draft = Draft::new(&mut random);
        let stops = stop.load(Ordering::Acquire);
        if stops {
            let Some(left) = last.checked_sub(1) else {
                break;
            };
            last = left;
            draft.deadline = Duration::from_secs(60);
        }
        under_way.push_back(SentLetter {
            number,
            draft,
            is_last: stops,
            sending: send(&mts, stream, number, draft),
        });
        if under_way.len() >= WINDOW
            && let Some(oldest) = under_way.pop_front()
        {
            note(&records, stream, oldest).await;
        }
        sleep(Duration::from_millis(1)).await;
    }
    for sent in under_way {
        note(&records, stream, sent).await;
    }
}

fn send(mts: &fipa_mts::Mts, stream: usize, number: usize, draft: Draft) -> Sending {
    let (name, sender) = SENDERS[stream];
    mts.submit(Submission {
        sender,
        letter: draft.letter(name, number),
        receivers: vec!["arm".into()],
        deadline: draft.deadline,
    })
}

/// A letter without an outcome.
struct SentLetter {
    number: usize,
    draft: Draft,
    /// Whether it was sent after the last fault.
    is_last: bool,
    sending: Sending,
}

async fn note(records: &StreamRecords, stream: usize, sent: SentLetter) {
    let SentLetter {
        number,
        draft,
        is_last,
        sending,
    } = sent;
    let outcome = outcome(sending).await;
    if is_last {
        let expected =
            outcome.is_success() != draft.refused && is_refusal(&outcome) == draft.refused;
        let retries = outcome.attempts().len();
        assert!(
            expected && retries <= RETRIES,
            "{number}, after the last fault: {outcome}"
        );
    }
    records.lock()[stream].note(number, draft, outcome);
}

async fn outcome(sending: Sending) -> Outcome {
    let outcomes = timeout(WATCHDOG, sending.outcomes()).await.unwrap();
    let [(_, outcome)] = <[_; 1]>::try_from(outcomes).unwrap();
    outcome
}

/// Runs one seed. Returns a summary with the number of letters per transport.
async fn run(seed: u64) -> String {
    let mut random = Rng::with_seed(seed);
    let (here, there) = (host(), host());
    let [near_keys, far_keys] = mutual_keys(here.path(), ["near", "far"]);
    let rovers = TestService::start(here.path(), "rovers", &[Kind::Shm], false);
    let near = TestService::with_keys(here.path(), "near", &ORDER, true, Some(near_keys));
    let far = TestService::with_gate(there.path(), "far", &ORDER, far_keys, Arc::new(NoCancel));
    let arms = TestService::start(there.path(), "arms", &[Kind::Shm, Kind::Unix], false);
    let quic = Link::before(&far.at(Kind::Quic)).await;
    let tcp = Link::before(&far.at(Kind::Tcp)).await;
    rovers.register_arm_at(vec![near.at(Kind::Shm)]);
    near.register_arm_at(vec![quic.location.clone(), tcp.location.clone()]);
    far.register_arm_at(arms.all_locations());
    arms.register_arm_at(arms.all_locations());
    for (name, sender) in SENDERS {
        rovers.mts.register(name.into(), sender);
    }
    arms.mts.register("arm".into(), ARM);

    let records = StreamRecords::default();
    let (receiver, taken) = (arms.mts.clone(), records.clone());
    let receiving = tokio::spawn(async move {
        while let Some(letter) = receiver.receive(ARM).await {
            let message = Message::decode(letter.letter.payload()).unwrap();
            let sender = message.sender().unwrap().name();
            let stream = SENDERS.iter().position(|(name, _)| *name == sender);
            taken.lock()[stream.unwrap()]
                .taken
                .push(number(&letter.letter));
        }
    });
    let stop = Arc::new(AtomicBool::new(false));
    let sending: Vec<_> = (0..SENDERS.len())
        .map(|stream| {
            let (mts, random) = (rovers.mts.clone(), random.fork());
            let sending = send_all(mts, stream, random, stop.clone(), records.clone());
            tokio::spawn(sending)
        })
        .collect();
    let goes_on = async || {
        for record in &mut *records.lock() {
            record.in_a_row = 0;
        }
        until_async("letters arrive", || {
            let ended = sending.iter().any(|it| it.is_finished());
            assert!(!ended, "a sender has failed; see above");
            let records = records.lock();
            records.iter().all(|record| record.in_a_row >= IN_A_ROW)
        })
        .await;
    };
    let went_by = |kind: Kind| {
        let records = records.lock();
        records
            .iter()
            .map(|record| record.went_by(kind))
            .sum::<usize>()
    };
    let goes_by = async |kind: Kind| {
        let before = went_by(kind);
        until_async(&format!("letters go by {kind}"), || {
            went_by(kind) > before + IN_A_ROW
        })
        .await;
    };

    goes_on().await;
    // The receiver's process loses its shared memory, early or late.
    let shm_until = random.usize(..CHANGES / 2);
    let mut closing = Vec::new();
    for change in 0..CHANGES {
        sleep(Duration::from_millis(random.u64(5..300))).await;
        if change == shm_until {
            let shm = arms.transport(Kind::Shm);
            closing.push(spawn_blocking(move || shm.close()));
        }
        let link = if random.bool() { &quic } else { &tcp };
        let states = [
            LinkState::Up,
            LinkState::Stalled,
            LinkState::OneWay,
            LinkState::Closed,
        ];
        link.set(states[random.usize(..states.len())]);
    }
    for link in [&quic, &tcp] {
        link.set(LinkState::Up);
    }
    goes_on().await;
    // Letters arrive by TCP but their answers do not. Then the link closes, and QUIC repeats them.
    quic.set(LinkState::Stalled);
    goes_by(Kind::Tcp).await;
    quic.set(LinkState::Up);
    tcp.set(LinkState::OneWay);
    sleep(Duration::from_millis(random.u64(1..100))).await;
    tcp.set(LinkState::Closed);
    sleep(Duration::from_millis(random.u64(100..600))).await;
    tcp.set(LinkState::Up);
    goes_on().await;
    // Waits until QUIC is used again.
    goes_by(Kind::Quic).await;
    let transport = far.transport(Kind::Quic);
    closing.push(spawn_blocking(move || transport.close()));
    goes_on().await;
    stop.store(true, Ordering::Release);
    for sending in sending {
        timeout(WATCHDOG, sending).await.unwrap().unwrap();
    }
    until_async("the delivered letters are received", || {
        records.lock().iter().all(StreamRecord::is_taken)
    })
    .await;
    receiving.abort();
    let summary = {
        let records = records.lock();
        for record in &*records {
            record.check();
            assert!(record.refused > 0, "nothing was refused");
        }
        let outcomes = records.iter().flat_map(|record| record.outcomes.values());
        let failed = outcomes.clone().filter(|it| !it.is_success()).count();
        let sent = outcomes.count();
        let refused: usize = records.iter().map(|record| record.refused).sum();
        drop(records);
        let by = OUTSIDE.map(|kind| (kind, went_by(kind)));
        format!("{sent} letters, {by:?}, {failed} failed, {refused} of them refused")
    };
    for closing in closing {
        timeout(WATCHDOG, closing).await.unwrap().unwrap();
    }
    for service in [&rovers, &near, &far, &arms] {
        service.mts.close(Duration::from_secs(1)).await;
    }
    for kind in OUTSIDE {
        assert!(went_by(kind) > 0, "no letter used {kind}");
    }
    summary
}

fn asked(variable: &str) -> Option<u64> {
    std::env::var(variable)
        .ok()
        .map(|text| text.parse().unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn promises_hold_on_real_sockets_with_quic_in_the_order() {
    let seeds = match asked("FIPA_PROMISES_SEED") {
        Some(seed) => seed..=seed,
        None => {
            let first = fastrand::u64(..1 << 40);
            first..=first + asked("FIPA_PROMISES_SEEDS").unwrap_or(1) - 1
        }
    };
    for seed in seeds {
        println!("FIPA_PROMISES_SEED={seed}");
        println!("  {}", run(seed).await);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_is_not_sent_unencrypted_and_its_outcome_has_the_failed_attempt() {
    let here = host();
    let [ours, theirs] = mutual_keys(here.path(), ["rovers", "arms"]);
    let order = [Kind::Tcp, Kind::Quic];
    let start = |name, keys: &Security| {
        TestService::with_keys(here.path(), name, &order, false, Some(keys.clone()))
    };
    let arms = start("arms", &theirs);
    // A service without keys at the TCP location that the directory has for the arm. It would accept
    // the letter.
    let plain = TestService::start(here.path(), "plain", &[Kind::Tcp], false);
    for service in [&arms, &plain] {
        service.register_arm_at(service.all_locations());
        service.mts.register("arm".into(), ARM);
    }
    let incarnation = arms.at(Kind::Quic).incarnation();
    let false_location = plain.at(Kind::Tcp).with_incarnation(incarnation);
    for (locations, by) in [
        (
            vec![false_location.clone(), arms.at(Kind::Quic)],
            Some(Kind::Quic),
        ),
        (vec![false_location], None),
    ] {
        let rovers = start("rovers", &ours);
        rovers.register_arm_at(locations);
        rovers.mts.register("rover".into(), ROVER);
        let sending = rovers.mts.submit(Submission {
            sender: ROVER,
            letter: letter(1),
            receivers: vec!["arm".into()],
            deadline: Duration::from_secs(30),
        });
        let outcome = outcome(sending).await;
        assert_eq!(outcome.via(), by, "{outcome}");
        let tried = outcome.attempts().iter();
        let tried = tried.filter(|attempt| attempt.via == Kind::Tcp);
        assert!(tried.count() > 0, "no attempt by TCP: {outcome}");
        rovers.mts.close(Duration::from_secs(1)).await;
    }
    let taken = timeout(WATCHDOG, arms.mts.receive(ARM)).await.unwrap();
    assert_eq!(number(&taken.unwrap().letter), 1);
    assert!(
        plain
            .mts
            .try_receive(ARM)
            .is_ok_and(|letter| letter.is_none()),
        "sent unencrypted"
    );
    for service in [&arms, &plain] {
        service.mts.close(Duration::from_secs(1)).await;
    }
}

/// Stores the conclusions of attempts.
#[derive(Default)]
struct Conclusions(Mutex<HashMap<AttemptId, Conclusion>>);

impl Sink for Conclusions {
    fn arrived(&self, _: Arrival) -> Reaction {
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        self.0.lock().insert(attempt, conclusion);
    }
}

/// A trusted service that repeats parcels.
struct RepeatingPeer {
    transport: Arc<dyn Transport>,
    conclusions: Arc<Conclusions>,
}

impl RepeatingPeer {
    fn over(kind: Kind, security: Security) -> Self {
        let identity = Identity {
            name: "rovers".into(),
            incarnation: Incarnation::random(),
            domain: "elsewhere".into(),
            host: "elsewhere".into(),
        };
        let (listen, limits) = (Vec::new(), NetLimits::default());
        let transport: Arc<dyn Transport> = match kind {
            Kind::Quic => {
                let config = QuicConfig {
                    listen,
                    identity,
                    limits,
                    refused_dials: fipa_transport_net::RefusedDials::default(),
                    security,
                    refusals: fipa_transport_net::Refusals::default(),
                };
                Arc::new(QuicTransport::new(config, Handle::current()))
            }
            _ => {
                let mut config = TcpConfig::new(listen, identity);
                config.limits = limits;
                config.processes = true;
                config.security = Some(security);
                Arc::new(TcpTransport::new(config, Handle::current()))
            }
        };
        let conclusions = Arc::new(Conclusions::default());
        transport.listen(conclusions.clone()).unwrap();
        Self {
            transport,
            conclusions,
        }
    }

    /// Sends the letter with this number, also if it was sent before, and waits for the answer.
    async fn send(&self, attempt: u64, to: &TestService, kind: Kind, sequence: u64) {
        let parcel = Parcel {
            receiver: "arm".into(),
            stream: Stream::between(ROVER, ARM),
            sequence,
            after: sequence - 1,
            remaining: Duration::from_secs(30),
            transfer: 0,
            body: Body::Letter(letter(sequence as usize)),
        };
        let attempt = AttemptId(attempt);
        self.transport.post(attempt, &to.at(kind), parcel).unwrap();
        until_async("an answer", || {
            self.conclusions.0.lock().contains_key(&attempt)
        })
        .await;
        let conclusion = self.conclusions.0.lock()[&attempt].clone();
        assert!(
            matches!(conclusion, Conclusion::Answered(_)),
            "{conclusion:?}"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_that_a_trusted_peer_repeats_is_received_once() {
    let here = host();
    let [ours, theirs] = mutual_keys(here.path(), ["rovers", "arms"]);
    let order = [Kind::Quic, Kind::Tcp];
    let arms = TestService::with_keys(here.path(), "arms", &order, false, Some(theirs));
    arms.register_arm_at(arms.all_locations());
    arms.mts.register("arm".into(), ARM);
    // Repeats on one connection, on a new one of the same kind, and on one of the other kind.
    for (round, kind) in [Kind::Quic, Kind::Quic, Kind::Tcp, Kind::Tcp]
        .into_iter()
        .enumerate()
    {
        let peer = RepeatingPeer::over(kind, ours.clone());
        for (attempt, sequence) in [1, 2, 1, 2, 2].into_iter().enumerate() {
            peer.send(attempt as u64, &arms, kind, sequence).await;
        }
        let next = round as u64 + 3;
        peer.send(99, &arms, kind, next).await;
        if round == 0 {
            for expected in [1, 2] {
                let taken = timeout(WATCHDOG, arms.mts.receive(ARM)).await.unwrap();
                assert_eq!(number(&taken.unwrap().letter), expected);
            }
        }
        let taken = timeout(WATCHDOG, arms.mts.receive(ARM)).await.unwrap();
        assert_eq!(number(&taken.unwrap().letter) as u64, next);
        peer.transport.close();
    }
    assert!(
        arms.mts
            .try_receive(ARM)
            .is_ok_and(|letter| letter.is_none()),
        "a letter twice"
    );
    arms.mts.close(Duration::from_secs(1)).await;
}
