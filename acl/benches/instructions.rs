//! Runs one hot path to count its instructions under valgrind: `.ci/instructions`.
//!
//! The argument is the name of a path. Without one, all names are listed. The counted instructions
//! are those of `measured`, which runs once after the preparations.

use std::hint::black_box;

use bytes::{Bytes, BytesMut};
use fipa_acl::{
    AclRepresentation, AgentId, Dialect, Envelope, EnvelopeParams, EnvelopeView, Message,
    MessageIndex, MessageView, Payload, Performative, Received, Representation, bitefficient,
};

const FIPA_SERVICES_LETTER: &[u8] = include_bytes!("../tests/vectors/tcp_letter.bin");

type Path = (&'static str, fn());

const PATHS: &[Path] = &[
    ("message/view/1B", || view(Representation::BitEfficient, 1)),
    ("message/view/1KB", || {
        view(Representation::BitEfficient, 1 << 10);
    }),
    ("message/view/1MB", || {
        view(Representation::BitEfficient, 1 << 20);
    }),
    ("message/decode/1KB", || {
        decode(Representation::BitEfficient, 1 << 10);
    }),
    ("message/index/1KB", || {
        let payload = payload();
        let index = measured(|| MessageIndex::of(black_box(&payload)));
        black_box(&index.expect("a message"));
    }),
    ("message/index/view", || {
        let payload = payload();
        let index = MessageIndex::of(&payload).expect("a message");
        measured(|| black_box(index.view(black_box(&payload))).reply_by());
    }),
    ("message/index/content", || {
        let payload = payload();
        let index = MessageIndex::of(&payload).expect("a message");
        measured(|| index.content(black_box(&payload)));
    }),
    ("message/encoded_len", || {
        let message = message(1);
        measured(|| bitefficient::encoded_len(black_box(&message)));
    }),
    ("message/encode/1B", || encode(1)),
    ("message/encode/1KB", || encode(1 << 10)),
    ("message/to_payload", || {
        let message = message(1 << 20);
        measured(|| black_box(&message).to_payload());
    }),
    ("string/view/1B", || view(Representation::String, 1)),
    ("string/view/1KB", || view(Representation::String, 1 << 10)),
    ("string/decode/1B", || decode(Representation::String, 1)),
    ("string/decode/1KB", || {
        decode(Representation::String, 1 << 10);
    }),
    ("xml/view/1B", || view(Representation::Xml, 1)),
    ("xml/view/1KB", || view(Representation::Xml, 1 << 10)),
    ("xml/decode/1B", || decode(Representation::Xml, 1)),
    ("xml/decode/1KB", || decode(Representation::Xml, 1 << 10)),
    ("xml/encode/1KB", || encode_xml(1 << 10)),
    ("xml/encode/1MB", || encode_xml(1 << 20)),
    ("envelope/view", || {
        let bytes = envelope().encode_standard().expect("an envelope");
        measured(|| EnvelopeView::parse(black_box(&bytes)).is_ok());
    }),
    ("envelope/view/stamped", || {
        let mut envelope = envelope();
        envelope.extensions.push(stamp());
        let bytes = envelope.encode_standard().expect("an envelope");
        measured(|| EnvelopeView::parse(black_box(&bytes)).is_ok());
    }),
    ("envelope/view/fipa_services", || {
        measured(|| EnvelopeView::parse(black_box(FIPA_SERVICES_LETTER)).is_ok());
    }),
    ("envelope/stamp", || {
        let stamp = stamp();
        measured(|| Envelope::encode_extension(black_box(&stamp)).is_ok());
    }),
    ("envelope/xml/view", || {
        let bytes = xml_envelope();
        measured(|| EnvelopeView::parse(black_box(&bytes)).is_ok());
    }),
    ("envelope/xml/decode", || {
        let bytes = xml_envelope();
        measured(|| Envelope::decode(black_box(&bytes)).is_ok());
    }),
];

#[allow(clippy::print_stdout, reason = "the names are what is asked for")]
fn main() {
    // Cargo's own arguments begin with a hyphen.
    let asked = std::env::args().skip(1).find(|name| !name.starts_with('-'));
    match asked {
        None => PATHS.iter().for_each(|(name, _)| println!("{name}")),
        Some(asked) => {
            let path = PATHS.iter().find(|(name, _)| *name == asked);
            let (_, run) = path.unwrap_or_else(|| panic!("there is no path {asked}"));
            run();
        }
    }
}

/// Runs a function whose instructions are counted, without those of dropping its result.
#[inline(never)]
fn measured<T>(run: impl FnOnce() -> T) -> T {
    black_box(run())
}

fn view(representation: Representation, content_len: usize) {
    let bytes = message(content_len).encode(representation, Dialect::Standard);
    let bytes = bytes.expect("a message");
    let view = measured(|| MessageView::parse(black_box(&bytes)));
    black_box(&view.expect("a message"));
}

fn encode(content_len: usize) {
    let message = message(content_len);
    let mut out = BytesMut::with_capacity(bitefficient::encoded_len(&message));
    measured(|| bitefficient::encode(black_box(&message), &mut out));
    black_box(&out);
}

fn encode_xml(content_len: usize) {
    let message = message(content_len);
    let (xml, dialect) = (Representation::Xml, Dialect::Standard);
    let encoded = measured(|| black_box(&message).encode(xml, dialect));
    black_box(&encoded.expect("a message"));
}

fn decode(representation: Representation, content_len: usize) {
    let bytes = message(content_len).encode(representation, Dialect::Standard);
    let payload = Payload::from(bytes.expect("a message"));
    let decoded = measured(|| Message::decode(black_box(&payload)));
    decoded.expect("a message");
}

/// An encoded message in one piece.
fn payload() -> Payload {
    let (encoding, dialect) = (Representation::BitEfficient, Dialect::Standard);
    let bytes = message(1 << 10).encode(encoding, dialect);
    bytes.expect("a message").into()
}

/// The message with all 13 parameters.
fn message(content_len: usize) -> Message {
    Message::builder(Performative::Request)
        .sender(agent("proxy"))
        .receiver(agent("crex_0"))
        .reply_to(agent("proxy"))
        .content(Bytes::from(vec![b'x'; content_len]))
        .language("test language")
        .encoding("test encoding")
        .ontology("test ontology")
        .protocol("RIMRES")
        .conversation_id("test conversationID")
        .reply_with("test reply_with")
        .in_reply_to("test in_reply_to")
        .reply_by("20101223T120037980".parse().expect("a time"))
        .build()
        .expect("a message")
}

fn agent(name: &str) -> AgentId {
    AgentId::new(name).expect("a name")
}

fn envelope() -> Envelope {
    let base = EnvelopeParams {
        to: vec![agent("crex_0")],
        from: Some(agent("proxy")),
        acl_representation: Some(AclRepresentation::BitEfficient),
        payload_length: Some(190),
        date: Some("20261120T112644998Z".parse().expect("a time")),
        intended_receivers: vec![agent("crex_0")],
        ..EnvelopeParams::default()
    };
    let extensions = Vec::new();
    Envelope { base, extensions }
}

fn xml_envelope() -> Bytes {
    let bytes = envelope().encode(Representation::Xml, Dialect::Standard);
    bytes.expect("an envelope")
}

fn stamp() -> EnvelopeParams {
    let date = "20261120T112644998Z".parse().expect("a time");
    EnvelopeParams {
        received: Some(Received {
            id: Some("4294967296".into()),
            ..Received::new("sherpa-mts", date)
        }),
        ..EnvelopeParams::default()
    }
}
