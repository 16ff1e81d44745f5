//! Contents that JADE wrote or read.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::fs;
use std::path::Path;

use bytes::Bytes;
use fipa_acl::{AgentId, Message, Payload};
use fipa_content::{
    Content, Printer, Problem, Profile, ReadError, Set, SlDialect, Term, Wff, from_slice,
};
use serde::{Deserialize, Serialize};

fn message(name: &str) -> Message {
    let directory = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/vectors");
    let bytes = fs::read(directory.join(name)).unwrap();
    Message::decode(&Payload::from(Bytes::from(bytes))).unwrap()
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename = "df-agent-description", rename_all = "kebab-case")]
struct Description {
    name: Option<Term<'static>>,
    languages: Option<Set<Vec<String>>>,
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename = "search-constraints", rename_all = "kebab-case")]
struct Constraints {
    max_results: Option<i64>,
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename = "search")]
struct Search(Description, Constraints);

const ALL: Search = Search(
    Description {
        name: None,
        languages: None,
    },
    Constraints {
        max_results: Some(-1),
    },
);

#[test]
fn a_search_is_read_and_written_as_jade_does() {
    for name in ["df_search_request.str", "df_search_reply.str"] {
        let message = message(name);
        let bytes = &message.content().unwrap()[..];
        let content = Content::parse_in(SlDialect::Jade, bytes).unwrap();
        let printer = Printer::new().dialect(SlDialect::Jade);
        assert_eq!(printer.print(&content).unwrap(), bytes, "{name}");
        assert_eq!(Content::parse(bytes).as_ref(), Ok(&content));
        // The standard notation of this content is the same.
        assert_eq!(Printer::new().print(&content).unwrap(), bytes);
        let language = message.language().unwrap();
        let profile = Profile::of_language(language).unwrap();
        assert_eq!(Profile::of(&content), Some(profile));
    }
}

#[test]
fn a_search_is_a_value() {
    let request = message("df_search_request.str");
    let request = Content::parse(request.content().unwrap()).unwrap();
    let action = request.action().unwrap();
    let (agent, search): (AgentId, Search) = action.read().unwrap();
    assert_eq!((agent.name(), search), ("df@jadetest", ALL));
    assert_eq!(Term::from_value(&ALL).unwrap().to_string(), {
        "(search (df-agent-description) (search-constraints :max-results -1))"
    });

    let reply = message("df_search_reply.str");
    let reply = Content::parse(reply.content().unwrap()).unwrap();
    let (searched, found): (_, Vec<Description>) = reply.result().unwrap();
    assert_eq!((searched, &found[..]), (action, &[][..]));
    assert!(matches!(reply.done(), Err(ReadError::Expression(_))));
}

#[derive(Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Reason {
    #[serde(rename = "MTS-error")]
    MtsError(fipa_content::Agent, Cause),
}

#[derive(Debug, PartialEq, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Cause {
    InternalError(String),
}

#[test]
fn a_failure_of_the_message_transport_is_read_and_written_as_jade_does() {
    let message = message("failure_unknown_agent.str");
    let bytes = &message.content().unwrap()[..];
    let content = Content::parse_in(SlDialect::Jade, bytes).unwrap();
    let printer = Printer::new().jade_failure();
    assert_eq!(printer.print(&content).unwrap(), bytes);
    // The output of SLCodec differs only in blanks.
    let line = Printer::new().dialect(SlDialect::Jade).print(&content);
    assert_eq!(Content::parse(&line.unwrap()).as_ref(), Ok(&content));

    let (action, reason) = content.refusal().unwrap();
    let (sender, act): (AgentId, Term<'static>) = action.read().unwrap();
    assert_eq!(sender.addresses(), ["http://127.0.0.1:9904/acc"]);
    assert_eq!(act, Term::functional("ACLMessage", []));
    let Reason::MtsError(receiver, Cause::InternalError(cause)) = reason.read().unwrap();
    assert_eq!(receiver.0.name(), "nobody@jadetest");
    assert!(cause.starts_with("Agent not found: "), "{cause}");
}

/// An agent identifier without names of slots is malformed, and keeps its arguments.
#[test]
fn arguments_by_position_survive_the_layout_of_failures() {
    let content = Content::parse("((p (agent-identifier crex)))").unwrap();
    let text = Printer::new().jade_failure().print(&content).unwrap();
    assert_eq!(text, b"( (p (agent-identifier crex)) )");
}

/// The contents of the other recordings.
#[test]
fn content_that_is_no_sl_is_refused() {
    let error = Content::parse("hello jade").unwrap_err();
    assert_eq!((error.offset(), error.clause()), (0, "FIPA00008 Content"));
    let expected = "'('";
    let found = "word";
    assert_eq!(error.problem(), &Problem::Unexpected { found, expected });
    assert_eq!(
        error.to_string(),
        "at byte 0: unexpected word where '(' should be (FIPA00008 Content)"
    );
}

/// The notations in which JADE differs from the standard.
#[test]
fn deviations_of_jade_are_read_and_written() {
    let text = "((p \"true\" TRUE #4\"aGk= ??meta \"é\" .5 (+ 1 2) (a :\"b c\" 1)) ??formula )";
    let content = Content::parse_in(SlDialect::Jade, text).unwrap();
    let [first, second] = &content.expressions[..] else {
        panic!("two expressions");
    };
    let fipa_content::ContentExpression::Wff(Wff::Predicate { arguments, .. }) = first else {
        panic!("a predicate");
    };
    assert_eq!(arguments[0], Term::from("true"));
    assert_eq!(arguments[1], Term::Boolean(true));
    assert_eq!(arguments[2], Term::Bytes(b"hi"[..].into()));
    assert_eq!(arguments[3], Term::Meta("meta".into()));
    assert_eq!(*second, Wff::Meta("formula".into()).into());
    let written = Printer::new().dialect(SlDialect::Jade).print(&content);
    assert_eq!(written.unwrap(), text.replace("TRUE", "true").as_bytes());
    // In the standard, the bytes are text.
    let standard: String = from_slice("#4\"aGk=").unwrap();
    assert_eq!(standard, "aGk=");
    assert_eq!(Profile::of(&content), None);
}
