//! The position of the deserializer in the text, and the readers of the parts of a term.

use std::borrow::Cow;

use serde::de::{self, Error as _, Unexpected, Visitor};

use super::access::{Elements, Slots};
use super::{Result, TERM};
use crate::chars::{is_term_keyword, truth};
use crate::error::{ParseError, Problem};
use crate::lex::{Lexer, Token};
use crate::number::{self, Decimal, Number};
use crate::parse::Parser;
use crate::print::Printer;
use crate::serde::error::{DeserializeError, DeserializeErrorKind, quoted};
use crate::{MAX_DEPTH, SlDialect};

pub(super) struct Deserializer<'de> {
    pub(super) lexer: Lexer<'de>,
    depth: usize,
}

/// The beginning of a term in parentheses.
pub(super) enum Head<'de> {
    /// A sequence or set.
    Sequence,
    /// An action expression or identifying expression.
    Operator,
    /// A functional term.
    Symbol(Cow<'de, str>),
}

impl Head<'_> {
    /// Returns the kind of term, for errors.
    pub(super) fn kind(&self) -> Unexpected<'static> {
        Unexpected::Other(match self {
            Self::Sequence => "a sequence or set",
            Self::Operator => "an action expression or identifying expression",
            Self::Symbol(_) => "a functional term",
        })
    }
}

impl<'de> Deserializer<'de> {
    pub(super) fn new(lexer: Lexer<'de>) -> Self {
        Self { lexer, depth: 0 }
    }

    /// Checks that no bytes are left.
    pub(super) fn end(&mut self) -> Result<()> {
        if self.lexer.peek().is_some() {
            let left = Problem::Trailing(self.lexer.remaining());
            return Err(ParseError::new(self.lexer.offset(), TERM, left).into());
        }
        Ok(())
    }

    /// Returns the offset of the next token.
    #[inline]
    pub(super) fn start(&mut self) -> usize {
        self.lexer.peek();
        self.lexer.offset()
    }

    pub(super) fn open(&mut self) -> Result<()> {
        self.lexer.bump();
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            let at = self.lexer.offset() - 1;
            return Err(ParseError::new(at, TERM, Problem::TooDeep).into());
        }
        Ok(())
    }

    /// Reads what follows an opening parenthesis.
    pub(super) fn head(&mut self) -> Result<Head<'de>> {
        let start = self.start();
        Ok(match self.lexer.next()? {
            Token::Word("sequence" | "set") => Head::Sequence,
            Token::Word(word) if is_term_keyword(word) => Head::Operator,
            Token::Word(word) => Head::Symbol(Cow::Borrowed(word)),
            Token::Literal(symbol) => Head::Symbol(symbol),
            other => return Err(unexpected(start, &other, "symbol")),
        })
    }

    /// Whether the list ends here. The closing parenthesis stays unread.
    #[inline]
    pub(super) fn closes(&mut self) -> Result<bool> {
        match self.lexer.peek() {
            Some(b')') => Ok(true),
            Some(_) => Ok(false),
            None => Err(unexpected(self.lexer.offset(), &Token::End, "')'")),
        }
    }

    /// Reads the closing parenthesis after a visitor has read the elements.
    #[inline]
    pub(super) fn close(&mut self, expected: &str) -> Result<()> {
        if !self.closes()? {
            let kind = DeserializeErrorKind::Length {
                found: "more".to_owned(),
                expected: expected.to_owned(),
            };
            return Err(DeserializeError::new(self.lexer.offset(), kind));
        }
        self.lexer.bump();
        self.depth -= 1;
        Ok(())
    }

    pub(super) fn visit_elements<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let value = visitor.visit_seq(Elements {
            deserializer: self,
            index: 0,
        })?;
        self.close("as many as the type has")?;
        Ok(value)
    }

    pub(super) fn visit_slots<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let value = self.slots(visitor)?;
        self.close("as many as the type has")?;
        Ok(value)
    }

    /// Visits arguments by name, without the closing parenthesis.
    pub(super) fn slots<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let mut slots = Slots {
            deserializer: self,
            name: Cow::Borrowed(""),
            start: 0,
        };
        let visited = visitor.visit_map(&mut slots);
        let last = slots.start;
        visited.map_err(|error| match error.kind() {
            DeserializeErrorKind::DuplicateSlot(_) => error.at(last),
            _ => error,
        })
    }

    /// Visits arguments by name or in the order of the fields, without the closing parenthesis.
    pub(super) fn arguments<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        match self.lexer.peek() {
            Some(b':' | b')') => self.slots(visitor),
            _ => visitor.visit_seq(Elements {
                deserializer: self,
                index: 0,
            }),
        }
    }

    /// Starts a functional term with this symbol.
    pub(super) fn functional(&mut self, symbol: &'static str) -> Result<()> {
        let start = self.start();
        if self.lexer.peek() != Some(b'(') {
            return Err(self.mistaken(&symbol));
        }
        self.open()?;
        self.lexer.peek();
        // Most writers use no quotation marks for the symbol.
        let found = match self.lexer.word()? {
            Some(word) if word == symbol && !is_term_keyword(word) => return Ok(()),
            Some(word) => quoted(word),
            None => match self.head()? {
                Head::Symbol(found) if found == symbol => return Ok(()),
                Head::Symbol(found) => quoted(&found),
                other => {
                    return Err(DeserializeError::invalid_type(other.kind(), &symbol).at(start));
                }
            },
        };
        let expected = symbol;
        let kind = DeserializeErrorKind::Symbol { found, expected };
        Err(DeserializeError::new(start, kind))
    }

    /// Returns the error for the next token, which is not of the requested type.
    #[cold]
    pub(super) fn mistaken(&mut self, expected: &dyn de::Expected) -> DeserializeError {
        let start = self.start();
        let token = match self.lexer.next() {
            Ok(token) => token,
            Err(error) => return error.into(),
        };
        let number;
        let found = match &token {
            Token::Word(word) => match truth(word) {
                Some(truth) => Unexpected::Bool(truth),
                None => Unexpected::Str(word),
            },
            Token::Literal(text) => Unexpected::Str(text),
            Token::Bytes(bytes) => Unexpected::Bytes(bytes),
            Token::Number(found) => match (found.as_i64(), found.as_u64(), found.as_f64()) {
                (Some(value), ..) => Unexpected::Signed(value),
                (_, Some(value), _) => Unexpected::Unsigned(value),
                (_, _, Some(value)) if !found.is_integer() => Unexpected::Float(value),
                _ => {
                    number = format!("number {}", quoted(found.as_str()));
                    Unexpected::Other(&number)
                }
            },
            Token::Open => match self.head() {
                Ok(head) => head.kind(),
                Err(error) => return error,
            },
            other => return unexpected(start, other, "term"),
        };
        DeserializeError::invalid_type(found, expected).at(start)
    }

    /// Reads a word or string.
    #[inline]
    pub(super) fn string(&mut self, expected: &dyn de::Expected) -> Result<Cow<'de, str>> {
        match self.lexer.peek() {
            Some(b'"') => Ok(self.lexer.quoted()?),
            Some(b'#') => {
                let start = self.lexer.offset();
                match self.lexer.counted()? {
                    Token::Literal(text) => Ok(text),
                    Token::Bytes(bytes) => {
                        let found = Unexpected::Bytes(&bytes);
                        Err(DeserializeError::invalid_type(found, expected).at(start))
                    }
                    other => Err(unexpected(start, &other, "string")),
                }
            }
            _ => match self.lexer.word()? {
                Some(word) => Ok(Cow::Borrowed(word)),
                None => Err(self.mistaken(expected)),
            },
        }
    }

    /// Reads a number: its offset, its bytes, and its digits unless they are hexadecimal.
    #[inline]
    pub(super) fn number(
        &mut self,
        expected: &dyn de::Expected,
    ) -> Result<(usize, &'de [u8], Option<Decimal>)> {
        self.lexer.peek();
        let start = self.lexer.offset();
        if let Some(decimal) = Decimal::scan(self.lexer.rest())
            && let Some(bytes) = self.lexer.take(decimal.len)
        {
            return Ok((start, bytes, Some(decimal)));
        }
        let before = self.lexer.clone();
        let bytes = self.lexer.run();
        if !number::is_number(bytes) {
            self.lexer = before;
            return Err(self.mistaken(expected));
        }
        Ok((start, bytes, None))
    }

    #[inline]
    pub(super) fn visit_integer<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let (start, bytes, decimal) = self.number(&visitor)?;
        let visited = match decimal {
            Some(decimal) if !decimal.is_integer => {
                visitor.visit_f64(self.float(start, bytes, Some(decimal))?)
            }
            Some(decimal) if !decimal.negative && decimal.magnitude().is_some() => {
                visitor.visit_u64(decimal.magnitude().unwrap_or_default())
            }
            _ => visit_long_integer(start, bytes, visitor),
        };
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    #[inline]
    pub(super) fn float(
        &self,
        start: usize,
        bytes: &'de [u8],
        decimal: Option<Decimal>,
    ) -> Result<f64> {
        if let Some(value) = decimal.and_then(|decimal| decimal.as_exact_f64()) {
            return Ok(value);
        }
        let text = self
            .lexer
            .text_of(start, bytes, "number", "FIPA00008 NumericalConstant")?;
        let value = Number::checked(text).as_f64();
        value.ok_or_else(|| out_of_range(start))
    }

    /// Skips one term.
    pub(super) fn skip(&mut self) -> Result<()> {
        let outside = self.depth;
        loop {
            let start = self.start();
            if self.lexer.peek() == Some(b'(') {
                self.open()?;
                let head_start = self.start();
                let head = self.lexer.next()?;
                if !matches!(head, Token::Word(_) | Token::Literal(_)) {
                    return Err(unexpected(head_start, &head, "symbol"));
                }
                continue;
            }
            match self.lexer.next()? {
                Token::Close if self.depth > outside => self.depth -= 1,
                Token::Parameter(_) if self.depth > outside => continue,
                other @ (Token::Close | Token::Parameter(_) | Token::End) => {
                    return Err(unexpected(start, &other, "term"));
                }
                _ => {}
            }
            if self.depth == outside {
                return Ok(());
            }
        }
    }

    pub(super) fn visit_term<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let (start, depth) = (self.start(), self.depth);
        self.skip()?;
        let text = self.lexer.since(start);
        let dialect = self.lexer.dialect();
        // Parsed here, so that the depth counts and offsets refer to the whole text.
        let term = Parser::whole_at(depth, dialect, text, Parser::term)
            .map_err(|error| error.moved(start))?;
        let visited = match dialect {
            SlDialect::Standard => visitor.visit_bytes(text),
            SlDialect::Jade => {
                let text = Printer::new()
                    .print(&term)
                    .map_err(|error| DeserializeError::from(error).at(start))?;
                visitor.visit_bytes(&text)
            }
        };
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    pub(super) fn visit_date_time<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let start = self.start();
        let before = self.lexer.clone();
        if let Token::DateTime(time) = self.lexer.next()? {
            return visitor.visit_str(&time.to_string());
        }
        self.lexer = before;
        let error = self.mistaken(&visitor);
        Err(error.at(start))
    }
}

/// Visits an integer with a sign, with many digits, or with hexadecimal digits.
fn visit_long_integer<'de, V: Visitor<'de>>(
    start: usize,
    bytes: &[u8],
    visitor: V,
) -> Result<V::Value> {
    let Some((negative, magnitude)) = number::integer(bytes) else {
        return Err(out_of_range(start));
    };
    match (negative, u64::try_from(magnitude)) {
        (false, Ok(value)) => visitor.visit_u64(value),
        (false, Err(_)) => visitor.visit_u128(magnitude),
        (true, _) => {
            let value = 0_i128
                .checked_sub_unsigned(magnitude)
                .ok_or_else(|| out_of_range(start))?;
            match i64::try_from(value) {
                Ok(value) => visitor.visit_i64(value),
                Err(_) => visitor.visit_i128(value),
            }
        }
    }
}

#[cold]
pub(super) fn out_of_range(start: usize) -> DeserializeError {
    let clause = "FIPA00008 NumericalConstant";
    ParseError::new(start, clause, Problem::NumberRange).into()
}

#[cold]
pub(super) fn unexpected(
    start: usize,
    found: &Token<'_>,
    expected: &'static str,
) -> DeserializeError {
    let problem = match found {
        Token::End => Problem::Truncated("term"),
        other => Problem::Unexpected {
            found: other.kind(),
            expected,
        },
    };
    ParseError::new(start, TERM, problem).into()
}

pub(super) fn visit_text<'de, V: Visitor<'de>>(
    text: Cow<'de, str>,
    visitor: V,
) -> Result<V::Value> {
    match text {
        Cow::Borrowed(text) => visitor.visit_borrowed_str(text),
        Cow::Owned(text) => visitor.visit_string(text),
    }
}

pub(super) fn visit_byte_string<'de, V: Visitor<'de>>(
    bytes: Cow<'de, [u8]>,
    visitor: V,
) -> Result<V::Value> {
    match bytes {
        Cow::Borrowed(bytes) => visitor.visit_borrowed_bytes(bytes),
        Cow::Owned(bytes) => visitor.visit_byte_buf(bytes),
    }
}
