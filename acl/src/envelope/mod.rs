//! The envelope (FIPA00067): what message transport services need to know of a letter.

pub(crate) mod agent_id;
mod decode;
pub(crate) mod parts;
mod read;
mod view;
mod write;

use std::collections::HashSet;

pub use view::{EnvelopeView, ReceiverNames, StampView, Stamps};
pub(crate) use write::encode;

use crate::{AclRepresentation, AgentId, Time};

/// An envelope: what the sender's transport service wrote, and what others put in front since.
///
/// Nobody changes what is there already. A service that forwards a letter adds an extension with
/// its stamp ([`EnvelopeParams::received`]) and the parameters it overrides; the newest value of a
/// parameter counts ([`effective`](Self::effective)).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Envelope {
    /// What the sender's transport service wrote.
    pub base: EnvelopeParams,
    /// What was added on the way, oldest first.
    pub extensions: Vec<EnvelopeParams>,
}

/// The parameters of a base or an extension envelope. What is absent is `None` or empty.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct EnvelopeParams {
    /// Whom the letter is for, as its sender wrote it.
    pub to: Vec<AgentId>,
    /// Who sent the letter, and gets to know when it fails.
    pub from: Option<AgentId>,
    /// For the final recipient to read.
    pub comments: Option<String>,
    /// How the message is encoded.
    pub acl_representation: Option<AclRepresentation>,
    /// Length of the encoded message in bytes.
    pub payload_length: Option<u64>,
    /// Charset of the encoded message; US-ASCII if absent.
    pub payload_encoding: Option<String>,
    /// When the envelope was made.
    pub date: Option<Time>,
    /// Whom this copy of the letter is for; counts instead of [`to`](Self::to).
    pub intended_receivers: Vec<AgentId>,
    /// The stamp of the transport service that received the letter.
    pub received: Option<Received>,
    /// Requirements on the transport.
    pub transport_behaviour: Option<String>,
    /// User-defined parameters, names without `X-`. Of several with the same name the last one
    /// counts.
    pub user_defined: Vec<(String, String)>,
}

/// The stamp of a transport service (FIPA00067 `received-object`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Received {
    /// Address or name of the service that received the letter.
    pub by: String,
    /// Address of the service that sent it.
    pub from: Option<String>,
    /// When it was received.
    pub date: Time,
    /// Identifies the letter at the service that sent it.
    pub id: Option<String>,
    /// The kind of transport it came by.
    pub via: Option<String>,
    /// User-defined parameters, names without `X-`.
    pub user_defined: Vec<(String, String)>,
}

impl Received {
    /// A stamp with nothing but what every stamp has.
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
    /// The parameters that count: of each the newest value (FIPA00067 4.2).
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_value_counts_parameter_by_parameter() {
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
