//! Names of agents, resources and conversations.

use std::fmt;
use std::sync::Arc;

/// Milliseconds: a time of the clock of one process, or a span.
pub type Millis = u64;

/// Maximum length of the name of a resource or of an agent, in bytes.
pub const MAX_NAME: usize = 255;

/// Error of a name of a resource or of an agent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NameError {
    /// The name is empty.
    #[error("a name is empty")]
    Empty,
    /// The name is too long.
    #[error("a name has {0} bytes (maximum {MAX_NAME})")]
    TooLong(usize),
    /// The name contains a control character. A newline separates the parts of a message's content.
    #[error("a name contains a control character at byte {0}")]
    Control(usize),
}

fn checked(name: &str) -> Result<Arc<str>, NameError> {
    if name.is_empty() {
        return Err(NameError::Empty);
    }
    if name.len() > MAX_NAME {
        return Err(NameError::TooLong(name.len()));
    }
    match name.char_indices().find(|(_, letter)| letter.is_control()) {
        Some((at, _)) => Err(NameError::Control(at)),
        None => Ok(name.into()),
    }
}

/// Name of a resource: 1 to [`MAX_NAME`] bytes without control characters.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Resource(Arc<str>);

impl Resource {
    /// Checks a name.
    ///
    /// # Errors
    /// The name is empty, too long, or contains a control character.
    pub fn new(name: &str) -> Result<Self, NameError> {
        Ok(Self(checked(name)?))
    }

    /// The name.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Resource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for Resource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// An agent in one registration. An agent that restarts has another registration.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LockPeer {
    name: Arc<str>,
    registration: u64,
}

impl LockPeer {
    /// Checks the name of an agent. `registration` differs for each registration of the name.
    ///
    /// # Errors
    /// The name is empty, too long, or contains a control character.
    pub fn new(name: &str, registration: u64) -> Result<Self, NameError> {
        Ok(Self {
            name: checked(name)?,
            registration,
        })
    }

    /// Name of the agent.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Number of the registration.
    #[must_use]
    pub fn registration(&self) -> u64 {
        self.registration
    }

    pub(crate) fn shared_name(&self) -> &Arc<str> {
        &self.name
    }
}

impl fmt::Display for LockPeer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name)
    }
}

impl fmt::Debug for LockPeer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}#{}", self.name, self.registration)
    }
}

/// Identifier of a conversation. Its text is `<prefix>_<number>`, as in `distributed_locking`, or any
/// other text of a foreign agent, which is the prefix.
#[derive(Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Conversation {
    prefix: Arc<str>,
    number: Option<u64>,
}

impl Conversation {
    /// Returns the conversation with this prefix and number.
    #[must_use]
    pub fn new(prefix: Arc<str>, number: u64) -> Self {
        Self {
            prefix,
            number: Some(number),
        }
    }

    /// Parses a text. Each text is an identifier.
    #[must_use]
    pub fn parse(text: &str) -> Self {
        if let Some((prefix, digits)) = text.rsplit_once('_')
            && let Ok(number) = digits.parse::<u64>()
            && number.to_string() == digits
        {
            return Self::new(prefix.into(), number);
        }
        Self {
            prefix: text.into(),
            number: None,
        }
    }

    /// Whether the identifier has the form that `peer` gives the conversations that it begins.
    #[must_use]
    pub fn is_of(&self, peer: &LockPeer) -> bool {
        *self.prefix == *peer.name && self.number.is_some()
    }

    /// Whether this conversation began at the same time as `other` or before it, by the numbers of
    /// the agent that began both. Conversations with different prefixes have no order.
    #[must_use]
    pub fn is_not_after(&self, other: &Self) -> bool {
        self.prefix == other.prefix && self.number <= other.number
    }
}

impl fmt::Display for Conversation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.number {
            Some(number) => write!(f, "{}_{number}", self.prefix),
            None => f.write_str(&self.prefix),
        }
    }
}

impl fmt::Debug for Conversation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_bounds() {
        assert_eq!(Resource::new(""), Err(NameError::Empty));
        assert_eq!(
            Resource::new(&"x".repeat(10_000)),
            Err(NameError::TooLong(10_000))
        );
        assert_eq!(Resource::new("a\nb"), Err(NameError::Control(1)));
        assert!(Resource::new("docking interface 3").is_ok());
        assert_eq!(LockPeer::new("", 1), Err(NameError::Empty));
    }

    #[test]
    fn conversations_keep_their_text() {
        for text in [
            "agent2_0",
            "a_b_17",
            "a_017",
            "a_",
            "_",
            "",
            "x",
            "a_99999999999999999999",
        ] {
            assert_eq!(Conversation::parse(text).to_string(), text);
        }
        let first = Conversation::parse("agent2_9");
        let second = Conversation::parse("agent2_10");
        assert!(first.is_not_after(&second) && !second.is_not_after(&first));
        assert!(!first.is_not_after(&Conversation::parse("agent3_10")));
    }
}
