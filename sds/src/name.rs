//! Names of agents.

use fipa_acl::is_unprintable;

use crate::is_pattern;

/// Longest name of an agent, in bytes.
///
/// The standards set no limit. This limit admits the longest names in use (`agent@host:port` of
/// JADE, coalitions of several agents), and an mDNS record holds many names of this length.
pub const MAX_NAME: usize = 1024;

/// Error of [`check_name`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NameError {
    /// The name is empty.
    #[error("the name is empty; give the agent a name of 1 to {MAX_NAME} bytes")]
    Empty,
    /// The name is longer than [`MAX_NAME`].
    #[error("the name has {0} bytes; at most {MAX_NAME} are allowed")]
    TooLong(usize),
    /// The name has a control character, a format character (such as a bidirectional one) or a line
    /// separator: it could look like another name.
    #[error(
        "the name {name:?} has the control or format character {character:?} at byte {at}; remove it"
    )]
    Unprintable {
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
        "the name {0:?} is a pattern; use a name without any of * + ? [ ( {{ | ^ $ \\ (a dot is allowed)"
    )]
    Pattern(String),
}

/// Checks that `name` is a valid agent name: UTF-8 of 1 to [`MAX_NAME`] bytes without
/// [unprintable](is_unprintable) characters that [is no pattern](is_pattern).
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
    match name.char_indices().find(|(_, c)| is_unprintable(*c)) {
        Some((at, character)) => Err(NameError::Unprintable {
            name: name.to_owned(),
            character,
            at,
        }),
        None if is_pattern(name) => Err(NameError::Pattern(name.to_owned())),
        None => Ok(()),
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
        ] {
            assert!(
                matches!(check_name(bad), Err(NameError::Unprintable { at, .. }) if at == place),
                "{bad:?}"
            );
        }
    }
}
