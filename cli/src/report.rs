//! Says on standard error what went wrong: what, where, and what to do about it.

use std::fmt::Write as _;
use std::io::{self, Write as _};
use std::process::ExitCode;

use fipa::config::{ConfigError, Mistake};

use crate::output;

/// Why a command ended without having done what it was told, and the exit code for that.
///
/// Displayed, for each trouble, as
/// ```text
/// error: unknown key `mts.deadlin`
/// where: fipa.toml:3
///    do: did you mean `mts.deadline`?
/// ```
#[derive(Debug)]
pub(crate) struct Failure {
    code: u8,
    troubles: Vec<Trouble>,
}

#[derive(Debug)]
struct Trouble {
    what: String,
    place: Option<String>,
    advice: String,
}

/// Exit code: it did not work.
const FAILED: u8 = 1;
/// Exit code: it was told the wrong thing, on the command line or in the configuration.
const WRONG_USAGE: u8 = 2;

impl Failure {
    /// It did not work.
    pub(crate) fn failed(
        what: impl Into<String>,
        place: impl Into<String>,
        advice: impl Into<String>,
    ) -> Self {
        Self {
            code: FAILED,
            troubles: vec![Trouble {
                what: what.into(),
                place: Some(place.into()),
                advice: advice.into(),
            }],
        }
    }

    /// It was told the wrong thing.
    pub(crate) fn wrong_usage(
        what: impl Into<String>,
        place: impl Into<String>,
        advice: impl Into<String>,
    ) -> Self {
        Self {
            code: WRONG_USAGE,
            ..Self::failed(what, place, advice)
        }
    }

    /// Several things did not work, if any.
    pub(crate) fn all(failures: impl IntoIterator<Item = Self>) -> Result<(), Self> {
        let joined = failures.into_iter().reduce(|mut all, one| {
            all.code = all.code.max(one.code);
            all.troubles.extend(one.troubles);
            all
        });
        joined.map_or(Ok(()), Err)
    }

    /// It was told the wrong thing, and the output says so already.
    pub(crate) fn wrong_usage_already_told() -> Self {
        Self {
            code: WRONG_USAGE,
            troubles: Vec::new(),
        }
    }

    /// It did not work, and the output says so already.
    pub(crate) fn already_told() -> Self {
        Self {
            code: FAILED,
            troubles: Vec::new(),
        }
    }

    /// Prints it.
    pub(crate) fn report(&self) -> ExitCode {
        let mut text = String::new();
        for Trouble {
            what,
            place,
            advice,
        } in &self.troubles
        {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "error: {}", indented(what));
            if let Some(place) = place {
                let _ = writeln!(text, "where: {}", indented(place));
            }
            let _ = writeln!(text, "   do: {}", indented(advice));
        }
        to_stderr(&text);
        ExitCode::from(self.code)
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        let troubles = match error {
            ConfigError::Mistakes(mistakes) => mistakes.into_iter().map(Trouble::from).collect(),
            other => vec![Trouble {
                what: other.to_string(),
                place: None,
                advice: "name another file with --config or $FIPA_CONFIG, or leave both out"
                    .to_owned(),
            }],
        };
        Self {
            code: WRONG_USAGE,
            troubles,
        }
    }
}

impl From<Mistake> for Trouble {
    fn from(mistake: Mistake) -> Self {
        Self {
            place: mistake.place.map(|place| place.to_string()),
            what: mistake.what,
            advice: mistake.help,
        }
    }
}

/// Says something that stops nothing.
pub(crate) fn warn(what: &str) {
    to_stderr(&format!("warning: {}\n", indented(what)));
}

/// The text with all lines but the first indented: none of them looks like one of this module.
fn indented(text: &str) -> String {
    output::printable(text).replace('\n', "\n       ")
}

/// When standard error is closed there is nobody left to tell.
fn to_stderr(text: &str) {
    let _ = io::stderr().lock().write_all(text.as_bytes());
}
