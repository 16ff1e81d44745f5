//! Services of agents in JSON, as the directory facilitator lists them (FIPA00023).

use fipa::actions::{term_from_json, term_to_json};
use fipa::platform::{AgentDescription, Property, ServiceDescription};
use fipa::{AgentId, Time};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use crate::failure::{Failure, FailureKind, OrFail as _};

/// A service: `service-description`.
#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Service {
    name: Option<String>,
    r#type: Option<String>,
    ownership: Option<String>,
    protocols: Vec<String>,
    ontologies: Vec<String>,
    languages: Vec<String>,
    /// A value is null if a template asks for any.
    properties: Map<String, Value>,
}

impl Service {
    fn read(value: Value) -> Result<Self, Failure> {
        // serde reads an array as a structure, too.
        if !value.is_object() {
            return Err(Failure::invalid(format!(
                "the service is no object: {value}"
            )));
        }
        let read = serde_json::from_value(value);
        read.map_err(|error| Failure::invalid(format!("the service: {error}")))
    }

    fn of(service: &ServiceDescription) -> Result<Self, Failure> {
        let property = |property: &Property| {
            let value = property.value.as_ref().map(term_to_json).transpose();
            let value = value.map_err(|error| Failure::new(FailureKind::Failed, error.to_string()));
            Ok((property.name.clone(), json!(value?)))
        };
        Ok(Self {
            name: service.name.clone(),
            r#type: service.service_type.clone(),
            ownership: service.ownership.clone(),
            protocols: service.protocols.clone(),
            ontologies: service.ontologies.clone(),
            languages: service.languages.clone(),
            properties: service
                .properties
                .iter()
                .map(property)
                .collect::<Result<_, Failure>>()?,
        })
    }

    fn description(self) -> Result<ServiceDescription, Failure> {
        let property = |(name, value): (String, Value)| {
            let value = match value {
                Value::Null => None,
                value => Some(
                    term_from_json(value)
                        .map_err(|error| Failure::invalid(format!("{name}: {error}")))?,
                ),
            };
            Ok(Property { name, value })
        };
        Ok(ServiceDescription {
            name: self.name,
            service_type: self.r#type,
            ownership: self.ownership,
            protocols: self.protocols,
            ontologies: self.ontologies,
            languages: self.languages,
            properties: self
                .properties
                .into_iter()
                .map(property)
                .collect::<Result<_, Failure>>()?,
        })
    }
}

/// Reads a service that is offered: an object with a `type`, and optionally a `name` (if it is missing, the type),
/// `ownership`, `protocols`, `ontologies`, `languages`, and `properties`, an object.
///
/// # Errors
/// If the value is another one.
pub fn service_from_json(value: Value) -> Result<ServiceDescription, Failure> {
    let mut service = Service::read(value)?.description()?;
    let service_type = service.service_type.as_ref();
    let service_type = service_type.ok_or_else(|| Failure::invalid("the service has no type"))?;
    service.name.get_or_insert_with(|| service_type.clone());
    Ok(service)
}

/// Reads a template of a search: an object as for a service, of which each part is optional, and the `agent` that offers
/// it. The value of a property is null if any will do.
///
/// # Errors
/// If the value is another one.
pub fn template_from_json(mut value: Value) -> Result<AgentDescription, Failure> {
    let agent = value
        .as_object_mut()
        .and_then(|parts| parts.remove("agent"));
    let name = match agent {
        None | Some(Value::Null) => None,
        Some(Value::String(name)) => Some(AgentId::new(name).or_fail()?),
        Some(other) => return Err(Failure::invalid(format!("the agent is no text: {other}"))),
    };
    let service = Service::read(value)?.description()?;
    let is_any = service == ServiceDescription::default();
    Ok(AgentDescription {
        name,
        services: if is_any { Vec::new() } else { vec![service] },
        ..AgentDescription::default()
    })
}

/// Writes the services of an agent: an object with its `name`, its `services`, its own `protocols`, `ontologies` and
/// `languages`, and the `lease`, the time in RFC 3339 at which they end.
///
/// # Errors
/// If a property has a value that JSON does not have.
pub fn services_to_json(description: &AgentDescription) -> Result<Value, Failure> {
    let services = description.services.iter().map(Service::of);
    Ok(json!({
        "name": description.name.as_ref().map(AgentId::name),
        "services": services.collect::<Result<Vec<_>, _>>()?,
        "protocols": description.protocols,
        "ontologies": description.ontologies,
        "languages": description.languages,
        "lease": description.lease_time.and_then(Time::to_rfc3339),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_service_keeps_its_parts() {
        let service = json!({
            "name": "left lift",
            "type": "lift",
            "ownership": "dock",
            "protocols": ["fipa-request"],
            "ontologies": [],
            "languages": ["fipa-sl"],
            "properties": { "capacity": 12.5, "side": "left", "busy": false },
        });
        let description = AgentDescription {
            name: Some(AgentId::new("arm").unwrap()),
            services: vec![service_from_json(service.clone()).unwrap()],
            ..AgentDescription::default()
        };
        let written = services_to_json(&description).unwrap();
        assert_eq!(written["name"], "arm");
        assert_eq!(written["services"], json!([service]));
    }

    #[test]
    fn the_name_of_a_service_is_its_type() {
        let service = service_from_json(json!({ "type": "lift" })).unwrap();
        assert_eq!(service.name.as_deref(), Some("lift"));
    }

    #[test]
    fn a_template_may_leave_out_each_part() {
        let all = template_from_json(json!({})).unwrap();
        assert_eq!(all, AgentDescription::default());
        let some = json!({ "agent": "arm", "properties": { "side": null } });
        let some = template_from_json(some).unwrap();
        assert_eq!(some.name.as_ref().map(AgentId::name), Some("arm"));
        assert_eq!(some.services[0].properties[0].value, None);
    }

    #[test]
    fn wrong_services_are_errors() {
        for wrong in [
            json!({}),
            json!(5),
            json!({ "type": 5 }),
            json!({ "type": "a", "kind": "b" }),
        ] {
            assert_eq!(
                service_from_json(wrong).unwrap_err().kind,
                FailureKind::Invalid
            );
        }
        for wrong in [json!({ "agent": 5 }), json!({ "agent": "" }), json!([])] {
            assert_eq!(
                template_from_json(wrong).unwrap_err().kind,
                FailureKind::Invalid
            );
        }
    }
}
