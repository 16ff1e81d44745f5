//! An agent that moves from host to host keeps its name, and letters on their way follow it or
//! fail: three gateways and their robots, on loopback.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use fipa::config::Sources;
use fipa::{
    Agent, AgentId, Config, Domain, FailureReason, Gateway, Incoming, Kind, Outcome, Performative,
    RegisterError,
};
use parking_lot::Mutex;
use tokio::sync::Semaphore;

const LETTERS: usize = 1000;
const MOVES: usize = 20;
/// What the agent takes on each host at least before it moves on.
const STAY: usize = 20;
/// Letters without an outcome at a time.
const UNDER_WAY: usize = 16;

struct Host {
    gateway: Gateway,
    domain: Domain,
}

impl Host {
    /// A host of its own, as far as names and shared memory go, that knows these others.
    async fn start(peers: &[&Self]) -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let mark = format!(
            "{}-{}",
            std::process::id(),
            NEXT.fetch_add(1, Ordering::Relaxed)
        );
        let peers: Vec<String> = peers
            .iter()
            .map(|peer| {
                format!(
                    "\"{}\" = [\"tcp://{}\"]",
                    peer.gateway.name(),
                    peer.address()
                )
            })
            .collect();
        let set = vec![
            format!("domain=moves-{mark}"),
            format!("mts.name=gateway-{mark}"),
            "discovery.mdns=false".to_owned(),
            format!("discovery.static={{ {} }}", peers.join(", ")),
        ];
        let sources = Sources {
            set,
            ..Sources::default()
        };
        let config = Config::load(&sources).unwrap();
        Self {
            gateway: Gateway::open(&config).await.unwrap(),
            domain: Domain::open(&config).await.unwrap(),
        }
    }

    fn address(&self) -> String {
        let mut ways = self.gateway.locations().into_iter();
        let way = ways.find(|way| way.kind() == Kind::Tcp).unwrap();
        way.address().to_owned()
    }

    /// The agent registers here as soon as this host knows that it has left the other.
    async fn welcome(&self, name: &str) -> Agent {
        let started = Instant::now();
        loop {
            match self.domain.register(name) {
                Ok(agent) => return agent,
                Err(RegisterError::AlreadyRegistered { .. }) => {}
                Err(other) => panic!("{other}"),
            }
            assert!(started.elapsed() < Duration::from_secs(60), "never free");
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    }
}

/// The letters that the agent has taken, in order, whichever life of it.
#[derive(Default)]
struct Taken {
    numbers: Mutex<Vec<usize>>,
    in_this_life: AtomicUsize,
}

impl Taken {
    fn take(&self, incoming: &Incoming) {
        // Gateways may have something to say, too.
        if *incoming.message.performative() != Performative::Inform {
            return;
        }
        let text = String::from_utf8(incoming.message.content().unwrap().to_vec()).unwrap();
        self.numbers.lock().push(text.parse().unwrap());
        self.in_this_life.fetch_add(1, Ordering::Relaxed);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_letter_to_an_agent_on_the_move_has_one_outcome_and_it_is_true() {
    let first = Host::start(&[]).await;
    let second = Host::start(&[&first]).await;
    let third = Host::start(&[&first, &second]).await;
    let rover = Arc::new(first.domain.register("rover").unwrap());
    let taken = Arc::new(Taken::default());
    let moved = Arc::new(AtomicUsize::new(0));

    let sending = tokio::spawn(send_all(Arc::clone(&rover), Arc::clone(&moved)));
    // Now where the sender is, too.
    let hosts = [&second, &third, &first];
    let mut arm = hosts[0].welcome("arm").await;
    for next in 1..=MOVES {
        taken.in_this_life.store(0, Ordering::Relaxed);
        while taken.in_this_life.load(Ordering::Relaxed) < STAY && !sending.is_finished() {
            let waited = tokio::time::timeout(Duration::from_millis(50), arm.receive()).await;
            if let Ok(received) = waited {
                taken.take(&received.unwrap());
            }
        }
        for unread in arm.deregister().unwrap() {
            taken.take(&unread.unwrap());
        }
        arm = hosts[next % hosts.len()].welcome("arm").await;
        moved.store(next, Ordering::Relaxed);
    }
    let outcomes = {
        let sending = sending;
        tokio::pin!(sending);
        loop {
            tokio::select! {
                received = arm.receive() => taken.take(&received.unwrap()),
                outcomes = &mut sending => break outcomes.unwrap(),
            }
        }
    };
    for unread in arm.deregister().unwrap() {
        taken.take(&unread.unwrap());
    }
    check(&outcomes, &taken.numbers.lock());
    for host in [first, second, third] {
        host.gateway.close().await;
    }
}

/// Sends all letters, and the last of them when the agent has moved for the last time.
async fn send_all(rover: Arc<Agent>, moved: Arc<AtomicUsize>) -> BTreeMap<usize, Outcome> {
    let room = Arc::new(Semaphore::new(UNDER_WAY));
    let outcomes = Arc::new(Mutex::new(BTreeMap::new()));
    for number in 0..LETTERS {
        let started = Instant::now();
        // Some for each stay; and none while nobody knows the name, which would fail at once.
        let waits = |moved: usize| {
            let known = rover.domain().directory().known("arm").is_some();
            !known || number >= (moved + 2) * LETTERS / (MOVES + 2)
        };
        while waits(moved.load(Ordering::Relaxed)) {
            assert!(started.elapsed() < Duration::from_secs(60), "never moves");
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let place = Arc::clone(&room).acquire_owned().await.unwrap();
        let message = rover
            .message(Performative::Inform)
            .receiver(AgentId::new("arm").unwrap())
            .content(number.to_string())
            .build()
            .unwrap();
        let sending = rover.send(message);
        let outcomes = Arc::clone(&outcomes);
        tokio::spawn(async move {
            let deliveries = sending.await.unwrap();
            let [delivery] = &deliveries.0[..] else {
                panic!("not one outcome: {deliveries:?}");
            };
            let before = outcomes.lock().insert(number, delivery.outcome.clone());
            assert_eq!(before, None);
            drop(place);
        });
    }
    drop(room.acquire_many(UNDER_WAY as u32).await.unwrap());
    Arc::into_inner(outcomes).unwrap().into_inner()
}

fn check(outcomes: &BTreeMap<usize, Outcome>, taken: &[usize]) {
    assert_eq!(outcomes.len(), LETTERS);
    for (number, outcome) in outcomes {
        let times = taken.iter().filter(|taken| *taken == number).count();
        let right = match outcome {
            Outcome::Delivered { .. } => times == 1,
            Outcome::Failed {
                reason: FailureReason::Unconfirmed,
                ..
            } => times <= 1,
            Outcome::Failed { .. } => times == 0,
            _ => false,
        };
        assert!(right, "letter {number} was taken {times} times: {outcome}");
    }
    assert!(taken.is_sorted(), "out of order: {taken:?}");
    assert!(taken.len() >= MOVES * STAY, "only {} arrived", taken.len());
}
