//! `fipa record`: records the letters of this host, and works on recordings.

mod capture;
pub(super) mod file;
pub(super) mod fleet;
mod hosts;
mod locks;
mod note;
mod recorder;
pub(super) mod tools;
mod topics;

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::builder::{PathBufValueParser, TypedValueParser};
use clap::{Args, Subcommand};

use super::watch::filter::Filter;
use crate::options::{self, Global};
use crate::report::Failure;

/// Record the letters of this host to a file
///
/// Writes the letters of all processes of the domain on this host, with their content and their verdicts, to a file in
/// the format MCAP. The agents need no configuration for it and are not slowed down. If the disk is too slow, records
/// are lost; the file and the summary have their number. A letter between hosts can be recorded on both.
///
/// Every second, the letters so far are complete in the file: if the process is killed, they can be read. An existing
/// file is not overwritten.
///
/// Ctrl-C or SIGTERM ends the recording and prints a summary.
#[derive(Debug, Args)]
#[command(
    args_conflicts_with_subcommands = true,
    subcommand_negates_reqs = true,
    after_help = "\
Examples:
  fipa record -o run.mcap
  fipa record -o run.mcap --split-size 100MiB --keep 10       the newest GiB
  fipa record -o run.mcap --agent 'arm_.*' --content none
  fipa record -o run.mcap --topics 'camera/.*'
  fipa record fleet start run1                                on all hosts of the fleet
  fipa record merge run1.*.mcap -o all.mcap
  fipa record info run.mcap
  fipa record repair run.mcap -o repaired.mcap
  fipa record filter run.mcap -o arm.mcap --agent arm_1
  fipa record to-json run.mcap | jq -r 'select(.topic == \"/log\") | .message.message'
  fipa replay run.mcap --check

The channels of a file:
  /letters/RECEIVER       letters as `fipa watch --json` prints them; /letters after 256 receivers
  /letters/RECEIVER/raw   their bytes for `fipa decode`, if the whole content was recorded
  /events                 agents that appear and leave, hosts that are gone, later outcomes, violations,
                          locks, lost records
  /log                    violations, lost records, hosts that are gone, lost, refused and abandoned locks
                          as foxglove.Log
  /topics/AGENT/TOPIC     values of topics

JSON, one object on a line:
  { \"event\": \"recording\", \"domain\", \"file\", \"processes\": number of processes }
  { \"event\": \"summary\", \"seconds\", \"letters\", \"violations\", \"lost\", \"topic_values\",
    \"missed_topic_values\", \"bytes\", \"files\" }"
)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    tool: Option<Tool>,

    /// File to write
    #[arg(short, long, value_name = "FILE", required = true, value_parser = file_name())]
    output: Option<PathBuf>,

    #[command(flatten)]
    filter: Filter,

    /// Content to record: a number of bytes per message, none, or all, which is 24 KiB
    ///
    /// The length of longer content is recorded.
    #[arg(long, value_name = "BYTES|none|all", default_value = "all", value_parser = content)]
    content: usize,

    /// Record the values of these topics: a pattern for agent/topic, for example 'camera/.*'; repeatable
    ///
    /// The command subscribes to them as an agent and gets all values.
    #[arg(long, value_name = "PATTERN", value_parser = fipa::Matcher::parse)]
    topics: Vec<fipa::Matcher>,

    /// Directory with SCXML files of protocols, as for `fipa watch`
    #[arg(long, value_name = "DIR")]
    protocols: Option<PathBuf>,

    /// Time between two synchronizations with the disk: the most that is lost if the host fails
    #[arg(long, value_name = "TIME", default_value = "1s", value_parser = options::duration)]
    sync: Duration,

    /// Begin another file after about this size, for example 100MiB
    ///
    /// The files have a number before the extension: run_0000.mcap, run_0001.mcap and so on.
    #[arg(long, value_name = "SIZE", value_parser = options::size)]
    split_size: Option<u64>,

    /// Begin another file after this time, for example 10m
    #[arg(long, value_name = "TIME", value_parser = options::duration)]
    split_duration: Option<Duration>,

    /// Maximum number of files; the oldest is deleted, also one of an earlier recording with the same name
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    keep: Option<u32>,

    /// End after this time, for example 10s
    #[arg(long = "for", value_name = "TIME", value_parser = options::duration)]
    time: Option<Duration>,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,

    /// Write metadata from standard input, one JSON object on a line, and end with standard input: for `fipa up`
    #[arg(long, hide = true)]
    supervised: bool,
}

#[derive(Debug, Subcommand)]
enum Tool {
    #[command(subcommand)]
    Fleet(fleet::Command),
    Info(tools::info::Arguments),
    Merge(tools::merge::Arguments),
    Repair(tools::copy::Repair),
    Filter(Box<tools::copy::Filtered>),
    ToJson(Box<tools::to_json::Arguments>),
}

/// Parses the name of a file to write.
fn file_name() -> impl TypedValueParser<Value = PathBuf> {
    PathBufValueParser::new().try_map(|path| match path == Path::new("-") {
        true => Err("a recording is written to a file, not to standard output"),
        false => Ok(path),
    })
}

/// Parses an amount of content.
fn content(text: &str) -> Result<usize, String> {
    match text {
        "all" => Ok(usize::MAX),
        "none" => Ok(0),
        bytes => {
            let bytes = bytes.parse();
            bytes.map_err(|_| "expected a number of bytes such as 1024, none or all".to_owned())
        }
    }
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    match arguments.tool {
        Some(Tool::Fleet(command)) => fleet::run(&command, global),
        Some(Tool::Merge(arguments)) => tools::merge::run(&arguments),
        Some(Tool::Info(arguments)) => tools::info::run(&arguments),
        Some(Tool::Repair(arguments)) => tools::copy::repair(&arguments),
        Some(Tool::Filter(arguments)) => tools::copy::filter(&arguments),
        Some(Tool::ToJson(arguments)) => tools::to_json::run(&arguments),
        None => capture::run(&arguments, global),
    }
}
