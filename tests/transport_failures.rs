//! Each transport of the receiver is closed while letters flow, in each position of the order. Every
//! letter arrives once and in order, and later letters take the next route.
//!
//! With `--nocapture` the test prints the time from each failure until a letter was delivered by
//! another transport. The system reports all these failures.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod services;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa::{Kind, Message, Outcome};
use fipa_mts::Sending;
use fipa_mts::core::Submission;
use tokio::task::{JoinHandle, spawn_blocking};
use tokio::time::timeout;

use services::{ARM, ROVER, TestService, host, letter};

/// Number of letters per transport.
const EACH: usize = 60;
/// Maximum number of letters without an outcome.
const WINDOW: usize = 8;
const WATCHDOG: Duration = Duration::from_secs(120);

/// Makes a submission of a letter with this number.
fn submission(number: usize) -> Submission {
    Submission {
        sender: ROVER,
        letter: letter(number),
        receivers: vec!["arm".into()],
        deadline: Duration::from_secs(60),
    }
}

/// Waits for the delivery of a letter. Returns its transport and the time of the outcome.
async fn delivered(sending: Sending) -> (Kind, Instant) {
    let outcomes = timeout(WATCHDOG, sending.outcomes()).await.unwrap();
    match &outcomes[..] {
        [(_, Outcome::Delivered { via, .. })] => (*via, Instant::now()),
        other => panic!("{other:?}"),
    }
}

/// Sends letters and closes one transport after the other. Returns the failed and the next transport
/// and the time of each change.
async fn close_transports(order: [Kind; 3]) -> Vec<(Kind, Kind, Duration)> {
    let here = host();
    let rovers = TestService::start(here.path(), "rovers", &order, false);
    let arms = TestService::start(here.path(), "arms", &order, false);
    rovers.register_arm_at(arms.all_locations());
    arms.register_arm_at(arms.all_locations());
    rovers.mts.register("rover".into(), ROVER);
    arms.mts.register("arm".into(), ARM);
    let total = EACH * order.len();

    let receiver = arms.mts.clone();
    let receiving = tokio::spawn(async move {
        for number in 0..=total {
            let letter = timeout(WATCHDOG, receiver.receive(ARM)).await.unwrap();
            let payload = letter.unwrap().letter.into_payload();
            let message = Message::decode(&payload).unwrap();
            assert_eq!(message.content().unwrap(), &number.to_string());
        }
    });

    let mut under_way = VecDeque::new();
    let mut went = Vec::new();
    let mut pulled: Vec<(Kind, Instant, JoinHandle<()>)> = Vec::new();
    for number in 0..total {
        if number > 0 && number % EACH == 0 {
            let kind = order[pulled.len()];
            let transport = arms.transport(kind);
            pulled.push((
                kind,
                Instant::now(),
                spawn_blocking(move || transport.close()),
            ));
        }
        under_way.push_back(rovers.mts.submit(submission(number)));
        if under_way.len() >= WINDOW {
            went.push(delivered(under_way.pop_front().unwrap()).await);
        }
    }
    for sending in under_way {
        went.push(delivered(sending).await);
    }
    let mut closed = Vec::new();
    for (kind, at, closing) in pulled {
        timeout(WATCHDOG, closing).await.unwrap().unwrap();
        closed.push((kind, at));
    }
    went.push(delivered(rovers.mts.submit(submission(total))).await);
    timeout(WATCHDOG, receiving).await.unwrap().unwrap();
    assert!(
        arms.mts
            .try_receive(ARM)
            .is_ok_and(|letter| letter.is_none()),
        "a letter twice"
    );

    // The last letter takes the only remaining transport. The transports of earlier ones also depend on
    // the load of the machine.
    assert_eq!(went.last().unwrap().0, order[2], "{order:?}");
    let mut changes = Vec::new();
    for (kind, at) in closed {
        let mut others = went.iter().filter(|(via, _)| *via != kind);
        let (next, known) = others.find(|(_, known)| *known > at).unwrap();
        changes.push((kind, *next, *known - at));
    }
    for service in [&rovers, &arms] {
        service.mts.close(Duration::from_secs(1)).await;
    }
    changes
}

#[tokio::test(flavor = "multi_thread")]
async fn a_closed_transport_loses_duplicates_and_reorders_no_letters() {
    let [shm, unix, tcp, udp] = [Kind::Shm, Kind::Unix, Kind::Tcp, Kind::Udp];
    for order in [
        [shm, unix, tcp],
        [unix, shm, tcp],
        [unix, tcp, shm],
        [shm, tcp, udp],
        [shm, udp, tcp],
        [tcp, shm, udp],
        [tcp, udp, unix],
        [udp, unix, tcp],
        [udp, tcp, shm],
    ] {
        for (broken, next, took) in close_transports(order).await {
            println!("{broken} failed; next delivery by {next} after {took:.1?}");
        }
    }
}
