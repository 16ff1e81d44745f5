//! Agent identifiers in a bit-efficient envelope.
//!
//! Unlike in messages, names and addresses are strings without a code, and user-defined parameters
//! have another code.

use crate::bitefficient::code;
use crate::bitefficient::identifier::{self, Notation};
use crate::bitefficient::notes::{self, Notes};
use crate::bitefficient::reader::Reader;
use crate::envelope::read::any;
use crate::error::{DecodeError, Problem};
use crate::view::{AgentIdView, AgentIds, Encoding};
use crate::word::is_token;
use crate::{AgentId, Text};

/// The notation in envelopes (FIPA00088).
pub(crate) struct InEnvelopes;

impl Notation for InEnvelopes {
    const ENCODING: Encoding = Encoding::Envelope;
    const CLAUSE: &'static str = "FIPA00088 AID";

    #[inline(always)]
    fn short_name<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Option<&'a [u8]> {
        reader.short_bare_name()
    }

    #[inline(always)]
    fn text<'a, N: Notes>(
        reader: &mut Reader<'a, N>,
        what: &'static str,
    ) -> Result<Text<'a>, DecodeError> {
        reader.string(Self::CLAUSE, what)
    }

    fn noted(text: &Text<'_>) -> String {
        notes::text(text)
    }

    #[inline]
    fn user_defined<'a, N: Notes>(
        reader: &mut Reader<'a, N>,
        id: u8,
    ) -> Result<Option<(Text<'a>, Text<'a>)>, DecodeError> {
        // JADE writes the code of messages and a string, as editions before C did.
        let is_string = match id {
            code::agent::USER_DEFINED => true,
            code::agent::USER_DEFINED_IN_ENVELOPE => false,
            _ => return Ok(None),
        };
        let name = user_defined_name(reader, Self::CLAUSE)?;
        let value = match is_string {
            true => reader.string(Self::CLAUSE, "user-defined value")?,
            false => any(reader, "user-defined value")?,
        };
        reader.note(|| notes::user_defined(&name, &value));
        Ok(Some((name.without_x(), value)))
    }
}

/// Reads an agent identifier with resolvers nested at most `depth` deep.
#[inline]
pub(super) fn agent_id<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    identifier::agent_id::<InEnvelopes, N>(reader, depth)
}

/// Reads the agent identifiers of a sequence, including its end.
pub(super) fn agent_ids<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    set: &'static str,
) -> Result<AgentIds<'a>, DecodeError> {
    let members = reader.set(set, |reader| agent_id(reader, AgentId::MAX_DEPTH))?;
    Ok(AgentIds::new(Encoding::Envelope, members))
}

/// Reads the name of a user-defined parameter, including its `X-`.
pub(super) fn user_defined_name<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    clause: &'static str,
) -> Result<Text<'a>, DecodeError> {
    let offset = reader.offset();
    let name = reader.string(clause, "user-defined name")?;
    if is_token(name.raw()) {
        return Ok(name);
    }
    let problem = Problem::NotAWord("name of a user-defined parameter");
    Err(DecodeError::new(offset, clause, problem))
}
