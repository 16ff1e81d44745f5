//! Tokens of the string encoding: white space, words, strings, expressions.

use std::borrow::Cow;

use crate::error::{DecodeError, Problem};

/// Deepest nesting of expressions that is accepted.
pub(super) const MAX_EXPRESSION_DEPTH: usize = 64;

const WORD: &str = "FIPA00070 Word";
const STRING: &str = "FIPA00070 String";
const EXPRESSION: &str = "FIPA00070 Expression";

/// What has to follow a keyword directly for it to be one where no white space stands in front:
/// fipa_services writes none, and a word may contain colons.
#[derive(Clone, Copy)]
pub(super) enum Follows {
    /// An opening parenthesis.
    Parenthesis,
    /// A byte-length encoded string.
    Counted,
    /// A date and time.
    DateTime,
    /// Any word.
    Word,
    /// Nothing: it never comes behind a word.
    Never,
}

/// The keywords that can stand in some place, without their colon.
pub(super) type Keywords<T> = [(&'static str, Follows, T)];

/// Goes over the bytes of a message once, from front to back.
pub(super) struct Lexer<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Lexer<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0 }
    }

    /// Bytes read so far.
    pub(super) fn offset(&self) -> usize {
        self.at
    }

    pub(super) fn rest(&self) -> &'a [u8] {
        self.bytes.get(self.at..).unwrap_or_default()
    }

    pub(super) fn peek(&self) -> Option<u8> {
        self.bytes.get(self.at).copied()
    }

    /// Passes over as many bytes, which the caller has seen to be there.
    pub(super) fn skip(&mut self, bytes: usize) {
        self.at = self.bytes.len().min(self.at.saturating_add(bytes));
    }

    /// Passes over white space and says whether there was any.
    pub(super) fn skip_space(&mut self) -> bool {
        let start = self.at;
        while self.peek().is_some_and(is_space) {
            self.at += 1;
        }
        self.at > start
    }

    /// Passes over white space and the byte, if it stands there.
    pub(super) fn accept(&mut self, byte: u8) -> bool {
        self.skip_space();
        let there = self.peek() == Some(byte);
        if there {
            self.at += 1;
        }
        there
    }

    /// Passes over white space and the parenthesis that must stand there.
    pub(super) fn open(&mut self, clause: &'static str) -> Result<(), DecodeError> {
        if self.accept(b'(') {
            Ok(())
        } else {
            Err(self.unexpected(clause, "an opening parenthesis"))
        }
    }

    /// Passes over white space and a name that must stand there, in any case.
    pub(super) fn name(
        &mut self,
        name: &str,
        clause: &'static str,
        expected: &'static str,
    ) -> Result<(), DecodeError> {
        self.skip_space();
        if starts_with(self.rest(), name) {
            self.skip(name.len());
            Ok(())
        } else {
            Err(self.unexpected(clause, expected))
        }
    }

    /// Passes over a colon and the keyword behind it, in any case.
    pub(super) fn keyword<T: Copy>(
        &mut self,
        keywords: &Keywords<T>,
        clause: &'static str,
        expected: &'static str,
    ) -> Result<Keyword<T>, DecodeError> {
        let Some((b':', rest)) = self.rest().split_first() else {
            return Err(self.unexpected(clause, expected));
        };
        if starts_with(rest, USER_DEFINED) {
            self.skip(1 + USER_DEFINED.len());
            return Ok(Keyword::UserDefined);
        }
        let known = keywords.iter().find(|(name, ..)| starts_with(rest, name));
        let Some((name, _, parameter)) = known else {
            self.skip(1);
            return Err(self.unexpected(clause, expected));
        };
        self.skip(1 + name.len());
        Ok(Keyword::Known(*parameter))
    }

    /// A word, whatever it begins with, up to white space or a parenthesis. If keywords are given,
    /// one of them ends it too.
    pub(super) fn word<T>(
        &mut self,
        glued: Option<&Keywords<T>>,
        what: &'static str,
    ) -> Result<&'a str, DecodeError> {
        let rest = self.rest();
        let ends = |(place, byte): (usize, &u8)| {
            !is_token_byte(*byte)
                || (*byte == b':'
                    && place > 0
                    && glued.is_some_and(|keywords| {
                        let behind = rest.get(place + 1..).unwrap_or_default();
                        is_glued_keyword(behind, keywords)
                    }))
        };
        let len = rest.iter().enumerate().position(|at| ends((at.0, at.1)));
        let word = rest.get(..len.unwrap_or(rest.len())).unwrap_or_default();
        if word.is_empty() {
            return Err(self.unexpected(WORD, what));
        }
        let text = std::str::from_utf8(word).map_err(|error| {
            let offset = self.at + error.valid_up_to();
            DecodeError::new(offset, WORD, Problem::NotUtf8(what))
        })?;
        self.skip(word.len());
        Ok(text)
    }

    /// An expression as text: words and numbers as they stand, strings without their quotation
    /// marks, parenthesised expressions with all that is in them.
    pub(super) fn expression<T>(
        &mut self,
        glued: Option<&Keywords<T>>,
        what: &'static str,
    ) -> Result<Cow<'a, str>, DecodeError> {
        if self.peek() != Some(b'(') {
            return self.text(glued, what);
        }
        let start = self.at;
        let bytes = self.parenthesised(what)?;
        checked_text(Cow::Borrowed(bytes), start, what)
    }

    /// A word, a number or a string.
    pub(super) fn text<T>(
        &mut self,
        glued: Option<&Keywords<T>>,
        what: &'static str,
    ) -> Result<Cow<'a, str>, DecodeError> {
        let start = self.at;
        if !matches!(self.peek(), Some(b'"' | b'#')) {
            return self.word(glued, what).map(Cow::Borrowed);
        }
        let bytes = self.string(what)?;
        checked_text(bytes, start, what)
    }

    /// A string of either form, which must stand here. Borrowed unless it has escapes.
    pub(super) fn string(&mut self, what: &'static str) -> Result<Cow<'a, [u8]>, DecodeError> {
        if self.peek() == Some(b'#') {
            return self.counted(what).map(Cow::Borrowed);
        }
        let mut unescaped = Vec::new();
        let last = self.quoted(what, |piece| unescaped.extend_from_slice(piece))?;
        if unescaped.is_empty() {
            return Ok(Cow::Borrowed(last));
        }
        unescaped.extend_from_slice(last);
        Ok(Cow::Owned(unescaped))
    }

    /// A parenthesised expression, which must stand here, as it stands. Only its nesting is
    /// checked.
    pub(super) fn parenthesised(&mut self, what: &'static str) -> Result<&'a [u8], DecodeError> {
        let start = self.at;
        let mut depth = 0_usize;
        while let Some(byte) = self.peek() {
            match byte {
                b'(' => {
                    depth += 1;
                    if depth > MAX_EXPRESSION_DEPTH {
                        return Err(self.error(EXPRESSION, Problem::TooDeep("expressions")));
                    }
                    self.skip(1);
                }
                b')' => {
                    depth = depth.saturating_sub(1);
                    self.skip(1);
                    if depth == 0 {
                        return Ok(self.bytes.get(start..self.at).unwrap_or_default());
                    }
                }
                b'"' => {
                    self.quoted(what, |_| ())?;
                }
                b'#' => {
                    self.counted(what)?;
                }
                byte if is_token_byte(byte) => {
                    let word = self.rest().iter().take_while(|byte| is_token_byte(**byte));
                    self.skip(word.count());
                }
                byte if is_space(byte) => self.skip(1),
                _ => return Err(self.unexpected(EXPRESSION, what)),
            }
        }
        Err(self.error(EXPRESSION, Problem::Truncated(what)))
    }

    /// A `StringLiteral`: what is inside, behind the last escape; what is in front of that goes
    /// piece by piece to `unescaped`. A quotation mark behind a backslash always is an escape.
    fn quoted(
        &mut self,
        what: &'static str,
        mut unescaped: impl FnMut(&'a [u8]),
    ) -> Result<&'a [u8], DecodeError> {
        let inner = self.rest().get(1..).unwrap_or_default();
        let mut done = 0;
        for mark in memchr::memchr_iter(b'"', inner) {
            let before = inner.get(done..mark).unwrap_or_default();
            match before.split_last() {
                Some((b'\\', piece)) => {
                    unescaped(piece);
                    // The mark itself goes with the next piece, and is none that ends it.
                    unescaped(b"\"");
                    done = mark + 1;
                }
                _ => {
                    self.skip(mark + 2);
                    return Ok(before);
                }
            }
        }
        Err(self.error(STRING, Problem::Truncated(what)))
    }

    /// A `ByteLengthEncodedString`: `#n"` and as many bytes.
    fn counted(&mut self, what: &'static str) -> Result<&'a [u8], DecodeError> {
        let rest = self.rest().get(1..).unwrap_or_default();
        let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let number = rest.get(..digits).unwrap_or_default();
        let len = std::str::from_utf8(number)
            .ok()
            .and_then(|digits| digits.parse::<usize>().ok())
            .ok_or_else(|| self.error(STRING, Problem::Number))?;
        match rest.get(digits) {
            Some(b'"') => {}
            Some(_) => {
                self.skip(1 + digits);
                return Err(self.unexpected(STRING, "the quotation mark of a counted string"));
            }
            None => return Err(self.error(STRING, Problem::Truncated(what))),
        }
        let text = rest
            .get(digits + 1..)
            .and_then(|text| text.get(..len))
            .ok_or_else(|| self.error(STRING, Problem::Truncated(what)))?;
        self.skip(1 + digits + 1 + len);
        Ok(text)
    }

    pub(super) fn error(&self, clause: &'static str, problem: Problem) -> DecodeError {
        DecodeError::new(self.at, clause, problem)
    }

    /// What stands here, or that nothing does, is not what should.
    pub(super) fn unexpected(&self, clause: &'static str, expected: &'static str) -> DecodeError {
        match self.peek() {
            Some(found) => self.error(clause, Problem::Unexpected { found, expected }),
            None => self.error(clause, Problem::Truncated(expected)),
        }
    }
}

/// A keyword that was read.
pub(super) enum Keyword<T> {
    Known(T),
    /// `X-`: the name of the user-defined parameter follows.
    UserDefined,
}

const USER_DEFINED: &str = "X-";

fn checked_text<'a>(
    bytes: Cow<'a, [u8]>,
    start: usize,
    what: &'static str,
) -> Result<Cow<'a, str>, DecodeError> {
    let fails = |problem| DecodeError::new(start, STRING, problem);
    if memchr::memchr(0, &bytes).is_some() {
        return Err(fails(Problem::Nul(what)));
    }
    match bytes {
        Cow::Borrowed(bytes) => std::str::from_utf8(bytes).map(Cow::Borrowed).ok(),
        Cow::Owned(bytes) => String::from_utf8(bytes).map(Cow::Owned).ok(),
    }
    .ok_or_else(|| fails(Problem::NotUtf8(what)))
}

/// The text of a string in parentheses, as fipa_services wraps user-defined values: `(#n"…)`.
pub(super) fn unwrapped(text: &str) -> Option<&str> {
    let inner = text.strip_prefix("(#")?.strip_suffix(')')?;
    let (digits, inner) = inner.split_once('"')?;
    (digits.parse() == Ok(inner.len())).then_some(inner)
}

/// Whether a reader of fipa_services' text might find a keyword inside of a word.
pub(super) fn holds_keyword<T>(word: &str, keywords: &Keywords<T>) -> bool {
    memchr::memchr_iter(b':', word.as_bytes()).any(|colon| {
        let behind = word.as_bytes().get(colon + 1..).unwrap_or_default();
        starts_with(behind, USER_DEFINED)
            || keywords.iter().any(|(name, ..)| starts_with(behind, name))
    })
}

fn is_glued_keyword<T>(behind_colon: &[u8], keywords: &Keywords<T>) -> bool {
    if starts_with(behind_colon, USER_DEFINED) {
        // The next colon ends it, so that many of them do not cost quadratic time.
        let name = behind_colon
            .iter()
            .position(|byte| !is_token_byte(*byte) || *byte == b':');
        return name.is_some_and(|end| behind_colon.get(end) == Some(&b'('));
    }
    let known = keywords
        .iter()
        .find(|(name, ..)| starts_with(behind_colon, name));
    known.is_some_and(|(name, follows, _)| {
        let behind = behind_colon.get(name.len()..).unwrap_or_default();
        match (follows, behind) {
            (Follows::Parenthesis, [b'(', ..]) => true,
            (Follows::Counted, [b'#', digit, ..]) => digit.is_ascii_digit(),
            (Follows::DateTime, [b'+' | b'-' | b'0'..=b'9', ..]) => true,
            (Follows::Word, [byte, ..]) => is_token_byte(*byte),
            _ => false,
        }
    })
}

#[inline(always)]
fn starts_with(bytes: &[u8], name: &str) -> bool {
    // Most names begin otherwise, which is quickly found out.
    let (Some(one), Some(other)) = (bytes.first(), name.as_bytes().first()) else {
        return false;
    };
    (one ^ other) & !0x20 == 0 && starts_with_all(bytes, name)
}

#[inline(never)]
fn starts_with_all(bytes: &[u8], name: &str) -> bool {
    let name = name.as_bytes();
    // Nearly everybody writes small letters.
    bytes.starts_with(name)
        || bytes
            .get(..name.len())
            .is_some_and(|start| start.eq_ignore_ascii_case(name))
}

fn is_space(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t'..=b'\r')
}

fn is_token_byte(byte: u8) -> bool {
    byte > b' ' && byte != b'(' && byte != b')'
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: Option<&Keywords<()>> = None;

    fn text(bytes: &[u8]) -> Result<String, Problem> {
        let mut lexer = Lexer::new(bytes);
        let text = lexer.expression(NONE, "test");
        text.map(Cow::into_owned)
            .map_err(|error| error.problem().clone())
    }

    #[test]
    fn expressions_of_every_form() {
        for (bytes, expected) in [
            ("word rest", "word"),
            ("a\"b)", "a\"b"),
            ("-42.5e7)", "-42.5e7"),
            (r#""quo)ted" x"#, "quo)ted"),
            (r#""say \"hi\"""#, r#"say "hi""#),
            (r#""\"""#, "\""),
            (r#""la\ng""#, r"la\ng"),
            (r#""""#, ""),
            ("#5\"a)\"b()", "a)\"b("),
            ("#0\")", ""),
            (r#"(a (b "c)" #2")))) x"#, r#"(a (b "c)" #2"))))"#),
        ] {
            assert_eq!(text(bytes.as_bytes()).as_deref(), Ok(expected), "{bytes}");
        }
    }

    #[test]
    fn nonsense_is_refused() {
        for (bytes, problem) in [
            (&b""[..], Problem::Truncated("test")),
            (b"\"a", Problem::Truncated("test")),
            (b"\"a\\\"", Problem::Truncated("test")),
            (b"#3\"ab", Problem::Truncated("test")),
            (b"#3", Problem::Truncated("test")),
            (b"#99999999999999999999999\"a", Problem::Number),
            (b"#a", Problem::Number),
            (b"(a", Problem::Truncated("test")),
            (b"\"\0\"", Problem::Nul("test")),
            (b"\"\xff\"", Problem::NotUtf8("test")),
            (b"\xff ", Problem::NotUtf8("test")),
        ] {
            assert_eq!(text(bytes), Err(problem), "{bytes:?}");
        }
        let deep = |depth| [b"(".repeat(depth), b")".repeat(depth)].concat();
        assert!(text(&deep(MAX_EXPRESSION_DEPTH)).is_ok());
        let deeper = text(&deep(MAX_EXPRESSION_DEPTH + 1));
        assert_eq!(deeper, Err(Problem::TooDeep("expressions")));
    }

    #[test]
    fn a_word_ends_at_a_keyword_that_has_its_value_behind_it() {
        let keywords: &Keywords<()> = &[
            ("sender", Follows::Parenthesis, ()),
            ("content", Follows::Counted, ()),
        ];
        for (bytes, word) in [
            ("inform:sender(", "inform"),
            ("inform:content#1\"", "inform"),
            ("a:b:content#1\"", "a:b"),
            ("inform:X-prio(", "inform"),
            ("my:sender x", "my:sender"),
            ("my:contents", "my:contents"),
            ("a:X-b:X-c", "a:X-b:X-c"),
            (":sender(", ":sender"),
        ] {
            let found = Lexer::new(bytes.as_bytes()).word(Some(keywords), "test");
            assert_eq!(found, Ok(word), "{bytes}");
        }
        assert!(holds_keyword("a:CONTENTS", keywords) && !holds_keyword("content", keywords));
    }

    #[test]
    fn user_defined_values_are_unwrapped() {
        assert_eq!(unwrapped("(#3\"a\")"), None);
        assert_eq!(unwrapped("(#2\"a\")"), Some("a\""));
        assert_eq!(unwrapped("(a)"), None);
    }
}
