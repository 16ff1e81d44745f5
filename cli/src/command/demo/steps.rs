//! The steps of the demo, in order: what is done, what the parts say they saw, and whether that is
//! what was promised.

use std::io::Write as _;
use std::time::{Duration, Instant};

use serde_json::{Map, Value, json};
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;

use super::part::{Event, Listed, Order, Received};
use super::stage::{Part, Stage};
use crate::report::Failure;

/// A letter as the C++ library fipa_services puts it on a TCP connection, for the agent `echo`.
const OLD_PEERS_LETTER: &[u8] = include_bytes!("../../../data/tcp_letter.bin");
const LARGE: usize = 4 << 20;
/// How long the hosts may take to find each other.
const FINDING: Duration = Duration::from_secs(30);

/// What the demo has to say in the end.
pub(super) struct Report {
    pub(super) steps: Vec<Value>,
    pub(super) measured: Value,
    /// The first step that did not do what it says.
    pub(super) broken: Option<String>,
}

/// Plays the demo. `aloud`: tells the story on standard output while it happens.
pub(super) async fn play(aloud: bool) -> Result<Report, Failure> {
    let stage = Stage::new()
        .map_err(|error| Failure::failed(error, "fipa demo", "see whether fipa can be run"))?;
    let mut play = Play {
        stage,
        aloud,
        steps: Vec::new(),
        broken: None,
    };
    let interrupted = tokio::select! {
        () = play.all() => false,
        () = interrupt() => true,
    };
    let left = play.stage.clear().await;
    if interrupted {
        return Err(Failure::failed(
            "interrupted; all processes of the demo have ended and nothing is left behind",
            "fipa demo",
            "run it again to see the rest",
        ));
    }
    play.last_step(&left);
    let measured = play.measured();
    Ok(Report {
        steps: play.steps,
        measured,
        broken: play.broken,
    })
}

/// Ctrl-C, or being told to end.
async fn interrupt() {
    let terminated = async {
        use tokio::signal::unix::{SignalKind, signal};
        match signal(SignalKind::terminate()) {
            Ok(mut terminated) => drop(terminated.recv().await),
            Err(_) => std::future::pending().await,
        }
    };
    tokio::select! {
        _ = tokio::signal::ctrl_c() => {}
        () = terminated => {}
    }
}

struct Play {
    stage: Stage,
    aloud: bool,
    steps: Vec<Value>,
    broken: Option<String>,
}

/// What a step found out, for its JSON object.
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

impl Play {
    async fn all(&mut self) {
        self.say("Two robots on this machine: each a domain with a gateway of its own.");
        let found = self.listed().await;
        if !self.step("agents register and are listed", found) {
            // Nobody is there to go on with.
            return;
        }
        let found = self.request("arm_1", "shm").await;
        self.step("a conversation on one host", found);
        let found = self.request("crex_camera", "tcp").await;
        self.step("the same conversation between the hosts", found);
        let found = self.large().await;
        self.step("large content without a copy", found);
        let found = self.multicast().await;
        self.step("a multicast to arm_.*", found);
        let found = self.killed().await;
        self.step("an agent is killed", found);
        let found = self.broken_memory().await;
        self.step("shared memory breaks, a Unix socket takes over", found);
        let found = self.old_peer().await;
        self.step("a letter of an old peer", found);
        let found = self.broken_protocol().await;
        self.step("a protocol is broken, and it is seen", found);
        let found = self.measurement().await;
        self.step("measurement", found);
    }

    fn say(&self, text: &str) {
        if self.aloud {
            // Whether anybody reads the story does not change what happens in it.
            let mut out = std::io::stdout().lock();
            let _ = writeln!(out, "{text}").and_then(|()| out.flush());
        }
    }

    /// Notes how a step went, and says whether it did what it says.
    fn step(&mut self, name: &str, found: Found) -> bool {
        let (ok, mut object) = match found {
            Ok(found) => (true, found),
            Err(why) => (false, Map::from_iter([("error".to_owned(), json!(why))])),
        };
        let number = self.steps.len() + 1;
        self.say(&match object.get("error").and_then(Value::as_str) {
            None => format!("  [ok] {number}. {name}\n"),
            Some(why) => format!("  [BROKEN] {number}. {name}: {why}\n"),
        });
        object.insert("name".to_owned(), json!(name));
        object.insert("ok".to_owned(), json!(ok));
        self.steps.push(Value::Object(object));
        if !ok && self.broken.is_none() {
            self.broken = Some(name.to_owned());
        }
        ok
    }

    async fn listed(&mut self) -> Found {
        self.stage.start("rover", "rover-mts", "gateway").await?;
        self.stage.start("crex", "crex-mts", "gateway").await?;
        for agent in ["rover", "arm_1", "arm_2", "arm_3", "arm_4", "echo"] {
            self.stage.start("rover", agent, "agent").await?;
            let part = self.stage.part(agent)?;
            let (pid, locations) = (part.pid(), part.locations.join("  "));
            self.say(&format!("  {agent:<12} process {pid:<7} {locations}"));
        }
        self.stage.start("crex", "crex_camera", "agent").await?;
        self.say("  crex_camera  on the other host; the gateways look for each other by mDNS ...");
        let started = Instant::now();
        let agents = loop {
            let agents = self.agents_seen_by("rover").await?;
            if agents.iter().any(|agent| agent.name == "crex_camera") {
                break agents;
            }
            ensure!(
                started.elapsed() < FINDING,
                "crex_camera was not found in {FINDING:?}"
            );
            tokio::time::sleep(Duration::from_millis(50)).await;
        };
        let took = started.elapsed().as_millis();
        self.say(&format!("  found after {took} ms"));
        for agent in ["rover", "arm_1", "arm_2", "arm_3", "arm_4", "echo"] {
            let entry = agents.iter().find(|entry| entry.name == agent);
            let entry = entry.ok_or_else(|| format!("{agent} is not listed"))?;
            let has = |kind: &str| entry.locations.iter().any(|url| url.starts_with(kind));
            ensure!(
                entry.local && has("shm://") && has("unix://") && !has("tcp://"),
                "{agent}: {entry:?}"
            );
        }
        let remote = agents.iter().find(|agent| agent.name == "crex_camera");
        ensure!(
            remote.is_some_and(|agent| !agent.local),
            "crex_camera counts as local"
        );
        found!("agents": agents, "found_after_ms": took)
    }

    async fn agents_seen_by(&mut self, name: &str) -> Result<Vec<Listed>, String> {
        match self.stage.part(name)?.tell(&Order::Agents).await? {
            Event::Agents { agents } => Ok(agents),
            other => Err(format!(
                "{name}: a list of agents was expected, not {other:?}"
            )),
        }
    }

    async fn send(&mut self, from: &str, order: Order) -> Result<Vec<Value>, String> {
        match self.stage.part(from)?.tell(&order).await? {
            Event::Outcomes {
                deliveries: Value::Array(deliveries),
            } => Ok(deliveries),
            other => Err(format!("{from}: outcomes were expected, not {other:?}")),
        }
    }

    async fn received_by(&mut self, name: &str) -> Result<Received, String> {
        self.stage.part(name)?.received().await
    }

    /// request, agree, inform; each seen by its receiver.
    async fn request(&mut self, to: &str, via: &str) -> Found {
        let order = Order::Send {
            performative: "request".into(),
            to: to.into(),
            content: "(lift sample-3)".into(),
            protocol: Some("fipa-request".into()),
        };
        let deliveries = self.send("rover", order).await?;
        let went = one_delivery(&deliveries)?;
        ensure!(went["via"] == via, "the request went {went}");
        let seen = self.received_by(to).await?;
        self.say(&format!(
            "  {to} saw: {} from {}",
            seen.performative, seen.sender
        ));
        ensure!(
            seen.performative == "request"
                && seen.sender == "rover"
                && seen.content.as_deref() == Some("(lift sample-3)"),
            "{to} saw {seen:?}"
        );
        for (performative, content) in [("agree", "agreed"), ("inform", "done")] {
            let seen = self.received_by("rover").await?;
            self.say(&format!(
                "  rover saw: {} from {}",
                seen.performative, seen.sender
            ));
            ensure!(
                seen.performative == performative
                    && seen.sender == to
                    && seen.content.as_deref() == Some(content)
                    && seen.in_reply_to.as_deref() == Some("question-1")
                    && seen.conversation_id == Some(format!("rover-to-{to}"))
                    && seen.protocol.as_deref() == Some("fipa-request"),
                "rover saw {seen:?}"
            );
        }
        found!("via": via, "attempts": went["attempts"])
    }

    async fn large(&mut self) -> Found {
        let mut ways = Vec::new();
        for (to, via, in_place) in [("arm_1", "shm", true), ("crex_camera", "tcp", false)] {
            let order = Order::SendLarge {
                to: to.into(),
                len: LARGE,
            };
            let deliveries = self.send("rover", order).await?;
            let went = one_delivery(&deliveries)?;
            ensure!(went["via"] == via, "the content for {to} went {went}");
            let seen = self.received_by(to).await?;
            ensure!(seen.len == LARGE, "{to} got {} bytes", seen.len);
            ensure!(seen.intact == Some(true), "{to} found another checksum");
            ensure!(
                !in_place || seen.in_shared_memory,
                "the content lies in {to}'s own memory: it was copied"
            );
            let place = if in_place {
                ", still in shared memory"
            } else {
                ""
            };
            self.say(&format!(
                "  {to} got 4 MiB via {via}{place}; the checksum is right"
            ));
            ways.push(json!({ "receiver": to, "via": via, "in_place": seen.in_shared_memory }));
        }
        found!("via": "shm", "bytes": LARGE, "ways": ways)
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
            "it reached {reached:?}"
        );
        for arm in ["arm_1", "arm_2", "arm_3"] {
            let seen = self.received_by(arm).await?;
            ensure!(
                seen.sender == "arm_4" && seen.content.as_deref() == Some("stop"),
                "{arm} saw {seen:?}"
            );
            self.say(&format!("  {arm} saw: {} from arm_4", seen.performative));
        }
        // Its own copy would have come by now: the others have had theirs.
        match self.stage.part("arm_4")?.tell(&Order::Count).await? {
            Event::Count { received: 0 } => {}
            other => return Err(format!("arm_4 heard itself: {other:?}")),
        }
        found!("via": "shm", "receivers": reached)
    }

    async fn killed(&mut self) -> Found {
        let pid = self.stage.part("arm_2")?.pid();
        self.stage.kill("arm_2").await?;
        self.say(&format!("  arm_2 (process {pid}) got SIGKILL"));
        let order = Order::Send {
            performative: "inform".into(),
            to: "arm_2".into(),
            content: "are you there?".into(),
            protocol: None,
        };
        let deliveries = self.send("rover", order).await?;
        let [went] = deliveries.as_slice() else {
            return Err(format!("{} outcomes for one receiver", deliveries.len()));
        };
        ensure!(
            went["outcome"] == "failed",
            "the letter to the dead went {went}"
        );
        let reason = went["reason"].as_str().unwrap_or_default().to_owned();
        let seen = self.received_by("rover").await?;
        let told = seen.content.clone().unwrap_or_default();
        ensure!(
            seen.performative == "failure" && told.contains(&reason) && !reason.is_empty(),
            "rover saw {seen:?}, the outcome was {went}"
        );
        self.say(&format!("  rover got a FIPA failure: {told}"));
        found!("reason": reason, "failure": told, "attempts": went["attempts"])
    }

    async fn broken_memory(&mut self) -> Found {
        // What a careless hand does to /dev/shm; nobody has a connection to the newcomer yet.
        let before = self.stage.shared_memory();
        self.stage.start("rover", "arm_5", "agent").await?;
        let mut mine = self.stage.shared_memory();
        mine.retain(|file| !before.contains(file));
        for file in &mine {
            std::fs::remove_file(file).map_err(|error| format!("{}: {error}", file.display()))?;
        }
        self.say(&format!(
            "  arm_5's shared memory, {} files, was removed",
            mine.len()
        ));
        let order = Order::Send {
            performative: "inform".into(),
            to: "arm_5".into(),
            content: "by another way".into(),
            protocol: None,
        };
        let deliveries = self.send("rover", order).await?;
        let went = one_delivery(&deliveries)?;
        ensure!(went["via"] == "unix", "the letter went {went}");
        ensure!(
            went["attempts"][0]["via"] == "shm",
            "shared memory was not tried: {went}"
        );
        let seen = self.received_by("arm_5").await?;
        ensure!(
            seen.via.as_deref() == Some("unix")
                && seen.content.as_deref() == Some("by another way"),
            "arm_5 saw {seen:?}"
        );
        let why = went["attempts"][0]["error"].as_str().unwrap_or_default();
        self.say(&format!(
            "  shm failed ({why}); arm_5 saw the letter come by unix"
        ));
        found!("via": "unix", "attempts": went["attempts"])
    }

    async fn old_peer(&mut self) -> Found {
        let gateway: &Part = self.stage.part("rover-mts")?;
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
        let thrown = async {
            stream.write_all(OLD_PEERS_LETTER).await?;
            stream.shutdown().await
        };
        thrown
            .await
            .map_err(|error| format!("{address}: {error}"))?;
        self.say(&format!(
            "  {} recorded bytes thrown at {address}",
            OLD_PEERS_LETTER.len()
        ));
        let seen = self.received_by("echo").await?;
        ensure!(
            seen.performative == "request"
                && seen.sender == "cpp-sender"
                && seen.content.as_deref() == Some("hello"),
            "echo saw {seen:?}"
        );
        self.say("  echo saw: request from cpp-sender: hello");
        found!("via": "tcp", "sender": seen.sender, "content": seen.content)
    }

    /// A call for proposals. One arm proposes; the other says that it is done already, and
    /// nobody has awarded it anything. Nobody has asked the agents whether they are watched.
    async fn broken_protocol(&mut self) -> Found {
        self.stage.start("rover", "eye", "watcher").await?;
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
            ensure!(seen.performative == performative, "{to} saw {seen:?}");
            self.say(&format!("  {from} says {performative} to {to}"));
        }
        let (sender, performative, text, kept) = match self.stage.part("eye")?.caught().await? {
            Event::Caught {
                sender,
                performative,
                text,
                kept,
            } => (sender, performative, text, kept),
            other => return Err(format!("a violation was expected, not {other:?}")),
        };
        ensure!(
            sender == "arm_3"
                && performative == "inform"
                && ["expected", "propose", "from arm_3"]
                    .iter()
                    .all(|part| text.contains(part)),
            "seen was: {text}"
        );
        ensure!(kept == 3, "{kept} letters kept to the protocol, not 3");
        self.say(&format!("  who watches sees: {text}"));
        let caught_itself = self.stopped_by_itself().await?;
        found!(
            "sender": sender, "performative": performative, "violation": text, "kept": kept,
            "caught_itself": caught_itself
        )
    }

    /// The same again by an agent that checks itself: what would break the protocol does not leave,
    /// and it can still do what is right.
    async fn stopped_by_itself(&mut self) -> Result<String, String> {
        let set = "monitor.check=enforce";
        self.stage
            .start_with("rover", "arm_6", "agent", set)
            .await?;
        let converse = |performative: &str, to: &str| Order::Converse {
            performative: performative.into(),
            to: to.into(),
            conversation: "auction-2".into(),
        };
        one_delivery(&self.send("rover", converse("cfp", "arm_6")).await?)?;
        self.received_by("arm_6").await?;
        self.say("  rover says cfp to arm_6, which checks itself");
        let broken = converse("inform", "rover");
        let what = match self.stage.part("arm_6")?.tell(&broken).await {
            Err(what) => what,
            Ok(other) => return Err(format!("arm_6 was not stopped: {other:?}")),
        };
        ensure!(
            what.contains("not sent: inform from arm_6") && what.contains("expected"),
            "arm_6 was told: {what}"
        );
        self.say(&format!("  stopped by itself, {what}"));
        one_delivery(&self.send("arm_6", converse("propose", "rover")).await?)?;
        // The next thing that comes from it: the inform has not left.
        let seen = self.received_by("rover").await?;
        ensure!(
            seen.performative == "propose" && seen.sender == "arm_6",
            "rover saw {seen:?}"
        );
        self.say("  arm_6 says propose to rover instead");
        Ok(what)
    }

    async fn measurement(&mut self) -> Found {
        let mut rows = Vec::new();
        for (to, via) in [("arm_1", "shm"), ("crex_camera", "shm, tcp, shm")] {
            let order = Order::Measure {
                to: to.into(),
                len: 1024,
                rounds: 500,
            };
            match self.stage.part("rover")?.tell(&order).await? {
                Event::Measured { p50_us, p99_us } => {
                    self.say(&format!(
                        "  1 KiB to {to} via {via}, sent and confirmed: \
                         p50 {p50_us:.0} us, p99 {p99_us:.0} us"
                    ));
                    rows.push(json!({
                        "receiver": to, "via": via, "bytes": 1024, "letters": 500,
                        "confirmed_us": { "p50": p50_us, "p99": p99_us },
                    }));
                }
                other => return Err(format!("a measurement was expected, not {other:?}")),
            }
        }
        found!("rows": rows)
    }

    fn measured(&self) -> Value {
        let step = self.steps.iter().find(|step| step["name"] == "measurement");
        step.map_or(Value::Null, |step| step["rows"].clone())
    }

    /// Nothing may be left behind.
    fn last_step(&mut self, left: &[std::path::PathBuf]) {
        let found = match left {
            [] => found!("left": 0),
            [first, ..] => Err(format!(
                "{} files had to be removed, {} first",
                left.len(),
                first.display()
            )),
        };
        self.step("nothing is left behind", found);
    }
}

/// The only delivery, which succeeded.
fn one_delivery(deliveries: &[Value]) -> Result<&Value, String> {
    match deliveries {
        [only] if only["outcome"] == "delivered" => Ok(only),
        [only] => Err(format!("not delivered: {only}")),
        several => Err(format!("{} outcomes for one receiver", several.len())),
    }
}
