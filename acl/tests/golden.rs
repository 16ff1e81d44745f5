//! Recorded messages and letters of real peers decode to their expected values.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod recorded;

use std::fs;
use std::path::Path;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use bytes::Bytes;
use fipa_acl::json::{envelope_to_json, message_from_json, message_to_json};
use fipa_acl::{
    AclRepresentation, AgentId, Dialect, Envelope, EnvelopeView, Letter, Message, MessageView,
    Payload, Performative, Representation, Zone,
};
use serde_json::json;

use self::recorded::{expected, name, vector, vectors, with_base64};

#[test]
fn messages_of_fipa_acl_are_decoded_and_rewritten() {
    let files = vectors('m', "be");
    assert!(files.len() >= 35, "only {} found", files.len());
    for path in files {
        let mut expected = expected(&path)["message"].take();
        if name(&path) == "m28_resolver_depth2" {
            // The library writes only one level of resolvers.
            let resolver = &mut expected["sender"]["resolvers"][0];
            resolver.as_object_mut().unwrap().remove("resolvers");
        }
        let bytes = Bytes::from(fs::read(&path).unwrap());
        let message = decoded(&bytes, &path);
        assert_eq!(with_base64(&message), expected, "{}", path.display());
        assert_eq!(
            message_from_json(&expected).map(|m| with_base64(&m)),
            Ok(expected)
        );

        // The standard's dialect represents the same message.
        let again = Message::decode(&message.to_payload()).unwrap();
        assert_eq!(again, message, "{}", path.display());

        // The library's dialect has the same bytes.
        let written = message.encode(Representation::BitEfficient, Dialect::FipaServices);
        let written = written.unwrap();
        if name(&path) == "m50_strings_special" {
            // The library does not escape the quotation mark in a text, and then cannot read it.
            let quoted = b"\x0b\x14\"on\"to\"\0";
            let counted = b"\x0b\x14#5\"on\"to\0";
            let at = memchr::memmem::find(&bytes, quoted).unwrap();
            let behind = &bytes[at + quoted.len()..];
            assert_eq!(written, [&bytes[..at], counted, behind].concat());
        } else {
            assert_eq!(written, bytes, "{}", path.display());
        }
    }
}

#[test]
fn letters_of_fipa_services_are_decoded_and_rewritten() {
    let files = vectors('e', "be");
    assert!(files.len() >= 11, "only {} found", files.len());
    for path in files {
        let mut expected = expected(&path);
        if name(&path) == "e12_extra_override" {
            // Extensions have no date in this encoding.
            let extension = &mut expected["envelope"]["extensions"][0];
            extension.as_object_mut().unwrap().remove("date");
        }
        let bytes = Bytes::from(fs::read(&path).unwrap());
        let (envelope, letter) = Letter::decode(bytes.clone()).unwrap();
        let json = envelope_to_json(&envelope);
        assert_eq!(json, expected["envelope"], "{}", path.display());
        let payload = BASE64.decode(expected["payload_base64"].as_str().unwrap());
        assert_eq!(letter.payload().to_bytes(), payload.unwrap());
        same_when_rewritten(&envelope, &letter, &path);
        assert_eq!(letter.parse_envelope().as_ref(), Ok(&envelope));

        let effective = envelope.effective();
        let view = EnvelopeView::parse(&bytes).unwrap();
        assert_eq!(view.len(), letter.envelope_len());
        assert_eq!(view.acl_representation(), effective.acl_representation);
        let from = effective.from.as_ref().map(AgentId::name);
        assert_eq!(
            view.from_name().map(|name| name.to_string()).as_deref(),
            from
        );
        let receivers: Vec<_> = view.receivers().map(|name| name.to_string()).collect();
        let expected: Vec<_> = effective
            .intended_receivers
            .iter()
            .map(AgentId::name)
            .collect();
        assert_eq!(receivers, expected, "{}", path.display());
        let stamped = view.stamps().map(|stamp| stamp.by().to_string());
        for received in envelope
            .extensions
            .iter()
            .filter_map(|e| e.received.as_ref())
        {
            assert!(stamped.clone().any(|by| by == received.by));
        }
    }
}

#[test]
fn a_letter_recorded_from_tcp_is_decoded() {
    let bytes = Bytes::from(fs::read(vector("tcp_letter.bin")).unwrap());
    let (envelope, letter) = Letter::decode(bytes).unwrap();
    same_when_rewritten(&envelope, &letter, Path::new("tcp_letter.bin"));
    let date = |stamp: &fipa_acl::Received| stamp.date.to_rfc3339().unwrap();
    let [stamped, overriding] = &envelope.extensions[..] else {
        panic!("two extensions expected: {envelope:?}");
    };
    let stamp = stamped.received.as_ref().unwrap();
    assert_eq!(stamp.by, "send-mts");
    assert_eq!(stamp.id.as_deref(), Some("1:20261120-11:26:44:998659"));
    assert_eq!(date(stamp), "2026-11-20T11:26:44.998Z");
    assert_eq!(overriding.received, None);
    assert_eq!(overriding.intended_receivers[0].name(), "echo");
    assert_eq!(
        envelope.base.from.as_ref().unwrap().addresses(),
        ["tcp://127.0.0.1:45615"]
    );
    assert_eq!(
        envelope.base.payload_length,
        Some(letter.payload().len() as u64)
    );

    let message = Message::decode(letter.payload()).unwrap();
    let expected = json!({
        "performative": "request",
        "sender": { "name": "cpp-sender", "addresses": ["tcp://127.0.0.1:45615"] },
        "receivers": [{ "name": "echo" }],
        "content": "hello",
        "reply_with": "rw-1",
        "conversation_id": "conv-1",
    });
    assert_eq!(message_to_json(&message), expected);
}

#[test]
fn a_recorded_failure_report_is_decoded() {
    let bytes = Bytes::from(fs::read(vector("failure_letter.bin")).unwrap());
    let (envelope, letter) = Letter::decode(bytes).unwrap();
    same_when_rewritten(&envelope, &letter, Path::new("failure_letter.bin"));
    let effective = envelope.effective();
    assert_eq!(effective.from.unwrap().name(), "echo-mts");
    assert_eq!(effective.intended_receivers[0].name(), "cpp-sender");
    assert_eq!(
        effective.acl_representation,
        Some(AclRepresentation::BitEfficient)
    );

    let message = Message::decode(letter.payload()).unwrap();
    assert_eq!(message.performative(), &Performative::Failure);
    assert_eq!(message.sender().unwrap().name(), "echo-mts");
    assert_eq!(message.in_reply_to(), Some("rw-1"));
    assert_eq!(message.ontology(), Some("fipa-agent-management"));
    let content = message.content().unwrap();
    assert!(content.starts_with(b"(inform:sender(agent-identifier"));
    assert_eq!(content.len(), 240);
}

#[test]
fn messages_of_jade_are_decoded_and_rewritten() {
    let bytes = Bytes::from(fs::read(vector("jade_inform.be")).unwrap());
    let expected = json!({
        "performative": "inform",
        "sender": { "name": "echo@jadetest", "addresses": ["http://127.0.0.1:7778/acc"] },
        "receivers": [{ "name": "rusty@rustap", "addresses": ["http://127.0.0.1:9901/acc"] }],
        "content": "hello jade",
        "language": "fipa-sl",
        "ontology": "test-onto",
        "protocol": "fipa-request",
        "conversation_id": "conv-1",
        "reply_with": "rusty@rustap1795173064144",
        "in_reply_to": "rw-1",
    });
    let inform = decoded(&bytes, Path::new("jade_inform.be"));
    assert_eq!(message_to_json(&inform), expected);

    let bytes = Bytes::from(fs::read(vector("jade_request.be")).unwrap());
    let request = decoded(&bytes, Path::new("jade_request.be"));
    assert_eq!(request.performative(), &Performative::Request);
    assert_eq!(request.content().unwrap(), "hello jade");
    assert!(inform.is_reply_to(&request));
    // JADE's dialect has the same bytes.
    let written = inform.encode(Representation::BitEfficient, Dialect::Jade);
    assert_eq!(
        written.unwrap(),
        fs::read(vector("jade_inform.be")).unwrap()
    );
}

#[test]
fn string_messages_of_fipa_acl_are_decoded_and_rewritten() {
    let files = vectors('m', "str");
    assert!(files.len() >= 35, "only {} found", files.len());
    for path in files {
        let expected = expected(&path)["message"].take();
        let bytes = Bytes::from(fs::read(&path).unwrap());
        let message = string_decoded(&bytes, &path);
        assert_eq!(with_base64(&message), expected, "{}", path.display());

        let written = message.encode(Representation::String, Dialect::FipaServices);
        match name(&path) {
            // The library writes these but does not read them, so the encoder refuses them.
            "m28_resolver_depth2" | "m51_user_performative" => assert!(written.is_err()),
            _ => assert_eq!(written.unwrap(), bytes, "{}", path.display()),
        }
        let standard = message.encode(Representation::String, Dialect::Standard);
        let again = Message::decode(&standard.unwrap().into());
        assert_eq!(again, Ok(message), "{}", path.display());
    }
}

#[test]
fn a_string_message_of_fipa_services_for_jade_is_decoded() {
    let bytes = Bytes::from(fs::read(vector("for_jade.str")).unwrap());
    let message = string_decoded(&bytes, Path::new("for_jade.str"));
    let expected = json!({
        "performative": "request",
        "sender": { "name": "cpp-sender", "addresses": ["tcp://127.0.0.1:34821"] },
        "receivers": [{ "name": "echo" }],
        "content": "hello",
        "reply_with": "rw-1",
        "conversation_id": "conv-1",
    });
    assert_eq!(message_to_json(&message), expected);
}

#[test]
fn content_of_jade_may_end_in_a_backslash() {
    let read = |file: &str| {
        let bytes = Bytes::from(fs::read(vector(file)).unwrap());
        Message::decode(&Payload::from(bytes)).unwrap()
    };
    let message = read("jade_backslash.str");
    assert_eq!(message.content().unwrap(), r"C:\logs\");
    assert_eq!(message.language(), Some("text"));
    // A later string of the message has the next quotation mark without a backslash.
    let message = read("jade_backslash_and_quotes.str");
    assert_eq!(message.content().unwrap(), r#"say "C:\logs\" or C:\logs\"#);
    assert_eq!(message.ontology(), Some("files on disk"));
    assert_eq!(message.conversation_id(), Some("c-1"));
}

#[test]
fn string_messages_of_jade_are_decoded_and_rewritten() {
    let read = |file: &str| {
        let bytes = Bytes::from(fs::read(vector(file)).unwrap());
        let message = Message::decode(&Payload::from(bytes)).unwrap();
        // JADE's dialect represents the same message.
        let written = message.encode(Representation::String, Dialect::Jade);
        let again = Message::decode(&written.unwrap().into());
        assert_eq!(again.as_ref(), Ok(&message), "{file}");
        message
    };
    let inform = read("jade_inform.str");
    let expected = json!({
        "performative": "inform",
        "sender": { "name": "echo@jadetest", "addresses": ["http://127.0.0.1:7778/acc"] },
        "receivers": [{ "name": "rusty@rustap", "addresses": ["http://127.0.0.1:9901/acc"] }],
        "content": "hello jade",
        "language": "fipa-sl",
        "ontology": "test-onto",
        "protocol": "fipa-request",
        "conversation_id": "conv-1",
        "reply_with": "rusty@rustap1795173063289",
        "in_reply_to": "rw-1",
    });
    assert_eq!(message_to_json(&inform), expected);
    let request = read("jade_request.str");
    assert_eq!(request.performative(), &Performative::Request);
    assert!(inform.is_reply_to(&request));

    let over_tcp = read("jade_tcpmtp_inform.str");
    assert_eq!(over_tcp.conversation_id(), Some("tcp-1"));
    assert!(over_tcp.sender().unwrap().addresses().is_empty());

    let failure = read("jade_failure.str");
    assert_eq!(failure.performative(), &Performative::Failure);
    let content = String::from_utf8(failure.content().unwrap().to_vec()).unwrap();
    assert!(content.starts_with("( (action ( agent-identifier :name rusty@rustap"));
    assert!(
        content.ends_with("find agent nobody@jadetest\")) )"),
        "{content}"
    );

    let found = read("jade_df_reply.str");
    assert_eq!(found.ontology(), Some("fipa-agent-management"));
    assert_eq!(found.language(), Some("fipa-sl0"));
}

#[test]
fn string_messages_are_not_longer_than_those_of_fipa_acl() {
    let text = "(request:sender(agent-identifier:nameproxy):receiver(set(agent-identifier:namecrex_0))\
                :content#1\"x:reply-with#15\"test reply_with:reply-to(set(agent-identifier:nameproxy))\
                :language#13\"test language:encoding#13\"test encoding:ontology#13\"test ontology\
                :protocolRIMRES:conversation-id#19\"test conversationID)";
    let message = Message::decode(&Bytes::from(text).into()).unwrap();
    for dialect in [Dialect::Standard, Dialect::FipaServices, Dialect::Jade] {
        let bytes = message.encode(Representation::String, dialect).unwrap();
        assert!(bytes.len() <= 330, "{dialect}: {} bytes", bytes.len());
    }
}

#[test]
fn times_of_fipa_acl_have_no_zone() {
    let bytes = fs::read(vector("m46_reply_by.be")).unwrap();
    let time = MessageView::parse(&bytes).unwrap().reply_by().unwrap();
    assert_eq!(time.zone(), Zone::Unspecified);
    assert_eq!(time.to_string(), "20101223T120037980");
}

/// Checks that encoding a decoded envelope in the library's dialect gives the same bytes, and the same
/// for a bit-efficient message behind it.
fn same_when_rewritten(envelope: &Envelope, letter: &Letter, path: &Path) {
    let written = envelope.encode(Representation::BitEfficient, Dialect::FipaServices);
    assert_eq!(written.unwrap(), letter.envelope(), "{}", path.display());
    if Representation::detect(&letter.payload().head) == Some(Representation::BitEfficient) {
        let message = Message::decode(letter.payload()).unwrap();
        let written = message.encode(Representation::BitEfficient, Dialect::FipaServices);
        assert_eq!(written.unwrap(), letter.payload().to_bytes());
    }
}

/// Decodes a view and an owned message. Checks that they have the same content, and that it is not
/// copied.
fn decoded(bytes: &Bytes, path: &Path) -> Message {
    let message = Message::decode(&Payload::from(bytes.clone()))
        .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let view = MessageView::parse(bytes).unwrap();
    assert_eq!(
        view.content().as_deref(),
        message.content().map(|content| &content[..])
    );
    if let Some(content) = message.content().filter(|content| !content.is_empty()) {
        assert!(
            bytes.as_ptr_range().contains(&content.as_ptr()),
            "{}",
            path.display()
        );
    }
    message
}

/// Decodes a message. Checks that the content is not copied.
fn string_decoded(bytes: &Bytes, path: &Path) -> Message {
    let message = Message::decode(&Payload::from(bytes.clone()))
        .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    if let Some(content) = message.content().filter(|content| !content.is_empty()) {
        let shared = bytes.as_ptr_range().contains(&content.as_ptr());
        assert!(shared, "{}", path.display());
    }
    message
}
