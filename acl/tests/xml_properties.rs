//! Properties of the XML encodings for all messages, all envelopes and damaged documents.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod arbitrary;

use std::time::{Duration, SystemTime};

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, AgentId, Dialect, Envelope, EnvelopeParams, Letter, Message, Payload,
    Performative, Received, Representation, Time,
};
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;

use arbitrary::{Kinds, agent_of, message_of};

const XML: Representation = Representation::Xml;

/// Text that XML can represent, with escapes if necessary.
fn text() -> BoxedStrategy<String> {
    let carried = |c: &char| !matches!(c, '\0'..='\x08' | '\x0b' | '\x0c' | '\x0e'..='\x1f' | '\u{fffe}' | '\u{ffff}');
    prop_oneof![
        "[a-z@#0-9-]{0,8}",
        "[ \\t\\r\\n<>&'\"a-b;\\]]{0,12}",
        "[^\\x00]{0,20}".prop_map(move |text| text.chars().filter(carried).collect()),
        Just("&amp;lt;]]>".to_owned()),
    ]
    .boxed()
}

fn some_text() -> BoxedStrategy<String> {
    text()
        .prop_filter("not empty", |text| !text.is_empty())
        .boxed()
}

fn pairs() -> impl Strategy<Value = Vec<(String, String)>> {
    let name = prop_oneof!["[a-zA-Z0-9._-]{1,8}", "[a-z<&\"X-]{1,5}"];
    vec((name, text()), 0..3)
}

fn agent() -> BoxedStrategy<AgentId> {
    agent_of(some_text(), some_text(), pairs().boxed())
}

fn date() -> impl Strategy<Value = Time> {
    prop_oneof![
        (0_u64..253_402_300_800_000).prop_map(|ms| {
            Time::from_system_time(SystemTime::UNIX_EPOCH + Duration::from_millis(ms)).unwrap()
        }),
        Just("20101223T120037980".parse().unwrap()),
        Just("20101223T120037980K".parse().unwrap()),
    ]
}

fn time() -> impl Strategy<Value = Time> {
    prop_oneof![
        3 => date(),
        1 => (0_u64..1_000_000).prop_map(|ms| Time::after(Duration::from_millis(ms)).unwrap()),
    ]
}

fn message() -> impl Strategy<Value = Message> {
    message_of(Kinds {
        performative: prop_oneof![
            prop::sample::select(&Performative::STANDARD[..]),
            "[a-z][a-z<&-]{0,9}".prop_map(|name| name.parse().unwrap()),
        ]
        .boxed(),
        agent: agent(),
        content: option::of(text().prop_map(String::into_bytes)).boxed(),
        text: text(),
        protocol: "[!-'*-~]{1,9}".boxed(),
        time: time().boxed(),
        pairs: pairs().boxed(),
    })
}

prop_compose! {
    fn received()(
        by in some_text(),
        from in option::of(some_text()),
        date in date(),
        id in option::of(some_text()),
        via in option::of(some_text()),
        user_defined in pairs(),
    ) -> Received {
        Received { from, id, via, user_defined, ..Received::new(by, date) }
    }
}

prop_compose! {
    fn params()(
        to in vec(agent(), 0..3),
        from in option::of(agent()),
        comments in option::of(some_text()),
        acl_representation in option::of(prop_oneof![
            Just(AclRepresentation::Xml),
            "[ a-z.&]{1,9}".prop_map(|name| AclRepresentation::from(name.as_str())),
        ]),
        payload_length in option::of(any::<u64>()),
        payload_encoding in option::of(some_text()),
        date in option::of(date()),
        intended_receivers in vec(agent(), 0..3),
        received in option::of(received()),
        transport_behaviour in option::of(some_text()),
        user_defined in pairs(),
    ) -> EnvelopeParams {
        EnvelopeParams {
            to, from, comments, acl_representation, payload_length, payload_encoding, date,
            intended_receivers, received, transport_behaviour, user_defined,
        }
    }
}

fn envelope() -> impl Strategy<Value = Envelope> {
    (params(), vec(params(), 0..3)).prop_map(|(base, extensions)| Envelope { base, extensions })
}

fn decoded(bytes: &Bytes) -> Message {
    Message::decode(&Payload::from(bytes.clone())).unwrap()
}

proptest! {
    #[test]
    fn unescaped_content_is_read_as_it_is_and_well_formed_content_as_xml(
        text in prop_oneof![
            text(),
            "[a-c<>&/ ;]{0,16}",
            vec(prop_oneof![
                Just("</content>"), Just("<content>"), Just("<b>"), Just("</b>"), Just("<x/>"),
                Just("&amp;"), Just("&"), Just("<"), Just("a"), Just(" "), Just("<!-- "),
                Just("-->"), Just("<language>"), Just("</language>"), Just("<![CDATA["),
                Just("]]>"), Just("</fipa-message>"), Just("&#65;"),
            ], 0..8).prop_map(|pieces| pieces.concat()),
        ],
    ) {
        let read = |xml: String| Message::decode(&Payload::from(Bytes::from(xml)));
        // Without content, a message must be well-formed, so this is the value that XML gives it.
        let strict = read(format!("<fipa-message act='inform'><language>{text}</language></fipa-message>"));
        let jade = read(format!(
            "<fipa-message act=\"INFORM\" ><content>{text}</content>\n\t<protocol>p</protocol></fipa-message>"
        ));
        match (strict, jade) {
            // A text with the element itself inside has another meaning there.
            _ if text.contains("language>") || text.contains("<content") => {}
            (Ok(strict), Ok(jade)) => {
                let content = jade.content().map(|it| String::from_utf8_lossy(it).into_owned());
                prop_assert_eq!(content.as_deref(), strict.language());
                prop_assert_eq!(jade.protocol(), Some("p"));
            }
            (Ok(_), Err(error)) => prop_assert!(false, "well-formed content is refused: {error}"),
            (Err(_), Ok(jade)) => {
                prop_assert_eq!(jade.content().unwrap(), &text);
                prop_assert_eq!(jade.protocol(), Some("p"));
            }
            (Err(_), Err(_)) => {}
        }
    }
}

proptest! {
    #[test]
    fn a_message_of_text_is_the_same_after_a_round_trip(message in message()) {
        let encoded = message.encode(XML, Dialect::Standard).unwrap();
        prop_assert_eq!(decoded(&encoded), message);
    }

    #[test]
    fn a_message_in_the_dialect_of_a_peer_is_the_same_apart_from_zones(message in message()) {
        if let Ok(encoded) = message.encode(XML, Dialect::Jade) {
            prop_assert_eq!(decoded(&encoded), message.clone());
        }
        if let Ok(encoded) = message.encode(XML, Dialect::FipaServices) {
            let read = decoded(&encoded);
            // Only the zone of a time is dropped.
            let local = |message: &Message| message.reply_by().map(|time| {
                let mut text = time.to_string();
                text.truncate(18);
                text
            });
            prop_assert_eq!(local(&read), local(&message));
            prop_assert_eq!(
                read.encode(XML, Dialect::FipaServices).unwrap(),
                encoded
            );
            if message.reply_by().is_none() {
                // fipa_services writes an empty conversation identifier for an absent one. The
                // encoder writes an element only if it is present.
                prop_assert_eq!(read, message);
            }
        }
    }

    #[test]
    fn an_envelope_with_a_payload_is_the_same_after_a_round_trip(
        envelope in envelope(),
        payload in vec(any::<u8>(), 0..20),
    ) {
        let encoded = envelope.encode(XML, Dialect::Standard).unwrap();
        let letter = Bytes::from([&encoded[..], &payload].concat());
        prop_assert_eq!(Envelope::decode(&letter), Ok((envelope, encoded.len())));
        let split = Letter::split(letter).unwrap();
        prop_assert_eq!(split.envelope(), encoded);
        prop_assert_eq!(split.payload().to_bytes(), payload);
    }

    #[test]
    fn an_envelope_in_the_dialect_of_a_peer_has_the_effective_parameters(envelope in envelope()) {
        if let Ok(encoded) = envelope.encode(XML, Dialect::Jade) {
            let (read, _) = Envelope::decode(&encoded).unwrap();
            prop_assert_eq!(read.base, envelope.effective());
            prop_assert_eq!(read.extensions, []);
        }
        if let Ok(encoded) = envelope.encode(XML, Dialect::FipaServices) {
            let (mut read, _) = Envelope::decode(&encoded).unwrap();
            prop_assert_eq!(&read.encode(XML, Dialect::FipaServices).unwrap(), &encoded);
            let parts = read.extensions.iter_mut().zip(&envelope.extensions);
            for (read, written) in parts.chain([(&mut read.base, &envelope.base)]) {
                read.date = written.date;
                if let (Some(read), Some(written)) = (&mut read.received, &written.received) {
                    read.date = written.date;
                }
            }
            prop_assert_eq!(read, envelope);
        }
    }

    #[test]
    fn damaged_documents_are_read_or_refused(
        message in message(),
        envelope in envelope(),
        cuts in vec((any::<prop::sample::Index>(), 0..4_usize, "[<>&;/'\"!?\\[\\]a=\\x00-]{0,4}"), 1..4),
    ) {
        for document in [
            message.encode(XML, Dialect::Standard).unwrap(),
            envelope.encode(XML, Dialect::Standard).unwrap(),
        ] {
            let mut bytes = document.to_vec();
            for (at, removed, inserted) in &cuts {
                let at = at.index(bytes.len() + 1);
                let end = (at + removed).min(bytes.len());
                bytes.splice(at..end, inserted.bytes());
            }
            if let Ok((envelope, len)) = Envelope::decode(&bytes) {
                prop_assert!(len <= bytes.len());
                if let Ok(again) = envelope.encode(XML, Dialect::Standard) {
                    prop_assert_eq!(Envelope::decode(&again).unwrap().0, envelope);
                }
            }
            let payload = Payload::from(Bytes::from(bytes.clone()));
            match Message::decode(&payload) {
                Err(error) => prop_assert!(error.offset() <= bytes.len()),
                Ok(message) => if let Ok(again) = message.encode(XML, Dialect::Standard) {
                    prop_assert_eq!(decoded(&again), message);
                },
            }
        }
    }
}
