//! The processes of a measurement: start, orders, end and cleanup.

use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use fipa::admin::keys::{Keys, KeysError, VALID};
use fipa::error::ErrorChain;
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

use crate::comparison::Program;
use crate::part::{End, Event, Order, Part};

/// Timeout of an answer, which usually takes less than a second.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Time that processes have to end after their orders end, if one uses zenoh. Only zenoh removes its files.
const ENDING: Duration = Duration::from_secs(2);

/// Beginning of the name of a measurement's directory; the process identifier follows.
const DIRECTORY: &str = "fipa-bench-";
/// Directory of shared memory.
const SHARED_MEMORY_DIR: &str = "/dev/shm";
/// Beginning of the names of a measurement's files in shared memory; the process identifier follows.
const SHARED_MEMORY: &str = "fipa_bench-";

/// All processes of a measurement, and their directory, apart from the domains of this user.
///
/// Dropping it ends all processes and removes all files, also after an interruption.
pub(super) struct Stage {
    program: Program,
    /// The program of the ends that use zenoh, if zenoh is measured.
    zenoh: Option<PathBuf>,
    /// Whether a process uses zenoh.
    ends_in_order: bool,
    place: PathBuf,
    processes: Vec<Process>,
    /// The processors that this process may use.
    cores: Vec<usize>,
}

/// Index of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct ProcessIndex(usize);

struct Process {
    name: String,
    child: Child,
    orders: Option<ChildStdin>,
    events: Lines<BufReader<ChildStdout>>,
}

impl Stage {
    pub(super) fn new(program: Program, zenoh: Option<PathBuf>) -> Result<Self, String> {
        remove_leftovers();
        let place = base().join(format!("{DIRECTORY}{}", std::process::id()));
        let mut private = std::fs::DirBuilder::new();
        std::os::unix::fs::DirBuilderExt::mode(&mut private, 0o700);
        let made = private.create(&place);
        made.map_err(|error| format!("cannot create {}: {error}", place.display()))?;
        Ok(Self {
            program,
            ends_in_order: zenoh.is_some(),
            zenoh,
            place,
            processes: Vec::new(),
            cores: super::machine::cores(),
        })
    }

    /// Name of a domain of the measurement.
    pub(super) fn domain(which: &str) -> String {
        format!("bench-{}-{which}", std::process::id())
    }

    /// Makes keys for the gateways of these domains, which trust each other. Returns the setting with
    /// the keys for each.
    pub(super) fn keys(&self, domains: &[String]) -> Result<Vec<String>, String> {
        let to_text = |error: KeysError| ErrorChain(&error).to_string();
        let of = |domain: &String| Keys::at(self.place.join(format!("keys-{domain}")));
        let all: Vec<Keys> = domains.iter().map(of).collect();
        let mut certificates = Vec::new();
        for (keys, domain) in all.iter().zip(domains) {
            keys.init(&Self::domain(domain), &[], VALID)
                .map_err(to_text)?;
            let file = keys.own_file();
            let read = std::fs::read(&file);
            certificates.push(read.map_err(|error| format!("{}: {error}", file.display()))?);
        }
        let mut settings = Vec::new();
        for (number, keys) in all.iter().enumerate() {
            for (_, certificate) in certificates
                .iter()
                .enumerate()
                .filter(|(it, _)| *it != number)
            {
                keys.trust(certificate).map_err(to_text)?;
            }
            settings.push(format!("security.keys={}", keys.dir().display()));
        }
        Ok(settings)
    }

    /// Starts a process, waits until it is ready and returns its address.
    pub(super) async fn start(
        &mut self,
        part: &Part,
        domain: &str,
        settings: &[String],
    ) -> Result<(ProcessIndex, String), String> {
        let core = part.end().and_then(|end| self.core_of(end));
        let described = serde_json::to_string(part).map_err(|error| error.to_string())?;
        let mut command = Command::new(&self.program.path);
        command
            .env_remove("HOME")
            .args(&self.program.arguments)
            .args(["--part", &described])
            .args(["--set", &format!("domain={}", Self::domain(domain))])
            // Gateways of other programs on this machine are not found.
            .args(["--set", "discovery.mdns=false"])
            .args(["--set", "transport.tcp.listen=127.0.0.1:0"])
            .args(["--set", "transport.udp.listen=127.0.0.1:0"])
            .args(["--set", "transport.quic.listen=127.0.0.1:0"]);
        if let Some(core) = core {
            command.args(["--core", &core.to_string()]);
        }
        for setting in settings {
            command.args(["--set", setting]);
        }
        self.spawn(command, format!("{part:?} in {domain}")).await
    }

    /// Starts the gateways of these domains; each later one connects with the first one. Each has
    /// the settings that `settings_of` returns for its number.
    pub(super) async fn start_gateways(
        &mut self,
        domains: &[String],
        settings_of: impl Fn(usize) -> Vec<String>,
    ) -> Result<Vec<ProcessIndex>, String> {
        let mut gateways = Vec::new();
        let mut first: Option<String> = None;
        for (number, domain) in domains.iter().enumerate() {
            let mut settings = settings_of(number);
            settings.push(format!("mts.name={}", Self::domain(domain)));
            if let Some(first) = &first {
                settings.push(format!("discovery.static={{ first = [\"{first}\"] }}"));
            }
            let (gateway, address) = self.start(&Part::Gateway, domain, &settings).await?;
            gateways.push(gateway);
            first.get_or_insert(address);
        }
        Ok(gateways)
    }

    /// Starts an end that uses zenoh. Its threads are not pinned.
    pub(super) async fn start_zenoh(
        &mut self,
        end: End,
        shared_memory: bool,
    ) -> Result<(ProcessIndex, String), String> {
        let program = self
            .zenoh
            .as_ref()
            .ok_or("no program was given for zenoh")?;
        let mut command = Command::new(program);
        command.args(match end {
            End::Sender => ["--end", "sender"],
            End::Receiver => ["--end", "receiver"],
        });
        if shared_memory {
            command.arg("--shared-memory");
        }
        self.spawn(command, format!("zenoh {end:?}")).await
    }

    /// Writes a file into the directory of the measurement.
    pub(super) fn write(&self, name: &str, text: &str) -> Result<PathBuf, String> {
        let path = self.place.join(name);
        let written = std::fs::write(&path, text);
        written.map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        Ok(path)
    }

    /// Starts an end that is a program of its own, which also gets the domain of the measurement and its directory.
    pub(super) async fn start_foreign(
        &mut self,
        mut command: Command,
        domain: &str,
        arguments: &[&str],
    ) -> Result<(ProcessIndex, String), String> {
        self.ends_in_order = true;
        command
            .arg(Self::domain(domain))
            .arg(&self.place)
            .args(arguments);
        let name = format!("{:?}", command.as_std());
        self.spawn(command, name).await
    }

    async fn spawn(
        &mut self,
        mut command: Command,
        name: String,
    ) -> Result<(ProcessIndex, String), String> {
        let program = command.as_std().get_program().to_owned();
        let mut child = command
            .env("FIPA_RUNTIME_DIR", &self.place)
            .env("FIPA_STATE_DIR", self.place.join("state"))
            // An empty file: no other configuration of this machine applies.
            .env("FIPA_CONFIG", "/dev/null")
            .current_dir("/")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            // Ctrl-C reaches the measurement only, which ends its processes in order.
            .process_group(0)
            .kill_on_drop(true)
            .spawn()
            .map_err(|error| format!("cannot start {}: {error}", program.display()))?;
        let orders = child.stdin.take();
        let stdout = child.stdout.take();
        let stdout = stdout.ok_or("a process without standard output")?;
        let who = ProcessIndex(self.processes.len());
        self.processes.push(Process {
            name,
            child,
            orders,
            events: BufReader::new(stdout).lines(),
        });
        match self.event(who).await? {
            Event::Ready { address } => Ok((who, address)),
            other => Err(format!("the first line of a process was {other:?}")),
        }
    }

    /// The processor of an end, if there are two.
    fn core_of(&self, end: End) -> Option<usize> {
        match (self.cores.as_slice(), end) {
            ([sender, _, ..], End::Sender) => Some(*sender),
            ([_, receiver, ..], End::Receiver) => Some(*receiver),
            _ => None,
        }
    }

    /// Sends an order to a process. Its result is the next event.
    pub(super) async fn tell(&mut self, who: ProcessIndex, order: &Order) -> Result<(), String> {
        let process = self.process(who)?;
        let mut line = serde_json::to_string(order).map_err(|error| error.to_string())?;
        line.push('\n');
        let orders = process.orders.as_mut().ok_or("its orders have ended")?;
        let written = orders.write_all(line.as_bytes()).await;
        written.map_err(|error| format!("{}: {error}", process.name))
    }

    /// Waits for the next event of a process.
    pub(super) async fn event(&mut self, who: ProcessIndex) -> Result<Event, String> {
        let process = self.process(who)?;
        let name = &process.name;
        let line = tokio::time::timeout(TIMEOUT, process.events.next_line()).await;
        let line = line.map_err(|_| format!("{name} sent no line for {TIMEOUT:?}"))?;
        let line = line.map_err(|error| format!("{name}: {error}"))?;
        let line = line.ok_or_else(|| format!("{name} ended unexpectedly"))?;
        match serde_json::from_str(&line) {
            Ok(Event::Failed { what }) => Err(what),
            Ok(event) => Ok(event),
            Err(error) => Err(format!("{name} sent {line:?}: {error}")),
        }
    }

    /// Ends one process.
    pub(super) async fn end(&mut self, who: ProcessIndex) -> Result<(), String> {
        let process = self.process(who)?;
        process.orders = None;
        let ended = process.child.wait().await;
        ended
            .map(drop)
            .map_err(|error| format!("{}: {error}", process.name))
    }

    /// The identifier of a running process.
    pub(super) fn pid(&mut self, who: ProcessIndex) -> Result<u32, String> {
        let process = self.process(who)?;
        let pid = process.child.id();
        pid.ok_or_else(|| format!("{} has ended", process.name))
    }

    fn process(&mut self, who: ProcessIndex) -> Result<&mut Process, String> {
        let process = self.processes.get_mut(who.0);
        process.ok_or_else(|| "no process has this index".to_owned())
    }

    /// Files of the measurement in shared memory.
    fn shared_memory() -> impl Iterator<Item = PathBuf> {
        let mark = format!("{SHARED_MEMORY}{}-", std::process::id());
        let files = std::fs::read_dir(SHARED_MEMORY_DIR);
        let files = files.into_iter().flatten().flatten();
        let ours = files.filter(move |file| file.file_name().to_string_lossy().starts_with(&mark));
        ours.map(|file| file.path())
    }
}

impl Drop for Stage {
    fn drop(&mut self) {
        // Other processes are killed while they still wait for orders: dozens of orderly ends at once would
        // take the processors from this one, which removes all files anyway.
        if self.ends_in_order {
            for process in &mut self.processes {
                process.orders = None;
            }
            let until = Instant::now() + ENDING;
            for process in &mut self.processes {
                while matches!(process.child.try_wait(), Ok(None)) && Instant::now() < until {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        }
        for process in &mut self.processes {
            let _ended_already = process.child.start_kill();
        }
        for process in &mut self.processes {
            while matches!(process.child.try_wait(), Ok(None)) {
                std::thread::sleep(Duration::from_millis(1));
            }
        }
        for file in Self::shared_memory() {
            let _ = std::fs::remove_file(file);
        }
        remove(&self.place);
    }
}

/// The parent of the directories of measurements: in memory, because on a busy disk the removal of some
/// hundred files takes most of a second.
fn base() -> PathBuf {
    let memory = Path::new(SHARED_MEMORY_DIR);
    match memory.is_dir() {
        true => memory.to_owned(),
        false => std::env::temp_dir(),
    }
}

/// Removes what measurements left that were killed. Their other processes end with their standard
/// input.
fn remove_leftovers() {
    let is_left = |name: &str, mark: &str| {
        let rest = name.strip_prefix(mark)?;
        let end = rest.find(|c: char| !c.is_ascii_digit());
        let process = rest.get(..end.unwrap_or(rest.len()))?;
        let ended = !process.is_empty() && !Path::new("/proc").join(process).exists();
        ended.then_some(())
    };
    let left = |place: &Path, mark: &str| {
        let entries = std::fs::read_dir(place).into_iter().flatten().flatten();
        let named = entries.filter_map(|entry| {
            is_left(entry.file_name().to_str()?, mark)?;
            Some(entry.path())
        });
        named.collect::<Vec<_>>()
    };
    for directory in left(&base(), DIRECTORY) {
        remove(&directory);
    }
    for file in left(Path::new(SHARED_MEMORY_DIR), SHARED_MEMORY) {
        if let Err(error) = std::fs::remove_file(&file) {
            fipa_transport::log_limit::warn!(%error, file = %file.display(), "could not be removed");
        }
    }
}

fn remove(place: &Path) {
    if let Err(error) = std::fs::remove_dir_all(place) {
        fipa_transport::log_limit::warn!(%error, directory = %place.display(), "could not be removed");
    }
}
