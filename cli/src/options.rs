//! The command line: the options all commands share.

use std::path::PathBuf;
use std::time::Duration;

use clap::{ArgAction, ArgMatches, Args, Command as Clap, CommandFactory, FromArgMatches, Parser};
use fipa::Config;
use fipa::config::{ConfigError, Effective, Sources};
use tokio::runtime::Runtime;

use crate::command::Command;
use crate::report::Failure;

/// Agents that exchange letters, to the FIPA standards: through shared memory on one host, through
/// a gateway between hosts.
///
/// Every command finds its configuration by itself: the file given with --config, else the one
/// named by $FIPA_CONFIG, else ./fipa.toml, else ~/.config/fipa/fipa.toml, else the defaults.
#[derive(Debug, Parser)]
#[command(
    name = "fipa",
    version,
    after_help = EXIT_CODES,
    subcommand_required = true,
    arg_required_else_help = true
)]
pub(crate) struct CommandLine {
    #[command(flatten)]
    pub(crate) global: Global,
    #[command(subcommand)]
    pub(crate) command: Command,
}

impl CommandLine {
    /// What this process was told; ends it when that is wrong, or help was asked for.
    ///
    /// The global options may stand before and behind the command. They are defined at every
    /// level and put together here, because those that clap calls global forget what stood
    /// before the command when they are given behind it too.
    pub(crate) fn read() -> Self {
        let matches = with_global_options(Self::command()).get_matches();
        let read = || {
            let mut line = Self::from_arg_matches(&matches)?;
            line.global = Global::of(&matches)?;
            Ok(line)
        };
        read().unwrap_or_else(|error: clap::Error| error.exit())
    }
}

fn with_global_options(command: Clap) -> Clap {
    command.mut_subcommands(|command| with_global_options(Global::augment_args(command)))
}

const EXIT_CODES: &str = "\
Exit codes:
  0  done
  1  failed, as reported on standard error
  2  wrong usage: of the command line, or mistakes in the configuration

Environment:
  FIPA_CONFIG  the configuration file, unless --config is given
  RUST_LOG     what is logged to standard error, for example fipa_mts=debug; goes before -v and -q";

// Options that every command takes. A documentation comment would be taken for the help of every
// command.
#[derive(Debug, Args)]
pub(crate) struct Global {
    /// Read this configuration file, and no other
    #[arg(long, value_name = "FILE", help_heading = "Global options")]
    config: Option<PathBuf>,

    /// Override a key of the configuration, for example mts.deadline=9s; may be repeated
    #[arg(long, value_name = "KEY=VALUE", help_heading = "Global options")]
    set: Vec<String>,

    /// Log more: once for what happens, twice for why, three times for every step
    #[arg(short, long, action = ArgAction::Count, conflicts_with = "quiet",
          help_heading = "Global options")]
    verbose: u8,

    /// Log errors only
    #[arg(short, long, help_heading = "Global options")]
    quiet: bool,
}

impl Global {
    /// Those of a command and of the commands within it: what can be given again adds up, of
    /// several files the last counts.
    fn of(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let mut all = Self::from_arg_matches(matches)?;
        if let Some((_, matches)) = matches.subcommand() {
            let within = Self::of(matches)?;
            all.config = within.config.or(all.config);
            all.set.extend(within.set);
            all.verbose = all.verbose.saturating_add(within.verbose);
            all.quiet |= within.quiet;
        }
        Ok(all)
    }

    /// What is logged unless `$RUST_LOG` says otherwise.
    pub(crate) fn log_level(&self) -> &'static str {
        match (self.quiet, self.verbose) {
            (true, _) => "error",
            (false, 0) => "warn",
            (false, 1) => "info",
            (false, 2) => "debug",
            (false, _) => "trace",
        }
    }

    /// The configuration.
    pub(crate) fn config(&self) -> Result<Config, Failure> {
        Ok(self.effective()?.into_config())
    }

    /// The configuration, with the origin of every value.
    pub(crate) fn effective(&self) -> Result<Effective, ConfigError> {
        Effective::load(&Sources {
            file: self.config.clone(),
            set: self.set.clone(),
            ..Sources::from_environment()
        })
    }
}

/// A time such as 10s.
pub(crate) fn duration(text: &str) -> Result<Duration, String> {
    let duration = humantime::parse_duration(text);
    duration.map_err(|_| "use a time such as 10s, 500ms or 2h".to_owned())
}

/// How long threads have to end that are still blocked when everything else has been done.
const BLOCKED: Duration = Duration::from_secs(3);

/// Runs what waits, to its end. A thread that is blocked all the same, in looking up a name that
/// nobody answers for, or in reading standard input, ends with the process.
pub(crate) fn block_on<T>(work: impl Future<Output = T>) -> Result<T, Failure> {
    let runtime = Runtime::new().map_err(|error| {
        Failure::failed(
            format!("cannot start the threads that do the work: {error}"),
            "this process",
            "see `ulimit -u` and `ulimit -n`",
        )
    })?;
    let done = runtime.block_on(work);
    runtime.shutdown_timeout(BLOCKED);
    Ok(done)
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use super::*;

    #[test]
    fn a_thread_that_is_blocked_is_not_waited_for() {
        let (release, blocked) = channel::<()>();
        let (done, finished) = channel();
        std::thread::spawn(move || {
            let ran = block_on(async {
                tokio::task::spawn_blocking(move || blocked.recv());
            });
            done.send(ran.is_ok())
        });
        let ran = finished.recv_timeout(Duration::from_secs(60));
        assert_eq!(ran, Ok(true));
        drop(release);
    }
}
