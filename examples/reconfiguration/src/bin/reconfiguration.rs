//! Runs the application: `reconfiguration [FAULT] [SEED]`. Its processes run the same executable, with their parts.

use std::process::ExitCode;

use fipa_acl::escape;
use fipa_reconfiguration::Fault;
use fipa_reconfiguration::launch::{self, Options};
use fipa_reconfiguration::part::{Failed, Part};
use fipa_reconfiguration::report::{Claim, Report, Reporter};
use fipa_reconfiguration::telling::told;

#[tokio::main]
async fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let ran = match arguments.as_slice() {
        ["part", part] => run_part(part).await,
        arguments => run(arguments).await,
    };
    match ran {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            print(&format!("{error}"));
            ExitCode::FAILURE
        }
    }
}

async fn run_part(part: &str) -> Result<bool, Failed> {
    let part: Part = serde_json::from_str(part)?;
    if let Err(error) = fipa_reconfiguration::run(&part).await {
        let error = error.to_string();
        Reporter::new(&part.name).claim(Claim::Broken { error });
        return Ok(false);
    }
    Ok(true)
}

async fn run(arguments: &[&str]) -> Result<bool, Failed> {
    let seed = arguments.get(1).map_or(Ok(1), |seed| seed.parse())?;
    let options = Options {
        fault: match arguments.first() {
            None | Some(&"none") => None,
            Some(&"random") => Some(Fault::random(seed)),
            Some(fault) => Some(fault.parse()?),
        },
        seed,
        program: launch::own_program(&["part"])?,
        ..Options::default()
    };
    let mut show = |report: &Report| {
        if let Some(line) = told(report) {
            print(&escape(&line));
        }
    };
    let outcome = launch::run(&options, &mut show).await?;
    for claim in &outcome.failed {
        print(&format!("failed: {claim}"));
    }
    Ok(outcome.failed.is_empty())
}

#[expect(clippy::print_stdout, reason = "a program prints its results")]
fn print(text: &str) {
    println!("{text}");
}
