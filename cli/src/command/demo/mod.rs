//! `fipa demo`: the tour. Real processes on this machine show what the project promises.

mod part;
mod stage;
mod steps;

use clap::Args;
use serde_json::json;

use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Show what this is about: two hosts, several agents, and what happens between them
///
/// Starts two gateways, each with a domain of its own on this machine (standing for two robots),
/// and several agents, all as separate processes; no root needed, nothing leaves this machine.
/// Agents converse through shared memory and between the hosts over TCP, large content moves
/// without a copy, one agent is killed, shared memory is broken, an old peer's letter arrives, and an
/// agent that breaks its protocol is caught by somebody who watches.
/// What each step claims is checked by the process that received something.
///
/// Exits with 0 only if every step did what it says, and leaves nothing behind.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  fipa demo\n  fipa demo --json | jq '.steps[] | {name, ok, via}'"
)]
pub(crate) struct Arguments {
    /// Print one JSON object instead of the story
    #[arg(long)]
    json: bool,
    /// Play a part in somebody else's demo
    #[arg(long, hide = true, requires = "name")]
    part: Option<Part>,
    /// The name of the agent or the gateway of that part
    #[arg(long, hide = true)]
    name: Option<String>,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Part {
    Agent,
    Gateway,
    Watcher,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    if let (Some(part), Some(name)) = (arguments.part, arguments.name) {
        let config = global.config()?;
        let played = options::block_on(async {
            match part {
                Part::Agent => part::agent(&config, &name).await,
                Part::Gateway => part::gateway(&config).await,
                Part::Watcher => part::watcher(&config).await,
            }
        })?;
        return played.map_err(|error| Failure::failed(error, name, "see the demo's own report"));
    }
    let report = options::block_on(steps::play(!arguments.json))??;
    if arguments.json {
        output::json(&json!({ "steps": report.steps, "measured": report.measured }))?;
    }
    match report.broken {
        None => Ok(()),
        Some(step) => Err(Failure::failed(
            format!("the step \"{step}\" did not do what it says"),
            "fipa demo",
            "run it with -v for the logs of all processes, and report what you see",
        )),
    }
}
