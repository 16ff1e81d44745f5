//! Agent identifiers in a string message.

use super::lex::{Follows, Keyword, Keywords, Lexer};
use super::read::user_defined;
use crate::error::{DecodeError, Problem};
use crate::view::{AgentIdView, AgentIds, Encoding, List, Part, check_name};
use crate::{AgentId, Text};

const AGENT_ID: &str = "FIPA00070 AgentIdentifier";
const WHAT: &str = "a parameter of an agent identifier";

#[derive(Clone, Copy)]
pub(super) enum Slot {
    Name,
    Addresses,
    Resolvers,
}

impl Slot {
    /// Returns the slot with this lowercase name.
    fn of(name: &[u8]) -> Option<Self> {
        match name {
            b"name" => Some(Self::Name),
            b"addresses" => Some(Self::Addresses),
            b"resolvers" => Some(Self::Resolvers),
            _ => None,
        }
    }
}

pub(super) const SLOTS: &Keywords<Slot> = &[
    ("name", Follows::Never, Slot::Name),
    ("addresses", Follows::Parenthesis, Slot::Addresses),
    ("resolvers", Follows::Parenthesis, Slot::Resolvers),
];

/// Reads the next of the consecutive identifiers in checked bytes.
pub(crate) fn next<'a>(rest: &mut &'a [u8]) -> Option<AgentIdView<'a>> {
    let mut lexer = Lexer::new(rest);
    lexer.skip_space();
    (!lexer.rest().is_empty()).then_some(())?;
    let agent = agent(&mut lexer, AgentId::MAX_DEPTH).ok();
    *rest = agent.map_or(&[], |_| lexer.rest());
    agent
}

/// Reads the next part of a checked identifier.
pub(crate) fn next_part<'a>(rest: &mut &'a [u8], list: &mut List) -> Option<Part<'a>> {
    let mut lexer = Lexer::new(rest);
    let part = part(&mut lexer, list, AgentId::MAX_DEPTH, &mut None);
    *rest = lexer.rest();
    part.ok().flatten()
}

pub(super) fn agent_set<'a>(lexer: &mut Lexer<'a>) -> Result<AgentIds<'a>, DecodeError> {
    let clause = "FIPA00070 AgentIdentifierSet";
    lexer.open(clause)?;
    lexer.name("set", clause, "set")?;
    let start = lexer.offset();
    loop {
        let members = lexer.since(start);
        if lexer.accept(b')') {
            return Ok(AgentIds::new(Encoding::String, members));
        }
        agent(lexer, AgentId::MAX_DEPTH)?;
    }
}

/// Reads an agent identifier with resolvers nested at most `depth` deep.
pub(super) fn agent<'a>(
    lexer: &mut Lexer<'a>,
    depth: usize,
) -> Result<AgentIdView<'a>, DecodeError> {
    lexer.open(AGENT_ID)?;
    let start = lexer.offset();
    let wrong = |problem| DecodeError::new(start, AGENT_ID, problem);
    lexer.name("agent-identifier", AGENT_ID, "agent-identifier")?;
    let (mut name, mut list) = (None, List::Outside);
    let parts = lexer.offset();
    while part(lexer, &mut list, depth, &mut name)?.is_some() {}
    let name = name.ok_or_else(|| wrong(Problem::Missing("name of an agent")))?;
    check_name(&name, "name of an agent").map_err(wrong)?;
    let parts = lexer.since(parts);
    Ok(AgentIdView::new(name, Encoding::String, parts))
}

/// Reads the next part of an identifier. Returns `None` at its end. If the name is read on the way,
/// it is stored in `name`.
fn part<'a>(
    lexer: &mut Lexer<'a>,
    list: &mut List,
    depth: usize,
    name: &mut Option<Text<'a>>,
) -> Result<Option<Part<'a>>, DecodeError> {
    loop {
        if lexer.accept(b')') {
            if *list == List::Outside {
                return Ok(None);
            }
            *list = List::Outside;
            continue;
        }
        match list {
            List::Addresses => return address(lexer).map(Some),
            List::Resolvers => {
                let Some(depth) = depth.checked_sub(1) else {
                    return Err(lexer.error(AGENT_ID, Problem::TooDeep("resolvers")));
                };
                return Ok(Some(Part::Resolver(agent(lexer, depth)?)));
            }
            List::Outside => {}
        }
        *list = match lexer.keyword(SLOTS, Slot::of, AGENT_ID, WHAT)? {
            Keyword::UserDefined => {
                let (name, value) = user_defined(lexer)?;
                return Ok(Some(Part::UserDefined(name, value)));
            }
            Keyword::Known(Slot::Name) => {
                let terminators = (!lexer.skip_space()).then_some(SLOTS);
                *name = Some(lexer.text(terminators, "name of an agent")?);
                continue;
            }
            Keyword::Known(Slot::Addresses) => List::Addresses,
            Keyword::Known(Slot::Resolvers) => List::Resolvers,
        };
        lexer.open(AGENT_ID)?;
        lexer.name("sequence", AGENT_ID, "sequence")?;
    }
}

fn address<'a>(lexer: &mut Lexer<'a>) -> Result<Part<'a>, DecodeError> {
    let offset = lexer.offset();
    let address = lexer.text::<()>(None, "address of an agent")?;
    if address.is_empty() {
        let problem = Problem::Empty("address of an agent");
        return Err(DecodeError::new(offset, AGENT_ID, problem));
    }
    Ok(Part::Address(address))
}
