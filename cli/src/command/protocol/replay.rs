//! `fipa protocol replay`: judges the letters of a recording.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use clap::Args;
use fipa::Time;
use fipa::monitor::recording::{Reader, Recorded};
use fipa::monitor::{Library, Machine};
use serde_json::json;

use crate::command::watch::checker::{CheckResult, Checker, Letter};
use crate::options::Global;
use crate::report::{self, Failure};
use crate::{input, output};

#[derive(Debug, Args)]
pub(crate) struct Arguments {
    /// A file of `fipa watch --record`
    file: PathBuf,

    /// Judge only conversations of this protocol: a name, or an SCXML file; repeatable
    #[arg(long, value_name = "PROTOCOL")]
    protocol: Vec<String>,

    /// Print JSON, one object on a line
    #[arg(long)]
    json: bool,
}

/// Numbers of letters.
#[derive(Default)]
struct Counts {
    letters: u64,
    accepted: u64,
    violations: u64,
    unchecked: u64,
    excluded: u64,
}

pub(crate) fn run(arguments: &Arguments, global: &Global) -> Result<(), Failure> {
    let mut library = super::library(global)?;
    let mut only = Vec::new();
    for named in &arguments.protocol {
        let machine = super::find(named, global)?;
        only.push(machine.name().to_owned());
        add(&mut library, machine, named)?;
    }
    let names = only.iter().filter_map(|name| library.find(name));
    let only: Vec<String> = names
        .flat_map(|machine| {
            machine
                .aliases()
                .iter()
                .map(String::as_str)
                .chain([machine.name()])
        })
        .map(str::to_ascii_lowercase)
        .collect();
    let mut replay = Replay {
        checker: Checker::new(library),
        only,
        json: arguments.json,
        counts: Counts::default(),
    };
    let complete = replay.read(&arguments.file)?;
    replay.end(complete)?;
    match replay.counts.violations {
        0 => Ok(()),
        _ => Err(Failure::already_reported()),
    }
}

fn add(library: &mut Library, machine: Machine, named: &str) -> Result<(), Failure> {
    library.add(machine).map_err(|error| {
        Failure::failed(
            error.to_string(),
            named,
            "list fewer files in monitor.protocols",
        )
    })
}

struct Replay {
    checker: Checker,
    /// Names of the judged protocols in lower case; empty for all.
    only: Vec<String>,
    json: bool,
    counts: Counts,
}

impl Replay {
    /// Reads and judges a file. Returns whether it was closed.
    fn read(&mut self, path: &Path) -> Result<bool, Failure> {
        let failed = |problem: String| {
            let help = "give a file of `fipa watch --record` that this user can read";
            Failure::failed(problem, input::name(path), help)
        };
        let mut file: Box<dyn Read> = match path == Path::new("-") {
            true => Box::new(std::io::stdin().lock()),
            false => {
                let opened = File::open(path);
                Box::new(opened.map_err(|error| failed(format!("cannot read: {error}")))?)
            }
        };
        let mut reader = Reader::new();
        let mut piece = vec![0; 64 * 1024];
        let mut is_empty = true;
        loop {
            let read = match file.read(&mut piece) {
                Ok(0) => break,
                Ok(read) => read,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(failed(format!("cannot read: {error}"))),
            };
            is_empty = false;
            reader.push(piece.get(..read).unwrap_or_default());
            while let Some(recorded) = reader
                .next_entry()
                .map_err(|error| failed(error.to_string()))?
            {
                self.letter(&recorded)?;
            }
        }
        match is_empty {
            true => Err(failed("the input is empty".to_owned())),
            false => Ok(reader.is_complete()),
        }
    }

    fn letter(&mut self, recorded: &Recorded) -> Result<(), Failure> {
        self.counts.letters += 1;
        if recorded.after_loss {
            self.checker.forget();
        }
        let message = recorded.message.as_ref();
        let protocol = message.and_then(|message| message.protocol());
        // A message of a judged conversation need not name the protocol.
        let is_judged = self.only.is_empty()
            || protocol.is_none_or(|name| self.only.contains(&name.to_ascii_lowercase()));
        if !is_judged {
            self.counts.excluded += 1;
            return Ok(());
        }
        // The time limits of states apply before the letter.
        self.checker.pass(recorded.at);
        let checked = self.checker.check(Letter {
            message,
            receiver: &recorded.receiver,
            at: recorded.at,
            answer_within: recorded.answer_within,
            from_service: recorded.from_service,
            undelivered: recorded.undelivered,
            may_continue: recorded.may_continue,
        });
        match checked {
            CheckResult::Accepted { .. } => self.counts.accepted += 1,
            CheckResult::Unchecked(_) => self.counts.unchecked += 1,
            CheckResult::Excluded(_) | CheckResult::Checked => self.counts.excluded += 1,
            CheckResult::Violation(violation) => {
                self.counts.violations += 1;
                let number = self.counts.letters;
                let text = violation.to_string();
                let at = Time::from_system_time(recorded.at).ok();
                let at = at.and_then(Time::to_rfc3339).unwrap_or_default();
                let kind = violation.kind.as_str();
                if self.json {
                    return output::json_line(&json!({
                        "event": "violation", "number": number, "time": at, "kind": kind,
                        "text": text
                    }));
                }
                output::text(&format!("letter {number}, {at}: {text}\n"))?;
            }
        }
        Ok(())
    }

    fn end(&self, complete: bool) -> Result<(), Failure> {
        let Counts {
            letters,
            accepted,
            violations,
            unchecked,
            excluded,
        } = self.counts;
        if !complete {
            report::warn(
                "the recording ends within a letter: the program that wrote it was killed",
            );
        }
        if self.json {
            return output::json_line(&json!({
                "event": "summary", "letters": letters, "accepted": accepted,
                "violations": violations, "unchecked": unchecked, "excluded": excluded,
                "complete": complete
            }));
        }
        output::text(&format!(
            "letters: {letters}, accepted: {accepted}, violations: {violations}, unchecked: \
             {unchecked}, not judged: {excluded}\n"
        ))
    }
}
