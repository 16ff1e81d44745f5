//! Tokens of SL (FIPA00008 clause 2.1).

use std::borrow::Cow;

use base64::Engine as _;
use base64::alphabet;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use fipa_acl::Time;

use crate::SlDialect;
use crate::chars::{begins_number, begins_word, is_delimiter, is_white};
use crate::error::{ParseError, Problem};
use crate::number::{self, Number};

const WORD: &str = "FIPA00008 Word";
const STRING: &str = "FIPA00008 String";
const NUMBER: &str = "FIPA00008 NumericalConstant";
const DATE_TIME: &str = "FIPA00008 DateTime";
const TOKEN: &str = "FIPA00008 2.1";

/// JADE reads Base64 with and without padding.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &alphabet::STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);

/// A token with its text, borrowed where it has no escapes.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Token<'a> {
    Open,
    Close,
    /// An unquoted word, which can be a keyword.
    Word(&'a str),
    /// A string literal, or a byte-length encoded string that is text.
    Literal(Cow<'a, str>),
    /// A byte-length encoded string that is not text.
    Bytes(Cow<'a, [u8]>),
    /// `?name`
    Variable(Cow<'a, str>),
    /// `:name`
    Parameter(Cow<'a, str>),
    /// `??name`, without the question marks.
    Meta(Cow<'a, str>),
    Number(Number<'a>),
    DateTime(Time),
    End,
}

impl Token<'_> {
    /// The kind of the token, for errors.
    pub(crate) fn kind(&self) -> &'static str {
        match self {
            Self::Open => "'('",
            Self::Close => "')'",
            Self::Word(_) => "word",
            Self::Literal(_) => "string",
            Self::Bytes(_) => "byte string",
            Self::Variable(_) => "variable",
            Self::Parameter(_) => "parameter name",
            Self::Meta(_) => "meta-symbol",
            Self::Number(_) => "number",
            Self::DateTime(_) => "date-time",
            Self::End => "end",
        }
    }
}

/// Splits the bytes into tokens in one pass.
#[derive(Debug, Clone)]
pub(crate) struct Lexer<'a> {
    bytes: &'a [u8],
    /// The bytes as text, if they are valid UTF-8. Tokens then need no separate check.
    text: Option<&'a str>,
    at: usize,
    dialect: SlDialect,
}

impl<'a> Lexer<'a> {
    pub(crate) fn new(bytes: &'a [u8], dialect: SlDialect) -> Self {
        Self {
            bytes,
            text: std::str::from_utf8(bytes).ok(),
            at: 0,
            dialect,
        }
    }

    pub(crate) fn dialect(&self) -> SlDialect {
        self.dialect
    }

    /// Returns the number of bytes read so far.
    pub(crate) fn offset(&self) -> usize {
        self.at
    }

    /// Returns the number of unread bytes.
    pub(crate) fn remaining(&self) -> usize {
        self.bytes.len() - self.at
    }

    /// Returns the bytes since `start`, an earlier [`offset`](Self::offset).
    pub(crate) fn since(&self, start: usize) -> &'a [u8] {
        self.bytes.get(start..self.at).unwrap_or_default()
    }

    /// Skips white space and returns the first byte of the next token.
    #[inline]
    pub(crate) fn peek(&mut self) -> Option<u8> {
        loop {
            let byte = *self.bytes.get(self.at)?;
            if !is_white(byte) {
                return Some(byte);
            }
            self.at += 1;
        }
    }

    /// Skips the byte that [`peek`](Self::peek) returned.
    #[inline]
    pub(crate) fn bump(&mut self) {
        self.at += 1;
    }

    /// Reads the next token.
    pub(crate) fn next(&mut self) -> Result<Token<'a>, ParseError> {
        let Some(first) = self.peek() else {
            return Ok(Token::End);
        };
        match first {
            b'(' => {
                self.bump();
                Ok(Token::Open)
            }
            b')' => {
                self.bump();
                Ok(Token::Close)
            }
            b'"' => self.quoted().map(Token::Literal),
            b'#' => self.counted(),
            b':' => {
                self.bump();
                self.name("parameter name").map(Token::Parameter)
            }
            b'?' => {
                self.bump();
                if self.bytes.get(self.at) == Some(&b'?') {
                    self.bump();
                    return self.name("meta-symbol").map(Token::Meta);
                }
                self.name("variable").map(Token::Variable)
            }
            _ => self.bare(),
        }
    }

    /// Reads a word, a number or a date-time.
    fn bare(&mut self) -> Result<Token<'a>, ParseError> {
        let start = self.at;
        let bytes = self.run();
        if begins_word(bytes) || bytes == b"-" {
            // JADE has the function symbol `-`.
            return self.text_of(start, bytes, "word", WORD).map(Token::Word);
        }
        if !begins_number(bytes) {
            let byte = bytes.first().or(self.bytes.get(start)).copied();
            let problem = Problem::Byte(byte.unwrap_or_default());
            return Err(ParseError::new(start, TOKEN, problem));
        }
        if number::is_number(bytes) {
            let text = self.text_of(start, bytes, "number", NUMBER)?;
            return Ok(Token::Number(Number::checked(text)));
        }
        if is_date_time(bytes) {
            let text = self.text_of(start, bytes, "date-time", DATE_TIME)?;
            let time = text
                .parse()
                .map_err(|_| ParseError::new(start, DATE_TIME, Problem::DateTime))?;
            return Ok(Token::DateTime(time));
        }
        Err(ParseError::new(start, NUMBER, Problem::Number))
    }

    /// Returns the unread bytes.
    #[inline]
    pub(crate) fn rest(&self) -> &'a [u8] {
        self.bytes.get(self.at..).unwrap_or_default()
    }

    /// Reads this number of bytes, if a token ends after them.
    #[inline]
    pub(crate) fn take(&mut self, len: usize) -> Option<&'a [u8]> {
        let (taken, behind) = self.rest().split_at_checked(len)?;
        if behind.first().is_some_and(|byte| !is_delimiter(*byte)) {
            return None;
        }
        self.at += len;
        Some(taken)
    }

    /// Reads a word that starts here, if there is one.
    #[inline]
    pub(crate) fn word(&mut self) -> Result<Option<&'a str>, ParseError> {
        let start = self.at;
        let bytes = self.run();
        if !begins_word(bytes) {
            self.at = start;
            return Ok(None);
        }
        self.text_of(start, bytes, "word", WORD).map(Some)
    }

    /// Returns the bytes up to the next delimiter.
    #[inline]
    pub(crate) fn run(&mut self) -> &'a [u8] {
        let rest = self.rest();
        let len = rest
            .iter()
            .position(|byte| is_delimiter(*byte))
            .unwrap_or(rest.len());
        self.at += len;
        rest.get(..len).unwrap_or(rest)
    }

    /// Reads the name of a parameter or variable: a string in any notation.
    pub(crate) fn name(&mut self, what: &'static str) -> Result<Cow<'a, str>, ParseError> {
        match self.bytes.get(self.at) {
            Some(b'"') => return self.quoted(),
            Some(b'#') => {
                let start = self.at;
                return match self.counted()? {
                    Token::Literal(text) => Ok(text),
                    _ => Err(ParseError::new(start, STRING, Problem::NotUtf8(what))),
                };
            }
            _ => {}
        }
        let start = self.at;
        let bytes = self.run();
        if bytes.is_empty() {
            return Err(match self.bytes.get(self.at) {
                Some(byte) => ParseError::new(self.at, WORD, Problem::Byte(*byte)),
                None => ParseError::new(self.at, WORD, Problem::Truncated(what)),
            });
        }
        if !begins_word(bytes) {
            let problem = Problem::Byte(bytes.first().copied().unwrap_or_default());
            return Err(ParseError::new(start, WORD, problem));
        }
        self.text_of(start, bytes, what, WORD).map(Cow::Borrowed)
    }

    /// Reads a string in quotation marks, in which `\"` stands for a quotation mark.
    ///
    /// JADE writes a string that ends in a backslash as `"…\"`. As JADE reads it, that ends the string
    /// if no other quotation mark does.
    pub(crate) fn quoted(&mut self) -> Result<Cow<'a, str>, ParseError> {
        self.bump();
        let start = self.at;
        let rest = self.bytes.get(start..).unwrap_or_default();
        let mut end = 0;
        let mut escaped = false;
        loop {
            let behind = rest.get(end..).unwrap_or_default();
            let Some(found) = memchr::memchr(b'"', behind) else {
                if escaped && self.dialect == SlDialect::Jade {
                    break;
                }
                return Err(ParseError::new(
                    start - 1,
                    STRING,
                    Problem::Truncated("string"),
                ));
            };
            let quote = end + found;
            end = quote + 1;
            if quote == 0 || rest.get(quote - 1) != Some(&b'\\') {
                break;
            }
            escaped = true;
        }
        self.at = start + end;
        let inner = rest.get(..end - 1).unwrap_or_default();
        let text = self.text_of(start, inner, "string", STRING)?;
        Ok(if escaped {
            Cow::Owned(text.replace("\\\"", "\""))
        } else {
            Cow::Borrowed(text)
        })
    }

    /// Reads a byte-length encoded string: `#n"` and n bytes.
    pub(crate) fn counted(&mut self) -> Result<Token<'a>, ParseError> {
        let start = self.at;
        self.bump();
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
        let (digits, rest) = rest.split_at_checked(digits).unwrap_or((rest, &[]));
        let [b'"', rest @ ..] = rest else {
            let problem = match rest.first() {
                Some(byte) => Problem::Byte(*byte),
                None => Problem::Truncated("byte-length encoded string"),
            };
            return Err(ParseError::new(self.at + digits.len(), STRING, problem));
        };
        let len = number::integer(digits)
            .ok_or_else(|| ParseError::new(start, STRING, Problem::Number))?
            .1;
        let taken = usize::try_from(len).ok().and_then(|len| rest.get(..len));
        let Some(taken) = taken else {
            let problem = Problem::Truncated("byte-length encoded string");
            return Err(ParseError::new(start, STRING, problem));
        };
        let first = self.at + digits.len() + 1;
        self.at = first + taken.len();
        if self.dialect == SlDialect::Jade {
            return match BASE64.decode(taken) {
                Ok(bytes) => Ok(Token::Bytes(Cow::Owned(bytes))),
                Err(_) => Err(ParseError::new(first, "JADE String", Problem::Base64)),
            };
        }
        // A count may end within a character, so these bytes need a separate check.
        Ok(match std::str::from_utf8(taken) {
            Ok(text) => Token::Literal(Cow::Borrowed(text)),
            Err(_) => Token::Bytes(Cow::Borrowed(taken)),
        })
    }

    /// Returns the text of bytes that start at `start`.
    #[inline]
    pub(crate) fn text_of(
        &self,
        start: usize,
        bytes: &'a [u8],
        what: &'static str,
        clause: &'static str,
    ) -> Result<&'a str, ParseError> {
        if let Some(text) = self.text
            && let Some(text) = text.get(start..start + bytes.len())
        {
            return Ok(text);
        }
        std::str::from_utf8(bytes)
            .map_err(|_| ParseError::new(start, clause, Problem::NotUtf8(what)))
    }
}

/// Whether the bytes have the form of a date-time: `[+-]YYYYMMDDThhmmssmmm[Z]`.
fn is_date_time(bytes: &[u8]) -> bool {
    let bytes = match bytes {
        [b'+' | b'-', rest @ ..] => rest,
        rest => rest,
    };
    let Some((date, [b'T' | b't', rest @ ..])) = bytes.split_first_chunk::<8>() else {
        return false;
    };
    let Some((time, designator)) = rest.split_first_chunk::<9>() else {
        return false;
    };
    date.iter().chain(time).all(u8::is_ascii_digit)
        && matches!(designator, [] | [b'a'..=b'z' | b'A'..=b'Z'])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tokens(bytes: &[u8]) -> Result<Vec<Token<'_>>, ParseError> {
        let mut lexer = Lexer::new(bytes, SlDialect::Standard);
        let mut tokens = Vec::new();
        loop {
            match lexer.next()? {
                Token::End => return Ok(tokens),
                token => tokens.push(token),
            }
        }
    }

    #[test]
    fn the_last_string_of_jade_may_end_in_a_backslash() {
        let first = |dialect, bytes| Lexer::new(bytes, dialect).next();
        let text = br#""C:\logs\"))"#;
        let read = first(SlDialect::Jade, text);
        assert_eq!(read, Ok(Token::Literal(r"C:\logs\".into())));
        let text = br#""say \"hi\" \"))"#;
        let read = first(SlDialect::Jade, text);
        assert_eq!(read, Ok(Token::Literal(r#"say "hi" \"#.into())));
        let refused = first(SlDialect::Standard, text).unwrap_err();
        assert_eq!(refused.problem(), &Problem::Truncated("string"));
    }

    #[test]
    fn tokens_of_every_kind() {
        use Token::{Close, DateTime, Literal, Meta, Open, Parameter, Variable, Word};
        let text = "(a:b\t:p ?v \"q\\\"\" #3\"a\") :\"x y\" ?\"u\" ??m 20000508T042651481Z)\n-";
        let time = "20000508T042651481Z".parse().unwrap();
        assert_eq!(
            tokens(text.as_bytes()).unwrap(),
            [
                Open,
                Word("a:b"),
                Parameter("p".into()),
                Variable("v".into()),
                Literal("q\"".into()),
                Literal("a\")".into()),
                Parameter("x y".into()),
                Variable("u".into()),
                Meta("m".into()),
                DateTime(time),
                Close,
                Word("-"),
            ]
        );
        assert_eq!(
            tokens(b"#2\"\xff(").unwrap(),
            [Token::Bytes(b"\xff("[..].into())]
        );
        let numbers = tokens(b"-1 0x1F 1.5e3 .5").unwrap();
        assert!(
            numbers
                .iter()
                .all(|token| matches!(token, Token::Number(_)))
        );
    }

    #[test]
    fn a_count_that_ends_within_a_character_gives_bytes() {
        let text = "#1\"é".as_bytes();
        let mut lexer = Lexer::new(text, SlDialect::Standard);
        assert_eq!(lexer.next(), Ok(Token::Bytes(text[3..4].into())));
        let error = lexer.next().unwrap_err();
        assert_eq!(error.problem(), &Problem::NotUtf8("word"));
    }

    #[test]
    fn byte_strings_of_jade_are_base64() {
        let mut lexer = Lexer::new(b"#4\"aGk= #4\"a!!!", SlDialect::Jade);
        assert_eq!(lexer.next(), Ok(Token::Bytes(b"hi"[..].into())));
        let error = lexer.next().unwrap_err();
        assert_eq!((error.offset(), error.problem()), (11, &Problem::Base64));
    }

    #[test]
    fn nonsense_is_refused_where_it_stands() {
        for (bytes, offset, problem) in [
            (&b" \"a"[..], 1, Problem::Truncated("string")),
            (b"\"a\\\"", 0, Problem::Truncated("string")),
            (
                b"#3\"ab",
                0,
                Problem::Truncated("byte-length encoded string"),
            ),
            (b"#3", 2, Problem::Truncated("byte-length encoded string")),
            (b"#x", 1, Problem::Byte(b'x')),
            (b"#\"x", 0, Problem::Number),
            (
                b"#340282366920938463463374607431768211456\"",
                0,
                Problem::Number,
            ),
            (b"a 1x", 2, Problem::Number),
            (b"-a", 0, Problem::Byte(b'-')),
            (b"20001308T042651481", 0, Problem::DateTime),
            (b"\x00", 0, Problem::Byte(0)),
            (b":", 1, Problem::Truncated("parameter name")),
            (b": a", 1, Problem::Byte(b' ')),
            (b"?1", 1, Problem::Byte(b'1')),
            (b"\xff", 0, Problem::NotUtf8("word")),
            (b"\"\xff\"", 1, Problem::NotUtf8("string")),
        ] {
            let error = tokens(bytes).unwrap_err();
            assert_eq!(
                (error.offset(), error.problem()),
                (offset, &problem),
                "{bytes:?}"
            );
        }
    }
}
