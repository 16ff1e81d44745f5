//! Lengths of encoded messages and envelopes: the figures of docs/benchmarks.md.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use fipa_acl::{
    AclRepresentation, AgentId, Dialect, Envelope, EnvelopeParams, Message, Performative,
    Representation,
};

const DIALECTS: [Dialect; 3] = [Dialect::Standard, Dialect::FipaServices, Dialect::Jade];

/// The message of the published measurements of fipa_acl: 99 bytes of header information and one byte
/// of content.
fn message() -> Message {
    Message::builder(Performative::Request)
        .sender(agent("proxy"))
        .receiver(agent("crex_0"))
        .reply_to(agent("proxy"))
        .content("x")
        .language("test language")
        .encoding("test encoding")
        .ontology("test ontology")
        .protocol("RIMRES")
        .conversation_id("test conversationID")
        .reply_with("test reply_with")
        .build()
        .unwrap()
}

fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn envelope(payload_len: usize) -> Envelope {
    let base = EnvelopeParams {
        to: vec![agent("crex_0")],
        from: Some(agent("proxy")),
        acl_representation: Some(AclRepresentation::BitEfficient),
        payload_length: Some(payload_len as u64),
        date: Some("20261120T112644998Z".parse().unwrap()),
        intended_receivers: vec![agent("crex_0")],
        ..EnvelopeParams::default()
    };
    let extensions = Vec::new();
    Envelope { base, extensions }
}

/// Returns the lengths of the message in bytes for the standard, fipa_services and JADE.
fn message_sizes(representation: Representation) -> [usize; 3] {
    DIALECTS.map(|dialect| message().encode(representation, dialect).unwrap().len())
}

/// Returns the lengths of a letter with a bit-efficient message.
fn letter_sizes(representation: Representation) -> [usize; 3] {
    DIALECTS.map(|dialect| {
        let message = message().encode(Representation::BitEfficient, dialect);
        let payload = message.unwrap().len();
        let envelope = envelope(payload).encode(representation, dialect);
        envelope.unwrap().len() + payload
    })
}

#[test]
fn messages_have_the_documented_lengths() {
    for (representation, expected, most) in [
        (Representation::BitEfficient, [148, 151, 138], 162),
        (Representation::String, [321, 303, 320], 330),
        (Representation::Xml, [535, 574, 514], 624),
    ] {
        assert_eq!(message_sizes(representation), expected, "{representation}");
        assert!(expected.iter().all(|len| *len <= most));
    }
}

#[test]
fn letters_have_the_documented_lengths() {
    for (representation, expected, most) in [
        (Representation::BitEfficient, [198, 217, 188], 242),
        (Representation::Xml, [583, 586, 643], 647),
    ] {
        assert_eq!(letter_sizes(representation), expected, "{representation}");
        assert!(expected.iter().all(|len| *len <= most));
    }
}
