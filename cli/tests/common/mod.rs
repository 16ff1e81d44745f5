//! Runs processes of the `fipa` command. Each test has its own domain and directories.

#![allow(dead_code, reason = "no test uses all items")]
#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stderr, reason = "a skipped test says so")]

use std::ffi::OsStr;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread;
use std::time::Duration;

use fipa_testbed::ChildGuard;
use serde_json::Value;
use tempfile::TempDir;

/// Timeout for hanging tests. No step is expected to take this long.
const WATCHDOG: Duration = Duration::from_secs(60);

/// A simulated host: a unique domain with its own runtime directory and a clean environment.
pub(crate) struct Host {
    directory: TempDir,
    pub(crate) domain: String,
}

impl Host {
    pub(crate) fn new() -> Self {
        let directory = tempfile::tempdir().unwrap();
        let random = directory
            .path()
            .file_name()
            .and_then(OsStr::to_str)
            .unwrap();
        let random: String = random.chars().filter(char::is_ascii_alphanumeric).collect();
        Self {
            domain: format!("cli-{}-{random}", std::process::id()),
            directory,
        }
    }

    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// A command with these arguments in this domain, without mDNS.
    pub(crate) fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_fipa"));
        command
            .args(["--set", &format!("domain={}", self.domain)])
            .args(["--set", "discovery.mdns=false"])
            .args(arguments)
            .current_dir(self.directory.path())
            .env_clear()
            .env("HOME", self.directory.path())
            .env("FIPA_RUNTIME_DIR", self.path("run"))
            .stdin(Stdio::null());
        command
    }

    /// Runs a command to its end.
    pub(crate) fn run(&self, arguments: &[&str]) -> Ran {
        output_of(&mut self.command(arguments), Vec::new())
    }

    /// Runs a command to its end with this standard input.
    pub(crate) fn run_with_input(&self, arguments: &[&str], input: &[u8]) -> Ran {
        let mut command = self.command(arguments);
        output_of(command.stdin(Stdio::piped()), input.to_vec())
    }

    /// Starts a command and waits for the first line of its output.
    pub(crate) fn start(&self, arguments: &[&str]) -> Running {
        Running::new(self.command(arguments))
    }

    /// Starts an agent of the demo, which executes orders from standard input, and waits until it is
    /// registered.
    pub(crate) fn ordered_agent(&self, name: &str, arguments: &[&str]) -> Running {
        let role = ["demo", "--role", "agent", "--name", name];
        let mut command = self.command(&[arguments, &role].concat());
        command.stdin(Stdio::piped());
        let running = Running::new(command);
        assert!(running.ready.contains("ready"), "{}", running.ready);
        running
    }

    /// Starts an echo agent and waits until it is registered.
    pub(crate) fn echo(&self, name: &str) -> Running {
        let running = self.start(&["echo", name]);
        let expected = format!("agent {} ", fipa_acl::escape_name(name));
        assert!(running.ready.starts_with(&expected), "{}", running.ready);
        running
    }

    /// The remaining files in the runtime directory and in shared memory.
    pub(crate) fn left_behind(&self) -> Vec<PathBuf> {
        let runtime = fs::read_dir(self.path("run"))
            .into_iter()
            .flatten()
            .flatten();
        let runtime = runtime.map(|entry| entry.path());
        runtime.chain(self.shared_memory()).collect()
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

/// Removes the shared memory files of killed processes.
impl Drop for Host {
    fn drop(&mut self) {
        for file in self.shared_memory() {
            let _ = fs::remove_file(file);
        }
    }
}

/// Wraps a command in a user namespace and these further ones, in which this line of shell runs first. Returns
/// `None` if this user cannot create them; panics in that case if `CI=true`.
pub(crate) fn unshared(command: &Command, namespaces: &[&str], first: &str) -> Option<Command> {
    let unshare = || {
        let mut unshare = Command::new("unshare");
        let line = format!("{first} && exec \"$@\"");
        unshare.args(["--user", "--map-root-user"]).args(namespaces);
        unshare.args(["sh", "-c", &line, "sh"]);
        unshare
    };
    let can = unshare().arg("true").status();
    if !can.is_ok_and(|status| status.success()) {
        let in_ci = std::env::var("CI").as_deref() == Ok("true");
        assert!(!in_ci, "needs user namespaces");
        eprintln!("SKIPPED, not a success: needs user namespaces");
        return None;
    }
    let mut wrapped = unshare();
    wrapped.arg(command.get_program()).args(command.get_args());
    wrapped.env_clear().stdin(Stdio::null());
    for (name, value) in command.get_envs() {
        if let Some(value) = value {
            wrapped.env(name, value);
        }
    }
    wrapped.env("PATH", std::env::var_os("PATH").unwrap());
    Some(wrapped)
}

/// The result of a command that has ended.
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
    /// Returns standard output. Requires success and an empty standard error.
    #[track_caller]
    pub(crate) fn done(self) -> String {
        assert_eq!((self.code, self.stderr.as_str()), (Some(0), ""), "{self:?}");
        String::from_utf8(self.stdout).unwrap()
    }

    /// Returns standard output as JSON. Requires success and an empty standard error.
    #[track_caller]
    pub(crate) fn done_json(self) -> Value {
        serde_json::from_str(&self.done()).unwrap()
    }

    /// Returns standard output as JSON, and standard error. Requires exit code 1.
    #[track_caller]
    pub(crate) fn failed_json(self) -> (Value, String) {
        assert_eq!(self.code, Some(1), "{self:?}");
        (serde_json::from_slice(&self.stdout).unwrap(), self.stderr)
    }

    /// Returns standard output and standard error. Requires exit code 1.
    #[track_caller]
    pub(crate) fn failed_text(self) -> (String, String) {
        assert_eq!(self.code, Some(1), "{self:?}");
        (String::from_utf8(self.stdout).unwrap(), self.stderr)
    }

    /// Returns standard error. Requires this exit code and an empty standard output.
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

/// An echo agent on another host, and the gateway of that host.
pub(crate) struct Far {
    /// The gateway, named `crex`.
    pub(crate) crex: Running,
    pub(crate) echo: Running,
    /// The name of the agent.
    pub(crate) name: String,
}

impl Far {
    /// Starts the gateways of two hosts, and the agent on the other one. Waits until the gateway of this host, which is
    /// also returned, knows the agent.
    pub(crate) fn connected(host: &Host, other: &Host) -> (Running, Self) {
        let name = format!("far-{}", other.domain);
        let echo = other.echo(&name);
        let crex = other.start(&["up", "--json", "--set", "mts.name=crex"]);
        let address = crex.tcp_address();
        let peer = format!("discovery.static={{ crex = [\"tcp://{address}\"] }}");
        let gateway = host.start(&["up", "--set", "mts.name=sherpa", "--set", &peer]);
        fipa_testbed::until("the far agent is announced", || {
            let known = host.run(&["agents", &name, "--json"]).done_json();
            !known["agents"][0].is_null()
        });
        (gateway, Self { crex, echo, name })
    }
}

/// A running command. It is killed when the value is dropped.
pub(crate) struct Running {
    child: ChildGuard,
    lines: Receiver<String>,
    errors: Receiver<String>,
    /// The lines received from `errors` so far.
    log: String,
    /// The first line of its standard output.
    pub(crate) ready: String,
}

impl Running {
    /// Starts a command and waits for the first line of its output.
    #[track_caller]
    pub(crate) fn new(mut command: Command) -> Self {
        let mut child = ChildGuard::start(command.stdout(Stdio::piped()).stderr(Stdio::piped()));
        let printed = lines(child.child().stdout.take().unwrap());
        let errors = lines(child.child().stderr.take().unwrap());
        let mut running = Self {
            child,
            lines: printed,
            errors,
            log: String::new(),
            ready: String::new(),
        };
        running.ready = running.line();
        running
    }

    /// Writes a line to its standard input, which must be a pipe.
    #[track_caller]
    pub(crate) fn write_line(&mut self, line: &str) {
        let input = self.child.child().stdin.as_mut();
        writeln!(input.unwrap(), "{line}").unwrap();
    }

    /// Waits for the next line of standard output.
    #[track_caller]
    pub(crate) fn line(&mut self) -> String {
        match self.lines.recv_timeout(WATCHDOG) {
            Ok(line) => line,
            Err(error) => {
                self.child.kill();
                panic!("no output ({error}): {:?}", self.end());
            }
        }
    }

    /// Returns the next line of standard output, or `None` if the command has ended without one.
    pub(crate) fn next_line(&mut self) -> Option<String> {
        self.lines.recv_timeout(WATCHDOG).ok()
    }

    /// Waits for a line on standard error that contains all these parts.
    #[track_caller]
    pub(crate) fn wait_for_log(&mut self, parts: &[&str]) {
        loop {
            match self.errors.recv_timeout(WATCHDOG) {
                Ok(line) => {
                    self.log.push_str(&format!("{line}\n"));
                    if parts.iter().all(|part| line.contains(part)) {
                        return;
                    }
                }
                Err(error) => panic!("no line with {parts:?} ({error}): {}", self.log),
            }
        }
    }

    /// Returns the TCP address of a gateway that was started with `up --json`.
    #[track_caller]
    pub(crate) fn tcp_address(&self) -> String {
        let ready: Value = serde_json::from_str(&self.ready).unwrap();
        let locations = ready["locations"].as_array().unwrap();
        let mut locations = locations.iter().filter_map(Value::as_str);
        let tcp = locations.find_map(|it| it.strip_prefix("tcp://")).unwrap();
        tcp.split('#').next().unwrap().to_owned()
    }

    /// Returns the location of this kind, without signature and incarnation, of a gateway that was
    /// started with `up --json`.
    #[track_caller]
    pub(crate) fn location(&self, kind: &str) -> String {
        let ready: Value = serde_json::from_str(&self.ready).unwrap();
        let locations = ready["locations"].as_array().unwrap();
        let mut locations = locations.iter().filter_map(Value::as_str);
        let found = locations.find(|it| it.starts_with(&format!("{kind}://")));
        found.unwrap().split([';', '#']).next().unwrap().to_owned()
    }

    /// Its process identifier.
    pub(crate) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Sends a signal, waits for the end, and returns the exit code and standard error.
    #[track_caller]
    pub(crate) fn signal(mut self, signal: &str) -> (Option<i32>, String) {
        self.send_signal(signal);
        self.end()
    }

    /// Sends a signal.
    #[track_caller]
    pub(crate) fn send_signal(&self, signal: &str) {
        self.child.signal(signal);
    }

    /// Whether the command ends within 100 ms.
    pub(crate) fn has_ended(&mut self) -> bool {
        match self.errors.recv_timeout(Duration::from_millis(100)) {
            Ok(line) => self.log.push_str(&format!("{line}\n")),
            Err(error) => return error == RecvTimeoutError::Disconnected,
        }
        false
    }

    /// Waits for the end, and returns the exit code and all of standard error.
    #[track_caller]
    pub(crate) fn end(&mut self) -> (Option<i32>, String) {
        let watchdog = Watchdog::new(self.child.id());
        let status = self.child.wait();
        drop(watchdog);
        for line in self.errors.iter() {
            self.log.push_str(&format!("{line}\n"));
        }
        (status.code(), std::mem::take(&mut self.log))
    }
}

/// Runs a command to its end. Writes `input` to its standard input if that is piped.
fn output_of(command: &mut Command, input: Vec<u8>) -> Ran {
    let piped = command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = piped.spawn().unwrap();
    let watchdog = Watchdog::new(child.id());
    let stdin = child.stdin.take();
    let writer = thread::spawn(move || stdin.map(|mut stdin| stdin.write_all(&input)));
    let output = child.wait_with_output().unwrap();
    drop(watchdog);
    // A command may end without reading all input; its output has the reason.
    let _ = writer.join().unwrap();
    output.into()
}

/// Kills a process that hangs; the process then has no exit code. Drop it after the process has ended.
struct Watchdog {
    _cancel: Sender<()>,
}

impl Watchdog {
    fn new(child: u32) -> Self {
        let pid = child.to_string();
        let (cancel, canceled) = channel();
        thread::spawn(move || {
            if canceled.recv_timeout(WATCHDOG) == Err(RecvTimeoutError::Timeout) {
                let _ = Command::new("kill").args(["-KILL", &pid]).status();
            }
        });
        Self { _cancel: cancel }
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
