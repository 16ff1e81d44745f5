//! Processes are killed at random moments; the surviving processes must keep the promises.
//!
//! Child processes of this binary join a domain and exchange letters. The test kills some of them
//! with SIGKILL in every scenario, after delays drawn from a seed that it prints. After every
//! round, the survivors still exchange letters, every letter has an outcome, no letter was received
//! twice, contents are intact, and memory, descriptors and files are at their initial level.
//!
//! `FIPA_CRASH_SEED` repeats the random decisions of a run, but not its timing. `FIPA_CRASH_KILLS`
//! is the minimum number of kills. The soak is a longer run:
//! `cargo test --release --all-features -p fipa --test crash -- --ignored --nocapture soak`.

#![expect(clippy::unwrap_used, reason = "a failed precondition fails the test")]
#![expect(
    clippy::print_stdout,
    reason = "prints seeds and rounds of failed runs"
)]

mod cluster;
mod process;
mod scenarios;
#[path = "../support/mod.rs"]
mod support;

use std::time::Instant;

use cluster::Cluster;
use scenarios::{SCENARIOS, Scenario};

#[test]
#[ignore = "started by the other tests"]
fn process_entry() {
    if let Ok(role) = std::env::var(process::ROLE) {
        process::run(&role);
    }
}

#[test]
fn survivors_keep_working_while_other_processes_are_killed() {
    run(300, 2, false);
}

#[test]
#[ignore = "takes 15 minutes; see CONTRIBUTING"]
fn soak() {
    run(5000, 4, true);
}

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok()?.parse().ok()
}

/// Runs rounds of all scenarios on several clusters in parallel until enough processes have been
/// killed. With `verbose`, prints every round, otherwise only a failed one.
fn run(kills: u64, clusters: u64, verbose: bool) {
    let seed = number("FIPA_CRASH_SEED").unwrap_or_else(|| fastrand::u64(..));
    let kills = number("FIPA_CRASH_KILLS").unwrap_or(kills);
    println!("FIPA_CRASH_SEED={seed} FIPA_CRASH_KILLS={kills}");
    std::thread::scope(|scope| {
        let clusters: Vec<_> = (0..clusters)
            .map(|cluster| {
                let random = fastrand::Rng::with_seed(seed.wrapping_add(cluster));
                let quota = kills.div_ceil(clusters) as usize;
                scope.spawn(move || run_cluster(cluster, random, quota, verbose))
            })
            .collect();
        for cluster in clusters {
            if let Err(panic) = cluster.join() {
                println!("failed with FIPA_CRASH_SEED={seed}");
                std::panic::resume_unwind(panic);
            }
        }
    });
}

fn run_cluster(number: u64, mut random: fastrand::Rng, kills: usize, verbose: bool) {
    let mut cluster = Cluster::new();
    let began = Instant::now();
    let mut rounds = 0;
    while cluster.kills < kills {
        let mut scenarios: Vec<(&str, Scenario)> = SCENARIOS.to_vec();
        random.shuffle(&mut scenarios);
        for (name, scenario) in scenarios {
            let round = Round {
                verbose,
                line: format!(
                    "cluster {number}, round {rounds}, {} killed, {:.0?}: {name}",
                    cluster.kills,
                    began.elapsed()
                ),
            };
            scenario(&mut cluster, &mut random);
            cluster.check();
            drop(round);
            rounds += 1;
        }
    }
    println!(
        "cluster {number}: {} killed in {rounds} rounds",
        cluster.kills
    );
    cluster.close();
}

/// Prints the round and its result when dropped.
struct Round {
    verbose: bool,
    line: String,
}

impl Drop for Round {
    fn drop(&mut self) {
        let outcome = match std::thread::panicking() {
            true => "FAILED",
            false if self.verbose => "ok",
            false => return,
        };
        println!("{} ... {outcome}", self.line);
    }
}
