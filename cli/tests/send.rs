//! `fipa send` and `fipa echo` in processes of their own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::path::PathBuf;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD as BASE64;
use common::{Host, Running, unshared};
use fipa_testbed::until;
use serde_json::{Value, json};

/// The kernel does not restrict the name of the host; `(none)` is its name before it was set.
#[test]
fn agents_register_on_a_host_of_any_name() {
    for name in ["(none)", "[a]{b}*+?|^$ "] {
        let host = Host::new();
        let named = |arguments: &[&str]| {
            let set = format!("printf %s '{name}' >/proc/sys/kernel/hostname");
            unshared(&host.command(arguments), &["--uts"], &set)
        };
        let Some(echo) = named(&["echo", "arm_1"]) else {
            return;
        };
        let echo = Running::new(echo);
        assert!(echo.ready.starts_with("agent arm_1 "), "{}", echo.ready);
        let send = named(&["send", "--to", "arm_1", "--content", "hello", "--wait"]);
        let sent = send.unwrap().output().unwrap();
        assert!(sent.status.success(), "{name}: {sent:?}");
    }
}

#[test]
fn a_message_is_answered_with_and_without_a_gateway() {
    let host = Host::new();
    let _echo = host.echo("arm_1");
    let asked = [
        "send",
        "--to",
        "arm_1",
        "--content",
        "hello",
        "--wait",
        "--json",
    ];
    let converse = || {
        let json = host.run(&asked).done_json();
        assert_eq!(
            json["deliveries"],
            json!([{ "receiver": "arm_1", "outcome": "delivered", "via": "shm", "attempts": [] }])
        );
        let reply = &json["reply"];
        assert_eq!(reply["performative"], "inform");
        assert_eq!(reply["sender"]["name"], "arm_1");
        assert_eq!(reply["content"], "hello");
        assert!(reply["in_reply_to"].is_string() && reply["conversation_id"].is_string());
    };
    converse();
    let gateway = host.start(&["up"]);
    assert!(gateway.ready.contains(&host.domain), "{}", gateway.ready);
    converse();
    // A crash of the gateway does not affect the agents of the host.
    drop(gateway);
    converse();
}

#[test]
fn the_text_output_has_the_outcome_and_the_reply() {
    let host = Host::new();
    let mut echo = host.echo("arm_1");
    let output = host.run(&[
        "send",
        "--to",
        "arm_1",
        "--from",
        "me",
        "--content",
        "hi",
        "--wait",
    ]);
    let output = output.done();
    let (outcome, reply) = output.split_once('\n').unwrap();
    assert_eq!(outcome, "arm_1: delivered via shm");
    assert!(
        reply.starts_with("reply: (inform :sender arm_1 :receiver (set me)"),
        "{reply}"
    );
    assert!(reply.ends_with(":content \"hi\")\n"), "{reply}");
    let seen = echo.line();
    assert!(
        seen.starts_with("via shm: (inform :sender me :receiver (set arm_1)"),
        "{seen}"
    );
}

#[test]
fn all_parameters_are_delivered() {
    let host = Host::new();
    let mut echo = host.echo("arm_1");
    let sent = [
        "send",
        "--to",
        "arm_1",
        "--performative",
        "request-when",
        "--protocol",
        "fipa-request",
        "--conversation-id",
        "c-1",
        "--ontology",
        "crane",
        "--language",
        "fipa-sl",
        "--encoding",
        "utf-8",
        "--reply-with",
        "r-1",
        "--reply-by",
        "2030-01-31T12:00:00Z",
        "--content",
        "x",
        "--wait",
        "--json",
    ];
    let json = host.run(&sent).done_json();
    let seen = echo.line();
    for part in [
        "(request-when ",
        ":protocol fipa-request",
        ":conversation-id c-1",
        ":ontology crane",
        ":language fipa-sl",
        ":encoding utf-8",
        ":reply-with r-1",
        ":reply-by 20300131T120000000Z",
    ] {
        assert!(seen.contains(part), "{part} in {seen}");
    }
    let reply = &json["reply"];
    for (key, value) in [
        ("conversation_id", "c-1"),
        ("in_reply_to", "r-1"),
        ("protocol", "fipa-request"),
        ("encoding", "utf-8"),
    ] {
        assert_eq!(reply[key], value, "{reply}");
    }
}

#[test]
fn binary_content_is_read_from_a_file_and_from_standard_input() {
    let host = Host::new();
    let _echo = host.echo("camera");
    let every_byte: Vec<u8> = (0..=255).cycle().take(100_000).collect();
    std::fs::write(host.path("picture.raw"), &every_byte).unwrap();
    let ask = |file| {
        [
            "send",
            "--to",
            "camera",
            "--wait",
            "--json",
            "--content-file",
            file,
        ]
    };
    let came_back = |json: Value| BASE64.decode(json["reply"]["content_base64"].as_str().unwrap());
    let by_file = host.run(&ask("picture.raw")).done_json();
    assert_eq!(came_back(by_file).unwrap(), every_byte);
    let by_input = host.run_with_input(&ask("-"), &every_byte).done_json();
    assert_eq!(came_back(by_input).unwrap(), every_byte);
    let missing = host.run(&ask("nothing.raw")).failed(1);
    assert!(missing.contains("where: nothing.raw\n"), "{missing}");
}

#[test]
fn a_letter_to_an_unknown_receiver_fails() {
    let host = Host::new();
    let (json, output) = host
        .run(&[
            "send",
            "--to",
            "unknown",
            "--content",
            "x",
            "--wait",
            "--json",
        ])
        .failed_json();
    assert_eq!(
        json,
        json!({ "deliveries": [{ "receiver": "unknown", "outcome": "failed",
                                 "reason": "no such agent", "attempts": [] }] })
    );
    assert!(
        output.contains("error: not delivered: no such agent\nwhere: \"unknown\"\n"),
        "{output}"
    );
    assert!(output.contains("start one with `fipa up`"), "{output}");
    let _gateway = host.start(&["up"]);
    let (_, output) = host
        .run(&["send", "--to", "unknown", "--json"])
        .failed_json();
    assert!(output.contains("that gateway "), "{output}");
}

/// Starts two gateways that know each other, and waits until the first lists the agent of the second.
fn connected(here: &Host, there: &Host, agent: &str) -> (Running, Running) {
    let far = there.start(&["up", "--json", "--set", "mts.name=crex"]);
    let peer = format!(
        "discovery.static={{ crex = [\"tcp://{}\"] }}",
        far.tcp_address()
    );
    let near = here.start(&["up", "--json", "--set", &peer]);
    until(&format!("{agent} is listed"), || listed(here, agent));
    (near, far)
}

fn listed(host: &Host, agent: &str) -> bool {
    let listed = host.run(&["agents", "--json"]).done_json();
    let mut agents = listed["agents"].as_array().unwrap().iter();
    agents.any(|entry| entry["name"] == agent)
}

#[test]
fn an_agent_behind_a_killed_gateway_is_unreachable() {
    let (here, there) = (Host::new(), Host::new());
    let _echo = there.echo("arm_1");
    let (_near, far) = connected(&here, &there, "arm_1");
    let at = far.tcp_address();
    far.signal("-KILL");
    until("arm_1 has left the directory", || !listed(&here, "arm_1"));
    let (json, output) = here
        .run(&["send", "--to", "arm_1", "--content", "x", "--json"])
        .failed_json();
    let delivery = &json["deliveries"][0];
    assert_eq!(delivery["reason"], "unreachable", "{json}");
    let attempt = delivery["attempts"][0].to_string();
    let why = "its host crex was last seen at ";
    assert!(attempt.contains(&at) && attempt.contains(why), "{attempt}");
    assert!(output.contains("fipa doctor"), "{output}");
    // Other names do not exist.
    let (json, _) = here
        .run(&["send", "--to", "arm_2", "--content", "x", "--json"])
        .failed_json();
    assert_eq!(json["deliveries"][0]["reason"], "no such agent");
}

#[test]
fn the_agent_of_a_command_on_another_host_does_not_stay_listed() {
    let (here, there) = (Host::new(), Host::new());
    let _far_echo = there.echo("arm_1");
    let mut near_echo = here.echo("parrot");
    let _gateways = connected(&here, &there, "arm_1");
    until("parrot is listed", || listed(&there, "parrot"));
    let sent = [
        "send",
        "--from",
        "brief",
        "--to",
        "parrot",
        "--content",
        "x",
    ];
    there.run(&sent).done();
    assert!(near_echo.line().contains("brief"));
    until("brief is no longer listed", || !listed(&here, "brief"));
}

#[test]
fn a_failure_for_one_of_two_receivers_does_not_affect_the_other() {
    let host = Host::new();
    let _echo = host.echo("arm_1");
    let (json, output) = host
        .run(&["send", "--to", "arm_1", "--to", "arm_2", "--wait", "--json"])
        .failed_json();
    let mut outcomes: Vec<_> = json["deliveries"].as_array().unwrap().iter().collect();
    outcomes.sort_by_key(|one| one["receiver"].to_string());
    assert_eq!(outcomes[0]["outcome"], "delivered");
    assert_eq!(outcomes[1]["reason"], "no such agent");
    // The failure message about arm_2 is not a reply.
    assert_eq!(json["reply"]["sender"]["name"], "arm_1");
    assert!(
        output.contains("where: \"arm_2\"\n") && !output.contains("no reply"),
        "{output}"
    );
}

#[test]
fn a_pattern_reaches_all_matching_agents_except_the_sender() {
    let host = Host::new();
    let mut echoes = [host.echo("arm_1"), host.echo("arm_2")];
    let _other = host.echo("camera");
    let json = host
        .run(&[
            "send",
            "--to",
            "arm_.*",
            "--from",
            "arm_0",
            "--content",
            "stop",
            "--json",
        ])
        .done_json();
    let deliveries = json["deliveries"].as_array().unwrap();
    let mut reached: Vec<_> = deliveries
        .iter()
        .map(|one| one["receiver"].clone())
        .collect();
    reached.sort_by_key(Value::to_string);
    assert_eq!(reached, ["arm_1", "arm_2"]);
    for echo in &mut echoes {
        let seen = echo.line();
        assert!(
            seen.contains("(inform :sender arm_0") && seen.contains("\"stop\""),
            "{seen}"
        );
    }
    let (_, output) = host.run(&["send", "--to", "arm_[", "--json"]).failed_json();
    assert!(output.contains("unclosed character class"), "{output}");
}

#[test]
fn a_missing_reply_is_reported_after_the_timeout() {
    let host = Host::new();
    let _echo = host.echo("arm_1");
    let not_answered = [
        "send",
        "--to",
        "arm_1",
        "--performative",
        "not-understood",
        "--wait",
        "--timeout",
        "50ms",
        "--json",
    ];
    let (json, output) = host.run(&not_answered).failed_json();
    assert_eq!(json["deliveries"][0]["outcome"], "delivered");
    assert_eq!(json.get("reply"), None);
    assert!(
        output.starts_with("error: no reply within 50ms\nwhere: \"arm_1\"\n"),
        "{output}"
    );
}

#[test]
fn echo_agents_do_not_answer_each_other_endlessly() {
    let host = Host::new();
    let (mut arm_1, mut arm_2) = (host.echo("arm_1"), host.echo("arm_2"));
    // The answer goes to arm_2 and has no in-reply-to that would mark it as a reply.
    let begin = [
        "--performative",
        "request",
        "--reply-to",
        "arm_2",
        "--content",
        "begin",
    ];
    host.run(&[&["send", "--to", "arm_1"], &begin[..]].concat())
        .done();
    assert!(arm_1.line().contains("\"begin\""));
    let answer = arm_2.line();
    assert!(answer.contains("(inform :sender arm_1"), "{answer}");
    // arm_2 handles messages in order: after this answer it has handled the previous message.
    host.run(&["send", "--to", "arm_2", "--content", "between", "--wait"])
        .done();
    host.run(&["send", "--to", "arm_1", "--content", "end"])
        .done();
    let next = arm_1.line();
    assert!(next.contains("\"end\""), "{next}");
}

#[test]
fn echo_ends_after_its_count_of_messages() {
    let host = Host::new();
    let mut echo = host.start(&["echo", "arm_1", "--count", "2"]);
    for _ in 0..2 {
        host.run(&["send", "--to", "arm_1", "--wait"]).done();
    }
    assert_eq!(echo.end(), (Some(0), String::new()));
}

#[test]
fn a_second_agent_of_the_same_name_is_rejected() {
    let host = Host::new();
    let _echo = host.echo("arm_1");
    for second in [
        &["echo", "arm_1"][..],
        &["send", "--to", "x", "--from", "arm_1"],
    ] {
        let output = host.run(second).failed(1);
        assert!(
            output.starts_with("error: the name \"arm_1\" is already registered by an agent at "),
            "{output}"
        );
        assert!(output.contains("\n help: choose another name"), "{output}");
    }
}

#[test]
fn too_large_content_fails_on_every_route() {
    let host = Host::new();
    let _echo = host.echo("camera");
    // With its envelope, the letter is longer than its content.
    std::fs::write(host.path("large.raw"), vec![0; 1 << 20]).unwrap();
    let send = [
        "--set",
        "transport.shm.max_letter=1MiB",
        "send",
        "--to",
        "camera",
        "--content-file",
        "large.raw",
        "--json",
    ];
    let (json, output) = host.run(&send).failed_json();
    let delivery = &json["deliveries"][0];
    assert_eq!(
        (&delivery["outcome"], &delivery["reason"]),
        (&json!("failed"), &json!("too large"))
    );
    let attempts: Vec<_> = delivery["attempts"].as_array().unwrap().iter().collect();
    assert_eq!(attempts.len(), 2, "{delivery}");
    assert!(
        output.starts_with("error: not delivered: too large\nwhere: \"camera\"\n"),
        "{output}"
    );
    assert!(
        output.contains("transport.shm.max_letter (now 1MiB here)"),
        "{output}"
    );
}

#[test]
fn an_invalid_command_line_has_exit_code_2() {
    let host = Host::new();
    for wrong in [
        &["send"][..],
        &["send", "--to", ""],
        &["send", "--to", "x", "--deadline", "0s"],
        &["send", "--to", "x", "--deadline", "2h"],
        &["send", "--to", "x", "--content", "a", "--content-file", "b"],
        &["send", "--to", "x", "--timeout", "1s"],
        &["send", "--to", "x", "--performative", "a b"],
        &["send", "--to", "x", "--reply-by", "tomorrow"],
        &["send", "--to", "x", "--protocol", "two words"],
        &["send", "--to", "x", "--set", "mts.queue=0"],
        &["echo"],
        &["echo", "arm\n1"],
        &["echo", "arm_1", "--set", "mts.queue=0"],
    ] {
        let output = host.run(wrong).failed(2);
        assert!(output.starts_with("error: "), "{wrong:?}: {output}");
    }
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
}

#[test]
fn no_files_are_left_behind() {
    let host = Host::new();
    let echo = host.echo("arm_1");
    assert!(!host.left_behind().is_empty());
    host.run(&["send", "--to", "arm_1", "--content", "x", "--wait"])
        .done();
    let gateway = host.start(&["up"]);
    assert_eq!(gateway.signal("-INT"), (Some(0), String::new()));
    assert_eq!(echo.signal("-INT"), (Some(0), String::new()));
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
}

#[test]
fn a_signal_during_the_wait_for_a_reply_leaves_no_files() {
    let host = Host::new();
    let echo = host.echo("arm_1");
    // Prints its outcome and waits for a reply that is never sent.
    let waiting = host.start(&[
        "send",
        "--to",
        "arm_1",
        "--performative",
        "failure",
        "--wait",
        "--timeout",
        "1h",
    ]);
    assert_eq!(waiting.ready, "arm_1: delivered via shm");
    let (code, output) = waiting.signal("-TERM");
    assert_eq!(code, Some(1));
    assert!(
        output.starts_with("error: canceled by a signal before the command was done\n"),
        "{output}"
    );
    assert_eq!(echo.signal("-TERM"), (Some(0), String::new()));
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
}

#[test]
fn content_from_an_endless_source_ends_at_the_largest_letter() {
    let host = Host::new();
    let output = host.run(&[
        "send",
        "arm",
        "--content-file",
        "/dev/zero",
        "--set",
        "transport.shm.max_letter=1MiB",
    ]);
    let output = output.failed(1);
    assert!(
        output.starts_with("error: the input has more than 1MiB\nwhere: /dev/zero\n"),
        "{output}"
    );
}

#[test]
fn outcomes_are_in_the_order_of_the_receivers() {
    let host = Host::new();
    let _agents = ["arm_1", "arm_2", "leg"].map(|name| host.echo(name));
    let to = ["--to", "leg", "--to", "nothing", "--to", "arm_.*"];
    let send = [&["send", "--content", "x", "--json"], &to[..]].concat();
    let (json, _) = host.run(&send).failed_json();
    let deliveries = json["deliveries"].as_array().unwrap().iter();
    let receivers: Vec<&str> = deliveries
        .map(|one| one["receiver"].as_str().unwrap())
        .collect();
    assert_eq!(receivers[..2], ["leg", "nothing"]);
    assert!(receivers[2..].iter().all(|it| it.starts_with("arm_")));
}

#[test]
fn a_receiver_whose_process_is_stopped_is_named() {
    let host = Host::new();
    let arm = host.echo("arm");
    arm.send_signal("-STOP");
    let send = ["send", "arm", "hello", "--deadline", "300ms"];
    let (_, error) = host.run(&send).failed_text();
    let stopped = format!("the process {} of arm is stopped", arm.pid());
    assert!(error.contains(&stopped), "{error}");
    assert!(error.contains("the receiver may get it twice"), "{error}");
    let table = host.run(&["agents"]).done();
    let pid = arm.pid();
    assert!(table.contains(&format!("  stopped (pid {pid})")), "{table}");
    assert!(
        table.lines().all(|line| line.chars().count() <= 80),
        "{table}"
    );
    arm.send_signal("-CONT");
}
