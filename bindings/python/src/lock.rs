//! A lock that an agent holds.

use fipa::MessageBuilder;
use fipa::locks::Lock as Held;
use fipa_bindings::{Failure, FailureKind};
use parking_lot::Mutex;
use pyo3::types::PyTuple;
use pyo3::{Bound, Py, PyResult, Python, pyclass, pymethods};

use crate::failure::{exception, raised};
use crate::pending::{Output, Pending};

/// A lock that the agent holds. Messages with it (`Message(lock=...)`) carry its fences.
#[pyclass(frozen, module = "fipa")]
#[derive(Debug)]
pub(crate) struct Lock {
    /// `None` after the release.
    held: Mutex<Option<Held>>,
}

impl Lock {
    pub(crate) fn new(held: Held) -> Self {
        Self {
            held: Mutex::new(Some(held)),
        }
    }

    /// Reads the lock; `None` after its release.
    pub(crate) fn read<R>(&self, read: impl FnOnce(&Held) -> R) -> Option<R> {
        self.held.lock().as_ref().map(read)
    }

    /// Adds the fences to a message.
    pub(crate) fn guard(&self, message: MessageBuilder) -> PyResult<MessageBuilder> {
        match &*self.held.lock() {
            Some(held) => Ok(held.guard(message)),
            None => Err(Python::attach(|py| raised(py, released()))),
        }
    }
}

fn released() -> Failure {
    Failure::new(FailureKind::Lost, "the lock was released")
}

#[pymethods]
impl Lock {
    /// The fence of the first resource, if its owner gives one.
    #[getter]
    fn fence(&self) -> Option<String> {
        self.read(|held| held.fence().map(ToString::to_string))
            .flatten()
    }

    /// Whether the agent holds all resources.
    #[getter]
    fn is_held(&self) -> bool {
        self.read(Held::is_held).unwrap_or(false)
    }

    /// Time in seconds until the shortest lease ends unless it is renewed; `None` if no owner gives a lease.
    #[getter]
    fn remaining(&self) -> Option<f64> {
        match self.read(Held::remaining) {
            Some(remaining) => remaining.map(|it| it.as_secs_f64()),
            None => Some(0.0),
        }
    }

    /// Waits until the lock is lost or released. The value is the reason, an exception.
    fn lost(&self) -> Pending {
        let lost = self.read(Held::lost);
        Pending::begun(async move {
            let failure = match lost {
                Some(lost) => Failure::of(lost.await),
                None => released(),
            };
            Ok(Box::new(|py: Python<'_>| exception(py, failure)) as Output)
        })
    }

    /// Releases the lock.
    fn release(&self) {
        let held = self.held.lock().take();
        drop(held);
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyTuple>) {
        self.release();
    }
}
