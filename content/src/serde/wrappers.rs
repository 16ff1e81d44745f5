//! Types for values without a serde type of their own: sets, times and agent identifiers.

use std::time::SystemTime;
use std::{fmt, ops};

use fipa_acl::{AgentId, Time, TimeError};
use serde::de::{self, Deserialize, Deserializer, Visitor};
use serde::ser::{Serialize, Serializer};

use super::names;
use crate::term::Term;

/// A collection that is written as a set: `(set tcp udp)`.
///
/// serde does not distinguish sets from sequences. So only collections in this type are written as
/// sets. All collections read both notations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Set<C>(pub C);

impl<C: Serialize> Serialize for Set<C> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_newtype_struct(names::SET, &self.0)
    }
}

impl<'de, C: Deserialize<'de>> Deserialize<'de> for Set<C> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        C::deserialize(deserializer).map(Self)
    }
}

impl<T, C: FromIterator<T>> FromIterator<T> for Set<C> {
    fn from_iter<I: IntoIterator<Item = T>>(elements: I) -> Self {
        Self(C::from_iter(elements))
    }
}

impl<C> ops::Deref for Set<C> {
    type Target = C;

    fn deref(&self) -> &C {
        &self.0
    }
}

/// A time that is written as a date-time constant: `20000508T042651481Z`.
///
/// Other formats than SL use the same text.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct DateTime(pub Time);

impl DateTime {
    /// Returns the time in UTC, truncated to milliseconds.
    ///
    /// # Errors
    /// When the year does not have four digits.
    pub fn from_system_time(time: SystemTime) -> Result<Self, TimeError> {
        Time::from_system_time(time).map(Self)
    }
}

impl From<Time> for DateTime {
    fn from(time: Time) -> Self {
        Self(time)
    }
}

impl Serialize for DateTime {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_newtype_struct(names::DATE_TIME, &self.0.to_string())
    }
}

impl<'de> Deserialize<'de> for DateTime {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_newtype_struct(names::DATE_TIME, TimeVisitor)
    }
}

struct TimeVisitor;

impl<'de> Visitor<'de> for TimeVisitor {
    type Value = DateTime;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a date-time")
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(
        self,
        deserializer: D,
    ) -> Result<Self::Value, D::Error> {
        deserializer.deserialize_str(self)
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<Self::Value, E> {
        text.parse().map(DateTime).map_err(E::custom)
    }
}

/// An agent identifier: `(agent-identifier :name crex)`.
///
/// Other formats than SL use the text of that term.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct Agent(pub AgentId);

impl From<AgentId> for Agent {
    fn from(agent: AgentId) -> Self {
        Self(agent)
    }
}

impl Serialize for Agent {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        Term::from(&self.0).serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Agent {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let term = Term::deserialize(deserializer)?;
        AgentId::try_from(&term)
            .map(Self)
            .map_err(de::Error::custom)
    }
}
