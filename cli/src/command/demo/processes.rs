//! Starts, controls and ends the processes of the demo.

use std::collections::{BTreeMap, VecDeque};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

use super::process::{Event, Order, Received, shown};

/// Timeout for actions that normally take milliseconds.
const STEP_TIMEOUT: Duration = Duration::from_secs(20);

/// One process of the demo.
pub(super) struct Process {
    name: String,
    child: Child,
    orders: Option<ChildStdin>,
    events: Lines<BufReader<ChildStdout>>,
    /// Messages received while the demo waited for another event.
    received: VecDeque<Received>,
    pub(super) locations: Vec<String>,
}

impl Process {
    /// Waits for the next event that is not a received message.
    async fn event(&mut self) -> Result<Event, String> {
        loop {
            match self.next().await? {
                Event::Received(received) => self.received.push_back(received),
                other => return Ok(other),
            }
        }
    }

    async fn next(&mut self) -> Result<Event, String> {
        let name = &self.name;
        let line = tokio::time::timeout(STEP_TIMEOUT, self.events.next_line()).await;
        let line = line.map_err(|_| format!("no event from {name} within {STEP_TIMEOUT:?}"))?;
        let line = line.map_err(|error| format!("{name}: {error}"))?;
        let line = line.ok_or_else(|| format!("{name} ended unexpectedly"))?;
        match serde_json::from_str(&line) {
            Ok(Event::Failed { error }) => Err(format!("{name}: {error}")),
            Ok(event) => Ok(event),
            Err(error) => Err(format!("invalid event {line:?} from {name}: {error}")),
        }
    }

    /// Sends an order to the process and waits for its result.
    pub(super) async fn run(&mut self, order: &Order) -> Result<Event, String> {
        self.begin(order).await?;
        self.event().await
    }

    /// Sends an order to the process.
    pub(super) async fn begin(&mut self, order: &Order) -> Result<(), String> {
        let mut line = serde_json::to_string(order).map_err(|error| error.to_string())?;
        line.push('\n');
        let orders = self.orders.as_mut().ok_or("the process is ending")?;
        let written = orders.write_all(line.as_bytes()).await;
        written.map_err(|error| format!("{}: {error}", self.name))
    }

    /// Waits for the result of an order that was sent.
    pub(super) async fn result(&mut self) -> Result<Event, String> {
        self.event().await
    }

    /// Waits for the watcher to report a protocol violation.
    pub(super) async fn violation(&mut self) -> Result<Event, String> {
        self.event().await
    }

    /// Waits for the next message that the process receives.
    pub(super) async fn received(&mut self) -> Result<Received, String> {
        if let Some(received) = self.received.pop_front() {
            return Ok(received);
        }
        match self.next().await? {
            Event::Received(received) => Ok(received),
            other => Err(format!(
                "{}: expected a message, not {}",
                self.name,
                shown(&other)
            )),
        }
    }

    pub(super) fn pid(&self) -> u32 {
        self.child.id().unwrap_or(0)
    }

    /// Takes the orders away, and waits until the process has ended.
    async fn end(&mut self) {
        self.orders = None;
        let ended = tokio::time::timeout(STEP_TIMEOUT, self.child.wait()).await;
        if ended.is_err() {
            let _ = self.child.kill().await;
        }
    }
}

/// All processes of the demo, and the runtime directory of their domains.
pub(super) struct Processes {
    program: PathBuf,
    /// `FIPA_RUNTIME_DIR` of all processes, separate from the domains of this user.
    runtime_dir: TempDir,
    by_name: BTreeMap<String, Process>,
}

impl Processes {
    pub(super) fn new() -> Result<Self, String> {
        let program = std::env::current_exe().map_err(|error| error.to_string())?;
        // Private and with a random name: another user cannot create it first.
        let runtime_dir = tempfile::Builder::new()
            .prefix(&format!("fipa-demo-{}-", std::process::id()))
            .permissions(std::fs::Permissions::from_mode(0o700))
            .tempdir()
            .map_err(|error| format!("cannot create a directory for the demo: {error}"))?;
        Ok(Self {
            program,
            runtime_dir,
            by_name: BTreeMap::new(),
        })
    }

    /// The name of one of the demo's domains.
    pub(super) fn domain(host: &str) -> String {
        format!("demo-{}-{host}", std::process::id())
    }

    /// Starts a process with an agent of this name, a gateway or a watcher, and waits until it is
    /// ready.
    pub(super) async fn start(&mut self, host: &str, name: &str, role: &str) -> Result<(), String> {
        self.start_with(host, name, role, "monitor.check=off").await
    }

    /// Like [`start`](Self::start), with one more configuration setting.
    pub(super) async fn start_with(
        &mut self,
        host: &str,
        name: &str,
        role: &str,
        set: &str,
    ) -> Result<(), String> {
        let mut child = Command::new(&self.program)
            .args(["demo", "--role", role, "--name", name])
            .args(["--set", &format!("domain={}", Self::domain(host))])
            .args(["--set", &format!("mts.name={name}")])
            // No traffic of the demo leaves this machine, and it meets no other domains: neither those of
            // this machine nor those of another demo, whose agents have the same names.
            .args(["--set", "discovery.mdns=false"])
            .args(["--set", "transport.tcp.listen=127.0.0.1:0"])
            .args(["--set", "mts.transports=shm,unix,tcp"])
            .args(["--set", set])
            .env("FIPA_RUNTIME_DIR", self.runtime_dir.path())
            // An empty file: no other configuration of this machine applies.
            .env("FIPA_CONFIG", "/dev/null")
            .current_dir("/")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // Ctrl-C is sent to the demo only, which ends its processes in order.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(|error| format!("cannot start {}: {error}", self.program.display()))?;
        let orders = child.stdin.take();
        let stdout = child
            .stdout
            .take()
            .ok_or("the process has no standard output")?;
        let mut process = Process {
            name: name.to_owned(),
            child,
            orders,
            events: BufReader::new(stdout).lines(),
            received: VecDeque::new(),
            locations: Vec::new(),
        };
        match process.event().await? {
            Event::Ready { locations } => process.locations = locations,
            other => {
                return Err(format!(
                    "{name}: expected `ready`, not {other}",
                    other = shown(&other)
                ));
            }
        }
        self.by_name.insert(name.to_owned(), process);
        Ok(())
    }

    pub(super) fn get(&mut self, name: &str) -> Result<&mut Process, String> {
        self.by_name
            .get_mut(name)
            .ok_or_else(|| format!("{name} is not running"))
    }

    /// Kills a process with SIGKILL and waits for its end.
    pub(super) async fn kill(&mut self, name: &str) -> Result<(), String> {
        let mut process = self.take(name)?;
        process
            .child
            .kill()
            .await
            .map_err(|error| error.to_string())
    }

    /// Ends one process in order.
    pub(super) async fn end(&mut self, name: &str) -> Result<(), String> {
        self.take(name)?.end().await;
        Ok(())
    }

    fn take(&mut self, name: &str) -> Result<Process, String> {
        let process = self.by_name.remove(name);
        process.ok_or_else(|| format!("{name} is not running"))
    }

    /// The shared memory files of the demo's domains.
    pub(super) fn shared_memory(&self) -> Vec<PathBuf> {
        let mark = format!("fipa_demo-{}-", std::process::id());
        let files = std::fs::read_dir("/dev/shm")
            .into_iter()
            .flatten()
            .flatten();
        let ours = files.filter(|file| file.file_name().to_string_lossy().starts_with(&mark));
        ours.map(|file| file.path()).collect()
    }

    /// All files of the demo.
    fn files(&self) -> Vec<PathBuf> {
        let mut files = self.shared_memory();
        collect(self.runtime_dir.path(), &mut files);
        files
    }

    /// Ends all processes in order, then removes the files that are left. Returns those files.
    pub(super) async fn clear(&mut self) -> Vec<PathBuf> {
        for process in self.by_name.values_mut() {
            process.orders = None;
        }
        for process in self.by_name.values_mut() {
            process.end().await;
        }
        self.by_name.clear();
        let remaining = self.files();
        for file in &remaining {
            let _ = std::fs::remove_file(file);
        }
        let _ = std::fs::remove_dir_all(self.runtime_dir.path());
        remaining
    }
}

fn collect(directory: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
        match entry.file_type() {
            Ok(kind) if kind.is_dir() => collect(&entry.path(), files),
            _ => files.push(entry.path()),
        }
    }
}
