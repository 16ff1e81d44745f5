//! The serializer. It converts Rust values to SL text without an intermediate tree.

use std::{fmt, mem};

use fipa_acl::TimeError;
use serde::ser::{self, Serialize};

use super::error::SerializeError;
use super::names;
use crate::error::PrintError;
use crate::parse::Parser;
use crate::print::Printer;
use crate::{MAX_DEPTH, SlDialect, write};

type Result<T = ()> = std::result::Result<T, Boxed>;

/// Boxed, so that successful results stay small.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
struct Boxed(Box<SerializeError>);

impl ser::Error for Boxed {
    #[cold]
    fn custom<T: fmt::Display>(message: T) -> Self {
        <SerializeError as ser::Error>::custom(message).into()
    }
}

impl<E: Into<SerializeError>> From<E> for Boxed {
    #[cold]
    fn from(error: E) -> Self {
        Self(Box::new(error.into()))
    }
}

/// Writes the value as a term in the standard dialect; the crate's documentation has the mapping.
///
/// # Errors
/// When SL has no notation for a part of the value, or `Serialize` of the value fails.
pub fn to_vec(value: &(impl Serialize + ?Sized)) -> std::result::Result<Vec<u8>, SerializeError> {
    to_vec_in(SlDialect::Standard, value)
}

/// Writes the value as a term in this dialect.
///
/// # Errors
/// When the dialect has no notation for a part of the value, or `Serialize` of the value fails.
pub fn to_vec_in(
    dialect: SlDialect,
    value: &(impl Serialize + ?Sized),
) -> std::result::Result<Vec<u8>, SerializeError> {
    let mut serializer = Serializer {
        out: Vec::with_capacity(128),
        dialect,
        depth: 0,
        mode: Mode::Plain,
        absent: false,
        slots: Vec::new(),
    };
    value
        .serialize(&mut serializer)
        .map_err(|Boxed(error)| *error)?;
    if serializer.absent {
        return Err(SerializeError::Absent);
    }
    Ok(serializer.out)
}

struct Serializer {
    out: Vec<u8>,
    dialect: SlDialect,
    depth: usize,
    mode: Mode,
    /// Whether the last value was `None`, and nothing was written.
    absent: bool,
    /// Slots of the structs that are being written.
    slots: Vec<&'static str>,
}

/// The notation of the next value: see [`names`].
#[derive(Default)]
enum Mode {
    #[default]
    Plain,
    Set,
    DateTime,
    Term,
}

impl Serializer {
    fn put(&mut self, text: &str) {
        self.out.extend_from_slice(text.as_bytes());
    }

    #[inline]
    fn put_integer(&mut self, value: impl itoa::Integer) -> Result {
        self.put(itoa::Buffer::new().format(value));
        Ok(())
    }

    /// Appends an integer that may be too long for JADE.
    #[inline]
    fn put_long_integer(&mut self, value: impl itoa::Integer + Copy + TryInto<i64>) -> Result {
        if self.dialect == SlDialect::Jade && value.try_into().is_err() {
            return Err(too_large_for_jade().into());
        }
        self.put_integer(value)
    }

    #[inline]
    fn put_float<F: zmij::Float + Copy + Into<f64>>(&mut self, value: F) -> Result {
        if !value.into().is_finite() {
            return Err(SerializeError::NotFinite.into());
        }
        self.put(zmij::Buffer::new().format_finite(value));
        Ok(())
    }

    fn open(&mut self) -> Result {
        // A mode applies to a collection or a text, not to the parts of another term.
        self.mode = Mode::Plain;
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(PrintError::TooDeep.into());
        }
        self.out.push(b'(');
        Ok(())
    }

    fn close(&mut self) {
        self.depth -= 1;
        self.out.push(b')');
    }

    /// Begins a functional term.
    fn open_functional(&mut self, symbol: &str, positional: usize) -> Result {
        self.open()?;
        write::function_symbol(&mut self.out, self.dialect, symbol, positional == 2)?;
        Ok(())
    }

    /// Appends a value that must not be absent.
    fn present(&mut self, value: &(impl Serialize + ?Sized)) -> Result {
        value.serialize(&mut *self)?;
        if self.absent {
            return Err(SerializeError::Absent.into());
        }
        Ok(())
    }

    /// Appends a slot, unless the value is absent.
    fn slot(&mut self, name: &str, value: &(impl Serialize + ?Sized)) -> Result {
        let before = self.out.len();
        self.put(" :");
        write::name(&mut self.out, self.dialect, name)?;
        self.out.push(b' ');
        value.serialize(&mut *self)?;
        if mem::take(&mut self.absent) {
            self.out.truncate(before);
        }
        Ok(())
    }

    fn compound(&mut self) -> Compound<'_> {
        let first_slot = self.slots.len();
        Compound {
            serializer: self,
            first_slot,
        }
    }

    /// Appends the text of a term within the remaining depth.
    fn term(&mut self, text: &[u8]) -> Result {
        let term = Parser::whole_at(self.depth, SlDialect::Standard, text, Parser::term)?;
        if self.dialect == SlDialect::Standard {
            self.out.extend_from_slice(text);
        } else {
            let text = Printer::new().dialect(self.dialect).print(&term)?;
            self.out.extend_from_slice(&text);
        }
        Ok(())
    }
}

fn too_large_for_jade() -> SerializeError {
    SerializeError::Print(PrintError::Unrepresentable {
        what: "integer",
        why: "JADE has integers of 64 bits with a sign",
    })
}

/// Defines the methods of a serializer that write numbers with the same method.
macro_rules! numbers {
    ($put:ident: $($method:ident $number:ty,)*) => {$(
        #[inline]
        fn $method(self, value: $number) -> Result {
            self.$put(value)
        }
    )*};
}

impl<'s> ser::Serializer for &'s mut Serializer {
    type Ok = ();
    type Error = Boxed;
    type SerializeSeq = Compound<'s>;
    type SerializeTuple = Compound<'s>;
    type SerializeTupleStruct = Compound<'s>;
    type SerializeTupleVariant = Compound<'s>;
    type SerializeMap = Compound<'s>;
    type SerializeStruct = Compound<'s>;
    type SerializeStructVariant = Compound<'s>;

    numbers! {
        put_integer:
        serialize_i8 i8,
        serialize_i16 i16,
        serialize_i32 i32,
        serialize_i64 i64,
        serialize_u8 u8,
        serialize_u16 u16,
        serialize_u32 u32,
    }

    numbers! {
        put_long_integer:
        serialize_u64 u64,
        serialize_i128 i128,
        serialize_u128 u128,
    }

    numbers! {
        put_float:
        serialize_f32 f32,
        serialize_f64 f64,
    }

    #[inline]
    fn serialize_bool(self, value: bool) -> Result {
        self.put(if value { "true" } else { "false" });
        Ok(())
    }

    fn serialize_char(self, value: char) -> Result {
        self.serialize_str(value.encode_utf8(&mut [0; 4]))
    }

    #[inline]
    fn serialize_str(self, text: &str) -> Result {
        match mem::take(&mut self.mode) {
            Mode::Plain | Mode::Set => {
                write::string(&mut self.out, self.dialect, text)?;
                Ok(())
            }
            Mode::DateTime => {
                let time = text
                    .parse()
                    .map_err(<Boxed as ser::Error>::custom::<TimeError>)?;
                write::time(&mut self.out, self.dialect, time)?;
                Ok(())
            }
            Mode::Term => self.term(text.as_bytes()),
        }
    }

    fn serialize_bytes(self, bytes: &[u8]) -> Result {
        if let Mode::Term = mem::take(&mut self.mode) {
            return self.term(bytes);
        }
        write::bytes(&mut self.out, self.dialect, bytes)?;
        Ok(())
    }

    #[inline]
    fn serialize_none(self) -> Result {
        self.absent = true;
        Ok(())
    }

    #[inline]
    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result {
        value.serialize(self)
    }

    fn serialize_unit(self) -> Result {
        self.open()?;
        self.put("sequence");
        self.close();
        Ok(())
    }

    fn serialize_unit_struct(self, name: &'static str) -> Result {
        self.open_functional(name, 0)?;
        self.close();
        Ok(())
    }

    fn serialize_unit_variant(
        self,
        _name: &'static str,
        _index: u32,
        variant: &'static str,
    ) -> Result {
        write::string(&mut self.out, self.dialect, variant)?;
        Ok(())
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(
        self,
        name: &'static str,
        value: &T,
    ) -> Result {
        self.mode = match name {
            names::SET => Mode::Set,
            names::DATE_TIME => Mode::DateTime,
            names::TERM => Mode::Term,
            _ => return value.serialize(self),
        };
        let written = value.serialize(&mut *self);
        self.mode = Mode::Plain;
        written
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _name: &'static str,
        _index: u32,
        variant: &'static str,
        value: &T,
    ) -> Result {
        self.open_functional(variant, 1)?;
        let before = self.out.len();
        self.out.push(b' ');
        value.serialize(&mut *self)?;
        if mem::take(&mut self.absent) {
            self.out.truncate(before);
        }
        self.close();
        Ok(())
    }

    fn serialize_seq(self, _len: Option<usize>) -> Result<Compound<'s>> {
        let is_set = matches!(self.mode, Mode::Set);
        self.open()?;
        self.put(if is_set { "set" } else { "sequence" });
        Ok(self.compound())
    }

    fn serialize_tuple(self, len: usize) -> Result<Compound<'s>> {
        self.serialize_seq(Some(len))
    }

    fn serialize_tuple_struct(self, name: &'static str, len: usize) -> Result<Compound<'s>> {
        self.open_functional(name, len)?;
        Ok(self.compound())
    }

    fn serialize_tuple_variant(
        self,
        _name: &'static str,
        _index: u32,
        variant: &'static str,
        len: usize,
    ) -> Result<Compound<'s>> {
        self.serialize_tuple_struct(variant, len)
    }

    fn serialize_map(self, _len: Option<usize>) -> Result<Compound<'s>> {
        self.open()?;
        self.put("set");
        Ok(self.compound())
    }

    #[inline]
    fn serialize_struct(self, name: &'static str, _len: usize) -> Result<Compound<'s>> {
        self.open_functional(name, 0)?;
        Ok(self.compound())
    }

    fn serialize_struct_variant(
        self,
        _name: &'static str,
        _index: u32,
        variant: &'static str,
        len: usize,
    ) -> Result<Compound<'s>> {
        self.serialize_struct(variant, len)
    }
}

/// A term in parentheses that is being written.
struct Compound<'s> {
    serializer: &'s mut Serializer,
    /// Index of its first slot among those of all open structs.
    first_slot: usize,
}

impl Compound<'_> {
    #[inline]
    fn element(&mut self, value: &(impl Serialize + ?Sized)) -> Result {
        self.serializer.out.push(b' ');
        self.serializer.present(value)
    }

    #[inline]
    fn field(&mut self, name: &'static str, value: &(impl Serialize + ?Sized)) -> Result {
        let slots = self.serializer.slots.get(self.first_slot..);
        if slots.unwrap_or_default().contains(&name) {
            return Err(SerializeError::DuplicateSlot(name).into());
        }
        self.serializer.slots.push(name);
        self.serializer.slot(name, value)
    }

    #[inline]
    fn finish(self) {
        self.serializer.slots.truncate(self.first_slot);
        self.serializer.close();
    }
}

macro_rules! elements {
    ($($trait:ident $method:ident,)*) => {$(
        impl ser::$trait for Compound<'_> {
            type Ok = ();
            type Error = Boxed;

            #[inline]
            fn $method<T: Serialize + ?Sized>(&mut self, value: &T) -> Result {
                self.element(value)
            }

            #[inline]
            fn end(self) -> Result {
                self.finish();
                Ok(())
            }
        }
    )*};
}

elements! {
    SerializeSeq serialize_element,
    SerializeTuple serialize_element,
    SerializeTupleStruct serialize_field,
    SerializeTupleVariant serialize_field,
}

macro_rules! fields {
    ($($trait:ident,)*) => {$(
        impl ser::$trait for Compound<'_> {
            type Ok = ();
            type Error = Boxed;

            #[inline]
            fn serialize_field<T: Serialize + ?Sized>(
                &mut self,
                name: &'static str,
                value: &T,
            ) -> Result {
                self.field(name, value)
            }

            #[inline]
            fn end(self) -> Result {
                self.finish();
                Ok(())
            }
        }
    )*};
}

fields! {
    SerializeStruct,
    SerializeStructVariant,
}

/// An entry of a map is a `property` (FIPA00023).
impl ser::SerializeMap for Compound<'_> {
    type Ok = ();
    type Error = Boxed;

    fn serialize_key<T: Serialize + ?Sized>(&mut self, key: &T) -> Result {
        self.serializer.out.push(b' ');
        self.serializer.open()?;
        self.serializer.put("property :name ");
        self.serializer.present(key)
    }

    fn serialize_value<T: Serialize + ?Sized>(&mut self, value: &T) -> Result {
        self.serializer.slot("value", value)?;
        self.serializer.close();
        Ok(())
    }

    fn end(self) -> Result {
        self.finish();
        Ok(())
    }
}
