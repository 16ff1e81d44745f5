//! `fipa reload` and SIGHUP: changes of the configuration of running processes.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::process::Stdio;

use common::{Host, Ran, Running};
use serde_json::{Value, json};

const FILE: &str = "robot.toml";

/// Starts a command with the configuration file.
fn start(host: &Host, arguments: &[&str]) -> Running {
    host.start(&[arguments, &["--config", FILE]].concat())
}

fn write(host: &Host, text: &str) {
    std::fs::write(host.path(FILE), text).unwrap();
}

fn send(host: &Host) -> Ran {
    host.run(&["send", "arm_1", "hello", "--json", "--config", FILE])
}

/// Sends a message to arm_1, and returns the transport that delivered it.
fn sent_via(host: &Host) -> Value {
    send(host).done_json()["deliveries"][0]["via"].take()
}

/// Sends a message to arm_1 that is not delivered, and returns the reason.
fn sent_in_vain(host: &Host) -> Value {
    let (mut json, _) = send(host).failed_json();
    json["deliveries"][0]["reason"].take()
}

/// Returns the answers to `fipa reload`, without the names of processes.
fn reload(host: &Host) -> Vec<Value> {
    let json = host
        .run(&["reload", "--json", "--config", FILE])
        .done_json();
    let mut all = json["processes"].as_array().unwrap().clone();
    for process in &mut all {
        process.as_object_mut().unwrap().remove("name").unwrap();
    }
    all
}

#[test]
fn reload_changes_the_routes_and_rules_of_running_processes() {
    let host = Host::new();
    write(&host, "[mts]\nname = \"sherpa\"\n");
    let _gateway = start(&host, &["up"]);
    let _arm = start(&host, &["echo", "arm_1"]);
    let mut ping = start(&host, &["ping", "arm_1", "--json", "--interval", "20ms"]);
    let mut ping_via = |via: &str| {
        while serde_json::from_str::<Value>(&ping.line()).unwrap()["via"] != via {}
    };
    ping_via("shm");

    let text = "[mts]\nname = \"other\"\nqueue = 7\n[routes]\narm_1 = [\"unix\"]\n";
    write(&host, text);
    let process = json!({
        "gateway": false, "result": "reloaded", "applied": ["routes"], "later": ["mts.queue"],
    });
    let gateway = json!({
        "gateway": true, "result": "reloaded", "applied": ["routes"], "later": ["mts.name", "mts.queue"],
    });
    assert_eq!(reload(&host), [gateway, process.clone(), process]);
    ping_via("unix");

    // The receiver's process applies the rule.
    write(
        &host,
        &format!("{text}[access]\ndeny = {{ \".*\" = [\"arm_1\"] }}\n"),
    );
    for process in reload(&host) {
        assert_eq!(process["applied"], json!(["access.deny"]));
    }
    assert_eq!(sent_in_vain(&host), "refused");
    write(&host, text);
    let _ = reload(&host);
    assert_eq!(sent_via(&host), "unix");

    write(&host, "[mts]\nqueue = 0\n");
    let mistaken = host.run(&["reload", "--config", FILE]).failed(2);
    assert!(mistaken.contains("robot.toml:2"), "{mistaken}");
    // This command reads no file, so only the processes read the mistake.
    let (json, _) = host.run(&["reload", "--json"]).failed_json();
    assert_eq!(json["processes"][0]["result"], "refused", "{json}");
    let error = json["processes"][0]["error"].as_str().unwrap();
    assert!(error.contains("robot.toml:2"), "{error}");
    ping_via("unix");
}

#[test]
fn reload_names_processes_that_do_not_follow() {
    let host = Host::new();
    let none = host.run(&["reload"]).done();
    assert!(none.starts_with("no process of domain "), "{none}");
    let _agent = host.ordered_agent("agent", &[]);
    let line = host.run(&["reload"]).done();
    assert!(line.contains("does not follow its configuration"), "{line}");
}

#[test]
fn sighup_reloads_a_command() {
    let host = Host::new();
    write(&host, "");
    let arm = start(&host, &["echo", "arm_1"]);
    let mut ping = start(&host, &["ping", "arm_1", "--json", "--interval", "20ms"]);
    write(&host, "[routes]\narm_1 = [\"unix\"]\n");
    ping.send_signal("-HUP");
    while serde_json::from_str::<Value>(&ping.line()).unwrap()["via"] != "unix" {}
    arm.send_signal("-HUP");
    assert_eq!(sent_via(&host), "unix");
    assert_eq!(arm.signal("-INT").0, Some(0));
}

#[test]
fn a_command_ends_when_its_terminal_is_closed() {
    let host = Host::new();
    let echo = host.command(&["echo", "arm_1"]);
    let words = [echo.get_program()].into_iter().chain(echo.get_args());
    let words: Vec<String> = words
        .map(|word| format!("'{}'", word.to_str().unwrap()))
        .collect();
    let mut script = std::process::Command::new("script");
    script.args([
        "-q",
        "-c",
        &format!("exec {}", words.join(" ")),
        "/dev/null",
    ]);
    script.current_dir(host.path("")).stdin(Stdio::piped());
    script.env_clear().envs(
        echo.get_envs()
            .filter_map(|(name, value)| Some((name, value?))),
    );
    script.env("PATH", std::env::var_os("PATH").unwrap_or_default());
    let mut terminal = Running::new(script);
    let agents = || host.run(&["agents"]).done();
    assert!(agents().contains("arm_1"), "{}", terminal.ready);
    terminal.send_signal("-KILL");
    let _ = terminal.end();
    while agents().contains("arm_1") {}
}
