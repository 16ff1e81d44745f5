//! Patterns of names, performatives and protocols: regular expressions that match whole texts.
//!
//! This is the only place of the project that compiles regular expressions at run time, so that one
//! set of flags and bounds holds for all of them. `.ci/arrows` checks this.

use std::fmt;

use regex::{Regex, RegexBuilder};
use regex_syntax::ast::{self, Ast, Flag, GroupKind};

/// A regular expression that must match the whole text. A dot matches every character, also a line
/// break.
///
/// The syntax is that of the crate `regex`, which matches in linear time. The size of the compiled
/// expression is bounded, so that a pattern from an untrusted peer costs little.
#[derive(Debug, Clone)]
pub struct Pattern {
    text: String,
    whole: Regex,
}

impl Pattern {
    /// Maximum length of a pattern, in bytes.
    pub const MAX_LEN: usize = 1024;

    /// Maximum size of the compiled expression, in bytes.
    const MAX_COMPILED: usize = 128 * 1024;

    /// Maximum nesting depth of groups.
    const MAX_DEPTH: u32 = 32;

    /// Compiles a pattern.
    ///
    /// # Errors
    /// Returns the cause when the pattern is too long, too big or not a regular expression, or when it
    /// turns off the flag `s`.
    pub fn new(pattern: &str) -> Result<Self, PatternError> {
        Self::compile(pattern, false)
    }

    /// Compiles a pattern that ignores the case of letters.
    ///
    /// # Errors
    /// As for [`new`](Self::new).
    pub fn ignoring_case(pattern: &str) -> Result<Self, PatternError> {
        Self::compile(pattern, true)
    }

    /// Whether the whole text matches.
    #[must_use]
    #[inline]
    pub fn matches(&self, text: &str) -> bool {
        self.whole.is_match(text)
    }

    fn compile(pattern: &str, ignores_case: bool) -> Result<Self, PatternError> {
        if pattern.len() > Self::MAX_LEN {
            return Err(PatternError::TooLong(pattern.len()));
        }
        // Parsed alone: a pattern such as `a)|(?:b` is valid only inside the group below, and would
        // escape it.
        let tree = ast::parse::ParserBuilder::new()
            .nest_limit(Self::MAX_DEPTH)
            .build()
            .parse(pattern)
            .map_err(|error| PatternError::Syntax(error.to_string()))?;
        // With `(?-s).*`, a rule for all names would exempt a name with a line break.
        match ast::visit(&tree, FlagCheck) {
            Ok(()) => {}
            Err(DotExcludesLines) => return Err(PatternError::DotExcludesLines),
        }
        let build = |end: &str| {
            RegexBuilder::new(&format!(r"\A(?:{pattern}{end}"))
                .case_insensitive(ignores_case)
                .dot_matches_new_line(true)
                .size_limit(Self::MAX_COMPILED)
                .dfa_size_limit(Self::MAX_COMPILED)
                .nest_limit(Self::MAX_DEPTH + 1)
                .build()
                .map_err(|error| match error {
                    regex::Error::CompiledTooBig(_) => PatternError::TooBig,
                    other => PatternError::Syntax(other.to_string()),
                })
        };
        let whole = match build(r")\z") {
            // A verbose pattern may end in a comment, which would comment out the end of the group.
            Err(PatternError::Syntax(_)) => build("\n)\\z"),
            built => built,
        };
        Ok(Self {
            text: pattern.to_owned(),
            whole: whole?,
        })
    }
}

/// Formats the pattern as it was written.
impl fmt::Display for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
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
    /// The pattern turns off the flag `s`, with which a dot matches a line break.
    #[error(
        "the pattern turns off the flag `s`, as `(?-s)` does; remove this, because a dot matches every character"
    )]
    DotExcludesLines,
    /// The pattern is not a regular expression.
    #[error("the pattern is not a regular expression: {0}")]
    Syntax(String),
}

/// Fails for a pattern whose dots do not match line breaks.
struct FlagCheck;

struct DotExcludesLines;

impl ast::Visitor for FlagCheck {
    type Output = ();
    type Err = DotExcludesLines;

    fn finish(self) -> Result<(), DotExcludesLines> {
        Ok(())
    }

    fn visit_pre(&mut self, ast: &Ast) -> Result<(), DotExcludesLines> {
        let flags = match ast {
            Ast::Flags(set) => &set.flags,
            Ast::Group(group) => match &group.kind {
                GroupKind::NonCapturing(flags) => flags,
                _ => return Ok(()),
            },
            _ => return Ok(()),
        };
        match flags.flag_state(Flag::DotMatchesNewLine) {
            Some(false) => Err(DotExcludesLines),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        assert_eq!(pattern.to_string(), "arm_.*|a|ab");
        assert!(!pattern.matches("A"));
        assert!(Pattern::ignoring_case("a|ab").unwrap().matches("AB"));
    }

    #[test]
    fn a_pattern_cannot_escape_its_anchors() {
        let verbose = Pattern::new("(?x) a b # comment").unwrap();
        assert!(verbose.matches("ab"));
        assert!(!verbose.matches("abc"));
        assert_eq!(verbose.to_string(), "(?x) a b # comment");
        assert!(!Pattern::new("(?m)^a$").unwrap().matches("a\nb"));
        assert!(matches!(
            Pattern::new("a)|(?:b"),
            Err(PatternError::Syntax(_))
        ));
    }

    #[test]
    fn a_dot_matches_every_character_whatever_flags_a_pattern_sets() {
        let breaks = ["\n", "\r", "\r\n", "\u{b}", "\u{85}", "\u{2028}", "\0"];
        for pattern in [
            ".*",
            "rov.*_1",
            "(?R).*",
            "(?mR).*",
            "(?mxU).*",
            "(?s).*",
            "(?i)ROV(?R:.*)",
        ] {
            let compiled = Pattern::new(pattern).unwrap();
            for line_break in breaks {
                let name = format!("rov{line_break}_1");
                assert!(compiled.matches(&name), "{pattern} on {name:?}");
            }
        }
        for pattern in [
            "(?-s).*",
            "(?-s:.*)",
            "rov(a|b(?i-s:.)*)?",
            "(?s)(?-s).*",
            "(?x-s) .* # all",
        ] {
            let refused = Pattern::new(pattern).unwrap_err();
            assert_eq!(refused, PatternError::DotExcludesLines, "{pattern}");
            assert!(Pattern::ignoring_case(pattern).is_err(), "{pattern}");
        }
        // These are no flags.
        assert!(Pattern::new(r"[(?-s)]\(\?-s\)").unwrap().matches("?(?-s)"));
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
        let unknown = Pattern::new(r"\p{Nonsense}").unwrap_err().to_string();
        assert!(unknown.contains("property not found"), "{unknown}");
    }
}
