//! What can be wrong with a configuration, and where.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use fipa_acl::escape;
use serde::{Serialize, Serializer};

/// Why there is no configuration.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// A file cannot be read.
    #[error("cannot read the configuration {} ({named_by}): {source}", shown(.path))]
    Read {
        /// The file.
        path: PathBuf,
        /// Why this file: `--config`, `$FIPA_CONFIG`, or where it was found.
        named_by: &'static str,
        /// What the system said.
        source: io::Error,
    },
    /// The configuration was read and has mistakes: at least one, in the order they stand.
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
    /// Where it stands; `None` for a value that a program set itself.
    pub place: Option<Origin>,
    /// What is wrong. Names the key.
    pub what: String,
    /// What is allowed there, or what to do.
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

/// Where a value comes from.
///
/// Displayed as `default`, `fipa.toml:12` or `--set mts.deadline=9s`, without control characters.
///
/// Serialized as `{"from": "default"}`, `{"from": "file", "path": "fipa.toml", "line": 12}` or
/// `{"from": "set", "assignment": "mts.deadline=9s"}`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "from", rename_all = "lowercase")]
#[non_exhaustive]
pub enum Origin {
    /// Nobody said anything.
    Default,
    /// It stands in a file.
    File {
        /// The file, as it was named.
        #[serde(serialize_with = "lossily")]
        path: PathBuf,
        /// The line, counted from 1.
        line: usize,
    },
    /// It was given with `--set`.
    Set {
        /// What stood behind `--set`.
        assignment: String,
    },
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => f.write_str("default"),
            Self::File { path, line } => write!(f, "{}:{line}", shown(path)),
            Self::Set { assignment } => write!(f, "--set {}", escape(assignment)),
        }
    }
}

/// A path as it is shown to people: a file name may contain anything, and this goes to terminals and
/// into comments of a TOML file.
fn shown(path: &Path) -> String {
    escape(&path.to_string_lossy()).into_owned()
}

/// A path that is not UTF-8 is still worth showing.
fn lossily<S: Serializer>(path: &Path, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&path.to_string_lossy())
}
