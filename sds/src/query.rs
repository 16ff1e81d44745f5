//! Queries of the directory, and the patterns that may name receivers.

use fipa_acl::{Pattern, PatternError, is_pattern};

use crate::entry::{millis_of_time, time_of_millis};
use crate::{Entry, Role};

/// The value that one field of an entry is compared with.
#[derive(Debug, Clone)]
pub enum Matcher {
    /// The text must be equal.
    Exact(String),
    /// The whole text must match the pattern.
    Pattern(Pattern),
}

impl Matcher {
    /// Parses a pattern if the text [is one](is_pattern); otherwise the text must be equal.
    ///
    /// # Errors
    /// Fails when the pattern is not valid.
    pub fn parse(text: &str) -> Result<Self, PatternError> {
        if is_pattern(text) {
            Pattern::new(text).map(Self::Pattern)
        } else {
            Ok(Self::Exact(text.to_owned()))
        }
    }

    /// Whether the text is equal, or matches the pattern as a whole.
    #[must_use]
    pub fn matches(&self, text: &str) -> bool {
        match self {
            Self::Exact(exact) => exact == text,
            Self::Pattern(pattern) => pattern.matches(text),
        }
    }
}

/// A query: an entry matches if every field that is given matches.
#[derive(Debug, Clone, Default)]
pub struct Query {
    /// Matches [`Entry::name`].
    pub name: Option<Matcher>,
    /// Matches [`Entry::agent_type`].
    pub agent_type: Option<Matcher>,
    /// Matches one of [`Entry::locations`], in the form `kind://address`.
    pub location: Option<Matcher>,
    /// Matches [`Entry::description`].
    pub description: Option<Matcher>,
    /// Matches the name of the message transport service in [`Entry::mts`].
    pub mts: Option<Matcher>,
    /// Matches [`Entry::registered`] in RFC 3339 form, UTC with milliseconds:
    /// `2026-03-01T09:30:00.000Z`.
    pub registered: Option<Matcher>,
    /// Matches one of the [`Members`](crate::Members) of a coalition; other entries have no
    /// members.
    pub member: Option<Matcher>,
}

impl Query {
    /// Matches every entry.
    #[must_use]
    pub fn all() -> Self {
        Self::default()
    }

    /// Matches entries by name.
    #[must_use]
    pub fn by_name(name: Matcher) -> Self {
        Self {
            name: Some(name),
            ..Self::default()
        }
    }

    /// Whether the entry matches the query.
    #[must_use]
    pub fn matches(&self, entry: &Entry) -> bool {
        let matches = |matcher: &Option<Matcher>, text: &str| {
            matcher.as_ref().is_none_or(|matcher| matcher.matches(text))
        };
        matches(&self.name, &entry.name)
            && matches(&self.agent_type, &entry.agent_type)
            && matches(&self.description, &entry.description)
            && self.location.as_ref().is_none_or(|matcher| {
                entry.locations.iter().any(|location| {
                    matcher.matches(&format!("{}://{}", location.kind(), location.address()))
                })
            })
            && self.mts.as_ref().is_none_or(|matcher| {
                let name = entry.mts.name.as_deref();
                name.is_some_and(|name| matcher.matches(name))
            })
            && self.registered.as_ref().is_none_or(|matcher| {
                // Clamped to the years that RFC 3339 can represent.
                let time = time_of_millis(millis_of_time(entry.registered));
                matcher.matches(&humantime::format_rfc3339_millis(time).to_string())
            })
            && self
                .member
                .as_ref()
                .is_none_or(|matcher| match &entry.role {
                    Role::Coalition(members) => {
                        members.names().iter().any(|name| matcher.matches(name))
                    }
                    _ => false,
                })
    }
}
