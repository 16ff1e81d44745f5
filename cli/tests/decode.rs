//! `fipa decode`: decodes recorded bytes of real peers.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;
use std::path::{Path, PathBuf};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use common::Host;
use serde_json::{Value, json};

#[test]
fn recorded_messages_decode_to_their_descriptions() {
    let host = Host::new();
    let recorded = vectors('m');
    assert!(recorded.len() >= 35, "only {} found", recorded.len());
    for path in recorded {
        let mut expected = description(&path);
        if name(&path) == "m28_resolver_depth2" {
            // The recording library encodes only one level of resolvers.
            let resolver = &mut expected["message"]["sender"]["resolvers"][0];
            resolver.as_object_mut().unwrap().remove("resolvers");
        }
        expected.as_object_mut().unwrap().remove("note");
        let mut decoded = host.run(&["decode", path.to_str().unwrap()]).done_json();
        to_base64(&mut decoded["message"]);
        assert_eq!(decoded, expected, "{}", path.display());
    }
}

#[test]
fn recorded_letters_decode_to_their_descriptions() {
    let host = Host::new();
    let recorded = vectors('e');
    assert!(recorded.len() >= 11, "only {} found", recorded.len());
    let mut messages = 0;
    for path in recorded {
        let mut expected = description(&path);
        if name(&path) == "e12_extra_override" {
            // The encoding has no date in extensions.
            let extension = &mut expected["envelope"]["extensions"][0];
            extension.as_object_mut().unwrap().remove("date");
        }
        let ran = host.run(&["decode", path.to_str().unwrap()]);
        assert_eq!(ran.code, Some(0), "{ran:?}");
        let mut decoded: Value = serde_json::from_slice(&ran.stdout).unwrap();
        assert_eq!(
            decoded["envelope"],
            expected["envelope"],
            "{}",
            path.display()
        );
        assert!(decoded["effective"]["to"].is_array(), "{decoded}");
        if let Some(payload) = decoded.get("payload_base64") {
            assert_eq!(payload, &expected["payload_base64"], "{}", path.display());
            assert_eq!(ran.stderr.is_empty(), payload == "", "{}", ran.stderr);
            continue;
        }
        // The message equals the result of decoding the payload alone.
        assert_eq!(ran.stderr, "");
        let payload = BASE64
            .decode(expected["payload_base64"].as_str().unwrap())
            .unwrap();
        let mut alone = host
            .run_with_input(&["decode", "--compact"], &payload)
            .done_json();
        to_base64(&mut alone["message"]);
        to_base64(&mut decoded["message"]);
        assert_eq!(decoded["message"], alone["message"], "{}", path.display());
        messages += 1;
    }
    assert!(
        messages >= 5,
        "only {messages} letters had a decoded message"
    );
}

#[test]
fn hexadecimal_input_is_decoded() {
    let host = Host::new();
    let bytes = fs::read(vector("m19_perf_request.be")).unwrap();
    let plain = host
        .run_with_input(&["decode", "-", "--compact"], &bytes)
        .done();
    assert_eq!(plain.lines().count(), 1);
    let hex: String = bytes.iter().map(|byte| format!("{byte:02X} ")).collect();
    let decoded = host.run_with_input(&["decode", "--hex", "--compact"], hex.as_bytes());
    assert_eq!(decoded.done(), plain);
    let output = host
        .run_with_input(&["decode", "--hex"], b"fa 1g")
        .failed(1);
    let expected =
        "error: expected a hexadecimal digit, not 'g'\nwhere: standard input, character 5\n";
    assert!(output.starts_with(expected), "{output}");
}

#[test]
fn the_example_of_the_help_works() {
    let decoded = Host::new()
        .run_with_input(&["decode", "--hex"], b"fa 10 13 01\n")
        .done_json();
    assert_eq!(decoded, json!({ "message": { "performative": "request" } }));
}

#[test]
fn malformed_bytes_are_reported_with_offset_and_clause() {
    let host = Host::new();
    let message = fs::read(vector("m19_perf_request.be")).unwrap();
    let cut = message.len() - 1;
    fs::write(host.path("cut.be"), &message[..cut]).unwrap();
    let output = host.run(&["decode", "cut.be"]).failed(1);
    assert!(
        output.contains(&format!("where: cut.be, byte {cut}\n")),
        "{output}"
    );
    assert!(output.contains("(FIPA00069"), "{output}");
    let letter = fs::read(vector("e01_simple.be")).unwrap();
    let output = host.run_with_input(&["decode"], &letter[..9]).failed(1);
    assert!(
        output.contains("(FIPA00069") && output.contains("where: standard input, byte "),
        "{output}"
    );
    for (input, problem) in [
        (&b""[..], "the input is empty"),
        (b"hello", "begins with the byte 0x68"),
        (b" \n", "begins with the byte 0x20"),
    ] {
        for arguments in [&["decode"][..], &["decode", "--explain"]] {
            let output = host.run_with_input(arguments, input).failed(1);
            assert!(output.contains(problem), "{output}");
        }
    }
    let output = host.run(&["decode", "nothing.be"]).failed(1);
    assert!(output.contains("where: nothing.be\n"), "{output}");
}

fn to_base64(message: &mut Value) {
    let message = message.as_object_mut().unwrap();
    if let Some(content) = message.remove("content") {
        let encoded = BASE64.encode(content.as_str().unwrap());
        message.insert("content_base64".to_owned(), encoded.into());
    }
}

fn description(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path.with_extension("json")).unwrap()).unwrap()
}

fn name(path: &Path) -> &str {
    path.file_stem().unwrap().to_str().unwrap()
}

fn vector(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../acl/tests/vectors")
        .join(name)
}

fn vectors(initial: char) -> Vec<PathBuf> {
    let entries = fs::read_dir(vector("")).unwrap();
    let paths = entries.map(|entry| entry.unwrap().path());
    paths
        .filter(|path| path.extension().is_some_and(|ext| ext == "be"))
        .filter(|path| name(path).starts_with(initial))
        .collect()
}

/// Each command has memory for its largest input only.
#[test]
fn input_beyond_the_bound_is_refused_without_reading_it() {
    const GIB: u64 = 1 << 30;
    let host = Host::new();
    let file = fs::File::create(host.path("huge")).unwrap();
    // Takes no space.
    file.set_len(8 * GIB).unwrap();
    let refused = |arguments: &str, memory: u64| {
        let program = env!("CARGO_BIN_EXE_fipa");
        let line = format!("ulimit -v {} && exec {program} {arguments}", memory >> 10);
        let ran = std::process::Command::new("sh")
            .args(["-c", &line])
            .current_dir(host.path("."))
            .output()
            .unwrap();
        let errors = String::from_utf8(ran.stderr).unwrap();
        assert_eq!(ran.status.code(), Some(1), "{arguments}: {errors}");
        assert!(errors.contains("the input has more than"), "{errors}");
    };
    for command in ["decode", "decode --hex", "encode"] {
        refused(&format!("{command} huge"), GIB / 2);
    }
    // A stream has no length before its end.
    refused("decode < /dev/zero", 3 * GIB / 2);
    refused("encode < /dev/zero", 3 * GIB / 2);
}
