//! The part of an agent in a coalition.

use fipa::MessageBuilder;
use fipa::coalitions::Membership as Joined;
use fipa_bindings::{Failure, FailureKind, OrFail as _, coalition};
use futures_util::stream::unfold;
use parking_lot::Mutex;
use pyo3::types::PyTuple;
use pyo3::{Bound, Py, PyResult, Python, pyclass, pymethods};

use crate::events::Events;
use crate::failure::OrRaise as _;
use crate::letter::Letter;
use crate::pending::Output;
use crate::value::to_python;

/// The part of the agent in a coalition. While the agent leads, messages with it (`Message(lock=...)`) carry the fence of
/// the leader.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Membership {
    /// `None` after `leave`.
    joined: Mutex<Option<Joined>>,
}

impl Membership {
    pub(crate) fn new(joined: Joined) -> Self {
        Self {
            joined: Mutex::new(Some(joined)),
        }
    }

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
