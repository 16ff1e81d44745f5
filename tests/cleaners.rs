//! Programs that clean `/tmp`: they skip the runtime directory, or the processes join it again.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

mod support;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use fipa::blocking::Wait;
use fipa::{Agent, AgentId, Config, Domain, Performative};
use fipa_testbed::ignored_test;

const WATCHDOG: Duration = Duration::from_secs(60);

/// Lengths of content that is copied, and of content that is read in the sender's memory.
const LENGTHS: [usize; 2] = [10, 100_000];

/// Runs one of the ignored tests in a process of its own, with this runtime directory.
fn with_runtime_dir(name: &str, runtime_dir: &Path) {
    let status = ignored_test(name)
        .env("FIPA_RUNTIME_DIR", runtime_dir)
        .status()
        .unwrap();
    assert!(status.success(), "{name}: {status}");
    let left = std::fs::read_dir(runtime_dir).into_iter().flatten();
    assert_eq!(left.count(), 0, "files are left");
}

fn runtime_dir() -> PathBuf {
    std::env::var_os("FIPA_RUNTIME_DIR").unwrap().into()
}

fn config(transports: &str) -> Config {
    support::load([
        format!("domain=cleaned-{}", std::process::id()),
        format!("mts.transports={transports}"),
        "mts.deadline=2s".to_owned(),
    ])
}

fn is_delivered(from: &Agent, to: &Agent, len: usize) -> bool {
    let message = from.message(Performative::Inform);
    let message = message.receiver(AgentId::new(to.name()).unwrap());
    let message = message.content(vec![1; len]).build().unwrap();
    let delivered = from.send(message).wait().unwrap().all_succeeded();
    while let Ok(Some(_)) = to.receive_within(Duration::ZERO).wait() {}
    delivered
}

/// Waits until letters of all sizes arrive in both directions.
fn until_letters_arrive(one: &Agent, other: &Agent) {
    let began = Instant::now();
    for (from, to) in [(one, other), (other, one)] {
        for len in LENGTHS {
            while !is_delivered(from, to, len) {
                let names = (from.name(), to.name());
                assert!(began.elapsed() < WATCHDOG, "never: {names:?}, {len} bytes");
            }
        }
    }
}

#[test]
fn agents_are_reachable_again_after_their_directory_was_removed() {
    let home = tempfile::tempdir().unwrap();
    with_runtime_dir(
        "inside_a_directory_that_is_removed",
        &home.path().join("run"),
    );
}

#[test]
#[ignore = "is run by the other test in a process of its own"]
fn inside_a_directory_that_is_removed() {
    let run = runtime_dir();
    for transports in ["shm", "unix", "shm,unix"] {
        let config = config(transports);
        let domains = [(); 2].map(|()| Domain::open(&config).wait().unwrap());
        let (arm, leg) = (
            domains[0].register("arm").wait().unwrap(),
            domains[1].register("leg").wait().unwrap(),
        );
        until_letters_arrive(&arm, &leg);
        for moved in [false, true] {
            let away = run.with_extension("away");
            match moved {
                // Fails if the processes join again before all files are removed.
                false => drop(std::fs::remove_dir_all(&run)),
                // The kernel does not report this.
                true => std::fs::rename(&run, &away).unwrap(),
            }
            // A name may be unknown until all processes have joined again.
            until_letters_arrive(&arm, &leg);
            let newcomer = Domain::open(&config).wait().unwrap();
            let foot = newcomer.register("foot").wait().unwrap();
            until_letters_arrive(&foot, &arm);
            until_letters_arrive(&foot, &leg);
            drop(foot);
            newcomer.close().wait();
            let _ = std::fs::remove_dir_all(away);
        }
        drop((arm, leg));
        for domain in domains {
            domain.close().wait();
        }
    }
}

#[test]
fn systemd_tmpfiles_skips_a_directory_in_use() {
    let home = tempfile::tempdir().unwrap();
    let version = Command::new("systemd-tmpfiles").arg("--version").output();
    if version.is_err() {
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "systemd-tmpfiles is missing");
        eprintln!("SKIPPED, not a success: needs systemd-tmpfiles");
        return;
    }
    let cleaned = home.path().join("cleaned");
    std::fs::create_dir(&cleaned).unwrap();
    with_runtime_dir("inside_a_cleaned_directory", &cleaned.join("fipa-1000"));
}

#[test]
#[ignore = "is run by the other test in a process of its own"]
fn inside_a_cleaned_directory() {
    let run = runtime_dir();
    let cleaned = run.parent().unwrap();
    let config = config("shm,unix");
    let domain = Domain::open(&config).wait().unwrap();
    let (arm, leg) = (
        domain.register("arm").wait().unwrap(),
        domain.register("leg").wait().unwrap(),
    );
    let files = || -> Vec<PathBuf> {
        let mut found = vec![run.clone()];
        let mut next = 0;
        while let Some(path) = found.get(next).cloned() {
            let below = std::fs::read_dir(path).into_iter().flatten().flatten();
            found.extend(below.map(|entry| entry.path()));
            next += 1;
        }
        found.sort();
        found
    };
    let before = files();
    assert!(before.len() > 10, "{before:?}");
    // Cleans the parent, as for `/tmp`, and the runtime directory itself. With age 0, all files are old.
    for line in [cleaned, &run] {
        let idle = line.join("idle");
        std::fs::create_dir(&idle).unwrap();
        std::fs::write(idle.join("file"), "").unwrap();
        let rules = cleaned.with_extension("conf");
        std::fs::write(&rules, format!("d {} - - - 0\n", line.display())).unwrap();
        let status = Command::new("systemd-tmpfiles")
            .arg("--clean")
            .arg(format!("--prefix={}", cleaned.display()))
            .arg(&rules)
            .status()
            .unwrap();
        assert!(status.success());
        assert!(!idle.exists(), "{} was not cleaned", line.display());
        assert_eq!(files(), before);
    }
    until_letters_arrive(&arm, &leg);
    drop((arm, leg));
    domain.close().wait();
}
