//! Errors of the conversion between Rust values and SL terms.

use std::fmt;

use fipa_acl::escape;
use serde::{de, ser};

use crate::error::{ParseError, PrintError};

/// Maximum length of quoted text in an error, in characters.
const MAX_QUOTED: usize = 60;

/// A Rust value that cannot be written as an SL term.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SerializeError {
    /// NaN or an infinity. SL has no notation for them.
    #[error("the number is not finite, and SL has no notation for it")]
    NotFinite,
    /// `None` as the whole value, in a sequence, as an argument by position, or as the key of a
    /// map. Only a slot can be absent.
    #[error("an absent value can only be written in a slot, which is left out then")]
    Absent,
    /// Two fields of one struct have the same slot.
    #[error("two fields have the slot {0:?}")]
    DuplicateSlot(&'static str),
    /// A value that the dialect has no notation for.
    #[error(transparent)]
    Print(#[from] PrintError),
    /// A value that is neither a predicate nor a proposition: neither a function symbol with
    /// arguments by position nor a word.
    #[error("the value is no predicate and no proposition; arguments of predicates have no names")]
    Predicate,
    /// An invalid [`Term`](crate::Term) inside of the value.
    #[error("the term inside is malformed")]
    Term(#[from] ParseError),
    /// An error of the value's own `Serialize`.
    #[error("{}", escape(.0))]
    Custom(String),
}

impl ser::Error for SerializeError {
    fn custom<T: fmt::Display>(message: T) -> Self {
        Self::Custom(message.to_string())
    }
}

/// An SL term that is not a value of the requested type: the offset, the slot, and the reason.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeserializeError(Box<Details>);

/// Boxed, so that successful results stay small.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Details {
    offset: Option<usize>,
    /// Slots and indexes, the innermost one first.
    path: Vec<Step>,
    kind: DeserializeErrorKind,
}

#[derive(Debug, Clone, PartialEq, Eq)]
enum Step {
    Slot(String),
    Index(usize),
}

/// Reasons for which a term is not a value of a type.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DeserializeErrorKind {
    /// The bytes are not SL.
    #[error(transparent)]
    Syntax(#[from] ParseError),
    /// A term of another type.
    #[error("found {} where {expected} should be", escape(.found))]
    Type {
        /// The term.
        found: String,
        /// The type.
        expected: String,
    },
    /// A term of the right type whose value is not allowed, for example out of range.
    #[error("found {} where {expected} should be", escape(.found))]
    Value {
        /// The value.
        found: String,
        /// The allowed values.
        expected: String,
    },
    /// A sequence, a set or arguments of another number.
    #[error("found {found} elements where {expected} should be")]
    Length {
        /// The number of elements, or "more".
        found: String,
        /// The allowed numbers.
        expected: String,
    },
    /// A function symbol that differs from that of the type.
    #[error("found the function symbol \"{}\" where {expected:?} should be", escape(.found))]
    Symbol {
        /// The symbol.
        found: String,
        /// The symbol of the type.
        expected: &'static str,
    },
    /// A function symbol, or a word, that no variant of the enum has.
    #[error("found \"{}\" where one of {expected:?} should be", escape(.found))]
    Variant {
        /// The symbol.
        found: String,
        /// The symbols of the enum.
        expected: &'static [&'static str],
    },
    /// A missing slot that the type requires.
    #[error("the slot :{0} is missing")]
    MissingSlot(&'static str),
    /// A slot that occurs twice.
    #[error("the slot :{0} is there twice")]
    DuplicateSlot(&'static str),
    /// A slot that a type with `deny_unknown_fields` does not have.
    #[error("unknown slot :{}, there are {expected:?}", escape(.found))]
    UnknownSlot {
        /// The slot.
        found: String,
        /// The slots of the type.
        expected: &'static [&'static str],
    },
    /// A constructed term without an SL notation.
    #[error(transparent)]
    Print(#[from] PrintError),
    /// An error of the type's own `Deserialize`.
    #[error("{}", escape(.0))]
    Custom(String),
}

impl DeserializeError {
    #[cold]
    pub(super) fn new(offset: usize, kind: DeserializeErrorKind) -> Self {
        Self(Box::new(Details {
            offset: Some(offset),
            path: Vec::new(),
            kind,
        }))
    }

    #[cold]
    fn elsewhere(kind: DeserializeErrorKind) -> Self {
        Self(Box::new(Details {
            offset: None,
            path: Vec::new(),
            kind,
        }))
    }

    /// Returns the reason.
    #[must_use]
    pub fn kind(&self) -> &DeserializeErrorKind {
        &self.0.kind
    }

    /// Returns the offset of the offending term from the start of the read bytes. For a missing
    /// slot, this is the offset of the term without the slot.
    #[must_use]
    pub fn offset(&self) -> usize {
        match &self.0.kind {
            DeserializeErrorKind::Syntax(error) => error.offset(),
            _ => self.0.offset.unwrap_or_default(),
        }
    }

    /// Returns the path of slots from the whole value to the offending term, for example `target.x`
    /// or `waypoints[2].yaw`. Empty for the whole value.
    #[must_use]
    pub fn slot(&self) -> String {
        let mut path = String::new();
        for step in self.0.path.iter().rev() {
            match step {
                Step::Slot(name) => {
                    if !path.is_empty() {
                        path.push('.');
                    }
                    path.push_str(name);
                }
                Step::Index(index) => path.push_str(&format!("[{index}]")),
            }
        }
        path
    }

    /// Sets the offset, unless it is already set.
    #[cold]
    pub(super) fn at(mut self, offset: usize) -> Self {
        self.0.offset.get_or_insert(offset);
        self
    }

    #[cold]
    pub(super) fn in_slot(mut self, name: &str) -> Self {
        self.0.path.push(Step::Slot(quoted(name)));
        self
    }

    #[cold]
    pub(super) fn in_element(mut self, index: usize) -> Self {
        self.0.path.push(Step::Index(index));
        self
    }
}

impl fmt::Display for DeserializeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let slot = self.slot();
        if !slot.is_empty() {
            write!(f, "slot {}: ", escape(&slot))?;
        }
        if !matches!(self.0.kind, DeserializeErrorKind::Syntax(_)) {
            write!(f, "at byte {}: ", self.offset())?;
        }
        self.0.kind.fmt(f)
    }
}

impl std::error::Error for DeserializeError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.0.kind.source()
    }
}

impl From<ParseError> for DeserializeError {
    #[cold]
    fn from(error: ParseError) -> Self {
        Self::new(error.offset(), DeserializeErrorKind::Syntax(error))
    }
}

impl From<PrintError> for DeserializeError {
    #[cold]
    fn from(error: PrintError) -> Self {
        Self::elsewhere(DeserializeErrorKind::Print(error))
    }
}

impl de::Error for DeserializeError {
    fn custom<T: fmt::Display>(message: T) -> Self {
        Self::elsewhere(DeserializeErrorKind::Custom(message.to_string()))
    }

    fn invalid_type(found: de::Unexpected<'_>, expected: &dyn de::Expected) -> Self {
        Self::elsewhere(DeserializeErrorKind::Type {
            found: described(found),
            expected: expected.to_string(),
        })
    }

    fn invalid_value(found: de::Unexpected<'_>, expected: &dyn de::Expected) -> Self {
        Self::elsewhere(DeserializeErrorKind::Value {
            found: described(found),
            expected: expected.to_string(),
        })
    }

    fn invalid_length(len: usize, expected: &dyn de::Expected) -> Self {
        Self::elsewhere(DeserializeErrorKind::Length {
            found: len.to_string(),
            expected: expected.to_string(),
        })
    }

    fn unknown_variant(variant: &str, expected: &'static [&'static str]) -> Self {
        let found = quoted(variant);
        Self::elsewhere(DeserializeErrorKind::Variant { found, expected })
    }

    fn unknown_field(field: &str, expected: &'static [&'static str]) -> Self {
        let found = quoted(field);
        Self::elsewhere(DeserializeErrorKind::UnknownSlot { found, expected })
    }

    fn missing_field(field: &'static str) -> Self {
        Self::elsewhere(DeserializeErrorKind::MissingSlot(field))
    }

    fn duplicate_field(field: &'static str) -> Self {
        Self::elsewhere(DeserializeErrorKind::DuplicateSlot(field))
    }
}

/// Returns the start of an untrusted text.
pub(super) fn quoted(text: &str) -> String {
    text.chars().take(MAX_QUOTED).collect()
}

/// Describes a found value in the terms of SL.
fn described(found: de::Unexpected<'_>) -> String {
    match found {
        de::Unexpected::Map | de::Unexpected::StructVariant => "a functional term".to_owned(),
        de::Unexpected::Str(text) => format!("the string \"{}\"", quoted(text)),
        other => quoted(&other.to_string()),
    }
}
