//! Translation of letters for legacy peers.
//!
//! fipa_services gets a bit-efficient envelope and message in its dialect. JADE's proxy agent gets
//! an XML envelope with the length of the payload, and a string message, or one in the encoding that the
//! signature names. Both get the letter with
//! only the receiver it is delivered to.

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, AgentId, DecodeError, Dialect, EncodeError, Envelope, EnvelopeParams,
    Letter, Message, Representation,
};
use fipa_transport::{Kind, Location, Signature, TransportErrorKind};

/// The reason for which a letter cannot be translated for a legacy peer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum TranslateError {
    #[error("the letter cannot be decoded: {0}")]
    Read(#[from] DecodeError),
    #[error("{0}")]
    Write(#[from] EncodeError),
    #[error("the receiver's name is not valid: {0:?}")]
    Receiver(String),
    #[error("the message has no sender, and JADE discards such messages without a notice")]
    NoSender,
    #[error("{0} is not the signature of a legacy peer")]
    NoDialect(Signature),
}

impl TranslateError {
    /// Returns the fault of an attempt that ends with this error.
    pub(crate) fn fault(&self) -> TransportErrorKind {
        match self {
            Self::Read(_) | Self::Write(_) | Self::Receiver(_) | Self::NoSender => {
                TransportErrorKind::Inexpressible
            }
            Self::NoDialect(_) => TransportErrorKind::Incompatible,
        }
    }
}

/// The address at which the agents of this host receive answers.
#[derive(Clone, Copy)]
pub(crate) struct ReplyAddress<'a> {
    /// The URL.
    pub(crate) url: &'a str,
    /// Whether an agent of this host has a name.
    pub(crate) has: &'a dyn Fn(&str) -> bool,
}

/// Translates a letter for one receiver into envelope and message in the dialect of the location `at`. JADE answers to
/// the addresses of the sender and of `reply-to`, so `here` is added to agents of this host that have none.
pub(crate) fn translate(
    letter: &Letter,
    receiver: &str,
    at: &Location,
    reply_address: Option<ReplyAddress<'_>>,
) -> Result<[Bytes; 2], TranslateError> {
    let signature = at.signature();
    let mut envelope = letter.parse_envelope()?;
    let message = Message::decode(letter.payload())?;
    let to = receiver_of(&envelope, receiver)?;
    match signature {
        Signature::FipaServices => {
            let (representation, dialect) = (Representation::BitEfficient, Dialect::FipaServices);
            let message = message.encode(representation, dialect)?;
            let length = message.len() as u64;
            remove_trace_context(&mut envelope);
            let envelope = addressed(envelope, to, AclRepresentation::BitEfficient, length);
            Ok([envelope.encode(representation, dialect)?, message])
        }
        Signature::JadeProxy | Signature::JadeXml | Signature::JadeBitEfficient => {
            let (representation, named) = match signature {
                Signature::JadeXml => (Representation::Xml, AclRepresentation::Xml),
                Signature::JadeBitEfficient => (
                    Representation::BitEfficient,
                    AclRepresentation::BitEfficient,
                ),
                _ => (Representation::String, AclRepresentation::String),
            };
            if message.sender().is_none() {
                return Err(TranslateError::NoSender);
            }
            let message = with_address(message, reply_address);
            let message = message.encode(representation, Dialect::Jade)?;
            let is_text = representation != Representation::BitEfficient;
            let length = match at.kind() {
                // JADE's proxy agent reads as many characters, in US-ASCII unless the envelope names
                // another encoding.
                Kind::Tcp => characters(&message),
                // FIPA00067 counts bytes. JADE warns of another number.
                _ => message.len(),
            };
            let length = length as u64;
            let mut envelope = addressed(envelope, to, named, length);
            let names_charset = is_text && !message.is_ascii();
            envelope.base.payload_encoding = names_charset.then(|| "UTF-8".to_owned());
            if let (Some(from), Some(reply_address)) = (&mut envelope.base.from, reply_address) {
                add_address(from, reply_address.url);
            }
            let envelope = envelope.encode(Representation::Xml, Dialect::Jade)?;
            Ok([envelope, message])
        }
        other => Err(TranslateError::NoDialect(other)),
    }
}

/// Number of characters of a text in UTF-8, or of bytes if it is none.
fn characters(message: &[u8]) -> usize {
    std::str::from_utf8(message).map_or(message.len(), |text| text.chars().count())
}

/// Returns the receiver with the parameters that the envelope gives for it.
fn receiver_of(envelope: &Envelope, name: &str) -> Result<AgentId, TranslateError> {
    let EnvelopeParams {
        to,
        intended_receivers,
        ..
    } = envelope.effective();
    let named = intended_receivers.into_iter().chain(to);
    match named.into_iter().find(|agent| agent.name() == name) {
        Some(agent) => Ok(agent),
        None => AgentId::new(name).map_err(|_| TranslateError::Receiver(name.to_owned())),
    }
}

/// Returns the envelope for this receiver alone, with the parameters of the translated message.
fn addressed(
    mut envelope: Envelope,
    to: AgentId,
    representation: AclRepresentation,
    length: u64,
) -> Envelope {
    for part in [&mut envelope.base]
        .into_iter()
        .chain(&mut envelope.extensions)
    {
        part.intended_receivers.clear();
        part.acl_representation = None;
        part.payload_length = None;
        part.payload_encoding = None;
    }
    envelope.base.intended_receivers = vec![to];
    envelope.base.acl_representation = Some(representation);
    envelope.base.payload_length = Some(length);
    envelope
}

/// Removes the parameters for which fipa_services has no place, and without which the letter means the same.
fn remove_trace_context(envelope: &mut Envelope) {
    let is_trace = |name: &str| {
        matches!(
            name,
            EnvelopeParams::TRACEPARENT | EnvelopeParams::TRACESTATE
        )
    };
    for part in [&mut envelope.base]
        .into_iter()
        .chain(&mut envelope.extensions)
    {
        part.user_defined.retain(|(name, _)| !is_trace(name));
    }
}

fn add_address(agent: &mut AgentId, url: &str) {
    if agent.addresses().is_empty()
        && let Ok(with) = agent.clone().with_address(url)
    {
        *agent = with;
    }
}

/// Returns the message with an address of its sender, and of the agents of this host in `reply-to`.
fn with_address(message: Message, reply_address: Option<ReplyAddress<'_>>) -> Message {
    let (Some(sender), Some(reply_address)) = (message.sender(), reply_address) else {
        return message;
    };
    let lacks = |agent: &AgentId| agent.addresses().is_empty();
    let is_local = |agent: &AgentId| agent.same_agent(sender) || (reply_address.has)(agent.name());
    let reply_to: Vec<AgentId> = message
        .reply_to()
        .iter()
        .map(|agent| {
            let mut agent = agent.clone();
            if lacks(&agent) && is_local(&agent) {
                add_address(&mut agent, reply_address.url);
            }
            agent
        })
        .collect();
    if !lacks(sender) && reply_to == message.reply_to() {
        return message;
    }
    let mut sender = sender.clone();
    add_address(&mut sender, reply_address.url);
    let mut builder = Message::builder(message.performative().clone())
        .sender(sender)
        .receivers(message.receivers().iter().cloned());
    for agent in reply_to {
        builder = builder.reply_to(agent);
    }
    if let Some(content) = message.content() {
        builder = builder.content(content.clone());
    }
    if let Some(language) = message.language() {
        builder = builder.language(language);
    }
    if let Some(encoding) = message.encoding() {
        builder = builder.encoding(encoding);
    }
    if let Some(ontology) = message.ontology() {
        builder = builder.ontology(ontology);
    }
    if let Some(protocol) = message.protocol() {
        builder = builder.protocol(protocol);
    }
    if let Some(conversation) = message.conversation_id() {
        builder = builder.conversation_id(conversation);
    }
    if let Some(reply_with) = message.reply_with() {
        builder = builder.reply_with(reply_with);
    }
    if let Some(in_reply_to) = message.in_reply_to() {
        builder = builder.in_reply_to(in_reply_to);
    }
    if let Some(reply_by) = message.reply_by() {
        builder = builder.reply_by(reply_by);
    }
    for (name, value) in message.user_defined() {
        builder = builder.user_defined(name, value);
    }
    builder.build().unwrap_or(message)
}

#[cfg(test)]
mod tests {
    use fipa_acl::{Performative, Received, Time};

    use super::*;

    fn at(kind: Kind, signature: Signature) -> Location {
        let location = Location::new(kind, "10.0.0.7:7778").unwrap();
        location.with_signature(signature).unwrap()
    }

    /// This host, which has the agents `rover` and `crane`.
    fn own(url: &str) -> ReplyAddress<'_> {
        let has = &|name: &str| ["rover", "crane"].contains(&name);
        ReplyAddress { url, has }
    }

    fn date() -> Time {
        "20261120T112644481Z".parse().unwrap()
    }

    fn message(content: &str) -> Message {
        Message::builder(Performative::Request)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .receiver(AgentId::new("echo").unwrap())
            .content(content.to_owned())
            .language("fipa-sl")
            .protocol("fipa-request")
            .conversation_id("c-1")
            .reply_with("r-1")
            .build()
            .unwrap()
    }

    /// A letter to two receivers that came through a gateway.
    fn letter(content: &str) -> Letter {
        let to = vec![AgentId::new("arm").unwrap(), AgentId::new("echo").unwrap()];
        let base = EnvelopeParams {
            to: to.clone(),
            intended_receivers: to,
            from: Some(AgentId::new("rover").unwrap()),
            acl_representation: Some(AclRepresentation::BitEfficient),
            date: Some(date()),
            payload_length: Some(1),
            ..EnvelopeParams::default()
        };
        let stamp = EnvelopeParams {
            received: Some(Received::new("crex-mts", date())),
            ..EnvelopeParams::default()
        };
        let envelope = Envelope {
            base,
            extensions: vec![stamp],
        };
        Letter::new(
            envelope.encode_standard().unwrap(),
            message(content).to_payload(),
        )
    }

    #[test]
    fn fipa_services_gets_its_dialect_and_one_receiver() {
        let [envelope, bytes] = translate(
            &letter("hello"),
            "echo",
            &at(Kind::Tcp, Signature::FipaServices),
            None,
        )
        .unwrap();
        let (read, len) = Envelope::decode(&envelope).unwrap();
        assert_eq!(len, envelope.len());
        let effective = read.effective();
        assert_eq!(
            effective.intended_receivers,
            [AgentId::new("echo").unwrap()]
        );
        assert_eq!(effective.payload_length, Some(bytes.len() as u64));
        assert_eq!(read.extensions.len(), 1);
        // Its texts are `#n"…`, and its times have no zone.
        assert!(envelope.windows(9).any(|w| w == b"#4\"echo\0\x01"));
        let payload = bytes.clone().into();
        let said = Message::decode(&payload).unwrap();
        assert_eq!(said, message("hello"));
        assert!(bytes.windows(9).any(|w| w == b"#5\"hello\0"));
    }

    #[test]
    fn jade_gets_xml_a_string_message_its_length_and_where_to_answer() {
        let over = [Kind::Tcp, Kind::Http, Kind::Https];
        let contents = ["hello", "grüß dich"];
        for (kind, content) in over.iter().flat_map(|kind| contents.map(|it| (*kind, it))) {
            let own_address = Some(own("tcp://10.0.0.1:7788"));
            let jade = at(kind, Signature::JadeProxy);
            let [envelope, bytes] = translate(&letter(content), "arm", &jade, own_address).unwrap();
            assert!(envelope.starts_with(b"<?xml"));
            let (read, len) = Envelope::decode(&envelope).unwrap();
            assert_eq!(len, envelope.len());
            let text = std::str::from_utf8(&bytes).unwrap();
            let effective = read.effective();
            // The proxy agent behind TCP counts characters, and JADE over HTTP counts bytes.
            let length = match kind {
                Kind::Tcp => text.chars().count(),
                _ => text.len(),
            };
            assert_eq!(
                effective.payload_length,
                Some(length as u64),
                "{kind} {content}"
            );
            assert_eq!(effective.payload_encoding.is_some(), !content.is_ascii());
            assert_eq!(
                effective.acl_representation,
                Some(AclRepresentation::String)
            );
            assert_eq!(effective.intended_receivers, [AgentId::new("arm").unwrap()]);
            let said = Message::decode(&bytes.clone().into()).unwrap();
            let sender = said.sender().unwrap();
            assert_eq!(sender.addresses(), ["tcp://10.0.0.1:7788"]);
            assert_eq!(said.content().unwrap(), content);
            assert_eq!(said.conversation_id(), Some("c-1"));
        }
    }

    #[test]
    fn jade_gets_the_trace_context_of_a_letter_and_fipa_services_does_not() {
        let pair = |name: &str, value: &str| (name.to_owned(), value.to_owned());
        let trace = [
            pair(
                EnvelopeParams::TRACEPARENT,
                "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01",
            ),
            pair(EnvelopeParams::TRACESTATE, "vendor=a b\"c<d"),
        ];
        let with = |pairs: &[(String, String)]| {
            let mut envelope = letter("hello").parse_envelope().unwrap();
            envelope.base.user_defined = pairs.to_vec();
            envelope.extensions[0].user_defined = pairs.to_vec();
            let envelope = envelope.encode_standard().unwrap();
            Letter::new(envelope, letter("hello").into_payload())
        };
        let received = |letter: &Letter, signature| {
            let at = at(Kind::Tcp, signature);
            let [envelope, _] = translate(letter, "arm", &at, None)?;
            Ok::<_, TranslateError>(
                Envelope::decode(&envelope)
                    .unwrap()
                    .0
                    .effective()
                    .user_defined,
            )
        };
        let letter = with(&trace);
        assert_eq!(received(&letter, Signature::JadeProxy).unwrap(), trace);
        assert_eq!(received(&letter, Signature::FipaServices).unwrap(), []);
        // Other parameters may change the meaning of the letter.
        let letter = with(&[pair("other", "value")]);
        let refused = received(&letter, Signature::FipaServices).unwrap_err();
        assert_eq!(refused.fault(), TransportErrorKind::Inexpressible);
    }

    #[test]
    fn jade_gets_messages_in_the_encoding_of_the_signature() {
        for (signature, representation) in [
            (Signature::JadeXml, AclRepresentation::Xml),
            (Signature::JadeBitEfficient, AclRepresentation::BitEfficient),
        ] {
            for content in ["hello", "(a \"b\")", "grüß dich"] {
                let own_address = "http://10.0.0.1:7778/acc";
                let [envelope, bytes] = translate(
                    &letter(content),
                    "arm",
                    &at(Kind::Http, signature),
                    Some(own(own_address)),
                )
                .unwrap();
                assert!(envelope.starts_with(b"<?xml"));
                let (read, _) = Envelope::decode(&envelope).unwrap();
                let effective = read.effective();
                assert_eq!(effective.acl_representation, Some(representation.clone()));
                let said = Message::decode(&bytes.clone().into()).unwrap();
                assert_eq!(said.content().unwrap(), content);
                assert_eq!(said.sender().unwrap().addresses(), [own_address]);
                let is_text = signature == Signature::JadeXml;
                let named = effective.payload_encoding.is_some();
                assert_eq!(named, is_text && !content.is_ascii());
                assert_eq!(effective.payload_length, Some(bytes.len() as u64));
            }
        }
        // JADE's reader of XML inserts blanks at escaped characters.
        let escaped = letter("a < b");
        let refused = translate(&escaped, "arm", &at(Kind::Http, Signature::JadeXml), None);
        let fault = refused.unwrap_err().fault();
        assert_eq!(fault, TransportErrorKind::Inexpressible);
        let bit_efficient = at(Kind::Http, Signature::JadeBitEfficient);
        assert!(translate(&escaped, "arm", &bit_efficient, None).is_ok());
    }

    #[test]
    fn jade_gets_an_address_of_each_agent_of_this_host_in_reply_to() {
        let other = AgentId::new("other@jade").unwrap();
        let stated = other.clone().with_address("http://10.0.0.9:7778/acc");
        let message = Message::builder(Performative::Request)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .reply_to(AgentId::new("rover").unwrap())
            .reply_to(AgentId::new("crane").unwrap())
            .reply_to(other)
            .reply_to(stated.unwrap())
            .content("(agent-identifier :name crane)")
            .build()
            .unwrap();
        let letter = message.to_letter(date()).unwrap();
        let url = "http://10.0.0.1:7778/acc";
        let jade = at(Kind::Http, Signature::JadeProxy);
        let [_, bytes] = translate(&letter, "arm", &jade, Some(own(url))).unwrap();
        let said = Message::decode(&bytes.into()).unwrap();
        let addresses = |agent: &AgentId| agent.addresses().to_vec();
        assert_eq!(addresses(said.sender().unwrap()), [url]);
        let reply_to: Vec<_> = said.reply_to().iter().map(addresses).collect();
        assert_eq!(
            reply_to,
            [
                vec![url],
                vec![url],
                vec![],
                vec!["http://10.0.0.9:7778/acc"]
            ]
        );
        // The content belongs to the agent.
        assert_eq!(said.content(), message.content());
        let cpp = at(Kind::Tcp, Signature::FipaServices);
        let [_, bytes] = translate(&letter, "arm", &cpp, Some(own(url))).unwrap();
        assert_eq!(Message::decode(&bytes.into()).unwrap(), message);
    }

    #[test]
    fn letters_that_cannot_be_translated_are_refused() {
        let garbage = Letter::new(Bytes::from_static(b"x"), Bytes::new());
        let refused = translate(
            &garbage,
            "arm",
            &at(Kind::Tcp, Signature::FipaServices),
            None,
        );
        assert!(matches!(refused, Err(TranslateError::Read(_))));
        let own = translate(&letter("x"), "arm", &at(Kind::Tcp, Signature::Frames), None);
        assert!(matches!(own, Err(TranslateError::NoDialect(_))));
    }
}
