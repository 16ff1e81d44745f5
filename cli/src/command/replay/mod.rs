//! `fipa replay`: judges the letters of a recording, or sends them again.

mod check;
mod into;
mod prepare;
mod recorded;

use std::path::PathBuf;

use clap::Args;
use fipa::Matcher;

use crate::options::Global;
use crate::report::Failure;

/// Judge the letters of a recording, or send them again
///
/// With --check, the command checks every letter against the protocol of its conversation and prints the violations.
/// The exit code is 1 if there is one, or if the file is no recording.
///
/// With --into, the command joins a domain and sends the letters to the agents of the same names there. Sent letters
/// can move robots. Therefore the command refuses the domain of the recording without --live. Without --all it leaves
/// out requests (request, request-when, request-whenever, propagate, proxy), calls (cfp), awards (accept-proposal),
/// performatives of your own, messages with a fence, and the messages of locks. It always leaves out letters of message transport services, and
/// letters whose content is not whole in the recording.
///
/// The senders are `replay/NAME`. Each conversation has a new identifier, and `reply-by` moves by the time since the
/// recording. A recorded letter is sent to its one receiver.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa replay run.mcap --check
  fipa replay run.mcap --check --protocol my.scxml --json
  fipa replay run.mcap --into lab
  fipa replay run.mcap --into lab --speed 2 --only arm_1 --all

JSON with --check, one object on a line:
  { \"event\": \"violation\", \"number\": of the letter, \"time\", \"kind\", \"text\" }
  { \"event\": \"summary\", \"letters\", \"accepted\", \"violations\", \"unchecked\",
    \"excluded\", \"complete\": false if the file was not closed }

JSON with --into:
  { \"letters\", \"sent\", \"failed\", \"left_out\": { reason: number } }")]
#[command(group = clap::ArgGroup::new("purpose").required(true).args(["check", "into"]))]
pub(crate) struct Arguments {
    /// A file of `fipa record`; - for standard input with --check
    file: PathBuf,

    /// Judge the letters
    #[arg(long)]
    check: bool,

    /// Send the letters in this domain
    #[arg(long, value_name = "DOMAIN")]
    into: Option<String>,

    /// With --into: the speed, for example 2 for half the time
    #[arg(long, value_name = "FACTOR", default_value = "1", value_parser = speed, conflicts_with = "check")]
    speed: f64,

    /// With --into: send also requests, calls, awards, performatives of your own, and messages with a fence
    #[arg(long, conflicts_with = "check")]
    all: bool,

    /// With --into: permit the domain of the recording
    #[arg(long, conflicts_with = "check")]
    live: bool,

    /// With --into: only letters from or to this agent, or agents matching this pattern; repeatable
    ///
    /// `fipa record filter` makes a file of other selections.
    #[arg(long, value_name = "AGENT", value_parser = Matcher::parse, conflicts_with = "check")]
    only: Vec<Matcher>,

    /// With --check: judge only conversations of this protocol: a name, or an SCXML file; repeatable
    #[arg(long, value_name = "PROTOCOL", conflicts_with = "into")]
    protocol: Vec<String>,

    /// Print JSON
    #[arg(long)]
    json: bool,
}

fn speed(text: &str) -> Result<f64, String> {
    let speed = text.parse().ok().filter(|it| (0.001..=1000.0).contains(it));
    speed.ok_or_else(|| "expected a factor from 0.001 to 1000".to_owned())
}

pub(crate) fn run(arguments: &Arguments, global: &Global) -> Result<(), Failure> {
    match &arguments.into {
        Some(domain) => into::run(arguments, domain, global),
        None => check::run(&arguments.file, &arguments.protocol, arguments.json, global),
    }
}
