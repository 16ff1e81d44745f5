//! Agent identifiers in a bit-efficient message.

use crate::bitefficient::code;
use crate::bitefficient::expression::expression;
use crate::bitefficient::identifier::{self, Notation};
use crate::bitefficient::notes::{self, Notes};
use crate::bitefficient::reader::Reader;
use crate::error::{DecodeError, Problem};
use crate::scan::Kind;
use crate::view::{AgentIdView, AgentIds, Encoding};
use crate::word::is_token;
use crate::{AgentId, Text};

/// The notation in messages (FIPA00069 2.2 `AgentIdentifier`).
pub(crate) struct InMessages;

impl Notation for InMessages {
    const ENCODING: Encoding = Encoding::BitEfficient;
    const CLAUSE: &'static str = "FIPA00069 2.2 AgentIdentifier";

    #[inline(always)]
    fn short_name<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Option<&'a [u8]> {
        reader.short_agent_name()
    }

    #[inline(always)]
    fn text<'a, N: Notes>(
        reader: &mut Reader<'a, N>,
        what: &'static str,
    ) -> Result<Text<'a>, DecodeError> {
        word(reader, what).map(Text::plain)
    }

    fn noted(text: &Text<'_>) -> String {
        notes::quoted(&text.as_str())
    }

    #[inline]
    fn user_defined<'a, N: Notes>(
        reader: &mut Reader<'a, N>,
        id: u8,
    ) -> Result<Option<(Text<'a>, Text<'a>)>, DecodeError> {
        match id {
            code::agent::USER_DEFINED => user_defined(reader).map(Some),
            _ => Ok(None),
        }
    }
}

/// Reads an agent identifier with resolvers nested at most `depth` deep.
#[inline(always)]
pub(crate) fn agent_id<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    identifier::agent_id::<InMessages, N>(reader, depth)
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
