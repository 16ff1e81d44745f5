//! FIPA messages, envelopes and letters, and their encodings.
//!
//! What lives here: the value types of the FIPA standards and the code that turns them into bytes
//! and back. What must not: input and output, clocks, threads, `unsafe`.
//!
//! * [`Message`] is what agents say to each other (FIPA00061), made with [`Message::builder`] and
//!   encoded with [`Message::to_payload`], or [`Message::encode`] where the reader needs another
//!   encoding than the bit-efficient one. [`MessageView`] reads one without allocating.
//! * [`Envelope`] is what message transport services read (FIPA00067): a base and the extensions
//!   that services put in front on the way. [`EnvelopeView`] is its borrowed counterpart.
//! * [`Letter`] is both, encoded, and what everything else in this project passes around.
//! * [`escape`] makes text from outside fit for a terminal or a log.
//! * [`explain()`] tells people what every byte of a bit-efficient message or letter means.
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
//! Bytes from outside are hostile until checked: every length and depth has a bound, and a
//! [`DecodeError`] says where the bytes break which clause.

pub mod bitefficient;

mod agent_id;
mod builder;
mod codec;
mod dialect;
mod envelope;
mod error;
mod escape;
mod explain;
#[cfg(feature = "json")]
pub mod json;
mod letter;
mod message;
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
    Envelope, EnvelopeParams, EnvelopeView, Received, ReceiverNames, StampView, Stamps,
};
pub use error::{DecodeError, EncodeError, Problem};
pub use escape::{escape, is_unprintable};
pub use explain::{Explanation, Span, explain};
pub use letter::{Letter, Payload};
pub use message::Message;
pub use performative::{Performative, PerformativeError, UserPerformative};
pub use representation::{AclRepresentation, Representation};
pub use time::{Base, Time, TimeError, Zone};
pub use view::{AgentIdView, AgentIds, MessageView, Text};
