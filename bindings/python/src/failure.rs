//! Exceptions: the classes of the module `fipa._errors`.

use fipa_bindings::{Failure, FailureKind};
use pyo3::{Py, PyAny, PyErr, PyResult, Python};

use crate::interpreter::call;

/// Returns the exception for a failure.
pub(crate) fn raised(py: Python<'_>, failure: Failure) -> PyErr {
    match exception(py, failure) {
        Ok(exception) => PyErr::from_value(exception.into_bound(py)),
        Err(error) => error,
    }
}

/// Creates the exception for a failure.
pub(crate) fn exception(py: Python<'_>, failure: Failure) -> PyResult<Py<PyAny>> {
    let class = match failure.kind {
        FailureKind::Invalid => "Invalid",
        FailureKind::Closed | FailureKind::BadHandle => "Closed",
        FailureKind::Forked => "Forked",
        FailureKind::TimedOut => "TimedOut",
        FailureKind::NotDelivered => "NotDelivered",
        FailureKind::Refused => "Refused",
        FailureKind::Gone => "Gone",
        FailureKind::Cancelled => "Cancelled",
        FailureKind::Violation => "Violation",
        FailureKind::Lost => "Lost",
        FailureKind::TooLarge => "TooLarge",
        FailureKind::NameTaken => "NameTaken",
        FailureKind::Stale => "Stale",
        FailureKind::Failed => "Error",
    };
    Ok(call(py, "fipa._errors", class, (failure.text,))?.unbind())
}

/// Turns a failure into an exception.
pub(crate) trait OrRaise<T> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T>;
}

impl<T> OrRaise<T> for Result<T, Failure> {
    fn or_raise(self, py: Python<'_>) -> PyResult<T> {
        self.map_err(|failure| raised(py, failure))
    }
}
