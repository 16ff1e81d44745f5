//! Result codes, and the text of the last failure of a thread.

use std::any::Any;
use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};

use fipa_bindings::{Failure, FailureKind};

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

impl From<FailureKind> for FipaResult {
    fn from(kind: FailureKind) -> Self {
        match kind {
            FailureKind::Invalid => Self::Invalid,
            FailureKind::BadHandle => Self::BadHandle,
            FailureKind::Closed => Self::Closed,
            FailureKind::Forked => Self::Forked,
            FailureKind::TimedOut => Self::TimedOut,
            FailureKind::NotDelivered => Self::NotDelivered,
            FailureKind::Refused => Self::Refused,
            FailureKind::Gone => Self::Gone,
            FailureKind::Cancelled => Self::Cancelled,
            FailureKind::Violation => Self::Violation,
            FailureKind::Lost => Self::Lost,
            FailureKind::TooLarge => Self::TooLarge,
            FailureKind::NameTaken => Self::NameTaken,
            FailureKind::Stale => Self::Stale,
            FailureKind::Failed => Self::Failed,
        }
    }
}

/// Stores the text of a failure as that of the last failure of this thread.
pub(crate) fn store(failure: Failure) -> FipaResult {
    LAST.replace(failure.text);
    failure.kind.into()
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
        return store(Failure::new(
            FailureKind::Forked,
            "this process was forked from one that uses fipa; call exec in the child, or fork before the first call",
        ));
    }
    match catch_unwind(AssertUnwindSafe(body)) {
        Ok(Ok(result)) => result,
        Ok(Err(failure)) => store(failure),
        Err(panic) => {
            LAST.replace(panic_text(&*panic));
            FipaResult::Panic
        }
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
