//! `fipa subscribe`: prints the notifications of an agent.

use std::time::Duration;

use clap::Args;
use fipa::protocol::{DialogueError, Keep, Notification, Subscription};
use fipa::{Agent, AgentId, Performative};
use fipa_acl::{escape, escape_name};
use serde_json::json;

use super::request::{self, CANCEL_WITHIN, Opening, line, unless_stopped};
use crate::complete;
use crate::membership::Stop;
use crate::options::{self, Global};
use crate::output::{self, Reader};
use crate::report::{self, Failure};

/// Subscribe to the notifications of an agent (FIPA00035)
///
/// Leads the protocol fipa-subscribe: prints the content of each notification until Ctrl-C, which cancels the
/// subscription. Gaps are reported on standard error. A silent host of the agent is reported and does not end the command. The exit code is 1
/// if the agent refuses, ends the subscription, leaves or dies.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa subscribe battery charge
  fipa subscribe battery charge --count 1
  fipa subscribe camera image --raw --count 1 > image.jpg      the newest image
  fipa subscribe door events --keep all
  fipa subscribe battery charge --json | jq -r .notification.content

JSON, one object on each line:
  { \"subscribed\": name }                     when the agent has agreed
  { \"notification\": the message as `fipa decode` prints it,
    \"missed\": number of notifications before it that were replaced or failed,
    \"age_ms\": time since the publication by the clocks of both hosts, or null }")]
pub(crate) struct Arguments {
    /// Name of the agent
    #[arg(add = complete::agents())]
    name: AgentId,

    /// Topic of the publisher; for an agent of another platform, the content of the subscription
    #[arg(value_name = "TOPIC")]
    content: String,

    /// Notifications to get if this command is slower than the publisher: all, latest(N), or auto, which is the newest one of
    /// a stream and all of others
    #[arg(long, value_name = "KEEP", default_value = "auto")]
    keep: Keep,

    /// Print the messages with all parameters
    #[arg(long, conflicts_with = "json")]
    full: bool,

    /// Print the bytes of the contents unchanged and without line ends, for a file or another program
    #[arg(long, conflicts_with_all = ["json", "full"])]
    raw: bool,

    /// End after this number of notifications
    #[arg(long, short, value_name = "N")]
    count: Option<u64>,

    /// End after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
    time: Option<Duration>,

    /// Maximum wait for the agreement, for example 10s
    #[arg(long, value_name = "TIME", default_value = "10s", value_parser = options::duration)]
    timeout: Duration,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    opening: Opening,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    arguments
        .opening
        .run("subscribe", global, async |agent, stop| {
            follow(agent, &arguments, stop).await
        })
}

async fn follow(agent: &Agent, arguments: &Arguments, stop: &mut Stop) -> Result<(), Failure> {
    let Arguments { name, content, .. } = arguments;
    let act = Performative::Subscribe;
    let opening = arguments.opening.message(agent, act, name, content);
    let opening = opening.await?;
    let subscribed = tokio::select! {
        subscribed = agent.subscribe_keeping(arguments.keep, opening, arguments.timeout) => subscribed,
        () = stop.requested() => return Ok(()),
    };
    let mut subscription = subscribed.map_err(|error| failed(&error, name))?;
    let mut reachability = subscription.reachability();
    match arguments.json {
        true => output::json_line(&json!({ "subscribed": name.name() }))?,
        // The output has the contents alone.
        false => report::hint(&format!(
            "subscribed to {}; press Ctrl-C to stop",
            escape_name(name.name())
        )),
    }
    let mut reader = Reader::of_output();
    let print = async {
        tokio::select! {
            printed = print_all(&mut subscription, arguments) => printed,
            () = reader.gone() => Ok(()),
            () = options::after(arguments.time) => Ok(()),
        }
    };
    match unless_stopped(print, &mut reachability, stop).await {
        Some(Err(failure)) => Err(failure),
        Some(Ok(())) | None => {
            Stop::ending();
            if let Err(error) = subscription.cancel(CANCEL_WITHIN).await {
                report::warn(&format!("the subscription was not canceled: {error}"));
            }
            Ok(())
        }
    }
}

/// The error report of a subscription.
fn failed(error: &DialogueError, name: &AgentId) -> Failure {
    let place = || format!("{:?}", name.name());
    match error {
        DialogueError::Refused(message) => {
            let content = message.content().map_or(&[][..], |content| content);
            let reason = String::from_utf8_lossy(content);
            Failure::failed(
                format!("the subscription is refused: {}", escape(&reason)),
                place(),
                format!(
                    "`fipa topics {}` lists the topics",
                    escape_name(name.name())
                ),
            )
        }
        DialogueError::NotDelivered { .. }
            if let Some((publisher, topic)) = options::of_publisher(name.name()) =>
        {
            let help = format!(
                "the agent and the topic are two arguments: `fipa subscribe {publisher} {topic}`"
            );
            Failure::failed(request::in_full(error), place(), help)
        }
        _ => request::failed(error, name),
    }
}

async fn print_all(subscription: &mut Subscription, arguments: &Arguments) -> Result<(), Failure> {
    let mut count = 0;
    while arguments.count.is_none_or(|most| count < most) {
        let notification = match subscription.next().await {
            Ok(notification) => notification,
            // Reported as a change of the reachability.
            Err(DialogueError::Unreachable { .. }) => continue,
            Err(error) => return Err(failed(&error, &arguments.name)),
        };
        count += 1;
        print(&notification, arguments)?;
    }
    Ok(())
}

fn print(notification: &Notification, arguments: &Arguments) -> Result<(), Failure> {
    if arguments.json {
        let mut line = line("notification", notification);
        line["missed"] = notification.missed().into();
        let age = notification.age().map(|age| age.as_millis());
        line["age_ms"] = json!(age);
        return output::json_line(&line);
    }
    match notification.missed() {
        0 => {}
        missed => report::note(&format!("{missed} missed")),
    }
    let content = notification.content().map_or(&[][..], |content| content);
    if arguments.raw {
        return output::bytes(content);
    }
    output::text(&match arguments.full {
        true => format!("{notification}\n"),
        false => match std::str::from_utf8(content) {
            Ok(text) => format!("{}\n", escape(text)),
            Err(_) => format!(
                "{} bytes that are no text; --raw prints them\n",
                content.len()
            ),
        },
    })
}
