//! Objects of the library, which their process alone uses and drops.

use std::fmt;
use std::ops::Deref;
use std::sync::atomic::{AtomicBool, Ordering};

use fipa_bindings::{Failure, FailureKind};
use pyo3::{PyResult, Python, pyfunction};

use crate::failure::raised;
use crate::interpreter::{away, end_sections};
use crate::log;

static IS_CHILD: AtomicBool = AtomicBool::new(false);

/// Marks this process as a forked child, in which the library refuses each call.
#[pyfunction]
#[pyo3(name = "_forked")]
pub(crate) fn forked() {
    IS_CHILD.store(true, Ordering::Relaxed);
    end_sections();
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

/// An object of the library.
pub(crate) struct Kept<T: Send>(Option<T>);

impl<T: Send> Kept<T> {
    pub(crate) fn new(object: T) -> Self {
        Self(Some(object))
    }

    /// Returns the object for a call.
    pub(crate) fn get(&self, py: Python<'_>) -> PyResult<&T> {
        own_process(py)?;
        log::deliver(py)?;
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
