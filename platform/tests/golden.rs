//! The exchange that was recorded with JADE's directory facilitator.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod common;

use std::fs;
use std::path::Path;

use bytes::Bytes;
use common::{Clock, id};
use fipa_acl::{Message, Payload};
use fipa_content::{Content, Printer, SlDialect};
use fipa_platform::{Ams, ApDescription, Asker, Df, Platform, Resident, found};

fn recorded(name: &str) -> Message {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors");
    let bytes = fs::read(directory.join(name)).unwrap();
    Message::decode(&Payload::from(Bytes::from(bytes))).unwrap()
}

#[test]
fn a_recorded_search_is_answered_as_jade_answered_it() {
    let request = recorded("df_search_request.str");
    let expected = recorded("df_search_reply.str");
    for dialect in [SlDialect::Standard, SlDialect::Jade] {
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

/// The recorded requests to the DF and AMS of JADE, in order, with their answers.
fn exchanges() -> Vec<(String, Message, Option<Message>)> {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors");
    let text = fs::read_to_string(directory.join("jade_ams_df.txt")).unwrap();
    let message = |text: &str| {
        let bytes = Bytes::copy_from_slice(text.trim().as_bytes());
        Message::decode(&Payload::from(bytes)).unwrap()
    };
    let exchanges = text.split("=== ").skip(1).map(|exchange| {
        let (name, rest) = exchange.split_once('\n').unwrap();
        let (request, answer) = rest.split_once("\n---\n").unwrap();
        let answer = (answer.trim() != "no answer").then(|| message(answer));
        (name.to_owned(), message(request), answer)
    });
    exchanges.collect()
}

/// Returns a content in the standard dialect: blanks and unnecessary quotes are no difference. JADE's content of
/// some messages is no SL and stays as it is.
fn normal(content: &[u8]) -> String {
    match Content::parse_in(SlDialect::Jade, content) {
        Ok(parsed) => String::from_utf8(Printer::new().print(&parsed).unwrap()).unwrap(),
        Err(_) => String::from_utf8(content.to_vec()).unwrap(),
    }
}

/// Answers that differ from those of JADE: the name of the exchange, and our performative and the end of our
/// content. docs/management.md has the reasons.
#[rustfmt::skip]
const DIFFERENCES: &[(&str, &str, &str)] = &[
    ("df_register", "inform", ":ontologies (set yard) :languages (set fipa-sl) :lease-time 20261122T130000000Z)))))"),
    ("df_search_type", "inform", ":ontologies (set yard) :languages (set fipa-sl) :lease-time 20261122T130000000Z))))"),
    ("df_search_ontology", "inform", ":ontologies (set yard) :languages (set fipa-sl) :lease-time 20261122T130000000Z))))"),
    ("df_search_without_constraints", "refuse", "(missing-argument search-constraints))"),
    ("df_modify", "inform", ":lease-time 20261122T130000000Z)))))"),
    ("df_search_property", "inform", ":lease-time 20261122T130000000Z))))"),
    ("df_unknown_function", "refuse", "(unsupported-function explode))"),
    ("df_register_without_argument", "refuse", "(missing-argument df-agent-description))"),
    ("df_register_unknown_slot", "refuse", "(unexpected-parameter df-agent-description colour))"),
    ("df_register_other_type", "refuse", "(unexpected-argument ams-agent-description))"),
    ("df_unknown_ontology", "not-understood", "ontology))"),
    ("df_undecodable", "not-understood", "((unrecognised-value content))"),
    ("df_not_an_action", "not-understood", "((unrecognised-value content))"),
    ("df_query_ref", "not-understood", "((unsupported-act query-ref))"),
    ("df_other_protocol", "inform", ":lease-time 20261122T130000000Z)))))"),
    ("ams_get_description", "inform", ":addresses (sequence http://127.0.0.1:27778/acc)))))))"),
    ("ams_get_description_word", "inform", ":addresses (sequence http://127.0.0.1:27778/acc)))))))"),
    ("ams_search_all", "inform", "(agent-identifier :name echo@jadetest) :state active))))"),
    ("ams_search_name", "inform", "(agent-identifier :name echo@jadetest) :state active))))"),
    ("ams_search_state", "inform", "(agent-identifier :name echo@jadetest) :state active))))"),
    ("ams_deregister_other", "refuse", " unauthorised)"),
    ("ams_unknown_function", "refuse", "(unsupported-function explode))"),
    ("ams_register_without_argument", "refuse", "(missing-argument ams-agent-description))"),
    ("ams_register_unknown_slot", "refuse", "(unexpected-parameter ams-agent-description colour))"),
    ("ams_unknown_ontology", "not-understood", "ontology))"),
    ("ams_undecodable", "not-understood", "((unrecognised-value content))"),
    ("ams_query_ref", "not-understood", "((unsupported-act query-ref))"),
];

#[test]
fn recorded_requests_are_answered_as_jade_answered_them() {
    let clock = Clock::start();
    let address = "http://127.0.0.1:27778/acc";
    let own = |name: &str| id(name).with_address(address).unwrap();
    let mut df = Df::new(own("df@jadetest"));
    let mut ams = Ams::new(
        own("ams@jadetest"),
        ApDescription {
            name: "jadetest".to_owned(),
            services: vec![("fipa.mts.mtp.http.std".to_owned(), vec![address.to_owned()])],
        },
    );
    let residents = ["ams@jadetest", "df@jadetest", "echo@jadetest"].map(|name| Resident {
        name: name.into(),
        registration: 1,
    });
    let mut differences = Vec::new();
    for (name, request, expected) in exchanges() {
        let mut asker = Asker::new(request.sender().unwrap().clone(), 0, Platform::Unproved);
        asker.dialect = SlDialect::Jade;
        let now = clock.after(0.0);
        let answer = match request.receivers()[0].name() {
            "df@jadetest" => {
                df.handle_message(now, &asker, &request);
                df.poll_answer()
            }
            _ => {
                ams.handle_message(now, &asker, &request, &residents);
                ams.poll_answer()
            }
        };
        let answer = answer.map(|it| it.message);
        let part = |message: &Option<Message>| {
            message.as_ref().map(|it| {
                (
                    it.performative().as_str().to_owned(),
                    normal(it.content().unwrap()),
                )
            })
        };
        let (ours, theirs) = (part(&answer), part(&expected));
        if let (Some(answer), Some(expected)) = (&answer, &expected) {
            // The parameters of the conversation never differ.
            assert_eq!(answer.sender(), expected.sender(), "{name}");
            assert_eq!(answer.receivers(), expected.receivers(), "{name}");
            assert_eq!(answer.in_reply_to(), expected.in_reply_to(), "{name}");
            assert_eq!(
                answer.conversation_id(),
                expected.conversation_id(),
                "{name}"
            );
            assert_eq!(answer.protocol(), expected.protocol(), "{name}");
            assert_eq!(answer.language(), expected.language(), "{name}");
            assert_eq!(answer.ontology(), expected.ontology(), "{name}");
        }
        if ours != theirs {
            let (act, content) = ours.unwrap_or_default();
            println!("{name}\n  JADE: {theirs:?}\n  ours: {act} {content}");
            differences.push((name, act, content));
        }
    }
    let listed = DIFFERENCES.iter().map(|(name, ..)| *name);
    let found = differences.iter().map(|(name, ..)| &**name);
    assert_eq!(found.collect::<Vec<_>>(), listed.collect::<Vec<_>>());
    for ((name, act, content), (_, expected, end)) in differences.iter().zip(DIFFERENCES) {
        assert_eq!(act, expected, "{name}");
        assert!(content.ends_with(end), "{name}: {content}");
    }
}
