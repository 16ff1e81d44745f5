//! `fipa content` in processes of their own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;

use common::Host;

const GOAL: &str = "((action (agent-identifier :name crex) (dock :target (pose :x 1.5 :y 0.2 :yaw \
                    3.1 :frame \"sherpa/emi 2\"))))";

#[test]
fn content_is_checked() {
    let host = Host::new();
    fs::write(host.path("goal.sl"), format!("{GOAL}\n")).unwrap();
    assert_eq!(
        host.run(&["content", "check", "goal.sl"]).done(),
        "fipa-sl0\n"
    );
    let query = "((iota ?x (p ?x)))";
    let smallest = host.run_with_input(&["content", "check"], query.as_bytes());
    assert_eq!(smallest.done(), "fipa-sl2\n");
    let profile = ["content", "check", "-", "--profile", "fipa-sl0"];
    let refused = host.run_with_input(&profile, query.as_bytes()).failed(1);
    assert!(refused.contains("fipa-sl0 has no"), "{refused}");
    let wrong = host.run_with_input(&["content", "check"], b"((action crex))");
    let wrong = wrong.failed(1);
    assert!(
        wrong.contains(":1:14\n") && wrong.contains("FIPA00008"),
        "{wrong}"
    );
    fs::write(host.path("lines.sl"), "((p \"é\n\")\n  (ü ö :x 1))\n").unwrap();
    let wrong = host.run(&["content", "check", "lines.sl"]).failed(1);
    assert!(wrong.contains("lines.sl:3:8\n"), "{wrong}");
    let missing = host.run(&["content", "check", "no-such-file"]).failed(1);
    assert!(missing.contains("no-such-file"), "{missing}");
}

#[test]
fn missing_parentheses_are_pointed_out() {
    let host = Host::new();
    let check = |text: &str| host.run_with_input(&["content", "check"], text.as_bytes());
    for text in ["(not true)", "(and p q)", "(done (action a (b)))", "(p q)"] {
        let ran = check(text);
        let printed = String::from_utf8(ran.stdout).unwrap();
        assert_eq!((ran.code, printed.lines().count()), (Some(0), 1), "{text}");
        let warned = ran.stderr;
        assert!(warned.contains("one more pair of parentheses"), "{text}");
    }
    for text in ["((not true))", "(true false)", "(p)", "((p a) q)"] {
        check(text).done();
    }
    let error = check("(action crex (dock :speed 0.5))").failed(1);
    assert!(error.contains("one more pair of parentheses"), "{error}");
    assert!(error.contains(":1:20\n"), "{error}");
    let error = check("((action crex))").failed(1);
    assert!(!error.contains("one more pair"), "{error}");
}

#[test]
fn content_is_formatted() {
    let host = Host::new();
    let formatted = host.run_with_input(&["content", "format"], GOAL.as_bytes());
    let formatted = formatted.done();
    assert_eq!(formatted.lines().count(), 3, "{formatted}");
    let again = host.run_with_input(&["content", "format", "--line"], formatted.as_bytes());
    assert_eq!(again.done(), format!("{GOAL}\n"));
    // JADE writes bytes in Base64.
    let bytes = ["content", "format", "--dialect", "jade", "--line"];
    let standard = host.run_with_input(&bytes, b"((p #4\"aGk=))").done();
    assert_eq!(standard, "((p #2\"hi))\n");
    let jade = [
        "content",
        "format",
        "--dialect",
        "jade",
        "--to",
        "jade",
        "--line",
    ];
    let jade = host.run_with_input(&jade, b"((p #4\"aGk=))").done();
    assert_eq!(jade, "((p #4\"aGk=))\n");
}

#[test]
fn control_characters_survive() {
    let host = Host::new();
    let content = "((p \"a\u{1b}[1m\u{7f}\u{202e}\tb\nc\u{85}\" (f :x \u{200b})))\n";
    let input = content.trim_end().as_bytes();
    let json = host.run_with_input(&["content", "to-json"], input).done();
    assert!(!json.contains('\u{1b}'), "{json:?}");
    let again = host.run_with_input(&["content", "from-json"], json.as_bytes());
    assert_eq!(again.done(), content);
    let line = host.run_with_input(&["content", "format", "--line"], input);
    assert_eq!(line.done(), content);
    let formatted = host.run_with_input(&["content", "format"], input).done();
    let line = host.run_with_input(&["content", "format", "--line"], formatted.as_bytes());
    assert_eq!(line.done(), content);
}

#[test]
fn content_survives_json() {
    let host = Host::new();
    let json = host.run_with_input(&["content", "to-json"], GOAL.as_bytes());
    let json = json.done();
    let parsed: serde_json::Value = serde_json::from_str(&json).unwrap();
    let target = &parsed[0]["action"]["slots"]["target"];
    assert_eq!(target["function"], "pose");
    assert_eq!(target["slots"]["x"], 1.5);
    // The order of slots stays.
    assert!(
        json.find("\"x\"").unwrap() < json.find("\"frame\"").unwrap(),
        "{json}"
    );
    let again = host.run_with_input(&["content", "from-json"], json.as_bytes());
    assert_eq!(again.done(), format!("{GOAL}\n"));
    let wrong = host.run_with_input(&["content", "from-json"], b"[{\"x\\u001b\": 1}]");
    let wrong = wrong.failed(1);
    assert!(
        wrong.contains("is not a formula") && !wrong.contains('\u{1b}'),
        "{wrong}"
    );
}
