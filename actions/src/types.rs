//! Types of parameters and results, and the check of values against them.

use std::borrow::Cow;
use std::fmt;

use fipa_content::{Arguments, FunctionalTerm, Parameter, Term};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::probe;

/// The function symbol of JSON objects without a symbol of their own.
pub(crate) const OBJECT: &str = "object";

/// A type of values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Type {
    /// No value.
    Nothing,
    /// Any value.
    Any,
    /// A truth value.
    Boolean,
    /// An integer.
    Integer,
    /// A number; integers are numbers, too.
    Number,
    /// A text.
    String,
    /// A byte string.
    Bytes,
    /// A date and time.
    Time,
    /// One of these words, or a functional term with one of them as its symbol.
    Choice {
        /// The words.
        of: Vec<String>,
    },
    /// A sequence or set.
    List {
        /// The type of the elements.
        of: Box<Type>,
    },
    /// A functional term with named arguments.
    Structure {
        /// The function symbol.
        name: String,
        /// The arguments.
        fields: Vec<Field>,
    },
}

/// A named argument of a [`Type::Structure`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename = "field")]
pub struct Field {
    /// The name.
    pub name: String,
    /// The type.
    #[serde(rename = "type")]
    pub value_type: Type,
    /// Whether the argument may be left out.
    pub optional: bool,
}

/// A value that does not have the required type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mismatch {
    /// The path from the checked value to the offending one, for example `x` or `waypoints[2].x`.
    pub path: String,
    /// The required type.
    pub expected: String,
    /// The kind of the value.
    pub found: String,
}

impl Type {
    /// Returns the type of the values that serde reads as `T`.
    ///
    /// Fields with `#[serde(default)]` count as required, and maps and enums with content as
    /// [`Type::Any`] or [`Type::Choice`]: serde does not tell more about them.
    #[must_use]
    pub fn of<T: DeserializeOwned>() -> Self {
        probe::of::<T>().0
    }

    /// Returns the type of `T`, and whether `T` is an `Option`.
    pub(crate) fn with_option<T: DeserializeOwned>() -> (Self, bool) {
        probe::of::<T>()
    }

    /// Checks a value, and returns it with the function symbols of the type.
    ///
    /// # Errors
    /// Returns the first part of the value that does not have its type.
    pub fn check(&self, value: Term<'static>) -> Result<Term<'static>, Mismatch> {
        match (self, value) {
            (Self::Any, value) => Ok(value),
            (Self::Boolean, value @ Term::Boolean(_))
            | (Self::String, value @ Term::String(_))
            // A byte string that is UTF-8 is a string in SL.
            | (Self::Bytes, value @ (Term::Bytes(_) | Term::String(_)))
            | (Self::Time, value @ Term::DateTime(_)) => Ok(value),
            // JSON has no times of its own.
            (Self::Time, Term::String(text)) => match Term::parse(text.as_bytes()) {
                Ok(time @ Term::DateTime(_)) => Ok(time.into_owned()),
                _ => Err(Mismatch {
                    path: String::new(),
                    expected: self.to_string(),
                    found: "string".to_owned(),
                }),
            },
            (Self::Integer, Term::Number(number)) if number.is_integer() => {
                Ok(Term::Number(number))
            }
            (Self::Number, Term::Number(number)) if number.as_f64().is_some() => {
                Ok(Term::Number(number))
            }
            (Self::Choice { of }, Term::String(word)) if of.iter().any(|it| *it == *word) => {
                Ok(Term::String(word))
            }
            (Self::Choice { of }, Term::Functional(term))
                if of.iter().any(|it| *it == *term.symbol) =>
            {
                Ok(Term::Functional(term))
            }
            (Self::List { of }, Term::Sequence(elements)) => of.check_all(elements).map(Term::Sequence),
            (Self::List { of }, Term::Set(elements)) => of.check_all(elements).map(Term::Set),
            (Self::Structure { name, fields }, Term::Functional(term)) => {
                structure(name, fields, term)
            }
            (_, value) => Err(Mismatch {
                path: String::new(),
                expected: self.to_string(),
                found: kind(&value),
            }),
        }
    }

    fn check_all(&self, elements: Vec<Term<'static>>) -> Result<Vec<Term<'static>>, Mismatch> {
        let elements = elements.into_iter().enumerate();
        elements
            .map(|(at, element)| {
                let checked = self.check(element);
                checked.map_err(|mismatch| mismatch.within(&format!("[{at}]")))
            })
            .collect()
    }
}

fn structure(
    name: &str,
    fields: &[Field],
    term: FunctionalTerm<'static>,
) -> Result<Term<'static>, Mismatch> {
    let mismatch = |path: &str, expected: String, found: String| Mismatch {
        path: path.to_owned(),
        expected,
        found,
    };
    if term.symbol != name && term.symbol != OBJECT {
        return Err(mismatch("", name.to_owned(), term.symbol.into_owned()));
    }
    let given = match term.arguments {
        Arguments::Parameters(given) => given,
        // Arguments by position are those of the fields in their order.
        Arguments::Terms(terms) if terms.len() <= fields.len() => {
            let named = terms.into_iter().zip(fields);
            let named = named.map(|(value, field)| Parameter {
                name: Cow::Owned(field.name.clone()),
                value,
            });
            named.collect()
        }
        Arguments::Terms(terms) => {
            let (at_most, found) = (fields.len(), terms.len());
            return Err(mismatch(
                "",
                format!("at most {at_most} arguments"),
                format!("{found} arguments"),
            ));
        }
    };
    let mut checked: Vec<Parameter<'static>> = Vec::with_capacity(given.len());
    for parameter in given {
        let Some(field) = fields.iter().find(|field| field.name == parameter.name) else {
            return Err(mismatch(
                &parameter.name,
                "no such field".into(),
                "a value".into(),
            ));
        };
        if checked.iter().any(|known| known.name == parameter.name) {
            return Err(mismatch(
                &parameter.name,
                "one value".into(),
                "two values".into(),
            ));
        }
        let value = field.value_type.check(parameter.value);
        checked.push(Parameter {
            value: value.map_err(|mismatch| mismatch.within(&field.name))?,
            name: parameter.name,
        });
    }
    let missing = fields
        .iter()
        .find(|field| !field.optional && checked.iter().all(|known| known.name != field.name));
    if let Some(missing) = missing {
        return Err(mismatch(
            &missing.name,
            missing.value_type.to_string(),
            "nothing".into(),
        ));
    }
    Ok(Term::Functional(FunctionalTerm {
        symbol: Cow::Owned(name.to_owned()),
        arguments: Arguments::Parameters(checked),
    }))
}

impl Mismatch {
    /// Returns the same mismatch seen from the value around it.
    pub(crate) fn within(self, step: &str) -> Self {
        let separator = if self.path.is_empty() || self.path.starts_with('[') {
            ""
        } else {
            "."
        };
        Self {
            path: format!("{step}{separator}{}", self.path),
            ..self
        }
    }
}

/// Returns the kind of a value in words.
pub(crate) fn kind(value: &Term<'_>) -> String {
    match value {
        Term::Number(number) if number.is_integer() => "integer".to_owned(),
        Term::Number(_) => "number".to_owned(),
        Term::String(_) => "string".to_owned(),
        Term::Bytes(_) => "bytes".to_owned(),
        Term::Boolean(_) => "boolean".to_owned(),
        Term::DateTime(_) => "time".to_owned(),
        Term::Sequence(_) | Term::Set(_) => "list".to_owned(),
        Term::Functional(term) => term.symbol.chars().take(60).collect(),
        _ => "expression".to_owned(),
    }
}

impl fmt::Display for Type {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Nothing => f.write_str("nothing"),
            Self::Any => f.write_str("any"),
            Self::Boolean => f.write_str("boolean"),
            Self::Integer => f.write_str("integer"),
            Self::Number => f.write_str("number"),
            Self::String => f.write_str("string"),
            Self::Bytes => f.write_str("bytes"),
            Self::Time => f.write_str("time"),
            Self::Choice { of } => f.write_str(&of.join(" | ")),
            Self::List { of } => write!(f, "list of {of}"),
            Self::Structure { name, fields } => {
                write!(f, "{name}(")?;
                for (at, field) in fields.iter().enumerate() {
                    let comma = if at == 0 { "" } else { ", " };
                    let mark = if field.optional { "?" } else { "" };
                    write!(f, "{comma}{}{mark}: {}", field.name, field.value_type)?;
                }
                f.write_str(")")
            }
        }
    }
}
