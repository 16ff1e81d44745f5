//! Services of agents, as the directory facilitator lists them (FIPA00023).

use fipa::blocking::Wait as _;
use fipa_bindings::{
    Failure, OrFail as _, service_from_json, services_to_json, template_from_json,
};
use serde_json::{Map, Value};

use crate::agent::OwnAgent;
use crate::failure::{FipaResult, call};
use crate::item::Text;
use crate::raw::{FipaText, Place};
use crate::table::{self, FipaHandle};

fn json(text: &str, what: &str) -> Result<Value, Failure> {
    serde_json::from_str(text).map_err(|error| Failure::invalid(format!("{what}: {error}")))
}

/// Lists a service of an agent in the directory facilitator of the host, or replaces its service of the same name.
/// `service` is a JSON object with a `type`, and optionally a `name` (if it is missing, the type), `ownership`,
/// `protocols`, `ontologies`, `languages` (arrays of texts) and `properties` (an object). Waits for the answer.
///
/// # Safety
/// The text must be readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_register_service(agent: FipaHandle, service: FipaText) -> FipaResult {
    call(|| {
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let service = unsafe { service.required("the service") }?;
        let service = service_from_json(json(service, "the service")?)?;
        let df = own.agent.df().or_fail()?;
        df.register_service(service).wait().or_fail()?;
        Ok(FipaResult::Ok)
    })
}

/// Removes all services of an agent from the directory facilitator, except its topics. Waits for the answer.
#[unsafe(no_mangle)]
pub extern "C" fn fipa_deregister_services(agent: FipaHandle) -> FipaResult {
    call(|| {
        let own = table::get::<OwnAgent>(agent)?;
        own.agent.df().or_fail()?.deregister().wait().or_fail()?;
        Ok(FipaResult::Ok)
    })
}

/// Searches for agents with a service, of this host and of those that its gateway knows. `pattern` is a JSON object as
/// for `fipa_register_service`, of which each part is optional, and may have the `agent`; an empty text finds all. The
/// value of a property is null if any will do. Waits for the answer: a JSON array of objects with `name`, `services`,
/// `protocols`, `ontologies`, `languages` and `lease`.
///
/// # Safety
/// The text must be readable. `found` is NULL or can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fipa_search_services(
    agent: FipaHandle,
    pattern: FipaText,
    found: *mut FipaHandle,
) -> FipaResult {
    call(|| {
        // SAFETY: The caller promises it.
        let found = unsafe { Place::of(found, "the handle") }?;
        let own = table::get::<OwnAgent>(agent)?;
        // SAFETY: The caller promises it.
        let pattern = match unsafe { pattern.read("the pattern") }? {
            None | Some("") => Value::Object(Map::new()),
            Some(text) => json(text, "the pattern")?,
        };
        let template = template_from_json(pattern)?;
        let df = own.agent.df().or_fail()?;
        let descriptions = df.search(&template).wait().or_fail()?;
        let all: Result<Vec<Value>, Failure> = descriptions.iter().map(services_to_json).collect();
        Ok(table::give(found, Text::json(&all?)?))
    })
}
