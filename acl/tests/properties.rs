//! What must hold for every message and envelope, and for any bytes at all.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::time::{Duration, SystemTime};

use bytes::{Bytes, BytesMut};
use fipa_acl::{
    AclRepresentation, AgentId, Envelope, EnvelopeParams, EnvelopeView, Letter, Message,
    MessageView, Payload, Performative, Received, Time, bitefficient,
};
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;

/// Text that an encoding has to be careful with.
fn text() -> BoxedStrategy<String> {
    prop_oneof![
        "[a-z@#0-9-]{0,8}",
        "[a-z\"\\\\#0-9 ():]{0,12}",
        "[^\\x00]{0,20}",
        Just("\"quoted\"".to_owned()),
        Just("#3\"abc".to_owned()),
        Just("ends with \\".to_owned()),
    ]
    .boxed()
}

fn some_text() -> BoxedStrategy<String> {
    text()
        .prop_filter("not empty", |text| !text.is_empty())
        .boxed()
}

fn token() -> BoxedStrategy<String> {
    prop_oneof![
        "[a-z0-9.#@\"-]{1,10}",
        Just("X-".to_owned()),
        Just("x-X-a".to_owned())
    ]
    .boxed()
}

fn pairs() -> impl Strategy<Value = Vec<(String, String)>> {
    vec((token(), text()), 0..3)
}

fn agent() -> BoxedStrategy<AgentId> {
    let plain = (some_text(), vec(some_text(), 0..3), pairs()).prop_map(|(name, urls, pairs)| {
        let mut agent = AgentId::new(name).unwrap();
        for url in urls {
            agent = agent.with_address(url).unwrap();
        }
        for (name, value) in pairs {
            agent = agent.with_user_defined(name, value).unwrap();
        }
        agent
    });
    plain
        .prop_recursive(3, 8, 2, |inner| {
            (inner.clone(), vec(inner, 0..2)).prop_map(|(agent, resolvers)| {
                resolvers.into_iter().fold(agent, |agent, resolver| {
                    agent.with_resolver(resolver).unwrap()
                })
            })
        })
        .boxed()
}

fn time() -> BoxedStrategy<Time> {
    let ms = 0_u64..253_402_300_800_000;
    prop_oneof![
        ms.prop_map(|ms| {
            let time = SystemTime::UNIX_EPOCH + Duration::from_millis(ms);
            Time::from_system_time(time).unwrap()
        }),
        (0_u64..1_000_000_000_000).prop_map(|ms| Time::after(Duration::from_millis(ms)).unwrap()),
        (0_u64..1_000_000_000_000).prop_map(|ms| Time::before(Duration::from_millis(ms)).unwrap()),
        Just("20101223T120037980".parse().unwrap()),
        Just("20101223T120037980K".parse().unwrap()),
    ]
    .boxed()
}

fn performative() -> impl Strategy<Value = Performative> {
    prop_oneof![
        prop::sample::select(&Performative::STANDARD[..]),
        "[a-z][a-z0-9-]{0,9}".prop_map(|name| name.parse().unwrap()),
    ]
}

fn content() -> impl Strategy<Value = Option<Vec<u8>>> {
    let sizes = prop_oneof![
        4 => 0..20_usize,
        1 => 250..260_usize,
        1 => Just(65_535_usize),
        1 => Just(65_536_usize),
    ];
    option::of((sizes, any::<u8>()).prop_map(|(size, byte)| vec![byte; size]))
}

prop_compose! {
    fn message()(
        performative in performative(),
        sender in option::of(agent()),
        receivers in vec(agent(), 0..3),
        reply_to in vec(agent(), 0..2),
        content in content(),
        texts in vec(option::of(text()), 6),
        protocol in option::of(token()),
        reply_by in option::of(time()),
        user_defined in pairs(),
    ) -> Message {
        let mut builder = Message::builder(performative).receivers(receivers);
        if let Some(sender) = sender { builder = builder.sender(sender); }
        for agent in reply_to { builder = builder.reply_to(agent); }
        if let Some(content) = content { builder = builder.content(content); }
        if let Some(text) = &texts[0] { builder = builder.language(text); }
        if let Some(text) = &texts[1] { builder = builder.encoding(text); }
        if let Some(text) = &texts[2] { builder = builder.ontology(text); }
        if let Some(text) = &texts[3] { builder = builder.conversation_id(text); }
        if let Some(text) = &texts[4] { builder = builder.reply_with(text); }
        if let Some(text) = &texts[5] { builder = builder.in_reply_to(text); }
        if let Some(protocol) = protocol { builder = builder.protocol(protocol); }
        if let Some(time) = reply_by { builder = builder.reply_by(time); }
        for (name, value) in user_defined { builder = builder.user_defined(name, value); }
        builder.build().unwrap()
    }
}

prop_compose! {
    fn received()(
        by in some_text(),
        from in option::of(some_text()),
        date in time(),
        id in option::of(some_text()),
        via in option::of(some_text()),
        user_defined in pairs(),
    ) -> Received {
        Received { by, from, date, id, via, user_defined }
    }
}

prop_compose! {
    fn params()(
        to in vec(agent(), 0..3),
        from in option::of(agent()),
        comments in option::of(some_text()),
        acl_representation in some_text(),
        standard in option::of(0..3_usize),
        payload_length in option::of(any::<u64>()),
        payload_encoding in option::of(some_text()),
        date in time(),
        intended_receivers in vec(agent(), 0..3),
        received in received(),
        transport_behaviour in option::of(some_text()),
        user_defined in pairs(),
    ) -> EnvelopeParams {
        let known = [AclRepresentation::BitEfficient, AclRepresentation::String, AclRepresentation::Xml];
        let acl_representation = match standard {
            Some(which) => known[which].clone(),
            None => AclRepresentation::from(&*acl_representation),
        };
        EnvelopeParams {
            to, from, comments, payload_length, payload_encoding, intended_receivers,
            transport_behaviour, user_defined,
            acl_representation: Some(acl_representation),
            date: Some(date),
            received: Some(received),
        }
    }
}

prop_compose! {
    fn envelope()(base in params().boxed(), extensions in vec(params().boxed(), 0..3)) -> Envelope {
        let extensions = extensions.into_iter().map(|e| EnvelopeParams { date: None, ..e });
        Envelope { base, extensions: extensions.collect() }
    }
}

/// Bytes with a chance to be taken for something.
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

fn never_panics(bytes: &[u8]) {
    if let Ok(view) = MessageView::parse(bytes) {
        assert_eq!(view.user_defined().count(), view.user_defined().count());
        view.receivers()
            .for_each(|agent| assert!(!agent.name().is_empty()));
    }
    if let Ok(message) = Message::decode(&Payload::from(Bytes::copy_from_slice(bytes))) {
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
    #![proptest_config(ProptestConfig::with_cases(192))]

    #[test]
    fn a_message_survives(message in message().boxed()) {
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
            let (head, tail) = message.around_content(content.len()).unwrap();
            prop_assert_eq!((head, tail), (payload.head, payload.tail));
        }
    }

    #[test]
    fn an_envelope_survives(envelope in envelope().boxed()) {
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
    fn a_message_cut_short_is_an_error(message in message().boxed(), cut in any::<prop::sample::Index>()) {
        let bytes = message.to_payload().to_bytes();
        let cut = cut.index(bytes.len());
        prop_assert!(Message::decode(&Payload::from(bytes.slice(..cut))).is_err());
        let payload = message.to_payload();
        let shorter = Payload { head: payload.head.slice(..payload.head.len() - 1), ..payload };
        prop_assert!(Message::decode(&shorter).is_err());
    }

    #[test]
    fn an_envelope_cut_short_is_an_error(envelope in envelope().boxed(), cut in any::<prop::sample::Index>()) {
        let bytes = envelope.encode_standard().unwrap();
        let cut = cut.index(bytes.len());
        prop_assert!(Envelope::decode(&bytes[..cut]).is_err());
        prop_assert!(EnvelopeView::parse(&bytes[..cut]).is_err());
    }

    #[test]
    fn damaged_bytes_are_read_or_refused(
        message in message().boxed(),
        envelope in envelope().boxed(),
        place in any::<prop::sample::Index>(),
        byte in any::<u8>(),
    ) {
        for bytes in [message.to_payload().to_bytes(), envelope.encode_standard().unwrap()] {
            let mut damaged = bytes.to_vec();
            let place = place.index(damaged.len());
            damaged[place] = byte;
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
