//! Queries of the directory, and the patterns that may name receivers.

use std::fmt;

use regex::{Regex, RegexBuilder};

use crate::entry::{millis_of_time, time_of_millis};
use crate::{Entry, MAX_NAME, Role};

/// Whether a name is a pattern: it contains one of `* + ? [ ( { | ^ $ \`.
///
/// A dot alone does not make a pattern, because many names contain dots.
#[must_use]
pub fn is_pattern(name: &str) -> bool {
    name.contains(['*', '+', '?', '[', '(', '{', '|', '^', '$', '\\'])
}

/// A regular expression that must match the whole text.
///
/// The syntax is that of the crate `regex`, which matches in linear time. The size of the compiled
/// expression is bounded, so that a pattern from an untrusted peer costs little.
#[derive(Debug, Clone)]
pub struct Pattern(Regex);

impl Pattern {
    /// Maximum length of a pattern, in bytes.
    pub const MAX_LEN: usize = MAX_NAME;

    /// Maximum size of the compiled expression, in bytes.
    const MAX_COMPILED: usize = 128 * 1024;

    /// Maximum nesting depth of groups.
    const MAX_DEPTH: u32 = 32;

    /// Compiles a pattern.
    ///
    /// # Errors
    /// Returns the cause when the pattern is too long, too big or not a regular expression.
    pub fn new(pattern: &str) -> Result<Self, PatternError> {
        if pattern.len() > Self::MAX_LEN {
            return Err(PatternError::TooLong(pattern.len()));
        }
        // Compiled alone first: a pattern such as `a)|(?:b` compiles only inside the group below,
        // and would escape it.
        compile(pattern)?;
        // A verbose pattern may end in a comment, which would comment out the end of the group.
        compile(&format!(r"\A(?:{pattern})\z"))
            .or_else(|_| compile(&format!("\\A(?:{pattern}\n)\\z")))
            .map(Self)
    }

    /// Whether the whole text matches.
    #[must_use]
    pub fn matches(&self, text: &str) -> bool {
        self.0.is_match(text)
    }
}

/// Formats the pattern as it was written.
impl fmt::Display for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let whole = self.0.as_str();
        let inner = whole.strip_prefix(r"\A(?:").unwrap_or(whole);
        let inner = inner.strip_suffix(r")\z").unwrap_or(inner);
        f.write_str(inner.trim_end_matches('\n'))
    }
}

fn compile(pattern: &str) -> Result<Regex, PatternError> {
    RegexBuilder::new(pattern)
        .size_limit(Pattern::MAX_COMPILED)
        .dfa_size_limit(Pattern::MAX_COMPILED)
        .nest_limit(Pattern::MAX_DEPTH)
        .build()
        .map_err(|error| match error {
            regex::Error::CompiledTooBig(_) => PatternError::TooBig,
            other => PatternError::Syntax(other.to_string()),
        })
}

/// Error of [`Pattern::new`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PatternError {
    /// The pattern is longer than [`Pattern::MAX_LEN`].
    #[error("the pattern has {0} bytes; at most {max} are allowed", max = Pattern::MAX_LEN)]
    TooLong(usize),
    /// The compiled pattern would take too much memory.
    #[error("the pattern takes too much memory; use smaller repetitions")]
    TooBig,
    /// The pattern is not a regular expression.
    #[error("the pattern is not a regular expression: {0}")]
    Syntax(String),
}

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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dot_alone_is_not_a_pattern() {
        assert!(!is_pattern("arm.left@robot-1:1099/JADE"));
        for character in ["*", "+", "?", "[", "(", "{", "|", "^", "$", "\\"] {
            assert!(is_pattern(&format!("arm{character}")), "{character}");
        }
    }

    #[test]
    fn patterns_match_whole_names() {
        let pattern = Pattern::new("arm_.*|a|ab").unwrap();
        for (name, expected) in [
            ("arm_left", true),
            ("arm_", true),
            ("ab", true),
            ("abc", false),
            ("my_arm_left", false),
        ] {
            assert_eq!(pattern.matches(name), expected, "{name}");
        }
    }

    #[test]
    fn a_pattern_cannot_escape_its_anchors() {
        let verbose = Pattern::new("(?x) a b # comment").unwrap();
        assert!(verbose.matches("ab"));
        assert!(!verbose.matches("abc"));
        assert!(!Pattern::new("(?m)^a$").unwrap().matches("a\nb"));
        assert!(matches!(
            Pattern::new("a)|(?:b"),
            Err(PatternError::Syntax(_))
        ));
    }

    #[test]
    fn an_invalid_pattern_reports_its_cause() {
        let error = Pattern::new("arm_(").unwrap_err().to_string();
        assert!(error.contains("unclosed group"), "{error}");
        let huge = Pattern::new(r"(\w{500}){500}").unwrap_err();
        assert_eq!(huge, PatternError::TooBig);
        let long = "x".repeat(Pattern::MAX_LEN + 1);
        assert_eq!(
            Pattern::new(&long).unwrap_err(),
            PatternError::TooLong(long.len())
        );
        let deep = format!("{}a{}", "(".repeat(200), ")".repeat(200));
        assert!(matches!(Pattern::new(&deep), Err(PatternError::Syntax(_))));
    }
}
