//! The string encoding of messages (FIPA00070, edition I).
//!
//! The reader is lenient: it accepts the standard and what fipa_services (no white space) and JADE
//! (upper case, quoted words, Base64) write. The writer is strict and writes one of the three
//! dialects. [`crate::Message::decode`] and [`crate::Message::encode`] use this module.

pub(crate) mod agent_id;
mod lex;
mod read;
mod write;

pub(crate) use read::{next_user_defined, view};
pub(crate) use write::encode;
