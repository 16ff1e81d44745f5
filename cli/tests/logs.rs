//! The log: its formats, and the lines about one letter in all processes of its route.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::collections::BTreeSet;

use common::{Host, Running};
use fipa_acl::is_unprintable;
use serde_json::Value;

/// The lines of a log, each of which must be an object with these keys.
#[track_caller]
fn objects(log: &str) -> Vec<Value> {
    let unprintable = log.chars().find(|&c| c != '\n' && is_unprintable(c));
    assert_eq!(unprintable, None, "{log:?}");
    let lines: Vec<Value> = log
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}")))
        .collect();
    for line in &lines {
        let time = line["timestamp"].as_str().unwrap();
        // RFC 3339 in UTC. A time of FIPA has no separators, and milliseconds.
        let shape: String = time
            .chars()
            .map(|c| if c.is_ascii_digit() { '0' } else { c })
            .collect();
        assert_eq!(shape, "0000-00-00T00:00:00.000000Z", "{line}");
        let digits: String = time[..23]
            .chars()
            .filter(char::is_ascii_alphanumeric)
            .collect();
        let time: fipa_acl::Time = format!("{digits}Z").parse().unwrap();
        assert_eq!(time.zone(), fipa_acl::Zone::Utc, "{line}");
        for key in ["level", "target"] {
            assert!(line[key].is_string(), "{line}");
        }
        assert!(line["fields"].is_object(), "{line}");
    }
    lines
}

/// The letters that lines with this message are about.
fn letters_of(lines: &[Value], message: &str) -> BTreeSet<String> {
    let lines = lines
        .iter()
        .filter(|line| line["fields"]["message"] == message);
    let ids = lines.map(|line| {
        assert_eq!(line["span"]["name"], "letter", "{line}");
        line["span"]["id"].as_str().unwrap().to_owned()
    });
    ids.collect()
}

fn ended(running: Running) -> Vec<Value> {
    let (code, log) = running.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
    objects(&log)
}

const JSON: [&str; 3] = ["--log-format", "json", "-vv"];

#[test]
fn the_lines_of_a_letter_have_one_identifier_in_all_processes() {
    let (rover, crex) = (Host::new(), Host::new());
    let arm = format!("arm-{}", crex.domain);
    let mts = |host: &Host, name: &str| format!("mts.name={name}-{}", host.domain);
    let up = [&JSON[..], &["up", "--json"]].concat();
    let theirs = crex.start(&[&up[..], &["--set", &mts(&crex, "crex")]].concat());
    let address = format!("tcp://{}", theirs.tcp_address());
    let peer = format!(
        "discovery.static={{ crex-{} = [{address:?}] }}",
        crex.domain
    );
    let ours = rover.start(&[&up[..], &["--set", &mts(&rover, "rover"), "--set", &peer]].concat());
    let echo = crex.start(&[&JSON[..], &["echo", &arm]].concat());
    let send = [
        &JSON[..],
        &["send", "--to", &arm, "--content", "hello", "--json"],
    ]
    .concat();
    let sent = fipa_testbed::until_some("a letter is delivered", || {
        let sent = rover.run(&send);
        (sent.code == Some(0)).then_some(sent)
    });
    let sender = objects(&sent.stderr);
    let ids = letters_of(&sender, "sent");
    let id = ids.first().unwrap();
    assert_eq!(ids.len(), 1, "{ids:?}");
    let (incarnation, sequence) = id.split_once('-').unwrap();
    assert_eq!((incarnation.len(), sequence), (16, "1"));
    assert!(letters_of(&sender, "dispatching").contains(id));
    assert!(letters_of(&sender, "settled").contains(id));
    let logs = [ended(ours), ended(theirs), ended(echo)];
    for log in &logs {
        assert!(letters_of(log, "arrived").contains(id), "{log:?}");
    }
    for gateway in &logs[..2] {
        for message in ["dispatching", "attempt ended", "settled"] {
            assert!(
                letters_of(gateway, message).contains(id),
                "{message} {gateway:?}"
            );
        }
    }
    assert!(!letters_of(&logs[2], "sent").contains(id));
}

#[test]
fn the_environment_sets_the_format_and_the_option_overrides_it() {
    let host = Host::new();
    let logged = |value: &str, options: &[&str]| {
        let words = [
            options,
            &[
                "send",
                "--to",
                "arm",
                "--content",
                "x",
                "--deadline",
                "0.2s",
                "-vv",
            ],
        ]
        .concat();
        let mut command = host.command(&words);
        let output = command.env("FIPA_LOG_FORMAT", value).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        String::from_utf8(output.stderr).unwrap()
    };
    let has_json = |log: &str| log.lines().any(|line| line.starts_with("{\"timestamp\":"));
    assert!(!has_json(&logged("", &[])));
    assert!(has_json(&logged("json", &[])));
    assert!(!has_json(&logged("json", &["--log-format", "text"])));
    let wrong = logged("xml", &[]);
    assert!(
        wrong.contains("FIPA_LOG_FORMAT") && !has_json(&wrong),
        "{wrong}"
    );
}

#[test]
fn text_from_outside_breaks_no_line_in_either_format() {
    const HOSTILE: &str =
        "x\u{1b}]0;t\u{7}\u{9b}31m\u{202e}\u{2066}\u{200b}\u{2028}\r\n{\"level\":\"ERROR\"}";
    let host = Host::new();
    let send = |options: &[&str]| {
        let words = [
            "send",
            "--to",
            HOSTILE,
            "--content",
            "x",
            "--deadline",
            "0.2s",
        ];
        let mut command = host.command(&[options, &words].concat());
        let sent = command.env("RUST_LOG", "fipa_mts=trace").output().unwrap();
        assert_eq!(sent.status.code(), Some(1), "{sent:?}");
        String::from_utf8(sent.stderr).unwrap()
    };
    let text = send(&[]);
    let escaped = "receiver=x\\u{1b}]0;t";
    assert!(text.lines().any(|line| line.contains(escaped)), "{text}");
    assert!(
        !text.chars().any(|c| c != '\n' && is_unprintable(c)),
        "{text:?}"
    );
    assert!(!text.lines().any(|line| line.starts_with('{')), "{text}");
    let json = send(&["--log-format", "json"]);
    // The error that ends the command is no line of the log.
    let (log, _) = json.split_once("\nerror: ").unwrap();
    let lines = objects(log);
    let receivers = lines.iter().map(|line| &line["fields"]["receiver"]);
    assert!(receivers.clone().any(|it| *it == HOSTILE), "{lines:?}");
}
