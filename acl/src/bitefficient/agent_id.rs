//! Agent identifiers in a bit-efficient message, borrowed.

use crate::AgentId;
use crate::bitefficient::notes::{self, Notes};
use crate::bitefficient::reader::Reader;
use crate::bitefficient::text::{Text, expression};
use crate::error::{DecodeError, Problem};
use crate::word::is_token;

const CLAUSE: &str = "FIPA00069 2.1 AID";

/// An agent identifier in an encoded message.
#[derive(Debug, Clone, Copy)]
pub struct AgentIdView<'a> {
    name: &'a str,
    /// What follows the name, with the end of the identifier.
    parameters: &'a [u8],
}

impl<'a> AgentIdView<'a> {
    /// The name.
    #[must_use]
    pub fn name(&self) -> &'a str {
        self.name
    }

    /// Transport addresses, the preferred one first.
    pub fn addresses(&self) -> impl Iterator<Item = &'a str> + use<'a> {
        // Of several lists the last one counts.
        let lists = self.parameters().filter_map(|parameter| match parameter {
            Parameter::Addresses(bytes) => Some(bytes),
            _ => None,
        });
        let mut reader = Reader::new(lists.last().unwrap_or_default());
        // Checked when the message was read: an error cannot occur, and would end the list.
        std::iter::from_fn(move || {
            (reader.peek()? == 0x10).then(|| reader.skip_peeked())?;
            reader.plain(CLAUSE, "address").ok()
        })
    }

    /// Agents that can resolve the name.
    #[must_use]
    pub fn resolvers(&self) -> AgentIds<'a> {
        let lists = self.parameters().filter_map(|parameter| match parameter {
            Parameter::Resolvers(bytes) => Some(bytes),
            _ => None,
        });
        AgentIds::new(lists.last().unwrap_or_default())
    }

    /// User-defined parameters, names without `X-`.
    pub fn user_defined(&self) -> impl Iterator<Item = (&'a str, Text<'a>)> + use<'a> {
        self.parameters().filter_map(|parameter| match parameter {
            Parameter::UserDefined(name, value) => Some((name, value)),
            _ => None,
        })
    }

    fn parameters(&self) -> impl Iterator<Item = Parameter<'a>> + use<'a> {
        let mut reader = Reader::new(self.parameters);
        // Checked when the message was read: an error cannot occur, and would end this.
        std::iter::from_fn(move || parameter(&mut reader, AgentId::MAX_DEPTH).ok()?)
    }

    /// The identifier as an owned value.
    pub(crate) fn to_owned(self) -> Result<AgentId, crate::AgentIdError> {
        let mut agent = AgentId::new(self.name)?;
        for address in self.addresses() {
            agent = agent.with_address(address)?;
        }
        for resolver in self.resolvers() {
            agent = agent.with_resolver(resolver.to_owned()?)?;
        }
        for (name, value) in self.user_defined() {
            agent = agent.with_user_defined(name, value.as_str())?;
        }
        Ok(agent)
    }
}

/// The agent identifiers of a set or sequence in an encoded message.
#[derive(Debug, Clone, Default)]
pub struct AgentIds<'a>(&'a [u8]);

impl<'a> AgentIds<'a> {
    /// The identifiers in checked bytes.
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self(bytes)
    }
}

impl<'a> Iterator for AgentIds<'a> {
    type Item = AgentIdView<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        (!self.0.is_empty()).then_some(())?;
        let mut reader = Reader::new(self.0);
        // Checked when the message was read: an error cannot occur, and would end the list.
        let agent = agent_id(&mut reader, AgentId::MAX_DEPTH).ok();
        self.0 = agent.map_or(&[], |_| reader.rest());
        agent
    }
}

/// Reads an agent identifier, whose resolvers may be nested `depth` deep.
#[inline(always)]
pub(crate) fn agent_id<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    // Whoever wants every part explained has to go the long way.
    if N::SILENT
        && let Some(name) = reader.short_agent_name()
    {
        let parameters = &[0x01];
        return Ok(AgentIdView { name, parameters });
    }
    other_agent_id(reader, depth)
}

#[inline(never)]
fn other_agent_id<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    let code = reader.byte(CLAUSE, "an agent identifier")?;
    if code != 0x02 {
        return Err(reader.unexpected(CLAUSE, code, "an agent identifier"));
    }
    let offset = reader.offset();
    let name = word(reader, "agent name")?;
    if name.is_empty() || name.len() > AgentId::MAX_NAME {
        let problem = match name {
            "" => Problem::Empty("agent name"),
            _ => Problem::TooLong("agent name"),
        };
        return Err(DecodeError::new(offset, CLAUSE, problem));
    }
    reader.note(|| format!("agent identifier: name {}", notes::quoted(name)));
    reader.notes().deeper();
    let start = reader.position();
    while parameter(reader, depth)?.is_some() {}
    reader.notes().shallower();
    reader.note(|| "end of agent identifier".to_owned());
    let parameters = reader.since(start);
    Ok(AgentIdView { name, parameters })
}

/// Reads the agent identifiers of a set up to its end, and gives the bytes in front of that.
pub(crate) fn agent_ids<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
    set: &'static str,
) -> Result<&'a [u8], DecodeError> {
    reader.set(set, |reader| agent_id(reader, depth))
}

enum Parameter<'a> {
    Addresses(&'a [u8]),
    Resolvers(&'a [u8]),
    UserDefined(&'a str, Text<'a>),
}

/// The next parameter of an identifier, or `None` at its end.
fn parameter<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<Option<Parameter<'a>>, DecodeError> {
    let code = reader.byte(CLAUSE, "an agent identifier")?;
    Ok(Some(match code {
        0x01 => return Ok(None),
        0x02 => Parameter::Addresses(addresses(reader)?),
        0x03 => {
            let Some(depth) = depth.checked_sub(1) else {
                return Err(reader.error(CLAUSE, Problem::TooDeep("resolvers")));
            };
            Parameter::Resolvers(agent_ids(reader, depth, "resolvers")?)
        }
        0x04 => {
            let (name, value) = user_defined(reader)?;
            Parameter::UserDefined(name, value)
        }
        other => return Err(reader.unexpected(CLAUSE, other, "a part of an agent identifier")),
    }))
}

fn addresses<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<&'a [u8], DecodeError> {
    reader.note(|| "addresses".to_owned());
    reader.notes().deeper();
    let start = reader.position();
    loop {
        let addresses = reader.since(start);
        if reader.take_if(0x01) {
            reader.notes().shallower();
            reader.note(|| "end of addresses".to_owned());
            return Ok(addresses);
        }
        let address = word(reader, "address")?;
        if address.is_empty() {
            return Err(reader.error(CLAUSE, Problem::Empty("address")));
        }
        reader.note(|| format!("address {}", notes::quoted(address)));
    }
}

/// Reads a `BinWord`.
#[inline(always)]
pub(crate) fn word<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<&'a str, DecodeError> {
    match reader.short_word() {
        Some(word) => Ok(word),
        None => other_word(reader, what),
    }
}

#[inline(never)]
fn other_word<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<&'a str, DecodeError> {
    const CLAUSE: &str = "FIPA00069 2.1 BinWord";
    match reader.byte(CLAUSE, what)? {
        0x10 => reader.plain(CLAUSE, what),
        0x11 => Err(reader.error(CLAUSE, Problem::CodeTable)),
        other => Err(reader.unexpected(CLAUSE, other, what)),
    }
}

/// Reads name and value of a user-defined parameter; the name comes without `X-`.
pub(crate) fn user_defined<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
) -> Result<(&'a str, Text<'a>), DecodeError> {
    let offset = reader.offset();
    let name = without_x(word(reader, "user-defined name")?);
    if !is_token(name) {
        let problem = Problem::NotAWord("name of a user-defined parameter");
        return Err(DecodeError::new(offset, "FIPA00061 user-defined", problem));
    }
    reader.note(|| format!("user-defined parameter {}", notes::quoted(name)));
    // JADE writes an empty value as a lone 00, which is no expression.
    if reader.take_if(0x00) {
        reader.note(|| "user-defined value: none, as JADE writes it".to_owned());
        return Ok((name, Text::plain("")));
    }
    let value = expression(reader, "user-defined value")?;
    reader.note(|| notes::named("user-defined value", &value));
    Ok((name, value))
}

/// The name of a user-defined parameter without its `X-`, which not every peer writes.
pub(crate) fn without_x(name: &str) -> &str {
    match name.as_bytes() {
        [b'X' | b'x', b'-', _, ..] => name.get(2..).unwrap_or(name),
        _ => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_parts_in_any_order() {
        let bytes = b"\x02\x10a\0\x04\x10X-p\0\x12\x80\x03\x02\x10r\0\x01\x01\x02\x10u:1\0\x10u:2\0\x01\x01";
        let mut reader = Reader::new(bytes);
        let view = agent_id(&mut reader, 16).unwrap();
        assert_eq!(reader.remaining(), 0);
        assert_eq!(view.name(), "a");
        assert_eq!(view.addresses().collect::<Vec<_>>(), ["u:1", "u:2"]);
        assert_eq!(
            view.resolvers().map(|r| r.name()).collect::<Vec<_>>(),
            ["r"]
        );
        let user: Vec<_> = view.user_defined().collect();
        assert_eq!(user, [("p", Text::plain("7"))]);
        assert_eq!(
            view.to_owned().unwrap().user_defined(),
            [("p".into(), "7".into())]
        );
    }

    #[test]
    fn resolvers_are_not_followed_for_ever() {
        let nested = |depth: usize| {
            let mut bytes = b"\x02\x10a\0\x03".repeat(depth);
            bytes.extend_from_slice(b"\x02\x10a\0\x01");
            bytes.extend_from_slice(&b"\x01\x01".repeat(depth));
            bytes
        };
        let deepest = nested(AgentId::MAX_DEPTH);
        assert!(agent_id(&mut Reader::new(&deepest), AgentId::MAX_DEPTH).is_ok());
        let error = agent_id(&mut Reader::new(&nested(50_000)), AgentId::MAX_DEPTH).unwrap_err();
        assert_eq!(error.problem(), &Problem::TooDeep("resolvers"));
    }

    #[test]
    fn names_and_addresses_must_be_there() {
        for bytes in [
            &b"\x02\x10\0\x01"[..],
            b"\x02\x10a\0\x02\x10\0\x01\x01",
            b"\x02\x10a\0",
            b"\x02\x10a\0\x05",
            b"\x03",
        ] {
            assert!(agent_id(&mut Reader::new(bytes), 16).is_err(), "{bytes:?}");
        }
    }
}
