//! `fipa bench`: the shell of the crate `fipa-bench`, which measures.

use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use bytesize::ByteSize;
use clap::{Args, ValueEnum};
use fipa::error::ErrorChain;
use fipa::{AgentId, Config, Incarnation, RegisterOptions};
use fipa_bench::{
    Baseline, BenchError, Changes, Comparison, Effort, Languages, LanguagesReport, Locks,
    LocksReport, Machine, Measurement, Paper, Peers, Program, Selection, Topics, TopicsReport,
};
use indicatif::{ProgressBar, ProgressStyle};

use crate::options::{self, Global};
use crate::report::{Failure, warn};
use crate::{membership, output};

/// Measure latency and throughput on this machine, compared with the raw mechanisms
///
/// Measures one-way latency, round trip, throughput and CPU time of every configured transport, for
/// content from 100 bytes to 4 MiB. Each transport is compared with its limit, which is measured in the
/// same rounds: raw iceoryx2, a raw Unix domain socket, or a raw relay. Gateways are also measured
/// with TCP over TLS and with QUIC, with temporary keys; their limits are relays of bare rustls and
/// of bare quinn. All traffic stays on this machine, and no
/// files are left.
///
/// `locks` measures an acquisition and release without contention, of groups of agents on one host and
/// through the gateways of two hosts, beside the same letters sent by hand between the same processes;
/// the hand-over from a holder to the next waiter; and the memory and idle load of 1,000 resources.
///
/// `topics` measures publications of 1 MB from one process to 1, 4 and 16 subscribers, beside raw iceoryx2
/// publish-subscribe, and beside the shared memory of zenoh with --zenoh. All processes sleep between two
/// publications.
///
/// `languages` measures messages that are answered, between two processes in Rust, in Python and in both, beside
/// the pipes and the shared memory of multiprocessing, zenoh, iceoryx2 and rclpy, if --python can import them.
///
/// On a busy machine the times are unreliable; the ratios are less affected.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa bench
  fipa bench shm --quick
  fipa bench net --json | jq '.rows[] | {path, size, p50: .one_way_us.p50, ratio}'
  fipa bench --svg latency.svg
  fipa bench --json > before.json; fipa bench --baseline before.json
  fipa bench --zenoh benches/comparison/zenoh/target/release/fipa-comparison-zenoh
  fipa bench paper --dir docs
  fipa bench locks --quick
  fipa bench locks --agents 2,16 --json | jq '.rows[] | {algorithm, agents, hosts, letters, ratio}'
  fipa bench topics --zenoh benches/comparison/zenoh/target/release/fipa-comparison-zenoh
  fipa bench topics --json | jq '.rows[] | {subscribers, fipa_us, ratio}'
  fipa bench languages --python venv/bin/python
  fipa bench languages --sizes 1KiB --json | jq '.rows[] | {mechanism, round_trip_us, ratio}'
  fipa bench peers --jade http://127.0.0.1:7777/acc --jade-asker http://127.0.0.1:7776/acc")]
pub(crate) struct Arguments {
    /// Part to measure [default: shm and net]
    #[arg(value_enum)]
    what: Option<What>,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    /// Also draw the times to this file: latency over content size, or those of `locks`
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Compare with the JSON output of an earlier run
    ///
    /// Prints the ratios to the limits that changed beyond the spread of both runs. The exit code is
    /// 1 if one has risen.
    #[arg(long, value_name = "FILE")]
    baseline: Option<PathBuf>,
    /// Take fewer samples: a few seconds, with a larger spread
    #[arg(long)]
    quick: bool,
    /// Content sizes; not used by `paper`, `locks` and `topics` [default: 100B,1KiB,64KiB,1MiB,4MiB; for
    /// `languages` 1KiB,1MiB]
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "SIZE",
        value_parser = options::size,
    )]
    sizes: Vec<u64>,
    /// Numbers of agents that share a resource, for `locks` [default: 2,8,32; with --quick 2,8]
    #[arg(long, value_delimiter = ',', value_name = "N")]
    agents: Vec<usize>,
    /// Directory for the tables and drawings of `paper` [default: docs]
    #[arg(long, value_name = "DIRECTORY")]
    dir: Option<PathBuf>,
    /// Also measure zenoh in the same rounds, with this program (see benches/comparison/zenoh)
    #[arg(long, value_name = "PROGRAM")]
    zenoh: Option<PathBuf>,
    /// Interpreter of Python that has the package `fipa`, for `languages` [default: python3]
    #[arg(long, value_name = "PROGRAM")]
    python: Option<PathBuf>,
    /// Address of the JADE platform that runs the agent of --echo, for `peers`
    ///
    /// `peers` measures conversations of 100 bytes in a row with that agent, through the gateway of this
    /// host (`fipa up` with the transport http). benches/comparison/jade has the agents for JADE.
    #[arg(long, value_name = "ADDRESS", value_parser = membership::address)]
    jade: Option<String>,
    /// Address of a second JADE platform, whose agent --asker asks the same agent in turn
    #[arg(long, value_name = "ADDRESS", requires = "jade", value_parser = membership::address)]
    jade_asker: Option<String>,
    /// Name of the echo agent of JADE
    #[arg(long, value_name = "NAME", default_value = "echo@jade")]
    echo: AgentId,
    /// Name of the asking agent of JADE
    #[arg(long, value_name = "NAME", default_value = "ask@asker")]
    asker: AgentId,
    /// Number of conversations of `peers`
    #[arg(long, value_name = "N", default_value_t = Peers::CONVERSATIONS)]
    conversations: usize,
    /// Run as a process of a measurement
    #[arg(long, hide = true)]
    part: Option<String>,
    /// Run on this CPU
    #[arg(long, hide = true, requires = "part")]
    core: Option<usize>,
}

/// Content sizes of `shm` and `net` if none are given.
const SIZES: [u64; 5] = [100, 1 << 10, 64 << 10, 1 << 20, 4 << 20];

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum What {
    /// Shared memory between two agents on one host
    Shm,
    /// Sockets between two agents, directly and through two gateways
    Net,
    /// Encodings, as in the paper about the C++ libraries; writes tables and drawings
    Paper,
    /// Conversations with an agent of a JADE platform, beside those of another JADE platform
    Peers,
    /// Locks of up to 32 agents, beside the same letters sent by hand
    Locks,
    /// Publications of 1 MB for up to 16 subscribers, beside raw iceoryx2 and zenoh
    Topics,
    /// Answered messages between Rust and Python, beside multiprocessing, zenoh, iceoryx2 and rclpy
    Languages,
}

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    if let Some(part) = &arguments.part {
        let played = fipa_bench::play(part, arguments.core, &config);
        let advice = "see the report of the measurement";
        return played.map_err(|error| {
            Failure::failed(error.to_string(), "a process of fipa bench", advice)
        });
    }
    match (arguments.what, &arguments.jade) {
        (what, _) if what != Some(What::Locks) && !arguments.agents.is_empty() => {
            return Err(Failure::wrong_usage(
                "--agents is only for `fipa bench locks`",
                "--agents",
                "omit --agents, or measure `locks`",
            ));
        }
        (what, _) if what != Some(What::Languages) && arguments.python.is_some() => {
            return Err(Failure::wrong_usage(
                "--python is only for `fipa bench languages`",
                "--python",
                "omit --python, or measure `languages`",
            ));
        }
        (Some(What::Paper), _) => return measure_paper(&arguments),
        (Some(What::Topics), None) => return measure_topics(&arguments),
        (Some(What::Languages), None) => return measure_languages(&arguments),
        (Some(What::Peers), Some(jade)) => return measure_peers(&arguments, jade, &config),
        (Some(What::Peers), None) => {
            return Err(Failure::wrong_usage(
                "`fipa bench peers` needs the address of a JADE platform",
                "--jade",
                "add --jade http://HOST:PORT/acc, as JADE prints it",
            ));
        }
        (_, Some(_)) => {
            return Err(Failure::wrong_usage(
                "--jade is only for `fipa bench peers`",
                "--jade",
                "omit --jade, or measure `peers`",
            ));
        }
        _ => {}
    }
    if arguments.dir.is_some() {
        return Err(Failure::wrong_usage(
            "--dir is only for `fipa bench paper`",
            "--dir",
            "omit --dir, or use --svg FILE for a drawing",
        ));
    }
    // Read first: a wrong file is reported before the measurement.
    let baseline = arguments.baseline.as_deref().map(Baseline::read);
    let baseline = baseline.transpose().map_err(failed)?;
    if arguments.what == Some(What::Locks) {
        return measure_locks(&arguments, baseline);
    }
    let mut comparison = Comparison::new(
        config.mts.transports.clone(),
        effort(&arguments, &SIZES)?,
        this_program()?,
    );
    comparison.selection = match arguments.what {
        Some(What::Shm) => Selection::Shm,
        Some(What::Net) => Selection::Net,
        _ => Selection::All,
    };
    comparison.zenoh = arguments.zenoh.as_deref().map(program).transpose()?;
    let measurement = membership::run(measure(comparison))?;
    report(
        &arguments,
        baseline,
        Measured {
            notes: measurement.notes(),
            svg: &|| measurement.to_svg(),
            compare: &|baseline| measurement.compare(baseline),
            json: &|| measurement.to_json(),
            text: &|| measurement.to_text(),
        },
    )
}

/// A result with rows that can be drawn and compared.
struct Measured<'a> {
    notes: &'a [String],
    svg: &'a dyn Fn() -> String,
    compare: &'a dyn Fn(&Baseline) -> Changes,
    json: &'a dyn Fn() -> serde_json::Value,
    text: &'a dyn Fn() -> String,
}

/// Writes a result, and the changes since an earlier one.
fn report(
    arguments: &Arguments,
    baseline: Option<Baseline>,
    measured: Measured<'_>,
) -> Result<(), Failure> {
    for note in measured.notes {
        fipa::log_limit::info!("{note}");
    }
    if let Some(file) = &arguments.svg {
        let path = file.clone();
        let written = std::fs::write(file, (measured.svg)());
        written.map_err(|source| failed(BenchError::Write { path, source }))?;
    }
    let changes = baseline.map(|baseline| (measured.compare)(&baseline));
    if arguments.json {
        let mut report = (measured.json)();
        if let (Some(report), Some(changes)) = (report.as_object_mut(), &changes) {
            report.insert("changes".to_owned(), changes.to_json());
        }
        output::json(&report)?;
    } else {
        output::text(&(measured.text)())?;
        if let Some(changes) = &changes {
            output::text(&format!("\n{changes}"))?;
        }
    }
    match changes {
        Some(changes) if changes.compared() == 0 => Err(Failure::failed(
            "the runs have no measurement in common",
            "--baseline",
            "use a baseline with the same part, sizes, agents and transports",
        )),
        Some(changes) if changes.is_slower() => Err(Failure::already_reported()),
        _ => Ok(()),
    }
}

/// Measures locks.
fn measure_locks(arguments: &Arguments, baseline: Option<Baseline>) -> Result<(), Failure> {
    if arguments.zenoh.is_some() {
        return Err(Failure::wrong_usage(
            "`fipa bench locks` measures locks, and zenoh has none",
            "--zenoh",
            "omit --zenoh or `locks`",
        ));
    }
    let mut locks = match arguments.quick {
        true => Locks::quick(this_program()?),
        false => Locks::full(this_program()?),
    };
    if !arguments.agents.is_empty() {
        locks.agents.clone_from(&arguments.agents);
    }
    let measured: LocksReport = membership::run(async {
        let machine = observe().await;
        let progress = Progress::new(locks.steps());
        let measured = locks.run(machine, |step| progress.begin(step)).await;
        progress.end();
        measured.map_err(|error| match error {
            BenchError::Agents(_) => {
                let advice = format!("use 2 to {} agents", Locks::MAX_AGENTS);
                Failure::wrong_usage(error.to_string(), "--agents", advice)
            }
            other => failed(other),
        })
    })?;
    report(
        arguments,
        baseline,
        Measured {
            notes: measured.notes(),
            svg: &|| measured.to_svg(),
            compare: &|baseline| measured.compare(baseline),
            json: &|| measured.to_json(),
            text: &|| measured.to_text(),
        },
    )
}

/// Measures publications for several subscribers.
fn measure_topics(arguments: &Arguments) -> Result<(), Failure> {
    let options = [
        ("--svg", arguments.svg.is_some()),
        ("--baseline", arguments.baseline.is_some()),
        ("--dir", arguments.dir.is_some()),
    ];
    refuse("topics", options)?;
    let mut topics = match arguments.quick {
        true => Topics::quick(this_program()?),
        false => Topics::full(this_program()?),
    };
    topics.zenoh = arguments.zenoh.as_deref().map(program).transpose()?;
    let measured: TopicsReport = membership::run(async {
        let machine = observe().await;
        let progress = Progress::new(topics.steps());
        let measured = topics.run(machine, |step| progress.begin(step)).await;
        progress.end();
        measured.map_err(failed)
    })?;
    show_notes(measured.notes());
    match arguments.json {
        true => output::json(&measured.to_json()),
        false => output::text(&measured.to_text()),
    }
}

/// Logs what was not measured.
fn show_notes(notes: &[String]) {
    for note in notes {
        fipa::log_limit::info!("{note}");
    }
}

/// Measures messages that are answered between Rust and Python.
fn measure_languages(arguments: &Arguments) -> Result<(), Failure> {
    let options = [
        ("--svg", arguments.svg.is_some()),
        ("--baseline", arguments.baseline.is_some()),
        ("--dir", arguments.dir.is_some()),
        ("--zenoh", arguments.zenoh.is_some()),
    ];
    refuse("languages", options)?;
    let effort = effort(arguments, &[1 << 10, 1 << 20])?;
    let mut languages = Languages::new(this_program()?, effort);
    if let Some(python) = &arguments.python {
        languages.python = interpreter(python);
    }
    let measured: LanguagesReport = membership::run(async {
        let machine = observe().await;
        let progress = Progress::new(languages.steps());
        let measured = languages.run(machine, |step| progress.begin(step)).await;
        progress.end();
        measured.map_err(failed)
    })?;
    show_notes(measured.notes());
    match arguments.json {
        true => output::json(&measured.to_json()),
        false => output::text(&measured.to_text()),
    }
}

/// The absolute path of an interpreter, whose processes run in another directory, or its name if it has no path. The
/// interpreter of a virtual environment is a link, which is not followed.
fn interpreter(given: &Path) -> PathBuf {
    match given.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => {
            std::path::absolute(given).unwrap_or_else(|_| given.to_owned())
        }
        _ => given.to_owned(),
    }
}

/// Refuses the first option that is given, which a part does not have.
fn refuse<const N: usize>(part: &str, options: [(&str, bool); N]) -> Result<(), Failure> {
    match options.into_iter().find(|(_, is_given)| *is_given) {
        None => Ok(()),
        Some((option, _)) => Err(Failure::wrong_usage(
            format!("`fipa bench {part}` has no {option}"),
            option,
            format!("omit {option} or `{part}`"),
        )),
    }
}

async fn measure(comparison: Comparison) -> Result<Measurement, Failure> {
    let machine = observe().await;
    let progress = Progress::new(comparison.steps());
    let measured = comparison.run(machine, |step| progress.begin(step));
    let measured = measured.await;
    progress.end();
    measured.map_err(failed)
}

/// Measures conversations with an agent of a JADE platform.
fn measure_peers(arguments: &Arguments, jade: &str, config: &Config) -> Result<(), Failure> {
    let at = |id: &AgentId, address: &str| {
        let id = id.clone().with_address(address);
        id.map_err(|error| {
            Failure::wrong_usage(error.to_string(), address.to_owned(), "change the address")
        })
    };
    let mut peers = Peers::new(at(&arguments.echo, jade)?);
    peers.conversations = arguments.conversations;
    if let Some(address) = &arguments.jade_asker {
        peers.asker = Some(at(&arguments.asker, address)?);
    }
    let report = membership::run(async {
        observe().await;
        let domain = membership::join(config).await?;
        let name = format!("fipa-bench-{}", Incarnation::random());
        let options = RegisterOptions::default();
        let agent = membership::register(&domain, &name, options, config).await?;
        let gateway = membership::gateway(&domain).ok_or_else(membership::no_gateway)?;
        let progress = Progress::new(Peers::STEPS);
        let report = peers.measure(&agent, &gateway, |step| progress.begin(step));
        let report = report.await;
        progress.end();
        drop(agent);
        domain.close().await;
        report.map_err(failed)
    })?;
    match arguments.json {
        true => output::json(&report)?,
        false => output::text(&report.to_text())?,
    }
    match report.is_complete() {
        true => Ok(()),
        false => Err(Failure::already_reported()),
    }
}

/// Repeats the evaluation of the paper.
fn measure_paper(arguments: &Arguments) -> Result<(), Failure> {
    if arguments.svg.is_some() {
        return Err(Failure::wrong_usage(
            "`fipa bench paper` has no --svg: it always writes its drawings",
            "--svg",
            "omit --svg, and give the directory of the drawings with --dir",
        ));
    }
    if arguments.baseline.is_some() {
        return Err(Failure::wrong_usage(
            "`fipa bench paper` has no --baseline",
            "--baseline",
            "omit --baseline or `paper`",
        ));
    }
    if arguments.zenoh.is_some() {
        return Err(Failure::wrong_usage(
            "`fipa bench paper` measures encodings, and zenoh has none",
            "--zenoh",
            "omit --zenoh or `paper`",
        ));
    }
    let directory = arguments.dir.as_deref().unwrap_or(Path::new("docs"));
    if !directory.is_dir() {
        return Err(Failure::wrong_usage(
            format!("{} is not a directory", directory.display()),
            "--dir",
            "give an existing directory, or run the command in the source directory",
        ));
    }
    let cycles = if arguments.quick {
        Paper::QUICK_CYCLES
    } else {
        Paper::CYCLES
    };
    let paper = membership::run(async {
        let machine = observe().await;
        let progress = Progress::new(Paper::STEPS);
        let paper = Paper::measure(machine, cycles, |step| progress.begin(step)).await;
        progress.end();
        paper.map_err(failed)
    })?;
    paper.write(directory).map_err(failed)?;
    if arguments.json {
        return output::json(&paper);
    }
    output::text(&paper.to_text())
}

/// Observes the machine and warns of conditions that spoil a measurement.
async fn observe() -> Machine {
    let machine = Machine::observe().await;
    for warning in machine.warnings() {
        warn(&warning);
    }
    machine
}

fn failed(error: BenchError) -> Failure {
    let place = match &error {
        BenchError::Write { path, .. }
        | BenchError::Read { path, .. }
        | BenchError::Baseline { path, .. } => path.display().to_string(),
        BenchError::Interpreter { .. } | BenchError::Package { .. } => "--python".to_owned(),
        _ => "fipa bench".to_owned(),
    };
    let advice = match &error {
        BenchError::Prepare(_) => "check that this user can write to $TMPDIR",
        BenchError::NothingMeasured(_) => {
            "check mts.transports (`fipa config show`), and run the command with -v for the logs"
        }
        BenchError::Peer { .. } => {
            "check that JADE runs with the agents of benches/comparison/jade, and the gateway with http"
        }
        BenchError::Interpreter { .. } => "give the interpreter with --python PROGRAM",
        BenchError::Package { .. } => "install the package for that interpreter: pip install fipa",
        BenchError::Read { .. } => "check the name of the file",
        BenchError::Baseline { .. } => "make a baseline with `fipa bench --json > FILE`",
        BenchError::Write { .. } => "check that this user can write there",
        _ => "report it as a bug of fipa, with this text",
    };
    Failure::failed(ErrorChain(&error).to_string(), place, advice)
}

/// The extent with the given sizes or, if none are given, with these.
fn effort(arguments: &Arguments, otherwise: &[u64]) -> Result<Effort, Failure> {
    let sizes = match arguments.sizes.as_slice() {
        [] => otherwise,
        given => given,
    };
    let sizes = sizes.iter().copied();
    let effort = if arguments.quick {
        Effort::quick(sizes)
    } else {
        Effort::full(sizes)
    };
    effort.map_err(|error| {
        let what = match &error {
            BenchError::Size(size) => format!("cannot measure content of {}", ByteSize(*size)),
            other => other.to_string(),
        };
        let most = ByteSize(Effort::MAX_SIZE);
        Failure::wrong_usage(what, "--sizes", format!("use 1 byte to {most}"))
    })
}

/// Returns this program, which also runs as the processes of a measurement.
fn this_program() -> Result<Program, Failure> {
    let path = std::env::current_exe().map_err(|error| {
        let advice = "check that /proc is mounted and the command was not removed";
        Failure::failed(error.to_string(), "/proc/self/exe", advice)
    })?;
    Ok(Program {
        path,
        arguments: vec!["bench".to_owned()],
    })
}

/// A bar that is not drawn when standard error is no terminal.
struct Progress {
    bar: ProgressBar,
    /// Time and number of the first step that measures.
    first: Cell<Option<(Instant, u64)>>,
}

impl Progress {
    fn new(steps: usize) -> Self {
        let bar = ProgressBar::new(steps as u64);
        let style = ProgressStyle::with_template("{bar:30} {elapsed}, {msg}");
        bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        bar.enable_steady_tick(Duration::from_millis(200));
        let first = Cell::default();
        Self { bar, first }
    }

    /// Shows that a step begins, and the time that is left. The estimate is the mean of the steps that measure:
    /// the starts of processes before them are short.
    fn begin(&self, step: &str) {
        self.bar.inc(1);
        if step.starts_with("starting ") {
            return self.bar.set_message(step.to_owned());
        }
        let (now, number) = (Instant::now(), self.bar.position());
        let (since, first) = self.first.get().unwrap_or((now, number));
        self.first.set(Some((since, first)));
        let steps = self.bar.length().unwrap_or(number);
        let left = time_left(now - since, number - first, steps + 1 - number.min(steps));
        let left = left.map(|left| format!("about {} left: ", output::time_span(left)));
        self.bar
            .set_message(format!("{}{step}", left.unwrap_or_default()));
    }

    fn end(&self) {
        self.bar.finish_and_clear();
    }
}

/// The time for the steps that are left if they take as long as those that are done, on average.
fn time_left(elapsed: Duration, done: u64, left: u64) -> Option<Duration> {
    let done = u32::try_from(done).ok().filter(|done| *done > 0)?;
    elapsed
        .checked_mul(u32::try_from(left).ok()?)?
        .checked_div(done)
}

/// The absolute path of a program, because its processes run in another directory.
fn program(given: &Path) -> Result<PathBuf, Failure> {
    given.canonicalize().map_err(|error| {
        Failure::wrong_usage(
            format!("cannot find {}: {error}", given.display()),
            "--zenoh",
            "build the program: cargo build --release --manifest-path benches/comparison/zenoh/Cargo.toml",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_left_is_that_of_steps_of_mean_length() {
        let elapsed = Duration::from_secs(30);
        assert_eq!(time_left(elapsed, 3, 12), Some(Duration::from_secs(120)));
        assert_eq!(time_left(elapsed, 3, 0), Some(Duration::ZERO));
        assert_eq!(time_left(elapsed, 0, 12), None);
    }
}
