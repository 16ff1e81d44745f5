//! One scenario between two processes, for each pair of languages: the leader runs the steps against the server, and
//! prints what it observes. Every leader must print `scenario.txt`.

#![allow(clippy::expect_used, reason = "a failed precondition fails the test")]

use std::fs;
use std::io::{BufRead as _, BufReader, Read as _};
use std::path::PathBuf;
use std::process::Stdio;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use common::{Language, RunDomain, Workshop, here};
use fipa_testbed::ChildGuard;

mod common;

/// Number of pairs that run at the same time.
const AT_ONCE: usize = 4;
/// Time in seconds after which a leader that hangs is killed. No run takes a tenth of it.
const WATCHDOG: &str = "200";
/// The roles of the programs, and their indices.
const ROLES: [&str; 2] = ["serve", "lead"];
const SERVE: usize = 0;
const LEAD: usize = 1;
/// The step at which the server is killed.
const LAST_REQUEST: &str = "request without an end: ";

/// Returns a line without the random digits of conversation identifiers.
fn without_digits(line: &str) -> String {
    let mut parts = line.split("rover--");
    let mut result = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let rest = part.trim_start_matches(|digit: char| digit.is_ascii_hexdigit());
        result.push_str("rover--ID");
        result.push_str(rest);
    }
    result
}

/// Runs the scenario, and returns the output of the leader. Kills the server while the leader waits for it.
fn run(workshop: &Workshop, domain: &RunDomain, leader: &Language, server: &Language) -> String {
    let mut command = domain.command(workshop, &server.programs[SERVE]);
    let (mut serving, ready) = ChildGuard::until_ready(command.arg("arm"));
    assert_eq!(ready, "ready\n");
    let watched = [
        &["timeout".into(), WATCHDOG.into()],
        &leader.programs[LEAD][..],
    ]
    .concat();
    let mut command = domain.command(workshop, &watched);
    command.args(["rover", "arm"]);
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut leading = ChildGuard::start(&mut command);
    let output = leading.child().stdout.take().expect("its output");
    let mut observed = String::new();
    for line in BufReader::new(output).lines() {
        let line = line.expect("a text");
        if line.starts_with(LAST_REQUEST) {
            serving.kill();
        }
        observed.push_str(&without_digits(&line));
        observed.push('\n');
    }
    let mut errors = String::new();
    let mut from = leading.child().stderr.take().expect("its errors");
    from.read_to_string(&mut errors).expect("a text");
    let status = leading.wait();
    let pair = format!("{} leads {}", leader.name, server.name);
    assert!(status.success(), "{pair}: {status}\n{observed}{errors}");
    observed
}

#[test]
fn each_language_observes_the_same_from_each() {
    let workshop = Workshop::new();
    let languages = workshop.languages("the matrix", &ROLES);
    let expected = fs::read_to_string(here("scenario.txt")).expect("the expected output");
    let count = languages.len().pow(2);
    let next = AtomicUsize::new(0);
    let work = || {
        loop {
            let number = next.fetch_add(1, Ordering::Relaxed);
            if number >= count {
                return;
            }
            let leader = &languages[number / languages.len()];
            let server = &languages[number % languages.len()];
            let domain = RunDomain::new();
            let observed = run(&workshop, &domain, leader, server);
            let pair = format!("{} leads {}", leader.name, server.name);
            assert_eq!(observed, expected, "{pair}");
            assert_eq!(domain.files(), Vec::<PathBuf>::new(), "{pair}");
        }
    };
    thread::scope(|scope| {
        for _ in 0..AT_ONCE {
            scope.spawn(work);
        }
    });
}
