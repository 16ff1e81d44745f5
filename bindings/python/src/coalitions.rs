//! Coalitions with a leader: the founder and the members.

use std::path::PathBuf;
use std::sync::Arc;

use fipa::coalitions::{CoalitionOptions, LedCoalition};
use fipa_bindings::{Failure, FailureKind, OrFail as _};
use parking_lot::Mutex;
use pyo3::types::PyTuple;
use pyo3::{Bound, Py, PyResult, Python, pyclass, pymethods};

use crate::agent::Agent;
use crate::conversation::nothing;
use crate::failure::OrRaise as _;
use crate::locks::own_options;
use crate::membership::Membership;
use crate::pending::{Output, Pending};

fn failed(error: impl ToString) -> Failure {
    Failure::new(FailureKind::Failed, error.to_string())
}

#[pymethods]
impl Agent {
    /// Founds a coalition: one name for the members. Letters to it go to the leader, the member that holds the lock
    /// `coalition/NAME`, which this agent owns; the other arguments are those of `own`.
    #[pyo3(signature = (name, members, *, lease=None, state_dir=None, volatile=false, forget=false))]
    #[allow(clippy::too_many_arguments, reason = "most are options with a name")]
    fn found_coalition(
        &self,
        py: Python<'_>,
        name: String,
        members: Vec<String>,
        lease: Option<f64>,
        state_dir: Option<PathBuf>,
        volatile: bool,
        forget: bool,
    ) -> PyResult<Pending> {
        let agent = self.registered(py)?.clone();
        let options = CoalitionOptions {
            lock: own_options(lease, state_dir, volatile, forget)?,
            ..CoalitionOptions::default()
        };
        Ok(Pending::lazy("Agent.found_coalition()", async move {
            let members = members.iter().map(String::as_str);
            let founded = agent.found_coalition(&name, members, options).await;
            let founded = Mutex::new(Some(Arc::new(founded.map_err(failed)?)));
            Ok(
                Box::new(|py: Python<'_>| Ok(Py::new(py, Coalition { founded })?.into_any()))
                    as Output,
            )
        }))
    }

    /// Takes part in a coalition, which may be founded later: the agent leads when it is its turn.
    fn join_coalition(&self, py: Python<'_>, name: &str) -> PyResult<Membership> {
        let joined = self
            .registered(py)?
            .join_coalition(name)
            .or_fail()
            .or_raise(py)?;
        Ok(Membership::new(joined))
    }
}

/// A coalition that the agent has founded.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Coalition {
    /// `None` after `dissolve`.
    founded: Mutex<Option<Arc<LedCoalition>>>,
}

#[pymethods]
impl Coalition {
    /// Replaces the members.
    fn change(&self, py: Python<'_>, members: Vec<String>) -> PyResult<Pending> {
        let over = || Failure::new(FailureKind::Closed, "the coalition is dissolved");
        let founded = self.founded.lock().clone().ok_or_else(over).or_raise(py)?;
        Ok(Pending::lazy("Coalition.change()", async move {
            let members = members.iter().map(String::as_str);
            founded.change(members).await.map_err(failed)?;
            Ok(nothing())
        }))
    }

    /// Dissolves the coalition.
    fn dissolve(&self) {
        let founded = self.founded.lock().take();
        drop(founded);
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyTuple>) {
        self.dissolve();
    }
}

impl std::fmt::Debug for Coalition {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Coalition").finish_non_exhaustive()
    }
}
