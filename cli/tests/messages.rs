//! The texts that commands print are sentences, not the `Debug` output of Rust values.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use common::Host;

/// The first part of a text that looks like the `Debug` output of a value: `Some(16)`, `None`,
/// `Remote { gateway: … }`, `NotFound`, or a path such as `Kind::Tcp`.
fn debug_text(text: &str) -> Option<&str> {
    let ends = |c: char| c.is_whitespace() || matches!(c, '"' | '\'' | ',' | ';' | '=');
    let words: Vec<&str> = text.split(ends).filter(|word| !word.is_empty()).collect();
    let found = words.iter().enumerate().find(|(at, word)| {
        let name: String = word
            .trim_start_matches('(')
            .chars()
            .take_while(char::is_ascii_alphanumeric)
            .collect();
        let rest = &word.trim_start_matches('(')[name.len()..];
        let is_type = name.starts_with(|c: char| c.is_ascii_uppercase());
        let mut pairs = name.as_bytes().windows(2);
        let is_camel = is_type
            && pairs.any(|pair| pair[0].is_ascii_lowercase() && pair[1].is_ascii_uppercase());
        // Settings of systemd.
        let is_known = matches!(name.as_str(), "RuntimeDirectoryMode" | "RemoveIPC");
        let has_fields = rest.starts_with('(') || words.get(at + 1) == Some(&"{");
        (is_camel && !is_known)
            || (is_type && (has_fields || rest.starts_with("::")))
            || matches!(name.as_str(), "None" | "Some" | "Ok" | "Err")
    });
    found.map(|(_, word)| *word)
}

#[test]
fn debug_output_is_recognized() {
    for text in [
        "nothing begins with Some(16)",
        "cannot open the mailbox (reason: DoesNotExist)",
        "reach=Remote { gateway: 1 }",
        "the kind is Kind::Tcp",
        "the state is None",
    ] {
        assert!(debug_text(text).is_some(), "{text}");
    }
    for text in [
        "error: not delivered: no such agent",
        "Ctrl-C stops it; TLS 1.3, FIPA00069 2.4 (note 1)",
        "WARN fipa: joined name=arm_1",
    ] {
        assert_eq!(debug_text(text), None, "{text}");
    }
}

/// Requires that a text has no `Debug` output.
#[track_caller]
fn check(what: &str, text: &str) {
    assert!(!text.is_empty(), "{what} printed nothing");
    assert_eq!(debug_text(text), None, "{what}: {text}");
}

#[test]
fn errors_are_sentences() {
    let host = Host::new();
    let _parrot = host.echo("parrot");
    for arguments in [
        &["send", "--to", "unknown", "--content", "x"][..],
        &["send", "--to", "arm_(", "--content", "x"],
        &["send", "--to", "parrot", "--content-file", "/nowhere"],
        &["echo", "parrot"],
        &["echo", "arm_.*"],
        &["up", "--set", "transport.tcp.listen=192.0.2.1:1"],
        &[
            "up",
            "--set",
            "transport.tcp.listen=192.0.2.1:1",
            "--set",
            "security.insecure=true",
        ],
        &["up", "--set", "security.keys=/nowhere"],
        &["up", "--set", "mts.transports=quic"],
        &["config", "show", "--config", "/nowhere"],
        &["config", "show", "--set", "mts.deadline=soon"],
        &["config", "check", "--set", "discovery.interfaces=nowhere0"],
        &["decode", "/nowhere"],
        &["keys", "trust", "/nowhere"],
        &["keys", "revoke", "unknown", "--yes"],
        &["protocol", "show", "fipa-dance"],
        &["man", "/proc/nowhere"],
    ] {
        let ran = host.run(arguments);
        assert!(matches!(ran.code, Some(1 | 2)), "{arguments:?}: {ran:?}");
        check(&arguments.join(" "), &ran.stderr);
    }
    let noise = host.run_with_input(&["decode"], b"\x10\x11\x12").failed(1);
    check("decode of noise", &noise);
}

#[test]
fn the_log_of_a_gateway_is_sentences() {
    let host = Host::new();
    let mut gateway = host.start(&["up", "-v"]);
    let parrot = host.echo("parrot");
    gateway.wait_for_log(&["joined", "name=parrot"]);
    parrot.signal("-KILL");
    gateway.wait_for_log(&["left", "name=parrot"]);
    let (code, log) = gateway.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
    check("the log", &log);
}

#[test]
fn cleaning_up_after_a_killed_process_prints_nothing() {
    let host = Host::new();
    host.echo("parrot").signal("-KILL");
    let ran = host.run(&["agents"]);
    assert_eq!((ran.code, ran.stderr.as_str()), (Some(0), ""));
}
