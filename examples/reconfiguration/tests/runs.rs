//! Whole runs with real processes: without a fault, with each fault, with random ones, and with a defect that the checker
//! has to find.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]

use std::path::Path;
use std::time::Duration;

use fipa_reconfiguration::Fault;
use fipa_reconfiguration::launch::{self, Link, Options, Outcome};
use fipa_reconfiguration::part::Mutant;
use fipa_reconfiguration::picture;
use fipa_reconfiguration::report::{Claim, Report};
use fipa_testbed::languages::{can_import, install_package, python};
use fipa_testbed::send_signal;

/// A run of the program of this package.
fn options(fault: Option<Fault>, seed: u64) -> Options {
    Options {
        fault,
        seed,
        program: vec![env!("CARGO_BIN_EXE_reconfiguration").into(), "part".into()],
        ..Options::default()
    }
}

async fn run(options: Options) -> Outcome {
    launch::run(&options, &mut |_| {}).await.unwrap()
}

/// Runs with a fault, and expects a consistent end.
async fn consistent(fault: Option<Fault>, seed: u64) -> Outcome {
    let outcome = run(options(fault, seed)).await;
    assert!(
        outcome.failed.is_empty(),
        "{fault:?}, seed {seed}: {:?}",
        outcome.failed
    );
    assert!(!outcome.passed.is_empty());
    outcome
}

/// Runs with a defect, and expects that the checker finds it.
async fn found(mutant: Mutant, fault: Option<Fault>) {
    let options = Options {
        mutant: Some(mutant),
        ..options(fault, 3)
    };
    let outcome = run(options).await;
    assert!(!outcome.failed.is_empty(), "{mutant:?} was not found");
}

#[tokio::test]
async fn two_robots_become_one() {
    let outcome = consistent(None, 1).await;
    let docked = outcome
        .reports
        .iter()
        .filter(|it| matches!(it.claim, Claim::Docked { .. }));
    assert_eq!(docked.count(), 2);
    let drawn = picture::page(&outcome.reports).svg();
    for text in ["payload_2", "crex_stack, leader", "sherpa #1", "confirm"] {
        assert!(drawn.contains(text), "{text}");
    }
}

/// The operator is the program in Python.
#[tokio::test]
async fn the_operator_may_be_a_program_in_python() {
    if !can_import("the operator in Python", &[]) {
        return;
    }
    let package = tempfile::tempdir().unwrap();
    install_package(package.path());
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let packages = format!("PYTHONPATH={}", package.path().display());
    let operator = here.join("stack_operator.py");
    let operator = [
        "env".into(),
        packages.into(),
        python().into(),
        operator.into_os_string(),
    ];
    let outcome = run(Options {
        operator: Some(operator.into()),
        ..options(None, 1)
    })
    .await;
    assert!(outcome.failed.is_empty(), "{:?}", outcome.failed);
    let docked = |claim: &Claim| matches!(claim, Claim::Docked { .. });
    assert_eq!(
        outcome
            .reports
            .iter()
            .filter(|it| docked(&it.claim))
            .count(),
        2
    );
}

#[tokio::test]
async fn the_item_is_killed() {
    consistent(Some(Fault::ItemKilled), 2).await;
}

#[tokio::test]
async fn the_link_is_cut() {
    consistent(Some(Fault::LinkCut), 3).await;
}

#[tokio::test]
async fn the_master_is_stopped() {
    consistent(Some(Fault::MasterStopped), 4).await;
}

#[tokio::test]
async fn an_agent_breaks_the_rules() {
    consistent(Some(Fault::Rogue), 5).await;
}

#[tokio::test]
async fn the_operator_cancels() {
    consistent(Some(Fault::Cancel), 6).await;
}

#[tokio::test]
async fn random_faults() {
    for seed in 7..10 {
        consistent(Some(Fault::random(seed)), seed).await;
    }
}

/// The robot is stopped when it is to lead: the item leads meanwhile, and gives the lead back.
#[tokio::test]
async fn the_client_is_stopped() {
    const PAUSE: Duration = Duration::from_secs(3);
    // No other test has it.
    const SEED: u64 = 12;
    let mut stopped = None;
    let mut show = |report: &Report| {
        if stopped.is_none() && matches!(report.claim, Claim::Confirmed { .. }) {
            let pid = children(env!("CARGO_BIN_EXE_reconfiguration"))
                .find(|pid| has_part(*pid, "crex", SEED))
                .unwrap();
            send_signal(pid, "-STOP");
            stopped = Some(std::thread::spawn(move || {
                std::thread::sleep(PAUSE);
                send_signal(pid, "-CONT");
            }));
        }
    };
    let outcome = launch::run(&options(None, SEED), &mut show).await.unwrap();
    stopped.unwrap().join().unwrap();
    assert!(outcome.failed.is_empty(), "{:?}", outcome.failed);
}

/// Whether a process has the part of this name in the run with this seed.
fn has_part(pid: u32, name: &str, seed: u64) -> bool {
    let arguments = std::fs::read_to_string(format!("/proc/{pid}/cmdline"));
    arguments.is_ok_and(|it| {
        it.contains(&format!("\"name\":\"{name}\"")) && it.contains(&format!("\"seed\":{seed},"))
    })
}

/// Maximum private memory of an item, in bytes. In the profile `small`, relocations of the program take 232 KB more.
const ITEM_MEMORY: u64 = 2_500_000;

#[tokio::test]
async fn an_item_needs_little_memory() {
    let item = env!("CARGO_BIN_EXE_payload_item");
    let options = Options {
        item: Some(vec![item.into()]),
        ..options(None, 1)
    };
    let mut most = 0;
    let mut show = |report: &Report| {
        if matches!(report.claim, Claim::Step { .. } | Claim::Image { .. }) {
            most = children(item)
                .filter_map(private_memory)
                .fold(most, u64::max);
        }
    };
    let outcome = launch::run(&options, &mut show).await.unwrap();
    assert!(outcome.failed.is_empty(), "{:?}", outcome.failed);
    println!("an item has {most} bytes");
    assert!((1_000_000..ITEM_MEMORY).contains(&most), "{most} bytes");
}

/// Returns the processes of this one that run a program.
fn children(program: &str) -> impl Iterator<Item = u32> {
    let program = Path::new(program).canonicalize().unwrap();
    let processes = std::fs::read_dir("/proc").unwrap().flatten();
    processes.filter_map(move |process| {
        let runs = std::fs::read_link(process.path().join("exe")).ok()?;
        let status = std::fs::read_to_string(process.path().join("status")).ok()?;
        let parent = status.lines().find_map(|line| line.strip_prefix("PPid:"))?;
        let is_child = parent.trim() == std::process::id().to_string();
        let pid = process.file_name().to_str()?.parse().ok()?;
        (is_child && runs == program).then_some(pid)
    })
}

/// Returns the private memory of a process in mappings that are neither files nor shared, in bytes. The code of its
/// program is in files. Images are in memory that is shared.
fn private_memory(pid: u32) -> Option<u64> {
    let maps = std::fs::read_to_string(format!("/proc/{pid}/smaps")).ok()?;
    let (mut sum, mut counts) = (0, false);
    for line in maps.lines() {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words[..] {
            ["Private_Clean:" | "Private_Dirty:", kib, _] if counts => {
                sum += kib.parse::<u64>().unwrap() * 1024;
            }
            [_, rights, _, _, inode, ..] if rights.len() == 4 => {
                counts = rights.ends_with('p') && inode == "0";
            }
            _ => {}
        }
    }
    Some(sum)
}

/// A reader of the example has to see the whole program of an agent.
#[test]
fn programs_of_agents_are_short() {
    let sources = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for program in ["operator", "sherpa", "guidance", "crex", "item", "rogue"] {
        let source = std::fs::read_to_string(sources.join(format!("{program}.rs"))).unwrap();
        let lines = source.lines().count();
        assert!(lines <= 250, "{program} has {lines} lines");
    }
}

/// The delay is in each step of the guidance.
#[tokio::test]
async fn a_slow_link() {
    let link = Link {
        delay: Duration::from_millis(50),
        rate: Some(10e6 / 8.0),
    };
    let outcome = run(Options {
        link,
        ..options(None, 1)
    });
    let outcome = outcome.await;
    assert!(outcome.failed.is_empty(), "{:?}", outcome.failed);
    assert!(outcome.steps("approach") > 0 && outcome.steps("align") > 0);
    assert!(outcome.seconds().is_some_and(|seconds| seconds > 0.0));
}

#[tokio::test]
async fn unchecked_fences_are_found() {
    found(Mutant::FencesUnchecked, None).await;
}

#[tokio::test]
async fn letters_that_are_not_checked_are_found() {
    found(Mutant::EnforcementOff, Some(Fault::Rogue)).await;
}

#[tokio::test]
async fn a_lock_that_is_skipped_is_found() {
    found(Mutant::LockSkipped, None).await;
}

#[tokio::test]
async fn a_leader_without_a_fence_is_found() {
    found(Mutant::LeaderNotFenced, Some(Fault::Rogue)).await;
}

#[tokio::test]
async fn a_reservation_that_is_kept_is_found() {
    found(Mutant::ReservationKept, Some(Fault::ItemKilled)).await;
}

#[tokio::test]
async fn an_invented_report_is_found() {
    found(Mutant::ReportInvented, None).await;
}
