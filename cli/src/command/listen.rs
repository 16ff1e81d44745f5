//! `fipa listen`: an agent that prints its letters.

use clap::Args;
use fipa::error::ErrorChain;
use fipa::{Config, Incoming};
use fipa_acl::escape_name;
use fipa_acl::json::message_to_json;
use serde_json::json;

use crate::membership::{self, Receiver, Stop};
use crate::options::{self, Global};
use crate::output::{self, Reader};
use crate::report::Failure;

/// Run an agent that prints each message and answers none
///
/// The agent prints one line per received message, until Ctrl-C. It works with and without a gateway.
/// `fipa echo` answers messages; `fipa watch` shows the letters of other agents.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa listen monitor_1
  fipa listen monitor_1 --count 1            ends after one message
  fipa listen monitor_1 --json | jq -r .message.content

In another terminal:
  fipa send --to monitor_1 --content hello

JSON, one object on each line:
  { \"agent\": name, \"domain\": text }          when the agent is ready
  { \"via\": transport, or null for a message of this process,
    \"violation\": text, if the message violates its protocol (monitor.check),
    \"message\": the message as `fipa decode` prints it }")]
pub(crate) struct Arguments {
    #[command(flatten)]
    receiver: Receiver,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    options::block_on(listen(arguments, &config))?
}

async fn listen(arguments: Arguments, config: &Config) -> Result<(), Failure> {
    let mut stop = Stop::listen()?;
    let domain = stop.during(membership::join(config)).await?;
    let agent = stop
        .during(arguments.receiver.register(&domain, config))
        .await?;
    match arguments.json {
        true => output::json_line(&json!({ "agent": agent.name(), "domain": config.domain }))?,
        false => output::text(&format!(
            "agent {} of domain {} is listening; press Ctrl-C to stop\n",
            escape_name(agent.name()),
            config.domain
        ))?,
    }
    let print_all = async {
        let (mut received, count) = (0, arguments.receiver.count);
        while count.is_none_or(|count| received < count) {
            let incoming = agent.receive().await.map_err(|error| {
                Failure::failed(
                    ErrorChain(&error).to_string(),
                    format!("agent {:?}", agent.name()),
                    "restart the agent",
                )
            })?;
            received += 1;
            print(&incoming, arguments.json)?;
        }
        Ok(())
    };
    let mut reader = Reader::of_output();
    let ended = tokio::select! {
        ended = print_all => ended,
        () = stop.requested() => Ok(()),
        () = reader.gone() => Ok(()),
        () = options::after(arguments.receiver.time) => Ok(()),
    };
    Stop::ending();
    drop(agent);
    domain.close().await;
    ended
}

fn print(incoming: &Incoming, json: bool) -> Result<(), Failure> {
    let violation = incoming.violation().map(ToString::to_string);
    let via = incoming.via.map(|via| via.name());
    if json {
        let mut line = json!({ "via": via, "message": message_to_json(incoming.message()) });
        if let Some(violation) = violation {
            line["violation"] = violation.into();
        }
        return output::json_line(&line);
    }
    let via = via.map(|via| format!("via {via}: ")).unwrap_or_default();
    let violation = violation.map(|it| format!(" (violation: {it})"));
    let message = incoming.message();
    output::text(&format!(
        "{via}{message}{}\n",
        violation.unwrap_or_default()
    ))
}
