//! Agent identifiers, borrowed from the bytes they were read from.

use crate::error::{DecodeError, Problem};
use crate::{AgentId, AgentIdError, Text, bitefficient, envelope, string, xml};

/// An agent identifier in an encoded message or envelope.
#[derive(Debug, Clone, Copy)]
pub struct AgentIdView<'a> {
    name: Text<'a>,
    parts: Parts<'a>,
}

impl<'a> AgentIdView<'a> {
    /// Creates the view of a checked identifier. `parts` are the encoded parts behind its name.
    #[inline]
    pub(crate) fn new(name: Text<'a>, encoding: Encoding, parts: &'a [u8]) -> Self {
        let parts = Parts {
            encoding,
            rest: parts,
            list: List::Outside,
        };
        Self { name, parts }
    }

    /// Returns the encoding and the encoded parts behind the name.
    pub(super) fn encoded_parts(&self) -> (Encoding, &'a [u8]) {
        (self.parts.encoding, self.parts.rest)
    }

    /// Name of the agent.
    #[must_use]
    pub fn name(&self) -> Text<'a> {
        self.name
    }

    /// Transport addresses, the preferred one first.
    pub fn addresses(&self) -> impl Iterator<Item = Text<'a>> + use<'a> {
        self.parts.filter_map(|part| match part {
            Part::Address(address) => Some(address),
            _ => None,
        })
    }

    /// Agents that can resolve the name, the preferred one first.
    pub fn resolvers(&self) -> impl Iterator<Item = AgentIdView<'a>> + use<'a> {
        self.parts.filter_map(|part| match part {
            Part::Resolver(agent) => Some(agent),
            _ => None,
        })
    }

    /// Names, without their `X-`, and values of user-defined parameters.
    pub fn user_defined(&self) -> impl Iterator<Item = (Text<'a>, Text<'a>)> + use<'a> {
        self.parts.filter_map(|part| match part {
            Part::UserDefined(name, value) => Some((name, value)),
            _ => None,
        })
    }

    /// Converts the identifier to an owned value.
    pub(crate) fn to_agent_id(self) -> Result<AgentId, DecodeError> {
        // The reader has checked the identifier, so this does not fail.
        self.owned()
            .map_err(|error| DecodeError::new(0, "FIPA00023 3.1", problem(&error)))
    }

    fn owned(self) -> Result<AgentId, AgentIdError> {
        let mut agent = AgentId::new(self.name.as_str())?.received();
        for part in self.parts {
            agent = match part {
                Part::Address(address) => agent.with_address(address.as_str())?,
                Part::Resolver(resolver) => agent.with_resolver(resolver.owned()?)?,
                Part::UserDefined(name, value) => {
                    agent.with_user_defined(name.as_str(), value.as_str())?
                }
            };
        }
        Ok(agent)
    }
}

/// The agent identifiers of a set or sequence in an encoded message or envelope.
#[derive(Debug, Clone, Default)]
pub struct AgentIds<'a>(pub(super) Set<'a>);

#[derive(Debug, Clone, Default)]
pub(super) enum Set<'a> {
    #[default]
    Empty,
    BitEfficient(&'a [u8]),
    Envelope(&'a [u8]),
    String(&'a [u8]),
    Xml(xml::AgentSet<'a>),
}

impl<'a> AgentIds<'a> {
    /// Creates a set of the consecutive identifiers in checked bytes.
    #[inline]
    pub(crate) fn new(encoding: Encoding, bytes: &'a [u8]) -> Self {
        Self(match encoding {
            _ if bytes.is_empty() => Set::Empty,
            Encoding::BitEfficient => Set::BitEfficient(bytes),
            Encoding::Envelope => Set::Envelope(bytes),
            Encoding::String => Set::String(bytes),
            Encoding::Xml => Set::Empty,
        })
    }

    /// Creates a set of the identifiers in checked elements.
    pub(crate) fn xml(set: xml::AgentSet<'a>) -> Self {
        Self(Set::Xml(set))
    }

    /// Whether the identifiers are in XML elements.
    pub(crate) fn is_xml(&self) -> bool {
        matches!(self.0, Set::Xml(_))
    }

    /// Whether the set is empty.
    pub(crate) fn is_empty(&self) -> bool {
        match &self.0 {
            Set::Empty => true,
            Set::BitEfficient(rest) | Set::Envelope(rest) | Set::String(rest) => rest.is_empty(),
            Set::Xml(set) => set.is_empty(),
        }
    }

    /// Adds identifiers that follow in the same bytes, if both sets are XML elements. Returns whether
    /// they were added.
    pub(crate) fn add(&mut self, others: &Self) -> bool {
        match (&mut self.0, &others.0) {
            (Set::Xml(set), Set::Xml(others)) => {
                set.add(others);
                true
            }
            _ => false,
        }
    }

    pub(crate) fn to_agent_ids(&self) -> Result<Vec<AgentId>, DecodeError> {
        self.clone().map(AgentIdView::to_agent_id).collect()
    }
}

impl<'a> Iterator for AgentIds<'a> {
    type Item = AgentIdView<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        // An error cannot occur in checked bytes. It would end the iteration.
        match &mut self.0 {
            Set::Empty => None,
            Set::BitEfficient(rest) => {
                bitefficient::next_agent_id::<bitefficient::InMessages>(rest)
            }
            Set::Envelope(rest) => bitefficient::next_agent_id::<envelope::InEnvelopes>(rest),
            Set::String(rest) => string::agent_id::next(rest),
            Set::Xml(set) => set.next(),
        }
    }
}

/// The encoding of an identifier.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Encoding {
    /// FIPA00069.
    BitEfficient,
    /// FIPA00088.
    Envelope,
    /// FIPA00070.
    String,
    /// FIPA00071 and FIPA00085.
    Xml,
}

/// The encoded parts of a checked identifier behind its name.
#[derive(Debug, Clone, Copy)]
struct Parts<'a> {
    encoding: Encoding,
    rest: &'a [u8],
    list: List,
}

/// A part of an identifier.
pub(crate) enum Part<'a> {
    Address(Text<'a>),
    Resolver(AgentIdView<'a>),
    UserDefined(Text<'a>, Text<'a>),
}

/// The list that contains the current position, while an identifier is read part by part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum List {
    Outside,
    Addresses,
    Resolvers,
}

impl<'a> Iterator for Parts<'a> {
    type Item = Part<'a>;

    fn next(&mut self) -> Option<Part<'a>> {
        let next = match self.encoding {
            Encoding::BitEfficient => bitefficient::next_agent_id_part::<bitefficient::InMessages>,
            Encoding::Envelope => bitefficient::next_agent_id_part::<envelope::InEnvelopes>,
            Encoding::String => string::agent_id::next_part,
            Encoding::Xml => xml::next_part,
        };
        next(&mut self.rest, &mut self.list)
    }
}

/// Checks a name as [`AgentId::new`] does.
pub(crate) fn check_name(name: &Text<'_>, what: &'static str) -> Result<(), Problem> {
    // Unescaping never makes a text longer, so most names need no unescaping here.
    let raw = name.raw();
    if raw.len() > AgentId::MAX_NAME && name.as_str().len() > AgentId::MAX_NAME {
        return Err(Problem::TooLong(what));
    }
    if name.is_empty() {
        return Err(Problem::Empty(what));
    }
    Ok(())
}

fn problem(error: &AgentIdError) -> Problem {
    match error {
        AgentIdError::EmptyName => Problem::Empty("agent name"),
        AgentIdError::NameTooLong(_) => Problem::TooLong("agent name"),
        AgentIdError::Nul(part) => Problem::Nul(part),
        AgentIdError::EmptyAddress => Problem::Empty("address"),
        AgentIdError::TooDeep => Problem::TooDeep("resolvers"),
        AgentIdError::UserDefinedName(_) => Problem::NotAWord("name of a user-defined parameter"),
    }
}
