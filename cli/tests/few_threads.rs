//! Processes that may start few threads.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

mod common;

use std::fs::Permissions;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::{PermissionsExt, chown};
use std::process::{Command, Stdio};

use common::Host;
use fipa_testbed::ChildGuard;

/// A host of a user without other processes, because the limit counts all processes of a user, and does not
/// apply to root.
struct LimitedUser {
    host: Host,
    user: u32,
}

impl LimitedUser {
    /// Creates a host of another user. `None` without root; panics in that case if `CI=true`.
    fn new() -> Option<Self> {
        let limited = Self {
            host: Host::new(),
            user: 1_000_000 + std::process::id(),
        };
        std::fs::create_dir(limited.host.path("run")).unwrap();
        for path in ["", "run"] {
            let path = limited.host.path(path);
            std::fs::set_permissions(&path, Permissions::from_mode(0o700)).unwrap();
            let _ = chown(path, Some(limited.user), Some(limited.user));
        }
        // Also checks that the user can reach the program.
        let version = limited.command(64, &["--version"]).output();
        if version.is_ok_and(|version| version.status.success()) {
            return Some(limited);
        }
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "needs root, setpriv and prlimit");
        eprintln!("SKIPPED, not a success: needs root, setpriv and prlimit");
        None
    }

    /// A command of this user with one worker thread, which may have this number of processes and threads.
    fn command(&self, limit: u32, arguments: &[&str]) -> Command {
        let fipa = self.host.command(arguments);
        let user = self.user;
        let mut command = Command::new("setpriv");
        command
            .args([format!("--reuid={user}"), format!("--regid={user}")])
            .args(["--clear-groups", "--", "prlimit"])
            .arg(format!("--nproc={limit}"))
            .arg(fipa.get_program())
            .args(fipa.get_args())
            .current_dir(fipa.get_current_dir().unwrap())
            .env_clear()
            .env("PATH", std::env::var_os("PATH").unwrap())
            .env("TOKIO_WORKER_THREADS", "1");
        for (name, value) in fipa.get_envs() {
            command.env(name, value.unwrap());
        }
        command
    }
}

/// Runs a service until it is ready, and returns whether it was, and its standard error. An error must name the
/// limit.
fn outcome(mut service: Command, limit: u32) -> (bool, String) {
    service.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut service = ChildGuard::start(&mut service);
    let mut ready = String::new();
    let output = service.child().stdout.take().unwrap();
    BufReader::new(output).read_line(&mut ready).unwrap();
    if !ready.is_empty() {
        service.signal("-TERM");
    }
    let mut errors = String::new();
    let output = service.child().stderr.take();
    output.unwrap().read_to_string(&mut errors).unwrap();
    let code = service.wait().code();
    assert!(!errors.contains("panicked"), "limit {limit}: {errors}");
    if !ready.is_empty() {
        assert_eq!(code, Some(0), "limit {limit}: {errors}");
        return (true, errors);
    }
    assert_eq!(code, Some(1), "limit {limit}: {errors}");
    let named = format!("all of its {limit} processes and threads (RLIMIT_NPROC)");
    for part in [&*named, "ulimit -u", "LimitNPROC="] {
        assert!(errors.contains(part), "limit {limit}: {errors}");
    }
    (false, errors)
}

#[test]
fn a_limit_of_threads_is_an_error_with_its_name_and_no_panic() {
    let Some(limited) = LimitedUser::new() else {
        return;
    };
    for command in [&["echo", "parrot"][..], &["up"]] {
        let mut failures = Vec::new();
        let mut limit = 1;
        loop {
            let (was_ready, errors) = outcome(limited.command(limit, command), limit);
            if was_ready {
                break;
            }
            failures.push(errors);
            limit += 1;
            assert!(limit < 64, "{failures:?}");
        }
        // Without a worker thread, and without a thread for the calls that block.
        let expected = [
            "error: cannot start the worker threads: cannot start another thread",
            "error: cannot start another thread",
        ];
        for expected in expected {
            let found = failures.iter().any(|errors| errors.contains(expected));
            assert!(found, "{command:?}: {failures:?}");
        }
    }
}
