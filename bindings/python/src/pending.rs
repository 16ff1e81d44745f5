//! Values that a program waits for.

use std::fmt;
use std::future::poll_fn;
use std::mem::replace;
use std::pin::Pin;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};

use fipa::blocking::Wait as _;
use fipa_bindings::{Failure, FailureKind};
use futures_core::Stream;
use futures_core::stream::BoxStream;
use futures_util::StreamExt as _;
use futures_util::stream::once;
use parking_lot::Mutex;
use pyo3::exceptions::{
    PyRuntimeError, PyRuntimeWarning, PyStopAsyncIteration, PyStopIteration, PyValueError,
};
use pyo3::{Bound, Py, PyAny, PyErr, PyResult, Python, pyclass, pymethods};

use crate::failure::raised;
use crate::interpreter::{call, is_ending, section};
use crate::kept::own_process;
use crate::log;
use crate::wakeups::Wakeups;

/// What a future has: the value for Python, created on the thread of the program.
pub(crate) type Output = Box<dyn FnOnce(Python<'_>) -> PyResult<Py<PyAny>> + Send>;

/// A future whose output may be the end of a sequence.
type Waiting = Pin<Box<dyn Future<Output = Result<Option<Output>, Failure>> + Send>>;

/// The interval in which a thread that waits looks for signals, such as that of Ctrl-C.
const SIGNALS: Duration = Duration::from_millis(50);

/// A value that is not there yet. A coroutine awaits it; other programs call `wait`.
///
/// A wait that is cancelled or times out ends the operation, and loses no letter.
#[pyclass(frozen, generic, module = "fipa")]
pub(crate) struct Pending {
    state: Mutex<State>,
    /// What the program does not do if it never waits. `None` if it is done without.
    lazy: Option<&'static str>,
    /// The end of a sequence is an exception in `await`, and `None` otherwise.
    is_step: bool,
    /// The value, while it is the context of a block.
    entered: Mutex<Option<Py<PyAny>>>,
}

enum State {
    /// Not waited for yet.
    New(Waiting),
    /// An event loop waits.
    Polled(Waiting, u64, Waker),
    /// A thread waits, or has waited.
    Over,
}

impl Pending {
    /// Creates the value of a future that has begun, and goes on without the program.
    pub(crate) fn begun<F>(future: F) -> Self
    where
        F: Future<Output = Result<Output, Failure>> + Send + 'static,
    {
        Self::of(async { future.await.map(Some) }, None, false)
    }

    /// Creates the value of a future that begins with the wait; `what` is its name.
    pub(crate) fn lazy<F>(what: &'static str, future: F) -> Self
    where
        F: Future<Output = Result<Output, Failure>> + Send + 'static,
    {
        Self::of(async { future.await.map(Some) }, Some(what), false)
    }

    /// Creates the next value of a sequence. At its end, the value is `None`, or an exception if `is_step`.
    pub(crate) fn next<F>(is_step: bool, future: F) -> Self
    where
        F: Future<Output = Result<Option<Output>, Failure>> + Send + 'static,
    {
        Self::of(future, None, is_step)
    }

    fn of<F>(future: F, lazy: Option<&'static str>, is_step: bool) -> Self
    where
        F: Future<Output = Result<Option<Output>, Failure>> + Send + 'static,
    {
        Self {
            state: Mutex::new(State::New(Box::pin(future))),
            lazy,
            is_step,
            entered: Mutex::new(None),
        }
    }

    /// Waits on this thread.
    pub(crate) fn waited(
        &self,
        py: Python<'_>,
        timeout: Option<Duration>,
    ) -> PyResult<Option<Py<PyAny>>> {
        section(py, || self.waited_inside(py, timeout))
    }

    fn waited_inside(
        &self,
        py: Python<'_>,
        timeout: Option<Duration>,
    ) -> PyResult<Option<Py<PyAny>>> {
        own_process(py)?;
        let state = replace(&mut *self.state.lock(), State::Over);
        let mut future = match state {
            State::New(future) => future,
            polled => {
                *self.state.lock() = polled;
                return Err(used());
            }
        };
        // Without giving up the interpreter if the value is there.
        let mut ready = poll_once(&mut future, Waker::noop());
        let due = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        loop {
            if let Poll::Ready(output) = ready {
                return output
                    .map_err(|failure| raised(py, failure))?
                    .map(|output| output(py))
                    .transpose();
            }
            let left = due.map(|due| due.saturating_duration_since(Instant::now()));
            if left == Some(Duration::ZERO) {
                let text = "the time for the wait is over";
                return Err(raised(py, Failure::new(FailureKind::TimedOut, text)));
            }
            let slice = left.map_or(SIGNALS, |left| left.min(SIGNALS));
            if is_ending() {
                let text = "the interpreter ends";
                return Err(raised(py, Failure::new(FailureKind::Closed, text)));
            }
            let waited = py.detach(|| (&mut future).wait_within(slice));
            ready = waited.map_or(Poll::Pending, Poll::Ready);
            if ready.is_pending() {
                // With an output in hand, an exception of these would lose it.
                log::deliver(py)?;
                py.check_signals()?;
            }
        }
    }
}

/// Polls a future without waiting. It may need the timers of the library.
fn poll_once(future: &mut Waiting, waker: &Waker) -> Poll<Result<Option<Output>, Failure>> {
    let mut context = Context::from_waker(waker);
    poll_fn(|_| Poll::Ready(future.as_mut().poll(&mut context))).wait()
}

/// Begins an operation that emits events: its first letter is sent before the program waits.
pub(crate) fn begun<T: Send + 'static>(
    mut events: impl Stream<Item = T> + Send + Unpin + 'static,
) -> BoxStream<'static, T> {
    let mut context = Context::from_waker(Waker::noop());
    let first = poll_fn(|_| Poll::Ready(events.poll_next_unpin(&mut context))).wait();
    match first {
        Poll::Ready(Some(event)) => once(async { event }).chain(events).boxed(),
        Poll::Ready(None) | Poll::Pending => events.boxed(),
    }
}

/// Has a future go on without the program. Its first part is done before the return.
pub(crate) fn detached(future: impl Future<Output = ()> + Send + 'static) {
    let mut future = Box::pin(future);
    let mut context = Context::from_waker(Waker::noop());
    let first = async {
        if poll_fn(|_| Poll::Ready(future.as_mut().poll(&mut context)))
            .await
            .is_pending()
        {
            tokio::spawn(future);
        }
    };
    first.wait();
}

fn used() -> PyErr {
    PyRuntimeError::new_err("the value is awaited, or was awaited, elsewhere")
}

#[pymethods]
impl Pending {
    /// Waits for the value on this thread; other threads of Python go on. Ctrl-C ends the wait.
    ///
    /// `timeout` is in seconds; without it, the wait has no limit.
    #[pyo3(signature = (timeout=None))]
    fn wait(&self, py: Python<'_>, timeout: Option<f64>) -> PyResult<Py<PyAny>> {
        let value = self.waited(py, seconds(timeout)?)?;
        Ok(value.unwrap_or_else(|| py.None()))
    }

    fn __await__(slf: Bound<'_, Self>) -> PyResult<Py<PyAny>> {
        let py = slf.py();
        Ok(call(py, "fipa._loop", "drive", (slf,))?.unbind())
    }

    /// Advances on behalf of an event loop. Returns a tuple with the value, or `None` if it is not there yet: the loop
    /// then gets a wake-up of the tag.
    fn _poll(&self, py: Python<'_>, wakeups: &Wakeups, tag: u64) -> PyResult<Option<(Py<PyAny>,)>> {
        own_process(py)?;
        let state = replace(&mut *self.state.lock(), State::Over);
        let (mut future, waker) = match state {
            State::New(future) => (future, wakeups.waker(tag)),
            State::Polled(future, of, waker) if of == tag => (future, waker),
            polled => {
                *self.state.lock() = polled;
                return Err(used());
            }
        };
        match poll_once(&mut future, &waker) {
            Poll::Pending => {
                *self.state.lock() = State::Polled(future, tag, waker);
                Ok(None)
            }
            Poll::Ready(Err(failure)) => Err(raised(py, failure)),
            Poll::Ready(Ok(Some(output))) => Ok(Some((output(py)?,))),
            Poll::Ready(Ok(None)) if self.is_step => Err(PyStopAsyncIteration::new_err(())),
            Poll::Ready(Ok(None)) => Ok(Some((py.None(),))),
        }
    }

    /// Ends the operation of an event loop that no longer waits.
    fn _abandon(&self) {
        let state = replace(&mut *self.state.lock(), State::Over);
        drop(state);
    }

    fn __enter__(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let value = self.wait(py, None)?;
        *self.entered.lock() = Some(value.clone_ref(py));
        Ok(value)
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(
        &self,
        py: Python<'_>,
        _exception: &Bound<'_, pyo3::types::PyTuple>,
    ) -> PyResult<()> {
        let value = self.entered.lock().take();
        if let Some(value) = value {
            let none = py.None();
            value.call_method1(py, "__exit__", (&none, &none, &none))?;
        }
        Ok(())
    }

    fn __aenter__(slf: Bound<'_, Self>) -> PyResult<Py<PyAny>> {
        let py = slf.py();
        Ok(call(py, "fipa._loop", "enter", (slf,))?.unbind())
    }

    #[pyo3(signature = (*exception))]
    fn __aexit__(
        slf: Bound<'_, Self>,
        exception: &Bound<'_, pyo3::types::PyTuple>,
    ) -> PyResult<Py<PyAny>> {
        let py = slf.py();
        slf.get().__exit__(py, exception)?;
        Ok(call(py, "fipa._loop", "nothing", ())?.unbind())
    }

    /// Sets the value of the block.
    fn _entered(&self, value: Py<PyAny>) {
        *self.entered.lock() = Some(value);
    }

    fn __repr__(&self) -> &'static str {
        match &*self.state.lock() {
            State::New(_) => "<fipa.Pending>",
            State::Polled(..) => "<fipa.Pending awaited>",
            State::Over => "<fipa.Pending over>",
        }
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        if let (State::New(_), Some(what)) = (self.state.get_mut(), self.lazy) {
            let _ = Python::try_attach(|py| {
                let text = format!("{what} has no effect: nothing awaits what it returned\0");
                let Ok(text) = std::ffi::CStr::from_bytes_with_nul(text.as_bytes()) else {
                    return;
                };
                let category = py.get_type::<PyRuntimeWarning>();
                if let Err(error) = section(py, || PyErr::warn(py, &category, text, 1)) {
                    // A warning that is an error has no caller in a destructor.
                    error.write_unraisable(py, None);
                }
            });
        }
    }
}

impl fmt::Debug for Pending {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.__repr__())
    }
}

/// Reads a time in seconds.
pub(crate) fn seconds(timeout: Option<f64>) -> PyResult<Option<Duration>> {
    let read = |seconds| {
        Duration::try_from_secs_f64(seconds)
            .map_err(|error| PyValueError::new_err(format!("a time of {seconds} s: {error}")))
    };
    timeout.map(read).transpose()
}

/// The value of a step on a thread.
pub(crate) fn step(py: Python<'_>, pending: &Pending) -> PyResult<Py<PyAny>> {
    let value = pending.waited(py, None)?;
    value.ok_or_else(|| PyStopIteration::new_err(()))
}
