//! The dialects of the encodings: the standard, and the two peers, which read less than it allows.

use std::fmt;

use crate::Text;
use crate::error::EncodeError;
use crate::time::{Time, Zone};
use crate::word::is_word;

/// Name, without its `X-`, of the user-defined parameter that names the encoding of the content in
/// JADE.
pub(crate) const JADE_ENCODING: &str = "JADE-Encoding";
/// Value of [`JADE_ENCODING`] for content in Base64, in any case.
pub(crate) const BASE64: &str = "Base64";

/// Whether the user-defined parameter marks the content as Base64.
pub(crate) fn announces_base64(name: &Text<'_>, value: &Text<'_>) -> bool {
    name.raw().len() >= JADE_ENCODING.len()
        && name.as_str().eq_ignore_ascii_case(JADE_ENCODING)
        && value.as_str().trim().eq_ignore_ascii_case(BASE64)
}

/// The dialect of an encoding, by the implementation that reads it.
///
/// Decoding needs no dialect: it accepts the standard and what both peers write.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Dialect {
    /// Strictly the standard.
    #[default]
    Standard,
    /// The C++ libraries `fipa_acl` and `fipa_services`.
    FipaServices,
    /// JADE with its add-ons.
    Jade,
}

impl fmt::Display for Dialect {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Standard => "standard",
            Self::FipaServices => "fipa_services",
            Self::Jade => "JADE",
        })
    }
}

/// Returns a time without its zone for fipa_services, which reads every time as a local one.
///
/// A time in UTC keeps its fields. So both peers must run in UTC for the time to be the same.
pub(crate) fn local_time(what: &'static str, time: Time) -> Result<Time, EncodeError> {
    let why = match time.zone() {
        _ if time.is_relative() => "fipa_services reads no relative times",
        Zone::Letter(_) => "fipa_services reads no time zones",
        Zone::Utc | Zone::Unspecified => {
            let zone = Zone::Unspecified;
            return Ok(Time { zone, ..time });
        }
    };
    Err(EncodeError::Unrepresentable { what, why })
}

/// Checks that fipa_services reads the text as a word of a message.
pub(crate) fn check_word(what: &'static str, text: &str) -> Result<(), EncodeError> {
    if !is_word(text) {
        return Err(not_a_word(what));
    }
    if !text.is_ascii() {
        let why = "fipa_services reads words of ASCII characters only";
        return Err(EncodeError::Unrepresentable { what, why });
    }
    Ok(())
}

pub(crate) fn not_a_word(what: &'static str) -> EncodeError {
    EncodeError::Unrepresentable {
        what,
        why: "it is not a FIPA00070 word (a word has no blanks or parentheses and does not begin \
              with a digit, '#', '-', '@' or '\"')",
    }
}
