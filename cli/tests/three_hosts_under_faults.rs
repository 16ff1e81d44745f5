//! Tests the promises of delivery on three hosts with real gateways and processes. Meanwhile, the
//! test kills and stops processes and gateways, cuts links, filters packets, changes addresses, moves
//! agents between hosts, and makes them send 200 letters at once. Letters have deadlines from 10 ms to 60 s. Some letters are large,
//! and gateways refuse some. Every process logs the letters that it sends, their outcomes, and the
//! letters that it takes. The link of one host drops what exceeds 10 Mbit/s.
//!
//! Afterwards a checker (`soak/checker.rs`) reads all logs and checks these promises:
//!
//! * No letter is taken twice, by any registration.
//! * Each registration takes the letters of a sender in order.
//! * A *delivered* letter is taken, unless its receiver was killed.
//! * A letter that failed for certain is not taken.
//! * Every letter has one outcome per receiver, unless its sender was killed.
//! * No open letter is passed over.
//! * After the last fault, every stream delivers every letter.
//!
//! `FIPA_SOAK_SECONDS` is the length of a run (default: 15). `FIPA_SOAK_SEED` repeats the random
//! decisions of a run, but not the timing. `FIPA_SOAK_FAULTS` limits the faults to a list (`kill`,
//! `restart`, `kill-gateway`, `stop`, `stop-gateway`, `cut`, `filter`, `address`, `move`, `burst`).
//! `FIPA_SOAK_FAMILY` (`ipv4`, `ipv6`, `link` or `both`) chooses the addresses, and `FIPA_SOAK_MBITS` the
//! rate of the slow link, 0 for none. A run
//! that fails or recovers slowly copies its logs to the directory `FIPA_SOAK_LOGS`. The soak
//! repeats runs of two minutes. Each run draws its own transports and discovery:
//!
//! ```console
//! # FIPA_SOAK_SECONDS=1800 cargo test -p fipa-cli --test three_hosts_under_faults -- --ignored --nocapture soak
//! ```

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]
#![allow(clippy::print_stdout, reason = "seeds and figures of a run")]

mod hosts;
mod soak;

use std::io::Write as _;
use std::time::{Duration, Instant};

use fipa_testbed::{enter, isolated};
use soak::checker::{self, Quiet, Report};
use soak::stage::Stage;
use soak::{actor, journal};

/// Length of a run, in seconds.
const SECONDS: u64 = 15;
/// Maximum length of a run in a soak, in seconds.
const EPISODE: u64 = 120;
/// Recovery time above which the logs are kept, in microseconds.
const SLOW: u64 = 2_000_000;
/// The recovery times of the runs of a soak.
const RECOVERIES: &str = concat!(env!("CARGO_TARGET_TMPDIR"), "/soak-recoveries");
/// Maximum number of printed breaches.
const SHOWN: usize = 20;

#[test]
#[ignore = "draws its faults at random and takes half a minute; see CONTRIBUTING"]
fn promises_hold_on_three_hosts_under_faults() {
    isolated("inside_a_run", &["nft", "kill"]);
}

#[test]
#[ignore = "takes half an hour; see CONTRIBUTING"]
fn soak() {
    let (began, length) = (Instant::now(), number("FIPA_SOAK_SECONDS").unwrap_or(1800));
    let _ = std::fs::remove_file(RECOVERIES);
    let (mut runs, mut failed) = (0, 0);
    while began.elapsed() < Duration::from_secs(length) {
        let run = || isolated("inside_a_run", &["nft", "kill"]);
        runs += 1;
        // The soak goes on, and fails at its end.
        failed += usize::from(std::panic::catch_unwind(run).is_err());
        println!("{:.0?} of {length} s", began.elapsed());
    }
    let recoveries = std::fs::read_to_string(RECOVERIES).unwrap_or_default();
    let recoveries = recoveries.lines().map(|line| line.parse().unwrap());
    println!(
        "{runs} runs, {failed} with breaches or other failures; {}",
        summary(recoveries.collect())
    );
    assert_eq!(failed, 0, "promises were broken; see above");
}

/// Returns the middle and the worst of recovery times in milliseconds.
fn summary(mut recoveries: Vec<u64>) -> String {
    recoveries.sort_unstable();
    let middle = recoveries.get(recoveries.len() / 2).copied().unwrap_or(0);
    let worst = recoveries.last().copied().unwrap_or(0);
    format!(
        "{} recoveries, median {middle} ms, worst {worst} ms",
        recoveries.len()
    )
}

/// Appends the recovery times of a run, in milliseconds, for the summary of the soak.
fn keep_recoveries(stage: &Stage) {
    let quiet = stage.quiet.iter();
    let lines = quiet.map(|quiet| format!("{}\n", (quiet.proved - quiet.healed) / 1000));
    let file = std::fs::File::options()
        .create(true)
        .append(true)
        .open(RECOVERIES);
    let written = file.and_then(|mut file| file.write_all(lines.collect::<String>().as_bytes()));
    written.unwrap();
}

#[test]
#[ignore = "is run by the other tests in namespaces of its own"]
fn inside_a_run() {
    enter();
    let seed = number("FIPA_SOAK_SEED").unwrap_or_else(|| fastrand::u64(..1 << 40));
    let seconds = number("FIPA_SOAK_SECONDS").unwrap_or(SECONDS).min(EPISODE);
    println!("FIPA_SOAK_SEED={seed} FIPA_SOAK_SECONDS={seconds}");
    let mut logs = Logs { keep: false };
    let mut stage = Stage::new(seed);
    println!("  {}", stage.setup);
    let began = Instant::now();
    while began.elapsed() < Duration::from_secs(seconds) {
        stage.disturb(Duration::from_secs(5), Duration::from_secs(2));
    }
    stage.close();
    let report = checker::check(&stage.lives, &stage.quiet);
    print(&stage, &report);
    keep_recoveries(&stage);
    let is_slow = |quiet: &Quiet| quiet.proved - quiet.healed > SLOW;
    logs.keep = stage.quiet.iter().any(is_slow);
    let breaches = report.breaches.len();
    assert_eq!(breaches, 0, "promises were broken; see above");
    assert!(report.taken > 0, "no letter was taken");
}

#[test]
#[ignore = "is started by the other tests"]
fn a_process_of_its_own() {
    if let Ok(part) = std::env::var(actor::PART) {
        actor::play(&part);
    }
}

fn print(stage: &Stage, report: &Report) {
    println!("  {:?}", stage.counts);
    println!(
        "  {} letters (one for each receiver), {} taken, {} lost with a killed receiver: {:?}",
        report.letters, report.taken, report.lost_with_receiver, report.outcomes
    );
    for quiet in &stage.quiet {
        println!(
            "  a letter of every stream was delivered {} ms after the last fault, at {} (processors {} % busy)",
            (quiet.proved - quiet.healed) / 1000,
            quiet.healed,
            quiet.busy_percent
        );
    }
    for (what, recovery) in [
        ("until receivers were found", &report.directory),
        (
            "until letters to known receivers were delivered promptly",
            &report.delivery,
        ),
    ] {
        println!(
            "  {what}: worst {} ms after the last fault, {} streams more than 2 s: {}",
            recovery.worst_ms(),
            recovery.slow(),
            recovery.slowest
        );
    }
    for breach in report.breaches.iter().take(SHOWN) {
        println!("BREACH {breach}");
    }
    println!(
        "  {} breaches, at {}",
        report.breaches.len(),
        journal::now()
    );
}

/// Copies the logs on drop if the run failed or `keep` is set.
struct Logs {
    keep: bool,
}

impl Drop for Logs {
    fn drop(&mut self) {
        let Some(to) = std::env::var_os("FIPA_SOAK_LOGS") else {
            return;
        };
        if self.keep || std::thread::panicking() {
            let from = fipa_testbed::directory();
            let files = std::fs::read_dir(from).into_iter().flatten().flatten();
            let logs = files.filter(|file| file.file_name().to_string_lossy().starts_with("log"));
            std::fs::create_dir_all(&to).unwrap();
            for log in logs {
                let copy = std::path::Path::new(&to).join(log.file_name());
                let _ = std::fs::copy(log.path(), copy);
            }
        }
    }
}

fn number(variable: &str) -> Option<u64> {
    std::env::var(variable).ok()?.parse().ok()
}
