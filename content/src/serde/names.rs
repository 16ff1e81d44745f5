//! Names of newtypes that the serializer and the deserializer treat in a way of their own. In other
//! formats than SL they are what serde makes of any newtype: the value inside.

/// A sequence that is written as a set.
pub(super) const SET: &str = "$fipa_content::Set";
/// The text of a date-time.
pub(super) const DATE_TIME: &str = "$fipa_content::DateTime";
/// The text of a term in the standard dialect.
pub(super) const TERM: &str = "$fipa_content::Term";
