//! What became of a letter, one outcome per receiver.

use std::fmt;

use serde::Serialize;

use crate::{Kind, Location, WayError};

/// One way that was tried and did not work.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Attempt {
    /// The transport that was tried.
    pub via: Kind,
    /// Where the letter was tried to be sent.
    pub location: Location,
    /// Why it did not work.
    pub error: WayError,
}

impl fmt::Display for Attempt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.location, self.error)
    }
}

/// What a sender is told about its letter, once per receiver and within the letter's deadline.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "outcome", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Outcome {
    /// Accepted into the named agent's queue, in the agent's process. A crash of that process
    /// afterwards is outside the promise.
    Delivered {
        /// The way it went. When the letter went to another host, the transport between the
        /// hosts.
        via: Kind,
        /// The ways that were tried before.
        attempts: Vec<Attempt>,
    },
    /// Handed to a peer that cannot confirm (fipa_services, JADE).
    Sent {
        /// The way it went.
        via: Kind,
        /// The ways that were tried before.
        attempts: Vec<Attempt>,
    },
    /// Not delivered, or ([`FailureReason::Unconfirmed`]) not known to be.
    Failed {
        /// Why.
        reason: FailureReason,
        /// The ways that were tried.
        attempts: Vec<Attempt>,
    },
}

impl Outcome {
    /// Whether the letter is known to be delivered, or was handed to a peer that cannot confirm.
    #[must_use]
    pub fn is_success(&self) -> bool {
        !matches!(self, Self::Failed { .. })
    }

    /// The way the letter went, unless it failed.
    #[must_use]
    pub fn via(&self) -> Option<Kind> {
        match self {
            Self::Delivered { via, .. } | Self::Sent { via, .. } => Some(*via),
            Self::Failed { .. } => None,
        }
    }

    /// The ways that were tried and did not work.
    #[must_use]
    pub fn attempts(&self) -> &[Attempt] {
        match self {
            Self::Delivered { attempts, .. }
            | Self::Sent { attempts, .. }
            | Self::Failed { attempts, .. } => attempts,
        }
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let attempts = match self {
            Self::Delivered { via, attempts } => {
                write!(f, "delivered via {via}")?;
                attempts
            }
            Self::Sent { via, attempts } => {
                write!(f, "sent via {via} (the peer cannot confirm)")?;
                attempts
            }
            Self::Failed { reason, attempts } => {
                write!(f, "failed: {reason}")?;
                attempts
            }
        };
        for same in attempts.chunk_by(|one, other| one == other) {
            let Some(attempt) = same.first() else {
                continue;
            };
            write!(f, "; tried {attempt}")?;
            if same.len() > 1 {
                write!(f, " ({} times)", same.len())?;
            }
        }
        Ok(())
    }
}

/// Why a letter was not delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum FailureReason {
    /// Nobody has this name, or the agent that had it is gone.
    NoSuchAgent,
    /// The agent's queue stayed full until the deadline.
    QueueFull,
    /// No way led to the agent before the deadline.
    Unreachable,
    /// The receiver, or a service on the way, does not take this letter.
    Refused,
    /// Larger than any way to this receiver takes.
    TooLarge,
    /// The deadline passed.
    TimedOut,
    /// It may have been delivered, but whoever knew is gone.
    Unconfirmed,
    /// The letter came back to a service that had already stamped it.
    Loop,
    /// The sender's own service is closed.
    Closed,
    /// The dialect of the legacy peer that the receiver belongs to has no form for something in the
    /// letter.
    Inexpressible,
    /// The receiver is reached only by transports that this project does not have. The attempts
    /// name them.
    Unsupported,
}

impl FailureReason {
    /// Every reason, for encoding: the position is the code on the wire, so new ones go last.
    pub(crate) const CODES: [Self; 11] = [
        Self::NoSuchAgent,
        Self::QueueFull,
        Self::Unreachable,
        Self::Refused,
        Self::TooLarge,
        Self::TimedOut,
        Self::Unconfirmed,
        Self::Loop,
        Self::Closed,
        Self::Inexpressible,
        Self::Unsupported,
    ];
}

impl fmt::Display for FailureReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NoSuchAgent => "no such agent",
            Self::QueueFull => "queue full",
            Self::Unreachable => "unreachable",
            Self::Refused => "refused",
            Self::TooLarge => "too large",
            Self::TimedOut => "timed out",
            Self::Unconfirmed => "unconfirmed",
            Self::Loop => "loop",
            Self::Closed => "closed",
            Self::Inexpressible => "not expressible in the peer's dialect",
            Self::Unsupported => "unsupported transport",
        })
    }
}
