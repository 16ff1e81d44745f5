//! The interface of domains and agents: messages by builder, handles of an agent, the list of agents and
//! its changes, loans, and waits of threads.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod support;

use std::collections::BTreeSet;
use std::future::poll_fn;
use std::pin::Pin;
use std::time::Duration;

use fipa::Performative::{Inform, Request};
use fipa::blocking::Wait;
use fipa::error::{AgentIdError, BuildError, DeregisterError, ReceiveError, SendError};
use fipa::{Change, Config, Domain, FailureReason, Outcome, RegisterOptions};
use fipa_testbed::until_async;
use futures_core::Stream;
use support::{inform, two};

/// Longer than any step takes, also on a busy machine.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Makes a configuration for a domain that no other test uses, with a deadline for busy machines.
fn config(set: &[&str]) -> Config {
    support::config(&[&["mts.deadline=2min"], set].concat())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_is_sent_by_its_builder_and_a_bad_name_is_an_error_of_send() {
    let domain = Domain::open(&config(&[])).await.unwrap();
    let rover = domain.register("rover").await.unwrap();
    let arm = domain.register("arm_1").await.unwrap();
    let lift = rover.message(Request).receiver("arm_1").content(" 2.5\n");
    assert!(rover.send(lift).await.unwrap().all_succeeded());
    let letter = arm.receive_within(TIMEOUT).await.unwrap().unwrap();
    assert_eq!(letter.message().text(), " 2.5\n");
    assert_eq!(letter.message().parse::<f64>().unwrap(), 2.5);
    let answer = arm.reply(letter.message(), Inform).content("done");
    assert!(
        arm.send_within(answer, TIMEOUT)
            .await
            .unwrap()
            .all_succeeded()
    );
    assert_eq!(rover.receive().await.unwrap().message().text(), "done");

    let bad = || rover.message(Request).receivers(["arm_1", "arm\0"]);
    let is_bad_name = |error: &SendError| {
        matches!(
            error,
            SendError::Build(BuildError::Agent(AgentIdError::Nul(_)))
        )
    };
    assert!(is_bad_name(&rover.send(bad()).await.unwrap_err()));
    assert!(is_bad_name(&rover.loan(bad(), 10).unwrap_err()));
    // Nothing was sent.
    let nothing = arm.receive_within(Duration::from_millis(1)).await;
    assert!(nothing.unwrap().is_none());
}

#[tokio::test(flavor = "multi_thread")]
async fn the_last_handle_of_an_agent_deregisters_it() {
    let (here, there) = two(&config(&[])).await;
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm").await.unwrap();
    let handle = arm.clone();
    drop(arm);
    let letter = inform(&rover, "arm", "x");
    assert!(rover.send(letter).await.unwrap().all_succeeded());
    assert_eq!(handle.receive().await.unwrap().message().text(), "x");
    drop(handle);
    // The name is free.
    there.register("arm").await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn deregister_ends_all_handles() {
    let (here, there) = two(&config(&[])).await;
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm").await.unwrap();
    let (waiting, other) = (arm.clone(), arm.clone());
    let received = tokio::spawn(async move { waiting.receive().await.map(drop) });
    let first = inform(&rover, "arm", "first");
    assert!(rover.send(first).await.unwrap().all_succeeded());
    // The waiting call takes the first letter.
    assert!(received.await.unwrap().is_ok());
    let second = inform(&rover, "arm", "second");
    assert!(rover.send(second).await.unwrap().all_succeeded());
    let waiting = other.clone();
    let unread = arm.deregister().unwrap();
    assert_eq!(unread.len(), 1);
    assert_eq!(unread[0].message().text(), "second");
    assert!(matches!(waiting.receive().await, Err(ReceiveError::Closed)));
    let sent = other.send(inform(&other, "rover", "")).await;
    assert!(matches!(sent, Err(SendError::Deregistered)));
    let again = other.deregister();
    assert!(matches!(again, Err(DeregisterError::NotRegistered(_))));
    // The handle of an ended registration does not end the next one.
    let next = there.register("arm").await.unwrap();
    drop(waiting);
    let third = inform(&rover, "arm", "third");
    assert!(rover.send(third).await.unwrap().all_succeeded());
    assert_eq!(next.receive().await.unwrap().message().text(), "third");
}

#[tokio::test(flavor = "multi_thread")]
async fn deregister_ends_a_waiting_receive() {
    let domain = Domain::open(&config(&[])).await.unwrap();
    let arm = domain.register("arm").await.unwrap();
    let waiting = arm.clone();
    let mut received = Box::pin(async move { waiting.receive().await });
    // Polled once, so that it waits.
    poll_fn(|context| {
        assert!(received.as_mut().poll(context).is_pending());
        std::task::Poll::Ready(())
    })
    .await;
    arm.deregister().unwrap();
    let ended = tokio::time::timeout(TIMEOUT, received).await.unwrap();
    assert!(matches!(ended, Err(ReceiveError::Closed)));
}

#[tokio::test(flavor = "multi_thread")]
async fn each_message_goes_to_one_of_two_receive_calls() {
    const LETTERS: usize = 200;
    let (here, there) = two(&config(&[])).await;
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm").await.unwrap();
    let readers: Vec<_> = (0..2)
        .map(|_| {
            let arm = arm.clone();
            tokio::spawn(async move {
                let mut read = Vec::new();
                while let Ok(letter) = arm.receive().await {
                    match letter.message().text().parse::<usize>() {
                        Ok(number) => read.push(number),
                        Err(_) => return read,
                    }
                }
                read
            })
        })
        .collect();
    for number in 0..LETTERS {
        let letter = inform(&rover, "arm", number.to_string());
        assert!(rover.send(letter).await.unwrap().all_succeeded());
    }
    for _ in 0..2 {
        let end = inform(&rover, "arm", "end");
        assert!(rover.send(end).await.unwrap().all_succeeded());
    }
    let mut all = Vec::new();
    for reader in readers {
        let read = tokio::time::timeout(TIMEOUT, reader)
            .await
            .unwrap()
            .unwrap();
        assert!(read.is_sorted(), "{read:?}");
        all.extend(read);
    }
    all.sort_unstable();
    assert_eq!(all, (0..LETTERS).collect::<Vec<_>>());
}

fn of_type(agent_type: &str) -> RegisterOptions {
    RegisterOptions {
        agent_type: agent_type.into(),
        ..RegisterOptions::default()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn agents_are_listed_by_type_and_their_changes_are_a_stream() {
    let (here, there) = two(&config(&[])).await;
    let mut changes = here.changes();
    let rover = here.register("rover").await.unwrap();
    let arms = [
        there.register_with("arm_2", of_type("arm")).await.unwrap(),
        there.register_with("arm_1", of_type("arm")).await.unwrap(),
    ];
    let group = there
        .form("group", ["arm_1"], None, of_type("arm"))
        .await
        .unwrap();
    let names = |found: Vec<std::sync::Arc<fipa::Entry>>| {
        let names: Vec<String> = found.iter().map(|it| it.name.to_string()).collect();
        names.join(" ")
    };
    assert_eq!(names(here.agents()), "arm_1 arm_2 rover");
    assert_eq!(names(here.agents_of_type("arm")), "arm_1 arm_2");
    assert_eq!(names(here.agents_of_type("ar.*")), "");
    drop((arms, group));
    until_async("the arms have left", || names(here.agents()) == "rover").await;

    let mut left = BTreeSet::new();
    while left.len() < 3 {
        let next = poll_fn(|context| Pin::new(&mut changes).poll_next(context));
        let change = tokio::time::timeout(TIMEOUT, next).await.unwrap();
        for one in change.unwrap().single() {
            if let Change::Left(entry) = one {
                left.insert(entry.name.to_string());
            }
        }
    }
    assert!(left.contains("arm_1") && left.contains("group"), "{left:?}");
    // The stream ends with the last handle.
    drop(rover);
    here.close().await;
    let end = async { while changes.next().await.is_some() {} };
    tokio::time::timeout(TIMEOUT, end).await.unwrap();
}

#[test]
fn the_default_configuration_is_that_of_no_file() {
    let default = Config::default();
    let loaded = Config::load(&fipa::config::Sources {
        current_dir: None,
        home: None,
        variable: None,
        ..fipa::config::Sources::from_environment()
    });
    assert_eq!(default, loaded.unwrap());
    assert!(default.check().is_ok());
}

#[cfg(feature = "shm")]
#[tokio::test(flavor = "multi_thread")]
async fn a_loan_above_the_limit_is_refused_with_the_limit() {
    const LIMIT: u64 = 1 << 20;
    let config = config(&["transport.shm.max_letter=1MiB"]);
    let (here, there) = two(&config).await;
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm").await.unwrap();
    let loan = |len| rover.loan(rover.message(Inform).receiver("arm"), len);
    // The message and the envelope around the content count, too.
    for len in [LIMIT as usize, LIMIT as usize + 1, usize::MAX] {
        match loan(len) {
            Err(SendError::TooLarge { len: found, limit }) => {
                assert_eq!(limit, LIMIT);
                assert!(found > LIMIT);
            }
            other => panic!("{other:?}"),
        }
    }
    // The largest loan that is accepted is delivered.
    let largest = (0..4096).find_map(|less| loan(LIMIT as usize - less).ok());
    let sent = rover.send_loan(largest.unwrap()).await.unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    assert!(
        arm.receive()
            .await
            .unwrap()
            .message()
            .content()
            .unwrap()
            .len()
            > 1_000_000
    );
}

#[cfg(feature = "shm")]
#[tokio::test(flavor = "multi_thread")]
async fn memory_that_loans_hold_is_a_reason_of_its_own() {
    let config = config(&[
        "mts.transports=shm",
        "transport.shm.capacity=12MiB",
        "transport.shm.max_letter=4MiB",
    ]);
    let (here, there) = two(&config).await;
    let rover = here.register("rover").await.unwrap();
    let arm = there.register("arm").await.unwrap();
    // The connection needs memory of its own.
    let first = inform(&rover, "arm", "first");
    assert!(rover.send(first).await.unwrap().all_succeeded());
    let len = 3 << 20;
    let held: Vec<_> = (0..8)
        .map(|_| {
            rover
                .loan(rover.message(Inform).receiver("arm"), len)
                .unwrap()
        })
        .collect();
    let letter = || inform(&rover, "arm", vec![7; len]);
    let failed = rover.send_within(letter(), Duration::from_secs(5));
    let failed = failed.await.unwrap();
    match &failed.0[0].outcome {
        Outcome::Failed { reason, attempts } => {
            assert_eq!(*reason, FailureReason::NoRoom, "{failed}");
            let last = attempts.last().unwrap().to_string();
            assert!(last.contains("transport.shm.capacity"), "{last}");
        }
        other => panic!("{other}"),
    }
    drop(held);
    let sent = rover.send(letter()).await.unwrap();
    assert!(sent.all_succeeded(), "{sent}");
    assert_eq!(arm.receive().await.unwrap().message().text(), "first");
}

/// Uses calls that wait.
fn converse(config: &Config) {
    let domain = Domain::open(config).wait().unwrap();
    let mut changes = domain.changes();
    let rover = domain.register("rover").wait().unwrap();
    let arm = domain.register_with("arm", of_type("arm")).wait().unwrap();
    let joined = std::iter::from_fn(|| changes.next().wait()).find_map(|it| match it {
        Change::Joined(entry) if &*entry.name == "arm" => Some(entry.incarnation),
        _ => None,
    });
    assert_eq!(joined, Some(arm.incarnation()));
    // The letter is delivered although no call receives yet.
    let early = rover.message(Inform).receiver("arm").content("early");
    assert!(rover.send(early).wait().unwrap().all_succeeded());
    assert!(arm.try_receive().unwrap().is_some());
    assert!(
        arm.receive()
            .wait_within(Duration::from_millis(1))
            .is_none()
    );
    let echo = std::thread::spawn({
        let arm = arm.clone();
        move || {
            let letter = arm.receive().wait().unwrap();
            let answer = arm.reply(letter.message(), Inform).content("done");
            arm.send(answer).wait().unwrap()
        }
    });
    // More letters than the budget of a task of tokio.
    for _ in 0..300 {
        let sent = rover.send(rover.message(Inform).receiver("rover"));
        assert!(sent.wait().unwrap().all_succeeded());
        assert!(rover.receive_within(TIMEOUT).wait().unwrap().is_some());
    }
    let lift = rover.message(Request).receiver("arm").content("x");
    assert!(rover.send(lift).wait().unwrap().all_succeeded());
    let answer = rover.receive_within(TIMEOUT).wait().unwrap().unwrap();
    assert_eq!(answer.message().text(), "done");
    assert!(echo.join().unwrap().all_succeeded());
    drop((rover, arm));
    domain.close().wait();
}

#[test]
fn waits_work_without_a_runtime() {
    converse(&config(&[]));
}

#[tokio::test(flavor = "multi_thread")]
async fn waits_work_on_a_thread_of_a_runtime() {
    // On a worker, on a thread for blocking calls, and on the only thread of a runtime.
    converse(&config(&[]));
    let blocking = tokio::task::spawn_blocking(|| converse(&config(&[])));
    blocking.await.unwrap();
    let current = std::thread::spawn(|| {
        let runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = { runtime }.build().unwrap();
        runtime.block_on(async { converse(&config(&[])) });
    });
    current.join().unwrap();
    let domain = Domain::open(&config(&[])).wait().unwrap();
    let rover = domain.register("rover").wait().unwrap();
    domain.close().wait();
    assert!(matches!(rover.receive().wait(), Err(ReceiveError::Closed)));
}
