//! Outcomes of letters, one per receiver.

use std::fmt;

use serde::Serialize;

use crate::{Kind, Location, TransportError};

/// A failed attempt to send a letter.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Attempt {
    /// The transport of the attempt.
    pub via: Kind,
    /// The location that the letter was sent to.
    pub location: Location,
    /// The cause of the failure.
    pub error: TransportError,
}

impl fmt::Display for Attempt {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.location, self.error)
    }
}

/// The final result of a letter, one per receiver, within the letter's deadline.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(tag = "outcome", rename_all = "snake_case")]
#[non_exhaustive]
pub enum Outcome {
    /// Accepted into the queue of the named agent, in the agent's process. A later crash of that
    /// process is outside of the promise.
    Delivered {
        /// The transport that delivered the letter. For a letter to another host, the transport
        /// between the hosts.
        via: Kind,
        /// The failed attempts before.
        attempts: Vec<Attempt>,
    },
    /// Handed to a peer that cannot confirm (fipa_services, JADE).
    Sent {
        /// The transport that carried the letter.
        via: Kind,
        /// The failed attempts before.
        attempts: Vec<Attempt>,
    },
    /// Not delivered, or ([`FailureReason::Unconfirmed`]) possibly delivered.
    Failed {
        /// The reason.
        reason: FailureReason,
        /// The failed attempts.
        attempts: Vec<Attempt>,
    },
}

impl Outcome {
    /// Whether the letter was delivered, or was handed to a peer that cannot confirm.
    #[must_use]
    pub fn is_success(&self) -> bool {
        !matches!(self, Self::Failed { .. })
    }

    /// The transport that carried the letter, unless it failed.
    #[must_use]
    pub fn via(&self) -> Option<Kind> {
        match self {
            Self::Delivered { via, .. } | Self::Sent { via, .. } => Some(*via),
            Self::Failed { .. } => None,
        }
    }

    /// The failed attempts.
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
        // Each location once, in the order of the first attempts, with its last error.
        for (index, attempt) in attempts.iter().enumerate() {
            let is_same =
                |other: &&Attempt| (other.via, &other.location) == (attempt.via, &attempt.location);
            if attempts.iter().take(index).any(|it| is_same(&it)) {
                continue;
            }
            let same = attempts.iter().filter(is_same);
            let (count, last) = same.fold((0, attempt), |(count, _), it| (count + 1, it));
            write!(f, "; tried {last}")?;
            if count > 1 {
                write!(f, " ({count} attempts)")?;
            }
        }
        Ok(())
    }
}

/// The reason why a letter was not delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum FailureReason {
    /// No agent has this name, or the agent that had it has ended.
    NoSuchAgent,
    /// The agent's queue stayed full until the deadline.
    QueueFull,
    /// No route led to the agent before the deadline.
    Unreachable,
    /// The receiver, or a service on the route, refuses this letter.
    Refused,
    /// Larger than the limit of every route to this receiver.
    TooLarge,
    /// The deadline passed.
    TimedOut,
    /// The letter may have been delivered, and no confirmation came.
    Unconfirmed,
    /// The letter came back to a service that had already stamped it.
    Loop,
    /// The sender's own service is closed.
    Closed,
    /// The dialect of the receiver's legacy peer has no representation for a part of the letter.
    Inexpressible,
    /// The receiver has only locations of unsupported transports, which the attempts list.
    Unsupported,
    /// This side had no memory for the letter until the deadline.
    NoRoom,
}

impl FailureReason {
    /// All reasons. The position is the code on the wire, so new ones go last.
    pub(crate) const CODES: [Self; 12] = [
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
        Self::NoRoom,
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
            Self::NoRoom => "no memory for the letter",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::TransportErrorKind;

    #[test]
    fn the_text_has_each_location_once_with_its_last_error() {
        let attempt = |location: &str, detail: &str| {
            let location: Location = location.parse().unwrap();
            Attempt {
                via: location.kind(),
                location,
                error: TransportError::new(TransportErrorKind::Unreachable, detail),
            }
        };
        let (near, far) = ("tcp://10.0.0.3:7788", "tcp://10.0.0.4:7788");
        let outcome = Outcome::Failed {
            reason: FailureReason::Unreachable,
            attempts: vec![
                attempt(near, "no answer"),
                attempt(far, "refused"),
                attempt(near, "no answer"),
                attempt(near, "reset"),
            ],
        };
        assert_eq!(
            outcome.to_string(),
            "failed: unreachable; tried tcp://10.0.0.3:7788: unreachable: reset (3 attempts); \
             tried tcp://10.0.0.4:7788: unreachable: refused"
        );
    }
}
