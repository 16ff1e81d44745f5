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

use std::path::PathBuf;
use std::process::{Child, Command};

pub use avahi::Avahi;
pub use ghost::Ghost;
pub use network::{Host, Network};
#[cfg(feature = "tls")]
pub use peer::Anybody;
pub use peer::{frame, frame_header};

/// Tells the process in the namespaces that it is there.
const INSIDE: &str = "FIPA_TESTBED_INSIDE";

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
    // What is started in there ends with it: the namespace of processes, too, is its own. What hangs is
    // killed, as `unshare` heeds nothing less, and with it all else.
    let status = Command::new("timeout")
        .args(["--foreground", "--signal=KILL", WATCHDOG, "unshare"])
        .args(["--net", "--mount", "--pid", "--fork", "--kill-child"])
        .args(["--mount-proc", "--"])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", name, "--ignored", "--nocapture"])
        .env(INSIDE, "1")
        .status()
        .unwrap();
    assert!(status.success(), "{name} failed; see above");
}

/// Prepares the namespaces that [`isolated`] has made: an empty `/run`, and the loopback
/// interface up.
///
/// # Panics
/// Outside of them.
pub fn enter() {
    let inside = std::env::var_os(INSIDE).is_some();
    assert!(inside, "this test is started by another one");
    run("mount -t tmpfs tmpfs /run");
    run("ip link set lo up");
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

    /// The process.
    pub fn child(&mut self) -> &mut Child {
        &mut self.0
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        // It may have ended already, which is as good.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
