//! The envelope (FIPA00067): the parameters of a letter that message transport services read.

pub(crate) mod agent_id;
mod decode;
pub(crate) mod parts;
mod read;
mod view;
mod write;

use std::collections::HashSet;

pub(crate) use agent_id::InEnvelopes;
pub use view::{EnvelopeView, ReceiverNames, StampView, Stamps};
pub use write::EnvelopeTemplate;
pub(crate) use write::encode;

use crate::error::EncodeError;
use crate::{AclRepresentation, AgentId, Time};

/// An envelope (FIPA00067): a base and the extensions that services have added.
///
/// A service never changes existing parameters. A service that forwards a letter adds an extension
/// with its stamp ([`EnvelopeParams::received`]) and the parameters that it overrides. The newest
/// value of a parameter counts ([`effective`](Self::effective)).
///
/// Encodings: bit-efficient (FIPA00088) and XML (FIPA00085).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Envelope {
    /// The parameters that the sender's transport service wrote.
    pub base: EnvelopeParams,
    /// The extensions that other services have added, oldest first.
    pub extensions: Vec<EnvelopeParams>,
}

/// The parameters of a base or an extension envelope. An absent parameter is `None` or empty.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EnvelopeParams {
    /// Receivers of the letter, as the sender named them.
    pub to: Vec<AgentId>,
    /// Sender of the letter. It receives failure reports.
    pub from: Option<AgentId>,
    /// Comments for the final recipient.
    pub comments: Option<String>,
    /// Encoding of the message.
    pub acl_representation: Option<AclRepresentation>,
    /// Length of the encoded message in bytes.
    pub payload_length: Option<u64>,
    /// Character set of the encoded message. US-ASCII if absent.
    pub payload_encoding: Option<String>,
    /// Time at which the envelope was made.
    pub date: Option<Time>,
    /// Receivers of this copy of the letter. They override [`to`](Self::to).
    pub intended_receivers: Vec<AgentId>,
    /// The stamp of the transport service that received the letter.
    pub received: Option<Received>,
    /// Requirements on the transport.
    pub transport_behaviour: Option<String>,
    /// Names, without their `X-`, and values of user-defined parameters. The last of several with
    /// the same name counts.
    pub user_defined: Vec<(String, String)>,
}

/// The stamp of a transport service (FIPA00067 `received-object`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Received {
    /// Address or name of the service that received the letter.
    pub by: String,
    /// Address of the service that sent the letter.
    pub from: Option<String>,
    /// Time at which the service received the letter.
    pub date: Time,
    /// Identifier of the letter at the service that sent it.
    pub id: Option<String>,
    /// Type of the transport that delivered the letter.
    pub via: Option<String>,
    /// Names, without their `X-`, and values of user-defined parameters.
    pub user_defined: Vec<(String, String)>,
}

impl EnvelopeParams {
    /// Name of the user-defined parameter with the span in which the letter was sent (W3C Trace Context).
    pub const TRACEPARENT: &str = "traceparent";
    /// Name of the user-defined parameter with the values of tracing systems for that span (W3C Trace Context).
    pub const TRACESTATE: &str = "tracestate";
}

impl Received {
    /// Creates a stamp with the mandatory parameters only.
    #[must_use]
    pub fn new(by: impl Into<String>, date: Time) -> Self {
        Self {
            by: by.into(),
            from: None,
            date,
            id: None,
            via: None,
            user_defined: Vec::new(),
        }
    }
}

impl Envelope {
    /// Returns the newest value of each parameter.
    ///
    /// FIPA00088 2.2 (of a reader that begins with the newest envelope): "if ((this parameter has
    /// no value in EnvelopeWithAllParams) AND (this parameter has a value in tempEnvelope)) then
    /// copy the value of this parameter to EnvelopeWithAllParams".
    #[must_use]
    pub fn effective(&self) -> EnvelopeParams {
        let mut result = EnvelopeParams::default();
        let mut seen = HashSet::new();
        for part in self.extensions.iter().rev().chain([&self.base]) {
            newest(&mut result.from, &part.from);
            newest(&mut result.comments, &part.comments);
            newest(&mut result.acl_representation, &part.acl_representation);
            newest(&mut result.payload_length, &part.payload_length);
            newest(&mut result.payload_encoding, &part.payload_encoding);
            newest(&mut result.date, &part.date);
            newest(&mut result.received, &part.received);
            newest(&mut result.transport_behaviour, &part.transport_behaviour);
            newest_list(&mut result.to, &part.to);
            newest_list(&mut result.intended_receivers, &part.intended_receivers);
            for (name, value) in part.user_defined.iter().rev() {
                if seen.insert(name) {
                    result.user_defined.push((name.clone(), value.clone()));
                }
            }
        }
        result.user_defined.reverse();
        result
    }
}

fn newest<T: Clone>(result: &mut Option<T>, older: &Option<T>) {
    if result.is_none() {
        result.clone_from(older);
    }
}

fn newest_list<T: Clone>(result: &mut Vec<T>, older: &[T]) {
    if result.is_empty() {
        result.extend_from_slice(older);
    }
}

/// Refuses an empty text, which a reader would take for an absent one.
pub(crate) fn present<'a>(what: &'static str, text: &'a str) -> Result<&'a str, EncodeError> {
    (!text.is_empty())
        .then_some(text)
        .ok_or(EncodeError::Empty(what))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_value_of_each_parameter_is_effective() {
        let agent = |name: &str| AgentId::new(name).unwrap();
        let pair = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        let base = EnvelopeParams {
            to: vec![agent("bob")],
            from: Some(agent("alice")),
            comments: Some("base".into()),
            user_defined: vec![pair("a", "base"), pair("b", "base"), pair("b", "later")],
            ..EnvelopeParams::default()
        };
        let older = EnvelopeParams {
            comments: Some("older".into()),
            intended_receivers: vec![agent("x")],
            ..EnvelopeParams::default()
        };
        let newer = EnvelopeParams {
            intended_receivers: vec![agent("y")],
            user_defined: vec![pair("a", "newer")],
            ..EnvelopeParams::default()
        };
        let envelope = Envelope {
            base,
            extensions: vec![older, newer],
        };
        let effective = envelope.effective();
        assert_eq!(effective.to, [agent("bob")]);
        assert_eq!(effective.from, Some(agent("alice")));
        assert_eq!(effective.comments.as_deref(), Some("older"));
        assert_eq!(effective.intended_receivers, [agent("y")]);
        assert_eq!(
            effective.user_defined,
            [pair("b", "later"), pair("a", "newer")]
        );
    }
}
