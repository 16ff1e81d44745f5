//! Names of agents.

use std::fmt;

use fipa_acl::{escape, misleading_character};

use crate::is_pattern;

/// Longest name of an agent, in bytes.
///
/// The standards set no limit. This limit admits the longest names in use (`agent@host:port` of
/// JADE, coalitions of several agents), and an mDNS record holds many names of this length.
pub const MAX_NAME: usize = 1024;

/// Error of [`check_name`] and [`check_characters`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NameError {
    /// The name is empty.
    #[error("the name is empty; give the agent a name of 1 to {MAX_NAME} bytes")]
    Empty,
    /// The name is longer than [`MAX_NAME`].
    #[error("the name has {0} bytes; at most {MAX_NAME} are allowed")]
    TooLong(usize),
    /// The name has a [misleading character](misleading_character): it could look like another name.
    #[error(
        "the name {} has the character U+{:04X} at byte {at}, with which it could look like another \
         name; remove this character",
        Shown(name), u32::from(*character)
    )]
    Misleading {
        /// The name.
        name: String,
        /// The character.
        character: char,
        /// Byte offset of the character in the name.
        at: usize,
    },
    /// The name is a pattern: the agent would receive letters that are meant for every matching
    /// agent.
    #[error(
        "the name {} is a pattern; use a name without any of * + ? [ ( {{ | ^ $ \\ (a dot is allowed)",
        Shown(.0)
    )]
    Pattern(String),
}

/// Checks that `name` is a valid agent name: UTF-8 of 1 to [`MAX_NAME`] bytes without
/// [misleading characters](misleading_character) that [is no pattern](is_pattern).
///
/// # Errors
/// Returns the first rule that the name violates.
pub fn check_name(name: &str) -> Result<(), NameError> {
    if name.is_empty() {
        return Err(NameError::Empty);
    }
    if name.len() > MAX_NAME {
        return Err(NameError::TooLong(name.len()));
    }
    check_characters(name)?;
    match is_pattern(name) {
        true => Err(NameError::Pattern(name.to_owned())),
        false => Ok(()),
    }
}

/// Checks that `name` has no [misleading characters](misleading_character). The names in a letter of
/// another host have to meet only this rule, because their agents may not be registered anywhere.
///
/// # Errors
/// Returns the first misleading character.
pub fn check_characters(name: &str) -> Result<(), NameError> {
    match misleading_character(name) {
        Some((at, character)) => Err(NameError::Misleading {
            name: name.to_owned(),
            character,
            at,
        }),
        None => Ok(()),
    }
}

/// Returns a valid beginning of a name, of at most 64 bytes, that is made of this text: characters
/// that are not allowed in names, and blanks, become `-`. For names that are derived from the name of
/// the host, which the kernel does not restrict.
#[must_use]
pub fn to_name(text: &str) -> String {
    const MAX: usize = 64;
    let is_allowed = |c: char| {
        let mut buffer = [0; 4];
        let text: &str = c.encode_utf8(&mut buffer);
        c != ' ' && check_characters(text).is_ok() && !is_pattern(text)
    };
    let mut name = String::new();
    for c in text.chars() {
        if name.len() + c.len_utf8() > MAX {
            break;
        }
        name.push(if is_allowed(c) { c } else { '-' });
    }
    match name.is_empty() {
        true => "localhost".to_owned(),
        false => name,
    }
}

/// The beginning of a name in quotes, for an error: a name from the network may have 4 KiB.
struct Shown<'a>(&'a str);

impl fmt::Display for Shown<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (start, rest) = match self.0.char_indices().nth(80) {
            Some((end, _)) => (self.0.get(..end).unwrap_or_default(), "…"),
            None => (self.0, ""),
        };
        write!(f, "\"{}{rest}\"", escape(start))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_accepted_up_to_the_documented_limits() {
        for good in [
            "a",
            "béla@home:1099/JADE",
            ".",
            "arm.left",
            "arm left)]}",
            &"x".repeat(MAX_NAME),
        ] {
            assert_eq!(check_name(good), Ok(()));
        }
        assert_eq!(check_name(""), Err(NameError::Empty));
        for pattern in [
            "arm_.*",
            "arm?left",
            "arm (left)",
            "[a]",
            "a|b",
            "^a",
            "a$",
            r"a\.b",
            "a+",
        ] {
            let error = NameError::Pattern(pattern.to_owned());
            assert_eq!(check_name(pattern), Err(error));
        }
        let long = "é".repeat(MAX_NAME / 2 + 1);
        assert_eq!(check_name(&long), Err(NameError::TooLong(MAX_NAME + 2)));
        for (bad, place) in [
            ("a\nb", 1),
            ("\0", 0),
            ("é\u{85}", 2),
            ("arm\u{202e}tfel", 3),
            ("rover\u{200b}", 5),
            ("\u{feff}rover", 0),
            ("a\u{2028}b", 1),
            ("rover\u{34f}", 5),
            ("\u{115f}rover", 0),
            ("ro\u{3164}ver", 2),
            ("rover\u{fe0f}", 5),
            (" rover", 0),
            ("rover ", 5),
            ("arm\u{a0}left", 3),
        ] {
            assert!(
                matches!(check_name(bad), Err(NameError::Misleading { at, .. }) if at == place),
                "{bad:?}"
            );
        }
    }

    #[test]
    fn a_name_is_derived_from_any_text() {
        for (text, expected) in [
            ("sherpa", "sherpa"),
            ("(none)", "-none)"),
            (r"([{*+?|^$\", "----------"),
            ("a b\u{a0}c\n\u{3164}", "a-b-c--"),
            ("béla.local", "béla.local"),
            ("", "localhost"),
        ] {
            let name = to_name(text);
            assert_eq!(name, expected);
            assert_eq!(check_name(&name), Ok(()));
        }
        assert_eq!(to_name(&"é".repeat(100)), "é".repeat(32));
    }

    #[test]
    fn an_error_shows_the_beginning_of_the_name_and_no_control_characters() {
        let error = check_name("rov\n_1").unwrap_err().to_string();
        let expected = r#"the name "rov\u{a}_1" has the character U+000A at byte 3,"#;
        assert!(error.starts_with(expected), "{error}");
        let long = format!("\u{1b}{}", "é".repeat(32_000));
        let error = check_characters(&long).unwrap_err().to_string();
        assert!(error.chars().count() < 200, "{error}");
    }
}
