//! Reading a view allocates nothing.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::hint::black_box;

use allocation_counter::measure;
use fipa_acl::{EnvelopeView, MessageView};

const MESSAGE: &[u8] = include_bytes!("vectors/m23_all_fields.be");
const AGENTS: &[u8] = include_bytes!("vectors/m58_reply_to_multi.be");
const JADE: &[u8] = include_bytes!("vectors/jade_inform.be");
const LETTER: &[u8] = include_bytes!("vectors/failure_letter.bin");
/// With every kind of text: word, string with escapes, number, expression.
const EXPRESSIONS: &[u8] = b"\xfa\x10\x00\x10ping\0\
    \x05\x70seq\0\x12\x53\0\x12\xe2\xf6\0\x14\"a\"\0\x40\
    \x07\x14\"say \\\"hi\\\"\"\0\
    \x00\x10X-prio\0\x12\x80\
    \x01";

#[test]
fn the_counter_counts() {
    let info = measure(|| drop(black_box(vec![1_u8])));
    assert_eq!(info.count_total, 1);
}

#[test]
fn messages() {
    for bytes in [MESSAGE, AGENTS, JADE, EXPRESSIONS] {
        let info = measure(|| {
            let view = MessageView::parse(black_box(bytes)).unwrap();
            black_box(view.performative_name());
            black_box(view.sender().map(|sender| sender.name()));
            for agent in view.receivers().chain(view.reply_to()) {
                black_box(agent.name());
                agent.addresses().for_each(|address| {
                    black_box(address.len());
                });
                agent.resolvers().for_each(|resolver| {
                    black_box(resolver.name().len());
                });
            }
            view.user_defined().for_each(|(name, _)| {
                black_box(name.len());
            });
            black_box((view.reply_by(), view.conversation_id(), view.protocol()));
        });
        assert_eq!(info.count_total, 0, "{bytes:?}");
    }
    let info = measure(|| {
        let view = MessageView::parse(black_box(MESSAGE)).unwrap();
        black_box(view.content().unwrap().len());
        black_box(view.conversation_id().unwrap().as_str().len());
    });
    assert_eq!(info.count_total, 0);
}

#[test]
fn envelopes() {
    let info = measure(|| {
        let view = EnvelopeView::parse(black_box(LETTER)).unwrap();
        black_box(view.from_name().unwrap().as_str().len());
        view.receivers().for_each(|name| {
            black_box(name.as_str().len());
        });
        for stamp in view.stamps() {
            black_box(stamp.by().as_str().len());
            black_box(stamp.id().map(|id| id.as_str().len()));
        }
        black_box((view.acl_representation(), view.len()));
    });
    assert_eq!(info.count_total, 0);
}
