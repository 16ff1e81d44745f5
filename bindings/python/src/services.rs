//! Services of agents, as the directory facilitator lists them (FIPA00023).

use fipa_bindings::{OrFail as _, service_from_json, services_to_json, template_from_json};
use pyo3::types::{PyDict, PyDictMethods as _};
use pyo3::{Bound, PyResult, Python, pymethods};
use serde_json::Value;

use crate::agent::Agent;
use crate::conversation::nothing;
use crate::failure::OrRaise as _;
use crate::pending::{Output, Pending};
use crate::value::{from_python, to_python};

#[pymethods]
impl Agent {
    /// Lists a service of this agent in the directory facilitator of the host, or replaces its service of the same name.
    /// Without a `name`, the name is the type. The other arguments are `properties` (a mapping), `protocols`,
    /// `ontologies`, `languages` and `ownership`.
    #[pyo3(signature = (r#type, name=None, **parts))]
    fn register_service(
        &self,
        py: Python<'_>,
        r#type: &str,
        name: Option<&str>,
        parts: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Pending> {
        let service = service(py, Some(r#type), name, parts)?;
        let service = service_from_json(service).or_raise(py)?;
        let agent = self.registered(py)?.clone();
        Ok(Pending::lazy("Agent.register_service()", async move {
            agent
                .df()
                .or_fail()?
                .register_service(service)
                .await
                .or_fail()?;
            Ok(nothing())
        }))
    }

    /// Removes all services of this agent from the directory facilitator, except its topics.
    fn deregister_services(&self, py: Python<'_>) -> PyResult<Pending> {
        let agent = self.registered(py)?.clone();
        Ok(Pending::lazy("Agent.deregister_services()", async move {
            agent.df().or_fail()?.deregister().await.or_fail()?;
            Ok(nothing())
        }))
    }

    /// Searches for agents with a service, of this host and of those that its gateway knows. Each argument, and each
    /// property, limits the search; the value of a property is `None` if any will do. `agent` is the name of an agent.
    /// Returns dictionaries with `name`, `services`, `protocols`, `ontologies`, `languages` and `lease`.
    #[pyo3(signature = (r#type=None, name=None, **parts))]
    fn search_services(
        &self,
        py: Python<'_>,
        r#type: Option<&str>,
        name: Option<&str>,
        parts: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Pending> {
        let template = template_from_json(service(py, r#type, name, parts)?).or_raise(py)?;
        let agent = self.registered(py)?.clone();
        Ok(Pending::lazy("Agent.search_services()", async move {
            let found = agent.df().or_fail()?.search(&template).await.or_fail()?;
            let found: Result<Vec<Value>, _> = found.iter().map(services_to_json).collect();
            let found = Value::Array(found?);
            Ok(Box::new(move |py: Python<'_>| to_python(py, &found)) as Output)
        }))
    }
}

/// Returns the parts of a service as an object.
fn service(
    py: Python<'_>,
    service_type: Option<&str>,
    name: Option<&str>,
    parts: Option<&Bound<'_, PyDict>>,
) -> PyResult<Value> {
    let service = PyDict::new(py);
    if let Some(parts) = parts {
        service.update(parts.as_mapping())?;
    }
    service.set_item("type", service_type)?;
    service.set_item("name", name)?;
    from_python(service.as_any(), "the service")
}
