//! The processes of the demo: started, spoken with, killed, and none left behind.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

use super::part::{Event, Order, Received};

/// How long the demo waits for something that should happen at once.
const PATIENCE: Duration = Duration::from_secs(20);

/// One process of the demo.
pub(super) struct Part {
    name: String,
    child: Child,
    orders: Option<ChildStdin>,
    events: Lines<BufReader<ChildStdout>>,
    /// Messages that were received while the demo waited for something else.
    received: VecDeque<Received>,
    pub(super) locations: Vec<String>,
}

impl Part {
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
        let line = tokio::time::timeout(PATIENCE, self.events.next_line()).await;
        let line = line.map_err(|_| format!("{name} said nothing for {PATIENCE:?}"))?;
        let line = line.map_err(|error| format!("{name}: {error}"))?;
        let line = line.ok_or_else(|| format!("{name} ended unexpectedly"))?;
        match serde_json::from_str(&line) {
            Ok(Event::Failed { what }) => Err(format!("{name}: {what}")),
            Ok(event) => Ok(event),
            Err(error) => Err(format!("{name} said {line:?}: {error}")),
        }
    }

    /// Tells the part to do something and waits until it is done.
    pub(super) async fn tell(&mut self, order: &Order) -> Result<Event, String> {
        let mut line = serde_json::to_string(order).map_err(|error| error.to_string())?;
        line.push('\n');
        let orders = self.orders.as_mut().ok_or("the part was told to end")?;
        let written = orders.write_all(line.as_bytes()).await;
        written.map_err(|error| format!("{}: {error}", self.name))?;
        self.event().await
    }

    /// The next letter that the part, which watches, has seen to break its protocol.
    pub(super) async fn caught(&mut self) -> Result<Event, String> {
        self.event().await
    }

    /// The next message that the part has received.
    pub(super) async fn received(&mut self) -> Result<Received, String> {
        if let Some(received) = self.received.pop_front() {
            return Ok(received);
        }
        match self.next().await? {
            Event::Received(received) => Ok(received),
            other => Err(format!(
                "{}: a message was expected, not {other:?}",
                self.name
            )),
        }
    }

    pub(super) fn pid(&self) -> u32 {
        self.child.id().unwrap_or(0)
    }
}

/// All processes of the demo, and the place where their domains meet.
pub(super) struct Stage {
    program: PathBuf,
    /// Set for all parts, so that nothing of this user's real domains is touched.
    place: PathBuf,
    parts: BTreeMap<String, Part>,
}

impl Stage {
    pub(super) fn new() -> Result<Self, String> {
        let program = std::env::current_exe().map_err(|error| error.to_string())?;
        let place = std::env::temp_dir().join(format!("fipa-demo-{}", std::process::id()));
        Ok(Self {
            program,
            place,
            parts: BTreeMap::new(),
        })
    }

    /// The name of one of the demo's domains.
    pub(super) fn domain(host: &str) -> String {
        format!("demo-{}-{host}", std::process::id())
    }

    /// Starts a process with an agent of this name, or with a gateway, and waits until it is
    /// there.
    pub(super) async fn start(&mut self, host: &str, name: &str, role: &str) -> Result<(), String> {
        self.start_with(host, name, role, "monitor.check=off").await
    }

    /// The same with something else in its configuration.
    pub(super) async fn start_with(
        &mut self,
        host: &str,
        name: &str,
        role: &str,
        set: &str,
    ) -> Result<(), String> {
        let mut child = Command::new(&self.program)
            .args(["demo", "--part", role, "--name", name])
            .args(["--set", &format!("domain={}", Self::domain(host))])
            .args(["--set", &format!("mts.name={name}")])
            // Nothing of the demo leaves this machine.
            .args(["--set", "discovery.interfaces=lo"])
            .args(["--set", "transport.tcp.listen=127.0.0.1:0"])
            .args(["--set", "mts.transports=shm,unix,tcp"])
            .args(["--set", set])
            .env("FIPA_RUNTIME_DIR", &self.place)
            .env_remove("FIPA_CONFIG")
            .current_dir("/")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // A Ctrl-C is for the demo, which ends its parts in order.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(|error| format!("cannot start {}: {error}", self.program.display()))?;
        let orders = child.stdin.take();
        let stdout = child
            .stdout
            .take()
            .ok_or("a process without standard output")?;
        let mut part = Part {
            name: name.to_owned(),
            child,
            orders,
            events: BufReader::new(stdout).lines(),
            received: VecDeque::new(),
            locations: Vec::new(),
        };
        match part.event().await? {
            Event::Ready { locations } => part.locations = locations,
            other => return Err(format!("{name} began with {other:?}")),
        }
        self.parts.insert(name.to_owned(), part);
        Ok(())
    }

    pub(super) fn part(&mut self, name: &str) -> Result<&mut Part, String> {
        self.parts
            .get_mut(name)
            .ok_or_else(|| format!("{name} is not on stage"))
    }

    /// Kills a process with SIGKILL and waits until it is gone.
    pub(super) async fn kill(&mut self, name: &str) -> Result<(), String> {
        let mut part = self
            .parts
            .remove(name)
            .ok_or_else(|| format!("{name} is not there"))?;
        part.child.kill().await.map_err(|error| error.to_string())
    }

    /// The shared memory of the demo's domains.
    pub(super) fn shared_memory(&self) -> Vec<PathBuf> {
        let mark = format!("fipa_demo-{}-", std::process::id());
        let files = std::fs::read_dir("/dev/shm")
            .into_iter()
            .flatten()
            .flatten();
        let ours = files.filter(|file| file.file_name().to_string_lossy().starts_with(&mark));
        ours.map(|file| file.path()).collect()
    }

    /// Everything the demo has in the file system.
    fn files(&self) -> Vec<PathBuf> {
        let mut files = self.shared_memory();
        collect(&self.place, &mut files);
        files
    }

    /// Ends everybody in order, then makes sure that nothing is left. Says what had to be removed
    /// by force.
    pub(super) async fn clear(&mut self) -> Vec<PathBuf> {
        for part in self.parts.values_mut() {
            part.orders = None;
        }
        for part in self.parts.values_mut() {
            let ended = tokio::time::timeout(PATIENCE, part.child.wait()).await;
            if ended.is_err() {
                let _ = part.child.kill().await;
            }
        }
        self.parts.clear();
        let left = self.files();
        for file in &left {
            let _ = std::fs::remove_file(file);
        }
        if self.place.exists() {
            let _ = std::fs::remove_dir_all(&self.place);
        }
        left
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
