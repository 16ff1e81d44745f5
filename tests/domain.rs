//! The guarantees for robot processes: agents of several processes of one host exchange letters. Each
//! process is a membership of its own, here in one test process.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::collections::HashSet;
use std::convert::Infallible;
use std::time::Duration;

use fipa::blocking::Wait;
use fipa::error::RegisterError;
use fipa::protocol::Reply;
use fipa::{Agent, AgentId, Deliveries, Domain, FailureReason, Kind, Outcome, Performative};
use support::{config, inform, two};

fn only(deliveries: &Deliveries) -> &Outcome {
    assert_eq!(deliveries.0.len(), 1, "{deliveries}");
    &deliveries.0[0].outcome
}

fn reason(deliveries: &Deliveries) -> FailureReason {
    match only(deliveries) {
        Outcome::Failed { reason, .. } => *reason,
        other => panic!("{other}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn letters_arrive_in_both_directions_and_report_their_transport() {
    for (transports, via) in [
        ("shm,unix,tcp", Kind::Shm),
        ("unix", Kind::Unix),
        ("unix,shm", Kind::Unix),
        // Processes do not use TCP unless transport.tcp.processes is true.
        ("tcp,unix", Kind::Unix),
    ] {
        let config = config(&[&format!("mts.transports={transports}")]);
        let (here, there) = two(&config).await;
        let (rover, arm) = (
            here.register("rover").await.unwrap(),
            there.register("arm").await.unwrap(),
        );
        let (conversation, reply_with) = (rover.unique_id(), rover.unique_id());
        assert_ne!(conversation, reply_with);
        assert_ne!(conversation, arm.unique_id());
        let question = rover
            .message(Performative::Request)
            .receiver(arm.id().clone())
            .content("lift")
            .protocol("fipa-request")
            .conversation_id(&conversation)
            .reply_with(&reply_with)
            .build()
            .unwrap();
        let deliveries = rover.send(question).await.unwrap();
        assert_eq!(
            only(&deliveries),
            &Outcome::Delivered {
                via,
                attempts: Vec::new()
            }
        );
        let asked = arm.receive().await.unwrap();
        assert_eq!(asked.via, Some(via));
        let answer = arm
            .reply(asked.message(), Performative::Agree)
            .build()
            .unwrap();
        assert!(arm.send(answer).await.unwrap().all_succeeded());
        let answered = rover.receive().await.unwrap();
        assert_eq!(answered.message().in_reply_to(), Some(&*reply_with));
        assert_eq!(answered.message().conversation_id(), Some(&*conversation));
        drop((rover, arm));
        here.close().await;
        there.close().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_name_belongs_to_one_agent_at_a_time() {
    let config = config(&[]);
    let (here, there) = two(&config).await;
    let first = here.register("arm").await.unwrap();
    for domain in [&here, &there] {
        match domain.register("arm").await {
            Err(RegisterError::AlreadyRegistered { holder }) => {
                assert_eq!(holder.incarnation, first.incarnation());
            }
            Err(other) => panic!("{other}"),
            Ok(_) => panic!("two agents have one name"),
        }
    }
    assert!(first.deregister().unwrap().is_empty());
    there.register("arm").await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_thousand_letters_arrive_in_order_and_once() {
    let config = config(&["mts.queue=16", "mts.deadline=2min"]);
    let (here, there) = two(&config).await;
    let (rover, arm) = (
        here.register("rover").await.unwrap(),
        there.register("arm").await.unwrap(),
    );
    assert_in_order(&rover, arm, 1_000).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn letters_stay_in_order_while_several_tasks_of_their_receiver_wait() {
    let config = config(&["mts.deadline=2min"]);
    let (here, there) = two(&config).await;
    let (rover, arm) = (
        here.register("rover").await.unwrap(),
        there.register("arm").await.unwrap(),
    );
    // Each of them takes letters, and hands over those of the other tasks.
    let mut servers = Vec::new();
    for protocol in ["fipa-request", "fipa-query", "fipa-contract-net"] {
        let server = arm.serve(protocol, async |_| {
            Ok::<_, Infallible>(Reply::Refuse("".into()))
        });
        servers.push(server.unwrap());
    }
    assert_in_order(&rover, arm, 4_000).await;
}

/// Sends numbers to an agent, and asserts that it receives them in order and once.
async fn assert_in_order(rover: &Agent, arm: Agent, total: u32) {
    let reading = tokio::spawn(async move {
        let mut seen = Vec::new();
        while seen.len() < total as usize {
            let incoming = arm.receive().await.unwrap();
            let content = incoming.message().content().unwrap();
            seen.push(u32::from_le_bytes(content[..].try_into().unwrap()));
        }
        seen
    });
    let mut sending = Vec::new();
    for number in 0..total {
        // Polled once here, so that the letters are sent in this order; awaited later.
        let message = inform(rover, "arm", number.to_le_bytes());
        let mut send = Box::pin(async move { rover.send(message).await.unwrap() });
        let first = futures_poll_once(&mut send).await;
        sending.push((first, send));
    }
    for (first, send) in sending {
        let deliveries = match first {
            Some(deliveries) => deliveries,
            None => send.await,
        };
        assert!(deliveries.all_succeeded(), "{deliveries}");
    }
    assert_eq!(reading.await.unwrap(), (0..total).collect::<Vec<_>>());
}

/// Polls a future once.
async fn futures_poll_once<T>(
    future: &mut std::pin::Pin<Box<impl Future<Output = T>>>,
) -> Option<T> {
    std::future::poll_fn(|context| match future.as_mut().poll(context) {
        std::task::Poll::Ready(value) => std::task::Poll::Ready(Some(value)),
        std::task::Poll::Pending => std::task::Poll::Ready(None),
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_queue_fails_at_the_deadline_and_does_not_block_other_receivers() {
    let config = config(&["mts.queue=2"]);
    let (here, there) = two(&config).await;
    let rover = here.register("rover").await.unwrap();
    let (slow, quick) = (
        there.register("slow").await.unwrap(),
        there.register("quick").await.unwrap(),
    );
    for _ in 0..2 {
        assert!(
            rover
                .send(inform(&rover, "slow", "x"))
                .await
                .unwrap()
                .all_succeeded()
        );
    }
    let short = Duration::from_secs(2);
    let blocked = rover.send_within(inform(&rover, "slow", "too much"), short);
    let meanwhile = async {
        for _ in 0..20 {
            assert!(
                rover
                    .send(inform(&rover, "quick", "x"))
                    .await
                    .unwrap()
                    .all_succeeded()
            );
            quick.receive().await.unwrap();
        }
    };
    let (blocked, ()) = tokio::join!(blocked, meanwhile);
    assert_eq!(reason(&blocked.unwrap()), FailureReason::QueueFull);
    // The sender gets a failure message. The next letter waits until the receiver reads.
    let failure = rover.receive().await.unwrap();
    assert_eq!(*failure.message().performative(), Performative::Failure);
    let waiting = rover.send(inform(&rover, "slow", "in time"));
    let reading = async {
        let mut seen = Vec::new();
        for _ in 0..3 {
            seen.push(
                slow.receive()
                    .await
                    .unwrap()
                    .message()
                    .content()
                    .unwrap()
                    .to_vec(),
            );
        }
        seen
    };
    let (waiting, seen) = tokio::join!(waiting, reading);
    assert!(waiting.unwrap().all_succeeded());
    assert_eq!(seen, [b"x".to_vec(), b"x".to_vec(), b"in time".to_vec()]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pattern_reaches_all_but_the_sender() {
    let config = config(&[]);
    let (here, there) = two(&config).await;
    let sender = here.register("arm_0").await.unwrap();
    let mut others = Vec::new();
    for number in 1..4 {
        others.push(there.register(&format!("arm_{number}")).await.unwrap());
    }
    let stranger = there.register("camera").await.unwrap();
    let deliveries = sender
        .send(inform(&sender, "arm_.*", "stop"))
        .await
        .unwrap();
    let reached: HashSet<&str> = deliveries
        .0
        .iter()
        .map(|delivery| &*delivery.receiver)
        .collect();
    assert_eq!(reached, HashSet::from(["arm_1", "arm_2", "arm_3"]));
    assert!(deliveries.all_succeeded(), "{deliveries}");
    for arm in &others {
        assert_eq!(
            arm.receive().await.unwrap().message().content().unwrap(),
            "stop"
        );
    }
    assert!(stranger.try_receive().unwrap().is_none());
    assert!(sender.try_receive().unwrap().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unknown_name_yields_one_failure_message() {
    let domain = Domain::open(&config(&[])).await.unwrap();
    let rover = domain.register("rover").await.unwrap();
    for to in ["unknown", "unknown_.*", "broken("] {
        let deliveries = rover.send(inform(&rover, to, "hello")).await.unwrap();
        assert_eq!(reason(&deliveries), FailureReason::NoSuchAgent);
        let failure = rover.receive().await.unwrap().into_message();
        assert_eq!(*failure.performative(), Performative::Failure);
        assert_eq!(failure.ontology(), Some("fipa-agent-management"));
        let content = String::from_utf8(failure.content().unwrap().to_vec()).unwrap();
        assert!(
            content.contains("no such agent") && content.contains(to),
            "{content}"
        );
        // A failure about a failure is never sent.
        let failure = rover
            .message(Performative::Failure)
            .receiver(AgentId::new(to).unwrap())
            .build()
            .unwrap();
        assert_eq!(
            reason(&rover.send(failure).await.unwrap()),
            FailureReason::NoSuchAgent
        );
        assert!(rover.try_receive().unwrap().is_none());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn loaned_content_is_not_copied() {
    let config = config(&[]);
    let (here, there) = two(&config).await;
    let (rover, arm) = (
        here.register("rover").await.unwrap(),
        there.register("arm").await.unwrap(),
    );
    for len in [100_000, 4 << 20] {
        let mut loan = rover.loan(inform(&rover, "arm", []), len).unwrap();
        for (index, byte) in loan.content_mut().iter_mut().enumerate() {
            *byte = index as u8;
        }
        assert!(rover.send_loan(loan).await.unwrap().all_succeeded());
        let incoming = arm.receive().await.unwrap();
        let content = incoming.message().content().unwrap();
        assert_eq!(content.len(), len);
        assert!(
            content
                .iter()
                .enumerate()
                .all(|(index, byte)| *byte == index as u8)
        );
        assert!(is_shared_memory(content), "{len} bytes were copied");
    }
    // A loan of shared memory takes longer than a copy of short content.
    for (len, is_shared) in [(4095, false), (4096, true)] {
        let mut loan = rover.loan(inform(&rover, "arm", []), len).unwrap();
        loan.content_mut().fill(9);
        assert_eq!(is_shared_memory(loan.content_mut()), is_shared, "{len}");
        assert!(rover.send_loan(loan).await.unwrap().all_succeeded());
        let incoming = arm.receive().await.unwrap();
        assert_eq!(incoming.message().content().unwrap(), &vec![9; len]);
    }
    // Short content for several receivers is copied for each of them.
    let other = there.register("arm_2").await.unwrap();
    for len in [5000, 1 << 20] {
        let mut loan = rover.loan(inform(&rover, "arm.*", []), len).unwrap();
        loan.content_mut().fill(7);
        assert!(rover.send_loan(loan).await.unwrap().all_succeeded());
        for receiver in [&arm, &other] {
            let incoming = receiver.receive().await.unwrap();
            assert_eq!(incoming.message().content().unwrap(), &vec![7; len]);
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn large_content_for_several_receivers_is_in_memory_once() {
    let config = config(&[]);
    let (here, there) = two(&config).await;
    let rover = here.register("rover").await.unwrap();
    let mut arms = Vec::new();
    for number in 0..4 {
        arms.push(there.register(&format!("arm_{number}")).await.unwrap());
    }
    let message = |to: &[&str]| {
        let empty = rover.message(Performative::Inform);
        let message = to.iter().fold(empty, |message, to| {
            message.receiver(AgentId::new(*to).unwrap())
        });
        message.content(vec![7; 1 << 20]).build().unwrap()
    };
    let mut loan = rover.loan(message(&["arm.*"]), 1 << 20).unwrap();
    loan.content_mut().fill(7);
    let content: *const u8 = loan.content_mut().as_ptr();
    assert!(is_shared_memory(loan.content_mut()));
    let sendings = [
        rover.send_loan(loan).await,
        rover.send(message(&["arm.*"])).await,
        rover
            .send(message(&["arm_0", "arm_1", "arm_2", "arm_3"]))
            .await,
    ];
    for sent in sendings {
        assert!(sent.unwrap().all_succeeded());
        let mut places = HashSet::new();
        for arm in &arms {
            let incoming = arm.receive().await.unwrap();
            let content = incoming.message().content().unwrap();
            assert_eq!(content, &vec![7; 1 << 20]);
            assert!(is_shared_memory(content));
            places.insert(content.as_ptr());
        }
        // All agents of one process read the same bytes, in a mapping other than the sender's.
        assert_eq!(places.len(), 1);
        assert!(!places.contains(&content));
    }
    // An unknown receiver does not affect the delivery to the other one.
    let sent = rover.send(message(&["arm_0", "unknown"])).await.unwrap();
    assert_eq!(sent.0.len(), 2, "{sent}");
    let incoming = arms[0].receive().await.unwrap();
    assert_eq!(incoming.message().content().unwrap(), &vec![7; 1 << 20]);
}

#[tokio::test(flavor = "multi_thread")]
async fn large_content_for_several_receivers_also_reaches_those_without_shared_memory() {
    let config = config(&["mts.transports=shm,unix"]);
    let domain = format!("domain={}", config.domain);
    let plain = support::load([&*domain, "discovery.mdns=false", "mts.transports=unix"]);
    let here = Domain::open(&config).await.unwrap();
    let (there, beyond) = (
        Domain::open(&config).await.unwrap(),
        Domain::open(&plain).await.unwrap(),
    );
    let rover = here.register("rover").await.unwrap();
    let arms = [
        there.register("arm_0").await.unwrap(),
        there.register("arm_1").await.unwrap(),
        beyond.register("arm_2").await.unwrap(),
    ];
    let sent = rover
        .send(inform(&rover, "arm.*", vec![9; 1 << 20]))
        .await
        .unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    for (arm, via) in arms.iter().zip([Kind::Shm, Kind::Shm, Kind::Unix]) {
        let incoming = arm.receive().await.unwrap();
        assert_eq!(incoming.via, Some(via));
        assert_eq!(incoming.message().content().unwrap(), &vec![9; 1 << 20]);
    }
}

fn is_shared_memory(bytes: &[u8]) -> bool {
    let address = bytes.as_ptr() as usize;
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    maps.lines()
        .filter(|line| line.contains("/dev/shm/fipa_"))
        .any(|line| {
            let (from, to) = line.split(' ').next().unwrap().split_once('-').unwrap();
            let number = |text| usize::from_str_radix(text, 16).unwrap();
            (number(from)..number(to)).contains(&address)
        })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_letter_that_is_too_large_fails_with_that_reason() {
    let config = config(&["transport.shm.max_letter=64KiB"]);
    let domain = Domain::open(&config).await.unwrap();
    let (rover, arm) = (
        domain.register("rover").await.unwrap(),
        domain.register("arm").await.unwrap(),
    );
    let deliveries = rover
        .send(inform(&rover, "arm", vec![0; 100_000]))
        .await
        .unwrap();
    assert_eq!(reason(&deliveries), FailureReason::TooLarge);
    assert_eq!(only(&deliveries).attempts().len(), 2, "{deliveries}");
    assert!(
        rover
            .send(inform(&rover, "arm", "small"))
            .await
            .unwrap()
            .all_succeeded()
    );
    assert_eq!(
        arm.receive().await.unwrap().message().content().unwrap(),
        "small"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deregistered_agent_is_unknown_and_its_successor_is_reached() {
    let config = config(&[]);
    let (here, there) = two(&config).await;
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm").await.unwrap();
    assert!(
        rover
            .send(inform(&rover, "arm", "first"))
            .await
            .unwrap()
            .all_succeeded()
    );
    let unread = arm.deregister().unwrap();
    let [unread] = &unread[..] else {
        panic!("one message waited: {unread:?}");
    };
    assert_eq!(unread.message().content().unwrap(), "first");
    let gone = rover.send(inform(&rover, "arm", "between")).await.unwrap();
    assert_eq!(reason(&gone), FailureReason::NoSuchAgent);
    let arm = there.register("arm").await.unwrap();
    assert!(
        rover
            .send(inform(&rover, "arm", "second"))
            .await
            .unwrap()
            .all_succeeded()
    );
    assert_eq!(
        arm.receive().await.unwrap().message().content().unwrap(),
        "second"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn closing_a_domain_removes_its_files_and_shared_memory() {
    let config = config(&[]);
    let names = || {
        let shm = std::fs::read_dir("/dev/shm").unwrap();
        let names = shm.map(|file| file.unwrap().file_name().to_string_lossy().into_owned());
        names
            .filter(|name| name.contains(&config.domain))
            .collect::<Vec<_>>()
    };
    let user = std::os::unix::fs::MetadataExt::uid(&std::fs::metadata("/proc/self").unwrap());
    let dir = format!("/tmp/fipa-{user}/{}", config.domain);
    let domain = Domain::open(&config).await.unwrap();
    let (rover, arm) = (
        domain.register("rover").await.unwrap(),
        domain.register("arm").await.unwrap(),
    );
    assert!(
        rover
            .send(inform(&rover, "arm", vec![0; 50_000]))
            .await
            .unwrap()
            .all_succeeded()
    );
    let held = arm.receive().await.unwrap();
    assert!(!names().is_empty());
    drop((held, rover, arm));
    domain.close().await;
    assert_eq!(names(), Vec::<String>::new());
    assert!(!std::path::Path::new(&dir).exists());
}

#[tokio::test(flavor = "multi_thread")]
async fn calls_after_closing_the_domain_fail_and_do_not_hang() {
    let (here, there) = two(&config(&[])).await;
    let (rover, arm) = (
        here.register("rover").await.unwrap(),
        there.register("arm").await.unwrap(),
    );
    let message = inform(&rover, arm.name(), "too late");
    here.close().await;
    let deliveries = rover.send(message).await.unwrap();
    assert!(!deliveries.all_succeeded(), "{deliveries}");
    let ended = loop {
        match rover.receive().await {
            // Failure messages from before the end may still be read.
            Ok(incoming) => assert_eq!(*incoming.message().performative(), Performative::Failure),
            Err(error) => break error,
        }
    };
    assert!(
        matches!(ended, fipa::error::ReceiveError::Closed),
        "{ended}"
    );
}

#[test]
fn processes_may_join_and_leave_concurrently() {
    let config = config(&[]);
    std::thread::scope(|scope| {
        for member in 0..6 {
            let config = &config;
            scope.spawn(move || {
                for round in 0..10 {
                    let domain = Domain::open(config).wait().unwrap();
                    let agent = domain
                        .register(&format!("agent-{member}-{round}"))
                        .wait()
                        .unwrap();
                    let entry = domain.directory().lookup(agent.name()).unwrap();
                    assert_eq!(entry.locations.len(), 2, "a transport could not be used");
                    drop(agent);
                    domain.close().wait();
                }
            });
        }
    });
}

#[tokio::test(flavor = "multi_thread")]
async fn a_process_does_not_use_the_network_and_its_error_names_the_transports_to_list() {
    let config = config(&["mts.transports=tcp"]);
    let error = Domain::open(&config).await.err().unwrap().to_string();
    assert!(error.contains("list shm or unix"), "{error}");
    assert!(error.contains("transport.tcp.processes"), "{error}");
}

#[tokio::test(flavor = "multi_thread")]
async fn routes_apply_within_a_host_and_no_other_transport_is_used() {
    let config = config(&["routes={ \"arm\" = [\"tcp\"], \"leg\" = [\"unix\"] }"]);
    let (here, there) = two(&config).await;
    let rover = here.register("rover").await.unwrap();
    for (name, via) in [
        ("arm", None),
        ("leg", Some(Kind::Unix)),
        ("eye", Some(Kind::Shm)),
    ] {
        let agent = there.register(name).await.unwrap();
        let sent = rover.send(inform(&rover, name, "x")).await.unwrap();
        // A process uses no TCP here, so the letter to the arm fails.
        assert_eq!(only(&sent).via(), via, "{sent}");
        drop(agent);
    }
}
