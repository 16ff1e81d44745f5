//! The string encoding of messages (FIPA00070, edition I).
//!
//! Reading is lenient: it takes the standard and what fipa_services (no white space at all) and
//! JADE (upper case, quoted words, Base64) write. Writing is strict, in the hand of one of the
//! three. Here the grammar; [`crate::Message::decode`] and [`crate::Message::encode`] are the way
//! in.

pub(crate) mod agent_id;
mod lex;
mod read;
mod write;

pub(crate) use read::{next_user_defined, view};
pub(crate) use write::encode;
