//! Why a connection ends, and what that means for the parcels on it.

use fipa_transport::{Incarnation, Location, WayError, WayFault};

/// Why a connection ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum End {
    /// It could not be opened.
    NotOpened(WayError),
    /// The peer is not the one that was meant.
    WrongIncarnation {
        expected: Incarnation,
        found: Incarnation,
    },
    /// The peer looked for a service of another incarnation than this one.
    NotSought,
    /// The peer sent what it must not send.
    Nonsense(String),
    /// The peer was too slow to say hello, or in the middle of a frame.
    TooSlow(&'static str),
    /// The peer gave no sign of life.
    Silent,
    /// The operating system says that the connection broke.
    Broken(String),
    /// The peer closed the connection without a goodbye.
    Hangup,
    /// The peer said goodbye, having taken parcels up to this one.
    Goodbye { last: u64 },
    /// Nothing had been going on for long.
    Idle,
    /// There are too many connections.
    Crowd,
    /// Trust in the peer has been withdrawn.
    #[cfg(feature = "secure")]
    Distrusted,
    /// The peer's certificate has expired.
    #[cfg(feature = "secure")]
    Expired,
    /// The peer opened another connection in place of this one.
    Superseded,
    /// The service that the peer says it is has a connection already, for this reason not with it.
    Impostor(&'static str),
    /// This endpoint closes.
    Closed,
}

impl End {
    /// No connection could be opened to a location.
    pub(crate) fn unreachable(to: &Location, what: &dyn std::fmt::Display) -> Self {
        let detail = format!("{}: {what}", to.address());
        Self::NotOpened(WayError::new(WayFault::Unreachable, detail))
    }

    /// Whether this side ends the connection in good order, with a goodbye.
    pub(crate) fn is_orderly(&self) -> bool {
        matches!(
            self,
            Self::WrongIncarnation { .. }
                | Self::NotSought
                | Self::Idle
                | Self::Crowd
                | Self::Impostor(_)
                | Self::Closed
        )
    }

    /// Whether the peer is to blame.
    pub(crate) fn is_misbehaviour(&self) -> bool {
        matches!(self, Self::Nonsense(_) | Self::TooSlow(_))
    }

    /// What is said about parcels that the peer cannot have got. `greeted` is whether the peer
    /// had said hello.
    pub(crate) fn before(&self, greeted: bool) -> WayError {
        match self {
            Self::NotOpened(error) => error.clone(),
            Self::WrongIncarnation { expected, found } => WayError::new(
                WayFault::WrongIncarnation,
                format_args!("{found} answers there, not {expected}"),
            ),
            Self::Nonsense(what) => WayError::new(WayFault::Incompatible, what),
            Self::Goodbye { .. } if !greeted => WayError::new(
                WayFault::Refused,
                "the peer takes no more connections (its max_connections), \
                 or has one with another service of this incarnation",
            ),
            Self::Hangup if !greeted => WayError::new(
                WayFault::Incompatible,
                "the peer closed the connection instead of saying hello; \
                 is a fipa endpoint listening there?",
            ),
            other => other.after(),
        }
    }

    /// What is said about parcels that the peer may have got.
    pub(crate) fn after(&self) -> WayError {
        let (fault, detail) = match self {
            Self::NotOpened(error) => return error.clone(),
            Self::WrongIncarnation { .. } => (WayFault::Broken, "the peer is another one"),
            Self::NotSought => (WayFault::Broken, "the peer looked for another service"),
            Self::Nonsense(what) => (WayFault::Broken, what.as_str()),
            Self::TooSlow(what) => (WayFault::TimedOut, *what),
            Self::Silent => (WayFault::TimedOut, "the peer gave no sign of life"),
            Self::Broken(what) => (WayFault::Broken, what.as_str()),
            Self::Hangup => (WayFault::Broken, "the peer closed the connection"),
            Self::Goodbye { .. } => (WayFault::Broken, "the peer said goodbye"),
            Self::Idle => (
                WayFault::Broken,
                "the connection had been idle for too long",
            ),
            Self::Crowd => (
                WayFault::Congested,
                "too many connections (max_connections)",
            ),
            #[cfg(feature = "secure")]
            Self::Distrusted => (WayFault::Refused, "the peer is not trusted any more"),
            #[cfg(feature = "secure")]
            Self::Expired => (
                WayFault::Refused,
                "the peer's certificate has expired: `fipa keys renew` there",
            ),
            Self::Impostor(why) => (WayFault::Refused, *why),
            Self::Superseded => (WayFault::Broken, "the peer opened another connection"),
            Self::Closed => (WayFault::Closed, "this endpoint has been closed"),
        };
        WayError::new(fault, detail)
    }
}
