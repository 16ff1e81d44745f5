//! The bit-efficient encoding of messages (FIPA00069, edition G) and what its envelopes
//! (FIPA00088) share with it.
//!
//! Reading is lenient: it takes the standard and what fipa_services and JADE write. Writing is
//! strict: version 1.0, words where the text is one and string literals elsewhere, content last
//! and with its length in front, no code tables. Those are read with a table of the caller's.

pub(crate) mod agent_id;
mod code_table;
pub(crate) mod dialects;
pub(crate) mod expression;
pub(crate) mod notes;
pub(crate) mod reader;
mod view;
pub(crate) mod write;

pub(crate) use agent_id::without_x;
pub use code_table::CodeTable;
pub(crate) use view::{next_user_defined, view, view_noting, view_split};
pub use write::{encode, encoded_len};
