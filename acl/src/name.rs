//! The characters of names.
//!
//! Decoders accept names with any characters, because recordings have them. The rules for names that
//! register, are announced or arrive in letters are in `fipa-sds` and `fipa-mts`.

use crate::is_unprintable;

/// Whether a name is a pattern: it contains one of `* + ? [ ( { | ^ $ \`.
///
/// A dot alone does not make a pattern, because many names contain dots.
#[must_use]
pub fn is_pattern(name: &str) -> bool {
    name.contains(['*', '+', '?', '[', '(', '{', '|', '^', '$', '\\'])
}

/// Returns the first character of a name, with its byte offset, with which the name could look like
/// another one: an [unprintable](is_unprintable) character, a blank other than a space, or a space at
/// the beginning or the end.
#[must_use]
pub fn misleading_character(name: &str) -> Option<(usize, char)> {
    // Nearly all names; a gateway checks each name in a letter.
    if name.bytes().all(|byte| byte.is_ascii_graphic()) {
        return None;
    }
    let is_misleading = |(at, c): &(usize, char)| {
        let is_inner = *at > 0 && at + 1 < name.len();
        is_unprintable(*c) || is_blank(*c) && !(*c == ' ' && is_inner)
    };
    name.char_indices().find(is_misleading)
}

/// Whether the character is shown as white space. U+2800, the Braille pattern without dots, is no white
/// space of Unicode.
fn is_blank(c: char) -> bool {
    c.is_whitespace() || c == '\u{2800}'
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
    fn names_that_look_alike_have_a_misleading_character() {
        for name in [
            "",
            "rover",
            "arm left 2",
            "a  b",
            "béla@home:1099/JADE",
            "机器人",
        ] {
            assert_eq!(misleading_character(name), None, "{name:?}");
        }
        for (name, expected) in [
            ("rov\n_1", (3, '\n')),
            ("rover\u{34f}", (5, '\u{34f}')),
            ("\u{115f}rover", (0, '\u{115f}')),
            ("ro\u{3164}ver", (2, '\u{3164}')),
            ("é\u{fe0f}", (2, '\u{fe0f}')),
            ("rover\u{e01ef}", (5, '\u{e01ef}')),
            (" rover", (0, ' ')),
            ("rover ", (5, ' ')),
            (" ", (0, ' ')),
            ("arm\u{a0}left", (3, '\u{a0}')),
            ("rover\u{3000}", (5, '\u{3000}')),
            ("\u{2800}rover", (0, '\u{2800}')),
        ] {
            assert_eq!(misleading_character(name), Some(expected), "{name:?}");
        }
    }
}
