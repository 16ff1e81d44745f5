//! The reasons for which a connection ends, and their consequences for parcels.

#[cfg(feature = "ip")]
use std::io;

use fipa_transport::{Incarnation, Location, TransportError, TransportErrorKind};

/// The reason for which a connection ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum ConnectionEnd {
    /// The connection could not be opened.
    NotOpened(TransportError),
    /// The peer has another incarnation than expected.
    WrongIncarnation {
        expected: Incarnation,
        found: Incarnation,
    },
    /// The peer is this service itself: the address leads back here.
    Itself,
    /// The peer dialed another incarnation than this one.
    NotSought,
    /// The peer violated the protocol.
    ProtocolViolation(String),
    /// The frames of the peer have another version of the protocol than those of this side.
    OtherVersion { peer: u8, own: u8, is_process: bool },
    /// The peer sent its hello or a frame too slowly.
    TooSlow(&'static str),
    /// The peer did not respond to a ping.
    Silent,
    /// The operating system reported an error.
    Broken(String),
    /// TLS failed after the handshake of this side, for example by an alert of the peer. The text has the
    /// cause and the remedy.
    #[cfg(feature = "secure")]
    Tls(String),
    /// The peer closed the connection without a goodbye.
    Hangup,
    /// The process at the other end of a Unix domain socket closed it before its hello.
    ProcessEnded(String),
    /// The peer sent a goodbye after accepting parcels up to this number.
    Goodbye { last: u64 },
    /// The connection reached its idle timeout.
    Idle,
    /// A connection limit is reached.
    TooManyConnections,
    /// The peer is no longer trusted.
    #[cfg(feature = "secure")]
    Distrusted,
    /// The peer's certificate has expired. The text has the remedy.
    #[cfg(feature = "secure")]
    Expired(String),
    /// The peer opened another connection in place of this one.
    Superseded,
    /// The peer claims to be a service that is connected with another peer.
    IdentityConflict(&'static str),
    /// This endpoint closes.
    Closed,
}

/// The knowledge about the peer of a connection that ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Acquaintance {
    /// Nothing has arrived.
    Unknown,
    /// The peer has proved its identity by TLS, but its hello has not arrived.
    Proved,
    /// Its hello has arrived.
    Greeted,
}

/// The possible causes if a peer without a proved identity closes a connection before its hello. A gateway of an
/// older release does so when it receives another version.
const UNKNOWN_CAUSES: &str = "possible causes: the peer requires keys and this host has none (set security.keys \
                              here, see `fipa keys`), it has another version of the protocol (install the same \
                              release of fipa on both hosts), it is ending, or no fipa gateway listens there";

/// The possible causes if a peer with a proved identity closes a connection before its hello.
const PROVED_CAUSES: &str = "possible causes: the peer has another version of the protocol (install the same \
                             release of fipa on both hosts), it does not trust this host (see its log), or it is \
                             ending";

/// Returns the error of a transport in an error of a socket: the reason for which a guarded stream has
/// ended, or a broken connection.
#[cfg(feature = "ip")]
pub(crate) fn of_io(error: io::Error) -> TransportError {
    let inner = error.get_ref().and_then(|inner| inner.downcast_ref());
    let inner: Option<&TransportError> = inner;
    match inner {
        Some(ended) => ended.clone(),
        None => TransportError::new(TransportErrorKind::Broken, error),
    }
}

impl ConnectionEnd {
    /// Creates the end of a connection that could not be opened to a location.
    pub(crate) fn unreachable(to: &Location, what: &dyn std::fmt::Display) -> Self {
        let detail = format!("{}: {what}", to.address());
        Self::NotOpened(TransportError::new(TransportErrorKind::Unreachable, detail))
    }

    /// Whether this side ends the connection with a goodbye.
    pub(crate) fn is_orderly(&self) -> bool {
        matches!(
            self,
            Self::WrongIncarnation { .. }
                | Self::Itself
                | Self::OtherVersion { .. }
                | Self::NotSought
                | Self::Idle
                | Self::TooManyConnections
                | Self::IdentityConflict(_)
                | Self::Closed
        )
    }

    /// Whether the peer caused the end by a violation of the protocol.
    pub(crate) fn is_misbehavior(&self) -> bool {
        matches!(self, Self::ProtocolViolation(_) | Self::TooSlow(_))
    }

    /// Returns the same end for a connection between two processes of this host whose peer has not sent its
    /// hello. Such processes need no keys.
    pub(crate) fn of_process(self) -> Self {
        match self {
            Self::Hangup => Self::ProcessEnded("it closed the connection before its hello".into()),
            Self::Broken(what) => Self::ProcessEnded(what),
            other => other,
        }
    }

    /// Returns the error of parcels that the peer cannot have received.
    pub(crate) fn before(&self, peer: Acquaintance) -> TransportError {
        match (self, peer) {
            (Self::NotOpened(error), _) => error.clone(),
            (Self::WrongIncarnation { expected, found }, _) => TransportError::new(
                TransportErrorKind::WrongIncarnation,
                format_args!("the service at this address has incarnation {found}, not {expected}"),
            ),
            (Self::ProtocolViolation(what), _) => {
                TransportError::new(TransportErrorKind::Incompatible, what)
            }
            (Self::Goodbye { .. }, Acquaintance::Unknown | Acquaintance::Proved) => {
                TransportError::new(
                    TransportErrorKind::Refused,
                    "the peer refused the connection: it is ending, its max_connections is reached, \
                 or it is connected with another service of this incarnation",
                )
            }
            (Self::Hangup, Acquaintance::Unknown) => TransportError::new(
                TransportErrorKind::Incompatible,
                format_args!("the peer closed the connection before its hello; {UNKNOWN_CAUSES}"),
            ),
            (Self::Broken(what), Acquaintance::Unknown) => TransportError::new(
                TransportErrorKind::Broken,
                format_args!("{what}, before the peer's hello; {UNKNOWN_CAUSES}"),
            ),
            (Self::Hangup, Acquaintance::Proved) => TransportError::new(
                TransportErrorKind::Broken,
                format_args!("the peer closed the connection before its hello; {PROVED_CAUSES}"),
            ),
            (Self::Broken(what), Acquaintance::Proved) => TransportError::new(
                TransportErrorKind::Broken,
                format_args!("{what}, before the peer's hello; {PROVED_CAUSES}"),
            ),
            (other, _) => other.after(),
        }
    }

    /// Returns the reason for which the peer refused a connection of this side, for an end before the peer has
    /// introduced itself. `None` if this side ended it, or if it was not opened.
    pub(crate) fn refusal(&self, peer: Acquaintance) -> Option<TransportError> {
        match self {
            Self::Goodbye { .. }
            | Self::Hangup
            | Self::Broken(_)
            | Self::ProtocolViolation(_)
            | Self::OtherVersion { .. } => Some(self.before(peer)),
            #[cfg(feature = "secure")]
            Self::Tls(_) | Self::Distrusted | Self::Expired(_) => Some(self.after()),
            _ => None,
        }
    }

    /// Returns the error of parcels that the peer may have received.
    pub(crate) fn after(&self) -> TransportError {
        let (fault, detail) = match self {
            Self::NotOpened(error) => return error.clone(),
            Self::OtherVersion {
                peer,
                own,
                is_process,
            } => {
                let (this, remedy) = match is_process {
                    true => (
                        "this process",
                        "run both processes with the same release of fipa",
                    ),
                    false => (
                        "this host",
                        "install the same release of fipa on both hosts",
                    ),
                };
                let detail = format!(
                    "the peer has version {peer} of the protocol and {this} has version {own}: {remedy}"
                );
                return TransportError::new(TransportErrorKind::Incompatible, detail);
            }
            Self::ProcessEnded(what) => {
                let detail = format!("the process at this socket has ended or is ending: {what}");
                return TransportError::new(TransportErrorKind::Broken, detail);
            }
            Self::WrongIncarnation { .. } => (
                TransportErrorKind::Broken,
                "the peer has another incarnation",
            ),
            Self::Itself => (
                TransportErrorKind::Unreachable,
                "this address leads to this gateway itself, for example by a port that is forwarded \
                 here; use another address of the peer",
            ),
            Self::NotSought => (
                TransportErrorKind::Broken,
                "the peer dialed another service",
            ),
            Self::ProtocolViolation(what) => (TransportErrorKind::Broken, what.as_str()),
            Self::TooSlow(what) => (TransportErrorKind::TimedOut, *what),
            Self::Silent => (
                TransportErrorKind::TimedOut,
                "the peer did not respond in time (keep_alive)",
            ),
            Self::Broken(what) => (TransportErrorKind::Broken, what.as_str()),
            #[cfg(feature = "secure")]
            Self::Tls(what) => (TransportErrorKind::Broken, what.as_str()),
            Self::Hangup => (TransportErrorKind::Broken, "the peer closed the connection"),
            Self::Goodbye { .. } => (TransportErrorKind::Broken, "the peer ended the connection"),
            Self::Idle => (
                TransportErrorKind::Broken,
                "the connection reached its idle timeout (idle_close)",
            ),
            Self::TooManyConnections => (
                TransportErrorKind::Congested,
                "too many connections (max_connections)",
            ),
            #[cfg(feature = "secure")]
            Self::Distrusted => (TransportErrorKind::Refused, "the peer is no longer trusted"),
            #[cfg(feature = "secure")]
            Self::Expired(why) => (TransportErrorKind::Refused, why.as_str()),
            Self::IdentityConflict(why) => (TransportErrorKind::Refused, *why),
            Self::Superseded => (
                TransportErrorKind::Broken,
                "the peer opened another connection",
            ),
            Self::Closed => (TransportErrorKind::Closed, "this endpoint has been closed"),
        };
        TransportError::new(fault, detail)
    }
}
