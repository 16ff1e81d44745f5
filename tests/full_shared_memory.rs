//! A `/dev/shm` that is too small or full: letters take the next route, errors name the cause, and no
//! process gets a signal.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use fipa::{AgentId, Config, Domain, Kind, Outcome, Performative};

#[test]
fn letters_without_space_take_the_next_route() {
    fipa_testbed::isolated("inside_letters_without_space_take_the_next_route", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_letters_without_space_take_the_next_route() {
    fipa_testbed::enter();
    fipa_testbed::run("mount -t tmpfs -o size=6M tmpfs /dev/shm");
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(large_contents());
}

/// Makes a configuration for a domain with this random name, because process numbers repeat in
/// namespaces.
fn config(name: u64, transports: &str) -> Config {
    support::load([
        format!("domain=cramped-{name:x}"),
        "discovery.mdns=false".to_owned(),
        format!("mts.transports={transports}"),
    ])
}

async fn large_contents() {
    let config = config(fastrand::u64(..), "shm,unix");
    let here = Domain::open(&config).await.unwrap();
    let there = Domain::open(&config).await.unwrap();
    let rover = here.register("rover").await.unwrap();
    let arms = [
        there.register("arm_0").await.unwrap(),
        there.register("arm_1").await.unwrap(),
    ];
    let mut transports_used = Vec::new();
    // The letters are kept, so that each needs new memory. They are for one receiver, loaned for one,
    // and for both, in turn.
    let mut kept = Vec::new();
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
            assert_eq!(incoming.message().content().unwrap(), &vec![round; len]);
            kept.push(incoming);
        }
        for delivery in sent.0 {
            let Outcome::Delivered { via, attempts } = delivery.outcome else {
                panic!("{}", delivery.outcome);
            };
            for attempt in &attempts {
                let reason = attempt.to_string();
                assert!(reason.contains("/dev/shm"), "{reason}");
            }
            transports_used.push(via);
        }
    }
    assert!(transports_used.contains(&Kind::Shm), "{transports_used:?}");
    assert!(transports_used.contains(&Kind::Unix), "{transports_used:?}");
    // Small letters are still delivered.
    kept.clear();
    let message = rover
        .message(Performative::Inform)
        .receiver(AgentId::new("arm_0").unwrap())
        .content(vec![1; 100])
        .build()
        .unwrap();
    assert!(rover.send(message).await.unwrap().all_succeeded());
}

#[test]
fn a_full_file_system_is_a_failed_attempt() {
    fipa_testbed::isolated("inside_a_full_file_system_is_a_failed_attempt", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_a_full_file_system_is_a_failed_attempt() {
    fipa_testbed::enter();
    fipa_testbed::run("mount -t tmpfs -o size=16M tmpfs /dev/shm");
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(full());
}

/// Takes all but this many bytes of the file system, as another program would, or frees it.
fn leave(free: Option<u64>) {
    let outsider = std::fs::File::create("/dev/shm/outsider").unwrap();
    let Some(left) = free else {
        return;
    };
    let found = rustix::fs::statvfs("/dev/shm").unwrap();
    let taken = found.f_bavail * found.f_frsize - left;
    rustix::fs::fallocate(&outsider, rustix::fs::FallocateFlags::empty(), 0, taken).unwrap();
}

async fn full() {
    let name = fastrand::u64(..);
    let here = Domain::open(&config(name, "shm,unix")).await.unwrap();
    let there = Domain::open(&config(name, "shm,unix")).await.unwrap();
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm").await.unwrap();
    let letter = async || {
        let message = rover
            .message(Performative::Inform)
            .receiver(AgentId::new("arm").unwrap())
            .content(vec![1; 5000])
            .build()
            .unwrap();
        let sent = rover.send(message).await.unwrap();
        arm.receive().await.unwrap();
        let delivery = sent.0.into_iter().next().unwrap();
        let Outcome::Delivered { via, attempts } = delivery.outcome else {
            panic!("{}", delivery.outcome);
        };
        let attempts = attempts.iter().map(ToString::to_string);
        (via, attempts.collect::<Vec<_>>().join("; "))
    };
    // The first letter to the arm, without any free space.
    leave(Some(0));
    let (via, attempts) = letter().await;
    assert_eq!(via, Kind::Unix);
    assert!(attempts.contains("/dev/shm"), "{attempts}");
    // A process starts without shared memory, if it has another transport.
    let late = Domain::open(&config(name, "shm,unix")).await.unwrap();
    drop(late);
    let error = Domain::open(&config(name, "shm")).await.err().unwrap();
    assert!(error.to_string().contains("/dev/shm"), "{error}");
    // The file system is large enough again.
    leave(None);
    let began = std::time::Instant::now();
    while letter().await.0 != Kind::Shm {
        assert!(began.elapsed() < std::time::Duration::from_secs(60));
    }
}
