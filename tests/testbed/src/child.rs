//! Processes that tests start.

use std::collections::HashMap;
use std::ffi::OsString;
use std::fs;
use std::io::{self, BufRead as _, BufReader, Read as _};
use std::process::{Child, ChildStderr, Command, ExitStatus, Stdio};
use std::thread::JoinHandle;

use crate::until;

/// Returns a command that runs this ignored test of this test program in a process of its own.
///
/// # Panics
/// If the path of this program is not known.
#[must_use]
pub fn ignored_test(name: &str) -> Command {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", name, "--ignored", "--nocapture"]);
    command
}

/// Sends a signal, such as `-TERM`, to a process. After `-STOP`, waits until all threads of the process have
/// stopped: a thread that runs on another processor goes on for a moment.
///
/// # Panics
/// If there is no such process or signal.
#[track_caller]
pub fn send_signal(process: u32, signal: &str) {
    let pid = process.to_string();
    let sent = Command::new("kill").args([signal, &pid]).status();
    assert!(sent.unwrap().success(), "kill {signal} {pid}");
    if signal == "-STOP" {
        until("the process has stopped", || is_stopped(process));
    }
}

/// Returns the memory of a process that is in no file, in bytes.
///
/// # Panics
/// If there is no such process.
#[must_use]
#[track_caller]
pub fn private_memory(process: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let mut lines = status.lines();
    let kib = lines.find_map(|line| line.strip_prefix("RssAnon:")?.strip_suffix(" kB"));
    kib.unwrap().trim().parse::<u64>().unwrap() << 10
}

/// How often each thread of a process has waited.
#[derive(Debug)]
pub struct Waits(HashMap<OsString, u64>);

impl Waits {
    /// Reads the counts of a process.
    ///
    /// # Panics
    /// If there is no such process.
    #[must_use]
    #[track_caller]
    pub fn of(process: u32) -> Self {
        let threads = fs::read_dir(format!("/proc/{process}/task")).unwrap();
        let counts = threads.flatten().filter_map(|thread| {
            // The thread may end meanwhile.
            let status = fs::read_to_string(thread.path().join("status")).ok()?;
            let mut lines = status.lines();
            let count = lines.find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))?;
            Some((thread.file_name(), count.trim().parse().unwrap()))
        });
        Self(counts.collect())
    }

    /// Returns how often the threads that are here have waited since these earlier counts. The waits of a thread
    /// that has ended since then are not known.
    #[must_use]
    pub fn since(&self, earlier: &Self) -> u64 {
        let new = self.0.iter().map(|(thread, count)| {
            let before = earlier.0.get(thread).copied().unwrap_or(0);
            // Another thread may have got the number of one that has ended.
            count.checked_sub(before).unwrap_or(*count)
        });
        new.sum()
    }
}

/// Whether no thread of the process runs.
fn is_stopped(process: u32) -> bool {
    let Ok(threads) = fs::read_dir(format!("/proc/{process}/task")) else {
        return true;
    };
    threads.flatten().all(|thread| {
        // A thread that has ended has no status. The state follows the name, which may contain parentheses.
        let status = fs::read_to_string(thread.path().join("stat")).unwrap_or_default();
        let state = status.rsplit_once(") ").map(|(_, fields)| fields);
        state.is_none_or(|fields| fields.starts_with(['T', 't', 'Z', 'X']))
    })
}

/// A process that is killed on drop.
#[derive(Debug)]
pub struct ChildGuard(Child);

impl ChildGuard {
    /// Starts the command.
    ///
    /// # Panics
    /// If the command cannot be started.
    #[track_caller]
    pub fn start(command: &mut Command) -> Self {
        let started = command.spawn();
        Self(started.unwrap_or_else(|error| panic!("{command:?}: {error}")))
    }

    /// Starts the command, waits for the first line of its output, and returns that line. Its standard
    /// error becomes part of the panic message, or is printed if `FIPA_TEST_LOG` is set.
    ///
    /// # Panics
    /// If the command cannot be started, or ends before it prints a line. The message has its status and
    /// its standard error.
    pub fn until_ready(command: &mut Command) -> (Self, String) {
        let shows_errors = std::env::var_os("FIPA_TEST_LOG").is_some();
        command.stdout(Stdio::piped()).stderr(match shows_errors {
            true => Stdio::inherit(),
            false => Stdio::piped(),
        });
        let mut guard = Self::start(command);
        let errors = guard.0.stderr.take().map(collect_last);
        let mut stdout = BufReader::new(guard.0.stdout.take().unwrap());
        let mut ready = String::new();
        stdout.read_line(&mut ready).unwrap();
        if ready.is_empty() {
            let status = guard.0.wait().unwrap();
            let errors = errors.map(|errors| errors.join().unwrap());
            let errors = errors.unwrap_or_default();
            panic!("{command:?} ended ({status}) before it was ready: {errors}");
        }
        // A full pipe would block the process, and a closed one would end it.
        std::thread::spawn(move || io::copy(&mut stdout, &mut io::sink()));
        (guard, ready)
    }

    /// Returns the status of the process if it has ended.
    ///
    /// # Panics
    /// If the kernel does not return the status.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.0.try_wait().unwrap()
    }

    /// Waits for the end of the process.
    ///
    /// # Panics
    /// If the kernel does not return the status.
    pub fn wait(&mut self) -> ExitStatus {
        self.0.wait().unwrap()
    }

    /// Returns the process identifier.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.0.id()
    }

    /// Sends a signal, such as `-STOP`.
    ///
    /// # Panics
    /// If the process has ended and was waited for, or there is no such signal.
    #[track_caller]
    pub fn signal(&self, signal: &str) {
        send_signal(self.id(), signal);
    }

    /// Sends SIGKILL and waits for the end.
    pub fn kill(&mut self) {
        // An error means that the process has ended already.
        let _ = self.0.kill();
        let _ = self.0.wait();
    }

    /// The process.
    pub fn child(&mut self) -> &mut Child {
        &mut self.0
    }
}

impl Drop for ChildGuard {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Reads to the end and returns the last 8 KiB.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[should_panic(expected = "before it was ready: no such luck")]
    fn a_process_that_cannot_start_fails_the_test_with_its_error() {
        let mut command = Command::new("sh");
        ChildGuard::until_ready(command.args(["-c", "echo no such luck >&2; exit 3"]));
    }

    #[test]
    fn a_process_is_ready_when_it_prints_its_first_line() {
        let mut command = Command::new("sh");
        command.args(["-c", "echo here I am; exec cat /dev/zero"]);
        let (mut guard, ready) = ChildGuard::until_ready(&mut command);
        assert_eq!(ready, "here I am\n");
        assert!(guard.ended().is_none());
    }

    #[test]
    fn a_process_has_stopped_when_its_signal_was_sent() {
        let mut command = Command::new("sh");
        let guard = ChildGuard::start(command.args(["-c", "while :; do :; done"]));
        for _ in 0..20 {
            assert!(!is_stopped(guard.id()));
            guard.signal("-STOP");
            assert!(is_stopped(guard.id()));
            guard.signal("-CONT");
        }
    }

    #[test]
    fn a_process_ends_with_its_guard() {
        let mut command = Command::new("sleep");
        let guard = ChildGuard::start(command.arg("1000"));
        let process = format!("/proc/{}", guard.id());
        assert!(std::path::Path::new(&process).exists());
        drop(guard);
        assert!(!std::path::Path::new(&process).exists());
    }
}
