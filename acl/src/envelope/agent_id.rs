//! Agent identifiers in a bit-efficient envelope. They differ from those in messages: plain
//! strings instead of words, and another code for user-defined parameters.

use crate::bitefficient::notes::{self, Notes};
use crate::bitefficient::reader::Reader;
use crate::bitefficient::{Text, without_x};
use crate::envelope::read::any;
use crate::error::{DecodeError, Problem};
use crate::word::is_token;
use crate::{AgentId, AgentIdError};

const CLAUSE: &str = "FIPA00088 AID";

/// An agent identifier that was checked.
#[derive(Debug, Clone, Copy)]
pub(super) struct AgentIdView<'a> {
    pub(super) name: Text<'a>,
    /// What follows the name, with the end of the identifier.
    parameters: &'a [u8],
}

/// Reads an agent identifier, whose resolvers may be nested `depth` deep.
pub(super) fn agent_id<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    let code = reader.byte(CLAUSE, "an agent identifier")?;
    if code != 0x02 {
        return Err(reader.unexpected(CLAUSE, code, "an agent identifier"));
    }
    let offset = reader.offset();
    let name = reader.string(CLAUSE, "agent name")?;
    let wrong = |problem| Err(DecodeError::new(offset, CLAUSE, problem));
    if name.is_empty() {
        return wrong(Problem::Empty("agent name"));
    }
    // Escapes may take up to half of it; the name itself is measured when it becomes an AgentId.
    if name.raw().len() > 2 * AgentId::MAX_NAME {
        return wrong(Problem::TooLong("agent name"));
    }
    reader.note(|| format!("agent identifier: name {}", notes::text(&name)));
    reader.notes().deeper();
    let start = reader.position();
    while parameter(reader, depth)?.is_some() {}
    reader.notes().shallower();
    reader.note(|| "end of agent identifier".to_owned());
    let parameters = reader.since(start);
    Ok(AgentIdView { name, parameters })
}

/// Reads the agent identifiers of a set up to its end, and gives the bytes in front of that.
pub(super) fn agent_ids<'a, N: Notes>(
    reader: &mut Reader<'a, N>,
    depth: usize,
    set: &'static str,
) -> Result<&'a [u8], DecodeError> {
    reader.set(set, |reader| agent_id(reader, depth))
}

/// The identifiers in checked bytes, one after the other.
#[derive(Debug, Clone)]
pub(super) struct AgentIdViews<'a>(Reader<'a>);

impl<'a> AgentIdViews<'a> {
    pub(super) fn new(ids: &'a [u8]) -> Self {
        Self(Reader::new(ids))
    }
}

impl<'a> Iterator for AgentIdViews<'a> {
    type Item = AgentIdView<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        (self.0.remaining() > 0).then_some(())?;
        // An error cannot occur in checked bytes, and would end the list.
        agent_id(&mut self.0, AgentId::MAX_DEPTH).ok()
    }
}

impl AgentIdView<'_> {
    pub(super) fn to_owned(self) -> Result<AgentId, DecodeError> {
        // What an identifier can be refused for was checked when it was read; should it be
        // refused all the same, the error is told.
        let refused =
            |_: AgentIdError| DecodeError::new(0, CLAUSE, Problem::NotAWord("agent identifier"));
        let mut agent = AgentId::new(self.name.as_str()).map_err(refused)?;
        let mut reader = Reader::new(self.parameters);
        while let Some(part) = parameter(&mut reader, AgentId::MAX_DEPTH)? {
            match part {
                Parameter::Addresses(bytes) => {
                    let mut addresses = Reader::new(bytes);
                    while addresses.remaining() > 0 {
                        let address = addresses.string(CLAUSE, "address")?.as_str();
                        agent = agent.with_address(address).map_err(refused)?;
                    }
                }
                Parameter::Resolvers(bytes) => {
                    for resolver in AgentIdViews::new(bytes) {
                        agent = agent.with_resolver(resolver.to_owned()?).map_err(refused)?;
                    }
                }
                Parameter::UserDefined(name, value) => {
                    agent = agent
                        .with_user_defined(without_x(&name.as_str()), value.as_str())
                        .map_err(refused)?;
                }
            }
        }
        Ok(agent)
    }
}

enum Parameter<'a> {
    Addresses(&'a [u8]),
    Resolvers(&'a [u8]),
    UserDefined(Text<'a>, Text<'a>),
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
        // 05 since edition C; JADE writes 04 with a string behind it.
        0x04 | 0x05 => {
            let name = user_defined_name(reader, CLAUSE)?;
            let value = if code == 0x04 {
                reader.string(CLAUSE, "user-defined value")?
            } else {
                any(reader, "user-defined value")?
            };
            reader.note(|| notes::user_defined(&name, &value));
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
        let address = reader.string(CLAUSE, "address")?;
        if address.is_empty() {
            return Err(reader.error(CLAUSE, Problem::Empty("address")));
        }
        reader.note(|| format!("address {}", notes::text(&address)));
    }
}

/// Reads the name of a user-defined parameter; an `X-` is still there.
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
