//! What counts as a word, and how text is written as a string literal (FIPA00070).
//!
//! Shared by all encodings: the bit-efficient one takes both productions over from the string one.

/// Whether the text is a FIPA00070 `Word`: not empty, no control characters, blanks or
/// parentheses, and not beginning with a digit, `#`, `-` or `@`. A quotation mark in front is
/// excluded too, because a reader would take the text for a string literal.
pub(crate) fn is_word(text: &str) -> bool {
    let starts_well = match text.as_bytes().first() {
        None | Some(b'0'..=b'9' | b'#' | b'-' | b'@' | b'"') => false,
        Some(_) => true,
    };
    starts_well && is_token(text)
}

/// Whether the text is a `Word` but for its first character, which peers do not look at: JADE
/// writes whatever has no blanks as a word.
pub(crate) fn is_token(text: &str) -> bool {
    !text.is_empty()
        && text
            .bytes()
            .all(|byte| byte > 0x20 && byte != b'(' && byte != b')')
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
    bytes.last() != Some(&b'\\') && memchr::memmem::find(bytes, b"\\\"").is_none()
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
