//! Terms as parts of Rust values, and conversion between terms and values.

use std::fmt;

use serde::de::{self, Deserialize, DeserializeOwned, Deserializer, Visitor};
use serde::ser::{self, Serialize, Serializer};

use super::error::{DeserializeError, SerializeError};
use super::{de::from_slice, names, ser::to_vec};
use crate::print::Printer;
use crate::term::{Arguments, FunctionalTerm, Term};
use crate::wff::Wff;

impl Term<'static> {
    /// Returns the value as a term.
    ///
    /// # Errors
    /// When SL has no notation for a part of the value, or `Serialize` of the value fails.
    pub fn from_value(value: &(impl Serialize + ?Sized)) -> Result<Self, SerializeError> {
        let text = to_vec(value)?;
        Ok(Term::parse(&text)?.into_owned())
    }
}

impl Term<'_> {
    /// Reads the term as a value.
    ///
    /// # Errors
    /// When the term is not a value of the type. Offsets count from the start of the term in its
    /// standard notation on one line.
    pub fn read<T: DeserializeOwned>(&self) -> Result<T, DeserializeError> {
        let text = Printer::new().print(self)?;
        from_slice(&text)
    }
}

impl Wff<'static> {
    /// Returns the formula of a value: a predicate for a function symbol with arguments by
    /// position, a proposition for a word. So an enum can hold the reasons of a refusal:
    /// `(missing-parameter dock target)`, `unauthorised`.
    ///
    /// # Errors
    /// When the value is written as another term, SL has no notation for a part of it, or its
    /// `Serialize` fails.
    pub fn from_value(value: &(impl Serialize + ?Sized)) -> Result<Self, SerializeError> {
        match Term::from_value(value)? {
            Term::String(symbol) => Ok(Self::Proposition(symbol)),
            Term::Functional(FunctionalTerm {
                symbol,
                arguments: Arguments::Terms(arguments),
            }) => Ok(Self::predicate(symbol, arguments)),
            _ => Err(SerializeError::Predicate),
        }
    }
}

impl Wff<'_> {
    /// Reads a predicate or proposition as a value: see [`from_value`](Self::from_value).
    ///
    /// # Errors
    /// When it is another formula, or not a value of the type. Offsets count from the start of the
    /// formula in its standard notation on one line.
    pub fn read<T: DeserializeOwned>(&self) -> Result<T, DeserializeError> {
        match self {
            Self::Proposition(symbol) => Term::String(symbol.clone()).read(),
            Self::Predicate { symbol, arguments } => {
                Term::functional(symbol.clone(), arguments.iter().cloned()).read()
            }
            _ => {
                let found = de::Unexpected::Other("another formula");
                let expected = &"a predicate or proposition";
                Err(de::Error::invalid_type(found, expected))
            }
        }
    }
}

/// Writes the term as it is; in other formats than SL, as text in the standard notation, or bytes
/// where it has byte strings. As in that notation, a byte string that is UTF-8 becomes a string.
impl Serialize for Term<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let text = Printer::new().print(self).map_err(ser::Error::custom)?;
        serializer.serialize_newtype_struct(names::TERM, &Text(&text))
    }
}

struct Text<'a>(&'a [u8]);

impl Serialize for Text<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match std::str::from_utf8(self.0) {
            Ok(text) => serializer.serialize_str(text),
            Err(_) => serializer.serialize_bytes(self.0),
        }
    }
}

/// Reads any term; from other formats than SL, its text in the standard notation.
impl<'de> Deserialize<'de> for Term<'static> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_newtype_struct(names::TERM, TermVisitor)
    }
}

struct TermVisitor;

impl<'de> Visitor<'de> for TermVisitor {
    type Value = Term<'static>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a term")
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(
        self,
        deserializer: D,
    ) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_str(self)
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<Self::Value, E> {
        self.visit_bytes(text.as_bytes())
    }

    fn visit_bytes<E: de::Error>(self, text: &[u8]) -> Result<Self::Value, E> {
        let term = Term::parse(text).map_err(E::custom)?;
        Ok(term.into_owned())
    }
}
