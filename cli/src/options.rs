//! The command line: the options all commands share.

use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use bytesize::ByteSize;
use clap::error::{ContextKind, ContextValue, ErrorKind};
use clap::{
    ArgAction, ArgMatches, Args, Command as Clap, CommandFactory, FromArgMatches, Parser, ValueHint,
};
use fipa::Config;
use fipa::config::{ConfigError, Effective, Sources};
use fipa::error::ErrorChain;
use fipa::threads;
use fipa_acl::escape_name;
use tokio::runtime;

use crate::command::Command;
use crate::complete;
use crate::log::LogFormat;
use crate::report::{self, Failure};

/// Agent communication to the FIPA standards: through shared memory or Unix domain sockets on one
/// host, through gateways between hosts.
///
/// Every command reads one configuration file: the file given with --config, else the file named by
/// $FIPA_CONFIG, else ./fipa.toml, else ~/.config/fipa/fipa.toml, else /etc/fipa/fipa.toml. Without a file
/// the defaults apply.
/// A domain belongs to one user, or to the members of a group (key `group`).
#[derive(Debug, Parser)]
#[command(
    name = "fipa",
    version,
    after_help = AFTER_HELP,
    subcommand_required = true,
    arg_required_else_help = true
)]
pub(crate) struct CommandLine {
    #[command(flatten)]
    pub(crate) global: Global,
    #[command(subcommand)]
    pub(crate) command: Command,
}

/// Returns the tip for a command with the name of an agent or a topic where it needs both.
pub(crate) type TopicTip = fn(&str, &Sources) -> Option<String>;

impl CommandLine {
    /// Parses the command line of this process. Ends the process after printing an error or the help.
    ///
    /// The global options are accepted before and after the command. They are defined at every level
    /// and merged here, because clap's own global options lose the value given before the command
    /// when the option is also given after it.
    pub(crate) fn read(publisher_of: TopicTip) -> Self {
        let matches = command().try_get_matches();
        let matches = matches.unwrap_or_else(|error| {
            let arguments: Vec<_> = std::env::args_os()
                .map(|it| it.to_string_lossy().into_owned())
                .collect();
            report::usage(&with_topic(
                with_meant_command(error),
                &arguments,
                publisher_of,
            ))
        });
        let read = || {
            let mut line = Self::from_arg_matches(&matches)?;
            line.global = Global::of(&matches)?;
            Ok(line)
        };
        read().unwrap_or_else(|error: clap::Error| report::usage(&error))
    }
}

/// Names the command that has another name in other tools, instead of one that is spelled alike.
fn with_meant_command(mut error: clap::Error) -> clap::Error {
    let word = match error.get(ContextKind::InvalidSubcommand) {
        Some(ContextValue::String(word)) => word.as_str(),
        _ => return error,
    };
    let meant: &[&str] = match word {
        "topic" => &["topics", "publish", "subscribe"],
        "pub" => &["publish"],
        "sub" => &["subscribe"],
        "list" | "ls" | "ps" | "node" | "nodes" | "info" | "status" => &["agents"],
        "hz" | "bw" => &["subscribe", "topics"],
        "service" | "services" | "call" => &["request", "actions", "df"],
        "action" => &["actions"],
        "param" | "params" | "set" => &["config"],
        "record" | "bag" | "log" | "monitor" => &["watch"],
        "start" | "run" | "launch" | "daemon" | "gateway" | "serve" => &["up"],
        _ => return error,
    };
    let tip = match word {
        "hz" | "bw" => Some("fipa subscribe NAME TOPIC --rate measures the rate of a topic"),
        "bag" => Some(
            "fipa record -o FILE records letters and topics, and fipa replay FILE replays them",
        ),
        "service" | "services" | "call" => Some(
            "fipa request NAME CONTENT calls an agent, and fipa actions lists the actions of robots",
        ),
        _ => None,
    };
    let meant = meant.iter().map(|command| (*command).to_owned()).collect();
    if let Some(tip) = tip {
        let tips = ContextValue::StyledStrs(vec![tip.into()]);
        error.insert(ContextKind::Suggested, tips);
    }
    error.insert(
        ContextKind::SuggestedSubcommand,
        ContextValue::Strings(meant),
    );
    error
}

/// Splits the path of a topic of ROS, where `fipa subscribe` has two arguments. Names the agent that publishes a topic
/// if only the topic is given.
fn with_topic(mut error: clap::Error, arguments: &[String], publisher_of: TopicTip) -> clap::Error {
    if error.kind() == ErrorKind::MissingRequiredArgument
        && let Some(at) = arguments.iter().position(|it| it == "subscribe")
        && let Some(name) = arguments.get(at + 1)
        && let Some(tip) = missing_topic(name, publisher_of)
    {
        let tips = ContextValue::StyledStrs(vec![tip.into()]);
        error.insert(ContextKind::Suggested, tips);
    }
    error
}

/// The tip for `fipa subscribe` with this argument alone.
fn missing_topic(name: &str, publisher_of: TopicTip) -> Option<String> {
    match of_publisher(name) {
        Some((publisher, topic)) => Some(format!(
            "the agent and the topic are two arguments: fipa subscribe {publisher} {topic}"
        )),
        None => publisher_of(name, &complete::sources(std::env::args_os())),
    }
}

/// Reads the name of an agent as the path of a topic in ROS: the agent and its topic.
pub(crate) fn of_publisher(name: &str) -> Option<(Cow<'_, str>, Cow<'_, str>)> {
    let (agent, topic) = name.trim_start_matches('/').split_once('/')?;
    let is_given = !agent.is_empty() && !topic.is_empty();
    is_given.then(|| (escape_name(agent), escape_name(topic)))
}

/// Builds the command line with its global options.
pub(crate) fn command() -> Clap {
    with_global_options(CommandLine::command())
}

fn with_global_options(command: Clap) -> Clap {
    command.mut_subcommands(|command| with_global_options(Global::augment_args(command)))
}

const AFTER_HELP: &str = "\
For users of ROS 2:
  node list -> fipa agents       topic echo -> fipa subscribe
  topic list -> fipa topics      topic hz -> fipa subscribe --rate

Exit codes:
  0  success
  1  failure; standard error has the reason
  2  usage error: invalid command line or invalid configuration
  `fipa lock` has further ones.

Environment:
  FIPA_CONFIG       configuration file, unless --config is given
  FIPA_DOMAIN       domain, unless --set domain=NAME is given; overrides the file
  FIPA_RUNTIME_DIR  directory in which the processes of a domain meet; default: runtime_dir of the file, else
                    /tmp/fipa-<user id>
  FIPA_STATE_DIR    directory of the state of `fipa own`; default: ~/.local/state/fipa
  RUST_LOG          log filter, for example fipa_mts=debug; overrides -v and -q
  FIPA_LOG_FORMAT   format of the log, text or json; --log-format overrides it
  NO_COLOR          when set, the output has no colors

Examples:
  fipa demo                                 shows the main functions with real processes
  fipa echo arm_1                           runs an agent that answers
  fipa send --to arm_1 --content hello --wait
  fipa doctor                               checks this machine";

// Options of every command. Not a doc comment: clap would print it as the help of every command.
#[derive(Debug, Args)]
pub(crate) struct Global {
    /// Read this configuration file and no other
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, help_heading = "Global options")]
    config: Option<PathBuf>,

    /// Override one configuration key, for example mts.deadline=9s; repeatable
    #[arg(long, value_name = "KEY=VALUE", add = complete::keys(), help_heading = "Global options")]
    set: Vec<String>,

    /// Log more: -v logs events, -vv debug details, -vvv every step
    #[arg(short, long, action = ArgAction::Count, conflicts_with = "quiet",
          help_heading = "Global options")]
    verbose: u8,

    /// Log only errors
    #[arg(short, long, help_heading = "Global options")]
    quiet: bool,

    /// Format of the log on standard error [default: text]
    #[arg(
        long,
        value_name = "FORMAT",
        help_heading = "Global options",
        hide_possible_values = true,
        long_help = "Format of the log on standard error: text, or json for one object per line [default: text]"
    )]
    pub(crate) log_format: Option<LogFormat>,
}

impl Global {
    /// Merges the options of a command with those of its subcommands: repeatable options add up; of
    /// several configuration files the last one is used.
    fn of(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let mut all = Self::from_arg_matches(matches)?;
        if let Some((_, matches)) = matches.subcommand() {
            let inner = Self::of(matches)?;
            all.config = inner.config.or(all.config);
            all.set.extend(inner.set);
            all.verbose = all.verbose.saturating_add(inner.verbose);
            all.quiet |= inner.quiet;
            all.log_format = inner.log_format.or(all.log_format);
        }
        Ok(all)
    }

    /// Default log filter; `$RUST_LOG` overrides it. The events of iceoryx2 contain the `Debug` text of its
    /// values; those that matter are part of the errors of the shared memory transport. Peers cause the
    /// warnings of rustls and quinn, which have no rate limit; what matters is in the errors of their connections.
    pub(crate) fn log_filter(&self) -> &'static str {
        match (self.quiet, self.verbose) {
            (true, _) => "error,iceoryx2_bb_loggers=off",
            (false, 0) => "warn,iceoryx2_bb_loggers=off,rustls=error,quinn=error,quinn_proto=error",
            (false, 1) => "info,iceoryx2_bb_loggers=off,rustls=error,quinn=error,quinn_proto=error",
            (false, 2) => "debug",
            (false, _) => "trace",
        }
    }

    /// Loads the configuration.
    pub(crate) fn config(&self) -> Result<Config, Failure> {
        Ok(self.effective()?.into_config())
    }

    /// Loads the configuration with the origin of every value.
    pub(crate) fn effective(&self) -> Result<Effective, ConfigError> {
        Effective::load(&self.sources())
    }

    /// Keeps the sources of the configuration for [`sources`].
    pub(crate) fn keep_sources(&self) {
        // Fails in a second call, which gives the same.
        let _ = SOURCES.set(self.sources());
    }

    /// The sources of the configuration.
    pub(crate) fn sources(&self) -> Sources {
        Sources {
            file: self.config.clone(),
            set: self.set.clone(),
            ..Sources::from_environment()
        }
    }
}

/// The sources of the configuration of this command.
static SOURCES: OnceLock<Sources> = OnceLock::new();

/// Returns the sources of the configuration of this command, from which it can be read again.
pub(crate) fn sources() -> Sources {
    SOURCES
        .get()
        .cloned()
        .unwrap_or_else(Sources::from_environment)
}

/// Parses a duration such as 10s.
pub(crate) fn duration(text: &str) -> Result<Duration, String> {
    let duration = humantime::parse_duration(text);
    duration.map_err(|_| "expected a duration such as 10s, 500ms or 2h".to_owned())
}

/// Parses a size such as 64KiB, or a number of bytes.
pub(crate) fn size(text: &str) -> Result<u64, String> {
    let size = text.parse::<ByteSize>().map(|size| size.as_u64());
    size.map_err(|_| "expected a size such as 100B, 64KiB or 1MiB".to_owned())
}

/// Waits for this time, the value of `--for`; without it, forever.
pub(crate) async fn after(time: Option<Duration>) {
    match time {
        Some(time) => tokio::time::sleep(time).await,
        None => std::future::pending().await,
    }
}

/// Maximum wait for blocked threads after the work has ended.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(3);

/// Runs a future to completion on a new runtime. A thread that is still blocked afterwards, for
/// example in a name lookup without an answer or in a read of standard input, ends with the process.
pub(crate) fn block_on<T>(work: impl Future<Output = T>) -> Result<T, Failure> {
    let failed = |error: &(dyn std::error::Error + 'static), help: &str| {
        let problem = format!("cannot start the worker threads: {}", ErrorChain(error));
        Failure::failed(problem, "this process", help)
    };
    let workers = workers();
    // The start of a runtime panics if the system refuses its threads.
    threads::check(workers).map_err(|error| {
        failed(
            &error,
            &format!("raise the limit that the message names; this command needs {workers} threads and some more"),
        )
    })?;
    let mut builder = runtime::Builder::new_multi_thread();
    let runtime = builder.worker_threads(workers).enable_all().build();
    let runtime =
        runtime.map_err(|error| failed(&error, "check the limit on open files: `ulimit -n`"))?;
    let done = runtime.block_on(work);
    let began = Instant::now();
    runtime.shutdown_timeout(SHUTDOWN_TIMEOUT);
    threads::wait(SHUTDOWN_TIMEOUT.saturating_sub(began.elapsed()));
    Ok(done)
}

/// The number of worker threads, which is that of tokio: `TOKIO_WORKER_THREADS`, or one per processor.
fn workers() -> usize {
    let given = std::env::var("TOKIO_WORKER_THREADS").ok();
    let given = given
        .and_then(|text| text.parse().ok())
        .filter(|it| *it > 0);
    given.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from))
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use super::*;

    #[test]
    fn a_size_is_a_number_of_bytes_or_has_a_unit() {
        for (text, bytes) in [
            ("1000", 1000),
            ("100B", 100),
            ("64KiB", 64 << 10),
            ("1 MiB", 1 << 20),
        ] {
            assert_eq!(size(text), Ok(bytes), "{text}");
        }
        for text in ["", "MiB", "-1", "1 parsec"] {
            assert!(size(text).is_err(), "{text}");
        }
    }

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
