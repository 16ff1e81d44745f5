//! `fipa config`: the configuration that counts, and whether it has mistakes.

use std::path::Path;

use clap::{Args, Subcommand};
use fipa::config::{ConfigError, Effective};
use serde_json::json;

use crate::options::Global;
use crate::output;
use crate::report::Failure;

/// Show the configuration that counts, or check it for mistakes
///
/// The configuration is one TOML file. The first of these counts, and no other is read: the one
/// given with --config, the one named by $FIPA_CONFIG, ./fipa.toml, ~/.config/fipa/fipa.toml. What
/// it does not say has its default, and --set KEY=VALUE overrides single keys.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa config show                          what counts here, and where it comes from
  fipa config show > new.toml               a file to start from
  fipa --set mts.deadline=9s config show    what an override does
  fipa config check --config robot.toml     whether a file has mistakes")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Print the configuration that counts, with the origin of every value
    ///
    /// What is printed is a configuration file itself that says the same: every key, followed by
    /// where its value comes from, `# default`, `# fipa.toml:12` (file and line) or `# --set`.
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
                            | { \"from\": \"set\", \"assignment\": \"key=value\" } } ] }")]
    Show(Json),

    /// Say whether the configuration has mistakes, and where
    ///
    /// Names every mistake with file, line and key, and says what is allowed there. The exit code is
    /// 0 when there is none and 2 otherwise, so that a script can check a file before a robot is
    /// started with it.
    #[command(after_help = "\
Examples:
  fipa config check
  fipa config check --config robot.toml
  fipa config check --set mts.transports=tcp

JSON:
  { \"ok\": true or false,
    \"mistakes\": [ { \"what\": text, \"help\": text,
                    \"place\": an origin as in `fipa config show` } ] }
  A file that cannot be read is an error as without --json.")]
    Check(Json),
}

#[derive(Debug, Args)]
struct Json {
    /// Print JSON
    #[arg(long)]
    json: bool,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    match arguments.action {
        Action::Show(Json { json }) => show(&global.effective()?, json),
        Action::Check(Json { json: false }) => check(&global.effective()?),
        Action::Check(Json { json: true }) => check_json(global.effective()),
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
        None => "no file, only defaults".into(),
    };
    output::text(&format!("no mistakes: {checked}\n"))
}

/// The mistakes are what was asked for, so they go to standard output and nowhere else.
fn check_json(loaded: Result<Effective, ConfigError>) -> Result<(), Failure> {
    match loaded {
        Ok(_) => output::json(&json!({ "ok": true, "mistakes": [] })),
        Err(ConfigError::Mistakes(mistakes)) => {
            output::json(&json!({ "ok": false, "mistakes": mistakes }))?;
            Err(Failure::wrong_usage_already_told())
        }
        Err(other) => Err(other.into()),
    }
}
