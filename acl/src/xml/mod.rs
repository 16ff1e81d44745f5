//! The XML encodings: messages (FIPA00071) and envelopes (FIPA00085).
//!
//! [`reader`] walks over elements and knows nothing of FIPA; the other modules know what the
//! elements mean. Nothing of a document type definition is ever processed, and no entities but the
//! five of XML itself exist.
//!
//! Reading takes what the standard, fipa_services and JADE write: tags in any case, values as
//! attribute or text, one element per agent or one for all, unknown elements passed over, and
//! content in CDATA sections byte for byte, even where that is no XML. What is written is XML 1.0
//! to the letter.

mod agent_id;
mod envelope_read;
mod envelope_write;
mod message_read;
mod message_write;
mod plain;
mod reader;
mod tag;
mod value;
mod writer;

pub(crate) use agent_id::{AgentSet, next_part};
pub(crate) use envelope_read::{EnvelopeReader, next_received_user_defined};
pub(crate) use envelope_write::encode as encode_envelope;
pub(crate) use message_read::{next_user_defined, view};
pub(crate) use message_write::encode;
pub(crate) use value::{Whitespace, unescaped};
