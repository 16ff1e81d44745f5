//! Errors as other languages see them: a kind, and a text.

use std::error::Error as _;
use std::fmt;

use fipa::FailureReason;
use fipa::actions::ActionError;
use fipa::error::{OpenError, ReceiveError, RegisterError, SendError};
use fipa::locks::LockError;
use fipa::platform::PlatformError;
use fipa::protocol::DialogueError;

/// The kind of a failure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(
    clippy::exhaustive_enums,
    reason = "each interface has a form for each kind"
)]
pub enum FailureKind {
    /// A pointer is NULL, a text is not UTF-8, a number is out of bounds, or a name or a configuration is invalid.
    Invalid,
    /// The handle was closed, is of another kind, or was never given out.
    BadHandle,
    /// The agent was deregistered, or the domain was closed.
    Closed,
    /// This process was forked from the one that opened the library. A child calls exec first.
    Forked,
    /// The time limit is over before the operation has ended.
    TimedOut,
    /// A letter was not delivered to each of its receivers.
    NotDelivered,
    /// The other agent refuses, fails, or does not understand.
    Refused,
    /// The other agent is gone, or its host is silent.
    Gone,
    /// The conversation was cancelled.
    Cancelled,
    /// A message violates its protocol.
    Violation,
    /// The lock was lost.
    Lost,
    /// The letter or the content is too large.
    TooLarge,
    /// Another agent has the name.
    NameTaken,
    /// A fence is missing, or is not the live one.
    Stale,
    /// Another failure; the text says which.
    Failed,
}

/// A failed call.
#[derive(Debug, Clone)]
#[allow(
    clippy::exhaustive_structs,
    reason = "the interfaces build and take apart failures"
)]
pub struct Failure {
    /// The kind.
    pub kind: FailureKind,
    /// The error with its causes.
    pub text: String,
}

impl Failure {
    /// Creates a failure.
    pub fn new(kind: FailureKind, text: impl Into<String>) -> Self {
        let text = text.into();
        Self { kind, text }
    }

    /// Creates a failure for a wrong argument.
    pub fn invalid(text: impl Into<String>) -> Self {
        Self::new(FailureKind::Invalid, text)
    }

    /// Describes an error of the library.
    pub fn of(error: impl Into<fipa::Error>) -> Self {
        let error = error.into();
        Self {
            kind: kind_of(&error),
            // With its causes.
            text: format!("{error:?}"),
        }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// Turns an error of the library into a failure.
pub trait OrFail<T> {
    /// Describes the error.
    ///
    /// # Errors
    /// If `self` is an error.
    fn or_fail(self) -> Result<T, Failure>;
}

impl<T, E: Into<fipa::Error>> OrFail<T> for Result<T, E> {
    fn or_fail(self) -> Result<T, Failure> {
        self.map_err(Failure::of)
    }
}

fn kind_of(error: &fipa::Error) -> FailureKind {
    use fipa::Error;
    if is_forked(error) {
        return FailureKind::Forked;
    }
    match error {
        Error::Dialogue(error)
        | Error::Action(ActionError::Dialogue(error))
        | Error::Platform(PlatformError::Dialogue(error)) => dialogue(error),
        Error::Action(ActionError::Refused(_) | ActionError::Failed(_))
        | Error::Platform(PlatformError::Rejected(_)) => FailureKind::Refused,
        Error::Send(error) => send(error),
        Error::Receive(ReceiveError::Closed) => FailureKind::Closed,
        Error::Lock(error) => lock(error),
        Error::Admit(_) => FailureKind::Stale,
        Error::Open(OpenError::Config(_)) => FailureKind::Invalid,
        Error::Register(RegisterError::AlreadyRegistered { .. }) => FailureKind::NameTaken,
        Error::Config(_)
        | Error::Rule(_)
        | Error::Build(_)
        | Error::AgentId(_)
        | Error::Name(_)
        | Error::Pattern(_)
        | Error::Performative(_)
        | Error::Time(_)
        | Error::Members(_) => FailureKind::Invalid,
        _ => FailureKind::Failed,
    }
}

fn dialogue(error: &DialogueError) -> FailureKind {
    match error {
        DialogueError::Refused(_) | DialogueError::Failed(_) | DialogueError::NotUnderstood(_) => {
            FailureKind::Refused
        }
        DialogueError::Cancelled(_) => FailureKind::Cancelled,
        DialogueError::NotDelivered {
            reason: FailureReason::Closed,
            ..
        } => FailureKind::Closed,
        DialogueError::NotDelivered { .. } | DialogueError::Undelivered(_) => {
            FailureKind::NotDelivered
        }
        DialogueError::TimedOut => FailureKind::TimedOut,
        DialogueError::Gone { .. } | DialogueError::Unreachable { .. } => FailureKind::Gone,
        DialogueError::Violation { .. } | DialogueError::WouldViolate(_) => FailureKind::Violation,
        DialogueError::Build(_) => FailureKind::Invalid,
        DialogueError::Send(error) => send(error),
        DialogueError::Receive(_) => FailureKind::Closed,
        _ => FailureKind::Failed,
    }
}

fn send(error: &SendError) -> FailureKind {
    match error {
        SendError::NoReceiver | SendError::Build(_) => FailureKind::Invalid,
        SendError::Violation(_) => FailureKind::Violation,
        SendError::TooLarge { .. } => FailureKind::TooLarge,
        SendError::Deregistered => FailureKind::Closed,
        _ => FailureKind::Failed,
    }
}

fn lock(error: &LockError) -> FailureKind {
    match error {
        LockError::Name(_) => FailureKind::Invalid,
        LockError::Unreachable { .. } => FailureKind::Gone,
        LockError::TimedOut { .. } | LockError::OwnerNotFound { .. } => FailureKind::TimedOut,
        LockError::Refused { .. } => FailureKind::Refused,
        LockError::Lost { .. } => FailureKind::Lost,
        LockError::Closed => FailureKind::Closed,
        _ => FailureKind::Failed,
    }
}

/// Whether the error, or a cause of it, is that this process is a forked child.
fn is_forked(error: &fipa::Error) -> bool {
    if matches!(error, fipa::Error::Forked(_)) {
        return true;
    }
    let mut cause = error.source();
    while let Some(error) = cause {
        if error.is::<fipa::error::Forked>() {
            return true;
        }
        cause = error.source();
    }
    false
}
