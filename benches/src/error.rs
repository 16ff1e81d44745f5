//! Errors of a measurement.

use std::path::PathBuf;

use fipa::error::ErrorChain;
use thiserror::Error;

/// A measurement that could not be made or shown.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BenchError {
    /// A size of content outside of 1 byte to [`Effort::MAX_SIZE`](crate::Effort::MAX_SIZE).
    #[error("content of {0} bytes cannot be measured")]
    Size(u64),
    /// A number of agents outside of 2 to [`Locks::MAX_AGENTS`](crate::Locks::MAX_AGENTS).
    #[error("locks of {0} agents cannot be measured")]
    Agents(usize),
    /// The directory and the processes of the measurement could not be prepared.
    #[error("cannot prepare the measurement: {0}")]
    Prepare(String),
    /// No path could be measured; one reason for each.
    #[error("no path could be measured: {}", .0.join("; "))]
    NothingMeasured(Vec<String>),
    /// An encoding failed on the message of the paper.
    #[error("cannot measure the encodings: {0}")]
    Encoding(String),
    /// An agent of another platform does not answer as expected.
    #[error(
        "cannot measure conversations with {}: {what}",
        fipa_acl::escape(agent)
    )]
    Peer {
        /// The name of the agent.
        agent: String,
        /// The cause.
        what: String,
    },
    /// An interpreter of Python could not be started.
    #[error("cannot start {}", path.display())]
    Interpreter {
        /// The interpreter.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// An interpreter of Python cannot import the package `fipa`.
    #[error("{} cannot import the package fipa: {why}", python.display())]
    Package {
        /// The interpreter.
        python: PathBuf,
        /// The reason that it gives.
        why: String,
    },
    /// A file could not be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A file is not the JSON output of a measurement.
    #[error("{} is not the JSON output of a measurement", path.display())]
    Baseline {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: serde_json::Error,
    },
    /// A file could not be written.
    #[error("cannot write {}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
}

/// The failure of a process of a measurement.
#[derive(Debug, Error)]
#[error("{0}")]
pub struct PartError(pub(crate) String);

/// Returns the text of an error of `fipa` with its causes.
pub(crate) fn chain_text(error: impl std::error::Error + 'static) -> String {
    ErrorChain(&error).to_string()
}
