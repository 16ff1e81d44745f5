//! A mailbox that the maximum number of processes have open: the letters of further processes take the
//! next route.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod services;

use std::time::Duration;

use fipa::{Kind, Outcome};
use fipa_mts::core::Submission;
use fipa_transport::Incarnation;
use tokio::time;

use services::{ARM, TestService, host, letter, number};

const ORDER: [Kind; 2] = [Kind::Shm, Kind::Unix];

/// Maximum number of processes that can have the mailbox open.
const CLIENTS: usize = 3;

/// Number of processes that send.
const SENDERS: usize = 6;

#[tokio::test(flavor = "multi_thread")]
async fn beyond_max_clients_letters_take_the_next_route() {
    let host = host();
    let arms = TestService::with_clients(host.path(), "arms", &ORDER, CLIENTS);
    arms.mts.register("arm".into(), ARM);
    let mut senders = Vec::new();
    for sender in 0..SENDERS {
        let service = TestService::start(host.path(), &format!("rovers-{sender}"), &ORDER, false);
        service.register_arm_at(arms.all_locations());
        let rover = Incarnation::random();
        service.mts.register("rover".into(), rover);
        for letter in 0..3 {
            let outcome = send((&service, rover), &arms, 10 * sender + letter).await;
            let Outcome::Delivered { via, attempts } = outcome else {
                panic!("{outcome}");
            };
            let expected = match sender < CLIENTS {
                true => Kind::Shm,
                false => Kind::Unix,
            };
            assert_eq!(via, expected, "sender {sender}");
            // The outcome has the reason for the failed attempt, at least the first time.
            if letter == 0 && expected == Kind::Unix {
                let reasons: Vec<String> = attempts.iter().map(ToString::to_string).collect();
                let reasons = reasons.join("; ");
                assert!(reasons.contains("max_clients"), "{reasons}");
            }
        }
        senders.push((service, rover));
    }
    assert_eq!(arms.shm().arrived, 3 * CLIENTS as u64);

    // After a process leaves, another one can open the mailbox.
    let (left, _) = senders.remove(0);
    left.mts.close(Duration::from_secs(1)).await;
    drop(left);
    let (last, rover) = senders.pop().unwrap();
    let timeout = async {
        for attempt in 100.. {
            let outcome = send((&last, rover), &arms, attempt).await;
            if matches!(outcome, Outcome::Delivered { via: Kind::Shm, .. }) {
                return;
            }
            assert!(outcome.is_success(), "{outcome}");
        }
    };
    time::timeout(Duration::from_secs(60), timeout)
        .await
        .unwrap();
}

/// Sends a letter with this number and receives it.
async fn send(
    (from, rover): (&TestService, Incarnation),
    to: &TestService,
    sequence: usize,
) -> Outcome {
    let sending = from.mts.submit(Submission {
        sender: rover,
        letter: letter(sequence),
        receivers: vec!["arm".into()],
        deadline: Duration::from_secs(20),
    });
    let received = time::timeout(Duration::from_secs(60), to.mts.receive(ARM)).await;
    assert_eq!(number(&received.unwrap().unwrap().letter), sequence);
    sending.outcomes().await.remove(0).1
}
