//! `fipa bench`: how fast letters go here, beside what the bare mechanisms can do.
//!
//! Every way is a set of real processes: this command starts itself again as their ends, in a
//! place of their own, so that nothing of this user's domains is touched. They are all kept ready
//! and take turns, a few milliseconds each, so that whatever else the machine does hits a way and
//! what it is compared with alike.
//!
//! * [`way`] has the ways, [`part`] what a process of one does.
//! * [`stage`] starts, tells and ends the processes.
//! * [`measure`] takes the turns and makes rows of them; [`many`] does so with large content for
//!   many receivers.
//! * [`report`] and [`plot`] show them; [`machine`] says on what machine that was.
//! * [`paper`] is another measurement, of encodings, with [`bars`] to show it.

mod bars;
mod machine;
mod many;
mod measure;
mod paper;
mod part;
mod plot;
mod report;
mod stage;
mod way;

use std::path::{Path, PathBuf};
use std::time::Duration;

use bytesize::ByteSize;
use clap::{Args, ValueEnum};
use fipa::{Config, Kind};
use indicatif::{ProgressBar, ProgressStyle};

use self::machine::Machine;
use self::measure::{Effort, Measured};
use self::part::{Part, Socket, Wait};
use self::stage::Stage;
use self::way::{Sort, Way};
use crate::options::Global;
use crate::report::{Failure, warn};
use crate::{membership, output};

/// Measure latency and throughput on this machine, compared with the raw mechanisms
///
/// Measures one-way latency, round trip, throughput and CPU time of every configured transport, for
/// content from 100 bytes to 4 MB. Each transport is compared with its limit, which is measured in the
/// same rounds: raw iceoryx2, a raw Unix domain socket, or a raw relay. Gateways are also measured
/// with TCP over TLS and with QUIC, with temporary keys. All traffic stays on this machine, and no
/// files are left.
///
/// On a busy machine the times are unreliable; the ratios are less affected.
#[derive(Debug, Args)]
#[command(after_help = "\
Examples:
  fipa bench
  fipa bench shm --quick
  fipa bench net --json | jq '.rows[] | {path, size, p50: .one_way_us.p50, ratio}'
  fipa bench --svg latency.svg
  fipa bench --zenoh comparison/zenoh/target/release/fipa-comparison-zenoh
  fipa bench paper --dir docs")]
pub(crate) struct Arguments {
    /// Part to measure [default: shm and net]
    #[arg(value_enum)]
    what: Option<What>,
    /// Print JSON instead of a table
    #[arg(long)]
    json: bool,
    /// Also draw latency over content size to this file
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Take fewer samples: a few seconds, with a larger spread
    #[arg(long)]
    quick: bool,
    /// Content sizes; not used by `paper`
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "SIZE",
        value_parser = size,
        default_value = "100B,1KiB,64KiB,1MiB,4MiB"
    )]
    sizes: Vec<ByteSize>,
    /// Directory for the tables and drawings of `paper` [default: docs]
    #[arg(long, value_name = "DIRECTORY")]
    dir: Option<PathBuf>,
    /// Also measure zenoh in the same rounds, with this program (see comparison/zenoh)
    #[arg(long, value_name = "PROGRAM")]
    zenoh: Option<PathBuf>,
    /// Run as a process of a measurement
    #[arg(long, hide = true)]
    part: Option<String>,
    /// Run on this CPU
    #[arg(long, hide = true, requires = "part")]
    core: Option<usize>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum What {
    /// Shared memory between two agents on one host
    Shm,
    /// Sockets between two agents, directly and through two gateways
    Net,
    /// Encodings, as in the paper about the C++ libraries; writes tables and drawings
    Paper,
}

/// Largest content that can be asked for.
const MOST: u64 = 32 << 20;

pub(crate) fn run(arguments: Arguments, global: &Global) -> Result<(), Failure> {
    let config = global.config()?;
    if let Some(part) = &arguments.part {
        let kept = arguments.core.map_or(Ok(()), machine::keep_to);
        let part = serde_json::from_str::<Part>(part).map_err(|error| error.to_string());
        let played = kept.and(part).and_then(|part| part::play(part, &config));
        let advice = "see the report of the measurement";
        return played.map_err(|error| Failure::failed(error, "a process of fipa bench", advice));
    }
    if arguments.what == Some(What::Paper) {
        return again(&arguments);
    }
    if arguments.dir.is_some() {
        return Err(Failure::wrong_usage(
            "--dir is only for `fipa bench paper`",
            "--dir",
            "omit --dir, or use --svg FILE for a drawing",
        ));
    }
    let effort = effort(&arguments)?;
    let (machine, measured) = membership::run(measure(&arguments, &config, &effort))?;
    for note in &measured.notes {
        tracing::info!("{note}");
    }
    if measured.rows.is_empty() {
        return Err(Failure::failed(
            format!("every measurement failed: {}", measured.notes.join("; ")),
            "fipa bench",
            "check mts.transports (`fipa config show`), and run the command with -v for the logs",
        ));
    }
    if let Some(file) = &arguments.svg {
        draw(file, &machine, &measured)?;
    }
    if arguments.json {
        return output::json(&report::json(&machine, &effort, &measured));
    }
    output::text(&report::text(&machine, &effort, &measured))
}

/// The paper's evaluation again.
fn again(arguments: &Arguments) -> Result<(), Failure> {
    if arguments.svg.is_some() {
        return Err(Failure::wrong_usage(
            "`fipa bench paper` has no --svg: it always writes its drawings",
            "--svg",
            "omit --svg, and give the directory of the drawings with --dir",
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
    let paper = membership::run(async {
        let machine = Machine::look().await;
        for warning in machine.warnings() {
            warn(&warning);
        }
        let progress = progress(paper::STEPS);
        let told = |what: &str| {
            progress.inc(1);
            progress.set_message(what.to_owned());
        };
        let cycles = if arguments.quick {
            paper::QUICK_CYCLES
        } else {
            paper::CYCLES
        };
        let paper = paper::measure(machine, cycles, &told).await;
        progress.finish_and_clear();
        paper.map_err(|error| {
            let advice = "report this bug: the messages do not depend on the machine";
            Failure::failed(error, "fipa bench paper", advice)
        })
    })?;
    paper.write(directory).map_err(|error| {
        let place = directory.display().to_string();
        Failure::failed(error, place, "check whether this user can write there")
    })?;
    if arguments.json {
        return output::json(&paper);
    }
    output::text(&paper.text())
}

fn size(text: &str) -> Result<ByteSize, String> {
    let size = text.parse();
    size.map_err(|_| "expected a size such as 100B, 64KiB or 1MiB".to_owned())
}

fn effort(arguments: &Arguments) -> Result<Effort, Failure> {
    let mut sizes = Vec::new();
    for size in &arguments.sizes {
        let bytes = usize::try_from(size.as_u64()).unwrap_or(usize::MAX);
        if !(1..=MOST).contains(&size.as_u64()) {
            return Err(Failure::wrong_usage(
                format!("cannot measure content of {size}"),
                "--sizes",
                format!("use 1 byte to {}", ByteSize(MOST)),
            ));
        }
        sizes.push(bytes);
    }
    sizes.sort_unstable();
    sizes.dedup();
    Ok(if arguments.quick {
        Effort::quick(sizes)
    } else {
        Effort::full(sizes)
    })
}

async fn measure(
    arguments: &Arguments,
    config: &Config,
    effort: &Effort,
) -> Result<(Machine, Measured), Failure> {
    let machine = Machine::look().await;
    for warning in machine.warnings() {
        warn(&warning);
    }
    let zenoh_program = arguments.zenoh.as_deref().map(program).transpose()?;
    let mut stage = Stage::new(zenoh_program).map_err(|error| {
        Failure::failed(
            error,
            "fipa bench",
            "check whether this user can write to $TMPDIR",
        )
    })?;
    let mut wanted = wanted(arguments.what, &config.mts.transports);
    if arguments.zenoh.is_some() {
        wanted.extend(zenoh(arguments.what));
    }
    let many = wanted.contains(&(Sort::Agents(Kind::Shm), Wait::Spin));
    let progress = progress(wanted.len() + effort.sizes.len() * 3 + usize::from(many));
    let told = |what: &str| {
        progress.inc(1);
        progress.set_message(what.to_owned());
    };
    let mut ways = Vec::new();
    let mut notes = Vec::new();
    for (sort, wait) in wanted {
        told(&format!("starting {}", sort.name()));
        match Way::open(&mut stage, sort, wait).await {
            Ok(way) => ways.push(way),
            Err(why) => notes.push(format!("cannot measure {}: {why}", sort.name())),
        }
    }
    let mut measured = measure::all(&mut stage, &mut ways, effort, &told).await;
    if many {
        told("multicast");
        match many::measure(&mut stage, effort).await {
            Ok(many) => measured.many = Some(many),
            Err(why) => notes.push(format!("cannot measure multicast: {why}")),
        }
    }
    progress.set_message("stopping");
    drop(stage);
    progress.finish_and_clear();
    notes.append(&mut measured.notes);
    measured.notes = notes;
    Ok((machine, measured))
}

/// Hidden by itself when standard error is no terminal.
fn progress(steps: usize) -> ProgressBar {
    let progress = ProgressBar::new(steps as u64);
    let style = ProgressStyle::with_template("{bar:30} {pos}/{len} {elapsed} {msg}");
    progress.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    progress.enable_steady_tick(Duration::from_millis(200));
    progress
}

/// The ways to be measured, each followed by what it is compared with.
fn wanted(what: Option<What>, transports: &[Kind]) -> Vec<(Sort, Wait)> {
    let mut wanted = Vec::new();
    let mut add = |sort: Sort, wait: Wait| {
        let all = [Some(sort), sort.plain(), sort.limit()];
        for sort in all.into_iter().flatten() {
            if !wanted.contains(&(sort, wait)) {
                wanted.push((sort, wait));
            }
        }
    };
    let shm = what != Some(What::Net) && transports.contains(&Kind::Shm);
    let net = what != Some(What::Shm);
    if shm {
        add(Sort::Agents(Kind::Shm), Wait::Spin);
        add(Sort::Letters, Wait::Spin);
        add(Sort::Agents(Kind::Shm), Wait::Block);
    }
    if net {
        for kind in transports {
            match kind {
                Kind::Unix => add(Sort::Agents(Kind::Unix), Wait::Block),
                Kind::Tcp | Kind::Udp => add(Sort::Gateways(*kind), Wait::Block),
                _ => {}
            }
        }
        // Whatever is configured: they have keys of their own.
        add(Sort::Secured(Kind::Tcp), Wait::Block);
        add(Sort::Secured(Kind::Quic), Wait::Block);
    }
    // What people know.
    add(Sort::Socket(Socket::Unix), Wait::Block);
    add(Sort::Socket(Socket::Tcp), Wait::Block);
    wanted
}

/// Where a program is, whatever the directory that its processes run in.
fn program(given: &Path) -> Result<PathBuf, Failure> {
    given.canonicalize().map_err(|error| {
        Failure::wrong_usage(
            format!("cannot find {}: {error}", given.display()),
            "--zenoh",
            "build the program: cargo build --release --manifest-path comparison/zenoh/Cargo.toml",
        )
    })
}

/// Zenoh with its shared memory and without, as far as there is a limit beside it.
fn zenoh(what: Option<What>) -> Vec<(Sort, Wait)> {
    let all = [(What::Net, true), (What::Shm, false)];
    let wanted = all.into_iter().filter(|(other, _)| what != Some(*other));
    wanted
        .map(|(_, shared_memory)| (Sort::Zenoh { shared_memory }, Wait::Block))
        .collect()
}

fn draw(file: &PathBuf, machine: &Machine, measured: &Measured) -> Result<(), Failure> {
    let subtitle = format!(
        "{}, {} cores, {}; {:.0} % of the CPU time used by other processes",
        machine.processor,
        machine.cores,
        machine.system,
        machine.busy * 100.0
    );
    let failed = |error: String| {
        Failure::failed(
            format!("cannot write the drawing: {error}"),
            file.display().to_string(),
            "check whether this user can write there",
        )
    };
    let picture = plot::svg(&measured.rows, &subtitle).map_err(failed)?;
    std::fs::write(file, picture).map_err(|error| failed(error.to_string()))
}
