//! The recorder of a gateway: an agent that records the letters of its host for other agents.

use std::ffi::OsString;
use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;
use fipa::protocol::{DialogueError, Reply, Server, Task};
use fipa::{Agent, AgentId, Config, Domain, Entry, RegisterOptions};
use fipa_acl::escape_name;
use serde::Serialize;
use tokio::task::JoinHandle;

use super::clock::{self, ClockAnswer};
use super::order::{Digest, Order};
use super::recordings::{Recordings, RecordingsError};
use crate::membership;
use crate::options;
use crate::report::Failure;

/// First part of the names of recorders; the second is the name of their gateway.
const PREFIX: &str = "recorder@";

/// Maximum number of characters of a reason.
const MAX_REASON: usize = 400;

/// Returns the name of the recorder of a gateway.
pub(super) fn name_of_recorder(gateway: &str) -> String {
    format!("{PREFIX}{gateway}")
}

/// A running recorder.
pub(in crate::command) struct RecorderService {
    recordings: Arc<Recordings>,
    agent: Agent,
    domain: Domain,
    tasks: [JoinHandle<()>; 2],
    _server: Server,
}

impl RecorderService {
    /// Starts the recorder of a gateway. `None` if the configuration names no directory.
    pub(in crate::command) async fn start(
        config: &Config,
        gateway: &str,
    ) -> Result<Option<Self>, Failure> {
        let directory = Path::new(&config.record.directory);
        if directory.as_os_str().is_empty() {
            return Ok(None);
        }
        let opened = Recordings::open(gateway, directory, config.record.bytes, arguments());
        let recordings = opened.map_err(|error| {
            Failure::failed(
                format!("cannot use the directory of the recordings: {error}"),
                format!("record.directory {:?}", config.record.directory),
                "use a directory that the user of the gateway can write",
            )
        })?;
        let domain = membership::join(config).await?;
        let options = RegisterOptions {
            agent_type: Entry::RECORDER_TYPE.to_owned(),
            ..RegisterOptions::default()
        };
        let name = name_of_recorder(gateway);
        let agent = membership::register(&domain, &name, options, config).await?;
        let (of_orders, known) = (Arc::clone(&recordings), domain.clone());
        let server = agent.serve("fipa-request", move |task| {
            handle(task, Arc::clone(&of_orders), known.clone())
        });
        let server = server
            .map_err(|error| Failure::failed(error.to_string(), name, "report this error"))?;
        // Only orders have an effect.
        let receiver = agent.clone();
        let receiving = async move { while receiver.receive().await.is_ok() {} };
        Ok(Some(Self {
            tasks: [
                tokio::spawn(Arc::clone(&recordings).keep_room()),
                tokio::spawn(receiving),
            ],
            recordings,
            agent,
            domain,
            _server: server,
        }))
    }

    /// The name of the agent.
    pub(in crate::command) fn name(&self) -> &str {
        self.agent.name()
    }

    /// Ends the recordings and the agent.
    pub(in crate::command) async fn close(self) {
        self.recordings.close().await;
        for task in self.tasks {
            task.abort();
        }
        drop(self.agent);
        self.domain.close().await;
    }
}

/// The arguments that select the configuration of this process.
fn arguments() -> Vec<OsString> {
    let sources = options::sources();
    let mut arguments = Vec::new();
    if let Some(file) = sources.file {
        arguments.extend([OsString::from("--config"), file.into()]);
    }
    for set in sources.set {
        arguments.extend([OsString::from("--set"), set.into()]);
    }
    arguments
}

/// Carries out an order.
async fn handle(
    task: Task,
    recordings: Arc<Recordings>,
    domain: Domain,
) -> Result<Reply, DialogueError> {
    let received = clock::now();
    let message = task.message();
    let sender = message.sender().map(AgentId::name).unwrap_or_default();
    if !domain.is_recorder(sender) {
        return Ok(Reply::Refuse(
            format!(
                "{} may not record on this host: access.recorders does not name it",
                escape_name(sender)
            )
            .into(),
        ));
    }
    let content = message.content().map_or(&[][..], |content| content);
    let order = match Order::read(content) {
        Ok(order) => order,
        Err(error) => return Ok(refusal(&error)),
    };
    let done = carry_out(order, &recordings, received).await;
    Ok(match done {
        Ok(answer) => Reply::Inform(answer),
        Err(error) => refusal(&error),
    })
}

/// A refusal with the reason, which can repeat a text of the order.
fn refusal(error: &impl ToString) -> Reply {
    let reason: String = error.to_string().chars().take(MAX_REASON).collect();
    Reply::Refuse(reason.into())
}

async fn carry_out(
    order: Order,
    recordings: &Arc<Recordings>,
    received: i64,
) -> Result<Bytes, RecordingsError> {
    match order {
        Order::Start {
            name,
            options,
            clock,
        } => json(&recordings.start(name, &options, clock).await?),
        Order::Stop { name, clock } => json(&recordings.stop(name, clock).await?),
        Order::List => json(&recordings.list().await?),
        Order::Read {
            name,
            offset,
            length,
        } => {
            let length = usize::try_from(length).unwrap_or(usize::MAX);
            Ok(recordings.read(name, offset, length).await?.into())
        }
        Order::Digest { name } => json(&Digest {
            sha256: recordings.digest(name).await?,
        }),
        Order::Clock => json(&ClockAnswer {
            received,
            answered: clock::now(),
        }),
    }
}

fn json(answer: &impl Serialize) -> Result<Bytes, RecordingsError> {
    let json = serde_json::to_vec(answer).map_err(std::io::Error::from)?;
    Ok(json.into())
}
