//! The objects of the ontology (FIPA00023 clause 6.1). All slots are optional, because templates of
//! searches are objects of the same types.

use std::fmt;

use fipa_acl::{AgentId, Time};
use fipa_content::{ActionExpression, Arguments, Number, Term, Wff};

use crate::exception::Exception;
use crate::slots::{Builder, Slots, text};

/// The services of an agent: `df-agent-description`.
#[derive(Debug, Clone, Default, PartialEq)]
#[allow(clippy::exhaustive_structs, reason = "the standard is final")]
pub struct AgentDescription {
    /// The agent. Mandatory, except in templates.
    pub name: Option<AgentId>,
    /// Its services.
    pub services: Vec<ServiceDescription>,
    /// Interaction protocols that the agent supports.
    pub protocols: Vec<String>,
    /// Ontologies that the agent knows.
    pub ontologies: Vec<String>,
    /// Content languages that the agent knows.
    pub languages: Vec<String>,
    /// The time at which the description ends.
    pub lease_time: Option<Time>,
    /// Where the description is visible, for federated directories: `local`, `global`.
    pub scope: Vec<String>,
}

/// A service of an agent: `service-description`.
#[derive(Debug, Clone, Default, PartialEq)]
#[allow(clippy::exhaustive_structs, reason = "the standard is final")]
pub struct ServiceDescription {
    /// The name of the service. Mandatory, except in templates.
    pub name: Option<String>,
    /// The type of the service. Mandatory, except in templates.
    pub service_type: Option<String>,
    /// Interaction protocols of the service.
    pub protocols: Vec<String>,
    /// Ontologies of the service.
    pub ontologies: Vec<String>,
    /// Content languages of the service.
    pub languages: Vec<String>,
    /// The owner of the service.
    pub ownership: Option<String>,
    /// Further properties.
    pub properties: Vec<Property>,
}

/// A property of a service: `property`.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::exhaustive_structs, reason = "the standard is final")]
pub struct Property {
    /// The name.
    pub name: String,
    /// The value. In a template, any value if it is missing.
    pub value: Option<Term<'static>>,
}

/// An agent of a platform: `ams-agent-description`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[allow(clippy::exhaustive_structs, reason = "the standard is final")]
pub struct AmsDescription {
    /// The agent. Mandatory, except in templates.
    pub name: Option<AgentId>,
    /// The owner of the agent.
    pub ownership: Option<String>,
    /// The state of its life cycle.
    pub state: Option<AgentState>,
}

/// A state of the life cycle of an agent (FIPA00023 clause 5.1).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum AgentState {
    /// Not invoked yet.
    Initiated,
    /// Running.
    Active,
    /// Suspended by itself or by the AMS.
    Suspended,
    /// Waiting for an event.
    Waiting,
    /// Moving to another platform.
    Transit,
}

/// The bounds of a search: `search-constraints`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[allow(clippy::exhaustive_structs, reason = "the standard is final")]
pub struct Constraints {
    /// Maximum number of federated directories that the search passes. This directory passes searches
    /// to no other one.
    pub max_depth: Option<i64>,
    /// Maximum number of descriptions in the answer: 1 if missing, any number if negative.
    pub max_results: Option<i64>,
    /// An identifier of the search, which a directory answers once.
    pub search_id: Option<String>,
}

/// A platform: `ap-description`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[allow(clippy::exhaustive_structs, reason = "the standard is final")]
pub struct ApDescription {
    /// The name of the platform.
    pub name: String,
    /// The transports of the platform: the name of each, which is also its type, and its addresses.
    pub services: Vec<(String, Vec<String>)>,
}

const DF_DESCRIPTION: &str = "df-agent-description";
const SERVICE: &str = "service-description";
const PROPERTY: &str = "property";
pub(crate) const AMS_DESCRIPTION: &str = "ams-agent-description";
pub(crate) const CONSTRAINTS: &str = "search-constraints";
const AP_DESCRIPTION: &str = "ap-description";
const AP_SERVICE: &str = "ap-service";

impl AgentDescription {
    /// Reads a `df-agent-description`. Symbols and slots are case-insensitive, user-defined slots
    /// (`X-…`) are ignored.
    ///
    /// # Errors
    /// When it is another object, has an unknown slot, or a value that its slot cannot have.
    pub fn from_term(term: &Term<'_>) -> Result<Self, Exception> {
        let known = [
            "name",
            "services",
            "protocols",
            "ontologies",
            "languages",
            "lease-time",
            "scope",
        ];
        let slots = Slots::of(term, DF_DESCRIPTION, &known)?;
        let services = slots.elements("services")?.iter();
        Ok(Self {
            name: slots.agent("name")?,
            services: services
                .map(ServiceDescription::from_term)
                .collect::<Result<_, _>>()?,
            protocols: slots.texts("protocols")?,
            ontologies: slots.texts("ontologies")?,
            languages: slots.texts("languages")?,
            lease_time: slots.time("lease-time")?,
            scope: slots.texts("scope")?,
        })
    }

    /// Returns the `df-agent-description`.
    #[must_use]
    pub fn to_term(&self) -> Term<'static> {
        let services = self.services.iter().map(ServiceDescription::to_term);
        Builder::default()
            .slot("name", self.name.as_ref().map(Term::from))
            .set("services", services.collect())
            .texts("protocols", &self.protocols)
            .texts("ontologies", &self.ontologies)
            .texts("languages", &self.languages)
            .slot("lease-time", self.lease_time.map(Term::from))
            .texts("scope", &self.scope)
            .build(DF_DESCRIPTION)
    }

    /// Checks that a description that is to be registered has its mandatory slots.
    pub(crate) fn check(&self) -> Result<(), Exception> {
        if self.name.is_none() {
            return Err(Exception::missing(DF_DESCRIPTION, "name"));
        }
        for service in &self.services {
            if service.name.is_none() {
                return Err(Exception::missing(SERVICE, "name"));
            }
            if service.service_type.is_none() {
                return Err(Exception::missing(SERVICE, "type"));
            }
        }
        Ok(())
    }

    /// Returns the number of parts of the description, and of bytes of their text.
    pub(crate) fn size(&self) -> Size {
        let mut size = Size::default();
        if let Some(agent) = &self.name {
            size.agent(agent);
        }
        for texts in [
            &self.protocols,
            &self.ontologies,
            &self.languages,
            &self.scope,
        ] {
            size.texts(texts);
        }
        for service in &self.services {
            size.text("");
            for text in [&service.name, &service.service_type, &service.ownership] {
                size.texts(text);
            }
            for texts in [&service.protocols, &service.ontologies, &service.languages] {
                size.texts(texts);
            }
            for Property { name, value } in &service.properties {
                size.text(name);
                if let Some(value) = value {
                    size.term(value);
                }
            }
        }
        size
    }
}

/// The template of all agents that have a service.
impl From<ServiceDescription> for AgentDescription {
    fn from(service: ServiceDescription) -> Self {
        Self {
            services: vec![service],
            ..Self::default()
        }
    }
}

impl ServiceDescription {
    /// Returns a service with this name and type.
    #[must_use]
    pub fn new(name: impl Into<String>, service_type: impl Into<String>) -> Self {
        Self {
            name: Some(name.into()),
            ..Self::of_type(service_type)
        }
    }

    /// Returns the template of all services of a type.
    #[must_use]
    pub fn of_type(service_type: impl Into<String>) -> Self {
        Self {
            service_type: Some(service_type.into()),
            ..Self::default()
        }
    }

    /// Adds a property.
    #[must_use]
    pub fn with_property(
        mut self,
        name: impl Into<String>,
        value: impl Into<Term<'static>>,
    ) -> Self {
        self.properties.push(Property::new(name, value));
        self
    }

    /// Returns the value of the first property with this name.
    #[must_use]
    pub fn property(&self, name: &str) -> Option<&Term<'static>> {
        let mut properties = self.properties.iter();
        properties
            .find(|property| property.name == name)?
            .value
            .as_ref()
    }

    fn from_term(term: &Term<'_>) -> Result<Self, Exception> {
        let known = [
            "name",
            "type",
            "protocols",
            "ontologies",
            "languages",
            "ownership",
            "properties",
        ];
        let slots = Slots::of(term, SERVICE, &known)
            .map_err(|error| nested(error, DF_DESCRIPTION, "services"))?;
        let properties = slots.elements("properties")?.iter();
        Ok(Self {
            name: slots.text("name")?,
            service_type: slots.text("type")?,
            protocols: slots.texts("protocols")?,
            ontologies: slots.texts("ontologies")?,
            languages: slots.texts("languages")?,
            ownership: slots.text("ownership")?,
            properties: properties
                .map(Property::from_term)
                .collect::<Result<_, _>>()?,
        })
    }

    fn to_term(&self) -> Term<'static> {
        let properties = self.properties.iter().map(Property::to_term);
        Builder::default()
            .text("name", self.name.as_deref())
            .text("type", self.service_type.as_deref())
            .texts("protocols", &self.protocols)
            .texts("ontologies", &self.ontologies)
            .texts("languages", &self.languages)
            .text("ownership", self.ownership.as_deref())
            .set("properties", properties.collect())
            .build(SERVICE)
    }
}

impl Property {
    /// Returns a property with a value.
    #[must_use]
    pub fn new(name: impl Into<String>, value: impl Into<Term<'static>>) -> Self {
        Self {
            name: name.into(),
            value: Some(value.into()),
        }
    }

    fn from_term(term: &Term<'_>) -> Result<Self, Exception> {
        let slots = Slots::of(term, PROPERTY, &["name", "value"])
            .map_err(|error| nested(error, SERVICE, "properties"))?;
        let name = slots.text("name")?;
        Ok(Self {
            name: name.ok_or_else(|| Exception::missing(PROPERTY, "name"))?,
            value: slots.get("value").map(|value| value.clone().into_owned()),
        })
    }

    fn to_term(&self) -> Term<'static> {
        Builder::default()
            .text("name", Some(&self.name))
            .slot("value", self.value.clone())
            .build(PROPERTY)
    }
}

/// Returns the error of an element of a slot: another object than the slot has is a value that the slot
/// cannot have.
fn nested(error: Exception, object: &str, slot: &str) -> Exception {
    match error {
        Exception::UnexpectedArgument(_) => Exception::unrecognised(object, slot),
        other => other,
    }
}

impl AmsDescription {
    /// Reads an `ams-agent-description`; see [`AgentDescription::from_term`].
    ///
    /// # Errors
    /// See [`AgentDescription::from_term`].
    pub fn from_term(term: &Term<'_>) -> Result<Self, Exception> {
        let slots = Slots::of(term, AMS_DESCRIPTION, &["name", "ownership", "state"])?;
        let state = slots.text("state")?;
        let state = state.map(|state| {
            AgentState::of(&state).ok_or_else(|| Exception::unrecognised(AMS_DESCRIPTION, "state"))
        });
        Ok(Self {
            name: slots.agent("name")?,
            ownership: slots.text("ownership")?,
            state: state.transpose()?,
        })
    }

    /// Returns the `ams-agent-description`.
    #[must_use]
    pub fn to_term(&self) -> Term<'static> {
        Builder::default()
            .slot("name", self.name.as_ref().map(Term::from))
            .text("ownership", self.ownership.as_deref())
            .text("state", self.state.map(AgentState::as_str))
            .build(AMS_DESCRIPTION)
    }

    pub(crate) fn size(&self) -> Size {
        let mut size = Size::default();
        if let Some(agent) = &self.name {
            size.agent(agent);
        }
        size.texts(&self.ownership);
        size
    }
}

impl AgentState {
    const ALL: [Self; 5] = [
        Self::Initiated,
        Self::Active,
        Self::Suspended,
        Self::Waiting,
        Self::Transit,
    ];

    /// Returns the word of the standard.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Initiated => "initiated",
            Self::Active => "active",
            Self::Suspended => "suspended",
            Self::Waiting => "waiting",
            Self::Transit => "transit",
        }
    }

    /// Returns the state with this word, in any case.
    #[must_use]
    pub fn of(word: &str) -> Option<Self> {
        let mut all = Self::ALL.into_iter();
        all.find(|state| state.as_str().eq_ignore_ascii_case(word))
    }
}

impl fmt::Display for AgentState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

impl Constraints {
    /// Returns the constraints of a search for all descriptions.
    #[must_use]
    pub fn all() -> Self {
        Self {
            max_results: Some(-1),
            ..Self::default()
        }
    }

    pub(crate) fn from_term(term: &Term<'_>) -> Result<Self, Exception> {
        let known = ["max-depth", "max-results", "search-id"];
        let slots = Slots::of(term, CONSTRAINTS, &known)?;
        Ok(Self {
            max_depth: slots.integer("max-depth")?,
            max_results: slots.integer("max-results")?,
            search_id: slots.text("search-id")?,
        })
    }

    pub(crate) fn to_term(&self) -> Term<'static> {
        let number = |value: i64| Number::new(value.to_string()).map(Term::Number);
        Builder::default()
            .slot("max-depth", self.max_depth.and_then(number))
            .slot("max-results", self.max_results.and_then(number))
            .text("search-id", self.search_id.as_deref())
            .build(CONSTRAINTS)
    }
}

impl ApDescription {
    /// Reads an `ap-description`; see [`AgentDescription::from_term`].
    ///
    /// # Errors
    /// See [`AgentDescription::from_term`].
    pub fn from_term(term: &Term<'_>) -> Result<Self, Exception> {
        let slots = Slots::of(term, AP_DESCRIPTION, &["name", "ap-services"])?;
        let services = slots.elements("ap-services")?.iter().map(|service| {
            let known = ["name", "type", "addresses"];
            let slots = Slots::of(service, AP_SERVICE, &known)
                .map_err(|error| nested(error, AP_DESCRIPTION, "ap-services"))?;
            let name = slots.text("name")?;
            let name = name.ok_or_else(|| Exception::missing(AP_SERVICE, "name"))?;
            Ok((name, slots.texts("addresses")?))
        });
        let name = slots.text("name")?;
        Ok(Self {
            name: name.ok_or_else(|| Exception::missing(AP_DESCRIPTION, "name"))?,
            services: services.collect::<Result<_, Exception>>()?,
        })
    }

    /// Returns the `ap-description`.
    #[must_use]
    pub fn to_term(&self) -> Term<'static> {
        let services = self.services.iter().map(|(name, addresses)| {
            let addresses = addresses.iter().cloned().map(Term::from).collect();
            Builder::default()
                .text("name", Some(name))
                .text("type", Some(name))
                .slot("addresses", Some(Term::Sequence(addresses)))
                .build(AP_SERVICE)
        });
        Builder::default()
            .text("name", Some(&self.name))
            .set("ap-services", services.collect())
            .build(AP_DESCRIPTION)
    }
}

/// The size of a description.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) parts: usize,
    pub(crate) bytes: usize,
}

impl Size {
    fn text(&mut self, text: &str) {
        self.parts += 1;
        self.bytes += text.len();
    }

    fn texts<'t>(&mut self, texts: impl IntoIterator<Item = &'t String>) {
        texts.into_iter().for_each(|text| self.text(text));
    }

    fn agent(&mut self, agent: &AgentId) {
        self.text(agent.name());
        self.texts(agent.addresses());
        for (name, value) in agent.user_defined() {
            self.text(name);
            self.text(value);
        }
        // The depth of resolvers is bounded by `AgentId`.
        agent.resolvers().iter().for_each(|it| self.agent(it));
    }

    /// Adds the value of a property. A formula within it, which no service needs, counts as too large.
    fn term(&mut self, value: &Term<'_>) {
        self.parts += 1;
        match value {
            Term::Variable(text) | Term::Meta(text) | Term::String(text) => self.text(text),
            Term::Number(number) => self.text(number.as_str()),
            Term::Bytes(bytes) => self.bytes += bytes.len(),
            Term::Boolean(_) | Term::DateTime(_) => {}
            Term::Sequence(terms) | Term::Set(terms) => {
                terms.iter().for_each(|term| self.term(term));
            }
            Term::Functional(term) => {
                self.text(&term.symbol);
                match &term.arguments {
                    Arguments::Terms(terms) => terms.iter().for_each(|term| self.term(term)),
                    Arguments::Parameters(parameters) => parameters.iter().for_each(|it| {
                        self.text(&it.name);
                        self.term(&it.value);
                    }),
                }
            }
            _ => self.parts = usize::MAX / 2,
        }
    }
}

/// Whether an agent identifier matches that of a template: the same name, in any case, and the addresses
/// of the template in their order among its addresses (FIPA00023 clause 6.4.2.1).
pub(crate) fn matches_agent(template: &AgentId, agent: &AgentId) -> bool {
    let mut addresses = agent.addresses().iter();
    template.name().eq_ignore_ascii_case(agent.name())
        && template
            .addresses()
            .iter()
            .all(|address| addresses.any(|other| address.eq_ignore_ascii_case(other)))
}

/// Returns the only action of `(result (action …) …)`, if the formula is one.
pub(crate) fn searched<'t, 'a>(wff: &'t Wff<'a>) -> Option<&'t ActionExpression<'a>> {
    match wff {
        Wff::Result(action, _) => match &**action {
            Term::Action(action) => Some(action),
            _ => None,
        },
        _ => None,
    }
}

/// Returns the name of the agent in the `:name` of a description, if it can be read. The check of the
/// authorization precedes the checks of the other slots.
pub(crate) fn described(term: Option<&Term<'_>>) -> Option<AgentId> {
    let parameters = term?.as_functional()?.parameters();
    let mut parameters = parameters.iter();
    let name = parameters.find(|parameter| parameter.name.eq_ignore_ascii_case("name"))?;
    AgentId::try_from(&name.value).ok()
}

/// Whether two numbers of the same kind have the same value. JADE writes `1.0E10` for `1e10`.
fn is_same(one: &Number<'_>, other: &Number<'_>) -> bool {
    if one == other {
        return true;
    }
    if one.is_integer() || other.is_integer() {
        let integers = (one.as_i128(), other.as_i128());
        return matches!(integers, (Some(one), Some(other)) if one == other);
    }
    let floats = (one.as_f64(), other.as_f64());
    matches!(floats, (Some(one), Some(other)) if one == other)
}

/// Whether a property matches that of a template. Names are compared exactly, and values by their types.
pub(crate) fn matches_property(template: &Property, property: &Property) -> bool {
    template.name == property.name
        && match (&template.value, &property.value) {
            (None, _) => true,
            (Some(template), Some(value)) => matches_value(template, value),
            (Some(_), None) => false,
        }
}

/// Whether two values are equal: texts in any case, numbers by their values. As in JADE, an integer equals
/// no floating point number, and a number no text. JADE writes the texts `+5` and `.5` without quotation
/// marks, so that they are read as numbers.
fn matches_value(template: &Term<'_>, value: &Term<'_>) -> bool {
    match (template, value) {
        (Term::Number(one), Term::Number(other)) => is_same(one, other),
        (Term::Number(number), other) | (other, Term::Number(number)) => {
            let number = number.as_str();
            number.starts_with(['+', '.'])
                && text(other).is_some_and(|text| text.eq_ignore_ascii_case(number))
        }
        _ => match (text(template), text(value)) {
            (Some(template), Some(value)) => template.eq_ignore_ascii_case(value),
            _ => template == value,
        },
    }
}
