//! Sequences of events.

use std::fmt;
use std::sync::Arc;

use fipa_bindings::Failure;
use futures_core::Stream;
use futures_core::stream::BoxStream;
use futures_util::StreamExt as _;
use pyo3::{Py, PyAny, PyResult, Python, pyclass, pymethods};
use tokio::sync::{Mutex, Notify};

use crate::pending::{Output, Pending, step};

/// A sequence of events. Iterate over it with `for` or `async for`, or ask for the next event.
///
/// Events wait in the library until the program asks for them. A wait that is cancelled loses none.
#[pyclass(frozen, generic, subclass, module = "fipa")]
pub(crate) struct Events {
    shared: Arc<Shared>,
}

struct Shared {
    /// `None` after the end.
    stream: Mutex<Option<BoxStream<'static, Result<Output, Failure>>>>,
    closed: Notify,
}

impl Events {
    pub(crate) fn new(
        stream: impl Stream<Item = Result<Output, Failure>> + Send + 'static,
    ) -> Self {
        Self {
            shared: Arc::new(Shared {
                stream: Mutex::new(Some(stream.boxed())),
                closed: Notify::new(),
            }),
        }
    }

    fn pending(&self, is_step: bool) -> Pending {
        let shared = Arc::clone(&self.shared);
        Pending::next(is_step, async move {
            let mut stream = shared.stream.lock().await;
            let Some(open) = stream.as_mut() else {
                return Ok(None);
            };
            tokio::select! {
                biased;
                () = shared.closed.notified() => {}
                next = open.next() => if let Some(event) = next {
                    return event.map(Some);
                }
            }
            *stream = None;
            Ok(None)
        })
    }
}

#[pymethods]
impl Events {
    /// Returns the next event, or `None` after the last one.
    pub(crate) fn next(&self) -> Pending {
        self.pending(false)
    }

    /// Ends the sequence. Waits for an event then have `None`.
    pub(crate) fn close(&self) {
        match self.shared.stream.try_lock() {
            Ok(mut stream) => *stream = None,
            // The one that waits ends it.
            Err(_) => self.shared.closed.notify_one(),
        }
    }

    fn __iter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        step(py, &self.pending(true))
    }

    fn __aiter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    fn __anext__(&self) -> Pending {
        self.pending(true)
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &pyo3::Bound<'_, pyo3::types::PyTuple>) {
        self.close();
    }
}

impl fmt::Debug for Events {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Events").finish_non_exhaustive()
    }
}
