//! The deserializer. It converts SL text to Rust values without an intermediate tree.

mod access;
mod cursor;

use std::borrow::Cow;

use serde::de::value::CowStrDeserializer;
use serde::de::{self, Deserialize, Error as _, IntoDeserializer, Visitor};

use self::access::{Function, Properties};
use self::cursor::{Deserializer, Head, out_of_range, unexpected, visit_byte_string, visit_text};
use super::error::DeserializeError;
use super::names;
use crate::SlDialect;
use crate::chars::truth;
use crate::lex::{Lexer, Token};

type Result<T, E = DeserializeError> = std::result::Result<T, E>;

const TERM: &str = "FIPA00008 Term";

/// Reads one term in the standard dialect as a value; the crate's documentation has the mapping.
///
/// Ignored slots are checked for tokens, parentheses and depth only. Memory use depends on the
/// bytes that were read, and never on an announced length.
///
/// # Errors
/// When the bytes are not one term, or the term is not a value of the type.
pub fn from_slice<'de, T: Deserialize<'de>>(bytes: &'de (impl AsRef<[u8]> + ?Sized)) -> Result<T> {
    from_slice_in(SlDialect::Standard, bytes)
}

/// Reads one term that comes from a writer of this dialect as a value.
///
/// # Errors
/// See [`from_slice`].
pub fn from_slice_in<'de, T: Deserialize<'de>>(
    dialect: SlDialect,
    bytes: &'de (impl AsRef<[u8]> + ?Sized),
) -> Result<T> {
    let mut deserializer = Deserializer::new(Lexer::new(bytes.as_ref(), dialect));
    let value = T::deserialize(&mut deserializer)?;
    deserializer.end()?;
    Ok(value)
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
                (Head::Symbol(_), Some(b':')) => self.visit_slots(visitor),
                _ => self.visit_elements(visitor),
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
        let (start, bytes, decimal) = self.number(&visitor)?;
        let value = self.float(start, bytes, decimal)?;
        let visited = visitor.visit_f64(value);
        visited.map_err(|error: DeserializeError| error.at(start))
    }

    fn deserialize_f32<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value> {
        let (start, bytes, decimal) = self.number(&visitor)?;
        let value = self.float(start, bytes, decimal)?;
        // Rounds once, from the digits. Hexadecimal digits have no such conversion.
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
        let head = self.head()?;
        if !matches!(head, Head::Sequence) {
            return Err(DeserializeError::invalid_type(head.kind(), &"(sequence)").at(start));
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
        let head = self.head()?;
        if !matches!(head, Head::Sequence) {
            return Err(DeserializeError::invalid_type(head.kind(), &visitor).at(start));
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
            head @ Head::Operator => Err(DeserializeError::invalid_type(head.kind(), &visitor)),
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
        let visited = self.arguments(visitor);
        let value = visited.map_err(|error| error.at(start))?;
        self.close("as many as the type has")?;
        Ok(value)
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
        let symbol = match self.head()? {
            Head::Symbol(symbol) => symbol,
            other => return Err(DeserializeError::invalid_type(other.kind(), &visitor).at(start)),
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
