//! Agent identifiers as terms (FIPA00023 clause 3.1, FIPA00008 clause 3.9).

use std::borrow::Cow;

use fipa_acl::{AgentId, AgentIdError};

use crate::error::PrintError;
use crate::print::Printer;
use crate::term::{Arguments, FunctionalTerm, Parameter, Term};

/// The function symbol of agent identifiers.
const SYMBOL: &str = "agent-identifier";

/// An error: a term is not an agent identifier.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AgentTermError {
    /// The term is not `(agent-identifier …)`.
    #[error("the term is not (agent-identifier …)")]
    Symbol,
    /// The name, which is mandatory, is missing.
    #[error("the slot :name of the agent identifier is missing")]
    MissingName,
    /// A slot has a value of another type.
    #[error("the slot :{slot} of the agent identifier is not {expected}")]
    Slot {
        /// The slot.
        slot: &'static str,
        /// The type.
        expected: &'static str,
    },
    /// A slot occurs twice.
    #[error("the slot :{0} of the agent identifier is there twice")]
    DuplicateSlot(&'static str),
    /// A value that no agent identifier can have.
    #[error(transparent)]
    Value(#[from] AgentIdError),
    /// A user-defined value without a text.
    #[error(transparent)]
    Print(#[from] PrintError),
}

impl From<&AgentId> for Term<'static> {
    fn from(agent: &AgentId) -> Self {
        let mut parameters = vec![parameter("name", agent.name().to_owned().into())];
        if !agent.addresses().is_empty() {
            let addresses = agent.addresses().iter().cloned().map(Term::from);
            let addresses = Term::Sequence(addresses.collect());
            parameters.push(parameter("addresses", addresses));
        }
        if !agent.resolvers().is_empty() {
            let resolvers = agent.resolvers().iter().map(Term::from);
            let resolvers = Term::Sequence(resolvers.collect());
            parameters.push(parameter("resolvers", resolvers));
        }
        for (name, value) in agent.user_defined() {
            parameters.push(parameter(format!("X-{name}"), value.clone().into()));
        }
        Self::Functional(FunctionalTerm {
            symbol: Cow::Borrowed(SYMBOL),
            arguments: Arguments::Parameters(parameters),
        })
    }
}

fn parameter(name: impl Into<Cow<'static, str>>, value: Term<'static>) -> Parameter<'static> {
    let name = name.into();
    Parameter { name, value }
}

/// Reads an agent identifier. Slots whose names start with `X-` are user-defined. Other unknown
/// slots are ignored. The symbol and the slots are case-insensitive.
impl TryFrom<&Term<'_>> for AgentId {
    type Error = AgentTermError;

    fn try_from(term: &Term<'_>) -> Result<Self, Self::Error> {
        let term = term
            .as_functional()
            .filter(|term| term.symbol.eq_ignore_ascii_case(SYMBOL))
            .ok_or(AgentTermError::Symbol)?;
        let name = slot(term, "name")?.ok_or(AgentTermError::MissingName)?;
        let mut agent = match name {
            // JADE writes a name that is a number without quotation marks.
            Term::Number(number) => Self::new(number.as_str())?,
            name => Self::new(string("name", name)?)?,
        }
        .received();
        for address in sequence(term, "addresses")? {
            agent = agent.with_address(string("addresses", address)?)?;
        }
        for resolver in sequence(term, "resolvers")? {
            agent = agent.with_resolver(Self::try_from(resolver)?)?;
        }
        for Parameter { name, value } in term.parameters() {
            let Some(name) = name.strip_prefix("X-").or_else(|| name.strip_prefix("x-")) else {
                continue;
            };
            let text = match value {
                Term::String(text) => text.to_string(),
                other => {
                    let text = Printer::new().print(other)?;
                    String::from_utf8_lossy(&text).into_owned()
                }
            };
            agent = agent.with_user_defined(name, text)?;
        }
        Ok(agent)
    }
}

fn slot<'t, 'a>(
    term: &'t FunctionalTerm<'a>,
    name: &'static str,
) -> Result<Option<&'t Term<'a>>, AgentTermError> {
    let parameters = term.parameters().iter();
    let mut found = parameters.filter(|parameter| parameter.name.eq_ignore_ascii_case(name));
    let first = found.next();
    if found.next().is_some() {
        return Err(AgentTermError::DuplicateSlot(name));
    }
    Ok(first.map(|parameter| &parameter.value))
}

/// Returns the elements of a slot. JADE and legacy services also write sets.
fn sequence<'t, 'a>(
    term: &'t FunctionalTerm<'a>,
    name: &'static str,
) -> Result<&'t [Term<'a>], AgentTermError> {
    match slot(term, name)? {
        None => Ok(&[]),
        Some(value) => value.elements().ok_or(AgentTermError::Slot {
            slot: name,
            expected: "a sequence",
        }),
    }
}

fn string<'t>(slot: &'static str, term: &'t Term<'_>) -> Result<&'t str, AgentTermError> {
    let expected = "a string";
    term.as_str().ok_or(AgentTermError::Slot { slot, expected })
}
