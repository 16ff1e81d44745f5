//! Texts in string messages for JADE, judged by recordings of JADE's own lexer.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

use std::collections::HashMap;
use std::fmt::Write as _;

use fipa_acl::{
    AgentId, Dialect, EncodeError, Message, MessageBuilder, Performative, Representation,
};

/// What JADE read: a parameter and a value as it is in the message, then the text behind `=`, or `!`
/// if JADE refused the message. vectors/README.md describes it.
const RECORDED: &str = include_str!("vectors/jade_texts.tsv");

const TEXTS: &[&str] = &[
    "a",
    "fipa-request",
    "c-1",
    "conv@x",
    ":x",
    "a:b",
    ":sender",
    "'a'",
    "{a}",
    "`",
    ";",
    "!",
    "~a",
    "true",
    "http://h:7778/acc",
    "550e8400-e29b-41d4-a716-446655440000",
    // Outside ASCII.
    "é",
    "aé",
    "éa",
    "ödd",
    "ödd echo",
    "日本",
    "😀",
    "a\u{80}b",
    "\u{a0}",
    "\u{2028}",
    "ſet",
    "K",
    // Control characters.
    "a\u{7f}",
    "\u{1}",
    "a\tb",
    "a\nb",
    "\r\n",
    "a\r\nb",
    // Numbers and dates.
    "1",
    "42",
    "1a",
    "-5",
    "-a",
    "-",
    "+",
    "+5",
    "+a",
    "+1.5e3",
    ".5",
    "5.",
    "1e5",
    "+00000000T000030000",
    "-00000000T000030000",
    "+00000000T000030000x",
    "20000508T042651481Z",
    // Other first characters.
    "#",
    "#a",
    "#3\"abc",
    "@a",
    "@",
    // Blanks and parentheses.
    "",
    " ",
    "a b",
    " a",
    "a ",
    " a ",
    "(a b)",
    "a(b",
    "a)b",
    "()",
    "é b",
    // Quotation marks and backslashes.
    "\"",
    "\"\"",
    "\"a\"",
    "\"a",
    "a\"",
    "a\"b",
    "é\"b",
    "a \"b\" c",
    "\\",
    "a\\",
    "a\\b",
    "a\\\\",
    "\\n",
    "\\\"",
    "a\\\"b",
    "a \\\"b",
    "é\\\"b",
    "é\\",
    "1\\",
    "\\u0041",
    "\" :ontology \"",
];

const PARAMETERS: &[(&str, &str)] = &[
    ("name", "(INFORM :sender (agent-identifier :name @))"),
    (
        "address",
        "(INFORM :sender (agent-identifier :name a :addresses (sequence @)))",
    ),
    (
        "resolver",
        "(INFORM :sender (agent-identifier :name a :resolvers (sequence (agent-identifier :name @))))",
    ),
    (
        "agent-value",
        "(INFORM :sender (agent-identifier :name a :X-k @))",
    ),
    (
        "agent-key",
        "(INFORM :sender (agent-identifier :name a :X-@ v))",
    ),
    (
        "receiver",
        "(INFORM :receiver (set (agent-identifier :name @)))",
    ),
    (
        "reply-to",
        "(INFORM :reply-to (set (agent-identifier :name @)))",
    ),
    ("reply-with", "(INFORM :reply-with @)"),
    ("in-reply-to", "(INFORM :in-reply-to @)"),
    ("language", "(INFORM :language @)"),
    ("encoding", "(INFORM :encoding @)"),
    ("ontology", "(INFORM :ontology @)"),
    ("protocol", "(INFORM :protocol @)"),
    ("conversation-id", "(INFORM :conversation-id @)"),
    ("value", "(INFORM :X-k @)"),
    ("key", "(INFORM :X-@ v)"),
    ("content", "(INFORM :content @)"),
];
const IN_BASE64: (&str, &str) = (
    "content-in-base64",
    "(INFORM :X-JADE-Encoding Base64 :content @)",
);

/// Returns a message with the text as this parameter, or `None` if no message can have it.
fn message(parameter: &str, text: &str) -> Option<Message> {
    let builder = Message::builder(Performative::Inform);
    let agent = |agent: Result<AgentId, _>| agent.ok();
    let a = AgentId::new("a").unwrap();
    let set: fn(MessageBuilder, &str) -> MessageBuilder = match parameter {
        "name" => return builder.sender(agent(AgentId::new(text))?).build().ok(),
        "address" => return builder.sender(agent(a.with_address(text))?).build().ok(),
        "resolver" => {
            let resolver = agent(AgentId::new(text))?;
            return builder
                .sender(agent(a.with_resolver(resolver))?)
                .build()
                .ok();
        }
        "agent-value" => {
            let sender = agent(a.with_user_defined("k", text))?;
            return builder.sender(sender).build().ok();
        }
        "agent-key" => {
            let sender = agent(a.with_user_defined(text, "v"))?;
            return builder.sender(sender).build().ok();
        }
        "receiver" => return builder.receiver(agent(AgentId::new(text))?).build().ok(),
        "reply-to" => return builder.reply_to(agent(AgentId::new(text))?).build().ok(),
        "reply-with" => |it, text| it.reply_with(text),
        "in-reply-to" => |it, text| it.in_reply_to(text),
        "language" => |it, text| it.language(text),
        "encoding" => |it, text| it.encoding(text),
        "ontology" => |it, text| it.ontology(text),
        "protocol" => |it, text| it.protocol(text),
        "conversation-id" => |it, text| it.conversation_id(text),
        "value" => |it, text| it.user_defined("k", text),
        "key" => |it, text| it.user_defined(text, "v"),
        _ => |it, text| it.content(text.to_owned()),
    };
    set(builder, text).build().ok()
}

/// Returns the value in an encoded message.
fn value<'a>(encoded: &'a str, template: &str) -> Option<&'a str> {
    let (before, behind) = template.split_once('@').unwrap();
    encoded.strip_prefix(before)?.strip_suffix(behind)
}

fn percent_encoded(text: &str) -> String {
    let mut out = String::new();
    for byte in text.bytes() {
        match byte {
            b'!'..=b'~' if byte != b'%' => out.push(char::from(byte)),
            _ => write!(out, "%{byte:02x}").unwrap(),
        }
    }
    out
}

fn recorded() -> HashMap<(&'static str, &'static str), Option<&'static str>> {
    let columns = |line: &'static str| {
        let mut columns = line.split('\t');
        let (parameter, value) = (columns.next().unwrap(), columns.next().unwrap());
        (
            (parameter, value),
            columns.next().unwrap().strip_prefix('='),
        )
    };
    RECORDED.lines().map(columns).collect()
}

/// Whether the text of this parameter has no form that JADE reads unchanged.
fn jade_reads_no_form_of(parameter: &str, text: &str) -> bool {
    let needs_count = text.contains("\\\"") || text.ends_with('\\');
    match parameter {
        // JADE reads a word only, which may be in quotation marks.
        "address" | "protocol" => {
            let is_word = |byte| (b'!'..=b'~').contains(&byte) && !b"()".contains(&byte);
            text.is_empty() || needs_count || !text.bytes().all(is_word)
        }
        "name" | "resolver" | "receiver" | "reply-to"
            if text.trim_matches(|c| c <= ' ') != text =>
        {
            true
        }
        // JADE counts characters where the standard counts bytes.
        _ => needs_count && !text.is_ascii(),
    }
}

#[test]
fn jade_reads_every_text_of_every_parameter_as_it_was_written() {
    let recorded = recorded();
    let (mut missing, mut wrong, mut refused) = (String::new(), String::new(), Vec::new());
    for (parameter, template) in PARAMETERS {
        for text in TEXTS {
            let Some(message) = message(parameter, text) else {
                continue;
            };
            let encoded = match message.encode(Representation::String, Dialect::Jade) {
                Ok(bytes) => String::from_utf8(bytes.to_vec()).unwrap(),
                Err(EncodeError::Unrepresentable { .. }) => {
                    refused.push((*parameter, *text));
                    continue;
                }
                Err(error) => panic!("{parameter}: {error}"),
            };
            let found = value(&encoded, template).map(|value| (*parameter, value));
            let (parameter, value) = found
                .or_else(|| Some((IN_BASE64.0, value(&encoded, IN_BASE64.1)?)))
                .unwrap_or_else(|| panic!("{encoded}"));
            let (value, text) = (percent_encoded(value), percent_encoded(text));
            match recorded.get(&(parameter, value.as_str())) {
                None => writeln!(missing, "{parameter}\t{value}").unwrap(),
                Some(read) if *read != Some(text.as_str()) => {
                    writeln!(wrong, "{parameter}\t{value}\t{text}\t{read:?}").unwrap();
                }
                Some(_) => {}
            }
        }
    }
    assert!(
        missing.is_empty(),
        "record these with benches/comparison/jade/ReadTexts.java:\n{missing}"
    );
    assert!(wrong.is_empty(), "JADE reads other texts:\n{wrong}");
    let unexpected = refused
        .into_iter()
        .find(|(parameter, text)| !jade_reads_no_form_of(parameter, text));
    assert_eq!(unexpected, None, "a form that JADE reads exists");
}
