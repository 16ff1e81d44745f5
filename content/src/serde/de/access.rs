//! Access of visitors to elements, slots, properties and variants, one after the other.

use std::borrow::Cow;

use serde::de::value::BorrowedStrDeserializer;
use serde::de::{self, DeserializeSeed, Error as _, IntoDeserializer, Visitor};
use serde::forward_to_deserialize_any;

use super::Result;
use super::cursor::{Deserializer, unexpected};
use crate::error::{ParseError, Problem};
use crate::lex::Token;
use crate::serde::error::{DeserializeError, DeserializeErrorKind};

const FUNCTIONAL: &str = "FIPA00008 FunctionalTerm";

/// Elements of a sequence or set, or arguments by position.
pub(super) struct Elements<'d, 'de> {
    pub(super) deserializer: &'d mut Deserializer<'de>,
    pub(super) index: usize,
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
pub(super) struct Slots<'d, 'de> {
    pub(super) deserializer: &'d mut Deserializer<'de>,
    /// The slot whose value is next.
    pub(super) name: Cow<'de, str>,
    /// Its offset.
    pub(super) start: usize,
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
        self.start = start;
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
pub(super) struct Properties<'d, 'de> {
    pub(super) deserializer: &'d mut Deserializer<'de>,
}

impl Properties<'_, '_> {
    /// Reads the name of the slot, which must be the next token.
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
pub(super) struct Function<'d, 'de> {
    pub(super) deserializer: &'d mut Deserializer<'de>,
    pub(super) symbol: Cow<'de, str>,
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
        let visited = self.deserializer.arguments(visitor);
        visited.map_err(|error| error.in_slot(&self.symbol))
    }
}

/// A missing argument of a functional term, which reads only as `None`.
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
