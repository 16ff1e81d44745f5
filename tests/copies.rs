//! Between two hosts, only the kernel copies large content. The sender writes it into shared memory;
//! from there it goes to the socket, and from the socket into the shared memory in which the receiver
//! reads it. Counters of all other copies stay at zero.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod services;

use std::time::{Duration, SystemTime};

use fipa::{AgentId, Kind, Message, Performative};
use fipa_acl::EnvelopeTemplate;
use fipa_mts::LetterDraft;
use fipa_mts::core::{Received, Submission};
use fipa_transport_net::Counters;
use fipa_transport_shm::ShmCounters;
use tokio::time::timeout;

use services::{ARM, ROVER, TestService, host};

const BOTH: [Kind; 2] = [Kind::Shm, Kind::Tcp];
const LETTERS: usize = 24;
/// Length of the first content, in bytes; each further one is a byte longer.
const LEN: usize = 1 << 20;

/// Makes the message; its content is written in service.
fn message() -> Message {
    Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap()
}

async fn received(service: &TestService) -> Received {
    let letter = timeout(Duration::from_secs(60), service.mts.receive(ARM)).await;
    letter.unwrap().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn only_the_kernel_copies_large_content() {
    let (here, there) = (host(), host());
    let (rovers, near) = (
        TestService::start(here.path(), "rovers", &[Kind::Shm], false),
        TestService::start(here.path(), "near", &BOTH, true),
    );
    let (far, arms) = (
        TestService::start(there.path(), "far", &BOTH, true),
        TestService::start(there.path(), "arms", &[Kind::Shm], false),
    );
    rovers.register_arm_at(vec![near.at(Kind::Shm)]);
    near.register_arm_at(vec![far.at(Kind::Tcp)]);
    far.register_arm_at(vec![arms.at(Kind::Shm)]);
    arms.register_arm_at(vec![arms.at(Kind::Shm)]);
    rovers.mts.register("rover".into(), ROVER);
    arms.mts.register("arm".into(), ARM);

    let message = message();
    for number in 0..LETTERS {
        let len = LEN + number;
        let mut template = EnvelopeTemplate::default();
        let draft = LetterDraft::new(message.clone(), len, SystemTime::now(), &mut template);
        let draft = draft.unwrap();
        let room = "arm".len() + draft.head_len();
        let mut loan = rovers
            .mts
            .loan(ROVER, &["arm"], room, len, draft.tail_len());
        loan.content_mut().fill(number as u8);
        let (_, letter) = draft.complete(loan.freeze());
        let sending = rovers.mts.submit(Submission {
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
    // The sender writes into shared memory, and the gateway reads it in service.
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
    // The gateway writes the frame to the socket from the letter's own memory, which `transport-net`
    // tests. The other gateway reads from the socket into the memory of the receiver.
    let Counters {
        placed,
        placed_moved_bytes,
        ..
    } = far.tcp();
    assert_eq!(placed, all);
    // Only bytes of the first letter that were read together with the hello are moved.
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

    for service in [&rovers, &near, &far, &arms] {
        service.mts.close(Duration::from_secs(1)).await;
    }
}
