//! Errors of joining a domain, sending and receiving.

#[cfg(feature = "monitor")]
use std::path::PathBuf;

use fipa_acl::{DecodeError, Letter};
#[cfg(feature = "monitor")]
use fipa_monitor::LibraryFull;
#[cfg(feature = "monitor")]
use fipa_monitor::scxml::ScxmlError;
use fipa_mts::PostError;
use fipa_sds::{HostError, RegisterError};
use fipa_transport::{Forked, Kind, ListenError};

use crate::config::ConfigError;
#[cfg(feature = "monitor")]
use crate::incoming::Incoming;
use crate::place::PlaceError;

/// Why a domain could not be joined.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The configuration has mistakes.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// There is no tokio runtime with I/O and time; processes without one use
    /// [`crate::blocking`].
    #[error("no tokio runtime is running; call this from one, or use fipa::blocking")]
    NoRuntime,
    /// The domain's directory cannot be used.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// A protocol that the configuration names cannot be used.
    #[cfg(feature = "monitor")]
    #[error(transparent)]
    Protocol(#[from] ProtocolError),
    /// The directory of the host cannot be used.
    #[error(transparent)]
    Directory(#[from] HostError),
    /// A transport that the gateway needs cannot be opened.
    #[error("{kind}: {source}")]
    Listen {
        /// Which transport.
        kind: Kind,
        /// Why.
        source: ListenError,
    },
    /// None of the configured transports works.
    #[error("no transport can be used: {0}")]
    NoTransport(String),
    /// The service's own name is taken, or not a name.
    #[error("cannot register the gateway: {0}")]
    Name(#[from] RegisterError),
    /// There can be one gateway only.
    #[error("the domain has a gateway already, {0:?}; end it, or name another domain")]
    GatewayRunning(String),
    /// The socket of a watcher cannot be used.
    #[error("cannot listen to the processes of the domain: {0}")]
    Watch(std::io::Error),
    /// The rules for who may send to whom cannot be used.
    #[error("access: {0}")]
    Access(String),
    /// The keys that the configuration names cannot be used.
    #[error("security.keys: {0}")]
    Keys(String),
    /// Other hosts cannot be looked for.
    #[error("discovery: {0}")]
    Discovery(String),
}

/// Why a message was not sent.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SendError {
    /// It names no receiver.
    #[error("the message has no receiver; give it one with MessageBuilder::receiver")]
    NoReceiver,
    /// It names no sender.
    #[error("the message has no sender; begin it with Agent::message")]
    NoSender,
    /// It says that it is from somebody else.
    #[error("the message is from {sender:?}, and {agent:?} sends only its own")]
    NotTheSender {
        /// The agent that was to send it.
        agent: String,
        /// Whom the message names.
        sender: String,
    },
    /// It violates its protocol, and the configuration says `enforce`.
    #[cfg(feature = "monitor")]
    #[error("not sent: {0}")]
    Violation(Box<fipa_monitor::Violation>),
    /// It cannot be encoded.
    #[error(transparent)]
    Post(#[from] PostError),
    /// This process is a forked child of the one that registered the agent.
    #[error(transparent)]
    Forked(#[from] Forked),
}

/// Why no message was received.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReceiveError {
    /// The domain was closed.
    #[error("the domain was closed")]
    Closed,
    /// This process is a forked child of the one that registered the agent.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// A letter came whose message cannot be decoded. Its sender gets a failure message.
    #[error("a letter with a message that cannot be decoded: {source}")]
    Malformed {
        /// Why not.
        source: DecodeError,
        /// The letter.
        letter: Box<Letter>,
    },
    /// A message came that violates its protocol, and the configuration says `enforce`.
    #[cfg(feature = "monitor")]
    #[error("{violation}")]
    Violation {
        /// In which way.
        violation: Box<fipa_monitor::Violation>,
        /// The message.
        incoming: Box<Incoming>,
    },
}

/// Why a protocol that the configuration names cannot be used.
#[cfg(feature = "monitor")]
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProtocolError {
    /// The file cannot be read.
    #[error("monitor.protocols: cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// The file has mistakes.
    #[error("monitor.protocols: {0}; see `fipa protocol check`")]
    Scxml(#[from] ScxmlError),
    /// There are too many.
    #[error("monitor.protocols: {0}")]
    Full(#[from] LibraryFull),
}
