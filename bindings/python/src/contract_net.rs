//! Calls for proposals (FIPA00029).

use std::time::Duration;

use fipa::protocol::ContractNet;
use fipa::{Message, Performative};
use fipa_bindings::{Failure, FailureKind, OrFail as _, bids};
use parking_lot::Mutex;
use pyo3::types::PyDict;
use pyo3::types::PyDictMethods as _;
use pyo3::{Bound, Py, PyAny, PyResult, Python, pyclass, pymethods};
use serde_json::Value;

use crate::agent::Agent;
use crate::conversation::LONG;
use crate::failure::{OrRaise as _, exception};
use crate::letter::Letter;
use crate::message::Draft;
use crate::pending::{Output, Pending, seconds};
use crate::value::to_python;

/// Time for the proposals if the program sets none.
const TIMEOUT: Duration = Duration::from_secs(10);

#[pymethods]
impl Agent {
    /// Calls the receivers of a message, names and patterns, for proposals. The value is what they have answered within
    /// `timeout` seconds (10).
    #[pyo3(signature = (message, *, timeout=None))]
    fn call_for_proposals(
        &self,
        message: &Bound<'_, PyAny>,
        timeout: Option<f64>,
    ) -> PyResult<Pending> {
        let agent = self.registered(message.py())?.clone();
        let draft = Draft::read(message, Some(Performative::Cfp))?;
        let builder = draft.with_content(draft.without_receivers(&agent)?)?;
        let (receivers, timeout) = (draft.receivers, seconds(timeout)?.unwrap_or(TIMEOUT));
        Ok(Pending::lazy("Agent.call_for_proposals()", async move {
            let net = agent
                .contract_net(builder, &receivers, timeout)
                .await
                .or_fail()?;
            Ok(
                Box::new(|py: Python<'_>| Ok(Py::new(py, Bids::new(py, net)?)?.into_any()))
                    as Output,
            )
        }))
    }
}

/// The answers to a call for proposals. A call that is dropped without an award rejects all proposals.
#[pyclass(frozen, module = "fipa")]
pub(crate) struct Bids {
    proposals: Vec<Py<Letter>>,
    answers: Value,
    /// The call and its proposals, until the award.
    net: Mutex<Option<ContractNet>>,
}

impl Bids {
    fn new(py: Python<'_>, net: ContractNet) -> PyResult<Self> {
        let proposals = net.bids().proposals.iter().cloned();
        let proposals = proposals.map(|proposal| Py::new(py, Letter::from(proposal)));
        Ok(Self {
            proposals: proposals.collect::<PyResult<_>>()?,
            answers: bids(net.bids()),
            net: Mutex::new(Some(net)),
        })
    }
}

#[pymethods]
impl Bids {
    /// The proposals, as letters.
    #[getter]
    fn proposals(&self, py: Python<'_>) -> Vec<Py<Letter>> {
        self.proposals
            .iter()
            .map(|proposal| proposal.clone_ref(py))
            .collect()
    }

    /// The other answers, a dictionary: `refusals` (each with `agent` and `reason`), `silent`, `unreached`, `gone` and
    /// `violations`.
    #[getter]
    fn answers(&self, py: Python<'_>) -> PyResult<Py<PyAny>> {
        to_python(py, &self.answers)
    }

    /// Accepts these proposals, one or several, and rejects the others; each gets the content. The value is a dictionary
    /// with the name of each accepted agent, and its result as a letter, or the exception instead of one. Without
    /// `accepted`, all are rejected.
    #[pyo3(signature = (*accepted, content="", timeout=None))]
    fn award(
        &self,
        py: Python<'_>,
        accepted: Vec<Py<Letter>>,
        content: &str,
        timeout: Option<f64>,
    ) -> PyResult<Pending> {
        let timeout = seconds(timeout)?.unwrap_or(LONG);
        for letter in &accepted {
            if !self.proposals.iter().any(|proposal| proposal.is(letter)) {
                let text = "the letter is not a proposal of this call";
                return Err(Failure::invalid(text)).or_raise(py);
            }
        }
        let chosen = accepted
            .iter()
            .map(|letter| letter.get().read(Message::clone));
        let chosen: Vec<Message> = chosen.collect::<PyResult<_>>()?;
        let awarded = || Failure::new(FailureKind::Closed, "the call was awarded");
        let mut net = self.net.lock().take().ok_or_else(awarded).or_raise(py)?;
        let content = content.to_owned();
        Ok(Pending::lazy("Bids.award()", async move {
            let awarded = net.award(&chosen, &content, timeout).await.or_fail()?;
            Ok(Box::new(|py: Python<'_>| {
                let results = PyDict::new(py);
                for one in awarded {
                    let result = match one.result {
                        Ok(message) => Py::new(py, Letter::from(message))?.into_any(),
                        Err(error) => exception(py, Failure::of(error))?,
                    };
                    results.set_item(one.agent, result)?;
                }
                Ok(results.into_any().unbind())
            }) as Output)
        }))
    }
}

impl std::fmt::Debug for Bids {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Bids").finish_non_exhaustive()
    }
}
