//! The errors of joining a domain, registering, sending and receiving.
//!
//! Each of them converts into [`Error`](crate::Error). The errors of a module, such as
//! [`DialogueError`](crate::protocol::DialogueError), are in that module.

#[cfg(feature = "protocols")]
use std::path::PathBuf;

pub use fipa_acl::{
    AgentIdError, BuildError, ContentError, DecodeError, EncodeError, ErrorChain,
    PerformativeError, TimeError,
};
#[cfg(feature = "protocols")]
use fipa_monitor::LibraryFull;
#[cfg(feature = "protocols")]
use fipa_monitor::scxml::ScxmlError;
pub use fipa_mts::PostError;
#[cfg(feature = "mdns")]
pub use fipa_sds::MdnsError;
pub use fipa_sds::{
    DeregisterError, EntryError, HostError, MembersError, NameError, PatternError, RegisterError,
};
use fipa_transport::Kind;
pub use fipa_transport::{
    Forked, IncarnationError, ListenError, LocationError, TransportError, TransportErrorKind,
};

use crate::Config;
#[cfg(feature = "secure")]
use crate::admin::keys::KeysError;
use crate::config::{ConfigError, RuleError};
use crate::domain::files::DomainDir;
pub use crate::domain::files::DomainDirError;
#[cfg(feature = "web")]
pub use crate::web::error::WebError;
#[cfg(feature = "web")]
pub use crate::web::token::TokenError;

/// The error of [`Domain::open`](crate::Domain::open) and of opening a gateway or a watcher.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The configuration is invalid.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The system refuses a thread for work that blocks.
    #[error("cannot start the background thread")]
    Thread(#[source] std::io::Error),
    /// The call was made outside a tokio runtime. Processes without a runtime wait for
    /// it with [`Wait`](crate::blocking::Wait).
    #[error(
        "no tokio runtime is running; call this within one, or wait for it with fipa::blocking::Wait"
    )]
    NoRuntime,
    /// The directory of the domain cannot be used.
    #[error(transparent)]
    DomainDir(#[from] DomainDirError),
    /// A file in `monitor.protocols` cannot be used.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    Protocol(#[from] ProtocolError),
    /// The agent directory of the host cannot be used.
    #[error(transparent)]
    Directory(#[from] HostError),
    /// A transport that the gateway needs cannot be opened.
    #[error("cannot open the transport {kind}")]
    Listen {
        /// The transport.
        kind: Kind,
        /// The error of the transport.
        source: ListenError,
    },
    /// The HTTP listener of the gateway cannot be opened.
    #[cfg(feature = "web")]
    #[error(transparent)]
    Web(#[from] WebError),
    /// None of the configured transports can be used. Holds the reason for each.
    #[error("no transport can be used: {0}")]
    NoTransport(String),
    /// The name of the gateway (`mts.name`) is taken or invalid.
    #[error("cannot register the gateway")]
    Name(#[from] RegisterError),
    /// Another gateway is running in the domain. Holds its name.
    #[error("the gateway {0:?} is already running in this domain; stop it, or use another domain")]
    GatewayRunning(String),
    /// The socket of a watcher cannot be used.
    #[error("cannot listen to the processes of the domain")]
    Watch(#[source] std::io::Error),
    /// The access rules of the configuration cannot be used.
    #[error("the section [access] of the configuration")]
    Access(#[source] RuleError),
    /// The keys that the configuration names cannot be used.
    #[cfg(feature = "secure")]
    #[error("cannot use security.keys")]
    Keys(#[source] KeysError),
    /// The key log that `security.key_log` asks for cannot be written.
    #[cfg(feature = "secure")]
    #[error("cannot use security.key_log")]
    KeyLog(#[source] fipa_transport_net::secure::KeyLogError),
    /// The configuration has a key for a feature that this program was built without.
    #[error("this program was built without the feature `{feature}`, which {key} needs")]
    NoFeature {
        /// The key of the configuration.
        key: &'static str,
        /// The feature of this crate.
        feature: &'static str,
    },
    /// The agents of legacy peers in `discovery.static` cannot be used.
    #[error("cannot use discovery.static")]
    StaticPeers(#[source] EntryError),
    /// The discovery of other hosts by multicast DNS cannot start.
    #[cfg(feature = "mdns")]
    #[error("cannot start the discovery by multicast DNS")]
    Mdns(#[source] MdnsError),
}

impl OpenError {
    /// Replaces an error that was caused by a directory of the domain in which no file can be written.
    pub(crate) fn explained(self, config: &Config) -> Self {
        let may_be_caused = matches!(
            self,
            Self::DomainDir(DomainDirError::Io { .. })
                | Self::Directory(_)
                | Self::NoTransport(_)
                | Self::Name(RegisterError::Failed(_))
                | Self::Watch(_)
        );
        if !may_be_caused {
            return self;
        }
        match DomainDir::of(config).check_writable() {
            Err(cause) => cause.into(),
            Ok(()) => self,
        }
    }
}

/// The error if a message is not sent.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SendError {
    /// The message has no receiver.
    #[error("the message has no receiver; set one with MessageBuilder::receiver")]
    NoReceiver,
    /// The message has no sender.
    #[error("the message has no sender; create it with Agent::message")]
    NoSender,
    /// The sender in the message is another agent.
    #[error(
        "the message names {sender:?} as its sender, but is sent by {agent:?}; create it with \
         Agent::message of the sending agent"
    )]
    NotTheSender {
        /// The name of the agent on which the call was made.
        agent: String,
        /// The name of the sender in the message.
        sender: String,
    },
    /// The message violates its protocol, and `monitor.check` is `enforce`.
    #[cfg(feature = "protocols")]
    #[error("not sent: {0}")]
    Violation(Box<fipa_monitor::Violation>),
    /// The message cannot be built, for example because the name of a receiver is invalid.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// The letter would be larger than `transport.shm.max_letter`. Lengths are in bytes.
    #[error(
        "the letter would have {len} bytes, and at most {limit} are allowed; split the content, or \
         raise transport.shm.max_letter in the configuration of all hosts"
    )]
    TooLarge {
        /// Length of the letter or of its content.
        len: u64,
        /// Maximum length of a letter.
        limit: u64,
    },
    /// The agent was deregistered by another handle.
    #[error("the agent is deregistered")]
    Deregistered,
    /// The message cannot be encoded.
    #[error(transparent)]
    Post(#[from] PostError),
    /// This process is a forked child of the one that registered the agent.
    #[error(transparent)]
    Forked(#[from] Forked),
}

/// The error if an agent can receive no further message. A mistake of another agent is no error of this
/// kind: see [`Incoming::violation`](crate::Incoming::violation) for messages that violate their
/// protocol. Letters that cannot be decoded are logged, and their senders get failure messages.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReceiveError {
    /// The agent was deregistered, or the domain was closed.
    #[error("the agent was deregistered, or the domain was closed")]
    Closed,
    /// This process is a forked child of the one that registered the agent.
    #[error(transparent)]
    Forked(#[from] Forked),
}

/// The error if a file in `monitor.protocols` cannot be used.
#[cfg(feature = "protocols")]
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ProtocolError {
    /// The file cannot be read.
    #[error("monitor.protocols: cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// The protocol in the file is invalid.
    #[error("monitor.protocols: a protocol is not valid (`fipa protocol check` lists all errors)")]
    Scxml(#[from] ScxmlError),
    /// The files define too many protocols.
    #[error("monitor.protocols: too many protocols")]
    Full(#[from] LibraryFull),
}

/// The error of forming or changing a coalition.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CoalitionError {
    /// The members or the leader are invalid.
    #[error(transparent)]
    Members(#[from] MembersError),
    /// An agent to be split off is not a member. Holds its name.
    #[error("{0:?} is not a member of this coalition")]
    NoMember(String),
    /// The directory refuses the coalition.
    #[error(transparent)]
    Register(#[from] RegisterError),
    /// The name cannot be removed from the directory.
    #[error(transparent)]
    Deregister(#[from] DeregisterError),
}
