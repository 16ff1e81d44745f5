//! `fipa watch` with real processes.

#![expect(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::process::Stdio;
use std::time::{Duration, Instant};

use common::{Host, Running};
use serde_json::{Value, json};

/// Starts `fipa watch --json` and waits until it watches all running processes.
fn watch(host: &Host, arguments: &[&str]) -> Running {
    let running = host.start(&[&["watch", "--json"], arguments].concat());
    let ready: Value = serde_json::from_str(&running.ready).unwrap();
    assert_eq!(ready["event"], "watching");
    running
}

fn next(watching: &mut Running) -> Value {
    serde_json::from_str(&watching.line()).unwrap()
}

/// The next event of this kind.
fn next_of(watching: &mut Running, event: &str) -> Value {
    loop {
        let found = next(watching);
        if found["event"] == event {
            return found;
        }
    }
}

fn send(host: &Host, arguments: &[&str]) {
    let ran = host.run(&[&["send"], arguments].concat());
    assert_eq!(ran.code, Some(0), "{ran:?}");
}

#[test]
fn a_letter_and_its_answer_are_shown() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut watching = watch(&host, &["--conversation", "c1", "--content"]);
    send(
        &host,
        &[
            "--from",
            "rover",
            "--to",
            "arm_1",
            "--performative",
            "request",
            "--protocol",
            "fipa-request",
            "--conversation-id",
            "c1",
            "--content",
            "lift sample-3",
            "--wait",
        ],
    );
    let request = next(&mut watching);
    assert_eq!(request["event"], "letter");
    for (key, value) in [
        ("sender", "rover"),
        ("receiver", "arm_1"),
        ("performative", "request"),
        ("protocol", "fipa-request"),
        ("conversation_id", "c1"),
        ("via", "shm"),
        ("outcome", "delivered"),
    ] {
        assert_eq!(request[key], value, "{request:#}");
    }
    assert_eq!(request["letter"]["message"]["content"], "lift sample-3");
    assert_eq!(request["letter"]["effective"]["from"]["name"], "rover");
    assert_eq!(request["content_length"], 13);
    assert_eq!(request["verdict"]["verdict"], "accepted");
    // The echo agent answers at once, without an agree.
    let answer = next(&mut watching);
    assert_eq!(
        (&answer["sender"], &answer["receiver"]),
        (&"arm_1".into(), &"rover".into())
    );
    let (code, errors) = watching.signal("-INT");
    assert_eq!((code, errors.as_str()), (Some(0), ""));
}

#[test]
fn letters_that_do_not_match_the_filters_are_not_shown() {
    let host = Host::new();
    let _arms = [host.echo("arm_1"), host.echo("arm_2")];
    let mut watching = watch(&host, &["--agent", "arm_2", "--performative", "query-ref"]);
    send(
        &host,
        &[
            "--to",
            "arm_1",
            "--performative",
            "query-ref",
            "--content",
            "not this",
        ],
    );
    send(
        &host,
        &[
            "--to",
            "arm_2",
            "--performative",
            "inform",
            "--content",
            "nor this",
        ],
    );
    send(
        &host,
        &[
            "--to",
            "arm_2",
            "--performative",
            "query-ref",
            "--content",
            "this",
        ],
    );
    let seen = next(&mut watching);
    assert_eq!(
        (&seen["receiver"], &seen["content_length"]),
        (&"arm_2".into(), &4.into())
    );
    assert_eq!(
        seen["letter"]["message"].get("content"),
        None,
        "content without --content"
    );
}

#[test]
fn a_failed_letter_is_shown_with_its_reason() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut watching = watch(&host, &["--performative", "request"]);
    let ran = host.run(&[
        "send",
        "--to",
        "unknown",
        "--performative",
        "request",
        "--content",
        "x",
    ]);
    assert_eq!(ran.code, Some(1));
    let seen = next(&mut watching);
    assert_eq!(
        (&seen["outcome"], &seen["reason"]),
        (&"failed".into(), &"no such agent".into())
    );
    assert_eq!(seen["verdict"]["reason"], "not delivered");
}

#[test]
fn a_violation_is_shown_with_its_protocol() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut watching = watch(&host, &["--violations"]);
    // An agree as the first message of a conversation.
    send(
        &host,
        &[
            "--from",
            "rover",
            "--to",
            "arm_1",
            "--performative",
            "agree",
            "--protocol",
            "fipa-contract-net",
            "--conversation-id",
            "c2",
        ],
    );
    let seen = next(&mut watching);
    let verdict = &seen["verdict"];
    assert_eq!(verdict["verdict"], "violation", "{seen:#}");
    assert_eq!(verdict["protocol"], "fipa-contract-net");
    assert!(
        verdict["text"].as_str().unwrap().contains("rover"),
        "{verdict}"
    );
    let (code, _) = watching.signal("-TERM");
    assert_eq!(code, Some(0));
}

#[test]
fn errors_in_protocol_files_are_reported() {
    let host = Host::new();
    let protocols = host.path("protocols");
    fs::create_dir(&protocols).unwrap();
    let file = protocols.join("broken.scxml");
    fs::write(&file, "<scxml><state/></scxml>").unwrap();
    let directory = protocols.to_str().unwrap();
    let output = host.run(&["watch", "--protocols", directory]).failed(2);
    assert!(output.contains("broken.scxml"), "{output}");
    let output = host
        .run(&["watch", "--protocols", "/no/such/directory"])
        .failed(2);
    assert!(output.contains("/no/such/directory"), "{output}");
}

#[test]
fn a_conversation_is_drawn_in_the_terminal_and_for_documents() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let file = host.path("c3.mmd");
    let picture = host.path("c3.svg");
    let mut watching = host.start(&[
        "watch",
        "--sequence",
        "--conversation",
        "c3",
        "--count",
        "2",
        "--mermaid",
        file.to_str().unwrap(),
        "--svg",
        picture.to_str().unwrap(),
    ]);
    assert!(watching.ready.contains("1 process;"), "{}", watching.ready);
    send(
        &host,
        &[
            "--from",
            "rover",
            "--to",
            "arm_1",
            "--performative",
            "query-ref",
            "--conversation-id",
            "c3",
            "--content",
            "where?",
            "--wait",
        ],
    );
    assert_eq!(watching.line(), "conversation c3");
    let head = watching.line();
    assert!(
        head.trim_start().starts_with("rover") && head.ends_with("arm_1"),
        "{head}"
    );
    assert!(watching.line().contains("query-ref"));
    assert!(watching.line().contains("►│"));
    assert!(watching.line().contains("inform"));
    assert!(watching.line().contains("│◄"));
    let (code, errors) = watching.end();
    assert_eq!((code, errors.as_str()), (Some(0), ""));
    let drawn = fs::read_to_string(&file).unwrap();
    assert_eq!(
        drawn,
        "sequenceDiagram\n    participant p1 as rover\n    participant p2 as arm_1\n    \
         Note over p1,p2: conversation c3\n    p1->>p2: query-ref\n    p2->>p1: inform\n"
    );
    let drawn = fs::read_to_string(&picture).unwrap();
    for text in [">conversation c3<", ">rover<", ">arm_1<", ">query-ref<"] {
        assert!(drawn.contains(text), "{text}: {drawn}");
    }
}

#[test]
fn the_text_output_has_lines_and_a_summary() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut watching = host.start(&["watch", "--agent", "rover"]);
    assert!(watching.line().starts_with("UTC"));
    send(
        &host,
        &["--from", "rover", "--to", "arm_1", "--content", "hello"],
    );
    let line = watching.line();
    for part in ["rover → arm_1", "inform", "shm", "delivered"] {
        assert!(line.contains(part), "{line}");
    }
    assert!(!line.contains('\u{1b}'), "no color without a terminal");
    watching.send_signal("-INT");
    assert_eq!(watching.line(), "");
    let summary = watching.line();
    assert!(
        summary.contains("1 delivered") && summary.contains("no violation"),
        "{summary}"
    );
    assert_eq!(watching.end().0, Some(0));
}

/// Starts an agent that executes orders from standard input, as in the demo.
fn ordered_agent(
    host: &Host,
    name: &str,
) -> (std::process::Child, BufReader<std::process::ChildStdout>) {
    let mut child = host
        .command(&["demo", "--role", "agent", "--name", name])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut events = BufReader::new(child.stdout.take().unwrap());
    let mut ready = String::new();
    events.read_line(&mut ready).unwrap();
    assert!(ready.contains("ready"), "{ready}");
    (child, events)
}

/// A stopped watcher does not delay any letter, and reports the lost records later.
#[test]
fn a_stopped_watcher_does_not_delay_letters() {
    const LETTERS: usize = 4000;
    let host = Host::new();
    let ((mut rover, mut events), (mut arm, _)) =
        (ordered_agent(&host, "rover"), ordered_agent(&host, "arm"));
    // More than the queues of the processes hold.
    let mut watching = watch(&host, &["--content=2000"]);
    watching.send_signal("-STOP");
    let order =
        format!("{{\"do\":\"measure\",\"to\":\"arm\",\"len\":2000,\"rounds\":{LETTERS}}}\n");
    rover
        .stdin
        .as_mut()
        .unwrap()
        .write_all(order.as_bytes())
        .unwrap();
    let mut output = String::new();
    events.read_line(&mut output).unwrap();
    assert!(
        output.contains("\"measured\""),
        "not every letter was delivered: {output}"
    );
    watching.send_signal("-CONT");
    let lost = next_of(&mut watching, "lost");
    assert!(lost["records"].as_u64().unwrap() > 0, "{lost}");
    for agent in [&mut rover, &mut arm] {
        drop(agent.stdin.take());
        assert!(agent.wait().unwrap().success());
    }
}

#[test]
fn the_files_of_a_killed_watcher_are_removed() {
    let host = Host::new();
    let arm = host.echo("arm_1");
    let watching = watch(&host, &[]);
    let sockets = || {
        let directory = host.path("run").join(&host.domain).join("directory");
        let files = fs::read_dir(directory).unwrap();
        let names = files.map(|file| file.unwrap().file_name().into_string().unwrap());
        names.filter(|name| name.ends_with(".socket")).count()
    };
    assert_eq!(sockets(), 1);
    watching.signal("-KILL");
    let began = Instant::now();
    while sockets() > 0 {
        assert!(began.elapsed().as_secs() < 60, "the socket was not removed");
        std::thread::sleep(Duration::from_millis(5));
    }
    send(&host, &["--to", "arm_1", "--content", "unwatched"]);
    arm.signal("-INT");
    assert_eq!(host.left_behind(), Vec::<std::path::PathBuf>::new());
}

/// Sends a message in a conversation of this protocol. The echo agent does not reply to it.
fn say(host: &Host, act: &str, protocol: &str, id: &str) {
    let message = format!(
        "--from rover --to arm_1 --performative {act} --protocol {protocol} --conversation-id {id} \
         --in-reply-to x"
    );
    send(host, &message.split(' ').collect::<Vec<_>>());
}

#[test]
fn conversations_that_may_have_begun_before_the_watching_are_unchecked() {
    let host = Host::new();
    let (mut rover, mut arm) = (
        host.ordered_agent("rover", &[]),
        host.ordered_agent("arm", &[]),
    );
    let converse = |agent: &mut Running, act: &str, to: &str, conversation: &str| {
        let order = json!({
            "do": "converse", "performative": act, "to": to, "conversation": conversation
        });
        agent.write_line(&order.to_string());
        while next(agent)["event"] != "outcomes" {}
    };
    converse(&mut rover, "cfp", "arm", "earlier");
    let file = host.path("late.mcap");
    let file = file.to_str().unwrap();
    let mut recording = host.start(&["record", "-o", file]);
    let mut watching = watch(&host, &[]);
    let mut verdicts = |agent: &mut Running, act: &str, to: &str, conversation: &str| {
        converse(agent, act, to, conversation);
        let seen = next_of(&mut watching, "letter");
        assert_eq!(seen["performative"], act, "{seen:#}");
        let verdict = seen["verdict"]["verdict"].as_str();
        verdict.unwrap().to_owned()
    };
    // It began before the command.
    assert_eq!(
        verdicts(&mut arm, "propose", "rover", "earlier"),
        "unchecked"
    );
    assert_eq!(
        verdicts(&mut rover, "accept-proposal", "arm", "earlier"),
        "unchecked"
    );
    // It begins while it is watched.
    assert_eq!(verdicts(&mut rover, "cfp", "arm", "later"), "accepted");
    assert_eq!(verdicts(&mut arm, "inform", "rover", "later"), "violation");
    // One of the agents registers later.
    let mut crane = host.ordered_agent("crane", &[]);
    assert_eq!(verdicts(&mut crane, "propose", "arm", "other"), "violation");
    let (code, errors) = watching.signal("-INT");
    assert_eq!((code, errors.as_str()), (Some(0), ""));
    // A recording has the same verdicts.
    recording.send_signal("-INT");
    assert_eq!(recording.end(), (Some(0), String::new()));
    let replayed = host.run(&["replay", file, "--check"]);
    assert_eq!(replayed.code, Some(1));
    let shown = String::from_utf8(replayed.stdout).unwrap();
    let summary = "letters: 5, accepted: 1, violations: 2, unchecked: 2, not judged: 0";
    let reason = "  unchecked: 2, the monitor does not know the beginning of the conversation";
    assert!(
        shown.ends_with(&format!("{summary}\n{reason}\n")),
        "{shown}"
    );
}

#[test]
fn protocols_of_the_configuration_and_files_without_an_extension_are_checked() {
    let host = Host::new();
    let protocol = |name: &str, act: &str| {
        let text = format!(
            r#"<scxml initial="1">
            <state id="1"><transition performative="{act}" from="a" to="b" target="2"/></state>
            <state id="2" final="yes"/></scxml>"#
        );
        (host.path(name), text)
    };
    let (configured, text) = protocol("lift.scxml", "request");
    fs::write(&configured, text).unwrap();
    let directory = host.path("protocols");
    fs::create_dir(&directory).unwrap();
    let (_, text) = protocol("wave", "propose");
    fs::write(directory.join("wave"), text).unwrap();
    // Not a protocol.
    fs::write(directory.join("README"), "Protocols of the arm").unwrap();
    let _arm = host.echo("arm_1");
    let set = format!("monitor.protocols={}", configured.display());
    let directory = directory.to_str().unwrap();
    let mut watching = host.start(&["--set", &set, "watch", "--json", "--protocols", directory]);
    for (act, name, id, verdict) in [
        ("request", "lift", "c1", "accepted"),
        ("inform", "lift", "c2", "violation"),
        ("propose", "wave", "c3", "accepted"),
        ("request", "wave", "c4", "violation"),
    ] {
        say(&host, act, name, id);
        let seen = next_of(&mut watching, "letter");
        assert_eq!(seen["verdict"]["verdict"], verdict, "{name}: {seen:#}");
    }
}
