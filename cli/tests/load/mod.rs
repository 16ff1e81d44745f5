//! Two gateway processes, and an honest pair of agents that exchanges letters through them while a
//! test attacks the gateways.

#![allow(dead_code, reason = "not every test uses all of it")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

pub(crate) mod hostile;

use std::collections::HashSet;
use std::fs;
use std::io::{BufRead as _, BufReader};
use std::net::SocketAddr;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use fipa::admin::keys::{Keys, VALID};
use fipa::config::Sources;
use fipa::{Agent, AgentId, Config, Domain, Incarnation, Outcome, Performative};
use fipa_testbed::{ChildGuard, until};
use parking_lot::Mutex;
use serde_json::Value;
use tokio::runtime::Runtime;

/// Timeout that ends a hung test.
pub(crate) const WATCHDOG: Duration = Duration::from_secs(90);

/// Maximum number of stored log lines per gateway. The oldest ones are dropped.
const LINES: usize = 200;

/// Prefix of the content of the honest pair's letters.
const HONEST: &str = "honest ";

/// Returns the number in this environment variable.
pub(crate) fn number(variable: &str) -> Option<u64> {
    let text = std::env::var(variable).ok()?;
    Some(
        text.parse()
            .unwrap_or_else(|_| panic!("{variable} is not a number: {text}")),
    )
}

/// Creates keys in this directory for a service with this name.
pub(crate) fn keys(dir: impl Into<std::path::PathBuf>, name: &str) -> Keys {
    let keys = Keys::at(dir);
    keys.init(name, &[], VALID).unwrap();
    keys
}

/// Makes each of two services trust the other one.
pub(crate) fn befriend(one: &Keys, other: &Keys) {
    one.trust(&fs::read(other.own_file()).unwrap()).unwrap();
    other.trust(&fs::read(one.own_file()).unwrap()).unwrap();
}

/// Resources of a process.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Usage {
    /// Resident memory, in KiB.
    pub(crate) resident: u64,
    pub(crate) descriptors: usize,
    /// Processor time since the start.
    pub(crate) processor: Duration,
}

/// Returns the resource usage of the process with this identifier.
pub(crate) fn usage(process: u32) -> Usage {
    let proc = format!("/proc/{process}");
    let status = fs::read_to_string(format!("{proc}/status")).unwrap();
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let resident = resident.unwrap().trim_end_matches("kB").trim();
    let stat = fs::read_to_string(format!("{proc}/stat")).unwrap();
    // Fields 14 and 15 of proc_pid_stat(5). The name may contain blanks and ends at the last `)`.
    let fields: Vec<&str> = stat
        .rsplit_once(')')
        .unwrap()
        .1
        .split_whitespace()
        .collect();
    let ticks: u64 = fields[11..13]
        .iter()
        .map(|it| it.parse::<u64>().unwrap())
        .sum();
    Usage {
        resident: resident.parse().unwrap(),
        descriptors: fs::read_dir(format!("{proc}/fd")).unwrap().count(),
        processor: Duration::from_millis(ticks * 10),
    }
}

/// A gateway process. Dropping it kills the process.
pub(crate) struct Gateway {
    child: ChildGuard,
    pub(crate) settings: Vec<String>,
    locations: Vec<String>,
    log_lines: Arc<Mutex<Vec<String>>>,
}

impl Gateway {
    /// Starts the gateway with this command of the program, and waits until it is ready.
    pub(crate) fn start(mut command: Command, settings: Vec<String>) -> Self {
        command.args(["up", "--json"]);
        for setting in &settings {
            command.args(["--set", setting]);
        }
        command.stdin(Stdio::null());
        command.stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = ChildGuard::start(&mut command);
        let log_lines: Arc<Mutex<Vec<String>>> = Arc::default();
        let (keep, errors) = (Arc::clone(&log_lines), child.child().stderr.take().unwrap());
        std::thread::spawn(move || {
            for line in BufReader::new(errors).lines().map_while(Result::ok) {
                let mut lines = keep.lock();
                // A panic message is always stored.
                if lines.len() >= LINES && !line.contains("panicked") {
                    lines.remove(0);
                }
                lines.push(line);
            }
        });
        let mut ready = String::new();
        BufReader::new(child.child().stdout.take().unwrap())
            .read_line(&mut ready)
            .unwrap();
        let ready: Value = serde_json::from_str(&ready).unwrap_or_else(|error| {
            panic!("the gateway is not ready ({error}): {:?}", log_lines.lock())
        });
        let locations = ready["locations"].as_array().unwrap().iter();
        let locations = locations.map(|location| location.as_str().unwrap());
        let locations = locations.map(|location| location.split('#').next().unwrap().to_owned());
        Self {
            child,
            settings,
            locations: locations.collect(),
            log_lines,
        }
    }

    /// Returns the `discovery.static` setting with the locations of this gateway.
    pub(crate) fn known_as(&self, name: &str) -> String {
        let others = ["shm", "http", "udt"];
        let is_other = |it: &&String| others.iter().any(|other| it.starts_with(other));
        let network = self.locations.iter().filter(|it| !is_other(it));
        let locations: Vec<String> = network.map(|location| format!("{location:?}")).collect();
        format!(
            "discovery.static={{ {name:?} = [{}] }}",
            locations.join(", ")
        )
    }

    /// Returns the listening address of this kind of transport.
    pub(crate) fn at(&self, kind: &str) -> SocketAddr {
        let mut locations = self.locations.iter();
        let found = locations.find_map(|it| it.strip_prefix(kind)?.strip_prefix("://"));
        // An address of HTTP has a path.
        let address = found.unwrap().trim_end_matches("/acc");
        // That of a legacy peer has a signature.
        let address = address.split(';').next().unwrap();
        address.parse().unwrap()
    }

    pub(crate) fn usage(&self) -> Usage {
        usage(self.child.id())
    }

    /// Ends the gateway with SIGTERM and checks that it exits successfully.
    pub(crate) fn end(mut self) {
        let log_lines = self.log_lines.lock().join("\n");
        assert!(!log_lines.contains("panicked"), "{log_lines}");
        let ended = self.child.ended();
        assert!(
            ended.is_none(),
            "the gateway has already ended ({ended:?}): {log_lines}"
        );
        let pid = self.child.id();
        self.child.signal("-TERM");
        until("the gateway ends", || {
            fs::read_to_string(format!("/proc/{pid}/stat")).map_or(true, |stat| {
                stat.rsplit_once(") ")
                    .is_none_or(|(_, state)| state.starts_with('Z'))
            })
        });
        let status = self.child.wait();
        assert!(
            status.success(),
            "{status}: {}",
            self.log_lines.lock().join("\n")
        );
    }
}

/// Two connected gateways, and an agent on the host of each.
pub(crate) struct Pair {
    /// The gateway that a test may attack.
    pub(crate) gateway: Gateway,
    other: Gateway,
    pub(crate) rover: Party,
    arm: Party,
}

impl Pair {
    /// Starts the pair, with keys in directories below `place`, or without keys. `what` makes the
    /// names of its domains unique.
    pub(crate) fn new(place: &Path, secured: bool, what: &str) -> Self {
        let mark = if secured { "keys" } else { "clear" };
        let mark = format!("{what}-{}-{mark}", std::process::id());
        if secured {
            let [one, other] = ["target", "other"].map(|name| keys(place.join(name), name));
            befriend(&one, &other);
        }
        let fipa = || {
            let mut command = Command::new(env!("CARGO_BIN_EXE_fipa"));
            command.current_dir(place).env("HOME", place);
            command
        };
        let settings = |name: &str| {
            let mut settings = vec![
                format!("domain={mark}-{name}"),
                format!("mts.name={name}"),
                "discovery.mdns=false".to_owned(),
                // Two hosts on one machine.
                "security.loopback=true".to_owned(),
                // Long enough for a busy machine.
                "mts.deadline=60s".to_owned(),
                "transport.http.listen=127.0.0.1:0".to_owned(),
            ];
            match secured {
                true => settings.extend([
                    format!("security.keys={}", place.join(name).display()),
                    "mts.transports=shm,quic,tcp,http".to_owned(),
                ]),
                false => settings.extend([
                    "mts.transports=shm,udp,tcp,http,udt".to_owned(),
                    "transport.udt.listen=127.0.0.1:0".to_owned(),
                ]),
            }
            settings
        };
        let gateway = Gateway::start(fipa(), settings("target"));
        let mut knowing = settings("other");
        knowing.push(gateway.known_as("target"));
        let other = Gateway::start(fipa(), knowing);
        let arm = Party::new(&gateway.settings, "arm");
        let rover = Party::new(&other.settings, "rover");
        rover.knows("arm");
        arm.answer();
        Self {
            gateway,
            other,
            rover,
            arm,
        }
    }

    /// Returns the registrations of both agents and both gateways, by name.
    pub(crate) fn registrations(&self) -> Vec<(String, Incarnation)> {
        self.arm.knows("rover");
        let entries = self.arm.agent.domain().directory().entries();
        let mut known: Vec<_> = entries
            .iter()
            .map(|entry| (entry.name.to_string(), entry.incarnation))
            .collect();
        let far = self.other_gateway();
        known.push(("other".to_owned(), far));
        known
    }

    fn other_gateway(&self) -> Incarnation {
        let directory = self.rover.agent.domain().directory();
        let entries = directory.entries();
        let gateway = entries.iter().find(|entry| &*entry.name == "other");
        gateway.unwrap().incarnation
    }

    /// Returns the number of foreign letters that the agent of the first host has received.
    pub(crate) fn strange(&self) -> u64 {
        self.arm.strange.load(Ordering::Relaxed)
    }

    /// Ends both agents and both gateways in order.
    pub(crate) fn end(self) {
        self.rover.end();
        self.arm.end();
        self.other.end();
        self.gateway.end();
    }
}

/// An honest agent on the host of a gateway.
pub(crate) struct Party {
    runtime: Runtime,
    agent: Arc<Agent>,
    /// Number of letters from other senders than the pair, counted by [`answer`](Self::answer).
    strange: Arc<AtomicU64>,
}

impl Party {
    /// Registers an agent on the host of the gateway with these settings.
    pub(crate) fn new(settings: &[String], name: &str) -> Self {
        let sources = Sources {
            set: settings.to_vec(),
            ..Sources::default()
        };
        let config = Config::load(&sources).unwrap();
        let mut builder = tokio::runtime::Builder::new_multi_thread();
        let runtime = builder.worker_threads(1).enable_all().build().unwrap();
        let domain = runtime.block_on(Domain::open(&config)).unwrap();
        let agent = runtime
            .block_on(async { domain.register(name).await })
            .unwrap();
        Self {
            runtime,
            agent: Arc::new(agent),
            strange: Arc::default(),
        }
    }

    /// Answers every honest letter with its own content. A repeated letter panics.
    pub(crate) fn answer(&self) {
        let (agent, strange) = (Arc::clone(&self.agent), Arc::clone(&self.strange));
        self.runtime.spawn(async move {
            let mut taken = HashSet::new();
            loop {
                let content = match agent.receive().await {
                    Ok(incoming) => honest(incoming.message()).map(|it| (it, incoming)),
                    Err(_) => return,
                };
                let Some((content, incoming)) = content else {
                    strange.fetch_add(1, Ordering::Relaxed);
                    continue;
                };
                assert!(taken.insert(content.clone()), "received twice: {content}");
                let answer = agent.reply(incoming.message(), Performative::Inform);
                // The other agent checks that the answer arrives.
                drop(agent.send(answer.content(content).build().unwrap()));
            }
        });
    }

    /// Sends letters to an answering agent, one after the other, until [`Talk::end`].
    pub(crate) fn talk(&self, to: &str) -> Talk {
        let (agent, to) = (Arc::clone(&self.agent), AgentId::new(to).unwrap());
        let stop = Arc::new(AtomicBool::new(false));
        let said = Arc::new(AtomicU64::new(0));
        let (ended, count) = (Arc::clone(&stop), Arc::clone(&said));
        let runtime = self.runtime.handle().clone();
        let took: Arc<Mutex<Vec<Duration>>> = Arc::default();
        let noted = Arc::clone(&took);
        let thread = std::thread::spawn(move || {
            while !ended.load(Ordering::Acquire) {
                let took = runtime.block_on(round(&agent, &to));
                noted.lock().push(took);
                count.fetch_add(1, Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(2));
            }
        });
        Talk {
            stop,
            said,
            took,
            thread,
        }
    }

    /// Waits until the directory has an agent of the other host.
    pub(crate) fn knows(&self, name: &str) {
        until("the directory has the agent of the other host", || {
            self.agent.domain().directory().lookup(name).is_some()
        });
    }

    pub(crate) fn end(self) {
        // The answering task holds a reference to the agent.
        self.runtime.shutdown_timeout(Duration::from_secs(5));
    }
}

/// A running exchange of letters of the honest pair.
pub(crate) struct Talk {
    stop: Arc<AtomicBool>,
    said: Arc<AtomicU64>,
    took: Arc<Mutex<Vec<Duration>>>,
    thread: JoinHandle<()>,
}

impl Talk {
    /// Waits until this number of further letters has been answered.
    pub(crate) fn goes_on(&self, letters: u64) {
        let before = self.said.load(Ordering::Relaxed);
        until("the honest pair exchanges more letters", || {
            self.said.load(Ordering::Relaxed) >= before + letters || self.thread.is_finished()
        });
    }

    /// Returns the round-trip times since the previous call.
    pub(crate) fn take(&self) -> Vec<Duration> {
        std::mem::take(&mut self.took.lock())
    }

    /// Ends the exchange. A panic of its thread continues here.
    pub(crate) fn end(self) {
        self.stop.store(true, Ordering::Release);
        if let Err(panic) = self.thread.join() {
            std::panic::resume_unwind(panic);
        }
    }
}

fn honest(message: &fipa::Message) -> Option<String> {
    let content = std::str::from_utf8(message.content()?).ok()?;
    let is_honest = *message.performative() == Performative::Inform && content.starts_with(HONEST);
    is_honest.then(|| content.to_owned())
}

/// Sends one letter and waits for its answer. The letter must have one outcome and be delivered.
async fn round(agent: &Agent, to: &AgentId) -> Duration {
    let content = format!("{HONEST}{}", agent.unique_id());
    let message = agent.message(Performative::Inform).receiver(to.clone());
    let begun = Instant::now();
    let sent = agent.send(message.content(content.clone()).build().unwrap());
    let answered = async {
        loop {
            let incoming = agent.receive().await.unwrap();
            if honest(incoming.message()).as_deref() == Some(&content) {
                return begun.elapsed();
            }
        }
    };
    let both = async { tokio::join!(sent, answered) };
    let (sent, took) = tokio::time::timeout(WATCHDOG, both).await.unwrap();
    let deliveries = sent.unwrap();
    let [delivery] = &deliveries.0[..] else {
        panic!("expected one outcome: {deliveries}");
    };
    let arrived = matches!(delivery.outcome, Outcome::Delivered { .. });
    assert!(arrived, "{deliveries}");
    took
}

/// Returns the median and the 99th percentile.
pub(crate) fn percentiles(mut took: Vec<Duration>) -> (Duration, Duration) {
    took.sort_unstable();
    (took[took.len() / 2], took[took.len() * 99 / 100])
}
