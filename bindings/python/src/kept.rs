//! Objects of the library, which their process alone uses and drops, and the end of the interpreter.

use std::fmt;
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread::sleep;
use std::time::Duration;

use fipa_bindings::{Failure, FailureKind};
use pyo3::{PyResult, Python, pyfunction};

use crate::failure::raised;

static IS_CHILD: AtomicBool = AtomicBool::new(false);

/// Marks this process as a forked child, in which the library refuses each call.
#[pyfunction]
#[pyo3(name = "_forked")]
pub(crate) fn forked() {
    IS_CHILD.store(true, Ordering::Relaxed);
    // The other threads exist in the parent alone.
    AWAY.store(0, Ordering::SeqCst);
}

/// Refuses a call in a forked child: a lock of the parent may be taken there forever.
pub(crate) fn own_process(py: Python<'_>) -> PyResult<()> {
    match IS_CHILD.load(Ordering::Relaxed) {
        false => Ok(()),
        true => Err(raised(
            py,
            Failure::new(
                FailureKind::Forked,
                "this process was forked from one that uses fipa; use the start method \"spawn\" of multiprocessing, \
                 or fork before the first call",
            ),
        )),
    }
}

/// Number of the threads that are without the interpreter's lock in a call of this module.
static AWAY: AtomicUsize = AtomicUsize::new(0);
static IS_ENDING: AtomicBool = AtomicBool::new(false);

/// Does something that may wait without the interpreter's lock.
///
/// A thread that asks for the lock after the end of the interpreter is ended by CPython, which unwinds the frames of this
/// module and so aborts the process. For that reason [`ending`] waits for all threads that are here, and no thread gives
/// up the lock afterwards.
pub(crate) fn away<T: Send>(py: Python<'_>, work: impl FnOnce() -> T + Send) -> T {
    AWAY.fetch_add(1, Ordering::SeqCst);
    let result = match is_ending() {
        true => work(),
        false => py.detach(work),
    };
    AWAY.fetch_sub(1, Ordering::SeqCst);
    result
}

/// Whether the interpreter ends. Waits then end with an error.
pub(crate) fn is_ending() -> bool {
    IS_ENDING.load(Ordering::SeqCst)
}

/// Has all waits of other threads end, and returns when no thread is without the interpreter's lock.
#[pyfunction]
#[pyo3(name = "_ending")]
pub(crate) fn ending(py: Python<'_>) {
    IS_ENDING.store(true, Ordering::SeqCst);
    py.detach(|| {
        while AWAY.load(Ordering::SeqCst) > 0 {
            sleep(Duration::from_millis(1));
        }
    });
}

/// An object of the library.
pub(crate) struct Kept<T: Send>(Option<T>);

impl<T: Send> Kept<T> {
    pub(crate) fn new(object: T) -> Self {
        Self(Some(object))
    }

    /// Returns the object for a call.
    pub(crate) fn get(&self, py: Python<'_>) -> PyResult<&T> {
        own_process(py)?;
        Ok(self)
    }
}

impl<T: Send> Deref for Kept<T> {
    type Target = T;

    fn deref(&self) -> &T {
        match &self.0 {
            Some(object) => object,
            None => unreachable!("only `drop` takes the object"),
        }
    }
}

impl<T: Send> Drop for Kept<T> {
    fn drop(&mut self) {
        let object = self.0.take();
        if IS_CHILD.load(Ordering::Relaxed) {
            // It belongs to the parent.
            std::mem::forget(object);
            return;
        }
        // The end of an object may wait for a thread, which must not wait for this one in turn.
        let mut object = Some(object);
        let _ = Python::try_attach(|py| {
            let object = object.take();
            away(py, move || drop(object));
        });
    }
}

impl<T: Send + fmt::Debug> fmt::Debug for Kept<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (**self).fmt(f)
    }
}
