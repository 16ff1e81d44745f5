//! `fipa record fleet`: recordings of several hosts.
//!
//! Each host records on its own disk. Files travel only when they are fetched, in pieces.

mod clock;
mod fetch;
mod order;
mod recordings;
pub(in crate::command) mod service;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use bytes::Bytes;
use clap::{Args, Subcommand};
use clock::ClockAnswer;
pub(super) use clock::{CLOCK_AT_START, CLOCK_AT_STOP, Clock};
use fetch::Destination;
use fipa::protocol::DialogueError;
use fipa::{Agent, AgentId, Entry, Incarnation, Performative, Reach, RegisterOptions, Role};
use fipa_acl::escape;
use order::{Listing, Options, Order, ReadError, Recording, RecordingName};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use service::name_of_recorder;
use tokio::task::JoinSet;

use crate::membership;
use crate::options::{self, Global};
use crate::report::{self, Failure};
use crate::{complete, input, output};

/// Maximum wait for the answer to a question, which is then asked again.
const ANSWER_WITHIN: Duration = Duration::from_secs(5);
/// Number of times for which an order without further effect is sent.
const ATTEMPTS: usize = 3;
/// Maximum wait for the beginning or the end of a recording.
const CHANGE_WITHIN: Duration = Duration::from_secs(50);
/// Number of questions about the clock of a host.
const SAMPLES: usize = 8;

/// Record on all hosts of a fleet, and fetch the recordings
///
/// Each host records on its own disk, and its gateway needs `record.directory`. The name of the asking agent must match
/// `access.recorders` of each host. Without --host, the command asks all known hosts that record. The exit code is 1 if
/// one of them fails.
#[derive(Debug, Subcommand)]
#[command(after_help = "\
Examples:
  fipa record fleet start run1 --from station
  fipa record fleet stop run1 --from station
  fipa record fleet list --from station
  fipa record fleet fetch run1 --from station -o recordings
  fipa record merge recordings/run1.*.mcap -o run1.mcap

Configuration of each host:
  access.recorders = [\"station\"]
  record.directory = \"/var/lib/fipa/recordings\"")]
pub(in crate::command) enum Command {
    Start(Start),
    Stop(Named),
    List(Hosts),
    Fetch(Fetch),
}

/// Begin a recording
///
/// The command measures the difference between the clock of each host and that of this host. The files have it.
#[derive(Debug, Args)]
pub(in crate::command) struct Start {
    /// Name of the recording: letters, digits, - and _
    name: RecordingName,

    /// End after this time, at most 7 days
    #[arg(long = "for", value_name = "TIME", default_value = "1h", value_parser = options::duration)]
    time: Duration,

    /// Content to record, as for `fipa record`
    #[arg(long, value_name = "BYTES|none|all", default_value = "all", value_parser = super::content)]
    content: usize,

    /// Only letters from or to agents with this name, or matching this pattern; repeatable
    #[arg(long, value_name = "PATTERN", add = complete::agents())]
    agent: Vec<String>,

    /// Only letters of this protocol; repeatable
    #[arg(long, value_name = "NAME")]
    protocol: Vec<String>,

    #[command(flatten)]
    hosts: Hosts,
}

/// End a recording
#[derive(Debug, Args)]
pub(in crate::command) struct Named {
    /// Name of the recording
    name: RecordingName,

    #[command(flatten)]
    hosts: Hosts,
}

/// Copy a finished recording of each host to this one
///
/// The files have the names NAME.HOST.mcap. A host has one request at a time, for at most 256 KiB, so that other letters
/// pass. A file that is not complete has the additional extension part. The next fetch continues it. The SHA-256 of a
/// complete file is compared with that of its host.
#[derive(Debug, Args)]
pub(in crate::command) struct Fetch {
    /// Name of the recording
    name: RecordingName,

    /// Directory for the files
    #[arg(short, long, value_name = "DIR", default_value = ".")]
    output: PathBuf,

    #[command(flatten)]
    hosts: Hosts,
}

/// List the recordings
#[derive(Debug, Args)]
#[command(after_help = "\
JSON:
  [ { \"host\", \"recording\", \"state\": \"recording\" or \"finished\", \"bytes\",
      \"file\": path or null } or { \"host\", \"error\": text } ]")]
pub(in crate::command) struct Hosts {
    /// Only this host, by the name of its gateway; repeatable
    #[arg(long, value_name = "NAME")]
    host: Vec<String>,

    /// Name of the asking agent [default: a random, unused name]
    #[arg(long, value_name = "NAME")]
    from: Option<AgentId>,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Work for each host.
#[derive(Debug, Clone)]
enum Work {
    Start(RecordingName, Options),
    Stop(RecordingName),
    List,
    Fetch(RecordingName, Destination),
}

/// A recording of a host, and its copy if it was fetched.
#[derive(Debug)]
struct Done {
    recording: Recording,
    file: Option<PathBuf>,
}

impl From<Recording> for Done {
    fn from(recording: Recording) -> Self {
        Self {
            recording,
            file: None,
        }
    }
}

/// The result for one host.
type Outcome = Result<Vec<Done>, String>;

/// Error of a question to a recorder.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
enum AskError {
    /// The conversation failed.
    #[error(transparent)]
    Dialogue(#[from] DialogueError),
    /// The answer cannot be read.
    #[error("the answer of the recorder: {0}")]
    Answer(#[from] ReadError),
    /// The order cannot be written.
    #[error(transparent)]
    Json(#[from] serde_json::Error),
}

impl AskError {
    /// The reason, without the message around it if a recorder gave it.
    fn reason(&self) -> String {
        let refusal = match self {
            Self::Dialogue(DialogueError::Refused(message)) => message.content(),
            _ => None,
        };
        match refusal {
            Some(reason) => String::from_utf8_lossy(reason).into_owned(),
            None => fipa::error::ErrorChain(self).to_string(),
        }
    }
}

/// A recorder of the fleet.
#[derive(Clone)]
struct Recorder {
    agent: Agent,
    host: String,
    id: AgentId,
    /// The gateway of this host.
    own: Option<String>,
}

impl Recorder {
    /// Sends an order and returns the content of the answer. An answer can be lost: the host may not yet know that the
    /// asking agent has registered again.
    async fn ask(&self, order: &Order, within: Duration) -> Result<Bytes, AskError> {
        let attempts = match order {
            Order::Start { .. } | Order::Digest { .. } => 1,
            _ => ATTEMPTS,
        };
        for _ in 1..attempts {
            match self.ask_once(order, within).await {
                Err(AskError::Dialogue(DialogueError::TimedOut)) => {}
                other => return other,
            }
        }
        self.ask_once(order, within).await
    }

    async fn ask_once(&self, order: &Order, within: Duration) -> Result<Bytes, AskError> {
        let request = self
            .agent
            .message(Performative::Request)
            .receiver(&self.id)
            .language("json")
            .ontology(order::ONTOLOGY)
            .content(serde_json::to_vec(order)?);
        let mut request = self.agent.request(request, within).await?;
        let answer = request.result().await?;
        Ok(answer.content().cloned().unwrap_or_default())
    }

    async fn ask_json<T: DeserializeOwned>(
        &self,
        order: &Order,
        within: Duration,
    ) -> Result<T, AskError> {
        Ok(order::read_answer(&self.ask(order, within).await?)?)
    }

    /// Measures the difference between the clock of the host and that of this host.
    async fn measure(&self) -> Result<Option<Clock>, AskError> {
        let Some(own) = &self.own else {
            return Ok(None);
        };
        if *own == self.host {
            return Ok(Some(Clock::of_reference(own)));
        }
        let mut samples = Vec::with_capacity(SAMPLES);
        for _ in 0..SAMPLES {
            let asked = clock::now();
            let answer: ClockAnswer = self.ask_json(&Order::Clock, ANSWER_WITHIN).await?;
            samples.push(clock::Sample {
                asked,
                answer,
                returned: clock::now(),
            });
        }
        Ok(clock::best(own, &samples))
    }

    async fn run(&self, work: Work) -> Outcome {
        let done = match work {
            Work::Start(name, options) => self.start(name, options).await,
            Work::Stop(name) => self.stop(name).await,
            Work::List => {
                let listed = self.list().await.map_err(|it| it.reason())?;
                return Ok(listed.into_iter().map(Done::from).collect());
            }
            Work::Fetch(name, to) => {
                let fetched = fetch::fetch(self, &name, &to).await;
                return fetched.map(|it| vec![it]).map_err(|it| it.reason());
            }
        };
        done.map(|it| vec![it.into()]).map_err(|it| it.reason())
    }

    async fn start(&self, name: RecordingName, options: Options) -> Result<Recording, AskError> {
        let clock = self.measure().await?;
        let order = Order::Start {
            name,
            options,
            clock,
        };
        self.ask_json(&order, CHANGE_WITHIN).await
    }

    async fn stop(&self, name: RecordingName) -> Result<Recording, AskError> {
        // A recording ends without it, too.
        let clock = self.measure().await.unwrap_or_default();
        self.ask_json(&Order::Stop { name, clock }, CHANGE_WITHIN)
            .await
    }

    async fn list(&self) -> Result<Vec<Recording>, AskError> {
        let listing: Listing = self.ask_json(&Order::List, ANSWER_WITHIN).await?;
        Ok(listing.recordings)
    }
}

pub(super) fn run(command: &Command, global: &Global) -> Result<(), Failure> {
    let (work, hosts) = match command {
        Command::Start(start) => {
            let is_limited = start.content < usize::MAX;
            let content = is_limited.then_some(start.content);
            let options = Options {
                seconds: start.time.as_secs(),
                content: content.and_then(|it| u64::try_from(it).ok()),
                agents: start.agent.clone(),
                protocols: start.protocol.clone(),
            };
            (Work::Start(start.name.clone(), options), &start.hosts)
        }
        Command::Stop(stop) => (Work::Stop(stop.name.clone()), &stop.hosts),
        Command::List(hosts) => (Work::List, hosts),
        Command::Fetch(fetch) => {
            let to = Destination::new(&fetch.output);
            (Work::Fetch(fetch.name.clone(), to), &fetch.hosts)
        }
    };
    let outcomes = each_host(&work, hosts, global)?;
    print(&outcomes, hosts.json)?;
    let config = global.config()?;
    let failures = outcomes.iter().filter_map(|(host, outcome)| {
        let reason = outcome.as_ref().err()?;
        Some(Failure::failed(
            escape(reason),
            format!("host {}, domain {:?}", escape(host), config.domain),
            "ask as an agent that access.recorders of the host names (--from NAME); `fipa routes` shows the route to \
             the host",
        ))
    });
    Failure::all(failures)
}

/// Does the work for all selected hosts at the same time.
fn each_host(
    work: &Work,
    hosts: &Hosts,
    global: &Global,
) -> Result<BTreeMap<String, Outcome>, Failure> {
    let config = global.config()?;
    membership::run(async {
        let domain = membership::join(&config).await?;
        let name = match &hosts.from {
            Some(id) => id.name().to_owned(),
            None => format!("fipa-record-{}", Incarnation::random()),
        };
        let done = async {
            let options = RegisterOptions {
                agent_type: "fipa-record".to_owned(),
                ..RegisterOptions::default()
            };
            let agent = membership::register(&domain, &name, options, &config).await?;
            let recorders = recorders(&agent);
            if recorders.is_empty() && hosts.host.is_empty() {
                return Err(Failure::failed(
                    "no host with a recorder is known",
                    format!("domain {:?}", config.domain),
                    "set record.directory in the configuration of the gateways, and restart them",
                ));
            }
            Ok(at_the_same_time(work, recorders, &hosts.host).await)
        };
        let done = done.await;
        domain.close().await;
        done
    })
}

/// The known recorders by the names of their hosts.
fn recorders(agent: &Agent) -> BTreeMap<String, Recorder> {
    let directory = agent.domain().directory();
    directory.refresh();
    let entries = directory.entries();
    let own = entries.iter().find(|it| it.is_own_gateway());
    let own = own.map(|it| it.name.to_string());
    let found = entries.iter().filter_map(|entry| {
        let is_recorder = entry.role == Role::Agent && entry.agent_type == Entry::RECORDER_TYPE;
        let host = match entry.reach {
            Reach::Local => own.as_deref(),
            _ => entry.mts.name.as_deref(),
        };
        // Another host can announce the name, too. The agent of such an entry is no recorder of this host.
        let host = host.filter(|host| is_recorder && *entry.name == *name_of_recorder(host))?;
        let recorder = Recorder {
            agent: agent.clone(),
            host: host.to_owned(),
            id: AgentId::new(&*entry.name).ok()?,
            own: own.clone(),
        };
        Some((host.to_owned(), recorder))
    });
    found.collect()
}

async fn at_the_same_time(
    work: &Work,
    mut recorders: BTreeMap<String, Recorder>,
    hosts: &[String],
) -> BTreeMap<String, Outcome> {
    let mut outcomes = BTreeMap::new();
    if !hosts.is_empty() {
        recorders.retain(|host, _| hosts.contains(host));
        for host in hosts.iter().filter(|host| !recorders.contains_key(*host)) {
            let reason = "no recorder of this host is known; its gateway needs record.directory";
            outcomes.insert(host.clone(), Err(reason.to_owned()));
        }
    }
    let mut running = JoinSet::new();
    for (host, recorder) in recorders {
        let work = work.clone();
        running.spawn(async move { (host, recorder.run(work).await) });
    }
    while let Some(ended) = running.join_next().await {
        match ended {
            Ok((host, outcome)) => {
                outcomes.insert(host, outcome);
            }
            Err(error) => report::warn(&format!("the work for a host has ended: {error}")),
        }
    }
    outcomes
}

fn print(outcomes: &BTreeMap<String, Outcome>, json: bool) -> Result<(), Failure> {
    if json {
        let mut rows: Vec<Value> = Vec::new();
        for (host, outcome) in outcomes {
            match outcome {
                Ok(all) => rows.extend(all.iter().map(|Done { recording, file }| {
                    json!({
                        "host": host, "recording": recording.name.to_string(),
                        "state": recording.state.as_str(), "bytes": recording.bytes,
                        "file": file.as_ref().map(|it| it.to_string_lossy()),
                    })
                })),
                Err(error) => rows.push(json!({ "host": host, "error": error })),
            }
        }
        return output::json(&rows);
    }
    let mut table = output::table(["HOST", "RECORDING", "STATE", "BYTES", "FILE"]);
    for (host, outcome) in outcomes {
        let host = escape(host).into_owned();
        match outcome {
            Ok(all) => table.add_rows(all.iter().map(|Done { recording, file }| {
                [
                    host.clone(),
                    recording.name.to_string(),
                    recording.state.as_str().to_owned(),
                    recording.bytes.to_string(),
                    file.as_deref().map_or_else(|| "-".to_owned(), input::name),
                ]
            })),
            Err(_) => {
                let no = || "-".to_owned();
                table.add_row([host, no(), "failed".to_owned(), no(), no()])
            }
        };
    }
    output::text(&format!("{}\n", table.trim_fmt()))
}
