//! `fipa request`: requests an action from an agent.

use std::pin::pin;
use std::time::Duration;

use clap::Args;
use fipa::error::ErrorChain;
use fipa::protocol::{DialogueError, Reachability};
use fipa::{
    Agent, AgentId, Config, Incarnation, Message, MessageBuilder, Performative, RegisterOptions,
};
use fipa_acl::escape_name;
use fipa_acl::json::message_to_json;
use serde_json::{Value, json};

use crate::complete;
use crate::membership::{self, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::{self, Failure};

/// Maximum wait for the confirmation of a cancel at the end of the command. A second signal ends it.
pub(super) const CANCEL_WITHIN: Duration = Duration::from_secs(5);

/// Request an action from an agent (FIPA00026)
///
/// Leads the protocol fipa-request: prints whether the agent agrees, warns while its host is silent, and
/// prints the result. Ctrl-C cancels the request. The exit code is 0 only if the agent has reported the
/// result; it is 1 if the agent refuses, fails, leaves or dies.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa request arm_1 '(lift crate)'
  fipa request arm_1 '(lift crate)' --timeout 5m
  fipa request arm_1 '(lift crate)' --json | jq -r .result.content
  fipa request arm@jade '(lift crate)' --address http://10.0.0.7:7778/acc    of another platform

JSON:
  { \"agreed\": whether the agent agreed before its result,
    \"result\", \"refused\", \"failed\" or \"not_understood\": the last message of the agent as
                 `fipa decode` prints it; absent without one }")]
pub(crate) struct Arguments {
    /// Name of the agent
    #[arg(add = complete::agents())]
    name: AgentId,

    /// Content of the request
    content: String,

    /// Maximum wait for the result, for example 10s or 5m
    #[arg(long, value_name = "TIME", default_value = "1m", value_parser = options::duration)]
    timeout: Duration,

    /// Print JSON
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    opening: Opening,
}

/// The options of the message that begins a conversation.
#[derive(Debug, Args)]
pub(super) struct Opening {
    /// Name of the asking agent [default: a random, unused name]
    #[arg(long, value_name = "NAME")]
    from: Option<AgentId>,

    /// Language of the content
    #[arg(long, value_name = "TEXT")]
    language: Option<String>,

    /// Ontology of the content
    #[arg(long, value_name = "TEXT")]
    ontology: Option<String>,

    #[command(flatten)]
    addresses: membership::Addresses,
}

impl Opening {
    /// Runs a conversation of the asking agent, and leaves the domain after it.
    pub(super) fn run(
        &self,
        command: &str,
        global: &Global,
        conversation: impl AsyncFnOnce(&Agent, &mut Stop) -> Result<(), Failure>,
    ) -> Result<(), Failure> {
        let config = global.config()?;
        let register = async |domain: &fipa::Domain| self.register(domain, command, &config).await;
        membership::run_agent(&config, register, conversation)
    }

    /// Registers the asking agent.
    pub(super) async fn register(
        &self,
        domain: &fipa::Domain,
        command: &str,
        config: &Config,
    ) -> Result<Agent, Failure> {
        let name = match &self.from {
            Some(id) => id.name().to_owned(),
            None => format!("fipa-{command}-{}", Incarnation::random()),
        };
        let options = RegisterOptions {
            agent_type: format!("fipa-{command}"),
            ..RegisterOptions::default()
        };
        membership::register(domain, &name, options, config).await
    }

    /// Starts the message.
    pub(super) async fn message(
        &self,
        agent: &Agent,
        performative: Performative,
        to: &AgentId,
        content: &str,
    ) -> Result<MessageBuilder, Failure> {
        let to = self.addresses.of(agent, to).await?;
        let mut message = agent
            .message(performative)
            .receiver(&to)
            .content(content.to_owned());
        if let Some(language) = &self.language {
            message = message.language(language);
        }
        if let Some(ontology) = &self.ontology {
            message = message.ontology(ontology);
        }
        Ok(message)
    }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    arguments
        .opening
        .run("request", global, async |agent, stop| {
            converse(agent, &arguments, stop).await
        })
}

async fn converse(agent: &Agent, arguments: &Arguments, stop: &mut Stop) -> Result<(), Failure> {
    let act = Performative::Request;
    let opening = arguments
        .opening
        .message(agent, act, &arguments.name, &arguments.content)
        .await?;
    let begun = tokio::select! {
        begun = agent.request(opening, arguments.timeout) => begun,
        () = stop.requested() => return Err(stopped()),
    };
    let mut agreed = false;
    let ended = match begun {
        Ok(mut request) => {
            let id = request.conversation_id().to_owned();
            let mut reachability = request.reachability();
            let lead = async {
                agreed = request.agreed().await?;
                if agreed && !arguments.json {
                    let agent = escape_name(arguments.name.name());
                    // A closed output ends the command with the result.
                    let _ = output::text(&format!("{agent} agreed\n"));
                }
                request.result().await
            };
            match unless_stopped(lead, &mut reachability, stop).await {
                Some(ended) => ended,
                None => {
                    Stop::ending();
                    cancel(agent, &arguments.name, &id).await;
                    return Err(stopped());
                }
            }
        }
        Err(error) => Err(error),
    };
    let mut json = json!({ "agreed": agreed });
    let failure = match ended {
        Ok(result) => {
            json["result"] = message_to_json(&result);
            if !arguments.json {
                output::text(&format!("result: {result}\n"))?;
            }
            None
        }
        Err(error) => {
            if let Some((key, message)) = last_message(&error) {
                json[key] = message_to_json(message);
            }
            Some(failed(&error, &arguments.name))
        }
    };
    if arguments.json {
        output::json(&json)?;
    }
    Failure::all(failure)
}

/// The message of the other side that ended the conversation, with its key in JSON.
fn last_message(error: &DialogueError) -> Option<(&'static str, &Message)> {
    match error {
        DialogueError::Refused(message) => Some(("refused", message)),
        DialogueError::Failed(message) => Some(("failed", message)),
        DialogueError::NotUnderstood(message) => Some(("not_understood", message)),
        _ => None,
    }
}

/// Runs a part of a conversation and warns while the host of the other agent is silent. Returns `None`
/// after a signal.
pub(super) async fn unless_stopped<T>(
    work: impl Future<Output = T>,
    reachability: &mut Reachability,
    stop: &mut Stop,
) -> Option<T> {
    let mut work = pin!(work);
    loop {
        tokio::select! {
            biased;
            done = &mut work => return Some(done),
            () = stop.requested() => return None,
            true = reachability.changed() => {
                for silent in reachability.unreachable() {
                    report::warn(&format!(
                        "the host of {:?} has been silent for {} s; still waiting",
                        silent.agent,
                        silent.since.elapsed().as_secs()
                    ));
                }
            }
        }
    }
}

/// Tells the agent that the command ends.
async fn cancel(agent: &Agent, to: &AgentId, conversation: &str) {
    let cancel = agent
        .message(Performative::Cancel)
        .receiver(to)
        .protocol("fipa-request")
        .conversation_id(conversation)
        .reply_with(agent.unique_id());
    match agent.send_within(cancel, CANCEL_WITHIN).await {
        Ok(deliveries) if deliveries.all_succeeded() => {}
        Ok(deliveries) => {
            return report::warn(&format!("the cancel was not delivered: {deliveries}"));
        }
        Err(error) => return report::warn(&format!("cannot cancel: {}", ErrorChain(&error))),
    }
    let confirmed = async {
        while let Ok(incoming) = agent.receive().await {
            let message = incoming.message();
            if message.conversation_id() == Some(conversation) {
                return *message.performative() != Performative::Failure;
            }
        }
        false
    };
    let confirmed = tokio::time::timeout(CANCEL_WITHIN, confirmed).await;
    if !confirmed.unwrap_or(false) {
        report::warn("the agent has not confirmed the cancel");
    }
}

fn stopped() -> Failure {
    Failure::failed(
        "canceled by a signal before the result",
        "this process",
        "run the command again",
    )
}

/// The error report of a conversation.
pub(super) fn failed(error: &DialogueError, name: &AgentId) -> Failure {
    let help = match error {
        DialogueError::NotDelivered { .. } => {
            "`fipa agents` lists the agents, and `fipa routes` their routes"
        }
        DialogueError::TimedOut => {
            "check whether the agent answers such messages, or wait longer with --timeout"
        }
        DialogueError::Gone { .. } => "start the agent again, and check its log",
        DialogueError::Several { .. } => "name one agent",
        DialogueError::Refused(_)
        | DialogueError::Failed(_)
        | DialogueError::NotUnderstood(_)
        | DialogueError::Cancelled(_) => "the message above has the reason of the agent",
        _ => "`fipa watch` shows the messages of the conversation",
    };
    Failure::failed(in_full(error), format!("{:?}", name.name()), help)
}

/// Formats the error with the reason of the other agent or platform, and then with its whole message.
pub(super) fn in_full(error: &DialogueError) -> String {
    let text = ErrorChain(error).to_string();
    let message = match error {
        DialogueError::Refused(message)
        | DialogueError::Failed(message)
        | DialogueError::NotUnderstood(message)
        | DialogueError::Cancelled(message)
        | DialogueError::Undelivered(message)
        | DialogueError::Unexpected(message) => message,
        _ => return text,
    };
    let short = message.to_string();
    match text.contains(&short) {
        true => text.replacen(&short, &format!("{message:#}"), 1),
        false => format!("{text} {message:#}"),
    }
}

/// Formats a message of another agent: with its whole texts if it has a reason.
pub(super) fn shown(message: &Message) -> String {
    match message.performative() {
        Performative::Refuse
        | Performative::Failure
        | Performative::NotUnderstood
        | Performative::RejectProposal => format!("{message:#}"),
        _ => message.to_string(),
    }
}

/// The JSON of a message, for commands that print one object per message.
pub(super) fn line(key: &str, message: &Message) -> Value {
    json!({ key: message_to_json(message) })
}
