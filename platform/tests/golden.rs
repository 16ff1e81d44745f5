//! The exchange that was recorded with JADE's directory facilitator.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod common;

use std::fs;
use std::path::Path;

use bytes::Bytes;
use common::{Clock, id};
use fipa_acl::{Message, Payload};
use fipa_content::Dialect;
use fipa_platform::{Asker, Df, Platform, found};

fn recorded(name: &str) -> Message {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors");
    let bytes = fs::read(directory.join(name)).unwrap();
    Message::decode(&Payload::from(Bytes::from(bytes))).unwrap()
}

#[test]
fn a_recorded_search_is_answered_as_jade_answered_it() {
    let request = recorded("df_search_request.str");
    let expected = recorded("df_search_reply.str");
    for dialect in [Dialect::Standard, Dialect::Jade] {
        // JADE's DF has the address of its platform.
        let df = expected.sender().unwrap().clone();
        let mut df = Df::new(df);
        let sender = request.sender().unwrap().clone();
        let mut asker = Asker::new(sender, 0, Platform::Unproved);
        asker.dialect = dialect;
        df.handle_message(Clock::start().after(0.0), &asker, &request);
        let answer = df.poll_answer().unwrap().message;
        assert_eq!(df.poll_answer(), None);
        assert_eq!(found(&answer).unwrap(), []);
        assert_eq!(id(answer.sender().unwrap().name()), id("df@jadetest"));
        // An answer that expects no answer needs no `reply-with`.
        let mut builder = fipa_acl::MessageBuilder::from(answer);
        builder = builder.reply_with(expected.reply_with().unwrap());
        assert_eq!(builder.build().unwrap(), expected, "{dialect}");
    }
}
