//! Descriptions of actions, and the check of goals against them.

use std::borrow::Cow;
use std::fmt;
use std::ops::{Bound, RangeBounds};

use fipa_content::{Arguments, Number, Parameter, SerializeError, Term};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::message::Refusal;
use crate::types::{Type, kind};

/// The function symbol of a value with its unit: `(quantity :value 3 :unit "m/s")`.
const QUANTITY: &str = "quantity";

/// The description of an action.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename = "action-description")]
#[non_exhaustive]
pub struct ActionDescription {
    /// The name of the action.
    pub name: String,
    /// The action in words.
    pub description: Option<String>,
    /// The parameters.
    pub parameters: Vec<ParameterDescription>,
    /// The type of the result; [`Type::Nothing`] if there is none.
    pub result: Type,
    /// The treatment of a goal while another one runs.
    pub policy: Policy,
    /// Whether a goal needs the fence of a lock.
    pub fenced: bool,
}

/// The description of a parameter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename = "parameter")]
#[non_exhaustive]
pub struct ParameterDescription {
    /// The name.
    pub name: String,
    /// The type.
    #[serde(rename = "type")]
    pub value_type: Type,
    /// The unit, and the frame of reference where there is one: `m, rad; frame crex/base`.
    pub unit: Option<String>,
    /// The range of a number.
    pub range: Option<Range>,
    /// The value if the parameter is left out. In JSON, the text of the value in SL.
    pub default: Option<Term<'static>>,
    /// The parameter in words.
    pub description: Option<String>,
    /// Whether the parameter may be left out without a default.
    pub optional: bool,
}

/// A range of numbers. Both bounds are within it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename = "range")]
pub struct Range {
    /// The least number; without it, there is no lower bound.
    pub min: Option<f64>,
    /// The greatest number; without it, there is no upper bound.
    pub max: Option<f64>,
}

/// The treatment of a goal while as many goals of the action run as may run at the same time.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Policy {
    /// The goal is refused.
    Reject,
    /// The goal waits. Holds the maximum number of waiting goals.
    Queue(u32),
    /// The earliest running goal is stopped, and the new one starts then.
    Preempt,
}

impl ActionDescription {
    /// Creates a description of an action without parameters and result.
    #[must_use]
    pub fn new(name: impl Into<String>) -> Self {
        Self {
            name: name.into(),
            description: None,
            parameters: Vec::new(),
            result: Type::Nothing,
            policy: Policy::Reject,
            fenced: false,
        }
    }

    /// Checks the arguments of a goal. Returns them with the defaults, in the order of the parameters.
    ///
    /// # Errors
    /// Returns the first parameter that is wrong, with the reason.
    pub fn admit(
        &self,
        arguments: Vec<Parameter<'static>>,
    ) -> Result<Vec<Parameter<'static>>, Refusal> {
        let mut given: Vec<Option<Term<'static>>> = self.parameters.iter().map(|_| None).collect();
        for Parameter { name, value } in arguments {
            let at = self.parameters.iter().position(|it| it.name == name);
            let Some(slot) = at.and_then(|at| given.get_mut(at)) else {
                return Err(Refusal::UnknownParameter(short(&name)));
            };
            if slot.replace(value).is_some() {
                return Err(Refusal::RepeatedParameter(name.into_owned()));
            }
        }
        let mut admitted = Vec::with_capacity(self.parameters.len());
        for (parameter, value) in self.parameters.iter().zip(given) {
            let value = match (value, &parameter.default) {
                (Some(value), _) => parameter.check(value)?,
                (None, Some(default)) => default.clone(),
                (None, None) if parameter.optional => continue,
                (None, None) => return Err(Refusal::MissingParameter(parameter.name.clone())),
            };
            let name = Cow::Owned(parameter.name.clone());
            admitted.push(Parameter { name, value });
        }
        Ok(admitted)
    }
}

impl ParameterDescription {
    /// Creates a description of a parameter of the type `T`. An `Option` is a parameter that may be
    /// left out.
    #[must_use]
    pub fn of<T: DeserializeOwned>(name: impl Into<String>) -> Self {
        let (value_type, optional) = Type::with_option::<T>();
        Self {
            name: name.into(),
            value_type,
            unit: None,
            range: None,
            default: None,
            description: None,
            optional,
        }
    }

    /// Sets the unit, and the frame of reference where there is one: `m, rad; frame crex/base`.
    #[must_use]
    pub fn unit(mut self, unit: impl Into<String>) -> Self {
        self.unit = Some(unit.into()).filter(|unit: &String| !unit.is_empty());
        self
    }

    /// Sets the range of a number. An excluded bound counts as included.
    #[must_use]
    pub fn range(mut self, range: impl RangeBounds<f64>) -> Self {
        let bound = |bound: Bound<&f64>| match bound {
            Bound::Included(&at) | Bound::Excluded(&at) => Some(at).filter(|at| at.is_finite()),
            Bound::Unbounded => None,
        };
        self.range = Some(Range {
            min: bound(range.start_bound()),
            max: bound(range.end_bound()),
        });
        self
    }

    /// Sets the value if the parameter is left out.
    ///
    /// # Errors
    /// If SL has no notation for the value.
    pub fn default(mut self, value: &(impl Serialize + ?Sized)) -> Result<Self, SerializeError> {
        self.default = Some(Term::from_value(value)?);
        Ok(self)
    }

    /// Sets the description in words.
    #[must_use]
    pub fn described(mut self, text: impl Into<String>) -> Self {
        self.description = Some(text.into());
        self
    }

    /// Checks a value of the parameter.
    ///
    /// # Errors
    /// If the value has another type or unit, or is out of range.
    pub(crate) fn check(&self, value: Term<'static>) -> Result<Term<'static>, Refusal> {
        let value = self.without_unit(value)?;
        let value = self.value_type.check(value).map_err(|mismatch| {
            let path = mismatch.within(&self.name);
            Refusal::WrongType(short(&path.path), short(&path.expected), short(&path.found))
        })?;
        if let (Some(range), Term::Number(number)) = (&self.range, &value)
            && !number.as_f64().is_some_and(|at| range.contains(at))
        {
            return Err(self.out_of_range(range, number));
        }
        Ok(value)
    }

    fn out_of_range(&self, range: &Range, number: &Number<'_>) -> Refusal {
        let range = range.to_string();
        Refusal::OutOfRange(self.name.clone(), range, short(number.as_str()))
    }

    /// Takes the value out of `(quantity :value v :unit u)`, if the parameter is not of that type.
    fn without_unit(&self, value: Term<'static>) -> Result<Term<'static>, Refusal> {
        let Term::Functional(term) = &value else {
            return Ok(value);
        };
        let is_own =
            matches!(&self.value_type, Type::Any | Type::Structure { .. }) && self.unit.is_none();
        if is_own || term.symbol != QUANTITY {
            return Ok(value);
        }
        let unit = term.parameter("unit").and_then(Term::as_str);
        let wrong = |found: &str| {
            let expected = self.unit.clone().unwrap_or_default();
            Refusal::WrongUnit(self.name.clone(), expected, short(found))
        };
        match unit {
            Some(unit) if self.unit.as_deref() == Some(unit) => {}
            Some(unit) => return Err(wrong(unit)),
            None => return Err(wrong("")),
        }
        let Term::Functional(term) = value else {
            return Ok(value);
        };
        let Arguments::Parameters(slots) = term.arguments else {
            return Err(wrong(""));
        };
        let found = slots.into_iter().find(|slot| slot.name == "value");
        found.map(|slot| slot.value).ok_or_else(|| {
            Refusal::WrongType(
                self.name.clone(),
                short(&self.value_type.to_string()),
                "nothing".into(),
            )
        })
    }

    /// Whether the default is a value of the parameter.
    pub(crate) fn has_valid_default(&self) -> bool {
        let default = self.default.clone();
        default.is_none_or(|default| {
            !matches!(kind(&default).as_str(), "expression") && self.check(default).is_ok()
        })
    }
}

impl Range {
    /// Whether a number is within the range.
    #[must_use]
    pub fn contains(&self, at: f64) -> bool {
        self.min.is_none_or(|min| at >= min) && self.max.is_none_or(|max| at <= max)
    }
}

impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (self.min, self.max) {
            (Some(min), Some(max)) => write!(f, "{min} to {max}"),
            (Some(min), None) => write!(f, "at least {min}"),
            (None, Some(max)) => write!(f, "at most {max}"),
            (None, None) => f.write_str("any number"),
        }
    }
}

/// Returns the start of a text.
pub(crate) fn short(text: &str) -> String {
    const SHOWN: usize = 120;
    text.chars().take(SHOWN).collect()
}
