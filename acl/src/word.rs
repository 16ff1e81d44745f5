//! Words and string literals (FIPA00070).
//!
//! All encodings share this module: FIPA00069 2.2 defines `Word` and `String` "as in [FIPA00070]".

use crate::scan::{self, TOPS};

/// Whether the text is a FIPA00070 `Word`.
///
/// A word is not empty, has no control characters, blanks or parentheses, and does not begin with a
/// digit, `#`, `-` or `@`. Here it does not begin with a quotation mark either, because a reader
/// would take it for a string literal.
pub(crate) fn is_word(text: impl AsRef<[u8]>) -> bool {
    Shape::of(text) == Shape::Word
}

/// Whether the text is a `Word` apart from its first character. Peers do not check that character:
/// JADE writes every text without blanks as a word.
pub(crate) fn is_token(text: impl AsRef<[u8]>) -> bool {
    let bytes = text.as_ref();
    !bytes.is_empty() && classes(bytes).0 == 0
}

/// Whether JADE reads the text as one word of a string message, and reads it unchanged.
///
/// The lexer of JADE has tokens for printable ASCII characters only. It takes `\"` for an escape in
/// a word too, and a date in front of a word for a date.
pub(crate) fn is_word_of_jade(text: &str) -> bool {
    let bytes = text.as_bytes();
    is_word(bytes)
        && bytes.iter().all(|byte| (b'!'..=b'~').contains(byte))
        && memchr::memmem::find(bytes, b"\\\"").is_none()
        && !begins_with_sign_and_digit(bytes)
}

/// Whether JADE reads the text in quotation marks as one word.
pub(crate) fn is_quoted_word_of_jade(text: &str) -> bool {
    let bytes = text.as_bytes();
    is_token(bytes) && bytes.iter().all(|byte| (b'!'..=b'~').contains(byte)) && is_quotable(text)
}

/// Whether the text begins like a signed date. A word begins with no digit and no `-`.
fn begins_with_sign_and_digit(bytes: &[u8]) -> bool {
    matches!(bytes, [b'+', digit, ..] if digit.is_ascii_digit())
}

/// The forms in which a text can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Shape {
    /// As a word.
    Word,
    /// In quotation marks, unchanged.
    Quotable,
    /// As a string literal that may need escapes or a byte count.
    Other,
}

impl Shape {
    #[inline(always)]
    pub(crate) fn of(text: impl AsRef<[u8]>) -> Self {
        let bytes = text.as_ref();
        // Up to the parentheses, most texts have no characters other than blanks, and no
        // backslashes.
        let (low, odd) = match (bytes.first_chunk(), bytes.last_chunk(), bytes.len()) {
            (Some(first), Some(last), ..=16) => odds::<8>(first, last),
            (Some(_), Some(_), 17..=32) => match (bytes.first_chunk(), bytes.last_chunk()) {
                (Some(first), Some(last)) => odds::<16>(first, last),
                _ => return Self::of_any(bytes),
            },
            _ => return Self::of_any(bytes),
        };
        if odd {
            Self::of_any(bytes)
        } else if low || Self::is_excluded(bytes) {
            Self::Quotable
        } else {
            Self::Word
        }
    }

    /// Whether a word cannot begin like the text.
    #[inline]
    fn is_excluded(bytes: &[u8]) -> bool {
        matches!(
            bytes.first(),
            None | Some(b'0'..=b'9' | b'#' | b'-' | b'@' | b'"')
        )
    }

    #[inline(never)]
    fn of_any(bytes: &[u8]) -> Self {
        let (no_token, care) = classes(bytes);
        if !Self::is_excluded(bytes) && no_token == 0 {
            Self::Word
        } else if care == 0 {
            Self::Quotable
        } else {
            Self::Other
        }
    }
}

/// Checks a text that begins with `first` and ends with `last`, which may overlap.
///
/// Returns whether it has bytes up to `)`, and whether it has such bytes other than blanks or
/// backslashes. The compiler turns the loop into a few vector instructions.
#[inline(always)]
fn odds<const N: usize>(first: &[u8; N], last: &[u8; N]) -> (bool, bool) {
    let (mut low, mut odd) = (0, 0);
    for (one, other) in first.iter().zip(last) {
        for byte in [*one, *other] {
            let is_low = u8::from(byte < b'*');
            low |= is_low;
            odd |= is_low & u8::from(byte != b' ') | u8::from(byte == b'\\');
        }
    }
    (low != 0, odd != 0)
}

/// Returns two numbers. The first is not zero if the text has bytes that a token cannot have
/// (blanks, parentheses and control characters). The second is not zero if it has quotation marks or
/// backslashes.
#[inline]
fn classes(bytes: &[u8]) -> (u64, u64) {
    let (mut no_token, mut care) = (0, 0);
    // Exact as to whether there is such a byte.
    scan::each(bytes, |word| {
        no_token |= scan::no_token(word) & TOPS;
        care |= (scan::is(word, b'"') | scan::is(word, b'\\')) & TOPS;
    });
    (no_token, care)
}

/// A piece of a string literal.
pub(crate) enum Piece<'a> {
    Text(&'a str),
    /// The prefix of a byte-length encoded string: `#n"`.
    LengthPrefix(usize),
}

/// Writes a text as a string literal, piece by piece: `"…"` with `\"` as the only escape, or `#n"…`
/// if a reader could misread the former (a quotation mark behind a backslash, or a backslash at the
/// end).
pub(crate) fn string_literal<'a>(text: &'a str, mut put: impl FnMut(Piece<'a>)) {
    if !is_quotable(text) {
        put(Piece::LengthPrefix(text.len()));
        put(Piece::Text(text));
        return;
    }
    quoted(text, |piece| put(Piece::Text(piece)));
}

/// Whether every reader finds the end of the text in quotation marks: the text has no quotation mark
/// behind a backslash and no backslash at its end.
pub(crate) fn is_quotable(text: &str) -> bool {
    let bytes = text.as_bytes();
    bytes.last() != Some(&b'\\')
        && (memchr::memchr(b'"', bytes).is_none() || memchr::memmem::find(bytes, b"\\\"").is_none())
}

/// Writes a text in quotation marks, piece by piece. `"` becomes `\"`.
pub(crate) fn quoted<'a>(text: &'a str, mut put: impl FnMut(&'a str)) {
    put("\"");
    let mut pieces = text.split('"');
    put(pieces.next().unwrap_or_default());
    for piece in pieces {
        put("\\\"");
        put(piece);
    }
    put("\"");
}

/// Appends the string literal for a text.
pub(crate) fn push_string_literal(out: &mut String, text: &str) {
    string_literal(text, |piece| match piece {
        Piece::Text(text) => out.push_str(text),
        Piece::LengthPrefix(len) => {
            out.push('#');
            out.push_str(&len.to_string());
            out.push('"');
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_follow_the_grammar() {
        for word in ["a", "fipa-request", ":x", "a\"b", "é", "+1", "conv@x"] {
            assert!(is_word(word), "{word:?}");
        }
        for other in [
            "", "1a", "#a", "-a", "@a", "\"a\"", "a b", "a(", "a\n", "a\0",
        ] {
            assert!(!is_word(other), "{other:?}");
        }
        assert!(is_token("1a") && is_token("@a") && !is_token("a b") && !is_token(""));
    }

    #[test]
    fn words_of_jade_are_printable_ascii_without_escapes_and_dates() {
        for word in [
            "a",
            "fipa-request",
            ":x",
            "a\"b",
            "a\\b",
            "a\\",
            "+",
            "conv@x",
        ] {
            assert!(is_word_of_jade(word), "{word:?}");
        }
        for other in [
            "",
            "1a",
            "é",
            "a\u{7f}",
            "a\\\"b",
            "+00000000T000030000",
            "a b",
        ] {
            assert!(!is_word_of_jade(other), "{other:?}");
        }
        assert!(is_quoted_word_of_jade("1a") && is_quoted_word_of_jade("+00000000T000030000"));
        assert!(!is_quoted_word_of_jade("é") && !is_quoted_word_of_jade("a b"));
        assert!(!is_quoted_word_of_jade("") && !is_quoted_word_of_jade("1\\"));
    }

    #[test]
    fn every_byte_is_checked_at_every_position() {
        for len in 1..20 {
            for at in 0..len {
                for byte in 0..=0x7f_u8 {
                    let mut text = vec![b'a'; len];
                    text[at] = byte;
                    let text = String::from_utf8(text).unwrap();
                    let no_token = byte <= 0x20 || b"()".contains(&byte);
                    assert_eq!(is_token(&text), !no_token, "{text:?}");
                    let excluded = at == 0 && b"0123456789#-@\"".contains(&byte);
                    let expected = if !no_token && !excluded {
                        Shape::Word
                    } else if b"\"\\".contains(&byte) {
                        Shape::Other
                    } else {
                        Shape::Quotable
                    };
                    assert_eq!(Shape::of(&text), expected, "{text:?}");
                }
            }
        }
        assert_eq!(Shape::of("é é\""), Shape::Other);
        assert_eq!(Shape::of("\u{a0}\u{fe}"), Shape::Word);
    }

    #[test]
    fn literals_have_escapes_or_a_byte_count_if_escapes_are_ambiguous() {
        let literal = |text: &str| {
            let mut out = String::new();
            push_string_literal(&mut out, text);
            out
        };
        assert_eq!(literal(""), r#""""#);
        assert_eq!(literal(r#"on"to"#), r#""on\"to""#);
        assert_eq!(literal(r"la\ng"), r#""la\ng""#);
        assert_eq!(literal(r#"é\""#), "#4\"é\\\"");
        assert_eq!(literal(r"a\"), "#2\"a\\");
    }
}
