//! The error that holds any error of this crate.

use std::fmt;

use fipa_acl::{
    AgentIdError, BuildError, ContentError, DecodeError, EncodeError, ErrorChain,
    PerformativeError, TimeError,
};
use fipa_mts::PostError;
#[cfg(feature = "mdns")]
use fipa_sds::MdnsError;
use fipa_sds::{
    DeregisterError, EntryError, HostError, MembersError, NameError, PatternError, RegisterError,
};
use fipa_transport::{Forked, IncarnationError, ListenError, LocationError, TransportError};

#[cfg(feature = "actions")]
use crate::actions::{ActionError, GoalError, OfferError};
use crate::admin::contact::{AddressError, IntroduceError};
#[cfg(feature = "secure")]
use crate::admin::keys::KeysError;
#[cfg(feature = "secure")]
use crate::admin::pairing::{CodeError, PairingError};
use crate::admin::routes::AskError;
use crate::config::{ConfigError, RuleError};
use crate::domain::files::DomainDirError;
use crate::error::CoalitionError;
#[cfg(feature = "protocols")]
use crate::error::ProtocolError;
use crate::error::{OpenError, ReceiveError, SendError};
#[cfg(feature = "web")]
use crate::error::{TokenError, WebError};
#[cfg(feature = "protocols")]
use crate::locks::{AdmitError, LockError, OwnError, StateFileError};
#[cfg(feature = "protocols")]
use crate::platform::PlatformError;
#[cfg(feature = "protocols")]
use crate::protocol::DialogueError;

/// The result of a program that uses this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Any error of this crate, for the `main` function of a program and for functions with several kinds
/// of errors. Every error of this crate converts into it with `?`.
///
/// `Debug` writes the message with its causes, because that is the form which the result of `main` is
/// printed in:
///
/// ```no_run
/// #[tokio::main]
/// async fn main() -> fipa::Result<()> {
///     let domain = fipa::Domain::from_environment().await?;
///     let rover = domain.register("rover").await?;
///     let letter = rover.receive().await?;
///     println!("{} m", letter.message().parse::<f64>()?);
///     Ok(())
/// }
/// ```
#[derive(thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A domain, a gateway or a watcher cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The configuration cannot be read or has mistakes.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A rule of the section `[access]` is invalid.
    #[error(transparent)]
    Rule(#[from] RuleError),
    /// The directory of the domain cannot be used.
    #[error(transparent)]
    DomainDir(#[from] DomainDirError),
    /// An agent cannot be registered.
    #[error(transparent)]
    Register(#[from] RegisterError),
    /// An agent cannot be deregistered.
    #[error(transparent)]
    Deregister(#[from] DeregisterError),
    /// A coalition cannot be formed or changed.
    #[error(transparent)]
    Coalition(#[from] CoalitionError),
    /// The members of a coalition are invalid.
    #[error(transparent)]
    Members(#[from] MembersError),
    /// A message cannot be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// An agent identifier is invalid.
    #[error(transparent)]
    AgentId(#[from] AgentIdError),
    /// A name in the directory is invalid.
    #[error(transparent)]
    Name(#[from] NameError),
    /// A pattern is invalid.
    #[error(transparent)]
    Pattern(#[from] PatternError),
    /// A performative is invalid.
    #[error(transparent)]
    Performative(#[from] PerformativeError),
    /// A time is invalid.
    #[error(transparent)]
    Time(#[from] TimeError),
    /// A message cannot be sent.
    #[error(transparent)]
    Send(#[from] SendError),
    /// No message can be received.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// The content of a message is not of the expected type.
    #[error(transparent)]
    Content(#[from] ContentError),
    /// A message or letter cannot be decoded.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// A message or letter cannot be encoded.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// A message cannot be put into a letter.
    #[error(transparent)]
    Post(#[from] PostError),
    /// A conversation has failed.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    Dialogue(#[from] DialogueError),
    /// The conversations of an earlier registration cannot be restored.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    Restore(#[from] fipa_monitor::SnapshotError),
    /// The directory facilitator or the agent management system has refused a request or failed.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    Platform(#[from] PlatformError),
    /// A lock cannot be acquired or was lost.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    Lock(#[from] LockError),
    /// A resource cannot be owned.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    Own(#[from] OwnError),
    /// The state file of an owner cannot be used.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    StateFile(#[from] StateFileError),
    /// An owner refuses the fence of a message.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    Admit(#[from] AdmitError),
    /// A goal was not reached.
    #[cfg(feature = "actions")]
    #[error(transparent)]
    Action(#[from] ActionError),
    /// A goal cannot be encoded.
    #[cfg(feature = "actions")]
    #[error(transparent)]
    Goal(#[from] GoalError),
    /// An action cannot be offered.
    #[cfg(feature = "actions")]
    #[error(transparent)]
    Offer(#[from] OfferError),
    /// An agent of another platform cannot be introduced.
    #[error(transparent)]
    Introduce(#[from] IntroduceError),
    /// The address of an agent of another platform is invalid.
    #[error(transparent)]
    Address(#[from] AddressError),
    /// A file with a protocol cannot be used.
    #[cfg(feature = "protocols")]
    #[error(transparent)]
    Protocol(#[from] ProtocolError),
    /// The gateway does not report its routes.
    #[error(transparent)]
    Routes(#[from] AskError),
    /// The agent directory of the host cannot be used.
    #[error(transparent)]
    Directory(#[from] HostError),
    /// An entry of the directory is invalid.
    #[error(transparent)]
    Entry(#[from] EntryError),
    /// A location is invalid.
    #[error(transparent)]
    Location(#[from] LocationError),
    /// An incarnation is invalid.
    #[error(transparent)]
    Incarnation(#[from] IncarnationError),
    /// A transport has failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// A transport cannot be opened.
    #[error(transparent)]
    Listen(#[from] ListenError),
    /// The keys of this host or the certificates of its peers cannot be used.
    #[cfg(feature = "secure")]
    #[error(transparent)]
    Keys(#[from] KeysError),
    /// The HTTP listener of a gateway cannot be opened.
    #[cfg(feature = "web")]
    #[error(transparent)]
    Web(#[from] WebError),
    /// The token of the HTTP listener cannot be used.
    #[cfg(feature = "web")]
    #[error(transparent)]
    Token(#[from] TokenError),
    /// Two hosts cannot be paired.
    #[cfg(feature = "secure")]
    #[error(transparent)]
    Pairing(#[from] PairingError),
    /// A text is no code for a pairing.
    #[cfg(feature = "secure")]
    #[error(transparent)]
    Code(#[from] CodeError),
    /// The discovery of other hosts cannot start.
    #[cfg(feature = "mdns")]
    #[error(transparent)]
    Mdns(#[from] MdnsError),
    /// This process is a forked child of the one that joined the domain.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// An error of the operating system in the program itself.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Writes the message with its causes.
impl fmt::Debug for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&ErrorChain(self), f)
    }
}
