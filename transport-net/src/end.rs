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
    /// The peer dialled another incarnation than this one.
    NotSought,
    /// The peer violated the protocol.
    ProtocolViolation(String),
    /// The peer sent its hello or a frame too slowly.
    TooSlow(&'static str),
    /// The peer did not respond to a ping.
    Silent,
    /// The operating system reported an error.
    Broken(String),
    /// The peer closed the connection without a goodbye.
    Hangup,
    /// The peer sent a goodbye after accepting parcels up to this number.
    Goodbye { last: u64 },
    /// The connection reached its idle timeout.
    Idle,
    /// A connection limit is reached.
    TooManyConnections,
    /// The peer is no longer trusted.
    #[cfg(feature = "secure")]
    Distrusted,
    /// The peer's certificate has expired.
    #[cfg(feature = "secure")]
    Expired,
    /// The peer opened another connection in place of this one.
    Superseded,
    /// The peer claims to be a service that is connected with another peer.
    IdentityConflict(&'static str),
    /// This endpoint closes.
    Closed,
}

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

    /// Returns the error of parcels that the peer cannot have received. `greeted` is whether the
    /// peer's hello had arrived.
    pub(crate) fn before(&self, greeted: bool) -> TransportError {
        match self {
            Self::NotOpened(error) => error.clone(),
            Self::WrongIncarnation { expected, found } => TransportError::new(
                TransportErrorKind::WrongIncarnation,
                format_args!("the service at this address has incarnation {found}, not {expected}"),
            ),
            Self::ProtocolViolation(what) => {
                TransportError::new(TransportErrorKind::Incompatible, what)
            }
            Self::Goodbye { .. } if !greeted => TransportError::new(
                TransportErrorKind::Refused,
                "the peer refused the connection: its max_connections is reached, \
                 or it is connected with another service of this incarnation",
            ),
            Self::Hangup if !greeted => TransportError::new(
                TransportErrorKind::Incompatible,
                "the peer closed the connection before its hello: the peer requires keys and this host \
                 has none (set security.keys here, see `fipa keys`), or no fipa gateway listens there",
            ),
            Self::Broken(what) if !greeted => TransportError::new(
                TransportErrorKind::Broken,
                format_args!(
                    "{what}, before the peer's hello: the peer may require keys that this host has not \
                     (set security.keys here, see `fipa keys`)"
                ),
            ),
            other => other.after(),
        }
    }

    /// Returns the reason for which the peer refused a connection of this side, for an end before the peer has
    /// introduced itself. `None` if this side ended it, or if it was not opened.
    pub(crate) fn refusal(&self) -> Option<TransportError> {
        match self {
            Self::Goodbye { .. } | Self::Hangup | Self::Broken(_) | Self::ProtocolViolation(_) => {
                Some(self.before(false))
            }
            #[cfg(feature = "secure")]
            Self::Distrusted | Self::Expired => Some(self.after()),
            _ => None,
        }
    }

    /// Returns the error of parcels that the peer may have received.
    pub(crate) fn after(&self) -> TransportError {
        let (fault, detail) = match self {
            Self::NotOpened(error) => return error.clone(),
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
                "the peer dialled another service",
            ),
            Self::ProtocolViolation(what) => (TransportErrorKind::Broken, what.as_str()),
            Self::TooSlow(what) => (TransportErrorKind::TimedOut, *what),
            Self::Silent => (
                TransportErrorKind::TimedOut,
                "the peer did not respond in time (keep_alive)",
            ),
            Self::Broken(what) => (TransportErrorKind::Broken, what.as_str()),
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
            Self::Expired => (
                TransportErrorKind::Refused,
                "the peer's certificate has expired; run `fipa keys renew` on the peer's host",
            ),
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
