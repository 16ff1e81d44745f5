//! Names of newtypes with special treatment by the serializer and the deserializer. Other formats
//! than SL treat them as any newtype: as the value inside.

/// A sequence that is written as a set.
pub(super) const SET: &str = "$fipa_content::Set";
/// The text of a date-time.
pub(super) const DATE_TIME: &str = "$fipa_content::DateTime";
/// The text of a term in the standard dialect.
pub(super) const TERM: &str = "$fipa_content::Term";
