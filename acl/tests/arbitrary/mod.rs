//! Strategies for messages and envelopes in property tests.

#![allow(dead_code, reason = "every test uses its part")]

use std::time::{Duration, SystemTime};

use fipa_acl::{
    AclRepresentation, AgentId, Envelope, EnvelopeParams, Message, Performative, Received, Time,
};
use proptest::collection::vec;
use proptest::option;
use proptest::prelude::*;

/// Text that encodings must escape or quote.
pub(crate) fn text() -> BoxedStrategy<String> {
    prop_oneof![
        "[a-z@#0-9-]{0,8}",
        "[a-z\"\\\\#0-9 ():]{0,12}",
        "[^\\x00]{0,20}",
        Just("\"quoted\"".to_owned()),
        Just("#3\"abc".to_owned()),
        Just("ends with \\".to_owned()),
        "[\\x01-\\x20]{1,3}",
    ]
    .boxed()
}

pub(crate) fn some_text() -> BoxedStrategy<String> {
    text()
        .prop_filter("not empty", |text| !text.is_empty())
        .boxed()
}

pub(crate) fn token() -> BoxedStrategy<String> {
    prop_oneof![
        "[a-z0-9.#@\"-]{1,10}",
        Just("X-".to_owned()),
        Just("x-X-a".to_owned())
    ]
    .boxed()
}

pub(crate) fn pairs() -> impl Strategy<Value = Vec<(String, String)>> {
    vec((token(), text()), 0..3)
}

pub(crate) fn agent() -> BoxedStrategy<AgentId> {
    agent_of(some_text(), some_text(), pairs().boxed())
}

/// An agent with these names, addresses and user-defined parameters. Its resolvers have the same.
pub(crate) fn agent_of(
    name: BoxedStrategy<String>,
    url: BoxedStrategy<String>,
    pairs: BoxedStrategy<Vec<(String, String)>>,
) -> BoxedStrategy<AgentId> {
    let plain = (name, vec(url, 0..3), pairs).prop_map(|(name, urls, pairs)| {
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
            (inner.clone(), vec(inner, 0..3)).prop_map(|(agent, resolvers)| {
                resolvers.into_iter().fold(agent, |agent, resolver| {
                    agent.with_resolver(resolver).unwrap()
                })
            })
        })
        .boxed()
}

pub(crate) fn time() -> BoxedStrategy<Time> {
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
    option::of(prop_oneof![
        (sizes, any::<u8>()).prop_map(|(size, byte)| vec![byte; size]),
        vec(any::<u8>(), 0..30),
        text().prop_map(String::into_bytes),
    ])
}

pub(crate) fn message() -> impl Strategy<Value = Message> {
    message_of(Kinds::default())
}

/// The values of the parameters of messages.
pub(crate) struct Kinds {
    pub(crate) performative: BoxedStrategy<Performative>,
    pub(crate) agent: BoxedStrategy<AgentId>,
    pub(crate) content: BoxedStrategy<Option<Vec<u8>>>,
    pub(crate) text: BoxedStrategy<String>,
    pub(crate) protocol: BoxedStrategy<String>,
    pub(crate) time: BoxedStrategy<Time>,
    pub(crate) pairs: BoxedStrategy<Vec<(String, String)>>,
}

/// All values that a message can have.
impl Default for Kinds {
    fn default() -> Self {
        Self {
            performative: performative().boxed(),
            agent: agent(),
            content: content().boxed(),
            text: text(),
            protocol: token(),
            time: time(),
            pairs: pairs().boxed(),
        }
    }
}

prop_compose! {
    /// A message with these values.
    pub(crate) fn message_of(kinds: Kinds)(
        performative in kinds.performative,
        sender in option::of(kinds.agent.clone()),
        receivers in vec(kinds.agent.clone(), 0..3),
        reply_to in vec(kinds.agent, 0..3),
        content in kinds.content,
        texts in vec(option::of(kinds.text), 6),
        protocol in option::of(kinds.protocol),
        reply_by in option::of(kinds.time),
        user_defined in kinds.pairs,
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
    pub(crate) fn envelope()(base in params().boxed(), extensions in vec(params().boxed(), 0..3)) -> Envelope {
        let extensions = extensions.into_iter().map(|e| EnvelopeParams { date: None, ..e });
        Envelope { base, extensions: extensions.collect() }
    }
}
