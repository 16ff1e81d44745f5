//! Tokens of the string encoding: white space, words, strings, expressions.

use crate::Text;
use crate::error::{DecodeError, Problem};
use crate::scan::{self, TOPS};

/// Deepest nesting of expressions that is accepted.
pub(super) const MAX_EXPRESSION_DEPTH: usize = 64;

/// No keyword is longer, with what follows it. Without a bound, one that is followed by no blank would
/// be looked for in all that is left.
const NEAR: usize = 16;

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
    /// Those that were not read yet.
    rest: &'a [u8],
}

impl<'a> Lexer<'a> {
    pub(super) fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, rest: bytes }
    }

    /// Bytes read so far.
    pub(super) fn offset(&self) -> usize {
        self.bytes.len() - self.rest.len()
    }

    pub(super) fn rest(&self) -> &'a [u8] {
        self.rest
    }

    /// What was read since `start`, a former [`offset`](Self::offset).
    pub(super) fn since(&self, start: usize) -> &'a [u8] {
        self.bytes.get(start..self.offset()).unwrap_or_default()
    }

    pub(super) fn peek(&self) -> Option<u8> {
        self.rest.first().copied()
    }

    /// Passes over as many bytes, which the caller has seen to be there.
    pub(super) fn skip(&mut self, bytes: usize) {
        self.rest = self.rest.get(bytes..).unwrap_or_default();
    }

    /// Passes over white space and says whether there was any.
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

    /// Passes over white space and the byte, if it stands there.
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
        // Nearly everybody writes small letters, and a blank or a parenthesis behind them.
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

    /// A word, whatever it begins with, up to white space or a parenthesis. If keywords are given,
    /// one of them ends it too.
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

    /// An expression as text: words and numbers as they stand, strings without their quotation
    /// marks, parenthesised expressions with all that is in them.
    pub(super) fn expression<T>(
        &mut self,
        terminators: Option<&Keywords<T>>,
        what: &'static str,
    ) -> Result<Text<'a>, DecodeError> {
        if self.peek() != Some(b'(') {
            return self.text(terminators, what);
        }
        let start = self.offset();
        let text = Text::plain(self.parenthesised(what)?);
        check_text(&text, start, what)?;
        Ok(text)
    }

    /// A word, a number or a string.
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

    /// A parenthesised expression, which must stand here, as it stands. Only its nesting is
    /// checked.
    pub(super) fn parenthesised(&mut self, what: &'static str) -> Result<&'a [u8], DecodeError> {
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

    /// A `StringLiteral`, which must stand here: what is inside, and whether there are escapes in
    /// it. A quotation mark behind a backslash always is one.
    pub(super) fn quoted(&mut self, what: &'static str) -> Result<(&'a [u8], bool), DecodeError> {
        let inside = self.rest.get(1..).unwrap_or_default();
        let mut from = 0;
        while let Some(found) = inside
            .get(from..)
            .and_then(|rest| scan::find_byte(rest, b'"'))
        {
            let mark = from + found;
            let inner = inside.get(..mark).unwrap_or_default();
            if found == 0 || inner.last() != Some(&b'\\') {
                self.skip(mark + 2);
                return Ok((inner, from > 0));
            }
            from = mark + 1;
        }
        Err(self.error(STRING, Problem::Truncated(what)))
    }

    /// A `ByteLengthEncodedString`: `#n"` and as many bytes.
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

/// The text of a string in parentheses, as fipa_services wraps user-defined values: `(#n"…)`.
pub(super) fn unwrapped<'a>(text: &Text<'a>) -> Option<Text<'a>> {
    let inner = text.raw().strip_prefix(b"(")?.strip_suffix(b")")?;
    let mut lexer = Lexer::new(inner);
    (lexer.peek() == Some(b'#')).then_some(())?;
    let counted = lexer.counted("").ok()?;
    lexer.rest().is_empty().then_some(Text::plain(counted))
}

/// Whether a reader of fipa_services' text might find a keyword inside of a word.
pub(super) fn holds_keyword<T>(word: &str, keywords: &Keywords<T>) -> bool {
    memchr::memchr_iter(b':', word.as_bytes()).any(|colon| {
        let behind = word.as_bytes().get(colon + 1..).unwrap_or_default();
        starts_with(behind, USER_DEFINED)
            || keywords.iter().any(|(name, ..)| starts_with(behind, name))
    })
}

/// Where the word at the beginning of the bytes ends, a keyword behind its first byte ending it too.
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
        text.map(|text| text.to_string())
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
