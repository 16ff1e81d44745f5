//! Between two hosts, nobody but the kernel touches large content: it is written into shared memory
//! by its author, goes from there to the socket, and from the socket into the shared memory that
//! its receiver reads it in. Every way there is to copy it on the way is counted, and stays at zero.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod services;

use std::time::{Duration, SystemTime};

use fipa::{AgentId, Kind, Message, Performative};
use fipa_mts::core::{Received, Submission};
use fipa_mts::letter_around;
use fipa_transport_net::Counters;
use fipa_transport_shm::ShmCounters;
use tokio::time::timeout;

use services::{ARM, Place, ROVER, host};

const BOTH: [Kind; 2] = [Kind::Shm, Kind::Tcp];
const LETTERS: usize = 24;
/// With every letter of another length.
const LEN: usize = 1 << 20;

/// What is sent; the content is filled in place.
fn message() -> Message {
    Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap()
}

async fn received(place: &Place) -> Received {
    let letter = timeout(Duration::from_secs(60), place.mts.receive(ARM)).await;
    letter.unwrap().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn large_content_is_touched_by_the_kernel_alone() {
    let (here, there) = (host(), host());
    let (rovers, near) = (
        Place::start(here.path(), "rovers", &[Kind::Shm], false),
        Place::start(here.path(), "near", &BOTH, true),
    );
    let (far, arms) = (
        Place::start(there.path(), "far", &BOTH, true),
        Place::start(there.path(), "arms", &[Kind::Shm], false),
    );
    rovers.knows_arm_at(vec![near.at(Kind::Shm)]);
    near.knows_arm_at(vec![far.at(Kind::Tcp)]);
    far.knows_arm_at(vec![arms.at(Kind::Shm)]);
    arms.knows_arm_at(vec![arms.at(Kind::Shm)]);
    rovers.mts.register("rover".into(), ROVER);
    arms.mts.register("arm".into(), ARM);

    let message = message();
    for number in 0..LETTERS {
        let len = LEN + number;
        let (head, tail) = message.around_content(len).unwrap();
        let room = 4096 + head.len();
        let mut loan = rovers.mts.loan(ROVER, &["arm"], room, len, tail.len());
        loan.content_mut().fill(number as u8);
        let letter = letter_around(&message, loan.freeze(), SystemTime::now()).unwrap();
        let sending = rovers.mts.send(Submission {
            sender: ROVER,
            letter,
            receivers: vec!["arm".into()],
            deadline: Duration::from_secs(60),
        });
        let content = received(&arms).await.letter.into_payload().content;
        assert_eq!(content.len(), len);
        assert!(content.iter().all(|byte| *byte == number as u8));
        let outcomes = sending.outcomes().await;
        assert!(outcomes[0].1.is_success(), "{outcomes:?}");
    }

    let all = LETTERS as u64;
    // From its author's hands into shared memory, and held there by the gateway.
    let ShmCounters {
        loans_sent,
        loans_copied,
        ..
    } = rovers.shm();
    assert_eq!((loans_sent, loans_copied), (all, 0));
    let ShmCounters {
        in_place,
        copied_full,
        ..
    } = near.shm();
    assert_eq!((in_place, copied_full), (all, 0));
    // From there to the socket in pieces, which `transport-net` has tests for: a frame is written
    // from the letter's own memory. From the socket to where the receiver reads it:
    let Counters {
        placed,
        placed_moved_bytes,
        ..
    } = far.tcp();
    assert_eq!(placed, all);
    // Of the first one, what the hello before it was read together with.
    assert!(
        placed_moved_bytes < 16 << 10,
        "{placed_moved_bytes} bytes were moved"
    );
    let ShmCounters {
        loans_sent,
        loans_copied,
        ..
    } = far.shm();
    assert_eq!((loans_sent, loans_copied), (all, 0));
    let ShmCounters {
        in_place,
        copied_full,
        ..
    } = arms.shm();
    assert_eq!((in_place, copied_full), (all, 0));

    for place in [&rovers, &near, &far, &arms] {
        place.mts.close(Duration::from_secs(1)).await;
    }
}
