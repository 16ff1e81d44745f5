//! The bit-efficient encoding of messages (FIPA00069, edition G), and the parts that envelopes
//! (FIPA00088) share with it.
//!
//! The reader is lenient: it accepts the standard and what fipa_services and JADE write. The writer
//! is strict: version 1.0, a word if the text is one and a string literal otherwise, the content
//! last and with its length, no code tables. Messages with code tables are read with a table that
//! the caller owns.

pub(crate) mod agent_id;
pub(crate) mod code;
mod code_table;
pub(crate) mod dialects;
pub(crate) mod expression;
pub(crate) mod identifier;
pub(crate) mod notes;
pub(crate) mod reader;
mod view;
pub(crate) mod write;

pub(crate) use agent_id::{InMessages, without_x};
pub use code_table::CodeTable;
pub(crate) use identifier::{next as next_agent_id, next_part as next_agent_id_part};
pub(crate) use view::{next_user_defined, view, view_noting, view_split};
pub use write::{encode, encoded_len};
