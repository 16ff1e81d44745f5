//! Real processes of the `fipa` command, each test in a domain and places of its own.

#![allow(dead_code, reason = "not every test uses all of it")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

use std::ffi::OsStr;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::PathBuf;
use std::process::{Child, Command, Output, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::Duration;

use serde_json::Value;
use tempfile::TempDir;

/// Ends a test that hangs; nothing is expected to take this long.
const WATCHDOG: Duration = Duration::from_secs(60);

/// A host of its own: a domain that nobody else has, where its processes meet, and nothing from
/// the outside.
pub(crate) struct Host {
    place: TempDir,
    pub(crate) domain: String,
}

impl Host {
    pub(crate) fn new() -> Self {
        let place = tempfile::tempdir().unwrap();
        let random = place.path().file_name().and_then(OsStr::to_str).unwrap();
        let random: String = random.chars().filter(char::is_ascii_alphanumeric).collect();
        Self {
            domain: format!("cli-{}-{random}", std::process::id()),
            place,
        }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.place.path().join(name)
    }

    /// The command with these arguments, in this domain and without mDNS.
    pub(crate) fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fipa"));
        command
            .args(["--set", &format!("domain={}", self.domain)])
            .args(["--set", "discovery.mdns=false"])
            .args(arguments)
            .current_dir(self.place.path())
            .env_clear()
            .env("HOME", self.place.path())
            .env("FIPA_RUNTIME_DIR", self.path("run"))
            .stdin(Stdio::null());
        command
    }

    /// Runs it to its end.
    pub(crate) fn run(&self, arguments: &[&str]) -> Ran {
        output_of(&mut self.command(arguments), Vec::new())
    }

    /// Runs it to its end with something on standard input.
    pub(crate) fn run_with_input(&self, arguments: &[&str], input: &[u8]) -> Ran {
        let mut command = self.command(arguments);
        output_of(command.stdin(Stdio::piped()), input.to_vec())
    }

    /// Starts it and waits for the first line of its output.
    pub(crate) fn start(&self, arguments: &[&str]) -> Running {
        Running::new(self.command(arguments))
    }

    /// Starts an echo agent and waits until it is there.
    pub(crate) fn echo(&self, name: &str) -> Running {
        let running = self.start(&["echo", name]);
        assert!(running.ready.starts_with(name), "{}", running.ready);
        running
    }

    /// What is left where the processes meet, and of their shared memory.
    pub(crate) fn left_behind(&self) -> Vec<PathBuf> {
        let meeting = fs::read_dir(self.path("run"))
            .into_iter()
            .flatten()
            .flatten();
        let meeting = meeting.map(|entry| entry.path());
        meeting.chain(self.shared_memory()).collect()
    }

    fn shared_memory(&self) -> impl Iterator<Item = PathBuf> {
        let prefix = format!("fipa_{}_", self.domain);
        let files = fs::read_dir("/dev/shm").into_iter().flatten().flatten();
        files.map(|entry| entry.path()).filter(move |path| {
            let name = path.file_name().and_then(OsStr::to_str);
            name.is_some_and(|name| name.starts_with(&prefix))
        })
    }
}

/// Processes that were killed leave files in shared memory.
impl Drop for Host {
    fn drop(&mut self) {
        for file in self.shared_memory() {
            let _ = fs::remove_file(file);
        }
    }
}

/// A command that came to its end.
#[derive(Debug)]
pub(crate) struct Ran {
    pub(crate) code: Option<i32>,
    pub(crate) stdout: Vec<u8>,
    pub(crate) stderr: String,
}

impl From<Output> for Ran {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code(),
            stdout: output.stdout,
            stderr: String::from_utf8(output.stderr).unwrap(),
        }
    }
}

impl Ran {
    /// Its standard output, when it has done what it was told and had nothing to complain about.
    #[track_caller]
    pub(crate) fn done(self) -> String {
        assert_eq!((self.code, self.stderr.as_str()), (Some(0), ""), "{self:?}");
        String::from_utf8(self.stdout).unwrap()
    }

    /// What it printed as JSON, when it has done what it was told.
    #[track_caller]
    pub(crate) fn done_json(self) -> Value {
        serde_json::from_str(&self.done()).unwrap()
    }

    /// What it printed as JSON, and what it complained about, when it has failed.
    #[track_caller]
    pub(crate) fn failed_json(self) -> (Value, String) {
        assert_eq!(self.code, Some(1), "{self:?}");
        (serde_json::from_slice(&self.stdout).unwrap(), self.stderr)
    }

    /// What it complained about, when it has failed with this code and printed nothing.
    #[track_caller]
    pub(crate) fn failed(self, code: i32) -> String {
        assert_eq!(
            (self.code, &self.stdout[..]),
            (Some(code), &b""[..]),
            "{self:?}"
        );
        self.stderr
    }
}

/// A command that goes on until it is told to end; killed when the test ends before.
pub(crate) struct Running {
    child: Child,
    lines: Receiver<String>,
    errors: Receiver<String>,
    told: String,
    /// The first line it printed.
    pub(crate) ready: String,
}

impl Running {
    /// Starts a command and waits for the first line of its output.
    #[track_caller]
    pub(crate) fn new(mut command: Command) -> Self {
        let mut child = command
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let printed = lines(child.stdout.take().unwrap());
        let errors = lines(child.stderr.take().unwrap());
        let mut running = Self {
            child,
            lines: printed,
            errors,
            told: String::new(),
            ready: String::new(),
        };
        running.ready = running.line();
        running
    }

    /// The next line it prints.
    #[track_caller]
    pub(crate) fn line(&mut self) -> String {
        match self.lines.recv_timeout(WATCHDOG) {
            Ok(line) => line,
            Err(error) => {
                let _ = self.child.kill();
                panic!("no line was printed ({error}): {:?}", self.end());
            }
        }
    }

    /// The next line that it printed before it ended, if there is one.
    pub(crate) fn next_line(&mut self) -> Option<String> {
        self.lines.recv_timeout(WATCHDOG).ok()
    }

    /// Waits until it says something on standard error that has all these parts.
    #[track_caller]
    pub(crate) fn tells(&mut self, parts: &[&str]) {
        loop {
            match self.errors.recv_timeout(WATCHDOG) {
                Ok(line) => {
                    self.told.push_str(&format!("{line}\n"));
                    if parts.iter().all(|part| line.contains(part)) {
                        return;
                    }
                }
                Err(error) => panic!("{parts:?} was not told ({error}): {}", self.told),
            }
        }
    }

    /// The number of its process.
    pub(crate) fn pid(&self) -> String {
        self.child.id().to_string()
    }

    /// Sends a signal, waits for its end, and returns the exit code and standard error.
    #[track_caller]
    pub(crate) fn signal(mut self, signal: &str) -> (Option<i32>, String) {
        self.send_signal(signal);
        self.end()
    }

    /// Sends a signal.
    #[track_caller]
    pub(crate) fn send_signal(&self, signal: &str) {
        let pid = self.child.id().to_string();
        let sent = Command::new("kill").args([signal, &pid]).status().unwrap();
        assert!(sent.success());
    }

    /// Whether it ends within a moment.
    pub(crate) fn has_ended(&mut self) -> bool {
        match self.errors.recv_timeout(Duration::from_millis(100)) {
            Ok(line) => self.told.push_str(&format!("{line}\n")),
            Err(error) => return error == RecvTimeoutError::Disconnected,
        }
        false
    }

    /// Waits for its end, and returns the exit code and all of standard error.
    #[track_caller]
    pub(crate) fn end(&mut self) -> (Option<i32>, String) {
        let watchdog = Watchdog::over(&self.child);
        let status = self.child.wait().unwrap();
        drop(watchdog);
        for line in self.errors.iter() {
            self.told.push_str(&format!("{line}\n"));
        }
        (status.code(), std::mem::take(&mut self.told))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Runs a command to its end, with something on standard input if that is piped.
fn output_of(command: &mut Command, input: Vec<u8>) -> Ran {
    let piped = command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = piped.spawn().unwrap();
    let watchdog = Watchdog::over(&child);
    let stdin = child.stdin.take();
    let writer = thread::spawn(move || stdin.map(|mut stdin| stdin.write_all(&input)));
    let output = child.wait_with_output().unwrap();
    drop(watchdog);
    // Whoever does not read all of it has a reason, which the output tells.
    let _ = writer.join().unwrap();
    output.into()
}

/// Kills a process that hangs, which then has no exit code. To be dropped once it has been waited for.
struct Watchdog {
    _waiting: Sender<()>,
}

impl Watchdog {
    fn over(child: &Child) -> Self {
        let pid = child.id().to_string();
        let (waiting, ended) = channel();
        thread::spawn(move || {
            if ended.recv_timeout(WATCHDOG) == Err(RecvTimeoutError::Timeout) {
                let _ = Command::new("kill").args(["-KILL", &pid]).status();
            }
        });
        Self { _waiting: waiting }
    }
}

fn lines(output: impl Read + Send + 'static) -> Receiver<String> {
    let (sender, lines) = channel();
    thread::spawn(move || {
        for line in BufReader::new(output).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    lines
}
