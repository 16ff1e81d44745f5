//! Values of Python as JSON and SL.

use fipa::actions::{Term, term_from_json, term_to_json};
use fipa_bindings::{Failure, FailureKind};
use pyo3::types::PyAnyMethods;
use pyo3::{Bound, Py, PyAny, PyResult, Python, pyfunction};
use serde_json::Value;

use crate::failure::{OrRaise as _, raised};
use crate::interpreter::call;

/// Reads a value of Python as the module `json` writes it; `what` names it in errors.
pub(crate) fn from_python(value: &Bound<'_, PyAny>, what: &str) -> PyResult<Value> {
    let py = value.py();
    let wrong = |text: String| raised(py, Failure::invalid(format!("{what}: {text}")));
    let text = call(py, "json", "dumps", (value,));
    let text: String = text.map_err(|error| wrong(error.to_string()))?.extract()?;
    serde_json::from_str(&text).map_err(|error| wrong(error.to_string()))
}

/// Returns a value for Python.
pub(crate) fn to_python(py: Python<'_>, value: &Value) -> PyResult<Py<PyAny>> {
    Ok(call(py, "json", "loads", (value.to_string(),))?.unbind())
}

/// Writes a value as an expression of SL (FIPA00008): what `json` can write, and dictionaries with a key `"sl"`.
#[pyfunction]
pub(crate) fn sl_dumps(value: &Bound<'_, PyAny>) -> PyResult<String> {
    let term = term_from_json(from_python(value, "the value")?);
    let term = term.map_err(|error| Failure::invalid(error.to_string()));
    Ok(term.or_raise(value.py())?.to_string())
}

/// Reads an expression of SL as a value.
#[pyfunction]
pub(crate) fn sl_loads(py: Python<'_>, text: &str) -> PyResult<Py<PyAny>> {
    let term: Result<Term<'_>, _> = Term::parse(text);
    let term = term.map_err(|error| Failure::invalid(error.to_string()));
    let value = term_to_json(&term.or_raise(py)?);
    let value = value.map_err(|error| Failure::new(FailureKind::Failed, error.to_string()));
    to_python(py, &value.or_raise(py)?)
}
