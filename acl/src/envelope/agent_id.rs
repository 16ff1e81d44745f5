//! Agent identifiers in a bit-efficient envelope. They differ from those in messages: plain
//! strings instead of words, and another code for user-defined parameters.

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
pub(super) fn agent_id<'a>(
    reader: &mut Reader<'a>,
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
    let start = reader.position();
    while parameter(reader, depth)?.is_some() {}
    let parameters = reader.since(start);
    Ok(AgentIdView { name, parameters })
}

/// Reads agent identifiers up to the end of their set, and gives the bytes in front of that.
pub(super) fn agent_ids<'a>(
    reader: &mut Reader<'a>,
    depth: usize,
) -> Result<&'a [u8], DecodeError> {
    let start = reader.position();
    loop {
        let ids = reader.since(start);
        if reader.take_if(0x01) {
            return Ok(ids);
        }
        agent_id(reader, depth)?;
    }
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
fn parameter<'a>(
    reader: &mut Reader<'a>,
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
            Parameter::Resolvers(agent_ids(reader, depth)?)
        }
        // 05 since edition C; JADE writes 04 with a string behind it.
        0x04 | 0x05 => {
            let name = user_defined_name(reader, CLAUSE)?;
            let value = if code == 0x04 {
                reader.string(CLAUSE, "user-defined value")?
            } else {
                any(reader, "user-defined value")?
            };
            Parameter::UserDefined(name, value)
        }
        other => return Err(reader.unexpected(CLAUSE, other, "a part of an agent identifier")),
    }))
}

fn addresses<'a>(reader: &mut Reader<'a>) -> Result<&'a [u8], DecodeError> {
    let start = reader.position();
    loop {
        let addresses = reader.since(start);
        if reader.take_if(0x01) {
            return Ok(addresses);
        }
        if reader.string(CLAUSE, "address")?.is_empty() {
            return Err(reader.error(CLAUSE, Problem::Empty("address")));
        }
    }
}

/// Reads the name of a user-defined parameter; an `X-` is still there.
pub(super) fn user_defined_name<'a>(
    reader: &mut Reader<'a>,
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
