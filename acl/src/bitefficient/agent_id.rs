//! Agent identifiers in a bit-efficient message.

use crate::bitefficient::code;
use crate::bitefficient::expression::expression;
use crate::bitefficient::notes::{self, Notes};
use crate::bitefficient::reader::Reader;
use crate::error::{DecodeError, Problem};
use crate::scan::Kind;
use crate::view::{AgentIdView, AgentIds, Encoding, List, Part, check_name};
use crate::word::is_token;
use crate::{AgentId, Text};

const CLAUSE: &str = "FIPA00069 2.2 AgentIdentifier";

/// Reads the next identifier of a sequence. The bytes have been checked before.
pub(crate) fn next<'a>(rest: &mut &'a [u8]) -> Option<AgentIdView<'a>> {
    (!rest.is_empty()).then_some(())?;
    let mut reader = Reader::new(rest);
    let agent = agent_id(&mut reader, AgentId::MAX_DEPTH).ok();
    *rest = agent.map_or(&[], |_| reader.rest());
    agent
}

/// Reads the next part of a checked identifier.
pub(crate) fn next_part<'a>(rest: &mut &'a [u8], list: &mut List) -> Option<Part<'a>> {
    let mut reader = Reader::new(rest);
    let part = part(&mut reader, list, AgentId::MAX_DEPTH).ok().flatten();
    *rest = reader.rest();
    part
}

/// Reads an agent identifier with resolvers nested at most `depth` deep.
#[inline(always)]
pub(crate) fn agent_id<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    // The fast path takes no notes.
    if !N::ENABLED
        && let Some(name) = reader.short_agent_name()
    {
        let (name, end) = (Text::plain(name), &[code::END]);
        return Ok(AgentIdView::new(name, Encoding::BitEfficient, end));
    }
    agent_id_slow(reader, depth)
}

#[inline(never)]
fn agent_id_slow<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    let first = reader.byte(CLAUSE, "an agent identifier")?;
    if first != code::agent::BEGIN {
        return Err(reader.unexpected(CLAUSE, first, "an agent identifier"));
    }
    let offset = reader.offset();
    let name = Text::plain(word(reader, "agent name")?);
    check_name(&name, "agent name").map_err(|problem| DecodeError::new(offset, CLAUSE, problem))?;
    reader.note(|| format!("agent identifier: name {}", notes::quoted(&name.as_str())));
    reader.notes().deeper();
    let start = reader.position();
    let mut list = List::Outside;
    while part(reader, &mut list, depth)?.is_some() {}
    reader.notes().shallower();
    reader.note(|| "end of agent identifier".to_owned());
    let parts = reader.since(start);
    Ok(AgentIdView::new(name, Encoding::BitEfficient, parts))
}

/// Reads the agent identifiers of a set, including its end.
#[inline(always)]
pub(crate) fn agent_ids<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    set: &'static str,
) -> Result<AgentIds<'a>, DecodeError> {
    if !N::ENABLED
        && let Some(members) = reader.short_agent_names()
    {
        return Ok(AgentIds::new(Encoding::BitEfficient, members));
    }
    agent_ids_slow(reader, set)
}

#[inline(never)]
fn agent_ids_slow<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    set: &'static str,
) -> Result<AgentIds<'a>, DecodeError> {
    let members = reader.set(set, |reader| agent_id(reader, AgentId::MAX_DEPTH))?;
    Ok(AgentIds::new(Encoding::BitEfficient, members))
}

/// Reads the next part of an identifier with resolvers nested at most `depth` deep. Returns `None`
/// at its end.
fn part<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    list: &mut List,
    depth: usize,
) -> Result<Option<Part<'a>>, DecodeError> {
    loop {
        list.end(reader);
        match list {
            List::Addresses => return address(reader).map(Some),
            List::Resolvers => {
                let Some(depth) = depth.checked_sub(1) else {
                    return Err(reader.error(CLAUSE, Problem::TooDeep("resolvers")));
                };
                return Ok(Some(Part::Resolver(agent_id(reader, depth)?)));
            }
            List::Outside => {}
        }
        match reader.byte(CLAUSE, "an agent identifier")? {
            code::END => return Ok(None),
            code::agent::ADDRESSES => list.begin(List::Addresses, reader),
            code::agent::RESOLVERS => list.begin(List::Resolvers, reader),
            code::agent::USER_DEFINED => {
                let (name, value) = user_defined(reader)?;
                return Ok(Some(Part::UserDefined(name, value)));
            }
            other => return Err(reader.unexpected(CLAUSE, other, "a part of an agent identifier")),
        }
    }
}

/// Both bit-efficient encodings begin a list with its code and end it with [`code::END`].
impl List {
    pub(crate) fn begin<N: Notes>(&mut self, list: Self, reader: &mut Reader<'_, N>) {
        *self = list;
        reader.note(|| list.name().to_owned());
        reader.notes().deeper();
    }

    /// Leaves the list if the next byte ends it.
    pub(crate) fn end<N: Notes>(&mut self, reader: &mut Reader<'_, N>) {
        if *self != Self::Outside && reader.take_if(code::END) {
            reader.notes().shallower();
            reader.note(|| format!("end of {}", self.name()));
            *self = Self::Outside;
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Outside => "",
            Self::Addresses => "addresses",
            Self::Resolvers => "resolvers",
        }
    }
}

fn address<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<Part<'a>, DecodeError> {
    let address = Text::plain(word(reader, "address")?);
    if address.is_empty() {
        return Err(reader.error(CLAUSE, Problem::Empty("address")));
    }
    reader.note(|| format!("address {}", notes::quoted(&address.as_str())));
    Ok(Part::Address(address))
}

/// Reads a `BinWord`.
#[inline(always)]
pub(crate) fn word<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<&'a [u8], DecodeError> {
    match reader.short_word() {
        Some((word, _)) => Ok(word),
        None => word_slow(reader, what),
    }
}

/// Reads a `BinWord`. Returns whether it is a word apart from its first character.
#[inline(always)]
pub(crate) fn token<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<(Text<'a>, bool), DecodeError> {
    let (word, is_token) = match reader.short_word() {
        Some((word, kind)) => (word, !word.is_empty() && Kind::is_token(kind)),
        None => {
            let word = word_slow(reader, what)?;
            (word, is_token(word))
        }
    };
    Ok((Text::plain(word), is_token))
}

#[inline(never)]
fn word_slow<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    what: &'static str,
) -> Result<&'a [u8], DecodeError> {
    const CLAUSE: &str = "FIPA00069 2.2 BinWord";
    match reader.byte(CLAUSE, what)? {
        code::token::WORD => reader.plain(CLAUSE, what),
        code::token::WORD_INDEX => Err(reader.error(CLAUSE, Problem::CodeTable)),
        other => Err(reader.unexpected(CLAUSE, other, what)),
    }
}

/// Reads the name, without its `X-`, and the value of a user-defined parameter.
#[inline(never)]
pub(crate) fn user_defined<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
) -> Result<(Text<'a>, Text<'a>), DecodeError> {
    let offset = reader.offset();
    let name = without_x(word(reader, "user-defined name")?);
    if !is_token(name) {
        let problem = Problem::NotAWord("name of a user-defined parameter");
        return Err(DecodeError::new(offset, "FIPA00061 user-defined", problem));
    }
    let name = Text::plain(name);
    reader.note(|| format!("user-defined parameter {}", notes::quoted(&name.as_str())));
    // JADE writes an empty value as a single 00, which is not an expression.
    if reader.take_if(0x00) {
        reader.note(|| "user-defined value: none, as JADE writes it".to_owned());
        return Ok((name, Text::plain(b"")));
    }
    let value = expression(reader, "user-defined value")?;
    reader.note(|| notes::named("user-defined value", &value));
    Ok((name, value))
}

/// Removes the `X-` of a user-defined name. Some peers write none.
pub(crate) fn without_x(name: &[u8]) -> &[u8] {
    match name {
        [b'X' | b'x', b'-', rest @ ..] if !rest.is_empty() => rest,
        _ => name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_read_in_any_order() {
        let bytes = b"\x02\x10a\0\x04\x10X-p\0\x12\x80\x03\x02\x10r\0\x01\x01\x02\x10u:1\0\x10u:2\0\x01\x01";
        let mut reader = Reader::new(bytes);
        let view = agent_id(&mut reader, 16).unwrap();
        assert_eq!(reader.remaining(), 0);
        assert_eq!(view.name(), "a");
        assert_eq!(view.addresses().collect::<Vec<_>>(), ["u:1", "u:2"]);
        let resolvers: Vec<_> = view.resolvers().map(|resolver| resolver.name()).collect();
        assert_eq!(resolvers, ["r"]);
        let user: Vec<_> = view.user_defined().collect();
        assert_eq!(user, [(Text::plain(b"p"), Text::plain(b"7"))]);
        assert_eq!(
            view.to_agent_id().unwrap().user_defined(),
            [("p".into(), "7".into())]
        );
    }

    #[test]
    fn resolvers_nested_too_deep_are_refused() {
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
    fn missing_names_and_empty_addresses_are_refused() {
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
