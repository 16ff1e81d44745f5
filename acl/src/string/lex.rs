//! Tokens of the string encoding: white space, words, strings, expressions.

use crate::Text;
use crate::error::{DecodeError, Problem};
use crate::scan::{self, TOPS};

/// Maximum nesting depth of expressions that the reader accepts.
pub(super) const MAX_EXPRESSION_DEPTH: usize = 64;

/// Number of bytes in which the end of a keyword is searched. No keyword is longer. The bound keeps
/// the time linear for input without blanks.
const NEAR: usize = 16;

const WORD: &str = "FIPA00070 Word";
const STRING: &str = "FIPA00070 String";
const EXPRESSION: &str = "FIPA00070 Expression";

/// The text that must follow a keyword without white space in front, to tell it from a part of a
/// word. fipa_services writes no white space, and a word may contain colons.
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
    /// The keyword never follows a word.
    Never,
}

/// The keywords that are allowed at a position, without their colon.
pub(super) type Keywords<T> = [(&'static str, Follows, T)];

/// Reads the tokens of a message in one pass.
pub(super) struct Lexer<'a> {
    bytes: &'a [u8],
    /// The bytes that were not read yet.
    rest: &'a [u8],
}

impl<'a> Lexer<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, rest: bytes }
    }

    /// Number of bytes read.
    pub(super) fn offset(&self) -> usize {
        self.bytes.len() - self.rest.len()
    }

    pub(super) fn rest(&self) -> &'a [u8] {
        self.rest
    }

    /// The bytes read since `start`, an earlier [`offset`](Self::offset).
    pub(super) fn since(&self, start: usize) -> &'a [u8] {
        self.bytes.get(start..self.offset()).unwrap_or_default()
    }

    pub(super) fn peek(&self) -> Option<u8> {
        self.rest.first().copied()
    }

    /// Skips a number of bytes. The caller has checked that they exist.
    pub(super) fn skip(&mut self, bytes: usize) {
        self.rest = self.rest.get(bytes..).unwrap_or_default();
    }

    /// Skips white space. Returns whether there was any.
    #[inline]
    pub(super) fn skip_space(&mut self) -> bool {
        match self.rest {
            [b' ', rest @ ..] if rest.first().is_some_and(|byte| *byte > b' ') => {
                self.rest = rest;
                true
            }
            [..=b' ', ..] => self.skip_more_space(),
            _ => false,
        }
    }

    #[inline(never)]
    fn skip_more_space(&mut self) -> bool {
        let before = self.rest.len();
        while let Some((byte, rest)) = self.rest.split_first()
            && is_space(*byte)
        {
            self.rest = rest;
        }
        self.rest.len() < before
    }

    /// Skips white space, and the byte if it is next. Returns whether it was.
    pub(super) fn accept(&mut self, byte: u8) -> bool {
        self.skip_space();
        match self.rest.split_first() {
            Some((next, rest)) if *next == byte => {
                self.rest = rest;
                true
            }
            _ => false,
        }
    }

    /// Skips white space and an opening parenthesis, which must be next.
    pub(super) fn open(&mut self, clause: &'static str) -> Result<(), DecodeError> {
        if self.accept(b'(') {
            Ok(())
        } else {
            Err(self.unexpected(clause, "an opening parenthesis"))
        }
    }

    /// Skips white space and a name, which must be next, in any case.
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

    /// Reads a colon and the keyword behind it, in any case.
    #[inline]
    pub(super) fn keyword<T: Copy>(
        &mut self,
        keywords: &Keywords<T>,
        of: impl Fn(&[u8]) -> Option<T>,
        clause: &'static str,
        expected: &'static str,
    ) -> Result<Keyword<T>, DecodeError> {
        let Some((b':', rest)) = self.rest().split_first() else {
            return Err(self.unexpected(clause, expected));
        };
        // The common case: lowercase letters, and then a blank or a parenthesis.
        let near = rest.get(..NEAR).unwrap_or(rest);
        if let Some(len) = scan::find(near, scan::no_token, |byte| !is_token_byte(byte))
            && let Some((name, behind)) = rest.split_at_checked(len)
            && let Some(parameter) = of(name)
        {
            self.rest = behind;
            return Ok(Keyword::Known(parameter));
        }
        self.keyword_slow(keywords, clause, expected)
    }

    #[inline(never)]
    fn keyword_slow<T: Copy>(
        &mut self,
        keywords: &Keywords<T>,
        clause: &'static str,
        expected: &'static str,
    ) -> Result<Keyword<T>, DecodeError> {
        let rest = self.rest.get(1..).unwrap_or_default();
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

    /// Reads a word up to white space, a parenthesis, or one of the keywords `terminators`. Its first
    /// character is not checked.
    pub(super) fn word<T>(
        &mut self,
        terminators: Option<&Keywords<T>>,
        what: &'static str,
    ) -> Result<Text<'a>, DecodeError> {
        let len = match terminators {
            Some(keywords) => len_to_keyword(self.rest, keywords),
            None => scan::find(self.rest, scan::no_token, |byte| !is_token_byte(byte)),
        };
        let word = self.rest.get(..len.unwrap_or(self.rest.len()));
        let word = word.unwrap_or_default();
        if word.is_empty() {
            return Err(self.unexpected(WORD, what));
        }
        if !word.is_ascii()
            && let Err(error) = std::str::from_utf8(word)
        {
            let offset = self.offset() + error.valid_up_to();
            return Err(DecodeError::new(offset, WORD, Problem::NotUtf8(what)));
        }
        self.skip(word.len());
        Ok(Text::plain(word))
    }

    /// Reads an expression as text: words and numbers unchanged, strings without their quotation
    /// marks, expressions in parentheses unchanged.
    pub(super) fn expression<T>(
        &mut self,
        terminators: Option<&Keywords<T>>,
        what: &'static str,
    ) -> Result<Text<'a>, DecodeError> {
        if self.peek() != Some(b'(') {
            return self.text(terminators, what);
        }
        let start = self.offset();
        let text = Text::plain(self.parenthesized(what)?);
        check_text(&text, start, what)?;
        Ok(text)
    }

    /// Reads a word, a number or a string.
    pub(super) fn text<T>(
        &mut self,
        terminators: Option<&Keywords<T>>,
        what: &'static str,
    ) -> Result<Text<'a>, DecodeError> {
        let start = self.offset();
        let text = match self.peek() {
            Some(b'"') => {
                let (inner, escaped) = self.quoted(what)?;
                if escaped {
                    Text::quoted(inner)
                } else {
                    Text::plain(inner)
                }
            }
            Some(b'#') => Text::plain(self.counted(what)?),
            _ => return self.word(terminators, what),
        };
        check_text(&text, start, what)?;
        Ok(text)
    }

    /// Reads an expression in parentheses, which must be next. Only its tokens and its nesting are
    /// checked.
    pub(super) fn parenthesized(&mut self, what: &'static str) -> Result<&'a [u8], DecodeError> {
        let start = self.offset();
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
                        return Ok(self.since(start));
                    }
                }
                b'"' => {
                    self.quoted(what)?;
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

    /// Reads a `StringLiteral`, which must be next. Returns its inside, and whether that has escapes.
    /// A quotation mark behind a backslash is always an escape.
    pub(super) fn quoted(&mut self, what: &'static str) -> Result<(&'a [u8], bool), DecodeError> {
        let literal = literal(self.rest);
        let literal = literal.ok_or_else(|| self.error(STRING, Problem::Truncated(what)))?;
        self.skip(literal.len);
        Ok((literal.inner, literal.escaped))
    }

    /// Reads a `StringLiteral` that may be content of JADE, which must be next. Returns its inside, and
    /// whether that has escapes.
    ///
    /// JADE writes content that ends in a backslash as `"…\"`, a blank and a line break. That ending
    /// counts if the literal has no other one, or if its other one is the beginning of a later string.
    pub(super) fn quoted_content(
        &mut self,
        what: &'static str,
    ) -> Result<(&'a [u8], bool), DecodeError> {
        const ENDING: &[u8] = b"\\\" \n";
        let found = literal(self.rest);
        let len = match &found {
            Some(literal) if !literal.escaped => return self.quoted(what),
            Some(literal) => literal.len,
            None => self.rest.len(),
        };
        let behind = self.rest.get(len..).unwrap_or_default();
        let is_end = |byte: u8| is_space(byte) || matches!(byte, b')' | b':');
        if found.is_some() && behind.first().is_none_or(|byte| is_end(*byte)) {
            return self.quoted(what);
        }
        let inside = self.rest.get(1..len).unwrap_or_default();
        let Some(backslash) = memchr::memmem::rfind(inside, ENDING) else {
            return self.quoted(what);
        };
        let inner = inside.get(..=backslash).unwrap_or_default();
        // The opening quotation mark, the inside and the closing quotation mark.
        self.skip(1 + inner.len() + 1);
        Ok((inner, memchr::memmem::find(inner, b"\\\"").is_some()))
    }

    /// Reads a `ByteLengthEncodedString`: `#n"` and n bytes.
    pub(super) fn counted(&mut self, what: &'static str) -> Result<&'a [u8], DecodeError> {
        let rest = self.rest().get(1..).unwrap_or_default();
        let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let number = rest.get(..digits).filter(|digits| !digits.is_empty());
        let len = number
            .and_then(|digits| {
                digits.iter().try_fold(0_usize, |number, digit| {
                    number
                        .checked_mul(10)?
                        .checked_add(usize::from(digit - b'0'))
                })
            })
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
        DecodeError::new(self.offset(), clause, problem)
    }

    /// Returns the error for a wrong next byte, or for a missing one.
    pub(super) fn unexpected(&self, clause: &'static str, expected: &'static str) -> DecodeError {
        match self.peek() {
            Some(found) => self.error(clause, Problem::Unexpected { found, expected }),
            None => self.error(clause, Problem::Truncated(expected)),
        }
    }
}

/// A `StringLiteral` at the beginning of bytes.
struct Literal<'a> {
    inner: &'a [u8],
    /// Number of bytes with the quotation marks.
    len: usize,
    escaped: bool,
}

/// Finds the end of the literal that the bytes begin with. A quotation mark behind a backslash is
/// always an escape.
fn literal(bytes: &[u8]) -> Option<Literal<'_>> {
    let inside = bytes.get(1..)?;
    let mut from = 0;
    loop {
        let found = scan::find_byte(inside.get(from..)?, b'"')?;
        let mark = from + found;
        let inner = inside.get(..mark).unwrap_or_default();
        if found == 0 || inner.last() != Some(&b'\\') {
            return Some(Literal {
                inner,
                len: mark + 2,
                escaped: from > 0,
            });
        }
        from = mark + 1;
    }
}

/// A keyword that was read.
pub(super) enum Keyword<T> {
    Known(T),
    /// `X-`: the name of the user-defined parameter follows.
    UserDefined,
}

const USER_DEFINED: &str = "X-";

fn check_text(text: &Text<'_>, start: usize, what: &'static str) -> Result<(), DecodeError> {
    let bytes = text.raw();
    let odd = |word| (scan::zero(word) | word) & TOPS;
    if !scan::any(bytes, odd) {
        return Ok(());
    }
    let fails = |problem| Err(DecodeError::new(start, STRING, problem));
    if memchr::memchr(0, bytes).is_some() {
        return fails(Problem::Nul(what));
    }
    match std::str::from_utf8(bytes) {
        Ok(_) => Ok(()),
        Err(_) => fails(Problem::NotUtf8(what)),
    }
}

/// Returns the text of a string in parentheses, the form in which fipa_services writes user-defined
/// values: `(#n"…)`.
pub(super) fn unwrapped<'a>(text: &Text<'a>) -> Option<Text<'a>> {
    let inner = text.raw().strip_prefix(b"(")?.strip_suffix(b")")?;
    let mut lexer = Lexer::new(inner);
    (lexer.peek() == Some(b'#')).then_some(())?;
    let counted = lexer.counted("").ok()?;
    lexer.rest().is_empty().then_some(Text::plain(counted))
}

/// Whether a reader that expects no white space may find a keyword inside the word.
pub(super) fn holds_keyword<T>(word: &str, keywords: &Keywords<T>) -> bool {
    memchr::memchr_iter(b':', word.as_bytes()).any(|colon| {
        let behind = word.as_bytes().get(colon + 1..).unwrap_or_default();
        starts_with(behind, USER_DEFINED)
            || keywords.iter().any(|(name, ..)| starts_with(behind, name))
    })
}

/// Returns the length of the word at the beginning of the bytes. A keyword behind its first byte ends
/// it.
fn len_to_keyword<T>(bytes: &[u8], keywords: &Keywords<T>) -> Option<usize> {
    let marks = |word| scan::no_token(word) | scan::is(word, b':');
    let ends = |byte: u8| !is_token_byte(byte) || byte == b':';
    let mut from = 0;
    loop {
        let at = from + scan::find(bytes.get(from..)?, marks, ends)?;
        if bytes.get(at) != Some(&b':') {
            return Some(at);
        }
        let behind = bytes.get(at + 1..).unwrap_or_default();
        if at > 0 && is_keyword_with_value(behind, keywords) {
            return Some(at);
        }
        from = at + 1;
    }
}

fn is_keyword_with_value<T>(behind_colon: &[u8], keywords: &Keywords<T>) -> bool {
    if starts_with(behind_colon, USER_DEFINED) {
        // The next colon ends the name. Otherwise many colons would cost quadratic time.
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
    // Most names differ in the first letter, which is fast to check.
    let (Some(one), Some(other)) = (bytes.first(), name.as_bytes().first()) else {
        return false;
    };
    (one ^ other) & !0x20 == 0 && starts_with_all(bytes, name)
}

#[inline(never)]
fn starts_with_all(bytes: &[u8], name: &str) -> bool {
    let name = name.as_bytes();
    // Lowercase letters are the common case.
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
        text.map(|text| text.to_string())
            .map_err(|error| error.problem().clone())
    }

    #[test]
    fn every_form_of_expression_is_read() {
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
    fn malformed_expressions_are_refused() {
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
    fn a_keyword_with_its_value_ends_a_word() {
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
            assert_eq!(found.unwrap(), word, "{bytes}");
        }
        assert!(holds_keyword("a:CONTENTS", keywords) && !holds_keyword("content", keywords));
    }

    #[test]
    fn user_defined_values_are_unwrapped() {
        let inside = |text: &'static str| unwrapped(&Text::plain(text.as_bytes()));
        assert_eq!(inside("(#3\"a\")"), None);
        assert_eq!(inside("(#2\"a\")"), Some(Text::plain(b"a\"")));
        assert_eq!(inside("(a)"), None);
    }
}
