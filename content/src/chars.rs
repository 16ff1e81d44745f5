//! Classes of bytes, and the words that SL reserves (FIPA00008 `Word`).

/// Ends a word: control characters, blanks and parentheses.
const DELIMITER: u8 = 1;
/// A quotation mark, which is escaped in quotation marks.
const QUOTE: u8 = 2;
/// A backslash, which a reader can take for the beginning of an escape.
const BACKSLASH: u8 = 16;
/// A byte of a character beyond ASCII.
const NOT_ASCII: u8 = 4;
/// White space between tokens.
const WHITE: u8 = 8;

static CLASSES: [u8; 256] = classes();

const fn classes() -> [u8; 256] {
    let mut classes = [0; 256];
    let mut byte = 0;
    while byte < 256 {
        classes[byte] = match byte as u8 {
            b' ' | b'\t' | b'\n' | b'\r' => DELIMITER | WHITE,
            0..=0x1f | b'(' | b')' => DELIMITER,
            b'"' => QUOTE,
            b'\\' => BACKSLASH,
            0x80.. => NOT_ASCII,
            _ => 0,
        };
        byte += 1;
    }
    classes
}

#[inline]
fn class(byte: u8) -> u8 {
    CLASSES.get(usize::from(byte)).copied().unwrap_or_default()
}

/// Whether the byte ends a word.
#[inline]
pub(crate) fn is_delimiter(byte: u8) -> bool {
    class(byte) & DELIMITER != 0
}

/// Whether the byte is white space between tokens.
#[inline]
pub(crate) fn is_white(byte: u8) -> bool {
    class(byte) & WHITE != 0
}

/// Properties of a text that decide on its notation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Shape {
    classes: u8,
    /// Whether the first characters can start a word.
    begins: bool,
}

impl Shape {
    #[inline]
    pub(crate) fn of(text: &str) -> Self {
        let bytes = text.as_bytes();
        let classes = bytes.iter().fold(0, |classes, byte| classes | class(*byte));
        Self {
            classes,
            begins: begins_word(bytes),
        }
    }

    /// Whether all readers take the text for a word: no delimiters, quotation marks and
    /// backslashes, and not the beginning of another token.
    #[inline]
    pub(crate) fn is_word(self) -> bool {
        self.begins && self.classes & (DELIMITER | QUOTE | BACKSLASH) == 0
    }

    #[inline]
    pub(crate) fn is_ascii(self) -> bool {
        self.classes & NOT_ASCII == 0
    }

    #[inline]
    pub(crate) fn has_quotes(self) -> bool {
        self.classes & QUOTE != 0
    }

    #[inline]
    pub(crate) fn has_backslashes(self) -> bool {
        self.classes & BACKSLASH != 0
    }
}

/// Whether a token with this start is a word.
///
/// FIPA00008 `Word` allows `+` and `.` in front, which also start numbers: `+5`, `.5`.
#[inline]
pub(crate) fn begins_word(bytes: &[u8]) -> bool {
    match bytes.first() {
        None | Some(b'0'..=b'9' | b'(' | b')' | b'#' | b':' | b'-' | b'?' | b'"') => false,
        Some(b'+' | b'.') => !begins_number(bytes),
        Some(byte) => !is_delimiter(*byte),
    }
}

/// Whether a token with this start is a number or a date-time.
#[inline]
pub(crate) fn begins_number(bytes: &[u8]) -> bool {
    matches!(
        bytes,
        [b'0'..=b'9', ..]
            | [b'+' | b'-' | b'.', b'0'..=b'9', ..]
            | [b'+' | b'-', b'.', b'0'..=b'9', ..]
    )
}

/// Returns the truth value of the word, in upper or lower case, as JADE reads it.
#[inline]
pub(crate) fn truth(word: &str) -> Option<bool> {
    match word.len() {
        4 if word.eq_ignore_ascii_case("true") => Some(true),
        5 if word.eq_ignore_ascii_case("false") => Some(false),
        _ => None,
    }
}

/// Whether the word is reserved as the head of a term.
pub(crate) fn is_term_keyword(word: &str) -> bool {
    matches!(
        word,
        "action" | "|" | ";" | "iota" | "any" | "all" | "sequence" | "set"
    )
}

/// Whether the word has a meaning of its own as the head of a formula.
pub(crate) fn is_wff_keyword(word: &str) -> bool {
    matches!(
        word,
        "not"
            | "and"
            | "or"
            | "implies"
            | "equiv"
            | "forall"
            | "exists"
            | "B"
            | "U"
            | "PG"
            | "I"
            | "feasible"
            | "done"
            | "result"
            | "="
            | "action"
            | "|"
            | ";"
            | "iota"
            | "any"
            | "all"
    )
}

/// Whether JADE takes the word for an operator directly after a parenthesis. It ignores case.
pub(crate) fn is_jade_operator(word: &str) -> bool {
    const OPERATORS: [&str; 22] = [
        "action", "iota", "any", "all", "B", "U", "PG", "I", "+", "*", "/", "%", "feasible",
        "done", "|", ";", "not", "and", "or", "implies", "equiv", "forall",
    ];
    OPERATORS
        .iter()
        .chain(&["exists"])
        .any(|operator| operator.eq_ignore_ascii_case(word))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_follow_the_grammar() {
        for word in [
            "a",
            "a:b?",
            "http://h:1/acc",
            "é",
            "+",
            "+x",
            "..5",
            ".x",
            "@a",
            "=",
            "|",
        ] {
            assert!(Shape::of(word).is_word(), "{word:?}");
        }
        for other in [
            "", "1", "-", "-a", "#a", ":a", "?a", "\"a", "a\"", "a\\", "a b", "a(", "a\0", "+1",
            "+.5", ".5",
        ] {
            assert!(!Shape::of(other).is_word(), "{other:?}");
        }
    }
}
