//! Errors in a configuration, and the origins of values.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use fipa_acl::escape;
use serde::{Serialize, Serializer};

/// The error if a configuration cannot be loaded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A file cannot be read.
    #[error("cannot read the configuration {} ({named_by})", shown(.path))]
    Read {
        /// The file.
        path: PathBuf,
        /// The reason for this file, for example `named by --config`.
        named_by: &'static str,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The configuration was read and has mistakes: at least one, in the order of the sources.
    #[error("{}", listed(.0))]
    Mistakes(Vec<Mistake>),
}

fn listed(mistakes: &[Mistake]) -> String {
    let lines: Vec<String> = mistakes.iter().map(Mistake::to_string).collect();
    lines.join("\n")
}

/// One mistake in a configuration.
///
/// Displayed as `place: what; help`, for example
/// ``fipa.toml:3: unknown key `mts.deadlin`; did you mean `mts.deadline`?``.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Mistake {
    /// The origin of the value; `None` for a value that a program set itself.
    pub place: Option<Origin>,
    /// The problem, with the name of the key.
    pub what: String,
    /// The allowed values, or the remedy.
    pub help: String,
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(place) = &self.place {
            write!(f, "{place}: ")?;
        }
        write!(f, "{}; {}", self.what, self.help)
    }
}

/// The origin of a value.
///
/// Displayed as `default`, `fipa.toml:12`, `$FIPA_DOMAIN` or `--set mts.deadline=9s`, without control
/// characters.
///
/// Serialized as `{"from": "default"}`, `{"from": "file", "path": "fipa.toml", "line": 12}`,
/// `{"from": "environment", "variable": "FIPA_DOMAIN"}` or
/// `{"from": "set", "assignment": "mts.deadline=9s"}`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "from", rename_all = "lowercase")]
#[non_exhaustive]
pub enum Origin {
    /// The default.
    Default,
    /// A line of a file.
    File {
        /// The path of the file, as it was given.
        #[serde(serialize_with = "lossily")]
        path: PathBuf,
        /// The line, counted from 1.
        line: usize,
    },
    /// A variable of the environment.
    Environment {
        /// The name of the variable.
        variable: &'static str,
    },
    /// A `--set` argument.
    Set {
        /// The text after `--set`.
        assignment: String,
    },
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => f.write_str("default"),
            Self::File { path, line } => write!(f, "{}:{line}", shown(path)),
            Self::Environment { variable } => write!(f, "${variable}"),
            Self::Set { assignment } => write!(f, "--set {}", escape(assignment)),
        }
    }
}

/// Escapes a path for terminals and for comments of a TOML file.
fn shown(path: &Path) -> String {
    escape(&path.to_string_lossy()).into_owned()
}

/// Serializes a path; invalid UTF-8 becomes the replacement character.
fn lossily<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.to_string_lossy())
}
