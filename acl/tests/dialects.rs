//! Bit-efficient messages and envelopes in the dialects of the peers.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod arbitrary;

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, AgentId, Dialect, EncodeError, Envelope, EnvelopeParams, EnvelopeView,
    Letter, Message, MessageBuilder, Performative, Received, Representation, Time, Zone,
};
use proptest::prelude::*;

use arbitrary::{envelope, message};

const PEERS: [Dialect; 2] = [Dialect::FipaServices, Dialect::Jade];
const BIT_EFFICIENT: Representation = Representation::BitEfficient;

fn agent(name: &str) -> AgentId {
    AgentId::new(name).unwrap()
}

fn inform() -> MessageBuilder {
    Message::builder(Performative::Inform)
}

fn written(message: &Message, dialect: Dialect) -> Result<Bytes, EncodeError> {
    message.encode(BIT_EFFICIENT, dialect)
}

/// Encodes a message without a sender. Returns the bytes behind its fixed beginning.
fn body(builder: MessageBuilder, dialect: Dialect) -> Vec<u8> {
    let bytes = written(&builder.build().unwrap(), dialect).unwrap();
    let start: &[u8] = match dialect {
        Dialect::FipaServices => b"\xfa\x10\x08\x02\x02\x10agent_id:undefined\0\x01",
        _ => b"\xfa\x10\x08",
    };
    bytes.strip_prefix(start).unwrap().to_vec()
}

fn base() -> EnvelopeParams {
    EnvelopeParams {
        acl_representation: Some(AclRepresentation::String),
        date: Some("20000508T042651481Z".parse().unwrap()),
        ..EnvelopeParams::default()
    }
}

fn enveloped(base: EnvelopeParams, dialect: Dialect) -> Result<Bytes, EncodeError> {
    let extensions = Vec::new();
    Envelope { base, extensions }.encode(BIT_EFFICIENT, dialect)
}

#[test]
fn texts_have_the_form_that_each_peer_reads() {
    let cpp = |text: &str| body(inform().language(text), Dialect::FipaServices);
    assert_eq!(cpp("sl"), b"\x09\x14\"sl\"\0\x01");
    assert_eq!(cpp("a b"), b"\x09\x14\"a b\"\0\x01");
    assert_eq!(cpp("on\"to"), b"\x09\x14#5\"on\"to\0\x01");
    assert_eq!(cpp("end\\"), b"\x09\x14#4\"end\\\0\x01");
    let jade = |text: &str| body(inform().language(text), Dialect::Jade);
    assert_eq!(jade("1-2"), b"\x09\x101-2\0\x01");
    assert_eq!(jade("a b"), b"\x09\x14a b\0\x01");
    assert_eq!(jade("\"a b\""), b"\x09\x16\x05\"a b\"\x01");
    let long = inform().language(format!("\"{} \"", "a".repeat(125)));
    assert!(matches!(
        written(&long.build().unwrap(), Dialect::Jade),
        Err(EncodeError::Unrepresentable {
            what: "language",
            ..
        })
    ));
}

#[test]
fn content_is_a_string_if_the_peer_reads_it_as_one() {
    let cpp = |content: &[u8]| body(inform().content(content.to_vec()), Dialect::FipaServices);
    assert_eq!(cpp(b""), b"\x04\x14#0\"\0\x01");
    assert_eq!(cpp(b"\xff"), b"\x04\x14#1\"\xff\0\x01");
    assert_eq!(cpp(b"a\0"), b"\x04\x16\x02a\0\x01");
    let jade = |content: &[u8]| body(inform().content(content.to_vec()), Dialect::Jade);
    assert_eq!(jade(b"say \"hi\""), b"\x04\x14say \"hi\"\0\x01");
    assert_eq!(jade(b"\"hi\""), b"\x04\x16\x04\"hi\"\x01");
    assert_eq!(jade(b"\xff"), b"\x04\x16\x01\xff\x01");
}

#[test]
fn user_defined_names_are_written_without_prefix_for_fipa_services() {
    let named = |name: &str| inform().user_defined(name, "v");
    let cpp = Dialect::FipaServices;
    assert_eq!(body(named("k"), cpp), b"\x00\x10k\0\x14\"v\"\0\x01");
    assert_eq!(body(named("X-k"), cpp), b"\x00\x10X-X-k\0\x14\"v\"\0\x01");
    assert_eq!(body(named("k"), Dialect::Jade), b"\x00\x10X-k\0\x10v\0\x01");
}

#[test]
fn values_that_a_peer_misreads_are_refused() {
    let time = |text: &str| text.parse::<Time>().unwrap();
    for (message, dialect, what) in [
        (inform().protocol("é"), Dialect::FipaServices, "protocol"),
        (inform().protocol("1a"), Dialect::FipaServices, "protocol"),
        (
            inform().sender(agent("1a")),
            Dialect::FipaServices,
            "name of an agent",
        ),
        (
            inform().reply_by(time("+00000000T000030000")),
            Dialect::FipaServices,
            "reply-by",
        ),
        (
            inform().reply_by(time("20000508T042651481K")),
            Dialect::FipaServices,
            "reply-by",
        ),
        (
            Message::builder("ping".parse().unwrap()),
            Dialect::Jade,
            "user-defined performative",
        ),
    ] {
        match written(&message.build().unwrap(), dialect) {
            Err(EncodeError::Unrepresentable { what: found, .. }) => assert_eq!(found, what),
            other => panic!("{what}: {other:?}"),
        }
    }
    let pair = ("k".to_owned(), "v".to_owned());
    let user_defined = EnvelopeParams {
        user_defined: vec![pair],
        ..base()
    };
    let other = EnvelopeParams {
        acl_representation: Some(AclRepresentation::from("mine")),
        ..base()
    };
    let length = EnvelopeParams {
        payload_length: Some(1 << 32),
        ..base()
    };
    for params in [user_defined, other, length] {
        let refused = enveloped(params, Dialect::FipaServices).unwrap_err();
        assert!(matches!(refused, EncodeError::Unrepresentable { .. }));
    }
    let quoted = EnvelopeParams {
        comments: Some("\"a\"".into()),
        ..base()
    };
    assert!(enveloped(quoted, Dialect::Jade).is_err());
}

#[test]
fn an_extension_without_a_stamp_has_an_empty_one_for_fipa_services() {
    let envelope = Envelope {
        base: base(),
        extensions: vec![EnvelopeParams {
            intended_receivers: vec![agent("bob")],
            ..EnvelopeParams::default()
        }],
    };
    assert!(envelope.encode(BIT_EFFICIENT, Dialect::Jade).is_err());
    let bytes = envelope
        .encode(BIT_EFFICIENT, Dialect::FipaServices)
        .unwrap();
    assert!(bytes.starts_with(
        b"\xfd\x00\x10#0\"\0\x20\x2a\x81\x12\x12\x11\x11\x11\x11\x11\x01\x09\x02#3\"bob\0\x01\x01\x01"
    ));
    let (read, _) = Envelope::decode(&bytes).unwrap();
    assert_eq!(read.extensions, envelope.extensions);
}

#[test]
fn envelopes_for_jade_have_names_of_representations_and_plain_user_defined_values() {
    let stamp = Received::new("mts", base().date.unwrap());
    let extension = EnvelopeParams {
        acl_representation: Some(AclRepresentation::Xml),
        from: Some(agent("a").with_user_defined("k", "v").unwrap()),
        received: Some(stamp),
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base: base(),
        extensions: vec![extension],
    };
    let bytes = envelope.encode(BIT_EFFICIENT, Dialect::Jade).unwrap();
    let from = b"\x03\x02a\0\x04X-k\0v\0\x01\x04fipa.acl.rep.xml.std\0";
    assert!(memchr::memmem::find(&bytes, from).is_some(), "{bytes:?}");
    assert_eq!(Envelope::decode(&bytes).unwrap().0, envelope);
}

#[test]
fn an_extension_longer_than_the_length_field_is_refused() {
    let envelope = Envelope {
        base: base(),
        extensions: vec![EnvelopeParams {
            comments: Some("c".repeat(1 << 16)),
            ..EnvelopeParams::default()
        }],
    };
    let refused = envelope.encode(BIT_EFFICIENT, Dialect::FipaServices);
    assert!(matches!(refused, Err(EncodeError::EnvelopeTooLong(_))));
}

/// fipa_services takes all times as local.
fn without_utc(what: &impl std::fmt::Debug) -> String {
    format!("{what:?}").replace("zone: Utc", "zone: Unspecified")
}

fn same(one: &impl std::fmt::Debug, other: &impl std::fmt::Debug, dialect: Dialect) {
    if dialect == Dialect::FipaServices {
        assert_eq!(without_utc(one), without_utc(other));
    } else {
        assert_eq!(format!("{one:?}"), format!("{other:?}"));
    }
}

fn refused_for_a_reason(error: &EncodeError) -> bool {
    matches!(
        error,
        EncodeError::Unrepresentable { .. } | EncodeError::EnvelopeTooLong(_)
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(ProptestConfig::default().cases.min(192)))]

    #[test]
    fn a_message_is_the_same_after_a_round_trip_or_is_refused(message in message().boxed()) {
        for dialect in PEERS {
            match written(&message, dialect) {
                Ok(bytes) => {
                    let again = Message::decode(&bytes.into()).unwrap();
                    same(&again, &message, dialect);
                }
                Err(error) => prop_assert!(refused_for_a_reason(&error), "{}", error),
            }
        }
    }

    #[test]
    fn an_envelope_is_the_same_after_a_round_trip_or_is_refused(envelope in envelope().boxed()) {
        let mut representable = envelope.clone();
        representable.base.user_defined.clear();
        representable.base.acl_representation = Some(AclRepresentation::Xml);
        representable.extensions.iter_mut().for_each(|extension| extension.user_defined.clear());
        for dialect in PEERS {
            for envelope in [&envelope, &representable] {
                match envelope.encode(BIT_EFFICIENT, dialect) {
                    Ok(bytes) => {
                        let (again, len) = Envelope::decode(&bytes).unwrap();
                        prop_assert_eq!(len, bytes.len());
                        same(&again, envelope, dialect);
                        let effective = again.effective();
                        let view = EnvelopeView::parse(&bytes).unwrap();
                        prop_assert_eq!(view.acl_representation(), effective.acl_representation);
                        let named = view.from_name().map(|name| name.to_string());
                        prop_assert_eq!(named.as_deref(), effective.from.as_ref().map(AgentId::name));
                    }
                    Err(error) => prop_assert!(refused_for_a_reason(&error), "{}", error),
                }
            }
        }
    }

    #[test]
    fn letters_of_any_two_encodings_are_split(envelope in envelope().boxed(), message in message().boxed()) {
        for dialect in [Dialect::Standard, Dialect::FipaServices, Dialect::Jade] {
            for of_envelope in [Representation::BitEfficient, Representation::Xml] {
                for of_message in [Representation::BitEfficient, Representation::String, Representation::Xml] {
                    let encoded = envelope.encode(of_envelope, dialect);
                    let payload = message.encode(of_message, dialect);
                    let (Ok(encoded), Ok(payload)) = (encoded, payload) else { continue };
                    let whole = Bytes::from([encoded.clone(), payload.clone()].concat());
                    let letter = Letter::split(whole).unwrap();
                    prop_assert_eq!(letter.envelope(), encoded);
                    prop_assert_eq!(letter.payload().to_bytes(), payload);
                    same(&Message::decode(letter.payload()).unwrap(), &message, dialect);
                }
            }
        }
    }
}

#[test]
fn times_are_written_without_zone_for_fipa_services() {
    let message = inform().reply_by("20000508T042651481Z".parse().unwrap());
    let bytes = written(&message.build().unwrap(), Dialect::FipaServices).unwrap();
    let read = Message::decode(&bytes.into()).unwrap().reply_by().unwrap();
    assert_eq!(read.zone(), Zone::Unspecified);
    assert_eq!(read.to_string(), "20000508T042651481");
}
