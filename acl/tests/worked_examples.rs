//! Worked examples of the bit-efficient encodings, byte for byte.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, AgentId, Envelope, EnvelopeParams, Letter, Message, Payload, Performative,
    Received,
};

fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn decoded(bytes: &[u8]) -> Message {
    Message::decode(&Payload::from(Bytes::copy_from_slice(bytes))).unwrap()
}

fn encoded(message: &Message) -> Bytes {
    message.to_payload().to_bytes()
}

#[test]
fn the_smallest_message_is_decoded_and_encoded() {
    let bytes = b"\xfa\x10\x08\x01";
    let message = Message::builder(Performative::Inform).build().unwrap();
    assert_eq!(decoded(bytes), message);
    assert_eq!(encoded(&message), &bytes[..]);
}

/// The example has the content as a quoted string in the middle. The encoder writes it last and with
/// its length, which every peer reads and which allows any bytes.
#[test]
fn a_request_with_text_is_decoded_and_encoded() {
    let bytes = b"\xfa\x10\x13\
        \x02\x02\x10a@p\0\x01\
        \x03\x02\x10b@q\0\x01\x01\
        \x04\x14\"(x)\"\0\
        \x0c\x10fipa-request\0\
        \x0d\x10c1\0\
        \x01";
    assert_eq!(bytes.len(), 49);
    let message = Message::builder(Performative::Request)
        .sender(agent("a@p"))
        .receiver(agent("b@q"))
        .content("(x)")
        .protocol("fipa-request")
        .conversation_id("c1")
        .build()
        .unwrap();
    assert_eq!(decoded(bytes), message);
    let ours = b"\xfa\x10\x13\
        \x02\x02\x10a@p\0\x01\
        \x03\x02\x10b@q\0\x01\x01\
        \x0c\x10fipa-request\0\
        \x0d\x10c1\0\
        \x04\x16\x03(x)\
        \x01";
    assert_eq!(encoded(&message), &ours[..]);
    assert_eq!(decoded(ours), message);
}

/// The encoder uses another order of the parameters.
#[test]
fn addresses_resolvers_bytes_and_a_date_are_decoded_and_encoded() {
    let head = b"\xfa\x10\x08\
        \x02\x02\x10alice@p1\0\
        \x02\x10http://h1:7778/acc\0\x01\
        \x03\x02\x10ams@p1\0\x01\x01\
        \x01\
        \x03\x02\x10bob@p2\0\x01\x01";
    let content = b"\x04\x16\x03\x00\x01\xff";
    let rest = b"\x06\x24\x31\x11\x16\x19\x15\x37\x62\x59\x20\x5a\
        \x07\x10m7\0\
        \x09\x10fipa-sl\0";
    let example = [&head[..], content, rest, b"\x01"].concat();
    assert_eq!(example.len(), 96);
    let alice = agent("alice@p1")
        .with_address("http://h1:7778/acc")
        .and_then(|alice| alice.with_resolver(agent("ams@p1")))
        .unwrap();
    let message = Message::builder(Performative::Inform)
        .sender(alice)
        .receiver(agent("bob@p2"))
        .content(&b"\x00\x01\xff"[..])
        .reply_by("20000508T042651481Z".parse().unwrap())
        .in_reply_to("m7")
        .language("fipa-sl")
        .build()
        .unwrap();
    assert_eq!(decoded(&example), message);
    let ours = [&head[..], rest, content, b"\x01"].concat();
    assert_eq!(encoded(&message), ours);
}

/// Numbers and expressions are decoded to the text that they stand for, and encoded as text.
#[test]
fn a_user_defined_act_with_an_expression_is_decoded_and_encoded() {
    let bytes = b"\xfa\x10\x00\x10ping\0\
        \x05\x70seq\0\x12\x53\0\x12\xe2\xf6\0\x14\"a\"\0\x40\
        \x06\x21\x11\x11\x11\x11\x11\x11\x41\x11\x10\
        \x00\x10X-prio\0\x12\x80\
        \x01";
    assert_eq!(bytes.len(), 51);
    let message = Message::builder("ping".parse().unwrap())
        .reply_with("(seq 42 -1.5 \"a\")")
        .reply_by("+00000000T000030000".parse().unwrap())
        .user_defined("prio", "7")
        .build()
        .unwrap();
    assert_eq!(decoded(bytes), message);
    let ours = b"\xfa\x10\x00\x10ping\0\
        \x05\x14\"(seq 42 -1.5 \\\"a\\\")\"\0\
        \x06\x21\x11\x11\x11\x11\x11\x11\x41\x11\x10\
        \x00\x10X-prio\0\x14\"7\"\0\
        \x01";
    assert_eq!(encoded(&message), &ours[..]);
    assert_eq!(decoded(ours), message);
}

#[test]
fn test_messages_of_fipa_acl_are_decoded() {
    assert_eq!(
        decoded(b"\xfa\x01\x01\x01").performative(),
        &Performative::AcceptProposal
    );
    let message = decoded(b"\xfa\x01\x08\x05\x60\x10HI\0\x40\x01");
    assert_eq!(message.reply_with(), Some("(HI)"));
    let bytes = b"\xfa\x01\x01\x02\x02\x10HI\0\x03\x02\x10meriadoc.local\0\x01\x01\x01\x01";
    let sender = decoded(bytes).sender().cloned().unwrap();
    assert_eq!(sender.resolvers()[0].name(), "meriadoc.local");
    let dated = b"\xfa\x01\x08\x06\x26\x31\x21\x50\x02\x29\x11\x11\x33\x30\x5a\x01";
    let time = decoded(dated).reply_by().unwrap();
    assert_eq!(
        time.to_string(),
        "-20100401T180000222Z",
        "month and day with padding"
    );
}

#[test]
fn an_envelope_with_a_stamp_is_decoded_and_encoded() {
    let bytes = b"\xfe\x00\x8a\x12\
        \x20\x31\x11\x16\x19\x15\x37\x62\x59\x20\
        \x02\x02receiver@foo.com\0\x02http://foo.com/acc\0\x01\x01\x01\
        \x03\x02sender@bar.com\0\x02http://bar.com/acc\0\x01\x01\
        \x0ahttp://foo.com/acc\0\x20\x31\x11\x16\x19\x15\x37\x62\x59\x20\x03123456789\0\x01\
        \x01";
    assert_eq!(bytes.len(), 138);
    let date = "20000508T042651481".parse().unwrap();
    let receiver = agent("receiver@foo.com").with_address("http://foo.com/acc");
    let sender = agent("sender@bar.com").with_address("http://bar.com/acc");
    let envelope = Envelope {
        base: EnvelopeParams {
            to: vec![receiver.unwrap()],
            from: Some(sender.unwrap()),
            acl_representation: Some(AclRepresentation::Xml),
            date: Some(date),
            received: Some(Received {
                id: Some("123456789".into()),
                ..Received::new("http://foo.com/acc", date)
            }),
            ..EnvelopeParams::default()
        },
        extensions: Vec::new(),
    };
    assert_eq!(envelope.encode_standard().unwrap(), &bytes[..]);
    assert_eq!(Envelope::decode(bytes), Ok((envelope, 138)));
}

#[test]
fn a_stamp_in_front_of_a_base_is_decoded_and_encoded() {
    let base = b"\xfe\x00\x38\x10\x24\x31\x35\x12\x42\x34\x6a\x6a\x11\x80\x5a\
        \x02\x02b@q\0\x02http://q/acc\0\x01\x01\x01\
        \x03\x02a@p\0\x01\
        \x06\x50\
        \x09\x02b@q\0\x01\x01\
        \x01";
    let stamp = b"\xfd\x00\x1dhttp://q/acc\0\x24\x31\x35\x12\x42\x34\x6a\x6a\x11\x90\x5a\x01\x01";
    assert_eq!((base.len(), stamp.len()), (56, 29));
    let mut envelope = Envelope {
        base: EnvelopeParams {
            to: vec![agent("b@q").with_address("http://q/acc").unwrap()],
            from: Some(agent("a@p")),
            acl_representation: Some(AclRepresentation::BitEfficient),
            payload_length: Some(4),
            date: Some("20240131T235959007Z".parse().unwrap()),
            intended_receivers: vec![agent("b@q")],
            ..EnvelopeParams::default()
        },
        extensions: Vec::new(),
    };
    assert_eq!(envelope.encode_standard().unwrap(), &base[..]);
    let stamped = EnvelopeParams {
        received: Some(Received::new(
            "http://q/acc",
            "20240131T235959008Z".parse().unwrap(),
        )),
        ..EnvelopeParams::default()
    };
    let extension = Envelope::encode_extension(&stamped).unwrap();
    assert_eq!(extension, &stamp[..]);

    let letter = Letter::new(
        Bytes::from_static(base),
        Bytes::from_static(b"\xfa\x10\x08\x01"),
    )
    .stamped(extension);
    envelope.extensions.push(stamped);
    assert_eq!(letter.parse_envelope().as_ref(), Ok(&envelope));
    assert_eq!(letter.envelope(), envelope.encode_standard().unwrap());
    let (read, split) = Letter::decode(letter.to_bytes()).unwrap();
    assert_eq!(read, envelope);
    assert_eq!(split.payload(), letter.payload());
}
