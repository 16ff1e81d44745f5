//! The hot paths of the delivery core, one at a time, to count their instructions under valgrind:
//! `.ci/instructions`.
//!
//! The argument is the name of a path; without one, all names are listed. The instructions within
//! `measured` are counted, for a thousand repetitions after the setup: tables have a new seed in
//! every run, so the cost of a single lookup varies.

#![allow(clippy::unwrap_used, reason = "a bench that cannot go on may panic")]

mod crowd;

use std::hint::black_box;
use std::sync::Arc;

use self::crowd::Crowd;

/// Letters of a path, each of or for another agent.
const LETTERS: usize = 1_000;

type Path = (&'static str, fn(&mut Crowd, &[Arc<str>]));

const PATHS: &[Path] = &[
    ("core/route/1000", |crowd, names| {
        measured(|| {
            for name in names {
                black_box(crowd.route(black_box(name)).unwrap());
            }
        });
    }),
    ("core/letter/1000", |crowd, names| {
        let mut round = || names.iter().for_each(|name| crowd.send(black_box(name)));
        round();
        measured(round);
    }),
    ("core/letter/watched/1000", |crowd, names| {
        let mut round = || {
            let names = names.iter();
            names.for_each(|name| crowd.send_watched(black_box(name)));
        };
        round();
        measured(round);
    }),
    ("core/arrival/1000", |crowd, names| {
        let mut round = || (0..names.len()).for_each(|from| crowd.receive(black_box(from)));
        round();
        measured(round);
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
            let names = Crowd::names(1_000);
            let mut crowd = Crowd::new(&names);
            run(&mut crowd, names.get(..LETTERS).unwrap());
        }
    }
}

/// The instructions of the closure are counted.
#[inline(never)]
fn measured(run: impl FnOnce()) {
    run();
    black_box(());
}
