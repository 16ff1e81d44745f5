//! Agent identifiers in a bit-efficient envelope.
//!
//! Unlike in messages, names and addresses are strings without a code, and user-defined parameters
//! have another code.

use crate::bitefficient::code;
use crate::bitefficient::notes::{self, Notes};
use crate::bitefficient::reader::Reader;
use crate::envelope::read::any;
use crate::error::{DecodeError, Problem};
use crate::view::{AgentIdView, AgentIds, Encoding, List, Part, check_name};
use crate::word::is_token;
use crate::{AgentId, Text};

const CLAUSE: &str = "FIPA00088 AID";

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
#[inline]
pub(super) fn agent_id<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    // The fast path takes no notes.
    if !N::ENABLED
        && let Some(name) = reader.short_bare_name()
    {
        let (name, end) = (Text::plain(name), &[code::END]);
        return Ok(AgentIdView::new(name, Encoding::Envelope, end));
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
    let name = reader.string(CLAUSE, "agent name")?;
    check_name(&name, "agent name").map_err(|problem| DecodeError::new(offset, CLAUSE, problem))?;
    reader.note(|| format!("agent identifier: name {}", notes::text(&name)));
    reader.notes().deeper();
    let start = reader.position();
    let mut list = List::Outside;
    while part(reader, &mut list, depth)?.is_some() {}
    reader.notes().shallower();
    reader.note(|| "end of agent identifier".to_owned());
    let parts = reader.since(start);
    Ok(AgentIdView::new(name, Encoding::Envelope, parts))
}

/// Reads the agent identifiers of a sequence, including its end.
pub(super) fn agent_ids<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    set: &'static str,
) -> Result<AgentIds<'a>, DecodeError> {
    let members = reader.set(set, |reader| agent_id(reader, AgentId::MAX_DEPTH))?;
    Ok(AgentIds::new(Encoding::Envelope, members))
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
            // JADE writes the code of messages and a string, as editions before C did.
            id @ (code::agent::USER_DEFINED | code::agent::USER_DEFINED_IN_ENVELOPE) => {
                let name = user_defined_name(reader, CLAUSE)?;
                let value = if id == code::agent::USER_DEFINED {
                    reader.string(CLAUSE, "user-defined value")?
                } else {
                    any(reader, "user-defined value")?
                };
                reader.note(|| notes::user_defined(&name, &value));
                return Ok(Some(Part::UserDefined(name.without_x(), value)));
            }
            other => return Err(reader.unexpected(CLAUSE, other, "a part of an agent identifier")),
        }
    }
}

fn address<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Result<Part<'a>, DecodeError> {
    let address = reader.string(CLAUSE, "address")?;
    if address.is_empty() {
        return Err(reader.error(CLAUSE, Problem::Empty("address")));
    }
    reader.note(|| format!("address {}", notes::text(&address)));
    Ok(Part::Address(address))
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
