//! The errors of transports.

use std::fmt;

use fipa_acl::escape;
use serde::Serialize;

/// The error of an attempt.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error, Serialize)]
#[error("{}{}{}", fault.description(), if detail.is_empty() { "" } else { ": " }, escape(detail))]
pub struct TransportError {
    /// The kind of fault.
    pub fault: TransportErrorKind,
    /// Details for people: the error of the operating system, and a remedy. May contain text of a
    /// peer; `Display` [escapes](fipa_acl::escape) it.
    pub detail: String,
}

impl TransportError {
    /// Creates an error with a detail for people.
    pub fn new(fault: TransportErrorKind, detail: impl fmt::Display) -> Self {
        Self {
            fault,
            detail: detail.to_string(),
        }
    }
}

/// The kinds of faults of a transport.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum TransportErrorKind {
    /// No service at the location, or no network path to it.
    Unreachable,
    /// A service of another incarnation than expected is at the location.
    WrongIncarnation,
    /// The letter is longer than this transport's limit.
    TooLarge,
    /// The window for the location is full, or another part is temporarily short. A later attempt may
    /// succeed.
    Congested,
    /// The connection broke, or the other process ended, before an answer came.
    Broken,
    /// No answer came in time.
    TimedOut,
    /// The other side has another protocol version, or sent malformed data.
    Incompatible,
    /// The other side refuses the parcel.
    Refused,
    /// This transport has been closed or cannot be used on this machine.
    Closed,
    /// This side has no memory, descriptors or disk space left for the attempt.
    Exhausted,
    /// The peer's dialect has no representation for a part of the letter. No byte was sent.
    Inexpressible,
    /// There is no transport of this kind.
    Unsupported,
    /// Loans and letters that are not received yet use up the memory. A later attempt may succeed.
    NoRoom,
    /// The other side proves no identity that this side trusts. Another attempt at the location would end the
    /// same way. In answers and reports to other services, it is [`Refused`](Self::Refused).
    Distrusted,
}

impl TransportErrorKind {
    /// All faults with a code. The position is the code on the wire, so new ones go last.
    pub(crate) const CODES: [Self; 13] = [
        Self::Unreachable,
        Self::WrongIncarnation,
        Self::TooLarge,
        Self::Congested,
        Self::Broken,
        Self::TimedOut,
        Self::Incompatible,
        Self::Refused,
        Self::Closed,
        Self::Exhausted,
        Self::Inexpressible,
        Self::Unsupported,
        Self::NoRoom,
    ];

    /// Whether an attempt failed for lack of a place that the end of another attempt may free.
    #[must_use]
    pub fn waits_for_room(self) -> bool {
        matches!(self, Self::Congested | Self::NoRoom)
    }

    fn description(self) -> &'static str {
        match self {
            Self::Unreachable => "unreachable",
            Self::WrongIncarnation => "another process has this address now",
            Self::TooLarge => "too large for this transport",
            Self::Congested => "congested",
            Self::Broken => "connection broken",
            Self::TimedOut => "no answer in time",
            Self::Incompatible => "incompatible",
            Self::Refused => "refused",
            Self::Closed => "closed",
            Self::Exhausted => "out of resources",
            Self::Inexpressible => "the peer's dialect cannot express it",
            Self::Unsupported => "unsupported transport",
            Self::NoRoom => "no memory",
            Self::Distrusted => "not trusted",
        }
    }
}

/// The error of opening an endpoint.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ListenError {
    /// An address could not be listened on.
    #[error("cannot listen on {address}")]
    Bind {
        /// The address as configured.
        address: String,
        /// The error of the operating system.
        source: std::io::Error,
    },
    /// A requirement of the transport is missing; the text names the remedy.
    #[error("{0}")]
    Unavailable(String),
    /// `listen` was called twice, or after `close`.
    #[error("this endpoint is already listening or closed")]
    OpenedBefore,
}
