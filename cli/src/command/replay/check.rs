//! `fipa replay --check`: judges the letters of a recording.

use std::collections::BTreeMap;
use std::path::Path;

use fipa::monitor::{Library, Machine};
use serde_json::json;

use super::recorded::{self, Contents};
use crate::command::protocol;
use crate::command::record::file::letter::RecordedLetter;
use crate::command::watch::checker::{CheckResult, Checker};
use crate::options::Global;
use crate::output;
use crate::report::{self, Failure};

/// Numbers of letters.
#[derive(Default)]
struct Counts {
    letters: u64,
    accepted: u64,
    violations: u64,
    unchecked: Reasons,
    excluded: Reasons,
}

/// Numbers of letters by the reason for which they were not judged.
type Reasons = BTreeMap<String, u64>;

/// Counts a letter. The texts of the reasons are constant, so their number is small.
fn count(reasons: &mut Reasons, reason: &str) {
    let number = reasons.entry(reason.to_owned()).or_default();
    *number += 1;
}

/// Judges the letters of a file: of all protocols, or of these.
pub(super) fn run(
    file: &Path,
    protocols: &[String],
    json: bool,
    global: &Global,
) -> Result<(), Failure> {
    let mut library = protocol::library(global)?;
    let mut only = Vec::new();
    for named in protocols {
        let machine = protocol::find(named, global)?;
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
        json,
        counts: Counts::default(),
    };
    let contents = recorded::read(file, |letter| replay.letter(&letter))?;
    replay.end(&contents)?;
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
    fn letter(&mut self, recorded: &RecordedLetter) -> Result<(), Failure> {
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
            count(&mut self.counts.excluded, "of another protocol");
            return Ok(());
        }
        // The time limits of states apply before the letter.
        self.checker.pass(recorded.at);
        let checked = self.checker.check(recorded.letter());
        match checked {
            CheckResult::Accepted { .. } => self.counts.accepted += 1,
            CheckResult::Unchecked(why) => count(&mut self.counts.unchecked, &why.to_string()),
            CheckResult::Excluded(why) => count(&mut self.counts.excluded, why),
            CheckResult::Checked => count(&mut self.counts.excluded, "judged before"),
            CheckResult::Violation(violation) => {
                self.counts.violations += 1;
                let number = self.counts.letters;
                let text = violation.to_string();
                let at = output::rfc3339(recorded.at).unwrap_or_default();
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

    fn end(&self, contents: &Contents) -> Result<(), Failure> {
        let Counts {
            letters,
            accepted,
            violations,
            unchecked: ref unchecked_reasons,
            excluded: ref excluded_reasons,
        } = self.counts;
        let unchecked: u64 = unchecked_reasons.values().sum();
        let excluded: u64 = excluded_reasons.values().sum();
        if contents.is_filtered {
            report::warn(
                "letters are left out of this recording by a filter; verdicts may be wrong",
            );
        }
        if self.json {
            return output::json_line(&json!({
                "event": "summary", "letters": letters, "accepted": accepted,
                "violations": violations, "unchecked": unchecked, "excluded": excluded,
                "complete": contents.is_closed, "unchecked_reasons": unchecked_reasons,
                "excluded_reasons": excluded_reasons,
            }));
        }
        output::text(&format!(
            "letters: {letters}, accepted: {accepted}, violations: {violations}, unchecked: \
             {unchecked}, not judged: {excluded}\n"
        ))?;
        for (word, reasons) in [
            ("unchecked", unchecked_reasons),
            ("not judged", excluded_reasons),
        ] {
            for (reason, number) in reasons {
                output::text(&format!("  {word}: {number}, {reason}\n"))?;
            }
        }
        Ok(())
    }
}
