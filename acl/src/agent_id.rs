//! The agent identifier (FIPA00023 clause 3.1).

use std::convert::Infallible;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::str::FromStr;

use crate::escape;
use crate::word::{is_token, push_string_literal};

/// An agent identifier: a globally unique name, and optional addresses, resolvers and user-defined
/// parameters.
///
/// Two identifiers are equal (`==`) if all their parts are equal. They identify the same agent if
/// their names are equal ([`same_agent`](Self::same_agent)).
///
/// An identifier that was decoded is [received](Self::is_received). Its addresses are a claim of its sender.
#[derive(Clone)]
pub struct AgentId {
    name: String,
    addresses: Vec<String>,
    resolvers: Vec<Self>,
    user_defined: Vec<(String, String)>,
    is_received: bool,
}

impl AgentId {
    /// Maximum length of a name, in bytes.
    pub const MAX_NAME: usize = 4096;
    /// Maximum nesting depth of resolvers. An identifier without resolvers has depth 0.
    pub const MAX_DEPTH: usize = 16;

    /// Creates an identifier with a name only.
    ///
    /// # Errors
    /// The name is empty, longer than [`MAX_NAME`](Self::MAX_NAME), or has a NUL character.
    pub fn new(name: impl Into<String>) -> Result<Self, AgentIdError> {
        let name = name.into();
        if name.is_empty() {
            return Err(AgentIdError::EmptyName);
        }
        if name.len() > Self::MAX_NAME {
            return Err(AgentIdError::NameTooLong(name.len()));
        }
        no_nul("name", &name)?;
        Ok(Self {
            name,
            addresses: Vec::new(),
            resolvers: Vec::new(),
            user_defined: Vec::new(),
            is_received: false,
        })
    }

    /// Appends a transport address. Earlier addresses are preferred. The address of a
    /// [received](Self::is_received) identifier counts as received, too: create a new identifier to give
    /// an address of your own.
    ///
    /// # Errors
    /// The address is empty or has a NUL character.
    pub fn with_address(mut self, address: impl Into<String>) -> Result<Self, AgentIdError> {
        let address = address.into();
        if address.is_empty() {
            return Err(AgentIdError::EmptyAddress);
        }
        no_nul("address", &address)?;
        self.addresses.push(address);
        Ok(self)
    }

    /// Appends an agent that can resolve the name. Earlier resolvers are preferred.
    ///
    /// # Errors
    /// Resolvers would be nested deeper than [`MAX_DEPTH`](Self::MAX_DEPTH).
    pub fn with_resolver(mut self, resolver: Self) -> Result<Self, AgentIdError> {
        if resolver.depth() >= Self::MAX_DEPTH {
            return Err(AgentIdError::TooDeep);
        }
        self.resolvers.push(resolver);
        Ok(self)
    }

    /// Appends a user-defined parameter. The name has no `X-`.
    ///
    /// # Errors
    /// The name is empty or has blanks, parentheses or control characters, or the value has a NUL
    /// character.
    pub fn with_user_defined(
        mut self,
        name: impl Into<String>,
        value: impl Into<String>,
    ) -> Result<Self, AgentIdError> {
        let (name, value) = (name.into(), value.into());
        if !is_token(&name) {
            return Err(AgentIdError::UserDefinedName(
                name.chars().take(60).collect(),
            ));
        }
        no_nul("user-defined value", &value)?;
        self.user_defined.push((name, value));
        Ok(self)
    }

    /// Marks the identifier as decoded from bytes or text; see [`is_received`](Self::is_received). All
    /// decoders of this crate do so.
    #[must_use]
    pub fn received(mut self) -> Self {
        self.is_received = true;
        self
    }

    /// Whether the identifier was decoded, so that its addresses are not those of this program. A clone
    /// has the same mark. The mark is not encoded, and does not take part in comparisons.
    #[must_use]
    pub fn is_received(&self) -> bool {
        self.is_received
    }

    /// Name of the agent.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Transport addresses (URLs), the preferred one first.
    #[must_use]
    pub fn addresses(&self) -> &[String] {
        &self.addresses
    }

    /// Agents that can resolve the name, the preferred one first.
    #[must_use]
    pub fn resolvers(&self) -> &[Self] {
        &self.resolvers
    }

    /// Names, without their `X-`, and values of user-defined parameters.
    #[must_use]
    pub fn user_defined(&self) -> &[(String, String)] {
        &self.user_defined
    }

    /// Whether both identifiers have the same name, and so identify the same agent.
    #[must_use]
    pub fn same_agent(&self, other: &Self) -> bool {
        self.name == other.name
    }

    /// Whether the identifier has only a name.
    pub(crate) fn is_plain(&self) -> bool {
        self.addresses.is_empty() && self.resolvers.is_empty() && self.user_defined.is_empty()
    }

    fn depth(&self) -> usize {
        let below = self.resolvers.iter().map(|resolver| resolver.depth() + 1);
        below.max().unwrap_or(0)
    }

    pub(crate) fn write_fipa00070(&self, out: &mut String) {
        out.push_str("(agent-identifier :name ");
        if is_token(&self.name) {
            out.push_str(&self.name);
        } else {
            push_string_literal(out, &self.name);
        }
        if !self.addresses.is_empty() {
            out.push_str(" :addresses (sequence");
            for address in &self.addresses {
                out.push(' ');
                out.push_str(address);
            }
            out.push(')');
        }
        if !self.resolvers.is_empty() {
            out.push_str(" :resolvers (sequence");
            for resolver in &self.resolvers {
                out.push(' ');
                resolver.write_fipa00070(out);
            }
            out.push(')');
        }
        for (name, value) in &self.user_defined {
            out.push_str(" :X-");
            out.push_str(name);
            out.push(' ');
            push_string_literal(out, value);
        }
        out.push(')');
    }
}

/// Compares all parts, but not the mark of [`AgentId::is_received`].
impl PartialEq for AgentId {
    fn eq(&self, other: &Self) -> bool {
        self.name == other.name
            && self.addresses == other.addresses
            && self.resolvers == other.resolvers
            && self.user_defined == other.user_defined
    }
}

impl Eq for AgentId {}

impl Hash for AgentId {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.name.hash(state);
        self.addresses.hash(state);
        self.resolvers.hash(state);
        self.user_defined.hash(state);
    }
}

fn no_nul(part: &'static str, text: &str) -> Result<(), AgentIdError> {
    if text.contains('\0') {
        return Err(AgentIdError::Nul(part));
    }
    Ok(())
}

impl FromStr for AgentId {
    type Err = AgentIdError;

    /// Creates an identifier with a name only: see [`AgentId::new`].
    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::new(name)
    }
}

impl TryFrom<&str> for AgentId {
    type Error = AgentIdError;

    fn try_from(name: &str) -> Result<Self, Self::Error> {
        Self::new(name)
    }
}

impl TryFrom<String> for AgentId {
    type Error = AgentIdError;

    fn try_from(name: String) -> Result<Self, Self::Error> {
        Self::new(name)
    }
}

impl TryFrom<&String> for AgentId {
    type Error = AgentIdError;

    fn try_from(name: &String) -> Result<Self, Self::Error> {
        Self::new(name.as_str())
    }
}

impl From<&Self> for AgentId {
    fn from(agent: &Self) -> Self {
        agent.clone()
    }
}

/// Writes the name. The alternate form (`{:#}`) writes the whole identifier in the form of FIPA00070.
impl fmt::Display for AgentId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !f.alternate() {
            return f.pad(&self.name);
        }
        let mut text = String::new();
        self.write_fipa00070(&mut text);
        f.write_str(&text)
    }
}

/// Writes the whole identifier, [escaped](escape).
impl fmt::Debug for AgentId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&escape(&format!("{self:#}")))
    }
}

/// Error of making an agent identifier.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AgentIdError {
    /// The name is empty.
    #[error("the name of an agent must not be empty")]
    EmptyName,
    /// The name is longer than [`AgentId::MAX_NAME`]. The value is its length in bytes.
    #[error("agent name of {0} bytes is too long (maximum {max})", max = AgentId::MAX_NAME)]
    NameTooLong(usize),
    /// A part has a NUL character, which no encoding can represent. The value names the part.
    #[error("the {0} of an agent identifier has a NUL character")]
    Nul(&'static str),
    /// A transport address is empty.
    #[error("an address of an agent must not be empty")]
    EmptyAddress,
    /// Resolvers are nested deeper than [`AgentId::MAX_DEPTH`].
    #[error("the resolvers of an agent are nested deeper than {max}", max = AgentId::MAX_DEPTH)]
    TooDeep,
    /// The name of a user-defined parameter is not one word.
    #[error(
        "not a name of a user-defined parameter: {0:?}; give one word without blanks, parentheses \
         or control characters"
    )]
    UserDefinedName(String),
}

/// A conversion that cannot fail has no error.
impl From<Infallible> for AgentIdError {
    fn from(never: Infallible) -> Self {
        match never {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn invalid_names_and_parts_are_refused() {
        assert_eq!(AgentId::new(""), Err(AgentIdError::EmptyName));
        assert_eq!(AgentId::new("a\0"), Err(AgentIdError::Nul("name")));
        let long = "x".repeat(AgentId::MAX_NAME + 1);
        assert_eq!(AgentId::new(long), Err(AgentIdError::NameTooLong(4097)));
        let bob = AgentId::new("bob").unwrap();
        assert!(bob.clone().with_address("").is_err());
        assert!(bob.clone().with_user_defined("a b", "c").is_err());
        assert!(bob.with_user_defined("a", "\0").is_err());
    }

    #[test]
    fn resolvers_nested_too_deep_are_refused() {
        let mut agent = AgentId::new("a0").unwrap();
        for depth in 1..=AgentId::MAX_DEPTH {
            let outer = AgentId::new(format!("a{depth}")).unwrap();
            agent = outer.with_resolver(agent).unwrap();
        }
        let outer = AgentId::new("outer").unwrap();
        assert_eq!(outer.with_resolver(agent), Err(AgentIdError::TooDeep));
    }

    #[test]
    fn the_mark_of_a_received_identifier_is_cloned_and_not_compared() {
        use std::collections::HashSet;

        let own = AgentId::new("bob").unwrap();
        let received = own.clone().received();
        assert!(!own.is_received() && received.is_received());
        let further = received.clone().with_address("http://h/acc").unwrap();
        assert!(further.is_received());
        assert_eq!(own, received);
        assert!(HashSet::from([own]).contains(&received));
    }

    #[test]
    fn equal_names_identify_the_same_agent() {
        let plain = AgentId::new("bob@home").unwrap();
        let known = plain.clone().with_address("tcp://h:1").unwrap();
        assert_ne!(plain, known);
        assert!(plain.same_agent(&known));
        assert_eq!(known.to_string(), "bob@home");
        assert_eq!(
            format!("{known:#}"),
            "(agent-identifier :name bob@home :addresses (sequence tcp://h:1))"
        );
    }
}
