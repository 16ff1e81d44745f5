//! The steps of the demo, in order. Each step acts, collects the events of the processes and checks
//! them.

use std::io::Write as _;
use std::time::{Duration, Instant};

use anstyle::{AnsiColor, Style};
use fipa_acl::escape;
use serde_json::{Map, Value, json};
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

use super::process::{Event, Listed, Order, Received, shown};
use super::processes::{Process, Processes};
use crate::membership::Stop;
use crate::output;
use crate::report::Failure;

/// A letter for the agent `echo`, as the C++ library fipa_services sends it over TCP.
const LEGACY_LETTER: &[u8] = include_bytes!("../../../data/tcp_letter.bin");
const LARGE: usize = 4 << 20;
/// Maximum time for one host to learn of the agents of the other.
const DISCOVERY_TIMEOUT: Duration = Duration::from_secs(30);

/// The result of the demo.
pub(super) struct Report {
    pub(super) steps: Vec<Value>,
    pub(super) measured: Value,
    /// The first step that failed.
    pub(super) broken: Option<String>,
}

/// Runs the demo. If `verbose`, prints each step on standard output.
pub(super) async fn run(verbose: bool) -> Result<Report, Failure> {
    let mut stop = Stop::listen()?;
    let processes = Processes::new().map_err(|error| {
        Failure::failed(
            error,
            "fipa demo",
            "check the permissions of the fipa executable",
        )
    })?;
    let mut demo = Demo {
        processes,
        verbose,
        color: output::has_color(),
        step: "",
        steps: Vec::new(),
        broken: None,
    };
    let interrupted = tokio::select! {
        () = demo.all() => false,
        () = stop.requested() => true,
    };
    let remaining = demo.processes.clear().await;
    if interrupted {
        return Err(Failure::failed(
            "interrupted; all processes of the demo have ended and no files are left",
            "fipa demo",
            "run the demo again",
        ));
    }
    demo.last_step(&remaining);
    let measured = demo.measured();
    Ok(Report {
        steps: demo.steps,
        measured,
        broken: demo.broken,
    })
}

struct Demo {
    processes: Processes,
    verbose: bool,
    color: bool,
    /// The name of the current step.
    step: &'static str,
    steps: Vec<Value>,
    broken: Option<String>,
}

/// The JSON fields of a step, or its error.
type Found = Result<Map<String, Value>, String>;

macro_rules! found {
    ($($key:literal : $value:expr),* $(,)?) => {{
        let mut found = Map::new();
        $(found.insert($key.to_owned(), json!($value));)*
        Ok(found)
    }};
}

macro_rules! ensure {
    ($condition:expr, $($why:tt)*) => {
        if !$condition {
            return Err(format!($($why)*));
        }
    };
}

impl Demo {
    async fn all(&mut self) {
        self.say(
            "Two domains on this machine stand for two robots; each domain has its own gateway.",
        );
        self.begin("agents register and are listed");
        let found = self.listed().await;
        if !self.end(found) {
            // The other steps need these agents.
            return;
        }
        self.begin("a conversation on one host");
        let found = self.request("arm_1", "shm").await;
        self.end(found);
        self.begin("the same conversation between two hosts");
        let found = self.request("crex_camera", "tcp").await;
        self.end(found);
        self.begin("large content without a copy");
        let found = self.large().await;
        self.end(found);
        self.begin("a multicast to arm_.*");
        let found = self.multicast().await;
        self.end(found);
        self.begin("an agent is killed");
        let found = self.killed().await;
        self.end(found);
        self.begin("fallback from shared memory to a Unix domain socket");
        let found = self.broken_memory().await;
        self.end(found);
        self.begin("a letter from a legacy peer");
        let found = self.legacy_peer().await;
        self.end(found);
        self.begin("a protocol violation is detected");
        let found = self.broken_protocol().await;
        self.end(found);
        self.begin("the lock of a killed agent, and its late command");
        let found = self.locks().await;
        self.end(found);
        self.begin("measurement");
        let found = self.measurement().await;
        self.end(found);
    }

    fn say(&self, text: &str) {
        self.print(&output::printable(text));
    }

    /// Prints a text that is escaped, and may have colors.
    fn print(&self, text: &str) {
        if self.verbose {
            // A closed standard output does not change the steps.
            let mut out = std::io::stdout().lock();
            let _ = writeln!(out, "{text}").and_then(|()| out.flush());
        }
    }

    /// Prints the heading of the next step.
    fn begin(&mut self, name: &'static str) {
        let heading = format!("{}. {name}", self.steps.len() + 1);
        self.print(&self.painted(Style::new().bold(), &heading));
        self.step = name;
    }

    /// Records and prints the result of the step that began last. Returns whether the step passed.
    fn end(&mut self, found: Found) -> bool {
        let (ok, mut object) = match found {
            Ok(found) => (true, found),
            Err(error) => (false, Map::from_iter([("error".to_owned(), json!(error))])),
        };
        match object.get("error").and_then(Value::as_str) {
            None => {
                let ok = self.painted(AnsiColor::Green.on_default(), "[ok]");
                self.print(&format!("  {ok}\n"));
            }
            Some(error) => {
                let failed = self.painted(AnsiColor::Red.on_default().bold(), "[FAILED]");
                self.print(&format!("  {failed} {}\n", escape(error)));
            }
        }
        let name = self.step;
        object.insert("name".to_owned(), json!(name));
        object.insert("ok".to_owned(), json!(ok));
        self.steps.push(Value::Object(object));
        if !ok && self.broken.is_none() {
            self.broken = Some(name.to_owned());
        }
        ok
    }

    fn painted(&self, style: Style, text: &str) -> String {
        match self.color {
            true => format!("{style}{text}{style:#}"),
            false => text.to_owned(),
        }
    }

    async fn listed(&mut self) -> Found {
        self.processes
            .start("rover", "rover-mts", "gateway")
            .await?;
        let locations = &self.processes.get("rover-mts")?.locations;
        let tcp = locations.iter().find(|url| url.starts_with("tcp://"));
        let tcp = tcp.ok_or("the gateway of rover has no TCP port")?;
        let peer = format!("discovery.static={{ rover-mts = [\"{tcp}\"] }}");
        self.processes
            .start_with("crex", "crex-mts", "gateway", &peer)
            .await?;
        for agent in ["rover", "arm_1", "arm_2", "arm_3", "arm_4", "echo"] {
            self.processes.start("rover", agent, "agent").await?;
            let process = self.processes.get(agent)?;
            let (pid, locations) = (process.pid(), process.locations.join("  "));
            self.say(&format!("  {agent:<12} process {pid:<7} {locations}"));
        }
        self.processes.start("crex", "crex_camera", "agent").await?;
        self.say(
            "  crex_camera  on the other host; its gateway connects with that of rover, its static peer ...",
        );
        let started = Instant::now();
        let agents = loop {
            let agents = self.agents_seen_by("rover").await?;
            if agents.iter().any(|agent| agent.name == "crex_camera") {
                break agents;
            }
            ensure!(
                started.elapsed() < DISCOVERY_TIMEOUT,
                "crex_camera was not known within {DISCOVERY_TIMEOUT:?}"
            );
            tokio::time::sleep(Duration::from_millis(50)).await;
        };
        let took = started.elapsed().as_millis();
        self.say(&format!("  known after {took} ms"));
        for agent in ["rover", "arm_1", "arm_2", "arm_3", "arm_4", "echo"] {
            let entry = agents.iter().find(|entry| entry.name == agent);
            let entry = entry.ok_or_else(|| format!("{agent} is not listed"))?;
            let has = |kind: &str| entry.locations.iter().any(|url| url.starts_with(kind));
            ensure!(
                entry.local && has("shm://") && has("unix://") && !has("tcp://"),
                "{agent}: {entry}",
                entry = shown(&entry)
            );
        }
        let remote = agents.iter().find(|agent| agent.name == "crex_camera");
        ensure!(
            remote.is_some_and(|agent| !agent.local),
            "crex_camera is listed as local"
        );
        found!("agents": agents, "found_after_ms": took)
    }

    async fn agents_seen_by(&mut self, name: &str) -> Result<Vec<Listed>, String> {
        match self.processes.get(name)?.run(&Order::Agents).await? {
            Event::Agents { agents } => Ok(agents),
            other => Err(format!(
                "{name}: expected a list of agents, not {other}",
                other = shown(&other)
            )),
        }
    }

    async fn send(&mut self, from: &str, order: Order) -> Result<Vec<Value>, String> {
        match self.processes.get(from)?.run(&order).await? {
            Event::Outcomes {
                deliveries: Value::Array(deliveries),
            } => Ok(deliveries),
            other => Err(format!(
                "{from}: expected outcomes, not {other}",
                other = shown(&other)
            )),
        }
    }

    async fn received_by(&mut self, name: &str) -> Result<Received, String> {
        self.processes.get(name)?.received().await
    }

    /// A conversation of request, agree and inform; each receiver reports its message.
    async fn request(&mut self, to: &str, via: &str) -> Found {
        let order = Order::Send {
            performative: "request".into(),
            to: to.into(),
            content: "(lift sample-3)".into(),
            protocol: Some("fipa-request".into()),
        };
        let deliveries = self.send("rover", order).await?;
        let went = one_delivery(&deliveries)?;
        ensure!(went["via"] == via, "outcome of the request: {went}");
        let seen = self.received_by(to).await?;
        self.say(&format!(
            "  {to} received {} from {}",
            seen.performative, seen.sender
        ));
        ensure!(
            seen.performative == "request"
                && seen.sender == "rover"
                && seen.content.as_deref() == Some("(lift sample-3)"),
            "{to} received {seen}",
            seen = shown(&seen)
        );
        for (performative, content) in [("agree", "agreed"), ("inform", "done")] {
            let seen = self.received_by("rover").await?;
            self.say(&format!(
                "  rover received {} from {}",
                seen.performative, seen.sender
            ));
            ensure!(
                seen.performative == performative
                    && seen.sender == to
                    && seen.content.as_deref() == Some(content)
                    && seen.in_reply_to.as_deref() == Some("question-1")
                    && seen.conversation_id == Some(format!("rover-to-{to}"))
                    && seen.protocol.as_deref() == Some("fipa-request"),
                "rover received {seen}",
                seen = shown(&seen)
            );
        }
        found!("via": via, "attempts": went["attempts"])
    }

    async fn large(&mut self) -> Found {
        let mut routes = Vec::new();
        for (to, via, in_place) in [("arm_1", "shm", true), ("crex_camera", "tcp", false)] {
            let order = Order::SendLarge {
                to: to.into(),
                len: LARGE,
            };
            let deliveries = self.send("rover", order).await?;
            let went = one_delivery(&deliveries)?;
            ensure!(
                went["via"] == via,
                "outcome of the content for {to}: {went}"
            );
            let seen = self.received_by(to).await?;
            ensure!(seen.len == LARGE, "{to} received {} bytes", seen.len);
            ensure!(seen.intact == Some(true), "{to}: wrong checksum");
            ensure!(
                !in_place || seen.in_place,
                "the content is in the private memory of {to}: it was copied"
            );
            let place = if in_place {
                ", in shared memory without a copy"
            } else {
                ""
            };
            self.say(&format!(
                "  {to} received 4 MiB via {via}{place}; the checksum is correct"
            ));
            routes.push(json!({ "receiver": to, "via": via, "in_place": seen.in_place }));
        }
        found!("via": "shm", "bytes": LARGE, "ways": routes)
    }

    async fn multicast(&mut self) -> Found {
        let order = Order::Send {
            performative: "inform".into(),
            to: "arm_.*".into(),
            content: "stop".into(),
            protocol: None,
        };
        let deliveries = self.send("arm_4", order).await?;
        let mut reached: Vec<&str> = deliveries
            .iter()
            .filter_map(|delivery| delivery["receiver"].as_str())
            .collect();
        reached.sort_unstable();
        ensure!(
            reached == ["arm_1", "arm_2", "arm_3"],
            "delivered to {reached}",
            reached = shown(&reached)
        );
        for arm in ["arm_1", "arm_2", "arm_3"] {
            let seen = self.received_by(arm).await?;
            ensure!(
                seen.sender == "arm_4" && seen.content.as_deref() == Some("stop"),
                "{arm} received {seen}",
                seen = shown(&seen)
            );
            self.say(&format!(
                "  {arm} received {} from arm_4",
                seen.performative
            ));
        }
        // A copy for arm_4 would have arrived by now: the others have their copies.
        match self.processes.get("arm_4")?.run(&Order::Count).await? {
            Event::Count { received: 0 } => {}
            other => {
                return Err(format!(
                    "arm_4 received its own message: {other}",
                    other = shown(&other)
                ));
            }
        }
        found!("via": "shm", "receivers": reached)
    }

    async fn killed(&mut self) -> Found {
        let pid = self.processes.get("arm_2")?.pid();
        self.processes.kill("arm_2").await?;
        self.say(&format!("  arm_2 (process {pid}) was killed with SIGKILL"));
        let order = Order::Send {
            performative: "inform".into(),
            to: "arm_2".into(),
            content: "are you there?".into(),
            protocol: None,
        };
        let deliveries = self.send("rover", order).await?;
        let [went] = deliveries.as_slice() else {
            return Err(format!("expected one outcome, not {}", deliveries.len()));
        };
        ensure!(
            went["outcome"] == "failed",
            "outcome of the letter to arm_2: {went}"
        );
        let reason = went["reason"].as_str().unwrap_or_default().to_owned();
        let seen = self.received_by("rover").await?;
        let failure = seen.content.clone().unwrap_or_default();
        ensure!(
            seen.performative == "failure" && failure.contains(&reason) && !reason.is_empty(),
            "rover received {seen}, the outcome was {went}",
            seen = shown(&seen)
        );
        self.say(&format!(
            "  rover received a FIPA failure message: {failure}"
        ));
        found!("reason": reason, "failure": failure, "attempts": went["attempts"])
    }

    async fn broken_memory(&mut self) -> Found {
        // Removes the new process's files in /dev/shm before any process is connected to it.
        let before = self.processes.shared_memory();
        self.processes.start("rover", "arm_5", "agent").await?;
        let mut mine = self.processes.shared_memory();
        mine.retain(|file| !before.contains(file));
        for file in &mine {
            std::fs::remove_file(file).map_err(|error| format!("{}: {error}", file.display()))?;
        }
        self.say(&format!(
            "  removed the {} shared memory files of arm_5",
            mine.len()
        ));
        let order = Order::Send {
            performative: "inform".into(),
            to: "arm_5".into(),
            content: "by another route".into(),
            protocol: None,
        };
        let deliveries = self.send("rover", order).await?;
        let went = one_delivery(&deliveries)?;
        ensure!(went["via"] == "unix", "outcome of the letter: {went}");
        ensure!(
            went["attempts"][0]["via"] == "shm",
            "shared memory was not tried: {went}"
        );
        let seen = self.received_by("arm_5").await?;
        ensure!(
            seen.via.as_deref() == Some("unix")
                && seen.content.as_deref() == Some("by another route"),
            "arm_5 received {seen}",
            seen = shown(&seen)
        );
        let why = went["attempts"][0]["error"].as_str().unwrap_or_default();
        self.say(&format!(
            "  shm failed ({why}); arm_5 received the letter via unix"
        ));
        // It would warn later that its files were removed.
        self.processes.end("arm_5").await?;
        found!("via": "unix", "attempts": went["attempts"])
    }

    async fn legacy_peer(&mut self) -> Found {
        let gateway: &Process = self.processes.get("rover-mts")?;
        let url = gateway
            .locations
            .iter()
            .find_map(|url| url.strip_prefix("tcp://"));
        let address = url
            .and_then(|rest| rest.split('#').next())
            .ok_or("no TCP port")?
            .to_owned();
        let mut stream = TcpStream::connect(&address)
            .await
            .map_err(|error| error.to_string())?;
        let written = async {
            stream.write_all(LEGACY_LETTER).await?;
            stream.shutdown().await
        };
        written
            .await
            .map_err(|error| format!("{address}: {error}"))?;
        self.say(&format!(
            "  sent {} recorded bytes of fipa_services to {address}",
            LEGACY_LETTER.len()
        ));
        let seen = self.received_by("echo").await?;
        ensure!(
            seen.performative == "request"
                && seen.sender == "cpp-sender"
                && seen.content.as_deref() == Some("hello"),
            "echo received {seen}",
            seen = shown(&seen)
        );
        self.say("  echo received request from cpp-sender: hello");
        found!("via": "tcp", "sender": seen.sender, "content": seen.content)
    }

    /// A call for proposals. One arm proposes; the other reports a result although it was not awarded
    /// the task. The agents do not cooperate with the watcher.
    async fn locks(&mut self) -> Found {
        let resource = "bay".to_owned();
        for agent in ["crane", "lifter_1", "lifter_2"] {
            self.processes.start("rover", agent, "agent").await?;
        }
        let own = Order::Own {
            resource: resource.clone(),
        };
        match self.processes.get("crane")?.run(&own).await? {
            Event::Owned => self.say("  crane owns the bay"),
            other => {
                return Err(format!(
                    "crane does not own the bay: {other}",
                    other = shown(&other)
                ));
            }
        }
        let lock = Order::Lock { resource };
        let locked = self.processes.get("lifter_1")?.run(&lock).await?;
        let stale = fence(locked)?;
        self.say(&format!("  lifter_1 holds the bay with the fence {stale}"));
        let answer = self.command("lifter_1", &stale).await?;
        ensure!(
            answer.performative == "agree",
            "answer to the holder: {answer}",
            answer = shown(&answer)
        );
        self.processes.get("lifter_2")?.begin(&lock).await?;
        let pid = self.processes.get("lifter_1")?.pid();
        self.processes.kill("lifter_1").await?;
        self.say(&format!(
            "  lifter_1 (process {pid}) was killed with SIGKILL"
        ));
        let locked = self.processes.get("lifter_2")?.result().await?;
        let live = fence(locked)?;
        self.say(&format!("  lifter_2 holds the bay with the fence {live}"));
        // The command of the killed agent, as a slow network would deliver it.
        let answer = self.command("arm_4", &stale).await?;
        ensure!(
            answer.performative == "refuse",
            "answer to the late command: {answer}",
            answer = shown(&answer)
        );
        let reason = answer.content.unwrap_or_default();
        self.say(&format!("  crane refused its late command: {reason}"));
        let answer = self.command("lifter_2", &live).await?;
        ensure!(
            answer.performative == "agree",
            "answer to the holder: {answer}",
            answer = shown(&answer)
        );
        self.say(&format!("  crane admitted the command with {live}"));
        found!("stale": stale, "live": live, "refused": reason)
    }

    /// Sends a command with a fence to the owner of the bay, and returns the answer.
    async fn command(&mut self, from: &str, fence: &str) -> Result<Received, String> {
        let order = Order::Command {
            to: "lock:bay".into(),
            fence: fence.into(),
        };
        let deliveries = self.send(from, order).await?;
        one_delivery(&deliveries)?;
        self.received_by(from).await
    }

    async fn broken_protocol(&mut self) -> Found {
        self.processes.start("rover", "watcher", "watcher").await?;
        for (from, performative, to) in [
            ("rover", "cfp", "arm_1"),
            ("rover", "cfp", "arm_3"),
            ("arm_1", "propose", "rover"),
            ("arm_3", "inform", "rover"),
        ] {
            let order = Order::Converse {
                performative: performative.into(),
                to: to.into(),
                conversation: "auction-1".into(),
            };
            one_delivery(&self.send(from, order).await?)?;
            let seen = self.received_by(to).await?;
            ensure!(
                seen.performative == performative,
                "{to} received {seen}",
                seen = shown(&seen)
            );
            self.say(&format!("  {from} sends {performative} to {to}"));
        }
        let (sender, performative, text, accepted) =
            match self.processes.get("watcher")?.violation().await? {
                Event::Violation {
                    sender,
                    performative,
                    text,
                    accepted,
                } => (sender, performative, text, accepted),
                other => {
                    return Err(format!(
                        "expected a violation, not {other}",
                        other = shown(&other)
                    ));
                }
            };
        ensure!(
            sender == "arm_3"
                && performative == "inform"
                && ["expected", "propose", "from arm_3"]
                    .iter()
                    .all(|part| text.contains(part)),
            "the watcher reported: {text}"
        );
        ensure!(
            accepted == 3,
            "{accepted} letters followed the protocol, not 3"
        );
        self.say(&format!("  the watcher reports: {text}"));
        let caught_itself = self.enforced_by_agent().await?;
        found!(
            "sender": sender, "performative": performative, "violation": text, "kept": accepted,
            "caught_itself": caught_itself
        )
    }

    /// A violation by an agent with `monitor.check=enforce`: the violating message is not sent, and a
    /// correct message is still accepted afterwards.
    async fn enforced_by_agent(&mut self) -> Result<String, String> {
        let set = "monitor.check=enforce";
        self.processes
            .start_with("rover", "arm_6", "agent", set)
            .await?;
        let converse = |performative: &str, to: &str| Order::Converse {
            performative: performative.into(),
            to: to.into(),
            conversation: "auction-2".into(),
        };
        one_delivery(&self.send("rover", converse("cfp", "arm_6")).await?)?;
        self.received_by("arm_6").await?;
        self.say("  rover sends cfp to arm_6, which has monitor.check=enforce");
        let violating = converse("inform", "rover");
        let error = match self.processes.get("arm_6")?.run(&violating).await {
            Err(error) => error,
            Ok(other) => {
                return Err(format!(
                    "the message of arm_6 was sent: {other}",
                    other = shown(&other)
                ));
            }
        };
        ensure!(
            error.contains("not sent: inform from arm_6") && error.contains("expected"),
            "the error of arm_6: {error}"
        );
        self.say(&format!("  {error}"));
        one_delivery(&self.send("arm_6", converse("propose", "rover")).await?)?;
        // This is the next message from arm_6: the inform was not sent.
        let seen = self.received_by("rover").await?;
        ensure!(
            seen.performative == "propose" && seen.sender == "arm_6",
            "rover received {seen}",
            seen = shown(&seen)
        );
        self.say("  arm_6 sends propose to rover instead");
        Ok(error)
    }

    async fn measurement(&mut self) -> Found {
        let mut rows = Vec::new();
        for (to, via) in [("arm_1", "shm"), ("crex_camera", "shm, tcp, shm")] {
            let order = Order::Measure {
                to: to.into(),
                len: 1024,
                rounds: 500,
            };
            match self.processes.get("rover")?.run(&order).await? {
                Event::Measured { p50_us, p99_us } => {
                    self.say(&format!(
                        "  1 KiB to {to} via {via}, from send to confirmation: \
                         p50 {p50_us:.0} us, p99 {p99_us:.0} us"
                    ));
                    rows.push(json!({
                        "receiver": to, "via": via, "bytes": 1024, "letters": 500,
                        "confirmed_us": { "p50": p50_us, "p99": p99_us },
                    }));
                }
                other => return Err(format!("expected a measurement, not {other:?}")),
            }
        }
        found!("rows": rows)
    }

    fn measured(&self) -> Value {
        let step = self.steps.iter().find(|step| step["name"] == "measurement");
        step.map_or(Value::Null, |step| step["rows"].clone())
    }

    /// Checks that no files are left.
    fn last_step(&mut self, remaining: &[std::path::PathBuf]) {
        let found = match remaining {
            [] => found!("left": 0),
            [first, ..] => Err(format!(
                "{} files were left, the first is {}",
                remaining.len(),
                first.display()
            )),
        };
        self.begin("no files are left behind");
        self.end(found);
    }
}

/// Returns the fence of a lock.
fn fence(event: Event) -> Result<String, String> {
    match event {
        Event::Locked { fence } => Ok(fence),
        other => Err(format!(
            "expected a lock, not {other}",
            other = shown(&other)
        )),
    }
}

/// Returns the only delivery. Several deliveries, or a failed one, are an error.
fn one_delivery(deliveries: &[Value]) -> Result<&Value, String> {
    match deliveries {
        [only] if only["outcome"] == "delivered" => Ok(only),
        [only] => Err(format!("not delivered: {only}")),
        several => Err(format!("expected one outcome, not {}", several.len())),
    }
}
