//! An agent that moves from host to host keeps its name, and letters in transit follow it or fail.
//! Three gateways and their robot processes, on loopback.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use fipa::error::RegisterError;
use fipa::{Agent, AgentId, Domain, FailureReason, Gateway, Incoming, Kind, Outcome, Performative};
use parking_lot::Mutex;
use support::config;
use tokio::sync::Semaphore;

const LETTERS: usize = 1000;
const MOVES: usize = 20;
/// Minimum number of letters that the agent receives on each host before it moves.
const STAY: usize = 20;
/// Maximum number of letters without an outcome.
const UNDER_WAY: usize = 16;

struct Host {
    gateway: Gateway,
    domain: Domain,
}

impl Host {
    /// Starts a simulated host, with names and shared memory of its own, that knows these peers.
    async fn start(peers: &[&Self]) -> Self {
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
        let config = config(&[&format!("discovery.static={{ {} }}", peers.join(", "))]);
        Self {
            gateway: Gateway::open(&config).await.unwrap(),
            domain: Domain::open(&config).await.unwrap(),
        }
    }

    fn address(&self) -> String {
        let mut locations = self.gateway.locations().into_iter();
        let location = locations.find(|it| it.kind() == Kind::Tcp).unwrap();
        location.address().to_owned()
    }

    /// Registers the agent here as soon as this host knows that it has left the other host.
    async fn register_when_free(&self, name: &str) -> Agent {
        let started = Instant::now();
        loop {
            match self.domain.register(name).await {
                Ok(agent) => return agent,
                Err(RegisterError::AlreadyRegistered { .. }) => {}
                Err(other) => panic!("{other}"),
            }
            assert!(started.elapsed() < Duration::from_secs(60), "never free");
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    }
}

/// The letters that all incarnations of the agent have received, in order.
#[derive(Default)]
struct Taken {
    numbers: Mutex<Vec<usize>>,
    in_this_life: AtomicUsize,
}

impl Taken {
    fn take(&self, incoming: &Incoming) {
        // Gateways may send failure messages.
        if *incoming.message().performative() != Performative::Inform {
            return;
        }
        let text = String::from_utf8(incoming.message().content().unwrap().to_vec()).unwrap();
        self.numbers.lock().push(text.parse().unwrap());
        self.in_this_life.fetch_add(1, Ordering::Relaxed);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_letter_to_a_moving_agent_has_one_correct_outcome() {
    let first = Host::start(&[]).await;
    let second = Host::start(&[&first]).await;
    let third = Host::start(&[&first, &second]).await;
    let rover = Arc::new(first.domain.register("rover").await.unwrap());
    let taken = Arc::new(Taken::default());
    let moved = Arc::new(AtomicUsize::new(0));

    let sending = tokio::spawn(send_all(Arc::clone(&rover), Arc::clone(&moved)));
    // The agent also moves to the host of the sender.
    let hosts = [&second, &third, &first];
    let mut arm = hosts[0].register_when_free("arm").await;
    for next in 1..=MOVES {
        taken.in_this_life.store(0, Ordering::Relaxed);
        while taken.in_this_life.load(Ordering::Relaxed) < STAY && !sending.is_finished() {
            let waited = tokio::time::timeout(Duration::from_millis(50), arm.receive()).await;
            if let Ok(received) = waited {
                taken.take(&received.unwrap());
            }
        }
        for unread in arm.deregister().unwrap() {
            taken.take(&unread);
        }
        arm = hosts[next % hosts.len()].register_when_free("arm").await;
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
        taken.take(&unread);
    }
    check(&outcomes, &taken.numbers.lock());
    for host in [first, second, third] {
        host.gateway.close().await;
    }
}

/// Sends all letters, the last of them after the last move of the agent.
async fn send_all(rover: Arc<Agent>, moved: Arc<AtomicUsize>) -> BTreeMap<usize, Outcome> {
    let room = Arc::new(Semaphore::new(UNDER_WAY));
    let outcomes = Arc::new(Mutex::new(BTreeMap::new()));
    for number in 0..LETTERS {
        let started = Instant::now();
        // Sends some letters per stay, and none while the name is unknown, because they would fail.
        let waits = |moved: usize| {
            let known = rover.domain().directory().known("arm").is_some();
            !known || number >= (moved + 2) * LETTERS / (MOVES + 2)
        };
        while waits(moved.load(Ordering::Relaxed)) {
            assert!(started.elapsed() < Duration::from_secs(60), "never moves");
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let permit = Arc::clone(&room).acquire_owned().await.unwrap();
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
            drop(permit);
        });
    }
    drop(room.acquire_many(UNDER_WAY as u32).await.unwrap());
    std::mem::take(&mut outcomes.lock())
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
