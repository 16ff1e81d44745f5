//! Result codes, and the text of the last failure of a thread.

use std::any::Any;
use std::cell::RefCell;
use std::error::Error as _;
use std::panic::{AssertUnwindSafe, catch_unwind};

use fipa::error::{OpenError, ReceiveError, RegisterError, SendError};
use fipa::locks::LockError;
use fipa::protocol::DialogueError;

use crate::fork;

/// The result of a call. Zero is success, a positive number is success without a value, and a negative
/// number is a failure. `fipa_error` has its text.
#[repr(i32)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FipaResult {
    /// The call has succeeded.
    Ok = 0,
    /// The time limit is over and nothing has arrived: no letter, no item.
    Empty = 1,
    /// A pointer is NULL, a text is not UTF-8, a number is out of bounds, or a name or a configuration is invalid.
    Invalid = -1,
    /// The handle was closed, is of another kind, or was never given out.
    BadHandle = -2,
    /// The agent was deregistered, or the domain was closed.
    Closed = -3,
    /// This process was forked from the one that opened the library. A child calls exec first.
    Forked = -4,
    /// The time limit is over before the operation has ended.
    TimedOut = -5,
    /// A letter was not delivered to each of its receivers.
    NotDelivered = -6,
    /// The other agent refuses, fails, or does not understand.
    Refused = -7,
    /// The other agent is gone, or its host is silent.
    Gone = -8,
    /// The conversation was cancelled.
    Cancelled = -9,
    /// A message violates its protocol.
    Violation = -10,
    /// The lock was lost.
    Lost = -11,
    /// The letter or the content is too large.
    TooLarge = -12,
    /// Another agent has the name.
    NameTaken = -13,
    /// A fence is missing, or is not the live one.
    Stale = -14,
    /// Another failure; the text says which.
    Failed = -15,
    /// A mistake of this library. The call had no effect that can be relied on.
    Panic = -16,
}

/// A failed call.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) code: FipaResult,
    pub(crate) text: String,
}

impl Failure {
    pub(crate) fn new(code: FipaResult, text: impl Into<String>) -> Self {
        let text = text.into();
        Self { code, text }
    }

    pub(crate) fn invalid(text: impl Into<String>) -> Self {
        Self::new(FipaResult::Invalid, text)
    }

    pub(crate) fn of(error: impl Into<fipa::Error>) -> Self {
        let error = error.into();
        Self {
            code: code(&error),
            // With its causes.
            text: format!("{error:?}"),
        }
    }

    /// Stores the text as that of the last failure of this thread.
    pub(crate) fn store(self) -> FipaResult {
        LAST.replace(self.text);
        self.code
    }
}

/// Turns an error of the library into a failure.
pub(crate) trait OrFail<T> {
    fn or_fail(self) -> Result<T, Failure>;
}

impl<T, E: Into<fipa::Error>> OrFail<T> for Result<T, E> {
    fn or_fail(self) -> Result<T, Failure> {
        self.map_err(Failure::of)
    }
}

fn code(error: &fipa::Error) -> FipaResult {
    use fipa::Error;
    if is_forked(error) {
        return FipaResult::Forked;
    }
    match error {
        Error::Dialogue(error) => dialogue(error),
        Error::Send(error) => send(error),
        Error::Receive(ReceiveError::Closed) => FipaResult::Closed,
        Error::Lock(error) => lock(error),
        Error::Admit(_) => FipaResult::Stale,
        Error::Open(OpenError::Config(_)) => FipaResult::Invalid,
        Error::Register(RegisterError::AlreadyRegistered { .. }) => FipaResult::NameTaken,
        Error::Config(_)
        | Error::Rule(_)
        | Error::Build(_)
        | Error::AgentId(_)
        | Error::Name(_)
        | Error::Pattern(_)
        | Error::Performative(_)
        | Error::Time(_)
        | Error::Members(_) => FipaResult::Invalid,
        _ => FipaResult::Failed,
    }
}

fn dialogue(error: &DialogueError) -> FipaResult {
    match error {
        DialogueError::Refused(_) | DialogueError::Failed(_) | DialogueError::NotUnderstood(_) => {
            FipaResult::Refused
        }
        DialogueError::Cancelled(_) => FipaResult::Cancelled,
        DialogueError::NotDelivered { .. } | DialogueError::Undelivered(_) => {
            FipaResult::NotDelivered
        }
        DialogueError::TimedOut => FipaResult::TimedOut,
        DialogueError::Gone { .. } | DialogueError::Unreachable { .. } => FipaResult::Gone,
        DialogueError::Violation { .. } | DialogueError::WouldViolate(_) => FipaResult::Violation,
        DialogueError::Build(_) => FipaResult::Invalid,
        DialogueError::Send(error) => send(error),
        DialogueError::Receive(_) => FipaResult::Closed,
        _ => FipaResult::Failed,
    }
}

fn send(error: &SendError) -> FipaResult {
    match error {
        SendError::NoReceiver | SendError::Build(_) => FipaResult::Invalid,
        SendError::Violation(_) => FipaResult::Violation,
        SendError::TooLarge { .. } => FipaResult::TooLarge,
        SendError::Deregistered => FipaResult::Closed,
        _ => FipaResult::Failed,
    }
}

fn lock(error: &LockError) -> FipaResult {
    match error {
        LockError::Name(_) => FipaResult::Invalid,
        LockError::Unreachable { .. } => FipaResult::Gone,
        LockError::TimedOut { .. } | LockError::OwnerNotFound { .. } => FipaResult::TimedOut,
        LockError::Refused { .. } => FipaResult::Refused,
        LockError::Lost { .. } => FipaResult::Lost,
        LockError::Closed => FipaResult::Closed,
        _ => FipaResult::Failed,
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

thread_local! {
    static LAST: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Reads the text of the last failure of this thread, which stays until its next one. Empty if none has failed.
pub(crate) fn last<T>(read: impl FnOnce(&str) -> T) -> T {
    LAST.with_borrow(|text| read(text))
}

/// Runs the body of a call: an error becomes its code, and a panic does not reach the caller.
pub(crate) fn call(body: impl FnOnce() -> Result<FipaResult, Failure>) -> FipaResult {
    if fork::is_child() {
        return Failure::new(
            FipaResult::Forked,
            "this process was forked from one that uses fipa; call exec in the child, or fork before the first call",
        )
        .store();
    }
    match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(result)) => result,
        Ok(Err(failure)) => failure.store(),
        Err(panic) => Failure::new(FipaResult::Panic, panic_text(&*panic)).store(),
    }
}

fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    format!(
        "a mistake of fipa, please report it: {}",
        text.unwrap_or("panic")
    )
}
