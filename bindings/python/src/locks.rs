//! Locks of resources, and their owners.

use std::path::PathBuf;

use fipa::locks::{OwnOptions, Owned as Opened};
use fipa_bindings::{Failure, FailureKind, OrFail as _};
use parking_lot::Mutex;
use pyo3::types::PyTuple;
use pyo3::{Bound, Py, PyResult, Python, pyclass, pymethods};

use crate::agent::Agent;
use crate::failure::OrRaise as _;
use crate::letter::Letter;
use crate::lock::Lock;
use crate::pending::{Output, Pending, seconds};

#[pymethods]
impl Agent {
    /// Locks resources, all of them or none. The agent renews the leases in the background. Raises `TimedOut` after
    /// `timeout` seconds. `async with agent.lock("arm") as lock:` releases the lock at the end of the block.
    #[pyo3(signature = (*resources, timeout=None))]
    fn lock(
        &self,
        py: Python<'_>,
        resources: Vec<String>,
        timeout: Option<f64>,
    ) -> PyResult<Pending> {
        let agent = self.registered(py)?.clone();
        if resources.is_empty() {
            return Err(Failure::invalid("a lock without a resource")).or_raise(py);
        }
        let within = seconds(timeout)?;
        Ok(Pending::lazy("Agent.lock()", async move {
            let resources: Vec<&str> = resources.iter().map(String::as_str).collect();
            let held = match within {
                Some(within) => agent.lock_all_within(&resources, within).await,
                None => agent.lock_all(&resources).await,
            };
            let lock = Lock::new(held.or_fail()?);
            Ok(Box::new(|py: Python<'_>| Ok(Py::new(py, lock)?.into_any())) as Output)
        }))
    }

    /// Owns a resource, whose locks other agents then request.
    ///
    /// `lease` is the time of a grant in seconds (15). `state_dir` has the file that keeps fences rising over restarts.
    /// An owner that is `volatile` has no file, and grants nothing for one lease after its start; one that may `forget`
    /// grants at once without a file, because no lock of an earlier run is in use.
    #[pyo3(signature = (resource, *, lease=None, state_dir=None, volatile=false, forget=false))]
    fn own(
        &self,
        py: Python<'_>,
        resource: String,
        lease: Option<f64>,
        state_dir: Option<PathBuf>,
        volatile: bool,
        forget: bool,
    ) -> PyResult<Pending> {
        let agent = self.registered(py)?.clone();
        let options = own_options(lease, state_dir, volatile, forget)?;
        Ok(Pending::lazy("Agent.own()", async move {
            let owned = agent.own(&resource, options).await.or_fail()?;
            let opened = Mutex::new(Some(owned));
            Ok(Box::new(|py: Python<'_>| Ok(Py::new(py, Owned { opened })?.into_any())) as Output)
        }))
    }
}

/// Reads how an agent owns a resource.
pub(crate) fn own_options(
    lease: Option<f64>,
    state_dir: Option<PathBuf>,
    volatile: bool,
    forget: bool,
) -> PyResult<OwnOptions> {
    let mut options = OwnOptions::default();
    if let Some(lease) = seconds(lease)? {
        options.lease = lease;
    }
    options.state_dir = state_dir;
    options.volatile = volatile;
    options.forget = forget;
    Ok(options)
}

/// A resource that the agent owns.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Owned {
    /// `None` after the release.
    opened: Mutex<Option<Opened>>,
}

#[pymethods]
impl Owned {
    /// Checks the fence that a letter carries. Raises `Stale` if the letter must not be acted on.
    fn check(&self, py: Python<'_>, letter: &Letter) -> PyResult<()> {
        let opened = self.opened.lock();
        let over = || Failure::new(FailureKind::Closed, "the resource is not owned any more");
        let opened = opened.as_ref().ok_or_else(over).or_raise(py)?;
        letter
            .read(|message| opened.check(message).map(drop).or_fail())?
            .or_raise(py)
    }

    /// Ends the ownership.
    fn release(&self) {
        let opened = self.opened.lock().take();
        drop(opened);
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyTuple>) {
        self.release();
    }
}

impl std::fmt::Debug for Owned {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Owned").finish_non_exhaustive()
    }
}
