//! `fipa send`: one message, and what became of it.

mod advice;

use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use clap::Args;
use fipa::{
    Agent, AgentId, Config, Deliveries, DeliveryFailure, Incarnation, Incoming, Message,
    Performative, ReceiveError, RegisterOptions, Time,
};
use fipa_acl::json::message_to_json;
use serde_json::{Value, json};

use crate::options::{self, Global};
use crate::report::{self, Failure};
use crate::{input, membership, output};

/// Send one message, and say what became of it
///
/// Registers an agent for as long as it takes, sends the message to every receiver and prints one
/// outcome for each: delivered (it is in the receiver's queue), sent (the peer cannot confirm) or
/// failed, the way it went, and the ways that were tried before. With --wait also the first reply.
///
/// Works with and without a gateway; agents of other hosts are reached when one is running
/// (`fipa up`). The exit code is 0 only if every receiver has got the message and, with --wait, a
/// reply came. A failure message about the letter itself, from the message transport service of
/// either host, is no reply.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa send --to arm_1 --content hello
  fipa send --to arm_1 --performative request --content '(lift sample-3)' --wait
  fipa send --to 'arm_.*' --content stop               everybody whose name matches
  fipa send --to camera --content-file picture.raw --deadline 30s
  head -c 4096 /dev/urandom | fipa send --to camera --content-file - --json

JSON:
  { \"deliveries\": [ { \"receiver\": name, \"outcome\": \"delivered\", \"sent\" or \"failed\",
                      \"via\": transport, unless it failed, \"reason\": text, if it failed,
                      \"attempts\": [ { \"via\", \"location\", \"error\" } ] } ],
    \"reply\": the message, as `fipa decode` prints it, if one came,
    \"failures\": [ { \"from\": name, \"receiver\": name or null, \"reason\": text } ], if with --wait
                failure messages about the letter came }")]
pub(crate) struct Arguments {
    /// Name of the receiver, or a pattern of names such as 'arm_.*'; may be repeated
    #[arg(long, required = true, value_name = "NAME")]
    to: Vec<AgentId>,

    /// Name to send it under [default: a name that nobody else has]
    #[arg(long, value_name = "NAME")]
    from: Option<AgentId>,

    /// What the message does: inform, request, query-ref, …, or a word of your own
    #[arg(long, short, default_value = "inform", value_name = "ACT")]
    performative: Performative,

    /// What it says
    #[arg(long, value_name = "TEXT", conflicts_with = "content_file")]
    content: Option<String>,

    /// What it says, byte by byte as in this file; - for standard input
    #[arg(long, value_name = "FILE")]
    content_file: Option<PathBuf>,

    /// How long the receivers have to take it [default: mts.deadline of the configuration]
    #[arg(long, value_name = "TIME", value_parser = deadline)]
    deadline: Option<Duration>,

    /// Wait for a reply
    #[arg(long)]
    wait: bool,

    /// How long to wait for it
    #[arg(long, value_name = "TIME", default_value = "10s", requires = "wait",
          value_parser = options::duration)]
    timeout: Duration,

    /// Print JSON
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    parameters: Parameters,
}

/// What else a message can say of itself (FIPA00061).
#[derive(Debug, Args)]
#[command(next_help_heading = "Parameters of the message")]
struct Parameters {
    /// The interaction protocol, for example fipa-request
    #[arg(long, value_name = "WORD")]
    protocol: Option<String>,

    /// The conversation it belongs to; with --wait one of its own unless given
    #[arg(long, value_name = "TEXT")]
    conversation_id: Option<String>,

    /// What the reply is to have as in-reply-to; with --wait something unique unless given
    #[arg(long, value_name = "TEXT")]
    reply_with: Option<String>,

    /// Who is to get the replies, instead of the sender; may be repeated
    #[arg(long, value_name = "NAME", conflicts_with = "wait")]
    reply_to: Vec<AgentId>,

    /// The reply-with of the message that this one answers
    #[arg(long, value_name = "TEXT")]
    in_reply_to: Option<String>,

    /// The latest time for a reply: from now, such as 30s, or as in 2030-01-31T12:00:00Z
    #[arg(long, value_name = "TIME", value_parser = reply_by)]
    reply_by: Option<Time>,

    /// The language of the content
    #[arg(long, value_name = "TEXT")]
    language: Option<String>,

    /// The encoding of the content
    #[arg(long, value_name = "TEXT")]
    encoding: Option<String>,

    /// The ontology of the content
    #[arg(long, value_name = "TEXT")]
    ontology: Option<String>,
}

pub(crate) fn run(mut arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    // Before the domain is joined: a terminal may take its time.
    let content = match (arguments.content.take(), &arguments.content_file) {
        (Some(text), _) => Some(text.into_bytes()),
        (None, Some(file)) => Some(input::read(file, Message::MAX_CONTENT)?),
        (None, None) => None,
    };
    membership::run(async {
        let domain = membership::join(&config).await?;
        let name = match &arguments.from {
            Some(id) => id.name().to_owned(),
            None => format!("fipa-send-{}", Incarnation::random()),
        };
        let options = RegisterOptions {
            agent_type: "fipa-send".to_owned(),
            ..RegisterOptions::default()
        };
        let agent = membership::register(&domain, &name, options, &config)?;
        let done = converse(&agent, &arguments, content, &config).await;
        drop(agent);
        domain.close().await;
        done
    })
}

/// Sends the message, waits for the reply if one is wanted, and prints what came of both.
async fn converse(
    agent: &Agent,
    arguments: &Arguments,
    content: Option<Vec<u8>>,
    config: &Config,
) -> Result<(), Failure> {
    let message = message(agent, arguments, content)?;
    let deadline = arguments.deadline.unwrap_or(config.mts.deadline);
    let sent = agent.send_within(message.clone(), deadline).await;
    let deliveries = sent.map_err(|error| {
        Failure::failed(
            format!("the message cannot be sent: {error}"),
            "this process",
            "see `fipa send --help` for what a message can have",
        )
    })?;
    if !arguments.json {
        output::text(&format!("{deliveries}\n"))?;
    }
    let anybody_got_it = deliveries.0.iter().any(|one| one.outcome.is_success());
    let mut answers = Answers::default();
    if arguments.wait && anybody_got_it {
        let sent = deliveries.0.iter().filter(|one| one.outcome.is_success());
        answers = wait(agent, &message, sent.count(), arguments.timeout).await?;
    }
    match &answers.reply {
        _ if arguments.json => {
            let mut json = json!({ "deliveries": output::deliveries(&deliveries) });
            if let Some(reply) = &answers.reply {
                json["reply"] = message_to_json(&reply.message);
            }
            if !answers.failures.is_empty() {
                let failures = answers.failures.iter().map(FailureMessage::json);
                json["failures"] = failures.collect();
            }
            output::json(&json)?;
        }
        Some(reply) => output::text(&format!("reply: {}\n", reply.message))?,
        None => {}
    }
    let silent = arguments.wait && anybody_got_it && answers.timed_out;
    let silent = silent.then(|| no_reply(&deliveries, arguments.timeout));
    let failures = advice::failures(&deliveries, agent, config);
    let told = answers.failures.iter().map(FailureMessage::failure);
    Failure::all(failures.into_iter().chain(told).chain(silent))
}

/// What came while the command waited for a reply.
#[derive(Debug, Default)]
struct Answers {
    reply: Option<Incoming>,
    failures: Vec<FailureMessage>,
    timed_out: bool,
}

/// A message that says that the letter was not delivered.
#[derive(Debug)]
struct FailureMessage {
    from: String,
    failure: DeliveryFailure,
}

impl FailureMessage {
    fn of(message: &Message) -> Option<Self> {
        let from = message.sender().map_or("", AgentId::name).to_owned();
        let failure = DeliveryFailure::read(message)?;
        Some(Self { from, failure })
    }

    fn json(&self) -> Value {
        let DeliveryFailure { receiver, reason } = &self.failure;
        json!({ "from": self.from, "receiver": receiver, "reason": reason })
    }

    fn failure(&self) -> Failure {
        let DeliveryFailure { receiver, reason } = &self.failure;
        let receiver = receiver.as_deref().unwrap_or("a receiver");
        Failure::failed(
            format!("not delivered: {reason}"),
            format!("{receiver:?}, as {:?} says in a failure message", self.from),
            "see `fipa agents`, and the log of that message transport service",
        )
    }
}

fn message(
    agent: &Agent,
    arguments: &Arguments,
    content: Option<Vec<u8>>,
) -> Result<Message, Failure> {
    let given = &arguments.parameters;
    let mut builder = agent
        .message(arguments.performative.clone())
        .receivers(arguments.to.iter().cloned());
    for agent in &given.reply_to {
        builder = builder.reply_to(agent.clone());
    }
    if let Some(content) = content {
        builder = builder.content(content);
    }
    let unique = || arguments.wait.then(|| Incarnation::random().to_string());
    if let Some(text) = given.conversation_id.clone().or_else(unique) {
        builder = builder.conversation_id(text);
    }
    if let Some(text) = given.reply_with.clone().or_else(unique) {
        builder = builder.reply_with(text);
    }
    if let Some(text) = &given.in_reply_to {
        builder = builder.in_reply_to(text);
    }
    if let Some(text) = &given.protocol {
        builder = builder.protocol(text);
    }
    if let Some(text) = &given.language {
        builder = builder.language(text);
    }
    if let Some(text) = &given.encoding {
        builder = builder.encoding(text);
    }
    if let Some(text) = &given.ontology {
        builder = builder.ontology(text);
    }
    if let Some(time) = given.reply_by {
        builder = builder.reply_by(time);
    }
    builder.build().map_err(|error| {
        Failure::wrong_usage(
            error.to_string(),
            "the command line",
            "see `fipa send --help` for what a message can have",
        )
    })
}

/// Waits for the first reply. Failure messages about the letter are collected meanwhile; when there
/// is one for each of the receivers that it was `sent` to, no reply is waited for.
async fn wait(
    agent: &Agent,
    message: &Message,
    sent: usize,
    patience: Duration,
) -> Result<Answers, Failure> {
    let mut answers = Answers::default();
    let first = async {
        while answers.failures.len() < sent {
            match agent.receive().await {
                // What this process tells the agent itself is in the outcomes already.
                Ok(incoming) if incoming.via.is_none() => {}
                Ok(incoming) if incoming.message.is_reply_to(message) => {
                    match FailureMessage::of(&incoming.message) {
                        Some(failure) => answers.failures.push(failure),
                        None => {
                            answers.reply = Some(incoming);
                            break;
                        }
                    }
                }
                Ok(other) => report::warn(&format!("not a reply: {}", other.message)),
                Err(error @ ReceiveError::Malformed { .. }) => report::warn(&error.to_string()),
                Err(error) => {
                    return Err(Failure::failed(
                        format!("cannot wait for a reply: {error}"),
                        format!("agent {:?}", agent.name()),
                        "send it again",
                    ));
                }
            }
        }
        Ok(())
    };
    match tokio::time::timeout(patience, first).await {
        Ok(ended) => ended?,
        Err(_) => answers.timed_out = true,
    }
    Ok(answers)
}

fn no_reply(deliveries: &Deliveries, patience: Duration) -> Failure {
    let got_it = deliveries.0.iter().filter(|one| one.outcome.is_success());
    let got_it: Vec<&str> = got_it.map(|one| &*one.receiver).collect();
    Failure::failed(
        format!("no reply within {}", humantime::format_duration(patience)),
        advice::receivers(&got_it),
        "see whether it answers such a message at all, or wait longer with --timeout",
    )
}

/// What the configuration allows for `mts.deadline`.
fn deadline(text: &str) -> Result<Duration, String> {
    let deadline = options::duration(text)?;
    if deadline.is_zero() || deadline > Duration::from_secs(3600) {
        return Err("use more than 0 and at most 1h".to_owned());
    }
    Ok(deadline)
}

fn reply_by(text: &str) -> Result<Time, String> {
    let from_now = humantime::parse_duration(text)
        .ok()
        .and_then(|span| SystemTime::now().checked_add(span))
        .map(Time::from_system_time);
    let time = from_now.unwrap_or_else(|| Time::from_rfc3339(text).or_else(|_| text.parse()));
    time.map_err(|error| error.to_string())
}
