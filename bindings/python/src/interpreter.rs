//! Calls into Python, and the end of the interpreter.

use std::cell::Cell;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::{ThreadId, current, park, sleep};
use std::time::Duration;

use parking_lot::Condvar;
use pyo3::call::PyCallArgs;
use pyo3::types::PyAnyMethods as _;
use pyo3::{Bound, PyAny, PyResult, Python, pyfunction};

/// Number of the threads that are in a [section].
static INSIDE: AtomicUsize = AtomicUsize::new(0);

thread_local! {
    /// Whether this thread is in a [section].
    static IS_INSIDE: Cell<bool> = const { Cell::new(false) };
}

/// The thread that ends the interpreter.
static ENDS: OnceLock<ThreadId> = OnceLock::new();

/// Notified at the end of the interpreter, and when log lines are added or were logged. A wait on it looks at
/// [`is_ending`].
pub(crate) static LOG_OR_END: Condvar = Condvar::new();

/// Does a part of a call in which the thread may give up the interpreter's lock: a wait, or a call into Python.
///
/// CPython ends a thread that asks for the lock after the end of the interpreter, which unwinds the frames of this module
/// and so aborts the process. For that reason [`ending`] waits until no other thread is in a section, and a thread that
/// would begin one afterwards does not go on.
pub(crate) fn section<T>(py: Python<'_>, work: impl FnOnce() -> T) -> T {
    if IS_INSIDE.get() {
        return work();
    }
    // Between this check and the end of the section, `ending` cannot pass: it needs the lock, or waits for the section.
    if ENDS.get().is_some_and(|ends| *ends != current().id()) {
        py.detach(|| {
            loop {
                park();
            }
        });
    }
    let _inside = Inside::enter();
    work()
}

/// Does something that may wait without the interpreter's lock.
pub(crate) fn away<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> T {
    section(py, || py.detach(work))
}

/// Calls a function or a class of a module of Python.
pub(crate) fn call<'py>(
    py: Python<'py>,
    module: &str,
    name: &str,
    arguments: impl PyCallArgs<'py>,
) -> PyResult<Bound<'py, PyAny>> {
    section(py, || py.import(module)?.getattr(name)?.call1(arguments))
}

/// A section, as long as it lasts.
struct Inside;

impl Inside {
    fn enter() -> Self {
        INSIDE.fetch_add(1, Ordering::SeqCst);
        IS_INSIDE.set(true);
        Self
    }
}

impl Drop for Inside {
    fn drop(&mut self) {
        IS_INSIDE.set(false);
        INSIDE.fetch_sub(1, Ordering::SeqCst);
    }
}

/// Ends the sections of threads that exist in the parent of this process alone.
pub(crate) fn end_sections() {
    INSIDE.store(usize::from(IS_INSIDE.get()), Ordering::SeqCst);
}

/// Whether the interpreter ends. Waits then end with an error.
pub(crate) fn is_ending() -> bool {
    ENDS.get().is_some()
}

/// Has all waits of other threads end, and returns when no thread is in a [section].
#[pyfunction]
#[pyo3(name = "_ending")]
pub(crate) fn ending(py: Python<'_>) {
    let _ = ENDS.set(current().id());
    py.detach(|| {
        while INSIDE.load(Ordering::SeqCst) > 0 {
            // Each time: it may have been about to wait.
            LOG_OR_END.notify_all();
            sleep(Duration::from_millis(1));
        }
    });
}
