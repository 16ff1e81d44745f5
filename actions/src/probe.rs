//! Types of Rust values, found by reading a value of the type from a source that records what serde
//! asks for.

use std::cell::RefCell;

use serde::de::value::{Error, StrDeserializer};
use serde::de::{
    self, DeserializeOwned, DeserializeSeed, Deserializer, EnumAccess, IntoDeserializer, MapAccess,
    SeqAccess, VariantAccess, Visitor,
};

use crate::types::{Field, Type};

/// Maximum number of types within one type.
const MAX_PARTS: usize = 4_096;

/// Returns the type of `T`, and whether it is optional.
pub(crate) fn of<T: DeserializeOwned>() -> (Type, bool) {
    let state = RefCell::new(State::default());
    let mut found = Found::default();
    // The types that were recorded before an error are right; the others stay `any`.
    let _ = T::deserialize(Probe {
        found: &mut found,
        state: &state,
    });
    (found.value_type, found.optional)
}

#[derive(Debug, Default)]
struct State {
    parts: usize,
    /// Structures around the present one: a type within itself is `any`.
    within: Vec<&'static str>,
}

#[derive(Debug)]
struct Found {
    value_type: Type,
    optional: bool,
}

impl Default for Found {
    fn default() -> Self {
        Self {
            value_type: Type::Any,
            optional: false,
        }
    }
}

struct Probe<'p> {
    found: &'p mut Found,
    state: &'p RefCell<State>,
}

impl Probe<'_> {
    fn set(&mut self, value_type: Type) -> Result<(), Error> {
        let mut state = self.state.borrow_mut();
        state.parts += 1;
        if state.parts > MAX_PARTS {
            return Err(de::Error::custom("too many parts"));
        }
        self.found.value_type = value_type;
        Ok(())
    }
}

macro_rules! scalars {
    ($($deserialize:ident => $visit:ident($($value:expr)?) $type:expr;)*) => {$(
        fn $deserialize<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, Error> {
            self.set($type)?;
            visitor.$visit($($value)?)
        }
    )*};
}

impl<'de> Deserializer<'de> for Probe<'_> {
    type Error = Error;

    scalars! {
        deserialize_bool => visit_bool(false) Type::Boolean;
        deserialize_i8 => visit_i8(0) Type::Integer;
        deserialize_i16 => visit_i16(0) Type::Integer;
        deserialize_i32 => visit_i32(0) Type::Integer;
        deserialize_i64 => visit_i64(0) Type::Integer;
        deserialize_i128 => visit_i128(0) Type::Integer;
        deserialize_u8 => visit_u8(0) Type::Integer;
        deserialize_u16 => visit_u16(0) Type::Integer;
        deserialize_u32 => visit_u32(0) Type::Integer;
        deserialize_u64 => visit_u64(0) Type::Integer;
        deserialize_u128 => visit_u128(0) Type::Integer;
        deserialize_f32 => visit_f32(0.0) Type::Number;
        deserialize_f64 => visit_f64(0.0) Type::Number;
        deserialize_char => visit_char('a') Type::String;
        deserialize_str => visit_str("a") Type::String;
        deserialize_string => visit_str("a") Type::String;
        deserialize_bytes => visit_bytes(b"a") Type::Bytes;
        deserialize_byte_buf => visit_bytes(b"a") Type::Bytes;
        deserialize_unit => visit_unit() Type::Nothing;
        deserialize_any => visit_unit() Type::Any;
        deserialize_ignored_any => visit_unit() Type::Any;
        deserialize_identifier => visit_str("a") Type::String;
    }

    fn deserialize_option<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        self.found.optional = true;
        visitor.visit_some(self)
    }

    fn deserialize_unit_struct<V: Visitor<'de>>(
        mut self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value, Error> {
        let (name, fields) = (name.to_owned(), Vec::new());
        self.set(Type::Structure { name, fields })?;
        visitor.visit_unit()
    }

    fn deserialize_newtype_struct<V: Visitor<'de>>(
        mut self,
        name: &'static str,
        visitor: V,
    ) -> Result<V::Value, Error> {
        match name {
            "$fipa_content::DateTime" => {
                self.set(Type::Time)?;
                let text: StrDeserializer<'_, Error> = "20000101T000000000Z".into_deserializer();
                visitor.visit_newtype_struct(text)
            }
            "$fipa_content::Term" => {
                self.set(Type::Any)?;
                let text: StrDeserializer<'_, Error> = "a".into_deserializer();
                visitor.visit_newtype_struct(text)
            }
            _ => visitor.visit_newtype_struct(self),
        }
    }

    fn deserialize_seq<V: Visitor<'de>>(self, visitor: V) -> Result<V::Value, Error> {
        self.list(1, visitor)
    }

    fn deserialize_tuple<V: Visitor<'de>>(self, len: usize, visitor: V) -> Result<V::Value, Error> {
        self.list(len, visitor)
    }

    fn deserialize_tuple_struct<V: Visitor<'de>>(
        mut self,
        _name: &'static str,
        len: usize,
        visitor: V,
    ) -> Result<V::Value, Error> {
        // A functional term with arguments by position: serde does not give their names.
        self.set(Type::Any)?;
        let mut ignored = Found::default();
        visitor.visit_seq(Elements {
            remaining: len,
            is_first: true,
            found: &mut ignored,
            state: self.state,
        })
    }

    fn deserialize_map<V: Visitor<'de>>(mut self, visitor: V) -> Result<V::Value, Error> {
        self.set(Type::Any)?;
        visitor.visit_map(Fields {
            names: &[],
            at: 0,
            found: &mut [],
            state: self.state,
        })
    }

    fn deserialize_struct<V: Visitor<'de>>(
        mut self,
        name: &'static str,
        fields: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        if self.state.borrow().within.contains(&name) {
            self.set(Type::Any)?;
            return Err(de::Error::custom("a type within itself"));
        }
        self.state.borrow_mut().within.push(name);
        let mut found: Vec<Found> = fields.iter().map(|_| Found::default()).collect();
        let value = visitor.visit_map(Fields {
            names: fields,
            at: 0,
            found: &mut found,
            state: self.state,
        });
        self.state.borrow_mut().within.pop();
        let fields = fields.iter().zip(found).map(|(name, found)| Field {
            name: (*name).to_owned(),
            value_type: found.value_type,
            optional: found.optional,
        });
        self.set(Type::Structure {
            name: name.to_owned(),
            fields: fields.collect(),
        })?;
        value
    }

    fn deserialize_enum<V: Visitor<'de>>(
        mut self,
        _name: &'static str,
        variants: &'static [&'static str],
        visitor: V,
    ) -> Result<V::Value, Error> {
        let of = variants.iter().map(|&it| it.to_owned()).collect();
        self.set(Type::Choice { of })?;
        match variants.first() {
            Some(first) => visitor.visit_enum(First(first)),
            None => Err(de::Error::custom("an enum without variants")),
        }
    }
}

impl<'p> Probe<'p> {
    fn list<'de, V: Visitor<'de>>(mut self, len: usize, visitor: V) -> Result<V::Value, Error> {
        self.set(Type::Any)?;
        let mut element = Found::default();
        let value = visitor.visit_seq(Elements {
            remaining: len.min(MAX_PARTS),
            is_first: true,
            found: &mut element,
            state: self.state,
        });
        let of = Box::new(element.value_type);
        self.set(Type::List { of })?;
        value
    }
}

/// The elements of a sequence. Their type is that of all elements, or `any`.
struct Elements<'p> {
    remaining: usize,
    is_first: bool,
    found: &'p mut Found,
    state: &'p RefCell<State>,
}

impl<'de> SeqAccess<'de> for Elements<'_> {
    type Error = Error;

    fn next_element_seed<T: DeserializeSeed<'de>>(
        &mut self,
        seed: T,
    ) -> Result<Option<T::Value>, Error> {
        let Some(remaining) = self.remaining.checked_sub(1) else {
            return Ok(None);
        };
        self.remaining = remaining;
        let mut found = Found::default();
        let value = seed.deserialize(Probe {
            found: &mut found,
            state: self.state,
        });
        if std::mem::take(&mut self.is_first) {
            *self.found = found;
        } else if found.value_type != self.found.value_type {
            self.found.value_type = Type::Any;
        }
        value.map(Some)
    }
}

struct Fields<'p> {
    names: &'static [&'static str],
    at: usize,
    found: &'p mut [Found],
    state: &'p RefCell<State>,
}

impl<'de> MapAccess<'de> for Fields<'_> {
    type Error = Error;

    fn next_key_seed<K: DeserializeSeed<'de>>(
        &mut self,
        seed: K,
    ) -> Result<Option<K::Value>, Error> {
        let Some(name) = self.names.get(self.at) else {
            return Ok(None);
        };
        let name: StrDeserializer<'_, Error> = (*name).into_deserializer();
        seed.deserialize(name).map(Some)
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, Error> {
        let found = self.found.get_mut(self.at);
        self.at += 1;
        let found = found.ok_or_else(|| de::Error::custom("no such field"))?;
        seed.deserialize(Probe {
            found,
            state: self.state,
        })
    }
}

/// The first variant of an enum, as one without content.
struct First(&'static str);

impl<'de> EnumAccess<'de> for First {
    type Error = Error;
    type Variant = Self;

    fn variant_seed<V: DeserializeSeed<'de>>(self, seed: V) -> Result<(V::Value, Self), Error> {
        let name: StrDeserializer<'_, Error> = self.0.into_deserializer();
        Ok((seed.deserialize(name)?, self))
    }
}

impl<'de> VariantAccess<'de> for First {
    type Error = Error;

    fn unit_variant(self) -> Result<(), Error> {
        Ok(())
    }

    fn newtype_variant_seed<T: DeserializeSeed<'de>>(self, _seed: T) -> Result<T::Value, Error> {
        Err(de::Error::custom("a variant with content"))
    }

    fn tuple_variant<V: Visitor<'de>>(self, _len: usize, _visitor: V) -> Result<V::Value, Error> {
        Err(de::Error::custom("a variant with content"))
    }

    fn struct_variant<V: Visitor<'de>>(
        self,
        _fields: &'static [&'static str],
        _visitor: V,
    ) -> Result<V::Value, Error> {
        Err(de::Error::custom("a variant with content"))
    }
}

#[cfg(test)]
mod tests {
    use serde::Deserialize;

    use super::*;

    #[derive(Deserialize)]
    #[serde(rename = "pose")]
    #[allow(dead_code)]
    struct Pose {
        x: f64,
        frame: Option<String>,
        through: Vec<(f64, f64)>,
    }

    #[derive(Deserialize)]
    #[serde(rename_all = "kebab-case")]
    #[allow(dead_code)]
    enum Side {
        FrontLeft,
        Back { distance: u8 },
    }

    #[derive(Deserialize)]
    #[allow(dead_code)]
    struct Node {
        side: Side,
        first: Option<Box<Node>>,
        second: Vec<Node>,
        at: fipa_content::DateTime,
    }

    #[test]
    fn types_are_those_that_serde_asks_for() {
        assert_eq!(of::<f64>(), (Type::Number, false));
        assert_eq!(of::<Option<u8>>(), (Type::Integer, true));
        assert_eq!(of::<()>(), (Type::Nothing, false));
        let pose = of::<Pose>().0;
        assert_eq!(
            pose.to_string(),
            "pose(x: number, frame?: string, through: list of list of number)"
        );
        // The types after a type within itself are not found.
        let node = of::<Node>().0.to_string();
        assert!(
            node.starts_with("Node(side: front-left | back, first?: any"),
            "{node}"
        );
        let mixed = of::<(f64, String, f64)>().0;
        assert_eq!(mixed.to_string(), "list of any");
    }
}
