//! `fipa own`, `fipa lock` and `fipa locks` in processes of their own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;
use std::os::unix::fs::PermissionsExt as _;

use common::{Host, Running};
use fipa_testbed::until;

fn own(host: &Host, options: &[&str]) -> Running {
    let own = host.start(&[&["own", "bay", "--agent", "crane", "--forget"], options].concat());
    let ready = format!("bay is owned by crane in domain {}", host.domain);
    assert!(own.ready.starts_with(&ready), "{}", own.ready);
    own
}

/// A command that prints its fence and its process, and runs until it is killed.
const HOLD: &str = "echo $FIPA_FENCE $$; exec sleep 600";

/// Starts a command that holds the bay. Returns its fence and the identifier of its process.
fn hold(host: &Host, options: &[&str], script: &str) -> (Running, String, Process) {
    let arguments = [&["lock", "bay"], options, &["--", "sh", "-c", script]].concat();
    let holder = host.start(&arguments);
    let (fence, process) = split(&holder.ready);
    (holder, fence, process)
}

/// Returns number, epoch and run of a fence of the crane.
fn parts(fence: &str) -> (String, String, String) {
    let fence = fence.trim().trim_start_matches("fence ");
    let position = fence.strip_suffix("@crane#bay").unwrap();
    let parts: Vec<&str> = position.split('.').collect();
    let [epoch, number, run] = parts[..] else {
        panic!("{fence} has no run");
    };
    (number.to_owned(), epoch.to_owned(), run.to_owned())
}

fn split(line: &str) -> (String, Process) {
    let (fence, process) = line.split_once(' ').unwrap();
    (fence.to_owned(), Process(process.to_owned()))
}

/// A process that outlives its parent. It is killed on drop.
struct Process(String);

impl Process {
    fn is_running(&self) -> bool {
        let state = fs::read_to_string(format!("/proc/{}/stat", self.0));
        state.is_ok_and(|state| !state.contains(") Z "))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if self.is_running() {
            let _ = std::process::Command::new("kill")
                .args(["-KILL", &self.0])
                .status();
        }
    }
}

/// Sends a command with this fence to the owner, and returns the performative of the answer.
fn command(host: &Host, fence: &str) -> String {
    let sent = host.run(&[
        "send",
        "--to",
        "lock:bay",
        "-p",
        "request",
        "--content",
        "dock",
        "--fence",
        fence,
        "--wait",
        "--timeout",
        "60s",
        "--json",
    ]);
    let sent = sent.done_json();
    sent["reply"]["performative"].as_str().unwrap().to_owned()
}

#[test]
fn the_lock_of_a_killed_holder_is_granted_and_its_late_command_refused() {
    let host = Host::new();
    let mut crane = own(&host, &["--lease", "10min"]);
    let (holder, stale, orphan) = hold(&host, &["--agent", "rover"], HOLD);
    let (number, epoch, run) = parts(&stale);
    assert_eq!(number, "1");
    assert_eq!(crane.line(), format!("granted to rover, fence {stale}"));
    assert_eq!(command(&host, &stale), "agree");
    assert!(
        crane
            .line()
            .starts_with(&format!("admitted with {stale}: (request"))
    );

    let late = host.run(&["lock", "bay", "--within", "10s", "--", "true"]);
    let late = late.failed(124);
    let problem = "timed out waiting for \"bay\", with 1 request ahead\nwhere: resource \"bay\", held by \"rover\"";
    assert!(late.contains(problem), "{late}");
    let arguments = ["lock", "bay", "--agent", "arm", "--", "sh", "-c", HOLD];
    let waiting = host.command(&arguments);
    let waiting = std::thread::spawn(move || Running::new(waiting));
    holder.send_signal("-KILL");
    let waiting = waiting.join().unwrap();
    // Long before the end of the lease.
    let (fence, _left_too) = split(&waiting.ready);
    assert_eq!(fence, format!("{epoch}.2.{run}@crane#bay"));
    assert_eq!(crane.line(), format!("ended with rover, fence {stale}"));
    assert_eq!(crane.line(), format!("granted to arm, fence {fence}"));
    // The command of the killed holder goes on, and its fence is refused.
    assert!(orphan.is_running());
    assert_eq!(command(&host, &stale), "refuse");
    let refused = format!("refused: the fence {stale}");
    assert!(crane.line().starts_with(&refused));
    assert_eq!(command(&host, &fence), "agree");
    assert_eq!(
        host.run(&["lock", "bay", "--within", "0s", "--", "true"])
            .code,
        Some(124)
    );

    let listed = host.run(&["locks", "--json"]).done_json();
    let listed = &listed["locks"][0];
    for (key, value) in [
        ("resource", "bay"),
        ("owner", "crane"),
        ("holder", "arm"),
        ("fence", fence.as_str()),
    ] {
        assert_eq!(listed[key], value, "{listed}");
    }
    assert!(listed["lease_ms"].as_u64().unwrap() <= 600_000);
    let table = host.run(&["locks"]).done();
    assert!(table.contains("arm") && !table.contains(&fence), "{table}");
    let table = host.run(&["locks", "--long"]).done();
    assert!(table.contains(&fence) && table.contains("arm"), "{table}");
}

/// The owner may be an agent of another host.
#[test]
fn the_name_of_the_owner_in_the_environment_is_no_command() {
    let host = Host::new();
    let owner = "crane;touch injected;`touch injected`&#";
    let _crane = host.start(&["own", "bay", "--agent", owner, "--forget"]);
    let printed = host.run(&[
        "lock",
        "bay",
        "--",
        "sh",
        "-c",
        "echo $FIPA_FENCE; $FIPA_FENCE",
    ]);
    let text = String::from_utf8(printed.stdout).unwrap();
    assert!(
        text.contains("crane;touch injected;`touch injected`&%23"),
        "{text}"
    );
    assert!(!host.path("injected").exists());
}

#[test]
fn exit_codes_are_those_of_the_command_and_of_env() {
    let host = Host::new();
    let alone = host.run(&["lock", "bay", "--", "true"]).failed(125);
    assert!(alone.contains("no agent owns \"bay\""), "{alone}");
    let soon = host
        .run(&["lock", "bay", "--within", "300ms", "--", "true"])
        .failed(124);
    assert!(soon.contains("no owner of \"bay\" was found"), "{soon}");
    assert!(soon.contains("fipa own RESOURCE"), "{soon}");
    let crane = own(&host, &[]);
    let run = |arguments: &[&str]| host.run(&[&["lock", "bay", "--"], arguments].concat());
    let fence = || run(&["sh", "-c", "echo $FIPA_FENCE"]).done();
    let first = fence();
    assert_eq!(parts(&first).0, "1", "{first}");
    assert_eq!(run(&["sh", "-c", "exit 7"]).code, Some(7));
    assert_eq!(run(&["sh", "-c", "kill -KILL $$"]).code, Some(137));
    assert!(
        run(&["/no/such/program"])
            .failed(127)
            .contains("/no/such/program")
    );
    let file = host.path("data");
    fs::write(&file, "").unwrap();
    fs::set_permissions(&file, fs::Permissions::from_mode(0o600)).unwrap();
    run(&[file.to_str().unwrap()]).failed(126);
    let long = "x".repeat(10_000);
    let long = host.run(&["lock", &long, "--", "true"]).failed(125);
    assert!(long.contains("255"), "{long}");
    let usage = host.run(&["lock", "bay"]);
    assert_eq!(usage.code, Some(2));
    let taken = host.run(&["own", "bay", "--agent", "other"]).failed(1);
    assert!(taken.contains("owned by \"crane\""), "{taken}");
    let (code, _) = crane.signal("-INT");
    assert_eq!(code, Some(0));
    // The epoch rises, and no lock is live, so the next run grants at once.
    let _crane = own(&host, &[]);
    let second = fence();
    let ((_, before, earlier), (number, epoch, run)) = (parts(&first), parts(&second));
    assert_eq!(number, "1");
    let number = |text: &str| text.parse::<u64>().unwrap();
    assert!(number(&before) < number(&epoch) && earlier != run);
    let nowhere = host
        .run(&["own", "dock", "--state-dir", "/dev/null"])
        .failed(1);
    assert!(nowhere.contains("--volatile"), "{nowhere}");
}

#[test]
fn the_end_of_a_command_is_reported_as_a_release() {
    let host = Host::new();
    let mut crane = own(&host, &[]);
    for grant in 1..=10 {
        host.run(&["lock", "bay", "--agent", "rover", "--", "true"])
            .done();
        let granted = crane.line();
        let fence = granted.strip_prefix("granted to rover, ").unwrap();
        assert_eq!(parts(fence).0, grant.to_string());
        assert_eq!(crane.line(), format!("released by rover, {fence}"));
    }
}

#[test]
fn the_command_is_ended_when_the_lock_is_lost() {
    let host = Host::new();
    let crane = own(&host, &["--lease", "3s"]);
    let script = "trap 'echo ended; exit 0' TERM; echo $FIPA_FENCE $$; while :; do sleep 0.1; done";
    let (mut holder, _, process) = hold(&host, &[], script);
    crane.signal("-KILL");
    assert_eq!(holder.line(), "ended");
    let (code, log) = holder.end();
    assert_eq!(code, Some(125), "{log}");
    assert!(log.contains("the lock of \"bay\" was lost"), "{log}");
    assert!(!process.is_running());

    let crane = own(&host, &["--lease", "3s"]);
    let stubborn = "trap '' TERM; echo $FIPA_FENCE $$; while :; do sleep 0.1; done";
    let (mut stubborn, _, process) = hold(&host, &["--kill-after", "500ms"], stubborn);
    drop(crane);
    let (code, log) = stubborn.end();
    assert_eq!(code, Some(125), "{log}");
    until("SIGKILL ends the command", || !process.is_running());

    let crane = own(&host, &["--lease", "3s"]);
    let script = "echo $FIPA_FENCE $$; while [ ! -e go ]; do sleep 0.1; done; exit 3";
    let (mut holder, _, _process) = hold(&host, &["--keep"], script);
    crane.signal("-KILL");
    holder.wait_for_log(&["warning:", "the lock of \"bay\" was lost"]);
    fs::write(host.path("go"), "").unwrap();
    assert_eq!(holder.end().0, Some(3));
}
