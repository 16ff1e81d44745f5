//! Whose hand to write in, where peers read less than the standard allows.

use std::fmt;

use crate::Text;
use crate::error::EncodeError;
use crate::time::{Time, Zone};
use crate::word::is_word;

/// The user-defined parameter by which JADE says that content is Base64, without `X-`.
pub(crate) const JADE_ENCODING: &str = "JADE-Encoding";
/// The value that says so, whatever its case.
pub(crate) const BASE64: &str = "Base64";

/// Whether the user-defined parameter makes readers take the content for Base64.
pub(crate) fn announces_base64(name: &Text<'_>, value: &Text<'_>) -> bool {
    name.raw().len() >= JADE_ENCODING.len()
        && name.as_str().eq_ignore_ascii_case(JADE_ENCODING)
        && value.as_str().trim().eq_ignore_ascii_case(BASE64)
}

/// Which reader an encoding is written for.
///
/// Reading needs none of this: every reader takes the standard and what both peers write.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Dialect {
    /// The standard to the letter.
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

/// A time for fipa_services, which reads no zones and takes every time for its local one: both
/// ends are to live in the same zone, so a time in UTC is written without saying so.
pub(crate) fn local_time(what: &'static str, time: Time) -> Result<Time, EncodeError> {
    let why = match time.zone() {
        _ if time.is_relative() => "fipa_services knows no relative times",
        Zone::Letter(_) => "fipa_services knows no zones",
        Zone::Utc | Zone::Unspecified => {
            let zone = Zone::Unspecified;
            return Ok(Time { zone, ..time });
        }
    };
    Err(EncodeError::Unrepresentable { what, why })
}

/// Checks that fipa_services reads this as a word, in messages of either of its encodings.
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
        why: "it is not a FIPA00070 word (no blanks or parentheses, and not beginning with a \
              digit, '#', '-', '@' or '\"')",
    }
}
