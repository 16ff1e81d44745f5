//! Properties of the bit-efficient encoding for all messages, all envelopes and any bytes.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod arbitrary;

use std::time::SystemTime;

use bytes::{Bytes, BytesMut};
use fipa_acl::{
    AgentId, DecodeError, Dialect, Envelope, EnvelopeView, Explanation, Letter, Message,
    MessageIndex, MessageView, Payload, Performative, Representation, Time, bitefficient, explain,
};
use proptest::collection::vec;
use proptest::prelude::*;

use arbitrary::{envelope, message};

/// Bytes that resemble an encoded message or envelope.
fn nearly_encoded() -> impl Strategy<Value = Vec<u8>> {
    let codes = prop::sample::select(
        &b"\x00\x01\x02\x03\x04\x05\x06\x09\x0a\x0d\x10\x12\x14\x16\x17\x19\x20\x24\x40\x60\x70\x74\xff\xfa\xfd\xfe\"#1a"[..],
    );
    let first = prop::sample::select(&b"\xfa\xfd\xfe"[..]);
    let body = vec(prop_oneof![4 => codes, 1 => any::<u8>()], 0..200);
    (first, body).prop_map(|(first, mut body)| {
        body.insert(0, first);
        body
    })
}

/// Explains the bytes. Checks that the spans cover every byte once, up to the error of decoding, if
/// any.
fn explained(bytes: &[u8]) -> Explanation {
    let explanation = explain(bytes);
    let mut end = 0;
    for span in &explanation.spans {
        assert_eq!(span.offset, end);
        assert!(span.len > 0);
        assert!(!span.meaning.chars().any(char::is_control), "{span:?}");
        end += span.len;
    }
    let error = explanation.error.as_ref();
    assert_eq!(end, error.map_or(bytes.len(), DecodeError::offset));
    let is_letter = matches!(bytes.first(), Some(0xfd | 0xfe));
    let decoded = if is_letter {
        EnvelopeView::parse(bytes).err()
    } else {
        MessageView::parse(bytes).err()
    };
    let other = matches!(
        Representation::detect(bytes),
        Some(Representation::String | Representation::Xml)
    );
    if other {
        assert!(error.is_some(), "only bit-efficient bytes are explained");
    } else if !is_letter || decoded.is_some() {
        assert_eq!(error, decoded.as_ref());
    }
    explanation
}

/// Checks that the index of a message gives the same message, or the same error.
fn index_agrees(payload: &Payload) {
    let (index, decoded) = (MessageIndex::of(payload), Message::decode(payload));
    assert_eq!(index.as_ref().err(), decoded.as_ref().err());
    let (Ok(index), Ok(message)) = (index, decoded) else {
        return;
    };
    let view = index.view(payload);
    assert_eq!(view.performative(), *message.performative());
    assert_eq!(
        view.content().as_deref(),
        message.content().map(|all| &**all)
    );
    assert_eq!(index.content(payload).as_ref(), message.content());
    assert_eq!(index.to_message(payload), message);
}

/// Counts the spans with this meaning.
fn count(explanation: &Explanation, meaning: &str) -> usize {
    let spans = explanation.spans.iter();
    spans.filter(|span| span.meaning == meaning).count()
}

fn all_agents<'a>(agents: impl IntoIterator<Item = &'a AgentId>) -> usize {
    agents
        .into_iter()
        .map(|agent| 1 + all_agents(agent.resolvers()))
        .sum()
}

fn never_panics(bytes: &[u8]) {
    explained(bytes);
    if let Ok(view) = MessageView::parse(bytes) {
        assert_eq!(view.user_defined().count(), view.user_defined().count());
        view.receivers()
            .for_each(|agent| assert!(!agent.name().is_empty()));
    }
    let payload = Payload::from(Bytes::copy_from_slice(bytes));
    index_agrees(&payload);
    if let Ok(message) = Message::decode(&payload) {
        let _ = message.to_string();
        let again = Message::decode(&message.to_payload());
        assert_eq!(again, Ok(message), "decoded messages can be encoded");
    }
    if let Ok(view) = EnvelopeView::parse(bytes) {
        assert!(view.len() <= bytes.len());
        let stamps = view.stamps().count();
        let receivers = view.receivers().count();
        if let Ok((envelope, len)) = Envelope::decode(bytes) {
            assert_eq!(len, view.len());
            assert!(
                stamps
                    >= envelope
                        .extensions
                        .iter()
                        .filter(|e| e.received.is_some())
                        .count()
            );
            let effective = envelope.effective();
            let named = if effective.intended_receivers.is_empty() {
                effective.to.len()
            } else {
                effective.intended_receivers.len()
            };
            assert_eq!(receivers, named);
            assert_eq!(view.from_name().is_some(), effective.from.is_some());
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(ProptestConfig::default().cases.min(192)))]

    #[test]
    fn encoded_len_is_the_length_of_the_encoded_message(message in message().boxed()) {
        for representation in [
            Representation::BitEfficient,
            Representation::String,
            Representation::Xml,
        ] {
            for dialect in [Dialect::Standard, Dialect::FipaServices, Dialect::Jade] {
                let len = message.encoded_len(representation, dialect);
                let written = message.encode(representation, dialect);
                prop_assert_eq!(len.clone(), written.as_ref().map(Bytes::len).map_err(Clone::clone));
                let Ok(written) = written else { continue };
                let mut buffer = vec![0; written.len()];
                let mut out = &mut buffer[..];
                message.encode_into(representation, dialect, &mut out).unwrap();
                prop_assert_eq!(out.len(), 0);
                prop_assert_eq!(&buffer[..], &written[..]);
            }
        }
    }

    #[test]
    fn a_message_is_the_same_after_a_round_trip(message in message().boxed()) {
        let payload = message.to_payload();
        prop_assert_eq!(payload.len(), bitefficient::encoded_len(&message));
        prop_assert_eq!(payload.is_split(), message.content().is_some());
        prop_assert_eq!(&Message::decode(&payload).unwrap(), &message);

        let mut out = BytesMut::new();
        bitefficient::encode(&message, &mut out);
        let whole = Payload::from(out.freeze());
        prop_assert_eq!(&whole.head, &payload.to_bytes());
        prop_assert_eq!(&Message::decode(&whole).unwrap(), &message);
        if let Some(content) = message.content() {
            let date = Time::from_system_time(SystemTime::UNIX_EPOCH).unwrap();
            let letter = message.to_letter_around(content.len(), date).unwrap();
            prop_assert_eq!(letter.with_content(content.clone()).into_payload(), payload);
        }
    }

    #[test]
    fn an_index_gives_the_message_in_every_encoding(message in message().boxed()) {
        index_agrees(&message.to_payload());
        for representation in [
            Representation::BitEfficient,
            Representation::String,
            Representation::Xml,
        ] {
            for dialect in [Dialect::Standard, Dialect::FipaServices, Dialect::Jade] {
                if let Ok(encoded) = message.encode(representation, dialect) {
                    index_agrees(&encoded.into());
                }
            }
        }
    }

    #[test]
    fn an_envelope_is_the_same_after_a_round_trip(envelope in envelope().boxed()) {
        let bytes = envelope.encode_standard().unwrap();
        prop_assert_eq!(Envelope::decode(&bytes).unwrap(), (envelope.clone(), bytes.len()));
        let letter = Letter::split(bytes.clone()).unwrap();
        prop_assert_eq!(letter.envelope(), bytes.clone());
        let effective = envelope.effective();
        let view = EnvelopeView::parse(&bytes).unwrap();
        prop_assert_eq!(view.len(), bytes.len());
        prop_assert_eq!(
            view.from_name().map(|name| name.to_string()),
            effective.from.as_ref().map(|agent| agent.name().to_owned())
        );
        prop_assert_eq!(view.acl_representation(), effective.acl_representation);
        let wanted = if effective.intended_receivers.is_empty() {
            effective.to
        } else {
            effective.intended_receivers
        };
        let names: Vec<_> = view.receivers().map(|name| name.to_string()).collect();
        let wanted: Vec<_> = wanted.iter().map(|agent| agent.name().to_owned()).collect();
        prop_assert_eq!(names, wanted);
        prop_assert_eq!(view.stamps().count(), envelope.extensions.len() + 1);
    }

    #[test]
    fn a_letter_is_explained_to_the_last_byte(
        envelope in envelope().boxed(),
        message in message().boxed(),
    ) {
        let payload = message.to_payload().to_bytes();
        let of_message = explained(&payload);
        prop_assert_eq!(&of_message.error, &None);
        let standard = Performative::STANDARD.contains(message.performative());
        let user_defined = if standard { "" } else { ", user-defined" };
        let act = format!("performative: {}{user_defined}", message.performative());
        prop_assert_eq!(count(&of_message, &act), 1);
        let agents = message.sender().into_iter().chain(message.receivers()).chain(message.reply_to());
        let agents = all_agents(agents);
        prop_assert_eq!(count(&of_message, "end of agent identifier"), agents);
        prop_assert_eq!(count(&of_message, "end of message"), 1);
        for (what, text) in [
            ("language", message.language()),
            ("conversation-id", message.conversation_id()),
            ("protocol", message.protocol()),
        ] {
            let start = format!("{what}: '{}", text.unwrap_or_default());
            let found = of_message.spans.iter().find(|span| span.meaning.starts_with(&start));
            let plain = text.is_some_and(|text| text.len() < 60 && !text.contains(fipa_acl::is_unprintable));
            prop_assert!(found.is_some() || !plain, "{start}");
            prop_assert!(found.is_none() || text.is_some(), "{start}");
        }

        let encoded = envelope.encode_standard().unwrap();
        let letter = explained(&[&encoded[..], &payload].concat());
        prop_assert_eq!(&letter.error, &None);
        prop_assert_eq!(count(&letter, "end of base envelope"), 1);
        let parts = || envelope.extensions.iter().chain([&envelope.base]);
        prop_assert_eq!(count(&letter, "end of extension envelope"), envelope.extensions.len());
        prop_assert_eq!(count(&letter, "end of received"), parts().count());
        let in_envelope = parts().flat_map(|part| {
            part.to.iter().chain(&part.from).chain(&part.intended_receivers)
        });
        let agents = agents + all_agents(in_envelope);
        prop_assert_eq!(count(&letter, "end of agent identifier"), agents);
        // All lengths are correct.
        prop_assert!(!letter.spans.iter().any(|span| span.meaning.contains("(ignored)")));
        // The message has the same spans as without an envelope, at higher offsets.
        let own = letter.spans.iter().skip_while(|span| span.offset < encoded.len());
        let own: Vec<_> = own.map(|span| (span.offset - encoded.len(), span.len, &span.meaning)).collect();
        let alone: Vec<_> = of_message.spans.iter().map(|span| (span.offset, span.len, &span.meaning)).collect();
        prop_assert_eq!(own, alone);
    }

    #[test]
    fn a_truncated_message_is_refused(message in message().boxed(), cut in any::<prop::sample::Index>()) {
        let bytes = message.to_payload().to_bytes();
        let cut = cut.index(bytes.len());
        prop_assert!(Message::decode(&Payload::from(bytes.slice(..cut))).is_err());
        let payload = message.to_payload();
        let shorter = Payload { head: payload.head.slice(..payload.head.len() - 1), ..payload };
        prop_assert!(Message::decode(&shorter).is_err());
    }

    #[test]
    fn a_truncated_envelope_is_refused(envelope in envelope().boxed(), cut in any::<prop::sample::Index>()) {
        let bytes = envelope.encode_standard().unwrap();
        let cut = cut.index(bytes.len());
        prop_assert!(Envelope::decode(&bytes[..cut]).is_err());
        prop_assert!(EnvelopeView::parse(&bytes[..cut]).is_err());
    }

    #[test]
    fn damaged_bytes_are_read_or_refused(
        message in message().boxed(),
        envelope in envelope().boxed(),
        at in any::<prop::sample::Index>(),
        byte in any::<u8>(),
    ) {
        for bytes in [message.to_payload().to_bytes(), envelope.encode_standard().unwrap()] {
            let mut damaged = bytes.to_vec();
            let at = at.index(damaged.len());
            damaged[at] = byte;
            never_panics(&damaged);
        }
    }

    #[test]
    fn any_bytes_are_read_or_refused(bytes in vec(any::<u8>(), 0..300)) {
        never_panics(&bytes);
    }

    #[test]
    fn nearly_encoded_bytes_are_read_or_refused(bytes in nearly_encoded()) {
        never_panics(&bytes);
    }
}
