//! Each transport is taken away from the receiver while letters flow, in each position of the order:
//! every letter arrives once and in order, and those that follow go the next way.
//!
//! With `--nocapture` it says how long it took from the moment a way broke until a letter had been
//! delivered by another: the system tells of all these breaks.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod services;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use fipa::{Kind, Message, Outcome};
use fipa_mts::Sending;
use fipa_mts::core::Submission;
use tokio::task::{JoinHandle, spawn_blocking};
use tokio::time::timeout;

use services::{ARM, Place, ROVER, host, letter};

/// Letters by each way.
const EACH: usize = 60;
/// Letters under way.
const WINDOW: usize = 8;
const WATCHDOG: Duration = Duration::from_secs(120);

/// A letter with this number.
fn submission(number: usize) -> Submission {
    Submission {
        sender: ROVER,
        letter: letter(number),
        receivers: vec!["arm".into()],
        deadline: Duration::from_secs(60),
    }
}

/// The way that a letter went, and when that was known.
async fn delivered(sending: Sending) -> (Kind, Instant) {
    let outcomes = timeout(WATCHDOG, sending.outcomes()).await.unwrap();
    match &outcomes[..] {
        [(_, Outcome::Delivered { via, .. })] => (*via, Instant::now()),
        other => panic!("{other:?}"),
    }
}

/// Sends letters, pulls one plug after the other, and returns how long each change took.
async fn pull_plugs(order: [Kind; 3]) -> Vec<(Kind, Kind, Duration)> {
    let here = host();
    let rovers = Place::start(here.path(), "rovers", &order, false);
    let arms = Place::start(here.path(), "arms", &order, false);
    rovers.knows_arm_at(arms.everywhere());
    arms.knows_arm_at(arms.everywhere());
    rovers.mts.register("rover".into(), ROVER);
    arms.mts.register("arm".into(), ARM);
    let total = EACH * order.len();

    let receiver = arms.mts.clone();
    let receiving = tokio::spawn(async move {
        for number in 0..total {
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
            let plug = arms.transport(kind);
            pulled.push((kind, Instant::now(), spawn_blocking(move || plug.close())));
        }
        under_way.push_back(rovers.mts.send(submission(number)));
        if under_way.len() >= WINDOW {
            went.push(delivered(under_way.pop_front().unwrap()).await);
        }
    }
    for sending in under_way {
        went.push(delivered(sending).await);
    }
    timeout(WATCHDOG, receiving).await.unwrap().unwrap();
    assert!(arms.mts.try_receive(ARM).is_none(), "a letter twice");

    // What is left at the end goes the only way that is left; which one a letter goes before depends
    // on how busy the machine is, too.
    assert_eq!(went.last().unwrap().0, order[2], "{order:?}");
    let mut changes = Vec::new();
    for (kind, at, closing) in pulled {
        timeout(WATCHDOG, closing).await.unwrap().unwrap();
        let mut others = went.iter().filter(|(via, _)| *via != kind);
        let (next, known) = others.find(|(_, known)| *known > at).unwrap();
        changes.push((kind, *next, *known - at));
    }
    for place in [&rovers, &arms] {
        place.mts.close(Duration::from_secs(1)).await;
    }
    changes
}

#[tokio::test(flavor = "multi_thread")]
async fn a_plug_that_is_pulled_loses_doubles_and_disorders_nothing() {
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
        for (broken, next, took) in pull_plugs(order).await {
            println!("{broken} broke: by {next} after {took:.1?}");
        }
    }
}
