//! The promises of the delivery simulation, on real sockets with QUIC in the order: links are cut and
//! transports stopped at random moments while letters flow. Each letter has one outcome, which says
//! the way; what was delivered is taken, and nothing else; nothing is taken twice or out of order.
//!
//! `FIPA_PROMISES_SEED` repeats the decisions of a run, which a failing one prints, and
//! `FIPA_PROMISES_SEEDS` is the number of runs.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod services;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::net::IpAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use fastrand::Rng;
use fipa::{FailureReason, Kind, Letter, Outcome};
use fipa_mts::Sending;
use fipa_mts::core::Submission;
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Incarnation, Parcel, Sink, Stream, Transport,
    Verdict,
};
use fipa_transport_net::{Identity, Limits, QuicConfig, QuicTransport, TcpConfig, TcpTransport};
use parking_lot::Mutex;
use services::weather::{Link, Sky};
use services::{ARM, Place, ROVER, Security, friends, host, letter, number};
use tokio::runtime::Handle;
use tokio::task::spawn_blocking;
use tokio::time::{sleep, timeout};

const ORDER: [Kind; 3] = [Kind::Shm, Kind::Quic, Kind::Tcp];
/// Letters under way.
const WINDOW: usize = 8;
/// What a letter has: shorter than some cuts last.
const DEADLINE: Duration = Duration::from_millis(400);
/// Changes of the weather.
const CHANGES: usize = 12;
/// Letters delivered in a row that count as traffic that goes on.
const IN_A_ROW: usize = 20;
const WATCHDOG: Duration = Duration::from_secs(120);

/// What happened.
#[derive(Default)]
struct Account {
    outcomes: BTreeMap<usize, Outcome>,
    taken: Vec<usize>,
    in_a_row: usize,
}

impl Account {
    fn note(&mut self, number: usize, outcome: Outcome) {
        self.in_a_row = match outcome {
            Outcome::Delivered { .. } => self.in_a_row + 1,
            _ => 0,
        };
        assert_eq!(self.outcomes.insert(number, outcome), None);
    }

    fn check(&self) {
        let mut pairs = self.taken.windows(2);
        let wrong = pairs.find(|two| two[0] >= two[1]);
        assert_eq!(wrong, None, "twice, or out of order");
        for (number, outcome) in &self.outcomes {
            let taken = self.taken.binary_search(number).is_ok();
            match outcome {
                Outcome::Delivered { via, attempts } => {
                    assert!(taken, "{number}: lost, and said to be delivered");
                    let mut ways = attempts.iter().map(|it| it.via).chain([*via]);
                    assert!(ways.all(|way| ORDER.contains(&way)), "{number}: {outcome}");
                }
                Outcome::Failed {
                    reason: FailureReason::Unconfirmed,
                    ..
                } => {}
                other => assert!(!taken, "{number} was taken, but {other}"),
            }
        }
    }

    fn went_by(&self, kind: Kind) -> usize {
        let outcomes = self.outcomes.values();
        outcomes.filter(|it| it.via() == Some(kind)).count()
    }
}

async fn until(what: &str, condition: impl Fn() -> bool) {
    let begun = Instant::now();
    while !condition() {
        assert!(begun.elapsed() < WATCHDOG, "never: {what}");
        sleep(Duration::from_millis(2)).await;
    }
}

async fn outcome(sending: Sending) -> Outcome {
    let outcomes = timeout(WATCHDOG, sending.outcomes()).await.unwrap();
    let [(_, outcome)] = <[_; 1]>::try_from(outcomes).unwrap();
    outcome
}

/// Sends letters through this weather; says how many went which way.
async fn through(seed: u64) -> String {
    let mut random = Rng::with_seed(seed);
    let here = host();
    let [ours, theirs] = friends(here.path(), ["rovers", "arms"]);
    let start = |name, keys| Place::with_keys(here.path(), name, &ORDER, false, Some(keys));
    let (rovers, arms) = (start("rovers", ours), start("arms", theirs));
    let quic = Link::before(&arms.at(Kind::Quic)).await;
    let tcp = Link::before(&arms.at(Kind::Tcp)).await;
    let links = [quic.location.clone(), tcp.location.clone()];
    rovers.knows_arm_at([&[arms.at(Kind::Shm)], &links[..]].concat());
    arms.knows_arm_at(arms.everywhere());
    rovers.mts.register("rover".into(), ROVER);
    arms.mts.register("arm".into(), ARM);

    let account: Arc<Mutex<Account>> = Arc::default();
    let (receiver, taken) = (arms.mts.clone(), account.clone());
    let receiving = tokio::spawn(async move {
        while let Some(letter) = receiver.receive(ARM).await {
            taken.lock().taken.push(number(&letter.letter));
        }
    });
    let stop = Arc::new(AtomicBool::new(false));
    let (sender, ended, noted) = (rovers.mts.clone(), stop.clone(), account.clone());
    let sending = tokio::spawn(async move {
        let mut under_way = VecDeque::new();
        for number in 0.. {
            if ended.load(Ordering::Acquire) {
                break;
            }
            let submission = Submission {
                sender: ROVER,
                letter: letter(number),
                receivers: vec!["arm".into()],
                deadline: DEADLINE,
            };
            under_way.push_back((number, sender.send(submission)));
            if under_way.len() >= WINDOW
                && let Some((number, sending)) = under_way.pop_front()
            {
                let outcome = outcome(sending).await;
                noted.lock().note(number, outcome);
            }
            sleep(Duration::from_millis(1)).await;
        }
        for (number, sending) in under_way {
            let outcome = outcome(sending).await;
            noted.lock().note(number, outcome);
        }
    });
    let goes_on = async || {
        account.lock().in_a_row = 0;
        until("letters arrive", || account.lock().in_a_row >= IN_A_ROW).await;
    };

    goes_on().await;
    // Letters flow through shared memory until it is taken away, early or late.
    let shm_until = random.usize(..CHANGES / 2);
    let mut closing = Vec::new();
    for change in 0..CHANGES {
        sleep(Duration::from_millis(random.u64(5..300))).await;
        if change == shm_until {
            let shm = arms.transport(Kind::Shm);
            closing.push(spawn_blocking(move || shm.close()));
        }
        let link = if random.bool() { &quic } else { &tcp };
        let skies = [Sky::Clear, Sky::Silent, Sky::Unanswered, Sky::Broken];
        link.turn(skies[random.usize(..skies.len())]);
    }
    for link in [&quic, &tcp] {
        link.turn(Sky::Clear);
    }
    goes_on().await;
    // Letters arrive by TCP and their answers do not, then it breaks: they go again, by QUIC.
    quic.turn(Sky::Silent);
    let before = account.lock().went_by(Kind::Tcp);
    until("letters go by TCP", || {
        account.lock().went_by(Kind::Tcp) > before + IN_A_ROW
    })
    .await;
    quic.turn(Sky::Clear);
    tcp.turn(Sky::Unanswered);
    sleep(Duration::from_millis(random.u64(1..100))).await;
    tcp.turn(Sky::Broken);
    sleep(Duration::from_millis(random.u64(100..600))).await;
    tcp.turn(Sky::Clear);
    goes_on().await;
    // Until QUIC has been tried again.
    let before = account.lock().went_by(Kind::Quic);
    until("letters go by QUIC", || {
        account.lock().went_by(Kind::Quic) > before + IN_A_ROW
    })
    .await;
    let plug = arms.transport(Kind::Quic);
    closing.push(spawn_blocking(move || plug.close()));
    goes_on().await;
    stop.store(true, Ordering::Release);
    timeout(WATCHDOG, sending).await.unwrap().unwrap();
    until("what was delivered is taken", || {
        let account = account.lock();
        let delivered = account.outcomes.iter();
        let mut delivered = delivered.filter(|(_, it)| matches!(it, Outcome::Delivered { .. }));
        delivered.all(|(number, _)| account.taken.contains(number))
    })
    .await;
    receiving.abort();
    let told = {
        let account = account.lock();
        account.check();
        let by = ORDER.map(|kind| (kind, account.went_by(kind)));
        let failed = account.outcomes.values().filter(|it| !it.is_success());
        format!("{by:?}, {} failed", failed.count())
    };
    for closing in closing {
        timeout(WATCHDOG, closing).await.unwrap().unwrap();
    }
    for place in [&rovers, &arms] {
        place.mts.close(Duration::from_secs(1)).await;
    }
    for kind in ORDER {
        assert!(account.lock().went_by(kind) > 0, "nothing went by {kind}");
    }
    told
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
        println!("  {}", through(seed).await);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_does_not_go_in_the_clear_and_its_sender_is_told() {
    let here = host();
    let [ours, theirs] = friends(here.path(), ["rovers", "arms"]);
    let order = [Kind::Tcp, Kind::Quic];
    let start = |name, keys: &Security| {
        Place::with_keys(here.path(), name, &order, false, Some(keys.clone()))
    };
    let arms = start("arms", &theirs);
    // Somebody in the clear, where the arm was by TCP, or so it is said; he would take the letter.
    let plain = Place::start(here.path(), "plain", &[Kind::Tcp], false);
    for place in [&arms, &plain] {
        place.knows_arm_at(place.everywhere());
        place.mts.register("arm".into(), ARM);
    }
    let life = arms.at(Kind::Quic).incarnation();
    let said = plain.at(Kind::Tcp).with_incarnation(life);
    for (ways, by) in [
        (vec![said.clone(), arms.at(Kind::Quic)], Some(Kind::Quic)),
        (vec![said], None),
    ] {
        let rovers = start("rovers", &ours);
        rovers.knows_arm_at(ways);
        rovers.mts.register("rover".into(), ROVER);
        let sending = rovers.mts.send(Submission {
            sender: ROVER,
            letter: letter(1),
            receivers: vec!["arm".into()],
            deadline: Duration::from_secs(5),
        });
        let outcome = outcome(sending).await;
        assert_eq!(outcome.via(), by, "{outcome}");
        let tried = outcome.attempts().iter();
        let tried = tried.filter(|attempt| attempt.via == Kind::Tcp);
        assert!(tried.count() > 0, "nothing is told of TCP: {outcome}");
        rovers.mts.close(Duration::from_secs(1)).await;
    }
    let taken = timeout(WATCHDOG, arms.mts.receive(ARM)).await.unwrap();
    assert_eq!(number(&taken.unwrap().letter), 1);
    assert!(plain.mts.try_receive(ARM).is_none(), "it went in the clear");
    for place in [&arms, &plain] {
        place.mts.close(Duration::from_secs(1)).await;
    }
}

/// Notes how attempts were concluded.
#[derive(Default)]
struct Conclusions(Mutex<HashMap<AttemptId, Conclusion>>);

impl Sink for Conclusions {
    fn arrived(&self, _: Arrival) -> Verdict {
        Verdict::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: IpAddr) {}

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        self.0.lock().insert(attempt, conclusion);
    }
}

/// A service that is trusted and says again what it said before.
struct Parrot {
    transport: Arc<dyn Transport>,
    told: Arc<Conclusions>,
}

impl Parrot {
    fn over(kind: Kind, security: Security) -> Self {
        let identity = Identity {
            name: "rovers".into(),
            incarnation: Incarnation::random(),
            domain: "elsewhere".into(),
            host: "elsewhere".into(),
        };
        let (listen, limits) = (Vec::new(), Limits::default());
        let transport: Arc<dyn Transport> = match kind {
            Kind::Quic => {
                let config = QuicConfig {
                    listen,
                    identity,
                    limits,
                    security,
                };
                Arc::new(QuicTransport::new(config, Handle::current()))
            }
            _ => {
                let config = TcpConfig {
                    listen,
                    identity,
                    limits,
                    security: Some(security),
                };
                Arc::new(TcpTransport::new(config, Handle::current()))
            }
        };
        let told = Arc::new(Conclusions::default());
        transport.listen(told.clone()).unwrap();
        Self { transport, told }
    }

    /// Sends the letter with this number, again if it was sent before; waits for the answer.
    async fn say(&self, attempt: u64, to: &Place, kind: Kind, sequence: u64) {
        let parcel = Parcel {
            receiver: "arm".into(),
            stream: Stream {
                sender: ROVER,
                receiver: ARM,
            },
            sequence,
            after: sequence - 1,
            remaining: Duration::from_secs(30),
            hops: 0,
            body: Body::Letter(letter(sequence as usize)),
        };
        let attempt = AttemptId(attempt);
        self.transport
            .dispatch(attempt, &to.at(kind), parcel)
            .unwrap();
        until("an answer", || self.told.0.lock().contains_key(&attempt)).await;
        let told = self.told.0.lock()[&attempt].clone();
        assert!(matches!(told, Conclusion::Answered(_)), "{told:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_trusted_peer_says_again_is_taken_once() {
    let here = host();
    let [ours, theirs] = friends(here.path(), ["rovers", "arms"]);
    let order = [Kind::Quic, Kind::Tcp];
    let arms = Place::with_keys(here.path(), "arms", &order, false, Some(theirs));
    arms.knows_arm_at(arms.everywhere());
    arms.mts.register("arm".into(), ARM);
    // On one connection, on a new one of the same kind, and on one of the other kind.
    for (life, kind) in [Kind::Quic, Kind::Quic, Kind::Tcp, Kind::Tcp]
        .into_iter()
        .enumerate()
    {
        let parrot = Parrot::over(kind, ours.clone());
        for (attempt, sequence) in [1, 2, 1, 2, 2].into_iter().enumerate() {
            parrot.say(attempt as u64, &arms, kind, sequence).await;
        }
        let next = life as u64 + 3;
        parrot.say(99, &arms, kind, next).await;
        if life == 0 {
            for expected in [1, 2] {
                let taken = timeout(WATCHDOG, arms.mts.receive(ARM)).await.unwrap();
                assert_eq!(number(&taken.unwrap().letter), expected);
            }
        }
        let taken = timeout(WATCHDOG, arms.mts.receive(ARM)).await.unwrap();
        assert_eq!(number(&taken.unwrap().letter) as u64, next);
        parrot.transport.close();
    }
    assert!(arms.mts.try_receive(ARM).is_none(), "a letter twice");
    arms.mts.close(Duration::from_secs(1)).await;
}
