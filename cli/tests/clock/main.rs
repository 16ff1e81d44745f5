//! A host without a battery for its clock starts in 1970, and a program sets the clock later.
//!
//! The library `shifted.c` shifts the time of day of the processes. Needs a C compiler; without it the test prints a
//! note and is skipped, and in CI it fails.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

#[path = "../common/mod.rs"]
mod common;

use std::fs::File;
use std::io::ErrorKind;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::thread;
use std::time::{SystemTime, UNIX_EPOCH};

use common::{Host, Running};
use fipa_testbed::until;
use serde_json::Value;

/// Letters that are sent while the clock is set.
const LETTERS: usize = 300;

/// A host whose time of day the test sets.
struct ShiftedHost {
    host: Host,
    library: PathBuf,
    shift: File,
}

impl ShiftedHost {
    /// Returns `None` if the test is skipped.
    fn new() -> Option<Self> {
        let host = Host::new();
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/clock/shifted.c");
        let library = host.path("shifted.so");
        let mut compiler = Command::new("cc");
        compiler.args(["-Wall", "-Werror", "-shared", "-fPIC", "-o"]);
        match compiler.arg(&library).arg(source).output() {
            Ok(output) => assert!(output.status.success(), "{output:?}"),
            Err(error) => {
                assert_eq!(error.kind(), ErrorKind::NotFound, "cc: {error}");
                let in_ci = std::env::var("CI").as_deref() == Ok("true");
                assert!(!in_ci, "missing: cc");
                eprintln!("SKIPPED, not a success: needs cc");
                return None;
            }
        }
        let shift = File::create_new(host.path("shift")).unwrap();
        let shifted = Self {
            host,
            library,
            shift,
        };
        shifted.set(0);
        Some(shifted)
    }

    /// Sets the clock, by the seconds from the time of day of the machine.
    fn set(&self, shift: i64) {
        self.shift.write_all_at(&shift.to_ne_bytes(), 0).unwrap();
    }

    /// Sets the clock to a minute after the beginning of 1970.
    fn set_to_1970(&self) {
        let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
        self.set(60 - i64::try_from(now.as_secs()).unwrap());
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut command = self.host.command(arguments);
        command.env("LD_PRELOAD", &self.library);
        command.env("CLOCK_SHIFT", self.host.path("shift"));
        command
    }

    fn start(&self, arguments: &[&str]) -> Running {
        Running::new(self.command(arguments))
    }

    /// Runs a command to its end, and returns its standard output.
    fn run(&self, arguments: &[&str]) -> String {
        let output = self.command(arguments).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    }
}

fn text(path: &Path) -> String {
    path.display().to_string()
}

#[test]
fn a_clock_that_jumps_from_1970_to_now_loses_no_letter_and_ends_no_lock_or_registration() {
    let Some(rover) = ShiftedHost::new() else {
        return;
    };
    let crex = Host::new();
    let keys = [text(&rover.host.path("keys")), text(&crex.path("keys"))];
    for (host, keys, name) in [(&rover.host, &keys[0], "rover"), (&crex, &keys[1], "crex")] {
        let name = format!("mts.name={name}");
        host.run(&["keys", "init", "--dir", keys, "--set", &name])
            .done();
    }
    for (host, keys, peer) in [
        (&rover.host, &keys[0], &crex),
        (&crex, &keys[1], &rover.host),
    ] {
        let pem = text(&peer.path("keys/own.pem"));
        host.run(&["keys", "trust", &pem, "--dir", keys]).done();
    }
    let with_keys = keys.map(|keys| format!("security.keys={keys}"));
    let listen = ["--set", "transport.tcp.listen=127.0.0.1:0"];
    let up = [
        "up",
        "--json",
        "--set",
        "mts.name=crex",
        "--set",
        &with_keys[1],
    ];
    let gateway = crex.start(&[&up[..], &listen].concat());
    let peer = format!("discovery.static.crex=[\"{}\"]", gateway.location("tcp"));
    let mut far = crex.start(&["listen", "far", "--json"]);

    rover.set_to_1970();
    let up = [
        "up",
        "--json",
        "--set",
        "mts.name=rover",
        "--set",
        &with_keys[0],
    ];
    let mut gateway = rover.start(&[&up[..], &listen, &["--set", &peer]].concat());
    // The error has the cause and the remedy.
    gateway.wait_for_log(&[
        "not valid yet",
        "the clock of this host shows 1970-01-01T00:0",
        "set it if it is wrong",
    ]);

    // A grant ends after three seconds unless its holder renews it.
    let own = ["own", "bay", "--forget", "--lease", "3s", "--volatile"];
    let _owner = rover.start(&own);
    let hold = ["lock", "bay", "--", "sh", "-c", "echo held; exec sleep 600"];
    let mut holder = rover.start(&hold);
    assert_eq!(holder.ready, "held");
    let _service = rover.start(&["df", "register", "arm", "lifting"]);
    let has_service = || {
        rover
            .run(&["df", "search", "--type", "lifting"])
            .contains("arm")
    };
    until("the service is registered", has_service);
    let mut near = rover.start(&["listen", "near", "--json"]);
    // Its letter is under way when the clock is set.
    let stopped = rover.start(&["listen", "stopped"]);
    stopped.send_signal("-STOP");
    let waiting = ["send", "stopped", "x", "--deadline", "60s"];
    let mut waiting = rover.command(&waiting);
    let waiting = thread::spawn(move || waiting.output().unwrap());
    let (rate, count) = ("40", LETTERS.to_string());
    let load = [
        "send",
        "near",
        "x",
        "--rate",
        rate,
        "--count",
        &count,
        "--numbered",
        "--json",
    ];
    let mut load = rover.start(&load);

    let mut received: Vec<String> = (0..LETTERS / 2).map(|_| content(&near.line())).collect();
    rover.set(0);
    received.extend((received.len()..LETTERS).map(|_| content(&near.line())));
    received.sort_unstable();
    received.dedup();
    assert_eq!(received.len(), LETTERS, "a letter was received twice");
    let summary = std::iter::from_fn(|| load.next_line()).last().unwrap();
    let summary: Value = serde_json::from_str(&summary).unwrap();
    assert_eq!(summary["delivered"], LETTERS, "{summary}");
    assert!(!waiting.is_finished());
    stopped.send_signal("-CONT");
    let outcome = waiting.join().unwrap();
    assert!(outcome.status.success(), "{outcome:?}");

    // The remaining letters took more than a lease.
    let wants = ["lock", "bay", "--within", "1s", "--", "echo", "stolen"];
    assert_eq!(rover.run(&wants), "");
    assert!(!holder.has_ended());
    assert!(has_service());
    // The hosts connect, without a restart.
    until("crex is connected", || {
        rover.run(&["agents", "--json"]).contains("\"far\"")
    });
    let sent = rover.run(&["send", "far", "hello", "--json"]);
    let sent: Value = serde_json::from_str(&sent).unwrap();
    assert_eq!(sent["deliveries"][0]["via"], "tcp", "{sent}");
    assert_eq!(content(&far.line()), "hello");
    // It ends its command, too.
    holder.signal("-TERM");
}

#[test]
fn keys_that_are_made_in_1970_are_valid_after_the_clock_is_set() {
    let Some(rover) = ShiftedHost::new() else {
        return;
    };
    let keys = text(&rover.host.path("keys"));
    rover.set_to_1970();
    rover.run(&["keys", "init", "--dir", &keys]);
    let list = || rover.run(&["keys", "list", "--dir", &keys]);
    assert!(list().contains("own"), "{}", list());
    let is_valid = |list: String| !list.contains("expired") && !list.contains("not valid yet");
    assert!(is_valid(list()), "{}", list());
    rover.set(0);
    assert!(is_valid(list()), "{}", list());
}

fn content(line: &str) -> String {
    let received: Value = serde_json::from_str(line).unwrap();
    received["message"]["content"].as_str().unwrap().to_owned()
}
