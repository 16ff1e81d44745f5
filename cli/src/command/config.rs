//! `fipa config`: shows and checks the effective configuration.

use std::path::Path;

use clap::{Args, Subcommand};
use fipa::config::{ConfigError, Effective};
use serde_json::json;

use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// Show the effective configuration, or check it for errors
///
/// The configuration is one TOML file: the file given with --config, else the file named by
/// $FIPA_CONFIG, else ./fipa.toml, else ~/.config/fipa/fipa.toml, else /etc/fipa/fipa.toml. No other
/// file is read. Keys that the file does not set have their defaults. $FIPA_DOMAIN overrides the
/// domain of the file. --set KEY=VALUE overrides single keys.
#[derive(Debug, Subcommand)]
#[command(after_help = "\
Examples:
  fipa config show                          prints each value with its origin
  fipa config show > new.toml               writes a file with all keys
  fipa --set mts.deadline=9s config show    shows the effect of an override
  fipa config check --config robot.toml     checks a file for errors")]
pub(crate) enum Arguments {
    /// Print the effective configuration with the origin of every value
    ///
    /// The output is a valid configuration file with every key. A comment after each value names its
    /// origin: `# default`, `# fipa.toml:12` (file and line) or `# --set`.
    #[command(after_help = "\
Examples:
  fipa config show
  fipa config show --config robot.toml
  fipa config show --json | jq '.settings[] | select(.origin.from != \"default\")'

JSON:
  { \"file\": path or null,
    \"settings\": [ { \"path\": [\"mts\", \"deadline\"], \"value\": \"5s\",
                    \"origin\": { \"from\": \"default\" }
                            | { \"from\": \"file\", \"path\": path, \"line\": number }
                            | { \"from\": \"environment\", \"variable\": name }
                            | { \"from\": \"set\", \"assignment\": \"key=value\" } } ] }")]
    Show(Json),

    /// Check the configuration for errors
    ///
    /// Reports every error with file, line, key and the allowed values. It also reports values that name
    /// something that this machine does not have: a key directory that cannot be used, protocol files that
    /// are missing or have mistakes, network interfaces that do not exist, and static peers whose
    /// transports are off. The exit code is 0 if there is no error and 2 otherwise, so that a script can
    /// check a file before it starts a robot.
    #[command(after_help = "\
Examples:
  fipa config check
  fipa config check --config robot.toml
  fipa config check --set mts.deadline=9s

JSON:
  { \"ok\": true or false,
    \"mistakes\": [ { \"what\": text, \"help\": text,
                    \"place\": an origin as in `fipa config show` } ] }
  A file that cannot be read is reported on standard error, as without --json.")]
    Check(Json),
}

#[derive(Debug, Args)]
pub(crate) struct Json {
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    match arguments {
        Arguments::Show(Json { json }) => show(&global.effective()?, json),
        Arguments::Check(Json { json: false }) => check(&Effective::check(&global.sources())?),
        Arguments::Check(Json { json: true }) => check_json(Effective::check(&global.sources())),
    }
}

fn show(effective: &Effective, json: bool) -> Result<(), Failure> {
    if !json {
        return output::text(&effective.render());
    }
    output::json(&json!({
        "file": effective.file().map(Path::to_string_lossy),
        "settings": effective.settings(),
    }))
}

fn check(effective: &Effective) -> Result<(), Failure> {
    let checked = match effective.file() {
        Some(file) => file.to_string_lossy(),
        None => "no configuration file, all keys have their defaults".into(),
    };
    output::text(&format!("no errors: {checked}\n"))
}

/// Prints the errors on standard output only: they are the result of this command.
fn check_json(loaded: Result<Effective, ConfigError>) -> Result<(), Failure> {
    match loaded {
        Ok(_) => output::json(&json!({ "ok": true, "mistakes": [] })),
        Err(ConfigError::Mistakes(mistakes)) => {
            output::json(&json!({ "ok": false, "mistakes": mistakes }))?;
            Err(Failure::wrong_usage_already_reported())
        }
        Err(other) => Err(other.into()),
    }
}
