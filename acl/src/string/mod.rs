//! The string encoding of messages (FIPA00070, edition I).
//!
//! Reading is lenient: it takes the standard and what fipa_services (no white space at all) and
//! JADE (upper case, quoted words, Base64) write. Writing is strict, in the hand of one of the
//! three. Here the grammar; [`crate::Message::decode`] and [`crate::Message::encode`] are the way
//! in.

mod lex;
mod read;
mod write;

use crate::dialect::{BASE64, JADE_ENCODING};

pub(crate) use read::decode;
pub(crate) use write::encode;

/// Whether the user-defined parameter makes readers take the content for Base64.
fn announces_base64((name, value): &(String, String)) -> bool {
    name.eq_ignore_ascii_case(JADE_ENCODING) && value.eq_ignore_ascii_case(BASE64)
}
