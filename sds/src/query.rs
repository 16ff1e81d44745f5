//! Searching the directory, and the patterns in which receivers may be named.

use std::fmt;

use regex::{Regex, RegexBuilder};

use crate::entry::{millis_of_time, time_of_millis};
use crate::{Entry, MAX_NAME, Role};

/// Whether a name that nobody has is a pattern: it contains one of `* + ? [ ( { | ^ $ \`.
///
/// A dot alone makes no pattern: names are full of dots.
#[must_use]
pub fn is_pattern(name: &str) -> bool {
    name.contains(['*', '+', '?', '[', '(', '{', '|', '^', '$', '\\'])
}

/// A regular expression that is matched against the whole of a text.
///
/// The syntax is that of the crate `regex`, which matches in linear time; the compiled expression
/// is bounded, so that a pattern from a stranger costs little.
#[derive(Debug, Clone)]
pub struct Pattern(Regex);

impl Pattern {
    /// Longest pattern, in bytes.
    pub const MAX_LEN: usize = MAX_NAME;

    /// Bound of the compiled expression, in bytes.
    const MAX_COMPILED: usize = 128 * 1024;

    /// How deep groups may be nested.
    const MAX_DEPTH: u32 = 32;

    /// Compiles a pattern.
    ///
    /// # Errors
    /// Says what is wrong with it.
    pub fn new(pattern: &str) -> Result<Self, PatternError> {
        if pattern.len() > Self::MAX_LEN {
            return Err(PatternError::TooLong(pattern.len()));
        }
        // On its own first: what only compiles inside the group below would have left the group.
        compile(pattern)?;
        // A verbose pattern may end in a comment, which would swallow the end of the group.
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

/// The pattern as it was written.
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

/// What is wrong with a pattern.
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

/// What one field of an entry is compared with.
#[derive(Debug, Clone)]
pub enum Matcher {
    /// The same text.
    Exact(String),
    /// A pattern for the whole text.
    Pattern(Pattern),
}

impl Matcher {
    /// A pattern when the text [is one](is_pattern), else the text itself.
    ///
    /// # Errors
    /// When the pattern is not valid.
    pub fn parse(text: &str) -> Result<Self, PatternError> {
        if is_pattern(text) {
            Pattern::new(text).map(Self::Pattern)
        } else {
            Ok(Self::Exact(text.to_owned()))
        }
    }

    /// Whether the whole text is the one that is meant, or matches.
    #[must_use]
    pub fn matches(&self, text: &str) -> bool {
        match self {
            Self::Exact(exact) => exact == text,
            Self::Pattern(pattern) => pattern.matches(text),
        }
    }
}

/// What is searched for: entries that match in every field that is given.
#[derive(Debug, Clone, Default)]
pub struct Query {
    /// Matches [`Entry::name`].
    pub name: Option<Matcher>,
    /// Matches [`Entry::agent_type`].
    pub agent_type: Option<Matcher>,
    /// Matches one of [`Entry::locations`], written `kind://address`.
    pub location: Option<Matcher>,
    /// Matches [`Entry::description`].
    pub description: Option<Matcher>,
    /// Matches the name of the message transport service in [`Entry::mts`].
    pub mts: Option<Matcher>,
    /// Matches [`Entry::registered`], written in UTC with milliseconds as RFC 3339 has it:
    /// `2026-03-01T09:30:00.000Z`.
    pub registered: Option<Matcher>,
    /// Matches one of the [`Members`](crate::Members) of a coalition; nobody else has any.
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

    /// Whether the entry is searched for.
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
            && matches(&self.mts, &entry.mts.name)
            && self.registered.as_ref().is_none_or(|matcher| {
                // Within the years that can be written.
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
    fn a_dot_makes_no_pattern() {
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
    fn a_pattern_cannot_leave_its_anchors() {
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
    fn bad_patterns_say_why() {
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
