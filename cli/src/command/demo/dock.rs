//! `fipa demo dock`: two robots fetch, reserve and dock items, and become one.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use fipa::Gateway;
use fipa_acl::escape;
use fipa_reconfiguration::Fault;
use fipa_reconfiguration::launch::{self, Link, Options, Outcome};
use fipa_reconfiguration::part::{Failed, Mutant, Part, Role};
use fipa_reconfiguration::picture;
use fipa_reconfiguration::report::{Claim, Report, Reporter};
use fipa_reconfiguration::telling::told;
use serde_json::json;

use crate::command::dashboard::{self, Dashboard};
use crate::membership::Stop;
use crate::options;
use crate::output;
use crate::report::Failure;

/// Two robots fetch, reserve and dock two items, and become one robot
///
/// Starts two gateways that stand for two hosts, two robots, two payload items, an operator, and the
/// simulated world, all as separate processes. The operator finds the robots in the directory and awards
/// each item to the one with the lowest cost. One robot guides the other to the items, with the images of
/// their cameras, while it holds the locks of all interfaces. The docked robots and items become a coalition
/// with one name and one leader.
///
/// A fault shows what happens when something goes wrong. At the end, a program that takes no part reads the
/// recording and the directory, and checks that no lock is held, that the coalition is what is joined, and
/// that each report is true. The exit code is 0 only if it finds nothing.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples:\n  fipa demo dock\n  fipa demo dock --fault master-stopped --svg dock.svg\n  \
                  fipa demo dock --fault random --seed 7\n  fipa demo dock --dashboard\n  \
                  fipa demo dock --operator examples/reconfiguration/stack_operator.py\n  \
                  fipa demo dock --json | jq '.reports[] | select(.claim == \"noticed\")'\n\nJSON:\n  \
                  { \"fault\", \"seed\", \"steps\": { \"approach\", \"align\" }, \"seconds\" from the first award to the end of the work,\n    \
                  \"passed\": [checks], \"failed\": [checks with reasons],\n    \
                  \"reports\": [ { \"at\" in microseconds since 1970, \"by\", \"claim\", its details } ] }"
)]
pub(crate) struct Arguments {
    /// The fault: item-killed, link-cut, master-stopped, rogue, cancel, or random
    #[arg(long, value_name = "FAULT", value_parser = ["item-killed", "link-cut", "master-stopped", "rogue", "cancel", "random"])]
    fault: Option<String>,
    /// Decides where the bodies are, the noise of the cameras, and the random fault
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Delay of the link between the hosts in one direction, for example 50ms
    #[arg(long, value_name = "TIME", default_value = "0ms", value_parser = options::duration)]
    delay: Duration,
    /// Rate of the link in one direction, in megabits per second
    #[arg(long, value_name = "MBIT", value_parser = rate)]
    rate: Option<f64>,
    /// Print one JSON object instead of the text
    #[arg(long)]
    json: bool,
    /// Write a picture of the run: the plane, the coalition, the locks and a docking
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// The program of the items, which runs instead of this one
    #[arg(long, hide = true, value_name = "PROGRAM", value_parser = program)]
    item: Option<PathBuf>,
    /// The program of the operator, which runs instead of this one
    ///
    /// The demo starts it with its part as JSON, in which `platform` has the name and the HTTP address of the gateway, for
    /// an agent of another platform such as JADE. The program writes its claims to standard output, one JSON object
    /// in a line. The last one is `finished`. It ends when its standard input is closed.
    #[arg(long, value_name = "PROGRAM", value_parser = program)]
    operator: Option<PathBuf>,
    /// Open the dashboard of the first gateway. The demo prints its link, and waits for Enter before the robots start and
    /// before they end
    #[arg(long, conflicts_with = "json")]
    dashboard: bool,
    /// A defect that is built in
    #[arg(long, hide = true, value_parser = mutant)]
    mutant: Option<Mutant>,
    /// Run as a process of the demo
    #[arg(long, hide = true, value_parser = part)]
    part: Option<Part>,
}

fn part(text: &str) -> Result<Part, String> {
    serde_json::from_str(text).map_err(|error| error.to_string())
}

fn mutant(text: &str) -> Result<Mutant, String> {
    serde_json::from_value(json!(text)).map_err(|error| error.to_string())
}

/// Reads a path as one from the present directory: the processes of the demo run in another one.
fn program(text: &str) -> Result<PathBuf, String> {
    match text.contains('/') {
        true => std::path::absolute(text).map_err(|error| error.to_string()),
        // A command of `PATH`.
        false => Ok(text.into()),
    }
}

fn rate(text: &str) -> Result<f64, String> {
    let rate: f64 = text.parse().map_err(|_| "expected a number".to_owned())?;
    match rate.is_finite() && rate > 0.0 {
        true => Ok(rate),
        false => Err("expected a number above 0".to_owned()),
    }
}

pub(super) fn run(arguments: Arguments) -> Result<(), Failure> {
    if let Some(part) = arguments.part {
        return options::block_on(run_part(&part))?;
    }
    let fault = match arguments.fault.as_deref() {
        Some("random") => Some(Fault::random(arguments.seed)),
        Some(fault) => Some(fault.parse().map_err(failed)?),
        None => None,
    };
    let options = Options {
        fault,
        seed: arguments.seed,
        link: Link {
            delay: arguments.delay,
            rate: arguments.rate.map(|megabits| megabits * 1e6 / 8.0),
        },
        mutant: arguments.mutant,
        program: launch::own_program(&["demo", "dock", "--part"]).map_err(failed)?,
        item: arguments.item.map(|program| vec![program.into()]),
        operator: arguments.operator.map(|program| vec![program.into()]),
        dashboard: arguments.dashboard,
    };
    // A file that cannot be written is an error before the run, not after it.
    if let Some(file) = &arguments.svg {
        std::fs::write(file, "").map_err(|error| not_written(file, &error))?;
    }
    let outcome = options::block_on(launch(&options, !arguments.json))??;
    if let Some(file) = &arguments.svg {
        let drawn = picture::page(&outcome.reports).svg();
        std::fs::write(file, drawn).map_err(|error| not_written(file, &error))?;
    }
    let (approach, align) = (outcome.steps("approach"), outcome.steps("align"));
    if arguments.json {
        output::json(&json!({
            "fault": fault.map_or("none", Fault::as_str),
            "seed": arguments.seed,
            "steps": { "approach": approach, "align": align },
            "seconds": outcome.seconds(),
            "passed": outcome.passed,
            "failed": outcome.failed,
            "reports": outcome.reports,
        }))?;
    } else {
        if let Some(seconds) = outcome.seconds() {
            say(&format!(
                "{approach} steps of approach, {align} of align; {seconds:.1} s from the first award"
            ))?;
        }
        for check in &outcome.passed {
            say(&format!("passed: {check}"))?;
        }
        for check in &outcome.failed {
            say(&format!("FAILED: {check}"))?;
        }
    }
    match outcome.failed.first() {
        None => Ok(()),
        Some(check) => Err(failed(check)),
    }
}

async fn run_part(part: &Part) -> Result<(), Failure> {
    let ran = match part.role {
        Role::Gateway => gateway(part).await,
        _ => fipa_reconfiguration::run(part).await,
    };
    ran.map_err(|error| {
        // The launcher reads it.
        let error = error.to_string();
        Reporter::new(&part.name).claim(Claim::Broken {
            error: error.clone(),
        });
        failed(error)
    })
}

/// Runs a gateway with the dashboard, if the part has `http.listen`.
async fn gateway(part: &Part) -> Result<(), Failed> {
    let config = part.config()?;
    if config.http.listen.is_empty() {
        return fipa_reconfiguration::run(part).await;
    }
    let (dashboard, pages) = Dashboard::start(&config);
    let gateway = Gateway::open_with_pages(&config, pages).await?;
    if let Some(listener) = gateway.http() {
        let link = dashboard::link(&listener).map_err(|failure| failure.problem())?;
        Reporter::new(&part.name).claim(Claim::Page { link });
    }
    fipa_reconfiguration::serve_gateway(part, gateway).await;
    dashboard.close().await;
    Ok(())
}

async fn launch(options: &Options, verbose: bool) -> Result<Outcome, Failure> {
    let mut stop = Stop::listen()?;
    let mut start = None;
    let mut show = |report: &Report| {
        let start = *start.get_or_insert(report.at);
        if let Some(line) = told(report).filter(|_| verbose) {
            let seconds = report.at.saturating_sub(start) as f64 / 1e6;
            // A closed standard output does not change the run.
            let _ = say(&format!("{seconds:6.2} s  {line}"));
        }
    };
    tokio::select! {
        outcome = launch::run(options, &mut show) => outcome.map_err(failed),
        () = stop.requested() => Err(failed("interrupted; the processes of the demo end")),
    }
}

fn say(line: &str) -> Result<(), Failure> {
    output::text(&format!("{}\n", escape(line)))
}

fn not_written(file: &std::path::Path, error: &std::io::Error) -> Failure {
    Failure::failed(
        error.to_string(),
        file.display().to_string(),
        "choose a file that can be written",
    )
}

fn failed(error: impl ToString) -> Failure {
    Failure::failed(
        error.to_string(),
        "fipa demo dock",
        "run `fipa doctor`; `RUST_LOG=info fipa demo dock` shows the logs of all processes",
    )
}
