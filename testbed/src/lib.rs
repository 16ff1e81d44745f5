//! Networks for tests: hosts in network namespaces, their links, and the real Avahi. And what peers
//! say that are none of ours.
//!
//! A test that needs a network of its own is two functions. The one that the test harness sees
//! calls [`isolated`], which runs the other, ignored one in a process with namespaces of its own
//! (network, mounts, processes). That one calls [`enter`], then builds what it needs:
//!
//! ```no_run
//! #[test]
//! fn hosts_reach_each_other() {
//!     fipa_testbed::isolated("inside_hosts_reach_each_other", &["ip"]);
//! }
//!
//! #[test]
//! #[ignore = "is run by the other test in namespaces of its own"]
//! fn inside_hosts_reach_each_other() {
//!     fipa_testbed::enter();
//!     let network = fipa_testbed::Network::new(3);
//!     network.host(0).unplug();
//! }
//! ```
//!
//! Nothing has to be cleaned up, however the test ends: with its process the kernel takes away
//! the namespaces, everything started in them, and every interface. For the same reason names
//! need not be unique.
//!
//! What a test cannot do without and the machine does not have makes it a skipped one, which is
//! said aloud, and a failed one when `CI=true`.
//!
//! Everything here panics when it fails: it is for tests only, which end then.

// The whole crate is for tests: what fails ends them, and what is skipped is told.
#![allow(clippy::unwrap_used, clippy::print_stderr)]

mod avahi;
mod ghost;
mod network;
mod peer;

use std::io::{self, BufRead as _, BufReader, Read as _};
use std::path::PathBuf;
use std::process::{Child, ChildStderr, Command, ExitStatus, Stdio};
use std::thread::JoinHandle;

pub use avahi::Avahi;
pub use ghost::Ghost;
pub use network::{Host, Network};
#[cfg(feature = "tls")]
pub use peer::Anybody;
pub use peer::{frame, frame_header};

/// Environment variable that gives the process in the namespaces the directory of its test.
const INSIDE: &str = "FIPA_TESTBED_INSIDE";
/// Environment variable that gives processes of `fipa` their runtime directory.
const RUNTIME_DIR: &str = "FIPA_RUNTIME_DIR";

/// How long a test in namespaces may take, in seconds, before it counts as one that hangs. None needs
/// half of it.
const WATCHDOG: &str = "900";

/// Runs the ignored test `name` of this test program in namespaces of its own, as root. Skips it,
/// aloud, when a right or one of the `tools` is missing; then fails if `CI=true`.
///
/// # Panics
/// When that test fails, or cannot be run in CI.
pub fn isolated(name: &str, tools: &[&str]) {
    let needed = ["ip", "mount", "timeout", "unshare"].iter().chain(tools);
    let mut missing: Vec<&str> = needed
        .copied()
        .filter(|tool| find(tool).is_none())
        .collect();
    if !rustix::process::geteuid().is_root() {
        missing.push("root");
    }
    if !missing.is_empty() {
        let missing = missing.join(", ");
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "missing for {name}: {missing}");
        eprintln!("SKIPPED, not a success: {name} needs {missing}");
        return;
    }
    // The program under test may lie below /tmp, so nothing is mounted there.
    let directory = tempfile::tempdir().unwrap();
    // What is started in there ends with it: the namespace of processes, too, is its own. What hangs is
    // killed, as `unshare` heeds nothing less, and with it all else.
    let status = Command::new("timeout")
        .args(["--foreground", "--signal=KILL", WATCHDOG, "unshare"])
        .args(["--net", "--mount", "--pid", "--fork", "--kill-child"])
        .args(["--mount-proc", "--"])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", name, "--ignored", "--nocapture"])
        .env(INSIDE, directory.path())
        .env(RUNTIME_DIR, directory.path().join("run"))
        .env("TMPDIR", directory.path())
        .status()
        .unwrap();
    assert!(status.success(), "{name} failed; see above");
}

/// Prepares the namespaces that [`isolated`] has made: an empty `/run`, an empty
/// [`directory`], and the loopback interface up.
///
/// # Panics
/// Outside of them.
pub fn enter() {
    let directory = directory();
    run("mount -t tmpfs tmpfs /run");
    // Files of killed processes vanish with the namespace.
    let directory = directory.to_str().unwrap();
    run(&format!("mount -t tmpfs -o mode=0700 tmpfs {directory}"));
    run("ip link set lo up");
}

/// Returns the directory of the running test. Temporary directories, and the runtime directory
/// of `fipa` unless a test names another one, lie in it.
///
/// # Panics
/// Outside of the namespaces that [`isolated`] has made.
#[must_use]
pub fn directory() -> PathBuf {
    let directory = std::env::var_os(INSIDE).map(PathBuf::from);
    directory.expect("this test is started by another one")
}

/// Runs a command, its words separated by one blank each.
///
/// # Panics
/// When it fails.
pub fn run(command: &str) {
    let mut words = command.split(' ');
    let program = words.next().unwrap();
    let output = Command::new(program).args(words).output();
    let output = output.unwrap_or_else(|error| panic!("{command}: {error}"));
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command}: {told}");
}

/// Where a tool is: in `PATH`, or where Debian has those of the administrator.
fn find(tool: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let dirs = std::env::split_paths(&path).chain(["/usr/sbin".into(), "/sbin".into()]);
    dirs.map(|dir| dir.join(tool)).find(|file| file.is_file())
}

/// A process that is killed when this is dropped.
#[derive(Debug)]
pub struct Running(Child);

impl Running {
    /// Starts it.
    ///
    /// # Panics
    /// When it cannot be started.
    pub fn start(command: &mut Command) -> Self {
        let started = command.spawn();
        Self(started.unwrap_or_else(|error| panic!("{command:?}: {error}")))
    }

    /// Starts it, waits for its first line of output, and returns that line. Its standard error
    /// is kept for the panic message, or shown when `FIPA_TEST_LOG` is set.
    ///
    /// # Panics
    /// When it cannot be started, or ends before it prints a line: with its status and its
    /// standard error.
    pub fn until_ready(command: &mut Command) -> (Self, String) {
        let shows_errors = std::env::var_os("FIPA_TEST_LOG").is_some();
        command.stdout(Stdio::piped()).stderr(match shows_errors {
            true => Stdio::inherit(),
            false => Stdio::piped(),
        });
        let mut running = Self::start(command);
        let errors = running.0.stderr.take().map(collect_last);
        let mut stdout = BufReader::new(running.0.stdout.take().unwrap());
        let mut ready = String::new();
        stdout.read_line(&mut ready).unwrap();
        if ready.is_empty() {
            let status = running.0.wait().unwrap();
            let errors = errors.map(|errors| errors.join().unwrap());
            let errors = errors.unwrap_or_default();
            panic!("{command:?} ended ({status}) before it was ready: {errors}");
        }
        // A full pipe would block the process, and a closed one would end it.
        std::thread::spawn(move || io::copy(&mut stdout, &mut io::sink()));
        (running, ready)
    }

    /// Returns the status of the process if it has ended.
    ///
    /// # Panics
    /// When the kernel refuses to say.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.0.try_wait().unwrap()
    }

    /// The process.
    pub fn child(&mut self) -> &mut Child {
        &mut self.0
    }
}

/// Reads to the end, and returns the last few kilobytes.
fn collect_last(mut from: ChildStderr) -> JoinHandle<String> {
    const KEPT: usize = 8 << 10;
    std::thread::spawn(move || {
        let mut kept = Vec::new();
        let mut part = [0; 1024];
        while let Ok(read @ 1..) = from.read(&mut part) {
            kept.extend(part.iter().take(read));
            kept.drain(..kept.len().saturating_sub(KEPT));
        }
        String::from_utf8_lossy(&kept).into_owned()
    })
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended already, which is as good.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_program_under_test_is_not_hidden() {
        isolated("tests::inside_the_program_under_test_is_not_hidden", &[]);
    }

    #[test]
    #[ignore = "is run by the other test in namespaces of its own"]
    fn inside_the_program_under_test_is_not_hidden() {
        let outside = std::env::temp_dir().join("outside");
        std::fs::write(&outside, "").unwrap();
        enter();
        assert!(std::env::current_exe().unwrap().exists());
        assert_eq!(std::env::temp_dir(), directory());
        let runtime_dir = PathBuf::from(std::env::var_os(RUNTIME_DIR).unwrap());
        assert!(runtime_dir.starts_with(directory()));
        assert!(!outside.exists(), "the directory is not this test's own");
    }

    #[test]
    #[should_panic(expected = "before it was ready: no such luck")]
    fn a_process_that_cannot_start_fails_the_test_with_its_error() {
        let mut command = Command::new("sh");
        Running::until_ready(command.args(["-c", "echo no such luck >&2; exit 3"]));
    }

    #[test]
    fn a_process_is_ready_with_its_first_line() {
        let mut command = Command::new("sh");
        command.args(["-c", "echo here I am; exec cat /dev/zero"]);
        let (mut running, ready) = Running::until_ready(&mut command);
        assert_eq!(ready, "here I am\n");
        assert!(running.ended().is_none());
    }
}
