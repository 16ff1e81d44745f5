//! What an event loop of Python polls.

use std::collections::VecDeque;
use std::os::fd::AsRawFd as _;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Wake, Waker};

use fipa_bindings::Bell;
use parking_lot::Mutex;
use pyo3::{PyResult, pyclass, pymethods};

/// The wake-ups of one event loop: a descriptor, and the tags of the pending values that may have advanced.
#[pyclass(frozen, module = "fipa._native", name = "_Wakeups")]
#[derive(Debug, Default)]
pub(crate) struct Wakeups {
    shared: Arc<Shared>,
}

#[derive(Debug, Default)]
struct Shared {
    bell: Bell,
    woken: Mutex<VecDeque<Arc<Wakeup>>>,
}

#[pymethods]
impl Wakeups {
    #[new]
    fn new() -> Self {
        Self::default()
    }

    /// Returns the descriptor, which is readable while there are wake-ups.
    fn fileno(&self) -> PyResult<i32> {
        Ok(self.shared.bell.descriptor()?.as_raw_fd())
    }

    /// Takes at most `limit` tags. The descriptor stays readable if there are more.
    fn take(&self, limit: usize) -> Vec<u64> {
        // Before the tags are taken, so that a later one makes it readable again.
        self.shared.bell.quiet();
        let mut woken = self.shared.woken.lock();
        let count = woken.len().min(limit);
        let taken = woken.drain(..count).map(|wakeup| {
            wakeup.is_woken.store(false, Ordering::SeqCst);
            wakeup.tag
        });
        let taken = taken.collect();
        if !woken.is_empty() {
            self.shared.bell.ring();
        }
        taken
    }
}

impl Wakeups {
    /// Returns a waker that adds a tag.
    pub(crate) fn waker(&self, tag: u64) -> Waker {
        Waker::from(Arc::new(Wakeup {
            tag,
            is_woken: AtomicBool::new(false),
            shared: Arc::clone(&self.shared),
        }))
    }
}

/// The wake-up of one tag.
#[derive(Debug)]
struct Wakeup {
    tag: u64,
    /// Whether the tag waits to be taken.
    is_woken: AtomicBool,
    shared: Arc<Shared>,
}

impl Wake for Wakeup {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if !self.is_woken.swap(true, Ordering::SeqCst) {
            self.shared.woken.lock().push_back(Arc::clone(self));
            self.shared.bell.ring();
        }
    }
}
