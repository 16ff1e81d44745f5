//! `fipa watch`: real processes, and somebody who looks on.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};

use common::{Host, Running};
use serde_json::Value;

/// Watches as a program does, once all processes that are there can be seen.
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
fn a_letter_and_its_answer_are_seen() {
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
    // The echo answers at once, without agreeing.
    let answer = next(&mut watching);
    assert_eq!(
        (&answer["sender"], &answer["receiver"]),
        (&"arm_1".into(), &"rover".into())
    );
    let (code, errors) = watching.signal("-INT");
    assert_eq!((code, errors.as_str()), (Some(0), ""));
}

#[test]
fn filters_leave_out_what_was_not_asked_for() {
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
        "content was not asked for"
    );
}

#[test]
fn a_letter_that_fails_is_seen_with_its_reason() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut watching = watch(&host, &["--performative", "request"]);
    let ran = host.run(&[
        "send",
        "--to",
        "nobody",
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
fn a_violation_stands_out() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut watching = watch(&host, &["--violations"]);
    // A conversation that begins with an agreement to nothing.
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
fn protocols_of_ones_own_are_read_and_mistakes_in_them_told() {
    let host = Host::new();
    let protocols = host.path("protocols");
    fs::create_dir(&protocols).unwrap();
    let file = protocols.join("broken.scxml");
    fs::write(&file, "<scxml><state/></scxml>").unwrap();
    let directory = protocols.to_str().unwrap();
    let told = host.run(&["watch", "--protocols", directory]).failed(2);
    assert!(told.contains("broken.scxml"), "{told}");
    let told = host
        .run(&["watch", "--protocols", "/no/such/directory"])
        .failed(2);
    assert!(told.contains("/no/such/directory"), "{told}");
}

#[test]
fn a_conversation_is_drawn_in_the_terminal_and_for_documents() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let file = host.path("c3.mmd");
    let mut watching = host.start(&[
        "watch",
        "--sequence",
        "--conversation",
        "c3",
        "--count",
        "2",
        "--mermaid",
        file.to_str().unwrap(),
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
}

#[test]
fn people_see_lines_and_a_summary() {
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
    assert!(
        !line.contains('\u{1b}'),
        "no colour where there is no terminal"
    );
    let pid = watching.pid();
    assert!(
        Command::new("kill")
            .args(["-INT", &pid])
            .status()
            .unwrap()
            .success()
    );
    assert_eq!(watching.line(), "");
    let summary = watching.line();
    assert!(
        summary.contains("1 delivered") && summary.contains("no violation"),
        "{summary}"
    );
    assert_eq!(watching.end().0, Some(0));
}

/// An agent that does what it is told on standard input, as in the demo.
fn part(host: &Host, name: &str) -> (std::process::Child, BufReader<std::process::ChildStdout>) {
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

/// A watcher that is stopped takes nothing from anybody, and is told what it missed.
#[test]
fn a_stopped_watcher_slows_nobody() {
    const LETTERS: usize = 4000;
    let host = Host::new();
    let ((mut rover, mut events), (mut arm, _)) = (part(&host, "rover"), part(&host, "arm"));
    let mut watching = watch(&host, &[]);
    let pid = watching.pid();
    let signal = |signal: &str| {
        let sent = Command::new("kill").args([signal, pid.as_str()]).status();
        assert!(sent.unwrap().success());
    };
    signal("-STOP");
    let order = format!("{{\"do\":\"measure\",\"to\":\"arm\",\"len\":9,\"rounds\":{LETTERS}}}\n");
    rover
        .stdin
        .as_mut()
        .unwrap()
        .write_all(order.as_bytes())
        .unwrap();
    let mut told = String::new();
    events.read_line(&mut told).unwrap();
    assert!(
        told.contains("\"measured\""),
        "every letter must arrive: {told}"
    );
    signal("-CONT");
    let lost = next_of(&mut watching, "lost");
    assert!(lost["records"].as_u64().unwrap() > 0, "{lost}");
    for part in [&mut rover, &mut arm] {
        drop(part.stdin.take());
        assert!(part.wait().unwrap().success());
    }
}

#[test]
fn a_killed_watcher_leaves_nothing_behind() {
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
    let began = std::time::Instant::now();
    while sockets() > 0 {
        assert!(began.elapsed().as_secs() < 60, "the socket is still there");
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    send(&host, &["--to", "arm_1", "--content", "alone again"]);
    arm.signal("-INT");
    assert_eq!(host.left_behind(), Vec::<std::path::PathBuf>::new());
}
