//! Tests of the checker with constructed logs.

use super::checker::{self, Life, Quiet};
use super::journal::{Event, Id};

/// Events with their times.
type Log<'a> = &'a [(u64, Event)];

/// Two registrations of `arm`, one after the other.
const ARM: u64 = 0xa;
const NEXT_ARM: u64 = 0xb;

fn registered(name: &str, agent: u64) -> [Event; 2] {
    let name = name.to_owned();
    let begins = Event::Begins { name: name.clone() };
    [begins, Event::Registered { name, agent }]
}

fn id(number: u64) -> Id {
    Id { sender: 1, number }
}

fn sends(number: u64) -> Event {
    Event::Sends {
        id: id(number),
        deadline_ms: 60_000,
        forbidden: false,
        receivers: vec!["arm".to_owned()],
    }
}

fn ends(number: u64, failure: Option<&str>) -> Event {
    Event::Outcome {
        id: id(number),
        receiver: "arm".to_owned(),
        failure: failure.map(str::to_owned),
        how: "as told".to_owned(),
    }
}

fn takes(agent: u64, number: u64) -> Event {
    Event::Takes {
        agent,
        id: id(number),
    }
}

/// Returns the breaches in the logs of a sender and of two successive receiver processes. The first
/// receiver process was killed at `killed`. All times are in seconds.
fn breaches(logs: [Log; 3], killed: Option<u64>) -> Vec<String> {
    const SECOND: u64 = 1_000_000;
    let directory = tempfile::tempdir().unwrap();
    let lives = logs.iter().enumerate().map(|(at, events)| {
        let log = directory.path().join(at.to_string());
        let lines = events
            .iter()
            .map(|(time, event)| event.to_line(time * SECOND));
        std::fs::write(&log, lines.collect::<String>()).unwrap();
        let killed = killed.filter(|_| at == 1).map(|time| time * SECOND);
        Life { log, killed }
    });
    let quiet = Quiet {
        healed: 20 * SECOND,
        proved: 21 * SECOND,
        end: 90 * SECOND,
        busy_percent: 0,
    };
    checker::check(&lives.collect::<Vec<_>>(), &[quiet]).breaches
}

/// Returns the breaches in the logs of a sender and of one receiver process that was not killed.
fn breaches_of(sender: Log, receiver: Log) -> Vec<String> {
    let here = registered("arm", ARM).map(|event| (0, event));
    breaches([sender, &[&here, receiver].concat(), &[]], None)
}

#[track_caller]
fn one(breaches: &[String], what: &str) {
    assert!(
        breaches.iter().any(|it| it.starts_with(what)),
        "{breaches:?}"
    );
}

#[test]
fn the_checker_accepts_what_keeps_the_promises() {
    let sent = [
        (1, sends(1)),
        (1, sends(2)),
        (1, sends(3)),
        (2, ends(1, None)),
        (2, ends(2, Some("TimedOut"))),
        (2, ends(3, Some("Unconfirmed"))),
    ];
    let taken = [(2, takes(ARM, 1)), (2, takes(ARM, 3))];
    assert_eq!(breaches_of(&sent, &taken), Vec::<String>::new());
}

#[test]
fn the_checker_finds_each_breach() {
    let sent = [(1, sends(1)), (1, sends(2))];
    let delivered = [(2, ends(1, None)), (2, ends(2, None))];
    let both = [sent.clone(), delivered].concat();
    let cases: [(Log, Log, &str); 8] = [
        (&both, &[(2, takes(ARM, 2)), (2, takes(ARM, 1))], "order"),
        (
            &both,
            &[(2, takes(ARM, 1)), (2, takes(ARM, 1))],
            "taken twice",
        ),
        (&both, &[(2, takes(ARM, 1))], "delivered, and not taken"),
        (&sent, &[], "no outcome"),
        (
            &[(1, sends(1)), (2, ends(1, Some("TimedOut")))],
            &[(2, takes(ARM, 1))],
            "failed, and was taken",
        ),
        (
            &[(1, sends(1)), (2, ends(1, None)), (2, ends(1, None))],
            &[(2, takes(ARM, 1))],
            "several outcomes",
        ),
        (
            &[
                (1, sends(1)),
                (1, sends(2)),
                (2, ends(2, None)),
                (30, ends(1, Some("TimedOut"))),
            ],
            &[(2, takes(ARM, 2))],
            "passed over",
        ),
        (
            &[(30, sends(1)), (80, ends(1, Some("TimedOut")))],
            &[],
            "failed 10000 ms after the last fault",
        ),
    ];
    for (sender, receiver, what) in cases {
        one(&breaches_of(sender, receiver), what);
    }
}

#[test]
fn the_checker_finds_a_letter_that_two_registrations_took() {
    let here = registered("arm", ARM).map(|event| (0, event));
    let next = registered("arm", NEXT_ARM).map(|event| (3, event));
    let sender = [(1, sends(1)), (5, ends(1, None))];
    let first = [&here[..], &[(2, takes(ARM, 1))]].concat();
    let second = [&next[..], &[(4, takes(NEXT_ARM, 1))]].concat();
    one(
        &breaches([&sender, &first, &second], Some(3)),
        "taken twice",
    );
}

#[test]
fn the_checker_knows_what_a_killed_receiver_may_have_accepted() {
    let here = registered("arm", ARM).map(|event| (0, event));
    let sender = [
        (1, sends(1)),
        (1, sends(2)),
        (2, ends(1, None)),
        (2, ends(2, None)),
    ];
    // The killed process may have accepted the letter after the last one in its log.
    let first = [&here[..], &[(2, takes(ARM, 1))]].concat();
    assert_eq!(
        breaches([&sender, &first, &[]], Some(3)),
        Vec::<String>::new()
    );
    // The process was killed before the letter was sent.
    one(
        &breaches([&sender, &here, &[]], Some(0)),
        "delivered, and not taken",
    );
    // The process logged a later letter, so it would have logged this one.
    let later = [&here[..], &[(2, takes(ARM, 2))]].concat();
    one(
        &breaches([&sender, &later, &[]], Some(3)),
        "delivered, and not taken",
    );
}
