//! The bit-efficient encoding of messages (FIPA00069, edition G) and what its envelopes
//! (FIPA00088) share with it.
//!
//! Reading is lenient: it takes the standard and what fipa_services and JADE write. Writing is
//! strict: version 1.0, words where the text is one and string literals elsewhere, content last
//! and with its length in front, no code tables. Those are read with a table of the caller's.

mod agent_id;
mod code_table;
mod decode;
pub(crate) mod dialects;
pub(crate) mod notes;
pub(crate) mod reader;
pub(crate) mod text;
mod view;
pub(crate) mod write;

pub(crate) use agent_id::without_x;
pub use agent_id::{AgentIdView, AgentIds};
pub use code_table::CodeTable;
pub(crate) use decode::decode;
pub use text::Text;
pub use view::MessageView;
pub use write::{encode, encoded_len};
