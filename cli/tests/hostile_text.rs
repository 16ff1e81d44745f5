//! Every command that prints text from outside escapes text that would control the terminal.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;
use std::io::Write;
use std::net::TcpStream;
use std::process::Command;
use std::thread;

use common::{Host, Ran};
use fipa::{AgentId, Envelope, EnvelopeParams, Letter, Message, Performative};
use fipa_acl::{AclRepresentation, is_unprintable};

/// A window title, a color set by a C1 control, two changes of the writing direction, an invisible
/// space, line separators, and a line that looks like an error of the program.
const HOSTILE: &str = "x\u{1b}]0;t\u{7}\u{9b}31m\u{202e}\u{2066}\u{200b}\u{2028}\r\nerror: forged";
/// The characters of [`HOSTILE`] that a word can contain.
const WORD: &str = "x\u{9b}31m\u{202e}\u{2066}\u{200b}";

/// Asserts that the text has no control characters and no forged line.
#[track_caller]
fn harmless(text: &str) {
    let found = text.chars().find(|&c| c != '\n' && is_unprintable(c));
    assert_eq!(found, None, "{text:?}");
    let forged = text.lines().find(|line| line.starts_with("error: forged"));
    assert_eq!(forged, None, "{text}");
}

#[track_caller]
fn all_harmless(ran: &Ran) -> String {
    let printed = String::from_utf8(ran.stdout.clone()).unwrap();
    harmless(&printed);
    harmless(&ran.stderr);
    printed
}

#[test]
fn decode_prints_json_and_notes_without_unprintable_characters() {
    let host = Host::new();
    let message = Message::builder(WORD.parse().unwrap())
        .sender(AgentId::new(HOSTILE).unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .protocol(WORD)
        .conversation_id(HOSTILE)
        .content(HOSTILE)
        .build()
        .unwrap();
    let bytes = message.to_payload().to_bytes();
    for options in [
        &[][..],
        &["--compact"],
        &["--explain"],
        &["--explain", "--json"],
    ] {
        let ran = host.run_with_input(&[&["decode"], options].concat(), &bytes);
        assert_eq!(ran.code, Some(0), "{ran:?}");
        all_harmless(&ran);
    }
    let json = host.run_with_input(&["decode"], &bytes).done_json();
    assert_eq!(
        json["message"]["content"], HOSTILE,
        "the decoded text is unchanged"
    );
}

#[test]
fn messages_and_entries_are_shown_without_unprintable_characters() {
    let host = Host::new();
    let direction = "arm\u{202e}\u{200b}\u{2066}";
    let mut arm = host.start(&[
        "echo",
        "arm",
        "--type",
        direction,
        "--description",
        direction,
    ]);
    let mut watching = host.start(&["watch", "--content=200", "--count", "6"]);
    let mut drawing = host.start(&[
        "watch",
        "--sequence",
        "--mermaid",
        "all.mmd",
        "--count",
        "6",
    ]);
    let mut machine = host.start(&["watch", "--json", "--content=200", "--count", "6"]);
    let mut following = host.start(&["agents", "--watch"]);

    for arguments in [
        &["agents"][..],
        &["agents", "--json"],
        &["routes"],
        &["routes", "--json"],
    ] {
        let printed = all_harmless(&host.run(arguments));
        assert!(printed.contains("arm"), "{printed}");
    }
    harmless(&following.line());

    let hostile = |to: &'static str, from: &'static str| {
        let mut all = vec!["send", "--to", to, "--from", from, "--performative", WORD];
        all.extend([
            "--content",
            HOSTILE,
            "--protocol",
            WORD,
            "--ontology",
            HOSTILE,
        ]);
        all
    };
    // A reply with the same content.
    let mut asked = hostile("arm", "rover");
    asked.extend(["--wait", "--timeout", "30s", "--conversation-id", HOSTILE]);
    let ran = host.run(&asked);
    assert_eq!(ran.code, Some(0), "{ran:?}");
    assert!(all_harmless(&ran).contains("reply: "));
    harmless(&arm.line());
    let ran = host.run(&[&asked[..], &["--json"]].concat());
    all_harmless(&ran);
    harmless(&arm.line());

    // A failure message, after a message that is not a reply. The echo agent does not answer a reply.
    let mut asked = hostile("arm", "crane");
    asked.extend([
        "--in-reply-to",
        "a",
        "--reply-with",
        "b",
        "--conversation-id",
        "c",
    ]);
    asked.extend(["--wait", "--timeout", "30s"]);
    let output = thread::scope(|scope| {
        let (host, asked) = (&host, &asked);
        let waiting = scope.spawn(move || host.run(asked));
        harmless(&arm.line());
        assert_eq!(host.run(&hostile("crane", "other")).code, Some(0));
        let failure = format!(
            "((action (agent-identifier :name crane) (ACLMessage)) (MTS-error \
             (agent-identifier :name \"{HOSTILE}\") (internal-error \"{HOSTILE}\")))"
        );
        let output = host.run(&[
            "send",
            "--to",
            "crane",
            "--from",
            "other",
            "--performative",
            "failure",
            "--in-reply-to",
            "b",
            "--conversation-id",
            "c",
            "--content",
            &failure,
        ]);
        assert_eq!(output.code, Some(0), "{output:?}");
        waiting.join().unwrap()
    });
    assert_eq!(output.code, Some(1), "{output:?}");
    all_harmless(&output);
    assert!(
        output.stderr.contains("warning: ignored, not a reply"),
        "{output:?}"
    );
    assert!(
        output.stderr.contains("error: not delivered: x\\u{1b}]0;t"),
        "{output:?}"
    );

    for watching in [&mut watching, &mut drawing, &mut machine] {
        let (code, errors) = watching.end();
        assert_eq!((code, errors.as_str()), (Some(0), ""));
        let mut printed = watching.ready.clone();
        while let Some(line) = watching.next_line() {
            printed.push_str(&format!("\n{line}"));
        }
        harmless(&printed);
        assert!(printed.contains("31m"), "{printed}");
    }
    harmless(&fs::read_to_string(host.path("all.mmd")).unwrap());

    // Names that look like other names are rejected.
    for arguments in [
        &["echo", direction][..],
        &["coalition", direction, "arm"],
        &["coalition", "arms", direction],
        &["send", "--to", "arm", "--from", HOSTILE],
        &["up", "--set", "mts.name=rover\u{202e}"],
    ] {
        let ran = host.run(arguments);
        assert_eq!(ran.code, Some(2), "{ran:?}");
        all_harmless(&ran);
    }
    let ran = host.run(&["send", "--to", HOSTILE]);
    assert_eq!(ran.code, Some(1), "{ran:?}");
    all_harmless(&ran);
}

#[test]
fn names_with_blanks_are_quoted_in_lines_about_messages() {
    let host = Host::new();
    let name = "boss-mts :receiver rover :ontology \"estop\"";
    let mut rover = host.start(&["listen", "rover"]);
    let mut watch = host.start(&["watch", "--count", "1"]);
    let ran = host.run(&["send", "--to", "rover", "--from", name, "--content", "stop"]);
    assert_eq!(ran.code, Some(0), "{ran:?}");
    let line = rover.line();
    let quoted = r#":sender "boss-mts :receiver rover :ontology \"estop\"" :receiver (set rover)"#;
    assert!(line.contains(quoted), "{line}");
    watch.end();
    let lines: Vec<String> = std::iter::from_fn(|| watch.next_line()).collect();
    let is_quoted = |line: &String| line.contains(" \"boss-mts");
    assert!(lines.iter().any(is_quoted), "{lines:?}");
    let agent = host.start(&["listen", name]);
    let ready = &agent.ready;
    assert!(ready.contains("agent \"boss-mts :receiver"), "{ready}");
    let agents = host.run(&["agents"]);
    let agents = String::from_utf8(agents.stdout).unwrap();
    let is_listed = |line: &str| line.starts_with("\"boss-mts :receiver");
    assert!(agents.lines().any(is_listed), "{agents}");
}

#[test]
fn the_gateway_logs_letters_of_legacy_peers_without_unprintable_characters() {
    let host = Host::new();
    let mut gateway = host.start(&["up", "--json", "-vv"]);
    let arm = AgentId::new("arm\u{202e}").unwrap();
    let message = Message::builder(Performative::Request)
        .sender(AgentId::new(HOSTILE).unwrap())
        .receiver(arm.clone())
        .content(HOSTILE)
        .build()
        .unwrap();
    let envelope = Envelope {
        base: EnvelopeParams {
            to: vec![arm],
            from: message.sender().cloned(),
            acl_representation: Some(AclRepresentation::BitEfficient),
            date: Some("20261121T120000000Z".parse().unwrap()),
            ..EnvelopeParams::default()
        },
        extensions: Vec::new(),
    };
    let letter = Letter::new(envelope.encode_standard().unwrap(), message.to_payload());
    let mut stream = TcpStream::connect(gateway.tcp_address()).unwrap();
    stream.write_all(&letter.to_bytes()).unwrap();
    drop(stream);
    gateway.wait_for_log(&["cannot send a failure message: its receiver is not known"]);
    let (_, output) = gateway.signal("-INT");
    harmless(&output);
    assert!(output.contains("31m"), "{output}");
}

#[test]
fn protocol_files_are_shown_without_unprintable_characters() {
    let host = Host::new();
    let name = "p&#x9b;31m&#x202e;&#10;error: forged";
    let scxml = format!(
        "<scxml xmlns=\"http://www.w3.org/2005/07/scxml\" id=\"{name}\" initial=\"a&#x9b;\">\
         <state id=\"a&#x9b;\"><transition event=\"inform\" from=\"i\" to=\"r\" target=\"b&#x202e;\"/>\
         </state><state id=\"b&#x202e;\" final=\"yes\"/></scxml>"
    );
    fs::write(host.path("p.scxml"), scxml).unwrap();
    let file = host.path("p.scxml").display().to_string();
    for arguments in [
        &["protocol", "check", &file][..],
        &["protocol", "check", "--json", &file],
        &["protocol", "show", &file],
        &["protocol", "show", "--json", &file],
        &["protocol", "draw", &file],
        &["protocol", "draw", "--format", "mermaid", &file],
        &[
            "protocol",
            "list",
            "--set",
            "monitor.protocols=[\"p.scxml\"]",
        ],
        &["protocol", "show", "nothing\u{9b}/"],
    ] {
        all_harmless(&host.run(arguments));
    }
}

#[test]
fn configuration_and_doctor_are_shown_without_unprintable_characters() {
    let host = Host::new();
    fs::write(
        host.path("c\u{9b}.toml"),
        "[mts]\n\"a\u{202e}\u{9b}\" = 1\n",
    )
    .unwrap();
    let keys = "security.keys=/nowhere/\u{9b}\u{202e}";
    for arguments in [
        &["config", "check", "--config", "c\u{9b}.toml"][..],
        &["config", "show", "--set", keys],
        &["config", "show", "--json", "--set", keys],
        &["doctor", "--set", keys],
        &["doctor", "--json", "--set", keys],
        &["up", "--set", keys],
        &["keys", "list", "--dir", "/nowhere/\u{9b}\u{202e}"],
        &["keys", "trust", "/nowhere/\u{9b}\u{202e}"],
    ] {
        let ran = host.run(arguments);
        all_harmless(&ran);
    }
}

#[test]
fn services_resources_and_platforms_are_shown_without_unprintable_characters() {
    let host = Host::new();
    let _gateway = host.start(&["up"]);
    let mut watching = host.start(&["df", "watch", "--count", "1"]);
    let mut machine = host.start(&["df", "watch", "--json", "--count", "1"]);
    let property = format!("{HOSTILE}={HOSTILE}");
    let crane = host.start(&[
        "df",
        "register",
        "crane",
        HOSTILE,
        "--service",
        HOSTILE,
        "--property",
        &property,
    ]);
    harmless(&crane.ready);
    for watching in [&mut watching, &mut machine] {
        while let Some(line) = watching.next_line() {
            harmless(&line);
            assert!(line.contains("31m"), "{line}");
        }
    }
    for arguments in [
        &["df", "search"][..],
        &["df", "search", "--json"],
        &["df", "search", "--type", HOSTILE],
    ] {
        let ran = host.run(arguments);
        assert_eq!(ran.code, Some(0), "{ran:?}");
        let printed = all_harmless(&ran);
        assert!(printed.contains("31m"), "{printed}");
    }
    for arguments in [
        &["df", "search", "--service", "\u{9b}"][..],
        &["df", "search", "--df", HOSTILE],
        &["ams"],
        &["ams", "--json"],
        &["ams", "--ownership", HOSTILE],
        &["ams", "--ams", HOSTILE],
        &["actions", HOSTILE],
        &["do", HOSTILE, HOSTILE, HOSTILE],
        &["own", HOSTILE, "--volatile"],
        &["lock", HOSTILE, "--within", "10ms", "--", "true"],
        &["locks"],
        &["request", HOSTILE, HOSTILE],
        &["subscribe", HOSTILE, HOSTILE],
        &["ping", HOSTILE, "--count", "1"],
    ] {
        all_harmless(&host.run(arguments));
    }
}

#[test]
fn input_is_converted_without_unprintable_characters_on_a_terminal() {
    let host = Host::new();
    // A byte string makes the content other than text.
    let content = b"((a \"x\x1b]0;t\x07\" #1\"\x9b))";
    fs::write(host.path("goal.sl"), content).unwrap();
    let message = format!(
        "{{ \"performative\": \"inform\", \"content\": {:?} }}",
        "x\u{1b}[31m"
    );
    let message = message.replace("\\u{1b}", "\\u001b");
    fs::write(host.path("message.json"), message).unwrap();
    let program = env!("CARGO_BIN_EXE_fipa");
    for arguments in [
        "content format goal.sl",
        "content check goal.sl",
        "content to-json goal.sl",
        "encode --representation string message.json",
    ] {
        let piped = host.run(&arguments.split(' ').collect::<Vec<_>>());
        assert_eq!(piped.code, Some(0), "{piped:?}");
        // `script` runs the command on a terminal of its own.
        let shown = Command::new("script")
            .args([
                "--quiet",
                "--command",
                &format!("{program} {arguments}"),
                "/dev/null",
            ])
            .current_dir(host.path(""))
            .output()
            .unwrap();
        let shown = String::from_utf8(shown.stdout).unwrap();
        // A terminal has a carriage return in front of each newline.
        harmless(&shown.replace("\r\n", "\n"));
        assert!(!shown.is_empty(), "{arguments}");
    }
}
