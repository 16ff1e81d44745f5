//! `fipa demo`: demonstrates the delivery guarantees with real processes on this machine.

mod dock;
mod process;
mod processes;
mod steps;

use clap::{Args, Subcommand};
use serde_json::json;

use crate::options::{self, Global};
use crate::output;
use crate::report::Failure;

/// Demonstrate the main functions with two simulated hosts and several agents
///
/// Starts two gateways and several agents, all as separate processes. Each gateway has its own domain
/// on this machine and stands for one robot. Root is not needed, and no traffic leaves this machine. The
/// second gateway has the first one as a static peer; mDNS is off, so that the demo meets no other domains.
///
/// The agents converse through shared memory and, between the hosts, over TCP. Large content is
/// delivered without a copy, one agent is killed, shared memory breaks, a legacy peer sends a letter,
/// a watcher reports an agent that violates its protocol, and the late command of an agent that was
/// killed with a lock is refused. The receiving process checks each step.
///
/// The exit code is 0 only if every step passed and no file is left behind.
#[derive(Debug, Args)]
#[command(
    args_conflicts_with_subcommands = true,
    after_help = "Examples:\n  fipa demo\n  fipa demo --json | jq '.steps[] | {name, ok, via}'\n\nJSON:\n  \
                  { \"steps\": [ { \"name\", \"ok\", \"error\" if it failed, details of the step } ],\n    \
                  \"measured\": the rows of the step \"measurement\" }"
)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    which: Option<Which>,
    /// Print one JSON object instead of the text
    #[arg(long)]
    json: bool,
    /// Run as a process of a demo
    #[arg(long, hide = true, requires = "name")]
    role: Option<Role>,
    /// Name of the agent or gateway of this process
    #[arg(long, hide = true)]
    name: Option<String>,
}

#[derive(Debug, Subcommand)]
enum Which {
    Dock(Box<dock::Arguments>),
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Role {
    Agent,
    Gateway,
    Watcher,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    if let Some(Which::Dock(arguments)) = arguments.which {
        return dock::run(*arguments);
    }
    if let (Some(role), Some(name)) = (arguments.role, arguments.name) {
        let config = global.config()?;
        let ended = options::block_on(async {
            match role {
                Role::Agent => process::agent(&config, &name).await,
                Role::Gateway => process::gateway(&config).await,
                Role::Watcher => process::watcher(&config).await,
            }
        })?;
        return ended.map_err(|error| Failure::failed(error, name, "see the report of the demo"));
    }
    let report = options::block_on(steps::run(!arguments.json))??;
    if arguments.json {
        output::json(&json!({ "steps": report.steps, "measured": report.measured }))?;
    }
    match report.broken {
        None => Ok(()),
        Some(step) => Err(Failure::failed(
            format!("the step \"{step}\" failed"),
            "fipa demo",
            "run `fipa doctor`; `RUST_LOG=info fipa demo` shows the logs of all processes",
        )),
    }
}
