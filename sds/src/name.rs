//! What may be the name of an agent.

use fipa_acl::is_unprintable;

use crate::is_pattern;

/// Longest name of an agent, in bytes.
///
/// The standards set no limit. This one leaves room for the longest names in use (`agent@host:port`
/// of JADE, coalitions of several agents) while a name still fits an mDNS record many times over.
pub const MAX_NAME: usize = 1024;

/// Why a name cannot be the name of an agent.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NameError {
    /// There is no name.
    #[error("the name is empty; give the agent a name of 1 to {MAX_NAME} bytes")]
    Empty,
    /// The name is longer than [`MAX_NAME`].
    #[error("the name has {0} bytes; at most {MAX_NAME} are allowed")]
    TooLong(usize),
    /// The name has a control character, a format character (bidirectional ones are such), or a
    /// separator of lines: it could look like another name.
    #[error(
        "the name {name:?} has the control or format character {character:?} at byte {at}; remove it"
    )]
    Unprintable {
        /// The name.
        name: String,
        /// The character.
        character: char,
        /// Where it stands, in bytes from the beginning.
        at: usize,
    },
    /// The name is a pattern: its agent would get the letters to those that match.
    #[error(
        "the name {0:?} is a pattern; use a name without any of * + ? [ ( {{ | ^ $ \\ (a dot is allowed)"
    )]
    Pattern(String),
}

/// Whether this can be the name of an agent: UTF-8 of 1 to [`MAX_NAME`] bytes without
/// [unprintable](is_unprintable) characters that [is no pattern](is_pattern).
///
/// # Errors
/// Says what is wrong with the name.
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
    fn the_limits_are_the_limits() {
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
