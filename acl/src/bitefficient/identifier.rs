//! The structure of agent identifiers, which is the same in messages and in envelopes.

use crate::bitefficient::code;
use crate::bitefficient::notes::Notes;
use crate::bitefficient::reader::Reader;
use crate::error::{DecodeError, Problem};
use crate::view::{AgentIdView, Encoding, List, Part, check_name};
use crate::{AgentId, Text};

/// The notation of the texts of agent identifiers in one of the two encodings.
pub(crate) trait Notation {
    const ENCODING: Encoding;
    const CLAUSE: &'static str;

    /// Reads an identifier in the common case: a short ASCII name and no other part.
    fn short_name<'a, N: Notes>(reader: &mut Reader<'a, N>) -> Option<&'a [u8]>;

    /// Reads a name or an address.
    fn text<'a, N: Notes>(
        reader: &mut Reader<'a, N>,
        what: &'static str,
    ) -> Result<Text<'a>, DecodeError>;

    /// Formats a name or an address for a note.
    fn noted(text: &Text<'_>) -> String;

    /// Reads the name and the value of the user-defined parameter with this code. Returns `None` if
    /// the code is none of such parameters.
    fn user_defined<'a, N: Notes>(
        reader: &mut Reader<'a, N>,
        id: u8,
    ) -> Result<Option<(Text<'a>, Text<'a>)>, DecodeError>;
}

/// Reads the next identifier of a sequence. The bytes have been checked before.
pub(crate) fn next<'a, F: Notation>(rest: &mut &'a [u8]) -> Option<AgentIdView<'a>> {
    (!rest.is_empty()).then_some(())?;
    let mut reader = Reader::new(rest);
    let agent = agent_id::<F, _>(&mut reader, AgentId::MAX_DEPTH).ok();
    *rest = agent.map_or(&[], |_| reader.rest());
    agent
}

/// Reads the next part of a checked identifier.
pub(crate) fn next_part<'a, F: Notation>(rest: &mut &'a [u8], list: &mut List) -> Option<Part<'a>> {
    let mut reader = Reader::new(rest);
    let part = part::<F, _>(&mut reader, list, AgentId::MAX_DEPTH);
    let part = part.ok().flatten();
    *rest = reader.rest();
    part
}

/// Reads an agent identifier with resolvers nested at most `depth` deep.
#[inline(always)]
pub(crate) fn agent_id<'a, F: Notation, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    // The fast path takes no notes.
    if !N::ENABLED
        && let Some(name) = F::short_name(reader)
    {
        let (name, end) = (Text::plain(name), &[code::END]);
        return Ok(AgentIdView::new(name, F::ENCODING, end));
    }
    agent_id_slow::<F, N>(reader, depth)
}

#[inline(never)]
fn agent_id_slow<'a, F: Notation, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    let first = reader.byte(F::CLAUSE, "an agent identifier")?;
    if first != code::agent::BEGIN {
        return Err(reader.unexpected(F::CLAUSE, first, "an agent identifier"));
    }
    let offset = reader.offset();
    let name = F::text(reader, "agent name")?;
    check_name(&name, "agent name")
        .map_err(|problem| DecodeError::new(offset, F::CLAUSE, problem))?;
    reader.note(|| format!("agent identifier: name {}", F::noted(&name)));
    reader.notes().deeper();
    let start = reader.position();
    let mut list = List::Outside;
    while part::<F, N>(reader, &mut list, depth)?.is_some() {}
    reader.notes().shallower();
    reader.note(|| "end of agent identifier".to_owned());
    let parts = reader.since(start);
    Ok(AgentIdView::new(name, F::ENCODING, parts))
}

/// Reads the next part of an identifier with resolvers nested at most `depth` deep. Returns `None`
/// at its end.
fn part<'a, F: Notation, N: Notes>(
    reader: &mut Reader<'a, N>,
    list: &mut List,
    depth: usize,
) -> Result<Option<Part<'a>>, DecodeError> {
    loop {
        list.end(reader);
        match list {
            List::Addresses => return address::<F, N>(reader).map(Some),
            List::Resolvers => {
                let Some(depth) = depth.checked_sub(1) else {
                    return Err(reader.error(F::CLAUSE, Problem::TooDeep("resolvers")));
                };
                // Resolvers are rare: the fast path would only make this function larger.
                let resolver = agent_id_slow::<F, N>(reader, depth)?;
                return Ok(Some(Part::Resolver(resolver)));
            }
            List::Outside => {}
        }
        match reader.byte(F::CLAUSE, "an agent identifier")? {
            code::END => return Ok(None),
            code::agent::ADDRESSES => list.begin(List::Addresses, reader),
            code::agent::RESOLVERS => list.begin(List::Resolvers, reader),
            id => {
                let Some((name, value)) = F::user_defined(reader, id)? else {
                    return Err(reader.unexpected(F::CLAUSE, id, "a part of an agent identifier"));
                };
                return Ok(Some(Part::UserDefined(name, value)));
            }
        }
    }
}

fn address<'a, F: Notation, N: Notes>(reader: &mut Reader<'a, N>) -> Result<Part<'a>, DecodeError> {
    let address = F::text(reader, "address")?;
    if address.is_empty() {
        return Err(reader.error(F::CLAUSE, Problem::Empty("address")));
    }
    reader.note(|| format!("address {}", F::noted(&address)));
    Ok(Part::Address(address))
}

/// A list begins with its code and ends with [`code::END`].
impl List {
    fn begin<N: Notes>(&mut self, list: Self, reader: &mut Reader<'_, N>) {
        *self = list;
        reader.note(|| list.name().to_owned());
        reader.notes().deeper();
    }

    /// Leaves the list if the next byte ends it.
    fn end<N: Notes>(&mut self, reader: &mut Reader<'_, N>) {
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
