//! Support for tests: processes that end with their test ([`ChildGuard`]), waiting for conditions
//! ([`until`]), and networks: hosts in network namespaces, their links, and the real Avahi. Also
//! frames of peers that do not use `fipa`.
//!
//! A test that needs a network consists of two functions. The test function calls [`isolated`], which
//! runs the second, ignored test function in a process with new namespaces (network, mounts,
//! processes). The second function calls [`enter`] and then builds its network:
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
//! No cleanup is necessary, however the test ends: with its process the kernel removes the namespaces,
//! their processes and their interfaces. For the same reason names need not be unique.
//!
//! If the machine lacks a requirement of a test, the test prints a note and is skipped; with `CI=true`
//! it fails.
//!
//! All functions panic on failure, because this crate is for tests only.

// The whole crate is for tests: a failure panics, and a skipped test prints a note.
#![allow(clippy::unwrap_used, clippy::print_stderr)]

mod avahi;
mod child;
mod http_requests;
pub mod jade;
pub mod languages;
mod network;
mod packet_repeater;
mod peer;
mod wait;

use std::path::PathBuf;
use std::process::Command;

pub use avahi::Avahi;
pub use child::{ChildGuard, Waits, ignored_test, private_memory, send_signal};
pub use http_requests::hostile_requests;
pub use network::{Family, Host, Network};
pub use packet_repeater::PacketRepeater;
#[cfg(feature = "tls")]
pub use peer::AnyPeer;
pub use peer::{frame, frame_header};
pub use wait::{until, until_async, until_some, until_some_async};

/// Environment variable with the directory of the test, for the process in the namespaces.
const INSIDE: &str = "FIPA_TESTBED_INSIDE";
/// Environment variable with the runtime directory of `fipa` processes.
const RUNTIME_DIR: &str = "FIPA_RUNTIME_DIR";

/// Timeout of a hanging test in namespaces, in seconds. No test needs half of it.
const WATCHDOG: &str = "900";

/// Runs the ignored test `name` of this test program in new namespaces, as root. If root or one of the
/// `tools` is missing, prints a note and skips the test, or panics if `CI=true`.
///
/// # Panics
/// If the test fails, or if it cannot run and `CI=true`.
pub fn isolated(name: &str, tools: &[&str]) {
    let needed = [&["ip", "mount", "timeout", "unshare"], tools].concat();
    if !can_run(name, &needed, rustix::process::geteuid().is_root()) {
        return;
    }
    // The program under test may be below /tmp, so /tmp is not replaced by a mount.
    let directory = tempfile::tempdir().unwrap();
    // All processes of the test end with its process namespace. A hanging test is killed with SIGKILL,
    // because `unshare` ignores other signals.
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

/// Whether the test `name` can run: all `tools` are there, and it has the permission that it needs. If not, prints a
/// note, or panics if `CI=true`.
///
/// # Panics
/// If the test cannot run and `CI=true`.
#[must_use]
pub fn can_run(name: &str, tools: &[&str], is_permitted: bool) -> bool {
    let missing = tools.iter().copied().filter(|tool| find(tool).is_none());
    let root = (!is_permitted).then_some("root");
    let missing: Vec<&str> = missing.chain(root).collect();
    is_complete(name, &missing)
}

/// A command that runs a line of the shell on a terminal of its own, of which standard input has the keys and standard
/// output the text. `None` if the program `script` is missing; then prints a note with the name of the test.
///
/// # Panics
/// If the program is missing and `CI=true`.
#[must_use]
pub fn on_terminal(name: &str, line: &str) -> Option<Command> {
    let mut script = can_run(name, &["script"], true).then(|| Command::new("script"))?;
    script.args([
        "--quiet",
        "--return",
        "--flush",
        "--command",
        line,
        "/dev/null",
    ]);
    Some(script)
}

/// Whether nothing is missing for a test. If something is, prints a note, or panics if `CI=true`.
fn is_complete(name: &str, missing: &[&str]) -> bool {
    if missing.is_empty() {
        return true;
    }
    let missing = missing.join(", ");
    let in_ci = std::env::var("CI").as_deref() == Ok("true");
    assert!(!in_ci, "missing for {name}: {missing}");
    eprintln!("SKIPPED, not a success: {name} needs {missing}");
    false
}

/// Prepares the namespaces that [`isolated`] has created: mounts an empty `/run`, an empty `/dev/shm` and
/// an empty [`directory`], and sets the loopback interface up.
///
/// # Panics
/// Outside of these namespaces.
pub fn enter() {
    let directory = directory();
    run("mount -t tmpfs tmpfs /run");
    // Files of killed processes vanish with the namespace.
    run("mount -t tmpfs tmpfs /dev/shm");
    let directory = directory.to_str().unwrap();
    run(&format!("mount -t tmpfs -o mode=0700 tmpfs {directory}"));
    run("ip link set lo up");
}

/// Returns the directory of the running test. It contains the temporary directories and the default
/// runtime directory of `fipa`.
///
/// # Panics
/// Outside of the namespaces that [`isolated`] has created.
#[must_use]
pub fn directory() -> PathBuf {
    let directory = std::env::var_os(INSIDE).map(PathBuf::from);
    directory.expect("this test must be started by another test")
}

/// Runs a command. Its arguments are separated by single spaces.
///
/// # Panics
/// If the command fails.
pub fn run(command: &str) {
    let mut words = command.split(' ');
    let program = words.next().unwrap();
    let output = Command::new(program).args(words).output();
    let output = output.unwrap_or_else(|error| panic!("{command}: {error}"));
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command}: {errors}");
}

/// Finds a tool in `PATH` or in Debian's directories of administration tools.
fn find(tool: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let dirs = std::env::split_paths(&path).chain(["/usr/sbin".into(), "/sbin".into()]);
    dirs.map(|dir| dir.join(tool)).find(|file| file.is_file())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entering_the_namespaces_does_not_hide_the_program_under_test() {
        isolated(
            "tests::inside_entering_the_namespaces_does_not_hide_the_program_under_test",
            &[],
        );
    }

    #[test]
    #[ignore = "is run by the other test in namespaces of its own"]
    fn inside_entering_the_namespaces_does_not_hide_the_program_under_test() {
        let outside = std::env::temp_dir().join("outside");
        std::fs::write(&outside, "").unwrap();
        enter();
        assert!(std::env::current_exe().unwrap().exists());
        assert_eq!(std::env::temp_dir(), directory());
        let runtime_dir = PathBuf::from(std::env::var_os(RUNTIME_DIR).unwrap());
        assert!(runtime_dir.starts_with(directory()));
        assert!(!outside.exists(), "the directory is shared");
    }
}
