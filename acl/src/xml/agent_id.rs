//! Agent identifiers in XML.
//!
//! Names and addresses are attributes in messages and text in envelopes. The reader accepts both
//! forms in both.

use crate::error::{DecodeError, EncodeError, Problem};
use crate::view::{AgentIdView, AgentIds, Encoding, List, Part, check_name};
use crate::xml::reader::{Element, Elements, Event};
use crate::xml::tag::Tag;
use crate::xml::value::Whitespace;
use crate::xml::writer::XmlWriter;
use crate::{AgentId, Dialect, Text};

/// The agents in all elements of one kind in the bytes of a document.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AgentSet<'a> {
    bytes: &'a [u8],
    /// Offset at which the search for the next agent begins.
    at: usize,
    /// Offset behind the last element.
    end: usize,
    tag: Tag,
    /// Whether `at` is inside one of the elements.
    inside: bool,
    /// Whether there is at least one agent.
    any: bool,
}

impl<'a> AgentSet<'a> {
    /// Separates the set from the bytes of its document.
    pub(crate) fn take_bytes(&self) -> (&'a [u8], AgentSet<'static>) {
        (self.bytes, self.with_bytes(&[]))
    }

    /// Returns the set with other bytes.
    pub(crate) fn with_bytes<'b>(&self, bytes: &'b [u8]) -> AgentSet<'b> {
        AgentSet {
            bytes,
            at: self.at,
            end: self.end,
            tag: self.tag,
            inside: self.inside,
            any: self.any,
        }
    }

    /// Adds the agents in later elements of the same document.
    pub(crate) fn add(&mut self, others: &Self) {
        self.end = others.end;
        self.any |= others.any;
    }

    pub(crate) fn is_empty(&self) -> bool {
        !self.any
    }
}

impl<'a> Iterator for AgentSet<'a> {
    type Item = AgentIdView<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        let mut elements = Elements::inside(self.bytes.get(self.at..self.end)?);
        // An error cannot occur in checked bytes. It would end the iteration.
        let agent = loop {
            match elements.next().ok()?? {
                Event::Text(_) => {}
                Event::End => self.inside = false,
                Event::Start(element) if !self.inside && element.tag == self.tag => {
                    self.inside = true;
                }
                Event::Start(element) if self.inside && element.tag == Tag::AgentIdentifier => {
                    break read(&mut elements, &element, AgentId::MAX_DEPTH).ok()?;
                }
                Event::Start(_) => elements.skip().ok()?,
            }
        };
        self.at += elements.position();
        Some(agent)
    }
}

/// Reads the agent identifiers in the current element, including its end, and adds them to `agents`.
pub(super) fn read_all<'a>(
    elements: &mut Elements<'a>,
    begin: &Element<'a>,
    agents: &mut AgentIds<'a>,
) -> Result<(), DecodeError> {
    let mut any = false;
    while let Some(child) = elements.child()? {
        if child.tag == Tag::AgentIdentifier {
            read(elements, &child, AgentId::MAX_DEPTH)?;
            any = true;
        } else {
            elements.skip()?;
        }
    }
    let these = AgentIds::xml(AgentSet {
        bytes: elements.bytes(),
        at: begin.offset,
        end: elements.position(),
        tag: begin.tag,
        inside: false,
        any,
    });
    if !agents.add(&these) {
        *agents = these;
    }
    Ok(())
}

/// Reads the current element, including its end. Returns its first agent identifier.
pub(super) fn read_one<'a>(
    elements: &mut Elements<'a>,
) -> Result<Option<AgentIdView<'a>>, DecodeError> {
    let mut agent = None;
    while let Some(child) = elements.child()? {
        if child.tag == Tag::AgentIdentifier {
            let read = read(elements, &child, AgentId::MAX_DEPTH)?;
            agent = agent.or(Some(read));
        } else {
            elements.skip()?;
        }
    }
    Ok(agent)
}

/// Reads an identifier with resolvers nested at most `depth` deep.
fn read<'a>(
    elements: &mut Elements<'a>,
    begin: &Element<'a>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    let start = elements.position();
    let (mut name, mut list) = (None, List::Outside);
    while part(elements, &mut list, depth, &mut name)?.is_some() {}
    let inside = elements.bytes().get(start..elements.begin());
    let wrong = |problem| elements.error(begin.offset, problem);
    let name = name.ok_or_else(|| wrong(Problem::Missing("name of the agent")))?;
    check_name(&name, "agent name").map_err(wrong)?;
    let inside = inside.unwrap_or_default();
    Ok(AgentIdView::new(name, Encoding::Xml, inside))
}

/// Reads the next part of a checked identifier.
pub(crate) fn next_part<'a>(rest: &mut &'a [u8], list: &mut List) -> Option<Part<'a>> {
    let mut elements = Elements::inside(rest);
    let part = part(&mut elements, list, AgentId::MAX_DEPTH, &mut None);
    *rest = elements.rest();
    part.ok().flatten()
}

/// Reads the next part of an identifier. Returns `None` at its end. If the name is read on the way,
/// it is stored in `name`.
fn part<'a>(
    elements: &mut Elements<'a>,
    list: &mut List,
    depth: usize,
    name: &mut Option<Text<'a>>,
) -> Result<Option<Part<'a>>, DecodeError> {
    loop {
        let child = match elements.next()? {
            Some(Event::Start(child)) => child,
            Some(Event::Text(_)) => continue,
            Some(Event::End) if *list != List::Outside => {
                *list = List::Outside;
                continue;
            }
            Some(Event::End) | None => return Ok(None),
        };
        match (*list, child.tag) {
            (List::Outside, Tag::Name) => {
                let value = elements.value(&child, &["id", "refid"])?;
                *name = Some(value.trimmed("agent name")?);
            }
            (List::Outside, Tag::Addresses) => *list = List::Addresses,
            (List::Outside, Tag::Resolvers) => *list = List::Resolvers,
            (List::Outside, _) => {
                if let Some((name, value)) = user_defined(elements, &child)? {
                    return Ok(Some(Part::UserDefined(name, value)));
                }
            }
            (List::Addresses, Tag::Url) => {
                let address = elements.value(&child, &["href"])?.trimmed("address")?;
                if !address.is_empty() {
                    return Ok(Some(Part::Address(address)));
                }
            }
            (List::Resolvers, Tag::AgentIdentifier) => {
                let Some(depth) = depth.checked_sub(1) else {
                    return Err(elements.error(child.offset, Problem::TooDeep("resolvers")));
                };
                return read(elements, &child, depth).map(|agent| Some(Part::Resolver(agent)));
            }
            _ => elements.skip()?,
        }
    }
}

/// Reads a user-defined parameter in either form, including the end of its element. The name has no
/// `X-`. Returns `None` for an unknown element.
pub(super) fn user_defined<'a>(
    elements: &mut Elements<'a>,
    element: &Element<'a>,
) -> Result<Option<(Text<'a>, Text<'a>)>, DecodeError> {
    let what = "name of a user-defined parameter";
    let wrong = |problem| elements.error(element.offset, problem);
    let name = if element.tag == Tag::UserDefined {
        let name = elements.attribute(element, "href")?;
        let name = name.ok_or_else(|| wrong(Problem::Missing(what)))?;
        name.trimmed(what)?.without_x()
    } else if let Some(name) = element.user_defined() {
        if std::str::from_utf8(name).is_err() {
            return Err(wrong(Problem::NotUtf8(what)));
        }
        Text::plain(name)
    } else {
        elements.skip()?;
        return Ok(None);
    };
    if !name.is_token() {
        return Err(wrong(Problem::NotAWord(what)));
    }
    let value = elements.value(element, &[])?;
    Ok(Some((
        name,
        value.text(Whitespace::Preserve, "user-defined value")?,
    )))
}

/// The form in which identifiers are written.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// Name and addresses as attributes (FIPA00071).
    Message,
    /// Name and addresses as text (FIPA00085).
    Envelope,
}

/// Writes agent identifiers in one element or, for JADE, in one element each.
pub(super) fn write_all(
    out: &mut XmlWriter<'_>,
    element: &str,
    agents: &[AgentId],
    form: Form,
    dialect: Dialect,
) -> Result<(), EncodeError> {
    // JADE reads only one agent in each element of a message. fipa_services reads only the last
    // element of an envelope.
    let per_element = if dialect == Dialect::Jade {
        1
    } else {
        agents.len().max(1)
    };
    for group in agents.chunks(per_element) {
        out.open(element);
        for agent in group {
            write(out, agent, form, dialect)?;
        }
        out.close(element);
    }
    Ok(())
}

pub(super) fn write(
    out: &mut XmlWriter<'_>,
    agent: &AgentId,
    form: Form,
    dialect: Dialect,
) -> Result<(), EncodeError> {
    out.open("agent-identifier");
    let name = ValueTag {
        element: "name",
        attribute: "id",
    };
    write_value(out, name, "agent name", agent.name(), form)?;
    // JADE writes the element even if it is empty.
    let as_jade = form == Form::Envelope && dialect == Dialect::Jade;
    if !agent.addresses().is_empty() || as_jade {
        out.open("addresses");
        for address in agent.addresses() {
            let url = ValueTag {
                element: "url",
                attribute: "href",
            };
            write_value(out, url, "address", address, form)?;
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
        match dialect {
            Dialect::Standard => out.user_defined(name, value, false)?,
            // In an identifier, fipa_services reads only elements with a name that begins with
            // `X-`. It takes name and type from their attributes.
            Dialect::FipaServices => out.user_element_with_name(name, value)?,
            Dialect::Jade => out.user_element(name, value)?,
        }
    }
    out.close("agent-identifier");
    Ok(())
}

/// The element of a value, whose attribute has the value in a message.
struct ValueTag {
    element: &'static str,
    attribute: &'static str,
}

fn write_value(
    out: &mut XmlWriter<'_>,
    tag: ValueTag,
    what: &'static str,
    value: &str,
    form: Form,
) -> Result<(), EncodeError> {
    if form == Form::Message {
        return out.empty(tag.element, tag.attribute, what, value);
    }
    out.open(tag.element);
    out.text_trimmed(what, value)?;
    out.close(tag.element);
    Ok(())
}
