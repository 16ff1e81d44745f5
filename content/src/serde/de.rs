//! The deserializer: SL text to Rust values, without a tree in between.

use std::borrow::Cow;

use serde::de::value::{BorrowedStrDeserializer, CowStrDeserializer};
use serde::de::{
    self, Deserialize, DeserializeSeed, Error as _, IntoDeserializer, Unexpected, Visitor,
};
use serde::forward_to_deserialize_any;

use super::error::{DeserializeError, DeserializeErrorKind, quoted};
use super::names;
use crate::chars::truth;
use crate::error::{ParseError, Problem};
use crate::lex::{Lexer, Token};
use crate::number::{self, Number};
use crate::parse::Parser;
use crate::print::Printer;
use crate::{Dialect, MAX_DEPTH};

type Result<T, E = DeserializeError> = std::result::Result<T, E>;

const TERM: &str = "FIPA00008 Term";
const FUNCTIONAL: &str = "FIPA00008 FunctionalTerm";

/// Reads one term in the standard dialect as a value; the crate's documentation has the mapping.
///
/// Ignored slots are checked for tokens, parentheses and depth only. Memory is taken for what was
/// read, never for what a length announces.
///
/// # Errors
/// When the bytes are not one term, or the term is not a value of the type.
pub fn from_slice<'de, T: Deserialize<'de>>(
    bytes: &'de (impl AsRef<[u8]> + ?Sized),
) -> Result<T> {
    from_slice_in(Dialect::Standard, bytes)
}

/// Reads one term that comes from a writer of this dialect as a value.
///
/// # Errors
/// See [`from_slice`].
pub fn from_slice_in<'de, T: Deserialize<'de>>(
    dialect: Dialect,
    bytes: &'de (impl AsRef<[u8]> + ?Sized),
) -> Result<T> {
    let mut deserializer = Deserializer {
        lexer: Lexer::new(bytes.as_ref(), dialect),
        depth: 0,
    };
    let value = T::deserialize(&mut deserializer)?;
    let lexer = &mut deserializer.lexer;
    if lexer.peek().is_some() {
        let left = Problem::Trailing(lexer.remaining());
        return Err(ParseError::new(lexer.offset(), TERM, left).into());
    }
    Ok(value)
}

struct Deserializer<'de> {
    lexer: Lexer<'de>,
    depth: usize,
}

/// The beginning of a term in parentheses.
enum Head<'de> {
    Sequence,
    Symbol(Cow<'de, str>),
}

impl<'de> Deserializer<'de> {
    /// Offset of the next token.
    #[inline]
    fn start(&mut self) -> usize {
        self.lexer.peek();
        self.lexer.offset()
    }

    fn open(&mut self) -> Result<()> {
        self.lexer.bump();
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            let at = self.lexer.offset() - 1;
            return Err(ParseError::new(at, TERM, Problem::TooDeep).into());
        }
        Ok(())
    }

    /// Reads what follows an opening parenthesis.
    fn head(&mut self) -> Result<Head<'de>> {
        let start = self.start();
        Ok(match self.lexer.next()? {
            Token::Word("sequence" | "set") => Head::Sequence,
            Token::Word(word) => Head::Symbol(Cow::Borrowed(word)),
            Token::Literal(symbol) => Head::Symbol(symbol),
            other => return Err(unexpected(start, &other, "symbol")),
        })
    }

    /// Whether the list ends here. Its parenthesis is not read.
    #[inline]
    fn closes(&mut self) -> Result<bool> {
        match self.lexer.peek() {
            Some(b')') => Ok(true),
            Some(_) => Ok(false),
            None => Err(unexpected(self.lexer.offset(), &Token::End, "')'")),
        }
    }

    /// Reads the closing parenthesis after a visitor has taken what it wanted.
    #[inline]
    fn close(&mut self, expected: &str) -> Result<()> {
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

    fn visit_elements<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let value = visitor.visit_seq(Elements {
            deserializer: self,
            index: 0,
        })?;
        self.close("as many as the type has")?;
        Ok(value)
    }

    fn visit_slots<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let value = visitor.visit_map(Slots {
            deserializer: self,
            name: Cow::Borrowed(""),
        })?;
        self.close("as many as the type has")?;
        Ok(value)
    }

    /// Arguments by name, or in the order of the fields.
    fn visit_arguments<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        match self.lexer.peek() {
            Some(b':' | b')') => self.visit_slots(visitor),
            _ => self.visit_elements(visitor),
        }
    }

    /// Begins a functional term with this symbol.
    fn functional(&mut self, symbol: &'static str) -> Result<()> {
        let start = self.start();
        if self.lexer.peek() != Some(b'(') {
            return Err(self.mistaken(&symbol));
        }
        self.open()?;
        let found = match self.head()? {
            Head::Symbol(found) if found == symbol => return Ok(()),
            Head::Symbol(found) => quoted(&found),
            Head::Sequence => "sequence".to_owned(),
        };
        let expected = symbol;
        let kind = DeserializeErrorKind::Symbol { found, expected };
        Err(DeserializeError::new(start, kind))
    }

    /// The error about the next token, which is none of the requested type.
    #[cold]
    fn mistaken(&mut self, expected: &dyn de::Expected) -> DeserializeError {
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
            Token::Open => Unexpected::Other(match self.head() {
                Ok(Head::Sequence) => "a sequence or set",
                Ok(Head::Symbol(_)) => "a functional term",
                Err(error) => return error,
            }),
            other => return unexpected(start, other, "term"),
            
        };
        DeserializeError::invalid_type(found, expected).at(start)
    }

    /// Reads a word or string.
    #[inline]
    fn string(&mut self, expected: &dyn de::Expected) -> Result<Cow<'de, str>> {
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
            Some(b'0'..=b'9' | b'-' | b'+' | b'.' | b'(' | b')' | b'?' | b':') | None => {
                let before = self.lexer.clone();
                match self.lexer.next() {
                    Ok(Token::Word(word)) => Ok(Cow::Borrowed(word)),
                    _ => {
                        self.lexer = before;
                        Err(self.mistaken(expected))
                    }
                }
            }
            Some(_) => match self.lexer.next()? {
                Token::Word(word) => Ok(Cow::Borrowed(word)),
                other => Err(unexpected(self.lexer.offset(), &other, "string")),
            },
        }
    }

    /// Reads the bytes of a number.
    #[inline]
    fn number(&mut self, expected: &dyn de::Expected) -> Result<(usize, &'de [u8])> {
        match self.lexer.peek() {
            Some(b'0'..=b'9' | b'-' | b'+' | b'.') => {}
            _ => return Err(self.mistaken(expected)),
        }
        let start = self.lexer.offset();
        let before = self.lexer.clone();
        let bytes = self.lexer.run();
        if !number::is_number(bytes) {
            self.lexer = before;
            return Err(self.mistaken(expected));
        }
        Ok((start, bytes))
    }

    #[inline]
    fn visit_integer<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let (start, bytes) = self.number(&visitor)?;
        let visited = match number::integer(bytes) {
            Some((negative, magnitude)) => match (negative, u64::try_from(magnitude)) {
                (false, Ok(value)) => visitor.visit_u64(value),
                (true, Ok(value)) => match 0_i64.checked_sub_unsigned(value) {
                    Some(value) => visitor.visit_i64(value),
                    None => visitor.visit_i128(-i128::from(value)),
                },
                (false, Err(_)) => visitor.visit_u128(magnitude),
                (true, Err(_)) => match 0_i128.checked_sub_unsigned(magnitude) {
                    Some(value) => visitor.visit_i128(value),
                    None => return Err(out_of_range(start)),
                },
            },
            None if number::is_integer(bytes) => return Err(out_of_range(start)),
            None => visitor.visit_f64(self.float(start, bytes)?),
        };
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    #[inline]
    fn float(&self, start: usize, bytes: &'de [u8]) -> Result<f64> {
        let text = self
            .lexer
            .text_of(start, bytes, "number", "FIPA00008 NumericalConstant")?;
        let value: Option<f64> = match text.parse() {
            Ok(value) => Some(value).filter(|value: &f64| value.is_finite()),
            // Hexadecimal digits.
            Err(_) => Number::checked(text).as_f64(),
        };
        value.ok_or_else(|| out_of_range(start))
    }

    /// Skips one term.
    fn skip(&mut self) -> Result<()> {
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

    fn visit_term<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
        let (start, depth) = (self.start(), self.depth);
        self.skip()?;
        let text = self.lexer.since(start);
        let dialect = self.lexer.dialect();
        // Checked and counted here, with the offset in the whole.
        let term = Parser::whole_at(depth, dialect, text, Parser::term)
            .map_err(|error| error.moved(start))?;
        let visited = match dialect {
            Dialect::Standard => visitor.visit_bytes(text),
            Dialect::Jade => {
                let text = Printer::new()
                    .print(&term)
                    .map_err(|error| DeserializeError::from(error).at(start))?;
                visitor.visit_bytes(&text)
            }
        };
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    fn visit_date_time<V: Visitor<'de>>(&mut self, visitor: V) -> Result<V::Value> {
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

fn out_of_range(start: usize) -> DeserializeError {
    let clause = "FIPA00008 NumericalConstant";
    ParseError::new(start, clause, Problem::NumberRange).into()
}

#[cold]
fn unexpected(start: usize, found: &Token<'_>, expected: &'static str) -> DeserializeError {
    let problem = match found {
        Token::End => Problem::Truncated("term"),
        other => Problem::Unexpected {
            found: other.kind(),
            expected,
        },
    };
    ParseError::new(start, TERM, problem).into()
}

fn visit_text<'de, V: Visitor<'de>>(text: Cow<'de, str>, visitor: V) -> Result<V::Value> {
    match text {
        Cow::Borrowed(text) => visitor.visit_borrowed_str(text),
        Cow::Owned(text) => visitor.visit_string(text),
    }
}

fn visit_byte_string<'de, V: Visitor<'de>>(
    bytes: Cow<'de, [u8]>,
    visitor: V,
) -> Result<V::Value> {
    match bytes {
        Cow::Borrowed(bytes) => visitor.visit_borrowed_bytes(bytes),
        Cow::Owned(bytes) => visitor.visit_byte_buf(bytes),
    }
}

macro_rules! integers {
    ($($method:ident)*) => {$(
        #[inline]
        fn $method<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
            self.visit_integer(visitor)
        }
    )*};
}

impl<'de> de::Deserializer<'de> for &mut Deserializer<'de> {
    type Error = DeserializeError;

    integers! {
        deserialize_i8 deserialize_i16 deserialize_i32 deserialize_i64 deserialize_i128
        deserialize_u8 deserialize_u16 deserialize_u32 deserialize_u64 deserialize_u128
    }

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let start = self.start();
        if self.lexer.peek() == Some(b'(') {
            self.open()?;
            return match (self.head()?, self.lexer.peek()) {
                (Head::Sequence, _) => self.visit_elements(visitor),
                (Head::Symbol(_), Some(b':')) => self.visit_slots(visitor),
                (Head::Symbol(_), _) => self.visit_elements(visitor),
            };
        }
        let before = self.lexer.clone();
        let visited = match self.lexer.next()? {
            Token::Word(word) => match truth(word) {
                Some(truth) => visitor.visit_bool(truth),
                None => visitor.visit_borrowed_str(word),
            },
            Token::Literal(text) => visit_text(text, visitor),
            Token::Bytes(bytes) => visit_byte_string(bytes, visitor),
            Token::Number(_) => {
                self.lexer = before;
                self.visit_integer(visitor)
            }
            Token::DateTime(time) => visitor.visit_string(time.to_string()),
            other => return Err(unexpected(start, &other, "term")),
        };
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    fn deserialize_bool<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let before = self.lexer.clone();
        let start = self.start();
        if let Ok(Token::Word(word)) = self.lexer.next()
            && let Some(truth) = truth(word)
        {
            let visited = visitor.visit_bool(truth);
            return visited.map_err(|error: DeserializeError| error.at(start));
        }
        self.lexer = before;
        Err(self.mistaken(&visitor))
    }

    #[inline]
    fn deserialize_f64<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let (start, bytes) = self.number(&visitor)?;
        let value = self.float(start, bytes)?;
        let visited = visitor.visit_f64(value);
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    fn deserialize_f32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let (start, bytes) = self.number(&visitor)?;
        let value = self.float(start, bytes)?;
        // Rounded once, from the digits. Hexadecimal ones have no such reading.
        let text = std::str::from_utf8(bytes).unwrap_or_default();
        let visited = match text.parse::<f32>() {
            Ok(value) if value.is_finite() => visitor.visit_f32(value),
            Ok(_) => return Err(out_of_range(start)),
            Err(_) => visitor.visit_f64(value),
        };
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    fn deserialize_char<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.deserialize_str(visitor)
    }

    #[inline]
    fn deserialize_str<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let start = self.start();
        let text = self.string(&visitor)?;
        let visited = visit_text(text, visitor);
        visited.map_err(|error| error.at(start))
    }

    #[inline]
    fn deserialize_string<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.deserialize_str(visitor)
    }

    fn deserialize_bytes<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let start = self.start();
        let visited = match self.lexer.peek() {
            Some(b'(') => self.deserialize_seq(visitor),
            Some(b'#') => match self.lexer.counted()? {
                Token::Bytes(bytes) => visit_byte_string(bytes, visitor),
                Token::Literal(Cow::Borrowed(text)) => {
                    visitor.visit_borrowed_bytes(text.as_bytes())
                }
                Token::Literal(Cow::Owned(text)) => visitor.visit_byte_buf(text.into_bytes()),
                other => return Err(unexpected(start, &other, "byte string")),
            },
            _ => match self.string(&visitor)? {
                Cow::Borrowed(text) => visitor.visit_borrowed_bytes(text.as_bytes()),
                Cow::Owned(text) => visitor.visit_byte_buf(text.into_bytes()),
            },
        };
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    fn deserialize_byte_buf<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.deserialize_bytes(visitor)
    }

    #[inline]
    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_some(self)
    }

    fn deserialize_unit<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let start = self.start();
        if self.lexer.peek() != Some(b'(') {
            return Err(self.mistaken(&visitor));
        }
        self.open()?;
        if let Head::Symbol(_) = self.head()? {
            let found = Unexpected::Other("a functional term");
            return Err(DeserializeError::invalid_type(found, &"(sequence)").at(start));
        }
        self.close("none")?;
        visitor.visit_unit()
    }

    fn deserialize_unit_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value> {
        self.functional(name)?;
        self.close("none")?;
        visitor.visit_unit()
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value> {
        match name {
            names::DATE_TIME => self.visit_date_time(visitor),
            names::TERM => self.visit_term(visitor),
            _ => visitor.visit_newtype_struct(self),
        }
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let start = self.start();
        if self.lexer.peek() != Some(b'(') {
            return Err(self.mistaken(&visitor));
        }
        self.open()?;
        if let Head::Symbol(_) = self.head()? {
            let found = Unexpected::Other("a functional term");
            return Err(DeserializeError::invalid_type(found, &visitor).at(start));
        }
        let visited = self.visit_elements(visitor);
        visited.map_err(|error| error.at(start))
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, _len: usize, visitor: V) -> Result<V::Value> {
        self.deserialize_seq(visitor)
    }

    fn deserialize_tuple_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        _len: usize,
        visitor: V,
    ) -> Result<V::Value> {
        let start = self.start();
        self.functional(name)?;
        let visited = self.visit_elements(visitor);
        visited.map_err(|error| error.at(start))
    }

    fn deserialize_map<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let start = self.start();
        if self.lexer.peek() != Some(b'(') {
            return Err(self.mistaken(&visitor));
        }
        self.open()?;
        let visited = match self.head()? {
            Head::Symbol(_) => self.visit_slots(visitor),
            Head::Sequence => {
                let value = visitor.visit_map(Properties { deserializer: self })?;
                self.close("as many as the type has")?;
                Ok(value)
            }
        };
        visited.map_err(|error| error.at(start))
    }

    #[inline]
    fn deserialize_struct<V: Visitor<'de>>(
        self,
        name: &'static str,
        _fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value> {
        let start = self.start();
        self.functional(name)?;
        let visited = self.visit_arguments(visitor);
        visited.map_err(|error| error.at(start))
    }

    fn deserialize_enum<V: Visitor<'de>>(
        self,
        _name: &'static str,
        _variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value> {
        let start = self.start();
        if self.lexer.peek() != Some(b'(') {
            let symbol = self.string(&visitor)?;
            let symbol: CowStrDeserializer<'_, DeserializeError> = symbol.into_deserializer();
            let visited = visitor.visit_enum(symbol);
            return visited.map_err(|error| error.at(start));
        }
        self.open()?;
        let Head::Symbol(symbol) = self.head()? else {
            let found = Unexpected::Other("a sequence or set");
            return Err(DeserializeError::invalid_type(found, &visitor).at(start));
        };
        let visited = visitor.visit_enum(Function {
            deserializer: self,
            symbol,
        });
        let value = visited.map_err(|error| error.at(start))?;
        self.close("as many as the type has")?;
        Ok(value)
    }

    fn deserialize_identifier<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.deserialize_str(visitor)
    }

    fn deserialize_ignored_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        self.skip()?;
        visitor.visit_unit()
    }
}

/// Elements of a sequence or set, or arguments by position.
struct Elements<'d, 'de> {
    deserializer: &'d mut Deserializer<'de>,
    index: usize,
}

impl<'de> de::SeqAccess<'de> for Elements<'_, 'de> {
    type Error = DeserializeError;

    #[inline]
    fn next_element_seed<T: DeserializeSeed<'de>>(&mut self, seed: T) -> Result<Option<T::Value>> {
        if self.deserializer.closes()? {
            return Ok(None);
        }
        match seed.deserialize(&mut *self.deserializer) {
            Ok(value) => {
                self.index += 1;
                Ok(Some(value))
            }
            Err(error) => Err(error.in_element(self.index)),
        }
    }
}

/// Arguments by name.
struct Slots<'d, 'de> {
    deserializer: &'d mut Deserializer<'de>,
    /// The slot whose value is next.
    name: Cow<'de, str>,
}

impl<'de> de::MapAccess<'de> for Slots<'_, 'de> {
    type Error = DeserializeError;

    #[inline]
    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>> {
        if self.deserializer.closes()? {
            return Ok(None);
        }
        let lexer = &mut self.deserializer.lexer;
        let start = lexer.offset();
        if lexer.peek() != Some(b':') {
            let found = lexer.next()?;
            let problem = Problem::Unexpected {
                found: found.kind(),
                expected: "parameter name or ')'",
            };
            return Err(ParseError::new(start, FUNCTIONAL, problem).into());
        }
        lexer.bump();
        self.name = lexer.name("parameter name")?;
        let key = match &self.name {
            Cow::Borrowed(name) => seed.deserialize(BorrowedStrDeserializer::new(name)),
            Cow::Owned(name) => seed.deserialize(name.as_str().into_deserializer()),
        };
        key.map(Some)
            .map_err(|error: DeserializeError| error.at(start))
    }

    #[inline]
    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value> {
        seed.deserialize(&mut *self.deserializer)
            .map_err(|error| error.in_slot(&self.name))
    }
}

/// Elements `(property :name key :value value)` of a map.
struct Properties<'d, 'de> {
    deserializer: &'d mut Deserializer<'de>,
}

impl Properties<'_, '_> {
    /// Reads the name of the slot that has to come now.
    fn slot(&mut self, slot: &'static str) -> Result<()> {
        let start = self.deserializer.start();
        match self.deserializer.lexer.next()? {
            Token::Parameter(name) if name == slot => Ok(()),
            Token::Parameter(_) | Token::Close => Err(DeserializeError::new(
                start,
                DeserializeErrorKind::MissingSlot(slot),
            )),
            other => Err(unexpected(start, &other, "parameter name")),
        }
    }
}

impl<'de> de::MapAccess<'de> for Properties<'_, 'de> {
    type Error = DeserializeError;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>> {
        if self.deserializer.closes()? {
            return Ok(None);
        }
        self.deserializer.functional("property")?;
        self.slot("name")?;
        let key = seed.deserialize(&mut *self.deserializer);
        key.map(Some).map_err(|error| error.in_slot("name"))
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value> {
        let value = if self.deserializer.closes()? {
            // An absent value.
            seed.deserialize(Nothing)
        } else {
            self.slot("value")?;
            seed.deserialize(&mut *self.deserializer)
        };
        let value = value.map_err(|error| error.in_slot("value"))?;
        self.deserializer.close("name and value")?;
        Ok(value)
    }
}

/// A functional term that is a variant of an enum.
struct Function<'d, 'de> {
    deserializer: &'d mut Deserializer<'de>,
    symbol: Cow<'de, str>,
}

impl<'de> de::EnumAccess<'de> for Function<'_, 'de> {
    type Error = DeserializeError;
    type Variant = Self;

    fn variant_seed<V: DeserializeSeed<'de>>(self, seed: V) -> Result<(V::Value, Self)> {
        let symbol: &str = &self.symbol;
        let symbol = IntoDeserializer::<DeserializeError>::into_deserializer(symbol);
        let variant = seed.deserialize(symbol)?;
        Ok((variant, self))
    }
}

impl<'de> de::VariantAccess<'de> for Function<'_, 'de> {
    type Error = DeserializeError;

    fn unit_variant(self) -> Result<()> {
        Ok(())
    }

    fn newtype_variant_seed<T: DeserializeSeed<'de>>(self, seed: T) -> Result<T::Value> {
        let value = if self.deserializer.closes()? {
            seed.deserialize(Nothing)
        } else {
            seed.deserialize(&mut *self.deserializer)
        };
        value.map_err(|error| error.in_slot(&self.symbol))
    }

    fn tuple_variant<V: Visitor<'de>>(self, _len: usize, visitor: V) -> Result<V::Value> {
        let index = 0;
        let deserializer = self.deserializer;
        let visited = visitor.visit_seq(Elements {
            deserializer,
            index,
        });
        visited.map_err(|error| error.in_slot(&self.symbol))
    }

    fn struct_variant<V: Visitor<'de>>(
        self,
        _fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value> {
        let deserializer = self.deserializer;
        let visited = match deserializer.lexer.peek() {
            Some(b':' | b')') => visitor.visit_map(Slots {
                deserializer,
                name: Cow::Borrowed(""),
            }),
            _ => visitor.visit_seq(Elements {
                deserializer,
                index: 0,
            }),
        };
        visited.map_err(|error| error.in_slot(&self.symbol))
    }
}

/// The argument that a functional term does not have: only `None` is read from it.
struct Nothing;

impl<'de> de::Deserializer<'de> for Nothing {
    type Error = DeserializeError;

    fn deserialize_any<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        Err(DeserializeError::invalid_length(0, &visitor))
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        visitor.visit_none()
    }

    forward_to_deserialize_any! {
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf unit
        unit_struct newtype_struct seq tuple tuple_struct map struct enum identifier ignored_any
    }
}
