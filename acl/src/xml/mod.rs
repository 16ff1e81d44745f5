//! The XML encodings: messages (FIPA00071) and envelopes (FIPA00085).
//!
//! [`reader`] parses elements independently of FIPA. The other modules handle the elements of FIPA.
//! Document type definitions are not processed, and the only entities are the five of XML.
//!
//! The reader accepts what the standard, fipa_services and JADE write: tags in any case, values as
//! attribute or text, and one element per agent or one for all. It skips unknown elements, and
//! accepts any bytes in CDATA sections, even those that XML forbids. An envelope may be in ISO-8859-1 if
//! it declares that. JADE writes envelopes over HTTP in ISO-8859-1 without declaring it; a name with
//! characters outside ASCII is then refused, as XML 1.0 clause 4.3.3 requires. The writer is strict: its output
//! is XML 1.0.

mod agent_id;
mod encoding;
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
pub(crate) use encoding::DeclaredEncoding;
pub(crate) use envelope_read::{EnvelopeReader, next_received_user_defined};
pub(crate) use envelope_write::encode as encode_envelope;
pub(crate) use message_read::{next_user_defined, view};
pub(crate) use message_write::encode;
pub(crate) use value::{Whitespace, unescaped};
