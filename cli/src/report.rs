//! Prints errors on standard error: the problem, its place and the remedy.

use std::env;
use std::ffi::OsString;
use std::fmt::Write as _;
use std::io::{self, IsTerminal as _, Write as _};
use std::process::{self, ExitCode};

use fipa::Performative;
use fipa::config::{ConfigError, Mistake};
use fipa::error::ErrorChain;
use fipa_acl::is_unprintable;
use fipa_monitor::near_standard;

use crate::log_output::LogOutput;
use crate::output;

/// The errors that ended a command, and its exit code.
///
/// Each error is printed as
/// ```text
/// error: unknown key `mts.deadlin`
/// where: fipa.toml:3
///  help: did you mean `mts.deadline`?
/// ```
#[derive(Debug)]
pub(crate) struct Failure {
    code: u8,
    errors: Vec<ErrorReport>,
}

#[derive(Debug)]
struct ErrorReport {
    problem: String,
    place: Option<String>,
    help: String,
}

/// Exit code of a failed operation.
const FAILED: u8 = 1;
/// Exit code for an invalid command line or an invalid configuration.
const WRONG_USAGE: u8 = 2;

impl Failure {
    /// A failed operation.
    pub(crate) fn failed(
        problem: impl Into<String>,
        place: impl Into<String>,
        help: impl Into<String>,
    ) -> Self {
        Self {
            code: FAILED,
            errors: vec![ErrorReport {
                problem: problem.into(),
                place: Some(place.into()),
                help: help.into(),
            }],
        }
    }

    /// An invalid command line or configuration.
    pub(crate) fn wrong_usage(
        problem: impl Into<String>,
        place: impl Into<String>,
        help: impl Into<String>,
    ) -> Self {
        Self {
            code: WRONG_USAGE,
            ..Self::failed(problem, place, help)
        }
    }

    /// Joins several failures into one. Returns `Ok` when there is none.
    pub(crate) fn all(failures: impl IntoIterator<Item = Self>) -> Result<(), Self> {
        let joined = failures.into_iter().reduce(|mut all, one| {
            all.code = all.code.max(one.code);
            all.errors.extend(one.errors);
            all
        });
        joined.map_or(Ok(()), Err)
    }

    /// Exit code 2 without an error report: the output of the command has the errors already.
    pub(crate) fn wrong_usage_already_reported() -> Self {
        Self {
            code: WRONG_USAGE,
            errors: Vec::new(),
        }
    }

    /// Exit code 1 without an error report: the output of the command has the errors already.
    pub(crate) fn already_reported() -> Self {
        Self {
            code: FAILED,
            errors: Vec::new(),
        }
    }

    /// These errors with another exit code.
    pub(crate) fn with_code(self, code: u8) -> Self {
        Self { code, ..self }
    }

    /// The problems, without their places and remedies.
    pub(crate) fn problem(&self) -> String {
        let problems = self.errors.iter().map(|error| error.problem.as_str());
        problems.collect::<Vec<_>>().join("; ")
    }

    /// Prints the errors and returns the exit code.
    pub(crate) fn report(&self) -> ExitCode {
        let mut text = String::new();
        for ErrorReport {
            problem,
            place,
            help,
        } in &self.errors
        {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "error: {}", indented(problem));
            if let Some(place) = place {
                let _ = writeln!(text, "where: {}", indented(place));
            }
            let _ = writeln!(text, " help: {}", indented(help));
        }
        to_stderr(&text);
        ExitCode::from(self.code)
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        let errors = match error {
            ConfigError::Mistakes(mistakes) => {
                mistakes.into_iter().map(ErrorReport::from).collect()
            }
            other => vec![ErrorReport {
                problem: ErrorChain(&other).to_string(),
                place: None,
                help: "check the permissions of the file (`ls -l`), or give another one with --config or \
                       $FIPA_CONFIG"
                    .to_owned(),
            }],
        };
        Self {
            code: WRONG_USAGE,
            errors,
        }
    }
}

impl From<Mistake> for ErrorReport {
    fn from(mistake: Mistake) -> Self {
        Self {
            place: mistake.place.map(|place| place.to_string()),
            problem: mistake.what,
            help: mistake.help,
        }
    }
}

/// Prints a warning; the command continues.
pub(crate) fn warn(text: &str) {
    to_stderr(&format!("warning: {}\n", indented(text)));
}

/// Tells the user about the course of the command.
pub(crate) fn note(text: &str) {
    to_stderr(&format!("{}\n", indented(text)));
}

/// Tells a person at a terminal what the command is doing, beside its output.
pub(crate) fn hint(text: &str) {
    if io::stderr().is_terminal() {
        note(text);
    }
}

/// Warns of each user-defined performative that differs from one of FIPA by a typing error. User-defined
/// ones are legal, so the command continues.
pub(crate) fn warn_of_performatives<'a>(performatives: impl IntoIterator<Item = &'a Performative>) {
    for performative in performatives {
        let name = performative.as_str();
        if let Some(standard) = near_standard(name) {
            warn(&format!(
                "{name:?} is a performative of your own, and none of FIPA00037; did you mean {standard:?}?"
            ));
        }
    }
}

/// Prints an error of the command line, the help or the version, and ends the process. An error repeats
/// arguments, which may be texts from outside in a script.
pub(crate) fn usage(error: &clap::Error) -> ! {
    let is_harmless = |argument: OsString| {
        let text = argument.to_string_lossy();
        !text.contains(is_unprintable)
    };
    if !error.use_stderr() || env::args_os().all(is_harmless) {
        error.exit();
    }
    let text = error.render().to_string();
    to_stderr(&format!("{}\n", indented(text.trim_end())));
    process::exit(error.exit_code())
}

/// Indents all lines but the first, so that none of them looks like a line of this module.
fn indented(text: &str) -> String {
    output::printable(text).replace('\n', "\n       ")
}

/// Ignores a closed standard error: there is no other place to report it.
fn to_stderr(text: &str) {
    let _ = LogOutput.write_all(text.as_bytes());
}
