//! Views do not allocate.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::hint::black_box;

use allocation_counter::measure;
use bytes::Bytes;
use fipa_acl::{EnvelopeView, MessageIndex, MessageView, Payload, Text};

const MESSAGE: &[u8] = include_bytes!("vectors/m23_all_fields.be");
const AGENTS: &[u8] = include_bytes!("vectors/m58_reply_to_multi.be");
const JADE: &[u8] = include_bytes!("vectors/jade_inform.be");
const NO_WHITE_SPACE: &[u8] = include_bytes!("vectors/m23_all_fields.str");
const JADE_STRING: &[u8] = include_bytes!("vectors/jade_inform.str");
const STRING: &[u8] = b"(inform :sender (agent-identifier :name a :addresses (sequence u:1 u:2) \
    :resolvers (sequence (agent-identifier :name r)) :X-k v) :receiver (set (agent-identifier \
    :name b) (agent-identifier :name \"c d\")) :reply-by 20240131T235959000Z :language \"a b\" \
    :protocol p :X-prio 7 :content #3\"a\"b)";
const ESCAPED: &[u8] = b"(inform :language \"say \\\"hi\\\"\" :content \"\\\"\")";
const XML_OF_FIPA_SERVICES: &[u8] = include_bytes!("vectors/m23_all_fields.xml");
const JADE_XML: &[u8] = include_bytes!("vectors/jade_xml_reply.payload");
const XML: &[u8] = b"<?xml version=\"1.0\"?><fipa-message act=\"inform\"><receiver>\
    <agent-identifier><name id=\"a\" /><addresses><url href=\"u:1\" /></addresses><resolvers>\
    <agent-identifier><name>r</name></agent-identifier></resolvers></agent-identifier></receiver>\
    <content>a b</content><language> l </language><reply-by time=\"20240131T235959000Z\" />\
    <user-defined href=\"X-k\">v</user-defined></fipa-message>";
const ESCAPED_XML: &[u8] = b"<fipa-message act='inform'><content>a&amp;b</content>\
    <language>&#x20;<![CDATA[<]]></language></fipa-message>";
const XML_LETTER: &[u8] = include_bytes!("vectors/e07_intended.xml");
const LETTER: &[u8] = include_bytes!("vectors/failure_letter.bin");
/// A message with every kind of text: word, string with escapes, number, expression.
const EXPRESSIONS: &[u8] = b"\xfa\x10\x00\x10ping\0\
    \x05\x70seq\0\x12\x53\0\x12\xe2\xf6\0\x14\"a\"\0\x40\
    \x07\x14\"say \\\"hi\\\"\"\0\
    \x00\x10X-prio\0\x12\x80\
    \x01";

#[test]
fn an_allocation_is_counted() {
    let info = measure(|| drop(black_box(vec![1_u8])));
    assert_eq!(info.count_total, 1);
}

/// Counts the allocations of reading a message and all its parameters.
fn allocations(bytes: &[u8]) -> u64 {
    measure(|| {
        let view = MessageView::parse(black_box(bytes)).unwrap();
        let access = |text: Text<'_>| {
            black_box(text.as_str().len());
        };
        access(view.performative_name());
        for agent in view
            .sender()
            .into_iter()
            .chain(view.receivers())
            .chain(view.reply_to())
        {
            access(agent.name());
            agent.addresses().for_each(access);
            agent
                .resolvers()
                .for_each(|resolver| access(resolver.name()));
            agent.user_defined().for_each(|(name, _)| access(name));
        }
        for text in [
            view.language(),
            view.encoding(),
            view.ontology(),
            view.protocol(),
            view.conversation_id(),
            view.reply_with(),
            view.in_reply_to(),
        ] {
            text.map(access);
        }
        view.user_defined().for_each(|(name, value)| {
            access(name);
            access(value);
        });
        black_box(view.content().map(|content| content.len()));
        black_box(view.reply_by());
    })
    .count_total
}

#[test]
fn reading_a_message_does_not_allocate() {
    for (name, bytes) in [
        ("bit-efficient", MESSAGE),
        ("agents", AGENTS),
        ("of JADE", JADE),
        ("string", STRING),
        ("string of JADE", JADE_STRING),
        ("string without white space", NO_WHITE_SPACE),
        ("XML", XML),
        ("XML of fipa_services", XML_OF_FIPA_SERVICES),
        ("XML of JADE", JADE_XML),
    ] {
        assert_eq!(allocations(bytes), 0, "{name}");
    }
}

#[test]
fn an_index_of_a_message_does_not_allocate() {
    for (name, bytes) in [
        ("bit-efficient", MESSAGE),
        ("agents", AGENTS),
        ("of JADE", JADE),
        ("string", STRING),
    ] {
        // The memory of `Bytes` that are shared for the first time is allocated then.
        let payload = Payload::from(Bytes::from_static(bytes));
        let info = measure(|| {
            let index = MessageIndex::of(black_box(&payload)).unwrap();
            black_box(index.view(&payload).reply_by());
            black_box(index.content(&payload));
        });
        assert_eq!(info.count_total, 0, "{name}");
    }
}

#[test]
fn escaped_texts_allocate_on_access_but_not_on_parsing() {
    for bytes in [EXPRESSIONS, ESCAPED, ESCAPED_XML] {
        let info = measure(|| {
            black_box(MessageView::parse(black_box(bytes)).unwrap());
        });
        assert_eq!(info.count_total, 0, "{bytes:?}");
        assert!(allocations(bytes) > 0);
    }
}

#[test]
fn reading_an_envelope_does_not_allocate() {
    for bytes in [LETTER, XML_LETTER] {
        let info = measure(|| {
            let view = EnvelopeView::parse(black_box(bytes)).unwrap();
            black_box(view.from_name().unwrap().as_str().len());
            view.receivers().for_each(|name| {
                black_box(name.as_str().len());
            });
            black_box(view.len());
        });
        assert_eq!(info.count_total, 0);
    }
    let info = measure(|| {
        let view = EnvelopeView::parse(black_box(LETTER)).unwrap();
        for stamp in view.stamps() {
            black_box(stamp.by().as_str().len());
            black_box(stamp.id().map(|id| id.as_str().len()));
        }
        black_box(view.acl_representation());
    });
    assert_eq!(info.count_total, 0);
}
