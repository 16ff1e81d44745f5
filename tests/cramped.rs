//! A `/dev/shm` that is too small: an error that says so, another way, and never a signal.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use fipa::config::Sources;
use fipa::{AgentId, Config, Domain, Kind, Outcome, Performative};

#[test]
fn what_has_no_room_takes_the_next_way() {
    fipa_testbed::isolated("inside_what_has_no_room_takes_the_next_way", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_what_has_no_room_takes_the_next_way() {
    fipa_testbed::enter();
    fipa_testbed::run("mount -t tmpfs -o size=6M tmpfs /dev/shm");
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(large_contents());
}

async fn large_contents() {
    let config = Config::load(&Sources {
        set: vec![
            format!("domain=cramped-{}", std::process::id()),
            "discovery.mdns=false".into(),
            "mts.transports=shm,tcp".into(),
        ],
        ..Sources::default()
    });
    let config = config.unwrap();
    let here = Domain::open(&config).await.unwrap();
    let there = Domain::open(&config).await.unwrap();
    let rover = here.register("rover").unwrap();
    let arms = [
        there.register("arm_0").unwrap(),
        there.register("arm_1").unwrap(),
    ];
    let mut ways = Vec::new();
    // Held, so that every letter needs new memory; for one, loaned for one, and for both.
    let mut held = Vec::new();
    for round in 0..24_u8 {
        let len = 300_000 + 100_000 * usize::from(round);
        let to = if round % 3 == 2 { "arm_.*" } else { "arm_0" };
        let message = rover
            .message(Performative::Inform)
            .receiver(AgentId::new(to).unwrap())
            .content(vec![round; len])
            .build()
            .unwrap();
        let sent = if round % 3 == 1 {
            let mut loan = rover.loan(message, len).unwrap();
            loan.content_mut().fill(round);
            rover.send_loan(loan).await.unwrap()
        } else {
            rover.send(message).await.unwrap()
        };
        assert!(sent.all_succeeded(), "{sent}");
        let receivers = if to == "arm_0" { &arms[..1] } else { &arms };
        for receiver in receivers {
            let incoming = receiver.receive().await.unwrap();
            assert_eq!(incoming.message.content().unwrap(), &vec![round; len]);
            held.push(incoming);
        }
        for delivery in sent.0 {
            let Outcome::Delivered { via, attempts } = delivery.outcome else {
                panic!("{}", delivery.outcome);
            };
            for attempt in &attempts {
                let said = attempt.to_string();
                assert!(said.contains("/dev/shm"), "{said}");
            }
            ways.push(via);
        }
    }
    assert!(ways.contains(&Kind::Shm), "{ways:?}");
    assert!(ways.contains(&Kind::Tcp), "{ways:?}");
    // Small letters still go.
    held.clear();
    let message = rover
        .message(Performative::Inform)
        .receiver(AgentId::new("arm_0").unwrap())
        .content(vec![1; 100])
        .build()
        .unwrap();
    assert!(rover.send(message).await.unwrap().all_succeeded());
}
