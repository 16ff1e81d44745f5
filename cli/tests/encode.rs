//! `fipa encode`: JSON as bytes, which `fipa decode` takes back; and bytes explained.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use common::Host;
use serde_json::{Value, json};

#[test]
fn every_recorded_message_survives() {
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
fn every_recorded_letter_survives() {
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
            // Only XML has a place for an extension without a stamp.
            let told = host.run_with_input(&["encode"], expected.to_string().as_bytes());
            let told = told.failed(1);
            assert!(
                told.starts_with("error: ") && told.contains("an extension envelope"),
                "{told}"
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
fn every_encoding_for_every_reader() {
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
    // Each has its own hand.
    seen.dedup();
    assert_eq!(seen.len(), 9);
}

#[test]
fn the_envelope_says_what_the_message_is() {
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

    let (bytes, said) = decoded(&letter(json!({ "payload_length": 99 })), &[]);
    assert!(bytes.ends_with(b"\xfa\x10\x08\x01"));
    let base = &said["envelope"]["base"];
    assert_eq!(base["acl_representation"], "fipa.acl.rep.bitefficient.std");
    assert_eq!(base["payload_length"], 4);

    let (bytes, said) = decoded(&letter(json!({})), &["--representation", "string"]);
    assert!(bytes.ends_with(b"(inform)"));
    assert_eq!(said["envelope"]["base"]["acl_representation"], string);

    let said_string = letter(json!({ "acl_representation": string }));
    let (bytes, said) = decoded(&said_string, &["--envelope", "xml", "--dialect", "jade"]);
    assert!(
        bytes.starts_with(b"<?xml") && bytes.ends_with(b")"),
        "{bytes:?}"
    );
    assert_eq!(said["envelope"], said_string["envelope"]);
    assert_eq!(said["message"], said_string["message"]);

    let input = said_string.to_string();
    let told = host.run_with_input(&["encode", "--representation", "xml"], input.as_bytes());
    let start = "error: the envelope says that the message is fipa.acl.rep.string.std, which is \
        not XML\nwhere: standard input, envelope: acl_representation\n";
    assert!(told.failed(2).starts_with(start));
    let unknown = letter(json!({ "acl_representation": "x" })).to_string();
    let told = host
        .run_with_input(&["encode"], unknown.as_bytes())
        .failed(1);
    assert!(
        told.starts_with("error: messages cannot be encoded as x\n"),
        "{told}"
    );
    let mut alone = letter(json!({}));
    alone.as_object_mut().unwrap().remove("message");
    let input = alone.to_string();
    let told = host.run_with_input(&["encode", "--representation", "xml"], input.as_bytes());
    assert!(
        told.failed(2)
            .starts_with("error: there is no message to encode")
    );
}

#[test]
fn mistakes_are_told_with_their_place() {
    let host = Host::new();
    let failed = |input: &str| host.run_with_input(&["encode"], input.as_bytes()).failed(1);
    let told = failed("{\n \"performative\" }");
    let start = "error: not JSON: expected `:`\nwhere: standard input, line 2, column 17\n   do: ";
    assert!(told.starts_with(start), "{told}");
    let told =
        failed(r#"{ "message": { "performative": "inform", "receivers": [{ "name": 7 }] } }"#);
    let place = "where: standard input, message.receivers[0].name\n";
    assert!(told.contains(place), "{told}");
    let told = failed(r#"{ "performative": "inform", "recievers": [] }"#);
    assert!(
        told.starts_with("error: unknown field `recievers`"),
        "{told}"
    );
    assert!(
        told.contains("where: standard input, recievers\n"),
        "{told}"
    );
    let told = failed(r#"{ "envelope": { "base": {} }, "message": { "performative": "inform" } }"#);
    assert!(
        told.starts_with("error: the date of a base envelope is missing\n"),
        "{told}"
    );
    host.run(&["encode", "nothing.json"]).failed(1);
    host.run(&["encode", "--representation", "morse"]).failed(2);
}

#[test]
fn what_the_help_shows_works() {
    let host = Host::new();
    let input = br#"{ "performative": "request", "content": "lift" }"#;
    let hex = host.run_with_input(&["encode", "--hex"], input).done();
    assert_eq!(hex, "fa 10 13 04 16 04 6c 69 66 74 01\n");
    let decoded = host
        .run_with_input(&["decode", "--hex"], hex.as_bytes())
        .done_json();
    let expected = json!({ "message": { "performative": "request", "content": "lift" } });
    assert_eq!(decoded, expected);
    // A letter that was printed, with what counts of its envelope, is a letter again.
    let mut printed = host
        .run(&["decode", letter().to_str().unwrap()])
        .done_json();
    let again = encoded(&host, &printed, &["--envelope", "xml"]);
    let mut again = host.run_with_input(&["decode"], &again).done_json();
    // fipa_services wrote more bytes for the same message.
    for (letter, len) in [(&mut again, 78), (&mut printed, 85)] {
        letter["effective"]["payload_length"].take();
        assert_eq!(letter["envelope"]["base"]["payload_length"].take(), len);
    }
    assert_eq!(again, printed);
}

#[test]
fn a_letter_explained() {
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
fn long_content_explained_is_cut() {
    let host = Host::new();
    let message = json!({ "performative": "inform", "content": "x".repeat(1000) });
    let encoded = encoded(&host, &message, &[]);
    let explained = host
        .run_with_input(&["decode", "--explain"], &encoded)
        .done();
    assert_eq!(explained.lines().count(), 9, "{explained}");
    assert!(explained.contains("       3  04 17 03 e8  "), "{explained}");
    assert!(
        explained.contains("\n      55  … 952 bytes more\n    1007  01  "),
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
        last[0].starts_with("       9  05 01  ") && last[0].ends_with("not read: see the error")
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
    let told = ran.failed(1);
    let start = "error: only what is bit-efficient is explained, and this is string\n";
    assert!(told.starts_with(start), "{told}");
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

/// The JSON beside the recordings whose names begin so.
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
