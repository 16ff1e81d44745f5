//! Memory of the library that Python reads or writes in place: the only `unsafe` of this crate, because CPython's buffer
//! protocol has no safe form.
#![allow(unsafe_code)]

use std::ffi::{c_int, c_void};
use std::sync::atomic::{AtomicUsize, Ordering};

use bytes::Bytes;
use parking_lot::Mutex;
use pyo3::exceptions::PyBufferError;
use pyo3::types::PyMemoryView;
use pyo3::{Bound, Py, PyAny, PyErr, PyResult, Python, ffi, pyclass, pymethods};

/// Bytes that Python reads in place.
#[pyclass(frozen, module = "fipa._native", name = "_Content")]
#[derive(Debug)]
pub(crate) struct Content(Bytes);

#[pymethods]
impl Content {
    unsafe fn __getbuffer__(
        slf: Bound<'_, Self>,
        view: *mut ffi::Py_buffer,
        flags: c_int,
    ) -> PyResult<()> {
        let py = slf.py();
        let bytes = &slf.get().0;
        let (memory, len) = (bytes.as_ptr().cast_mut(), bytes.len());
        // SAFETY: CPython passes a view that can be written. The memory stays where it is and readable as long as the
        // object exists, to which the view has a reference. The view is read-only.
        unsafe { export(py, slf.into_any(), view, memory, len, true, flags) }
    }
}

/// Returns a read-only view of bytes, which keeps their memory.
pub(crate) fn view(py: Python<'_>, bytes: Bytes) -> PyResult<Py<PyMemoryView>> {
    let content = Bound::new(py, Content(bytes))?;
    Ok(PyMemoryView::from(&content)?.unbind())
}

/// Memory that the program writes before it is sent.
pub(crate) trait Writable: Send + 'static {
    /// Returns the memory, which stays where it is as long as the value exists.
    fn memory(&mut self) -> &mut [u8];
}

/// A value whose memory Python writes in place.
pub(crate) struct Lent<L> {
    value: Mutex<Option<L>>,
    /// Number of the views.
    views: AtomicUsize,
}

impl<L: Writable> Lent<L> {
    pub(crate) fn new(value: L) -> Self {
        Self {
            value: Mutex::new(Some(value)),
            views: AtomicUsize::new(0),
        }
    }

    /// Takes the value. Fails as long as there is a view of its memory.
    pub(crate) fn take(&self) -> PyResult<L> {
        let mut value = self.value.lock();
        if self.views.load(Ordering::SeqCst) > 0 {
            return Err(PyBufferError::new_err(
                "a view of the loan exists; release it (`with memoryview(loan) as view:`, or `del`) before the loan is sent",
            ));
        }
        value.take().ok_or_else(sent)
    }

    /// Exports the memory for a view of `owner`, to which this value belongs.
    ///
    /// # Safety
    /// `view` can be written, and `owner` keeps this value.
    pub(crate) unsafe fn export(
        &self,
        owner: Bound<'_, PyAny>,
        view: *mut ffi::Py_buffer,
        flags: c_int,
    ) -> PyResult<()> {
        let mut value = self.value.lock();
        let memory = value.as_mut().ok_or_else(sent)?.memory();
        let (memory, len) = (memory.as_mut_ptr(), memory.len());
        let py = owner.py();
        // SAFETY: The caller promises the view. The value is only taken after the last view, and its memory stays where
        // it is. No reference to the memory exists beside the views.
        unsafe { export(py, owner, view, memory, len, false, flags) }?;
        self.views.fetch_add(1, Ordering::SeqCst);
        Ok(())
    }

    /// Ends a view.
    pub(crate) fn release(&self) {
        self.views.fetch_sub(1, Ordering::SeqCst);
    }

    /// Returns the number of bytes.
    pub(crate) fn len(&self) -> usize {
        let mut value = self.value.lock();
        value.as_mut().map_or(0, |value| value.memory().len())
    }
}

fn sent() -> PyErr {
    PyBufferError::new_err("the loan was sent")
}

/// Fills a view.
///
/// # Safety
/// `view` can be written. The memory is readable, and writable unless `read_only`, as long as `owner` exists.
unsafe fn export(
    py: Python<'_>,
    owner: Bound<'_, PyAny>,
    view: *mut ffi::Py_buffer,
    memory: *mut u8,
    len: usize,
    read_only: bool,
    flags: c_int,
) -> PyResult<()> {
    let len = isize::try_from(len)?;
    let memory: *mut c_void = memory.cast();
    // SAFETY: The caller promises the view and the memory.
    let failed = unsafe {
        ffi::PyBuffer_FillInfo(
            view,
            owner.as_ptr(),
            memory,
            len,
            c_int::from(read_only),
            flags,
        )
    };
    match failed {
        0 => Ok(()),
        _ => Err(PyErr::fetch(py)),
    }
}
