//! Agents: sending, loans, receiving.

use std::ffi::c_int;
use std::time::Duration;

use fipa::error::DeregisterError;
use fipa::{Agent as Registered, Deliveries as Outcomes, Loan as OpenLoan};
use fipa_bindings::{Failure, FailureKind, OrFail as _, Sending, all_delivered, send, send_loan};
use pyo3::types::PyTuple;
use pyo3::{Bound, Py, PyAny, PyErr, PyResult, Python, ffi, pyclass, pymethods};
use serde_json::Value;

use crate::buffer::{Lent, Writable};
use crate::failure::{OrRaise as _, raised};
use crate::interpreter::away;
use crate::kept::Kept;
use crate::letter::{self, Letter};
use crate::message::Draft;
use crate::pending::{Pending, seconds};
use crate::value::to_python;

/// An agent of a domain, with its name in the directory. `Domain.register` creates it.
#[pyclass(frozen, subclass, module = "fipa")]
#[derive(Debug)]
pub(crate) struct Agent {
    agent: Kept<Registered>,
}

impl Agent {
    pub(crate) fn new(agent: Registered) -> Self {
        Self {
            agent: Kept::new(agent),
        }
    }

    /// Returns the agent for a call.
    pub(crate) fn registered(&self, py: Python<'_>) -> PyResult<&Registered> {
        self.agent.get(py)
    }
}

/// Something that the exception of a failed call is.
struct Raised(PyErr);

impl From<Failure> for Raised {
    fn from(failure: Failure) -> Self {
        Self(Python::attach(|py| raised(py, failure)))
    }
}

impl From<PyErr> for Raised {
    fn from(error: PyErr) -> Self {
        Self(error)
    }
}

#[pymethods]
impl Agent {
    /// The name.
    #[getter]
    fn name(&self) -> &str {
        self.agent.name()
    }

    /// Sends a message to its receivers, names or patterns of names. The letters leave in the order of the calls,
    /// whether the program waits or not.
    ///
    /// The value is the outcome for each receiver. Raises `NotDelivered` if a receiver has not got the letter.
    /// `timeout` is in seconds; without it, `mts.deadline` of the configuration applies.
    #[pyo3(signature = (message, *, timeout=None))]
    fn send(&self, message: &Bound<'_, PyAny>, timeout: Option<f64>) -> PyResult<Pending> {
        let agent = self.registered(message.py())?;
        let draft = Draft::read(message, None)?;
        let builder = draft.without_content(agent)?;
        self.sent(&draft, builder, seconds(timeout)?)
    }

    /// Sends an answer to a letter: to its `reply_to` or its sender, in the same conversation and protocol. What
    /// `message` sets takes precedence. Otherwise as `send`.
    #[pyo3(signature = (letter, message, *, timeout=None))]
    fn answer(
        &self,
        letter: &Letter,
        message: &Bound<'_, PyAny>,
        timeout: Option<f64>,
    ) -> PyResult<Pending> {
        let agent = self.registered(message.py())?;
        let draft = Draft::read(message, None)?;
        let builder = draft.answering(agent, letter)?;
        self.sent(&draft, builder, seconds(timeout)?)
    }

    /// Loans memory of `length` bytes for the content of a message, in shared memory where possible: receivers on this
    /// host read in place what the program writes. The content of `message` is ignored.
    fn loan(&self, message: &Bound<'_, PyAny>, length: usize) -> PyResult<Loan> {
        let py = message.py();
        let agent = self.registered(py)?;
        let builder = Draft::read(message, None)?.without_content(agent)?;
        let loan = agent.loan(builder, length).or_fail().or_raise(py)?;
        Ok(Loan {
            agent: agent.clone(),
            lent: Lent::new(loan),
        })
    }

    /// Waits for the next letter.
    fn receive(&self, py: Python<'_>) -> PyResult<Pending> {
        let agent = self.registered(py)?.clone();
        Ok(Pending::begun(async move {
            Ok(letter::output(agent.receive().await.or_fail()?))
        }))
    }

    /// Returns the next letter, or `None` if there is none now.
    fn try_receive(&self, py: Python<'_>) -> PyResult<Option<Letter>> {
        let received = self.registered(py)?.try_receive().or_fail().or_raise(py)?;
        Ok(received.map(Letter::from))
    }

    /// Removes the agent from the directory. What it has not received is dropped.
    fn deregister(&self, py: Python<'_>) -> PyResult<()> {
        let agent = self.registered(py)?.clone();
        match away(py, || agent.deregister()) {
            // The domain was closed before, which has deregistered the agent.
            Ok(_) | Err(DeregisterError::Closed | DeregisterError::NotRegistered(_)) => Ok(()),
            Err(error) => Err(Failure::of(error)).or_raise(py),
        }
    }

    fn __enter__(slf: Py<Self>) -> Py<Self> {
        slf
    }

    #[pyo3(signature = (*_exception))]
    fn __exit__(&self, py: Python<'_>, _exception: &Bound<'_, PyTuple>) -> PyResult<()> {
        self.deregister(py)
    }

    fn __repr__(&self) -> String {
        format!("<fipa.Agent {:?}>", self.agent.name())
    }
}

impl Agent {
    fn sent(
        &self,
        draft: &Draft<'_>,
        builder: fipa::MessageBuilder,
        within: Option<Duration>,
    ) -> PyResult<Pending> {
        let content = draft.content()?;
        let content = match &content {
            None => None,
            Some(content) => Some((content.len()?, |to: &mut [u8]| {
                Ok(Python::attach(|py| content.write(py, to))?)
            })),
        };
        let sending = send(&self.agent, builder, content, within);
        Ok(outcomes(sending.map_err(|Raised(error)| error)?))
    }
}

/// Waits for the outcomes.
fn outcomes(sending: Sending) -> Pending {
    Pending::begun(async {
        let outcomes = sending.await.or_fail()?;
        all_delivered(&outcomes)?;
        Ok(Box::new(|py: Python<'_>| Ok(Py::new(py, Deliveries(outcomes))?.into_any())) as _)
    })
}

/// The outcomes of a message, one for each receiver. `str()` lists them.
#[pyclass(frozen, module = "fipa")]
#[derive(Debug)]
pub(crate) struct Deliveries(Outcomes);

#[pymethods]
impl Deliveries {
    /// Returns a dictionary per receiver, with `receiver`, `outcome` (`"delivered"` or `"sent"`), `via`, and the failed
    /// `attempts`.
    fn to_list(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        let outcomes = serde_json::to_value(&self.0);
        let outcomes: Result<Value, Failure> =
            outcomes.map_err(|error| Failure::new(FailureKind::Failed, error.to_string()));
        to_python(py, &outcomes.or_raise(py)?)
    }

    fn __str__(&self) -> String {
        self.0.to_string()
    }

    fn __repr__(&self) -> String {
        format!("<fipa.Deliveries {}>", self.0)
    }
}

/// Memory for a content. It is a writable buffer: `memoryview(loan)`, `numpy.frombuffer(loan, ...)`.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Loan {
    agent: Registered,
    lent: Lent<OpenLoan>,
}

impl Writable for OpenLoan {
    fn memory(&mut self) -> &mut [u8] {
        self.content_mut()
    }
}

#[pymethods]
impl Loan {
    /// Sends the message of the loan, as `Agent.send`. Raises `BufferError` as long as a view of the loan exists.
    #[pyo3(signature = (*, timeout=None))]
    fn send(&self, timeout: Option<f64>) -> PyResult<Pending> {
        let within = seconds(timeout)?;
        let loan = self.lent.take()?;
        Ok(outcomes(send_loan(&self.agent, loan, within)))
    }

    fn __len__(&self) -> usize {
        self.lent.len()
    }

    #[allow(unsafe_code, reason = "the form that CPython prescribes")]
    unsafe fn __getbuffer__(
        slf: Bound<'_, Self>,
        view: *mut ffi::Py_buffer,
        flags: c_int,
    ) -> PyResult<()> {
        let lent = slf.get();
        // SAFETY: CPython passes a view that can be written. The loan belongs to the object.
        unsafe { lent.lent.export(slf.clone().into_any(), view, flags) }
    }

    #[allow(unsafe_code, reason = "the form that CPython prescribes")]
    unsafe fn __releasebuffer__(&self, _view: *mut ffi::Py_buffer) {
        self.lent.release();
    }
}

impl std::fmt::Debug for Loan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Loan").finish_non_exhaustive()
    }
}
