//! What counts as a word, and how text is written as a string literal (FIPA00070).
//!
//! Shared by all encodings: the bit-efficient one takes both productions over from the string one.

use crate::scan::{self, TOPS};

/// Whether the text is a FIPA00070 `Word`: not empty, no control characters, blanks or
/// parentheses, and not beginning with a digit, `#`, `-` or `@`. A quotation mark in front is
/// excluded too, because a reader would take the text for a string literal.
pub(crate) fn is_word(text: impl AsRef<[u8]>) -> bool {
    Shape::of(text) == Shape::Word
}

/// Whether the text is a `Word` but for its first character, which peers do not look at: JADE
/// writes whatever has no blanks as a word.
pub(crate) fn is_token(text: impl AsRef<[u8]>) -> bool {
    let bytes = text.as_ref();
    !bytes.is_empty() && classes(bytes).0 == 0
}

/// How a text can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Shape {
    Word,
    /// In quotation marks, as it is.
    Quotable,
    /// Not without care.
    Other,
}

impl Shape {
    #[inline]
    pub(crate) fn of(text: impl AsRef<[u8]>) -> Self {
        let bytes = text.as_ref();
        let (no_token, care) = classes(bytes);
        let starts_well = match bytes.first() {
            None | Some(b'0'..=b'9' | b'#' | b'-' | b'@' | b'"') => false,
            Some(_) => true,
        };
        if starts_well && no_token == 0 {
            Self::Word
        } else if care == 0 {
            Self::Quotable
        } else {
            Self::Other
        }
    }
}

/// Two numbers, neither of which is zero if there are bytes that no token has (blanks, parentheses
/// and control characters), or bytes that need care in quotation marks (those and backslashes).
#[inline]
fn classes(bytes: &[u8]) -> (u64, u64) {
    let (mut no_token, mut care) = (0, 0);
    let mut look = |eight: [u8; 8]| {
        let word = u64::from_le_bytes(eight);
        // Exact as to whether there is one.
        no_token |= scan::no_token(word) & TOPS;
        care |= (scan::is(word, b'"') | scan::is(word, b'\\')) & TOPS;
    };
    match (bytes.as_chunks::<8>(), bytes.last_chunk()) {
        // The last eight overlap those in front of them.
        ((eights, _), Some(last)) => {
            eights.iter().for_each(|eight| look(*eight));
            look(*last);
        }
        ((_, rest), None) => {
            // Letters, which are neither.
            let mut eight = [b'a'; 8];
            for (filled, byte) in eight.iter_mut().zip(rest) {
                *filled = *byte;
            }
            look(eight);
        }
    }
    (no_token, care)
}

/// A piece of a string literal.
pub(crate) enum Piece<'a> {
    Text(&'a str),
    /// The opening of a byte-length encoded string: `#n"`.
    LengthPrefix(usize),
}

/// The pieces of the string literal for a text: `"…"` with `\"` as the only escape, or `#n"…`
/// where a reader of the former could go wrong (a quotation mark after a backslash, a backslash
/// at the end).
pub(crate) fn string_literal<'a>(text: &'a str, mut put: impl FnMut(Piece<'a>)) {
    if !is_quotable(text) {
        put(Piece::LengthPrefix(text.len()));
        put(Piece::Text(text));
        return;
    }
    quoted(text, |piece| put(Piece::Text(piece)));
}

/// Whether every reader finds the end of the text in quotation marks: no quotation mark behind a
/// backslash and no backslash at the end.
pub(crate) fn is_quotable(text: &str) -> bool {
    let bytes = text.as_bytes();
    bytes.last() != Some(&b'\\')
        && (memchr::memchr(b'"', bytes).is_none() || memchr::memmem::find(bytes, b"\\\"").is_none())
}

/// The pieces of a text in quotation marks, `"` written as `\"`.
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
    fn every_byte_counts_wherever_it_stands() {
        for len in 1..20 {
            for place in 0..len {
                for byte in 0..=0x7f_u8 {
                    let mut text = vec![b'a'; len];
                    text[place] = byte;
                    let text = String::from_utf8(text).unwrap();
                    let no_token = byte <= 0x20 || b"()".contains(&byte);
                    assert_eq!(is_token(&text), !no_token, "{text:?}");
                    let starts_badly = place == 0 && b"0123456789#-@\"".contains(&byte);
                    let expected = if !no_token && !starts_badly {
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
    fn literals_escape_quotes_and_count_bytes_where_escaping_is_ambiguous() {
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
