//! Agent identifiers, whose names and addresses are attributes in messages and text in envelopes.
//! Either is read in both.

use crate::bitefficient::without_x;
use crate::error::{DecodeError, EncodeError, Problem};
use crate::xml::out::Out;
use crate::xml::reader::{Element, Elements};
use crate::{AgentId, AgentIdError, Dialect};

/// Reads the agent identifiers in the element that was begun last, to its end.
pub(super) fn read_all(
    elements: &mut Elements<'_>,
    agents: &mut Vec<AgentId>,
) -> Result<(), DecodeError> {
    while let Some(child) = elements.child()? {
        if child.is("agent-identifier") {
            agents.push(read(elements, &child)?);
        } else {
            elements.skip()?;
        }
    }
    Ok(())
}

/// The nesting of elements is bounded by the reader, and with it this recursion.
fn read<'a>(elements: &mut Elements<'a>, begin: &Element<'a>) -> Result<AgentId, DecodeError> {
    let mut name = None;
    let mut addresses = Vec::new();
    let mut resolvers = Vec::new();
    let mut user_defined = Vec::new();
    while let Some(child) = elements.child()? {
        if child.is("name") {
            let value = elements.value(&child, &["id", "refid"])?;
            name = Some(value.trimmed("agent name")?);
        } else if child.is("addresses") {
            read_addresses(elements, &mut addresses)?;
        } else if child.is("resolvers") {
            read_all(elements, &mut resolvers)?;
        } else if let Some(pair) = user_defined_pair(elements, &child)? {
            user_defined.push(pair);
        }
    }
    let refused = |error| {
        let problem = match error {
            AgentIdError::EmptyName => Problem::Empty("agent name"),
            AgentIdError::NameTooLong(_) => Problem::TooLong("agent name"),
            AgentIdError::TooDeep => Problem::TooDeep("resolvers"),
            AgentIdError::UserDefinedName(_) => {
                Problem::NotAWord("name of a user-defined parameter")
            }
            _ => Problem::NotAWord("agent identifier"),
        };
        elements.error(begin.offset, problem)
    };
    let Some(name) = name else {
        return Err(elements.error(begin.offset, Problem::Missing("name of the agent")));
    };
    let mut agent = AgentId::new(name).map_err(refused)?;
    for address in addresses {
        agent = agent.with_address(address).map_err(refused)?;
    }
    for resolver in resolvers {
        agent = agent.with_resolver(resolver).map_err(refused)?;
    }
    for (name, value) in user_defined {
        agent = agent.with_user_defined(name, value).map_err(refused)?;
    }
    Ok(agent)
}

fn read_addresses(
    elements: &mut Elements<'_>,
    addresses: &mut Vec<String>,
) -> Result<(), DecodeError> {
    while let Some(child) = elements.child()? {
        if !child.is("url") {
            elements.skip()?;
            continue;
        }
        let address = elements.value(&child, &["href"])?.trimmed("address")?;
        if !address.is_empty() {
            addresses.push(address);
        }
    }
    Ok(())
}

/// Reads an element to its end: a user-defined parameter in either form, name without `X-`, or
/// `None` for an element that is not known.
pub(super) fn user_defined_pair<'a>(
    elements: &mut Elements<'a>,
    element: &Element<'a>,
) -> Result<Option<(String, String)>, DecodeError> {
    let name = if element.is("user-defined") {
        let Some(name) = elements.attribute(element, "href")? else {
            let problem = Problem::Missing("name of a user-defined parameter");
            return Err(elements.error(element.offset, problem));
        };
        let name = name.trimmed("name of a user-defined parameter")?;
        without_x(&name).to_owned()
    } else if let Some(name) = element.user_defined() {
        name.to_owned()
    } else {
        elements.skip()?;
        return Ok(None);
    };
    let value = elements.value(element, &[])?;
    Ok(Some((name, value.text("user-defined value")?)))
}

/// How identifiers are written.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// Name and addresses as attributes (FIPA00071).
    Message,
    /// Name and addresses as text (FIPA00085).
    Envelope,
}

/// Writes elements with agent identifiers in them, all in one where the dialect's reader takes it.
pub(super) fn write_all(
    out: &mut Out,
    element: &str,
    agents: &[AgentId],
    form: Form,
    dialect: Dialect,
) -> Result<(), EncodeError> {
    // JADE writes one agent in each element and reads no more from one of a message;
    // fipa_services reads only the last element of an envelope.
    let at_once = if dialect == Dialect::Jade {
        1
    } else {
        agents.len().max(1)
    };
    for group in agents.chunks(at_once) {
        out.open(element);
        for agent in group {
            write(out, agent, form, dialect)?;
        }
        out.close(element);
    }
    Ok(())
}

pub(super) fn write(
    out: &mut Out,
    agent: &AgentId,
    form: Form,
    dialect: Dialect,
) -> Result<(), EncodeError> {
    out.open("agent-identifier");
    write_value(out, ("name", "id"), "agent name", agent.name(), form)?;
    // JADE writes the element even where there is nothing in it.
    let as_jade = form == Form::Envelope && dialect == Dialect::Jade;
    if !agent.addresses().is_empty() || as_jade {
        out.open("addresses");
        for address in agent.addresses() {
            write_value(out, ("url", "href"), "address", address, form)?;
        }
        out.close("addresses");
    }
    if as_jade && !agent.resolvers().is_empty() {
        return Err(EncodeError::Unrepresentable {
            what: "resolvers of an agent",
            why: "JADE does not read them in envelopes",
        });
    }
    if dialect == Dialect::Jade {
        for resolver in agent.resolvers() {
            out.open("resolvers");
            write(out, resolver, form, dialect)?;
            out.close("resolvers");
        }
    } else if !agent.resolvers().is_empty() {
        out.open("resolvers");
        for resolver in agent.resolvers() {
            write(out, resolver, form, dialect)?;
        }
        out.close("resolvers");
    }
    for (name, value) in agent.user_defined() {
        if dialect == Dialect::Standard {
            out.user_defined(name, value, false)?;
        } else {
            // fipa_services writes user-defined elements, but reads only this.
            out.user_element(name, value)?;
        }
    }
    out.close("agent-identifier");
    Ok(())
}

fn write_value(
    out: &mut Out,
    (element, attribute): (&str, &str),
    what: &'static str,
    value: &str,
    form: Form,
) -> Result<(), EncodeError> {
    if form == Form::Message {
        return out.empty(element, attribute, what, value);
    }
    out.open(element);
    out.text_trimmed(what, value)?;
    out.close(element);
    Ok(())
}
