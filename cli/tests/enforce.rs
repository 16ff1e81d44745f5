//! The commands with `monitor.check=enforce`: an illegal message ends none of them. And `fipa send
//! --wait` for an agent that is killed.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use common::Host;

/// Settings of a process that checks its messages.
const ENFORCE: [&str; 2] = ["--set", "monitor.check=enforce"];

/// The arguments of `fipa send` with an illegal message: no conversation has begun.
fn illegal(to: &str) -> Vec<&str> {
    let message = "send --performative accept-proposal --protocol fipa-contract-net \
                   --conversation-id c --to";
    message
        .split(' ')
        .filter(|it| !it.is_empty())
        .chain([to])
        .collect()
}

#[test]
fn an_illegal_message_does_not_end_an_echo_agent() {
    let host = Host::new();
    let mut echo = host.start(&[&ENFORCE[..], &["echo", "arm_1"]].concat());
    let in_conversation = |act: &str| {
        let message = format!(
            "send --from rover --to arm_1 --in-reply-to x --performative {act} --protocol fipa-request \
             --conversation-id c"
        );
        let words: Vec<&str> = message.split_whitespace().collect();
        host.run(&words).done()
    };
    in_conversation("request");
    let line = echo.line();
    assert!(line.contains("request"), "{line}");
    for _ in 0..3 {
        let sent = in_conversation("accept-proposal");
        assert!(sent.contains("delivered"), "{sent}");
    }
    // The agent still answers, and has printed no illegal message.
    let answered = host.run(&["send", "--to", "arm_1", "--content", "hello", "--wait"]);
    assert!(answered.done().contains("hello"));
    let line = echo.line();
    assert!(line.contains("hello"), "{line}");
}

#[test]
fn an_illegal_message_is_no_reply_and_does_not_end_the_wait() {
    let host = Host::new();
    // This agent reads, and never replies.
    let mut silent = host.echo("arm_1");
    let mut waiting = host.command(
        &[
            &ENFORCE[..],
            &[
                "send",
                "--from",
                "rover",
                "--to",
                "arm_1",
                "--in-reply-to",
                "x",
            ],
            &["--protocol", "fipa-request", "--performative", "request"],
            &["--conversation-id", "c", "--wait", "--timeout", "60s"],
        ]
        .concat(),
    );
    let waiting = std::thread::spawn(move || waiting.output().unwrap());
    // The request has been delivered.
    let line = silent.line();
    assert!(line.contains("request"), "{line}");
    let sent = host.run(&illegal("rover")).done();
    assert!(sent.contains("delivered"), "{sent}");
    assert!(!waiting.is_finished());
    drop(silent);
    let ended = waiting.join().unwrap();
    assert_eq!(ended.status.code(), Some(1));
    let errors = String::from_utf8(ended.stderr).unwrap();
    assert!(errors.contains("violates its protocol"), "{errors}");
    assert!(errors.contains("gone before it replied"), "{errors}");
}

#[test]
fn a_wait_ends_when_the_receiver_is_killed() {
    let host = Host::new();
    let mut silent = host.echo("arm_1");
    let mut waiting = host.command(&[
        "send",
        "--to",
        "arm_1",
        "--in-reply-to",
        "x",
        "--wait",
        "--timeout",
        "120s",
        "--json",
    ]);
    let waiting = std::thread::spawn(move || waiting.output().unwrap());
    silent.line();
    drop(silent);
    let ended = waiting.join().unwrap();
    assert_eq!(ended.status.code(), Some(1));
    let json: serde_json::Value = serde_json::from_slice(&ended.stdout).unwrap();
    assert_eq!(json["gone"], serde_json::json!(["arm_1"]), "{json:#}");
    let errors = String::from_utf8(ended.stderr).unwrap();
    assert!(errors.contains("arm_1"), "{errors}");
}

#[test]
fn the_other_commands_work_with_enforcement() {
    let host = Host::new();
    let gateway = host.start(&[&ENFORCE[..], &["up"]].concat());
    assert!(gateway.ready.contains(&host.domain), "{}", gateway.ready);
    let _echo = host.start(&[&ENFORCE[..], &["echo", "arm_1"]].concat());
    host.run(&illegal("arm_1")).done();
    for command in ["agents", "routes"] {
        let shown = host.run(&[&ENFORCE[..], &[command]].concat()).done();
        assert!(shown.contains("arm_1"), "{command}: {shown}");
    }
    let coalition = host.start(&[&ENFORCE[..], &["coalition", "platoon", "arm_1"]].concat());
    host.run(&illegal("platoon")).done();
    let asked = ["send", "--to", "arm_1", "--content", "hello", "--wait"];
    let answered = host.run(&[&ENFORCE[..], &asked].concat()).done();
    assert!(answered.contains("reply"), "{answered}");
    // This process refuses to send an illegal message itself.
    let refused = host.run(&[&ENFORCE[..], &illegal("arm_1")].concat());
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("not sent"), "{}", refused.stderr);
    drop((coalition, gateway));
}

#[test]
fn commands_with_agents_of_their_own_go_on_after_an_illegal_message() {
    let host = Host::new();
    let _gateway = host.start(&[&ENFORCE[..], &["--set", "mts.name=robot", "up"]].concat());
    let watch = ["df", "watch", "--type", "lifting", "--json"];
    let mut watching = host.start(&[&ENFORCE[..], &watch].concat());
    let crane = ["df", "register", "crane", "lifting", "--service", "lift-1"];
    let crane = host.start(&[&ENFORCE[..], &crane].concat());
    let changed = watching.line();
    assert!(changed.contains("lift-1"), "{changed}");
    // All agents of the host, the temporary ones of the commands among them.
    for to in ["crane", "fipa-.*"] {
        let sent = host.run(&illegal(to)).done();
        assert!(sent.contains("delivered"), "{sent}");
    }
    let found = host.run(&[&ENFORCE[..], &["df", "search", "--type", "lifting"]].concat());
    assert!(found.done().contains("crane"));
    let other = ["df", "register", "hoist", "lifting", "--service", "lift-2"];
    let _hoist = host.start(&[&ENFORCE[..], &other].concat());
    let changed = watching.line();
    assert!(changed.contains("lift-2"), "{changed}");
    crane.send_signal("-INT");
    let line = watching.line();
    assert!(line.contains("crane"), "{line}");
    drop(crane);
}

#[test]
fn a_question_to_a_platform_goes_on_after_an_illegal_message() {
    let host = Host::new();
    let mut silent = host.start(&["listen", "manager"]);
    let mut asking = host.command(&[&ENFORCE[..], &["ams", "--ams", "manager"]].concat());
    let asking = std::thread::spawn(move || asking.output().unwrap());
    let line = silent.line();
    assert!(line.contains("request"), "{line}");
    let sent = host.run(&illegal("fipa-.*")).done();
    assert!(sent.contains("delivered"), "{sent}");
    assert!(!asking.is_finished());
    drop(silent);
    let ended = asking.join().unwrap();
    assert_eq!(ended.status.code(), Some(1));
    let errors = String::from_utf8(ended.stderr).unwrap();
    assert!(errors.contains("violates its protocol"), "{errors}");
    assert!(errors.contains("manager"), "{errors}");
}

#[test]
fn watching_and_an_agent_of_the_demo_go_on_after_an_illegal_message() {
    let host = Host::new();
    let mut watching = host.start(&[&ENFORCE[..], &["watch", "--json"]].concat());
    let mut agent = host.ordered_agent("arm_1", &ENFORCE);
    host.run(&illegal("arm_1")).done();
    let letter = |watching: &mut common::Running| -> serde_json::Value {
        serde_json::from_str(&watching.line()).unwrap()
    };
    let seen = letter(&mut watching);
    assert_eq!(seen["verdict"]["verdict"], "violation", "{seen:#}");
    assert!(agent.line().contains("accept-proposal"));
    host.run(&["send", "--to", "arm_1", "--content", "hello"])
        .done();
    assert!(agent.line().contains("hello"));
    let seen = letter(&mut watching);
    assert_eq!(seen["verdict"]["verdict"], "unchecked", "{seen:#}");
    agent.write_line(r#"{"do":"count"}"#);
    assert!(agent.line().contains("count"));
}
