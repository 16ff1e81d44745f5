//! Processes that are killed at every moment, and what must be true of those who live.
//!
//! Real processes of this very binary join a domain and exchange letters; some are killed with
//! SIGKILL, in every cell of a matrix of who and when, after delays drawn from a seed that is
//! printed. After every round: the survivors still talk, every letter has an outcome, none was
//! taken twice, contents are whole, and memory, descriptors and files are back where they began.
//!
//! `FIPA_CRASH_SEED` repeats a run's decisions (the machine's are its own); `FIPA_CRASH_KILLS` is
//! how many processes are killed at least. The soak is a longer run of the same:
//! `cargo test --release --test crash -- --ignored --nocapture soak`.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]
#![expect(clippy::print_stdout, reason = "seeds and rounds, when a run fails")]

mod actor;
mod cells;
mod stage;

use std::time::Instant;

use cells::{CELLS, Cell};
use stage::Stage;

#[test]
#[ignore = "started by the other tests"]
fn a_process_of_its_own() {
    if let Ok(part) = std::env::var(actor::PART) {
        actor::play(&part);
    }
}

#[test]
fn survivors_notice_nothing() {
    run(300, 2, false);
}

#[test]
#[ignore = "takes a quarter of an hour; see CONTRIBUTING"]
fn soak() {
    run(5000, 4, true);
}

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok()?.parse().ok()
}

/// Rounds of all cells on some stages at the same time, until enough processes have been killed.
/// `tells` of every round, for who watches; else only of the one that fails.
fn run(kills: u64, stages: u64, tells: bool) {
    let seed = number("FIPA_CRASH_SEED").unwrap_or_else(|| fastrand::u64(..));
    let kills = number("FIPA_CRASH_KILLS").unwrap_or(kills);
    println!("FIPA_CRASH_SEED={seed} FIPA_CRASH_KILLS={kills}");
    std::thread::scope(|scope| {
        let stages: Vec<_> = (0..stages)
            .map(|stage| {
                let random = fastrand::Rng::with_seed(seed.wrapping_add(stage));
                let quota = kills.div_ceil(stages) as usize;
                scope.spawn(move || act(stage, random, quota, tells))
            })
            .collect();
        for stage in stages {
            if let Err(panic) = stage.join() {
                println!("failed with FIPA_CRASH_SEED={seed}");
                std::panic::resume_unwind(panic);
            }
        }
    });
}

fn act(number: u64, mut random: fastrand::Rng, kills: usize, tells: bool) {
    let mut stage = Stage::new();
    let began = Instant::now();
    let mut rounds = 0;
    while stage.kills < kills {
        let mut cells: Vec<(&str, Cell)> = CELLS.to_vec();
        random.shuffle(&mut cells);
        for (name, cell) in cells {
            let round = Round {
                tells,
                line: format!(
                    "stage {number}, round {rounds}, {} killed, {:.0?}: {name}",
                    stage.kills,
                    began.elapsed()
                ),
            };
            cell(&mut stage, &mut random);
            stage.check();
            drop(round);
            rounds += 1;
        }
    }
    println!("stage {number}: {} killed in {rounds} rounds", stage.kills);
    stage.close();
}

/// Says what was played when it ends.
struct Round {
    tells: bool,
    line: String,
}

impl Drop for Round {
    fn drop(&mut self) {
        let outcome = match std::thread::panicking() {
            true => "FAILED",
            false if self.tells => "ok",
            false => return,
        };
        println!("{} ... {outcome}", self.line);
    }
}
