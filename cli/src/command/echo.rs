//! `fipa echo`: an agent that answers.

use clap::Args;
use fipa::error::ErrorChain;
use fipa::{Agent, Config, Incoming, Message, MessageBuilder, Performative};
use fipa_acl::escape_name;

use crate::answers::Answers;
use crate::membership::{self, Receiver, Stop};
use crate::options::{self, Global};
use crate::output;
use crate::report::{self, Failure};

/// Run an agent that answers each message with an inform of the same content
///
/// The agent prints one line per received message, until Ctrl-C. It works with and without a gateway.
///
/// The agent answers every message except replies (messages with in-reply-to), failure and
/// not-understood. It answers an inform only if that has reply-with. Its own answers have no
/// reply-with, so two echo agents cannot answer each other endlessly.
///
/// With monitor.check, a message that violates its protocol is logged and not answered. It does not count
/// for --count, and neither does a letter that cannot be decoded.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa echo arm_1
  fipa echo arm_1 --type arm --description 'left front'
  fipa echo arm_1 --count 1          ends after one message

To print the values of a topic:
  fipa subscribe camera image

In another terminal:
  fipa send --to arm_1 --content hello --wait")]
pub(crate) struct Arguments {
    #[command(flatten)]
    receiver: Receiver,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(serve(arguments, &config))?
}

async fn serve(arguments: Arguments, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let agent = stop
        .during(arguments.receiver.register(&domain, config))
        .await?;
    if let Some((publisher, topic)) = options::of_publisher(agent.name()) {
        report::warn(&format!(
            "this agent answers messages; `fipa subscribe {publisher} {topic}` prints the values of a topic"
        ));
    }
    output::text(&format!(
        "agent {} of domain {} is ready; press Ctrl-C to stop\n",
        escape_name(agent.name()),
        config.domain
    ))?;
    let ended = tokio::select! {
        ended = answer_all(&agent, arguments.receiver.count) => ended,
        () = stop.requested() => Ok(()),
        () = options::after(arguments.receiver.time) => Ok(()),
    };
    Stop::ending();
    drop(agent);
    domain.close().await;
    ended
}

async fn answer_all(agent: &Agent, count: Option<u64>) -> Result<(), Failure> {
    let mut received = 0;
    let mut answers = Answers::new(agent);
    while count.is_none_or(|count| received < count) {
        match agent.receive().await {
            // The library has logged the violation. An answer would continue a conversation that the
            // sender has broken.
            Ok(incoming) if incoming.violation().is_some() => {}
            Ok(incoming) => {
                received += 1;
                output::text(&line(&incoming))?;
                if requires_answer(incoming.message()) {
                    let answer = answer(agent, incoming.message());
                    answers.send(&incoming, answer).await;
                }
            }
            Err(error) => {
                return Err(Failure::failed(
                    ErrorChain(&error).to_string(),
                    format!("agent {:?}", agent.name()),
                    "restart the agent",
                ));
            }
        }
    }
    answers.finish().await;
    Ok(())
}

fn line(incoming: &Incoming) -> String {
    match incoming.via {
        Some(via) => format!("via {via}: {}\n", incoming.message()),
        None => format!("{}\n", incoming.message()),
    }
}

fn requires_answer(message: &Message) -> bool {
    if message.in_reply_to().is_some() {
        return false;
    }
    match message.performative() {
        Performative::Failure | Performative::NotUnderstood => false,
        Performative::Inform => message.reply_with().is_some(),
        _ => true,
    }
}

/// Returns the answer to a message.
fn answer(agent: &Agent, message: &Message) -> MessageBuilder {
    // `Agent::reply` would set reply-with, which requests an answer to the answer.
    let reply = message.reply(Performative::Inform);
    let mut reply = reply.sender(agent.id().clone());
    if let Some(content) = message.content() {
        reply = reply.content(content.clone());
    }
    if let Some(encoding) = message.encoding() {
        reply = reply.encoding(encoding);
    }
    reply
}
