//! Coalitions with a leader: the founder and the members.

use std::path::PathBuf;
use std::sync::Arc;

use fipa::MessageBuilder;
use fipa::coalitions::{CoalitionOptions, LedCoalition, Membership as Joined};
use fipa_bindings::{Failure, FailureKind, OrFail as _, coalition};
use futures_util::stream::unfold;
use parking_lot::Mutex;
use pyo3::types::PyTuple;
use pyo3::{Bound, Py, PyResult, Python, pyclass, pymethods};

use crate::agent::Agent;
use crate::conversation::nothing;
use crate::events::Events;
use crate::failure::OrRaise as _;
use crate::letter::Letter;
use crate::locks::own_options;
use crate::pending::{Output, Pending};
use crate::value::to_python;

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
        Ok(Membership {
            joined: Mutex::new(Some(joined)),
        })
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

/// The part of the agent in a coalition. While the agent leads, messages with it (`Message(lock=...)`) carry the fence of
/// the leader.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Membership {
    /// `None` after `leave`.
    joined: Mutex<Option<Joined>>,
}

impl Membership {
    fn read<R>(&self, py: Python<'_>, read: impl FnOnce(&Joined) -> R) -> PyResult<R> {
        let joined = self.joined.lock();
        let over = || Failure::new(FailureKind::Closed, "the agent has left the coalition");
        Ok(read(joined.as_ref().ok_or_else(over).or_raise(py)?))
    }

    /// Adds the fence of the leader to a message.
    pub(crate) fn guard(
        &self,
        py: Python<'_>,
        message: MessageBuilder,
    ) -> PyResult<MessageBuilder> {
        let lost =
            |error: &dyn std::error::Error| Failure::new(FailureKind::Lost, error.to_string());
        let guarded = self.read(py, |joined| {
            joined.guard(message).map_err(|error| lost(&error))
        })?;
        guarded.or_raise(py)
    }
}

#[pymethods]
impl Membership {
    /// Follows the coalition: dictionaries with `members`, `leader` (`None` if there is none at present) and `leads`.
    fn changes(&self, py: Python<'_>) -> PyResult<Events> {
        let changes = self.read(py, Joined::changes)?;
        Ok(Events::new(unfold(changes, |mut changes| async {
            let state = coalition(&changes.next().await?);
            let event = Box::new(move |py: Python<'_>| to_python(py, &state)) as Output;
            Some((Ok(event), changes))
        })))
    }

    /// Checks the fence that a command of the leader carries. Raises `Stale` if it must not be acted on.
    fn check(&self, py: Python<'_>, letter: &Letter) -> PyResult<()> {
        let checked = self.read(py, |joined| {
            letter.read(|message| joined.check(message).map(drop).or_fail())
        })?;
        checked?.or_raise(py)
    }

    /// Gives up the lead, if the agent leads. The other members are asked first to lead again.
    fn resign(&self, py: Python<'_>) -> PyResult<()> {
        self.read(py, Joined::resign)
    }

    /// Ends the membership.
    fn leave(&self) {
        let joined = self.joined.lock().take();
        drop(joined);
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, _exception: &Bound<'_, PyTuple>) {
        self.leave();
    }
}

impl std::fmt::Debug for Membership {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Membership").finish_non_exhaustive()
    }
}
