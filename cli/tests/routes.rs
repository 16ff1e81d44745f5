//! `fipa routes` in processes of its own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use common::Host;
use serde_json::{Value, json};

#[test]
fn routes_of_processes_and_of_the_gateway_are_shown() {
    let host = Host::new();
    let empty = host.run(&["routes"]).done();
    assert!(empty.starts_with("no agent is known in domain "), "{empty}");
    let _arm = host.echo("arm_1");
    let _camera = host.echo("camera");
    let alone = host.run(&["routes", "--json"]).done_json();
    assert_eq!(alone["gateway"], Value::Null);
    let routes = alone["process"]["routes"].as_array().unwrap();
    let names: Vec<&Value> = routes.iter().map(|route| &route["receiver"]).collect();
    assert_eq!(names, [&json!("arm_1"), &json!("camera")]);
    for way in routes[0]["ways"].as_array().unwrap() {
        assert_eq!(way["standing"], json!({ "standing": "ready" }));
    }
    let first = routes[0]["ways"][0]["location"].as_str().unwrap();
    assert!(first.starts_with("shm://"), "{first}");

    // The process has an exception in its configuration; the gateway has none.
    let exception = "routes={ \"arm_.*\" = [\"unix\"] }";
    let peer = "discovery.static={ crex = [\"tcp://127.0.0.1:9\"] }";
    let _gateway = host.start(&["up", "--set", "mts.name=sherpa", "--set", peer]);
    let output = host.run(&["routes", "arm_1", "--json", "--set", exception]);
    let output = output.done_json();
    let route = &output["process"]["routes"][0];
    assert_eq!(route["exception"], "arm_.*");
    let ways = route["ways"].as_array().unwrap();
    let location = |way: &Value| way["location"].as_str().unwrap().to_owned();
    assert!(location(&ways[0]).starts_with("unix://"), "{ways:?}");
    let standing = |way: &Value| way["standing"]["standing"].clone();
    assert_eq!(standing(ways.last().unwrap()), "not_in_order");
    let gateway = &output["gateway"];
    assert_eq!(gateway["mts"], "sherpa");
    assert_eq!(gateway["routes"].as_array().unwrap().len(), 1);
    assert_eq!(gateway["routes"][0]["exception"], Value::Null);
    assert_eq!(gateway["peers"][0]["name"], "crex");

    let table = host.run(&["routes"]).done();
    assert!(table.starts_with("TO "), "{table}");
    assert!(!table.contains("fipa-routes-"), "{table}");
    assert!(table.contains("Gateway sherpa:"), "{table}");
    assert!(table.contains("listening on "), "{table}");
    assert!(table.contains("static peer crex: "), "{table}");
}

#[test]
fn a_receiver_whose_process_is_stopped_is_named() {
    let host = Host::new();
    let arm = host.echo("arm");
    let _camera = host.echo("camera");
    assert_eq!(
        host.run(&["routes", "--json"]).done_json()["stopped"],
        json!([])
    );
    arm.send_signal("-STOP");
    let pid = arm.pid();
    let routes = host.run(&["routes"]).done();
    let lines = |name: &str| {
        let mut lines = routes.lines().filter(|line| line.starts_with(name));
        lines.next().unwrap().to_owned()
    };
    let status = format!("first, but process {pid} is stopped");
    assert!(lines("arm ").ends_with(&status), "{routes}");
    assert!(lines("camera ").ends_with("first, ready"), "{routes}");
    let stopped = format!(
        "the process {pid} of arm is stopped, by SIGSTOP, Ctrl-Z or a debugger; continue it: `kill -CONT {pid}`"
    );
    assert_eq!(routes.matches(&stopped).count(), 1, "{routes}");
    let in_json = host.run(&["routes", "arm", "--json"]).done_json();
    assert_eq!(
        in_json["stopped"],
        json!([{ "receiver": "arm", "process": pid }])
    );
    arm.send_signal("-CONT");
}

#[test]
fn an_invalid_pattern_is_rejected() {
    let host = Host::new();
    let output = host.run(&["routes", "arm_("]).failed(2);
    assert!(output.contains("regular expression"), "{output}");
}

#[test]
fn a_route_applies_to_a_receiver_on_the_same_host() {
    let host = Host::new();
    let tcp = "routes={ arm_1 = [\"tcp\"], \"crex_.*\" = [\"tcp\"] }";
    let processes = "transport.tcp.processes=true";
    let arm = host.start(&["echo", "arm_1", "--set", processes]);
    let send = ["send", "arm_1", "hello", "--json", "--set", tcp];
    let sent = host.run(&[&send, &["--set", processes][..]].concat());
    let sent = sent.done_json();
    assert_eq!(sent["deliveries"][0]["via"], "tcp", "{sent}");
    let table = host.run(&["routes", "--set", processes, "--set", tcp]);
    let table = table.done();
    let reason = "not used: transport not listed in routes.\"arm_1\"";
    assert!(table.contains(reason), "{table}");

    // Without ports of processes, the route leads nowhere: the letter takes no other transport.
    let (failed, _) = host.run(&send).failed_json();
    let delivery = &failed["deliveries"][0];
    assert_eq!(delivery["reason"], "unreachable", "{failed}");
    let table = host.run(&["routes", "--set", tcp]).done();
    let reason = "not used: transport.tcp.processes is false, so only the gateway uses tcp";
    assert!(table.contains(reason), "{table}");
    let table = host.run(&["routes", "--set", "mts.transports=shm,unix"]);
    let table = table.done();
    let reason = "not used: transport not listed in mts.transports";
    assert!(table.contains(reason), "{table}");
    drop(arm);
}
