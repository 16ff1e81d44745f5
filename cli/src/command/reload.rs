//! `fipa reload`: makes the running processes read their configuration again.

use clap::Args;
use fipa::admin::reload::{self, ReloadAnswer, ReloadedProcess};
use fipa::config::Reloaded;
use fipa_acl::{escape, escape_name};
use serde_json::json;

use crate::membership;
use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// Make the gateway and the programs of this domain read their configuration again
///
/// Each process of the domain on this host reads its own configuration again: the file and the options with which it
/// was started. It applies [routes], [access], mts.deadline and the order of mts.transports at once and loses no letter;
/// the gateway also applies discovery.static. The command prints which keys each process has applied, and which
/// changed keys take effect after a restart of the process. A configuration with mistakes changes nothing.
///
/// The gateway and the commands of `fipa` follow their configuration, and so do programs that join their domain
/// with `Domain::from_environment` or call `Domain::follow`. The command names other programs.
/// `kill -HUP` does the same for a single process of `fipa`.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa config check && fipa reload
  fipa reload --json | jq '.processes[] | select(.later != null and .later != [])'

JSON:
  { \"domain\": text,
    \"processes\": [ { \"name\": text, \"gateway\": true or false,
                     \"result\": \"reloaded\", \"refused\", \"not_followed\" or \"silent\",
                     \"applied\": [ key ], \"later\": [ key ], if it was reloaded,
                     \"error\": text, if it was refused } ] }")]
pub(crate) struct Arguments {
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    let domain = &config.domain;
    let processes = membership::run(async {
        let requested = reload::request(&config).await;
        requested.map_err(|error| membership::not_joined(error, &config))
    })?;
    if arguments.json {
        output::json(&json!({ "domain": domain, "processes": processes }))?;
    } else if processes.is_empty() {
        output::text(&format!("no process of domain {domain} is running\n"))?;
    } else {
        let lines: Vec<String> = processes.iter().map(line).collect();
        output::text(&lines.concat())?;
    }
    let failed = |process: &&ReloadedProcess| {
        !matches!(
            process.answer,
            ReloadAnswer::Reloaded(_) | ReloadAnswer::NotFollowed
        )
    };
    match processes.iter().filter(failed).count() {
        0 => Ok(()),
        count => Err(Failure::failed(
            format!("{count} processes have not read the configuration"),
            format!("domain {domain:?}"),
            "correct the mistakes above, or restart the processes",
        )),
    }
}

/// Returns the line about a process.
fn line(process: &ReloadedProcess) -> String {
    let kind = if process.gateway { "gateway " } else { "" };
    let answer = match &process.answer {
        ReloadAnswer::Reloaded(reloaded) => described(reloaded),
        ReloadAnswer::Refused { error } => format!("applied nothing: {}", escape(error)),
        ReloadAnswer::NotFollowed => {
            "does not follow its configuration; restart it to apply changes".to_owned()
        }
        ReloadAnswer::Silent => "did not answer; it may be stopped or busy".to_owned(),
        _ => "gave an unknown answer".to_owned(),
    };
    format!("{kind}{}: {answer}\n", escape_name(&process.name))
}

fn described(reloaded: &Reloaded) -> String {
    let keys = |keys: &[String]| escape(&keys.join(", ")).into_owned();
    let applied = match reloaded.applied.is_empty() {
        true => None,
        false => Some(format!("applied {}", keys(&reloaded.applied))),
    };
    let later = match reloaded.later.is_empty() {
        true => None,
        false => Some(format!("restart it to apply {}", keys(&reloaded.later))),
    };
    let parts: Vec<String> = applied.into_iter().chain(later).collect();
    match parts.is_empty() {
        true => "nothing has changed".to_owned(),
        false => parts.join("; "),
    }
}
