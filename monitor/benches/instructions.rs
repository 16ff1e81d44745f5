//! The hot paths of the monitor, one at a time, to count their instructions under valgrind:
//! `.ci/instructions`.
//!
//! The argument is the name of a path; without one, all names are listed. The instructions within
//! `measured` are counted, for a thousand messages after the setup: tables have a new seed in every
//! run, so the cost of a single search varies.

#![allow(clippy::unwrap_used, reason = "a bench that cannot go on may panic")]

mod conversations;

use std::hint::black_box;

use fipa_acl::{Message, Performative};
use fipa_monitor::{Header, Monitor};

use self::conversations::{answer, now, with_open};

/// Messages of a path, each of another conversation.
const MESSAGES: usize = 1_000;

type Path = (&'static str, fn(&mut Monitor, &[Message]));

const PATHS: &[Path] = &[
    ("monitor/verdict/1000", |monitor, informs| {
        measured(|| check(monitor, informs, true));
    }),
    ("monitor/opening/1000", |monitor, _| {
        let opening = numbered(&Performative::Request, "fipa-request", MESSAGES);
        measured(|| check(monitor, &opening, true));
    }),
    ("monitor/violation/1000", |monitor, _| {
        let wrong = numbered(&Performative::Propose, "fipa-subscribe", 0);
        measured(|| check(monitor, &wrong, false));
    }),
];

#[allow(clippy::print_stdout, reason = "the names are the output")]
fn main() {
    // Cargo's own arguments begin with a hyphen.
    let asked = std::env::args().skip(1).find(|name| !name.starts_with('-'));
    match asked {
        None => PATHS.iter().for_each(|(name, _)| println!("{name}")),
        Some(asked) => {
            let path = PATHS.iter().find(|(name, _)| *name == asked);
            let (_, run) = path.unwrap_or_else(|| panic!("unknown path {asked}"));
            let (mut monitor, informs) = with_open(MESSAGES);
            run(&mut monitor, &informs);
        }
    }
}

/// Messages of conversations from this number on.
fn numbered(act: &Performative, protocol: &str, first: usize) -> Vec<Message> {
    let numbers = first..first + MESSAGES;
    let messages = numbers.map(|number| answer(act.clone(), protocol, number));
    messages.collect()
}

fn check(monitor: &mut Monitor, messages: &[Message], is_accepted: bool) {
    for message in messages {
        let verdict = monitor.check(&Header::from(black_box(message)), now());
        assert_eq!(verdict.is_accepted(), is_accepted);
        black_box(&verdict);
    }
}

/// The instructions of the closure are counted.
#[inline(never)]
fn measured(run: impl FnOnce()) {
    run();
    black_box(());
}
