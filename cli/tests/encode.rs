//! `fipa encode`: encodes JSON that `fipa decode` decodes again; and `fipa decode --explain`.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use common::Host;
use serde_json::{Value, json};

#[test]
fn every_recorded_message_is_unchanged_after_encode_and_decode() {
    let host = Host::new();
    let recorded = recorded('m');
    assert!(recorded.len() >= 35, "only {} found", recorded.len());
    for (name, mut expected) in recorded {
        expected.as_object_mut().unwrap().remove("note");
        let encoded = encoded(&host, &expected, &[]);
        let mut decoded = host.run_with_input(&["decode"], &encoded).done_json();
        to_base64(&mut decoded["message"]);
        assert_eq!(decoded, expected, "{name}");
    }
}

#[test]
fn every_recorded_letter_is_unchanged_after_encode_and_decode() {
    let host = Host::new();
    let recorded = recorded('e');
    assert!(recorded.len() >= 11, "only {} found", recorded.len());
    for (name, mut expected) in recorded {
        expected.as_object_mut().unwrap().remove("note");
        let mut how = &[][..];
        let mut extensions = expected["envelope"]["extensions"]
            .as_array()
            .unwrap()
            .iter();
        if extensions.any(|extension| extension.get("received").is_none()) {
            // Only XML can encode an extension without a stamp.
            let output = host.run_with_input(&["encode"], expected.to_string().as_bytes());
            let output = output.failed(1);
            assert!(
                output.starts_with("error: ") && output.contains("an extension envelope"),
                "{output}"
            );
            how = &["--envelope", "xml"];
        }
        let encoded = encoded(&host, &expected, how);
        let payload = expected["payload_base64"].as_str().unwrap();
        let payload = BASE64.decode(payload).unwrap();
        assert!(encoded.ends_with(&payload), "{name}");
        let ran = host.run_with_input(&["decode"], &encoded);
        let decoded: Value = serde_json::from_slice(&ran.stdout).unwrap();
        assert_eq!(decoded["envelope"], expected["envelope"], "{name}");
    }
}

#[test]
fn every_dialect_of_every_encoding_is_decoded() {
    let host = Host::new();
    let message = json!({ "message": {
        "performative": "request",
        "sender": { "name": "alice", "addresses": ["tcp://h:1"] },
        "receivers": [{ "name": "bob" }, { "name": "carol" }],
        "reply_to": [{ "name": "dave" }],
        "content": "lift \"it\"", "language": "l", "encoding": "e", "ontology": "o",
        "protocol": "fipa-request", "conversation_id": "c 1", "reply_with": "r1",
        "in_reply_to": "r0", "reply_by": "2026-11-20T11:26:44.998Z",
    } });
    let mut seen = Vec::new();
    for (representation, start) in [("bit-efficient", 0xfa), ("string", b'('), ("xml", b'<')] {
        for dialect in ["standard", "fipa-services", "jade"] {
            let how = ["--representation", representation, "--dialect", dialect];
            let encoded = encoded(&host, &message, &how);
            assert_eq!(encoded[0], start, "{how:?}");
            let decoded = host.run_with_input(&["decode"], &encoded).done_json();
            assert_eq!(decoded, message, "{how:?}");
            seen.push(encoded);
        }
    }
    // No two dialects have the same bytes.
    seen.dedup();
    assert_eq!(seen.len(), 9);
}

#[test]
fn the_envelope_sets_the_encoding_of_the_message() {
    let host = Host::new();
    let date = "2026-11-20T11:26:44.998Z";
    let letter = |params: Value| {
        let mut base = json!({ "to": [{ "name": "b" }], "date": date });
        let params = params.as_object().unwrap().clone();
        base.as_object_mut().unwrap().extend(params);
        json!({
            "envelope": { "base": base, "extensions": [] },
            "message": { "performative": "inform" },
        })
    };
    let decoded = |letter: &Value, how: &[&str]| {
        let encoded = encoded(&host, letter, how);
        let decoded = host.run_with_input(&["decode"], &encoded).done_json();
        (encoded, decoded)
    };
    let string = json!("fipa.acl.rep.string.std");

    let (bytes, json) = decoded(&letter(json!({ "payload_length": 99 })), &[]);
    assert!(bytes.ends_with(b"\xfa\x10\x08\x01"));
    let base = &json["envelope"]["base"];
    assert_eq!(base["acl_representation"], "fipa.acl.rep.bitefficient.std");
    assert_eq!(base["payload_length"], 4);

    let (bytes, json) = decoded(&letter(json!({})), &["--representation", "string"]);
    assert!(bytes.ends_with(b"(inform)"));
    assert_eq!(json["envelope"]["base"]["acl_representation"], string);

    let string_letter = letter(json!({ "acl_representation": string }));
    let (bytes, json) = decoded(&string_letter, &["--envelope", "xml", "--dialect", "jade"]);
    assert!(
        bytes.starts_with(b"<?xml") && bytes.ends_with(b")"),
        "{bytes:?}"
    );
    assert_eq!(json["envelope"], string_letter["envelope"]);
    assert_eq!(json["message"], string_letter["message"]);

    let input = string_letter.to_string();
    let output = host.run_with_input(&["encode", "--representation", "xml"], input.as_bytes());
    let start = "error: the envelope has acl_representation fipa.acl.rep.string.std, but \
        --representation is XML\nwhere: standard input, envelope: acl_representation\n";
    assert!(output.failed(2).starts_with(start));
    let unknown = letter(json!({ "acl_representation": "x" })).to_string();
    let output = host
        .run_with_input(&["encode"], unknown.as_bytes())
        .failed(1);
    assert!(
        output.starts_with("error: cannot encode a message as x: not a supported encoding\n"),
        "{output}"
    );
    let mut alone = letter(json!({}));
    alone.as_object_mut().unwrap().remove("message");
    let input = alone.to_string();
    let output = host.run_with_input(&["encode", "--representation", "xml"], input.as_bytes());
    assert!(output.failed(2).starts_with(
        "error: --representation has no effect: the letter has no `message` to encode\n"
    ));
}

#[test]
fn commands_that_read_say_that_the_input_is_empty_or_noise() {
    let host = Host::new();
    let commands: [(&[&str], i32); 7] = [
        (&["encode"], 1),
        (&["decode"], 1),
        (&["content", "check"], 1),
        (&["content", "to-json"], 1),
        (&["content", "from-json"], 1),
        (&["replay", "-", "--check"], 1),
        (&["protocol", "check", "-"], 1),
    ];
    for (command, code) in commands {
        let said = host.run_with_input(command, b"").failed(code);
        let (problem, help) = (said.starts_with("error: "), said.contains("\n help: "));
        let is_named = said.contains("is empty") || said.contains("has no element");
        assert!(problem && help && is_named, "{command:?}: {said}");
        let said = host.run_with_input(command, b"noise {").failed(code);
        let (problem, place) = (
            said.starts_with("error: "),
            said.contains("\nwhere: standard input"),
        );
        assert!(
            problem && place && said.contains("\n help: "),
            "{command:?}: {said}"
        );
        for of_a_library in ["EOF", "ident"] {
            let first = said.lines().next().unwrap();
            let is_json = first.contains("JSON");
            assert!(
                is_json || !first.contains(of_a_library),
                "{command:?}: {said}"
            );
        }
    }
}

#[test]
fn errors_are_reported_with_their_place() {
    let host = Host::new();
    let failed = |input: &str| host.run_with_input(&["encode"], input.as_bytes()).failed(1);
    let output = failed("{\n \"performative\" }");
    let start = "error: the input is not JSON: expected `:`\nwhere: standard input, line 2, column 17\n help: ";
    assert!(output.starts_with(start), "{output}");
    let output =
        failed(r#"{ "message": { "performative": "inform", "receivers": [{ "name": 7 }] } }"#);
    let place = "where: standard input, message.receivers[0].name\n";
    assert!(output.contains(place), "{output}");
    let output = failed(r#"{ "performative": "inform", "recievers": [] }"#);
    assert!(
        output.starts_with("error: unknown field `recievers`"),
        "{output}"
    );
    assert!(
        output.contains("where: standard input, recievers\n"),
        "{output}"
    );
    let output =
        failed(r#"{ "envelope": { "base": {} }, "message": { "performative": "inform" } }"#);
    assert!(
        output.starts_with("error: the date of a base envelope is missing\n"),
        "{output}"
    );
    host.run(&["encode", "nothing.json"]).failed(1);
    host.run(&["encode", "--representation", "morse"]).failed(2);
}

#[test]
fn the_examples_of_the_help_work() {
    let host = Host::new();
    let input = br#"{ "performative": "request", "content": "lift" }"#;
    let hex = host.run_with_input(&["encode", "--hex"], input).done();
    assert_eq!(hex, "fa 10 13 04 16 04 6c 69 66 74 01\n");
    let decoded = host
        .run_with_input(&["decode", "--hex"], hex.as_bytes())
        .done_json();
    let expected = json!({ "message": { "performative": "request", "content": "lift" } });
    assert_eq!(decoded, expected);
    // A decoded letter can be encoded again, also with `effective`.
    let mut printed = host
        .run(&["decode", letter().to_str().unwrap()])
        .done_json();
    let again = encoded(&host, &printed, &["--envelope", "xml"]);
    let mut again = host.run_with_input(&["decode"], &again).done_json();
    // fipa_services encodes the same message in more bytes.
    for (letter, len) in [(&mut again, 78), (&mut printed, 85)] {
        letter["effective"]["payload_length"].take();
        assert_eq!(letter["envelope"]["base"]["payload_length"].take(), len);
    }
    assert_eq!(again, printed);
}

#[test]
fn a_letter_is_explained_without_gaps() {
    let host = Host::new();
    let letter = letter();
    let letter = letter.to_str().unwrap();
    let explained = host.run(&["decode", "--explain", letter]).done();
    assert_eq!(explained, include_str!("explained/tcp_letter.txt"));

    let json = host
        .run(&["decode", "--explain", "--json", letter])
        .done_json();
    let spans = json["spans"].as_array().unwrap();
    let mut end = 0;
    for span in spans {
        assert_eq!(span["offset"], end);
        end += span["length"].as_u64().unwrap();
    }
    assert_eq!((&json["length"], json.get("error")), (&json!(end), None));
}

#[test]
fn explained_content_is_shortened() {
    let host = Host::new();
    let message = json!({ "performative": "inform", "content": "x".repeat(1000) });
    let encoded = encoded(&host, &message, &[]);
    let explained = host
        .run_with_input(&["decode", "--explain"], &encoded)
        .done();
    assert_eq!(explained.lines().count(), 9, "{explained}");
    assert!(explained.contains("       3  04 17 03 e8  "), "{explained}");
    assert!(
        explained.contains("\n      55  … 952 more bytes\n    1007  01  "),
        "{explained}"
    );
}

#[test]
fn malformed_bytes_are_explained_up_to_the_error() {
    let host = Host::new();
    let input = b"fa 10 08 02 02 10 61 00 03 05 01";
    let ran = host.run_with_input(&["decode", "--hex", "--explain"], input);
    assert_eq!(ran.code, Some(1));
    let printed = String::from_utf8(ran.stdout).unwrap();
    let last: Vec<&str> = printed.lines().rev().take(2).collect();
    assert!(
        last[0].starts_with("       9  05 01  ") && last[0].ends_with("not decoded: see the error")
    );
    assert!(last[1].starts_with("       8  03  ") && last[1].ends_with("    resolvers"));
    assert!(
        ran.stderr.contains("\nwhere: standard input, byte 9\n"),
        "{}",
        ran.stderr
    );
    let ran = host.run_with_input(&["decode", "--hex", "--explain", "--json"], input);
    let (json, _) = ran.failed_json();
    assert_eq!(json["error"]["offset"], 9);
    assert_eq!(json["error"]["clause"], "FIPA00069 2.2 AgentIdentifier");

    let ran = host.run_with_input(&["decode", "--explain"], b"(inform)");
    let output = ran.failed(1);
    let start = "error: cannot explain string: --explain supports only bit-efficient encodings\n";
    assert!(output.starts_with(start), "{output}");
    host.run(&["decode", "--explain", "--compact"]).failed(2);
}

fn encoded(host: &Host, json: &Value, how: &[&str]) -> Vec<u8> {
    let ran = host.run_with_input(&[&["encode"], how].concat(), json.to_string().as_bytes());
    assert_eq!((ran.code, &*ran.stderr), (Some(0), ""), "{json}");
    ran.stdout
}

fn to_base64(message: &mut Value) {
    let message = message.as_object_mut().unwrap();
    if let Some(content) = message.remove("content") {
        let encoded = BASE64.encode(content.as_str().unwrap());
        message.insert("content_base64".to_owned(), encoded.into());
    }
}

fn letter() -> PathBuf {
    vectors().join("tcp_letter.bin")
}

fn vectors() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../acl/tests/vectors")
}

/// The JSON descriptions of the recordings whose names begin with this letter.
fn recorded(initial: char) -> Vec<(String, Value)> {
    let entries = fs::read_dir(vectors()).unwrap();
    let paths = entries.map(|entry| entry.unwrap().path());
    let described = paths.filter(|path| path.extension().is_some_and(|ext| ext == "json"));
    let named = described.map(|path| {
        let name = path.file_stem().unwrap().to_str().unwrap().to_owned();
        (
            name,
            serde_json::from_slice(&fs::read(path).unwrap()).unwrap(),
        )
    });
    named
        .filter(|(name, _)| name.starts_with(initial))
        .collect()
}
