//! A process that forks without exec: its child can neither use nor release the parent's membership.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]
#![allow(
    clippy::print_stderr,
    reason = "the child has no other way to report a failure"
)]

mod support;

use std::process::Command;
use std::time::Duration;

use fipa::blocking::Wait;
use fipa::error::{CoalitionError, Forked, ReceiveError, RegisterError, SendError};
use fipa::{Agent, AgentId, Config, Domain, Incoming, Message, Performative, RegisterOptions};
use fork::{Fork, fork, waitpid};

/// Content that is large enough to be read in the sender's memory.
static CONTENT: [u8; 100_000] = [7; 100_000];

/// Exit code of a successful child. The child does not panic, because the report of a panic may need a
/// lock that another thread held at the fork.
const PASSED: i32 = 7;

fn config(domain: &str) -> Config {
    support::load([
        format!("domain={domain}"),
        "mts.transports=shm,unix,tcp".to_owned(),
        "mts.deadline=20s".to_owned(),
    ])
}

/// Runs one of the ignored tests in a process of its own, because a child has only the thread
/// that forked.
fn in_a_process(name: &str) {
    let home = tempfile::tempdir().unwrap();
    let run = home.path().join("run");
    let status = Command::new("timeout")
        .args(["--signal=KILL", "120"])
        .arg(std::env::current_exe().unwrap())
        .args([
            "--exact",
            name,
            "--ignored",
            "--nocapture",
            "--test-threads=1",
        ])
        .env("FIPA_RUNTIME_DIR", &run)
        .env("FIPA_FORK_TEST", name)
        .status()
        .unwrap();
    assert!(status.success(), "{name}: {status}");
    let left = std::fs::read_dir(&run).unwrap().count();
    assert_eq!(left, 0, "files are left in {}", run.display());
}

/// Returns the domain of this process, which no other process uses.
fn domain_name() -> String {
    assert!(std::env::var_os("FIPA_FORK_TEST").is_some());
    format!("fork-{}", std::process::id())
}

fn letter(from: &Agent, to: &str) -> Message {
    let message = from.message(Performative::Inform);
    let message = message.receiver(AgentId::new(to).unwrap());
    message.content(CONTENT.to_vec()).build().unwrap()
}

fn is_delivered(from: &Agent, to: &str) -> bool {
    let sent = from.send(letter(from, to)).wait().unwrap();
    sent.all_succeeded()
}

fn is_whole(incoming: &Incoming) -> bool {
    let content = incoming.message().content();
    content.is_some_and(|content| content[..] == CONTENT)
}

/// Ends the child with an exit code that depends on the checks.
fn exit(checks: &[(&str, bool)]) -> ! {
    let failed = checks.iter().filter(|(_, passed)| !passed);
    let failed: Vec<&str> = failed.map(|(name, _)| *name).collect();
    if !failed.is_empty() {
        eprintln!("in the child: {failed:?}");
    }
    std::process::exit(if failed.is_empty() { PASSED } else { 1 })
}

#[track_caller]
fn wait_for(child: i32) {
    let status = waitpid(child).unwrap();
    // The exit code is in the second byte.
    assert_eq!(status, PASSED << 8, "the child failed");
}

#[test]
fn a_child_neither_uses_nor_releases_its_parents_membership() {
    in_a_process("parent_of_a_child_that_drops");
}

#[test]
#[ignore = "is run by the other test in a process of its own"]
fn parent_of_a_child_that_drops() {
    let config = config(&domain_name());
    let (here, there) = (
        Domain::open(&config).wait().unwrap(),
        Domain::open(&config).wait().unwrap(),
    );
    let (arm, leg) = (
        here.register("arm").wait().unwrap(),
        there.register("leg").wait().unwrap(),
    );
    let team = ["arm", "leg"];
    assert!(is_delivered(&leg, "arm"));
    assert!(is_delivered(&arm, "leg"));
    let held = arm.receive().wait().unwrap();
    let loan = arm.loan(letter(&arm, "leg"), CONTENT.len()).unwrap();

    match fork().unwrap() {
        Fork::Child => {
            let send = arm.send(letter(&arm, "leg")).wait();
            let loaned = arm.loan(letter(&arm, "leg"), CONTENT.len());
            let received = arm.receive().wait();
            let waited = arm.receive_within(Duration::from_millis(1)).wait();
            let registered = here.register("foot").wait();
            let formed = here
                .form("pair", ["arm"], None, RegisterOptions::default())
                .wait();
            let parent = std::os::unix::process::parent_id();
            let refused = Forked { owner: parent };
            let checks = [
                (
                    "send",
                    matches!(send, Err(SendError::Forked(it)) if it == refused),
                ),
                ("loan", matches!(loaned, Err(SendError::Forked(_)))),
                ("receive", matches!(received, Err(ReceiveError::Forked(_)))),
                ("wait", matches!(waited, Err(ReceiveError::Forked(_)))),
                (
                    "register",
                    matches!(registered, Err(RegisterError::Forked(_))),
                ),
                (
                    "form",
                    matches!(
                        formed,
                        Err(CoalitionError::Register(RegisterError::Forked(_)))
                    ),
                ),
                ("content", is_whole(&held)),
            ];
            drop((held, loan, arm, leg));
            here.close().wait();
            drop(there);
            exit(&checks);
        }
        Fork::Parent(child) => wait_for(child),
    }

    // The parent still has its letters and registrations.
    assert!(is_whole(&held));
    for name in team {
        assert!(here.directory().lookup(name).is_some(), "{name}");
    }
    // More letters than slots, to show that no slot was returned twice.
    for _ in 0..40 {
        assert!(is_delivered(&leg, "arm"));
        assert!(is_delivered(&arm, "leg"));
        for agent in [&arm, &leg] {
            let received = agent.receive().wait().unwrap();
            assert!(is_whole(&received));
        }
    }
    let mut loan = loan;
    loan.content_mut().fill(9);
    assert!(arm.send_loan(loan).wait().unwrap().all_succeeded());
    let newcomer = Domain::open(&config).wait().unwrap();
    let visitor = newcomer.register("visitor").wait().unwrap();
    assert!(is_delivered(&visitor, "arm"));
    assert!(is_whole(&held));
    drop((held, visitor, arm, leg));
    for domain in [newcomer, here, there] {
        domain.close().wait();
    }
    let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
    let prefix = format!("fipa_{}_", domain_name());
    let mut ours = files.filter(|file| file.file_name().to_string_lossy().starts_with(&prefix));
    assert!(ours.next().is_none(), "shared memory is left");
}

#[test]
fn a_child_can_join_the_domain_with_a_membership_of_its_own() {
    in_a_process("parent_of_a_child_that_joins");
}

#[test]
#[ignore = "is run by the other test in a process of its own"]
fn parent_of_a_child_that_joins() {
    let config = config(&domain_name());
    let here = Domain::open(&config).wait().unwrap();
    let arm = here.register("arm").wait().unwrap();
    match fork().unwrap() {
        Fork::Child => {
            let own = Domain::open(&config).wait().unwrap();
            let foot = own.register("foot").wait().unwrap();
            let checks = [("delivered", is_delivered(&foot, "arm"))];
            drop(foot);
            own.close().wait();
            drop((arm, here));
            exit(&checks);
        }
        Fork::Parent(child) => wait_for(child),
    }
    assert!(is_whole(&arm.receive().wait().unwrap()));
    drop(arm);
    here.close().wait();
}
