//! FIPA messages, envelopes and letters, and their encodings.
//!
//! The crate has the value types of the FIPA standards, their encoders and their decoders. It has no
//! input or output, no clocks, no threads and no `unsafe`.
//!
//! * [`Message`]: a message between agents (FIPA00061). [`Message::builder`] makes one,
//!   [`Message::to_payload`] encodes it bit-efficiently, and [`Message::encode`] in any encoding and
//!   dialect. [`MessageView`] reads an encoded message without allocating.
//! * [`Envelope`]: the parameters for message transport services (FIPA00067), a base and the
//!   extensions that services add. [`EnvelopeView`] is its borrowed counterpart.
//! * [`Letter`]: an encoded envelope and an encoded message, the unit that the other crates of this
//!   project transport.
//! * [`escape`]: makes text from outside safe for a terminal or a log.
//! * `Pattern`, with the feature `pattern`: a regular expression that matches whole names.
//! * [`explain()`]: explains every byte of a bit-efficient message or letter.
//!
//! ```
//! use fipa_acl::{AgentId, Message, Performative};
//!
//! let request = Message::builder(Performative::Request)
//!     .sender(AgentId::new("alice")?)
//!     .receiver(AgentId::new("crane")?)
//!     .protocol("fipa-request")
//!     .conversation_id("lift 7")
//!     .content("lift the crate")
//!     .build()?;
//! let received = Message::decode(&request.to_payload())?;
//! let answer = received
//!     .reply(Performative::Agree)
//!     .sender(AgentId::new("crane")?)
//!     .build()?;
//! assert!(answer.is_reply_to(&request));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Decoding accepts hostile bytes: every length and depth has a bound. A [`DecodeError`] has the
//! offset, the problem and the violated clause.

pub mod bitefficient;

mod agent_id;
mod builder;
mod codec;
mod dialect;
mod envelope;
mod error;
mod error_chain;
mod escape;
mod explain;
#[cfg(feature = "json")]
pub mod json;
mod letter;
mod message;
mod name;
#[cfg(feature = "pattern")]
mod pattern;
mod performative;
mod representation;
mod scan;
mod string;
mod time;
mod view;
mod word;
mod xml;

pub use agent_id::{AgentId, AgentIdError};
pub use bitefficient::CodeTable;
pub use builder::{BuildError, MessageBuilder};
pub use dialect::Dialect;
pub use envelope::{
    Envelope, EnvelopeParams, EnvelopeTemplate, EnvelopeView, Received, ReceiverNames, StampView,
    Stamps,
};
pub use error::{DecodeError, EncodeError, Problem};
pub use error_chain::ErrorChain;
pub use escape::{escape, escape_name, is_unprintable};
pub use explain::{Explanation, Span, explain};
pub use letter::{Letter, Payload};
pub use message::{ContentError, Message};
pub use name::{is_pattern, misleading_character};
#[cfg(feature = "pattern")]
pub use pattern::{Pattern, PatternError};
pub use performative::{Performative, PerformativeError, UserPerformative};
pub use representation::{AclRepresentation, Representation};
pub use time::{Base, Time, TimeError, Zone};
pub use view::{AgentIdView, AgentIds, MessageIndex, MessageView, Text};
