//! `fipa df` and `fipa ams` in processes of their own, with a gateway.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use common::{Host, Running};
use fipa_testbed::{Network, enter, isolated};
use serde_json::{Value, json};

fn next_json(running: &mut Running) -> Value {
    serde_json::from_str(&running.line()).unwrap()
}

#[test]
fn services_are_registered_found_and_watched() {
    let host = Host::new();
    let alone = host.run(&["df", "search"]).failed(1);
    assert!(
        alone.contains("no directory facilitator is registered"),
        "{alone}"
    );
    let _gateway = host.start(&["--set", "mts.name=robot", "up"]);
    let none = host.run(&["df", "search"]).done();
    assert_eq!(none, "df@robot knows no such service\n");
    let mut watching = host.start(&["df", "watch", "--type", "lifting", "--json"]);
    let expected = json!({ "event": "watching", "df": "df@robot" });
    assert_eq!(
        serde_json::from_str::<Value>(&watching.ready).unwrap(),
        expected
    );
    let crane = host.start(&[
        "df",
        "register",
        "crane",
        "lifting",
        "--service",
        "lift-1",
        "--property",
        "load=5 t",
    ]);
    assert_eq!(
        crane.ready,
        "agent crane offers lifting at df@robot; press Ctrl-C to stop"
    );
    let changed = next_json(&mut watching);
    assert_eq!(changed["event"], "changed");
    assert_eq!(changed["agent"]["services"][0]["name"], "lift-1");
    for filter in [
        &["--type", "Lifting"][..],
        &["--service", "lift-1"],
        &["--agent", "crane"],
        &["--property", "load=5 t"],
        &["--df", "df@robot"],
    ] {
        let found = host.run(&[&["df", "search", "--json"], filter].concat());
        let found = found.done_json();
        assert_eq!(found["df"], "df@robot");
        assert_eq!(found["agents"][0]["name"], "crane", "{filter:?}");
        let properties = &found["agents"][0]["services"][0]["properties"];
        assert_eq!(*properties, json!({ "load": "\"5 t\"" }));
    }
    for filter in [["--type", "towing"], ["--property", "load=6 t"]] {
        let found = host.run(&[&["df", "search", "--json"], &filter[..]].concat());
        assert_eq!(found.done_json()["agents"], json!([]), "{filter:?}");
    }
    let towing = ["df", "register", "tug", "towing", "--property", "load=5"];
    let more = ["--property", "b=true", "--property", "speed=0.5"];
    let string = ["--property", "model=\"5\""];
    let _tug = host.start(&[&towing[..], &more, &string].concat());
    for (filter, is_found) in [
        ("load=5", true),
        ("load=+5", true),
        ("load=\"5\"", false),
        ("load=5.0", false),
        ("b=true", true),
        ("b=\"true\"", false),
        ("b=false", false),
        ("speed=.5", true),
        ("model=\"5\"", true),
        ("model=5", false),
    ] {
        let found = host.run(&["df", "search", "--json", "--property", filter]);
        let found = found.done_json();
        let agents = found["agents"].as_array().unwrap();
        assert_eq!(agents.len(), usize::from(is_found), "{filter}");
        let values = json!({ "load": "5", "b": "true", "speed": "0.5", "model": "\"5\"" });
        for agent in agents {
            assert_eq!(agent["services"][0]["properties"], values);
        }
    }
    let unended = ["df", "search", "--property", "model=\"5"];
    let refused = host.run(&unended).failed(2);
    assert!(refused.contains("quotation mark"), "{refused}");
    let table = host.run(&["df", "search"]).done();
    assert!(
        table.contains("crane") && table.contains("load=\"5 t\""),
        "{table}"
    );
    assert_eq!(crane.signal("-INT"), (Some(0), String::new()));
    let expected = json!({ "event": "left", "name": "crane" });
    assert_eq!(next_json(&mut watching), expected);
    assert_eq!(watching.signal("-INT"), (Some(0), String::new()));
    let unknown = host.run(&["df", "search", "--df", "df@nowhere"]).failed(1);
    assert!(unknown.contains("df@nowhere"), "{unknown}");
}

/// The services of a host are found on another host, and end there with their agent and with their
/// gateway, whether these end or are killed.
#[test]
fn services_of_another_host_are_found_and_watched_until_they_end() {
    let (near, far) = (Host::new(), Host::new());
    let gateway = far.start(&["--set", "mts.name=far", "up", "--json"]);
    let address = gateway.tcp_address();
    let peer = format!("discovery.static={{ far = [\"tcp://{address}\"] }}");
    let _gateway = near.start(&["--set", "mts.name=near", "--set", &peer, "up"]);
    let mut watching = near.start(&["df", "watch", "--type", "lifting", "--json"]);
    let crane =
        |service: &str| far.start(&["df", "register", "crane", "lifting", "--service", service]);
    let departure = json!({ "event": "left", "name": "crane" });
    for (service, signal) in [("lift-1", "-INT"), ("lift-2", "-KILL")] {
        let crane = crane(service);
        let changed = next_json(&mut watching);
        assert_eq!(changed["agent"]["name"], "crane");
        assert_eq!(changed["agent"]["services"][0]["name"], service);
        let found = near.run(&["df", "search", "--type", "lifting", "--json"]);
        let found = found.done_json();
        assert_eq!(found["df"], "df@near");
        assert_eq!(found["agents"], json!([changed["agent"]]));
        crane.signal(signal);
        assert_eq!(next_json(&mut watching), departure);
        let found = near.run(&["df", "search", "--json"]).done_json();
        assert_eq!(found["agents"], json!([]));
    }
    let _crane = crane("lift-3");
    assert_eq!(next_json(&mut watching)["event"], "changed");
    gateway.signal("-KILL");
    assert_eq!(next_json(&mut watching), departure);
    let found = near.run(&["df", "search", "--json"]).done_json();
    assert_eq!(found["agents"], json!([]));
}

/// A gateway with services connects with gateways that it knows by mDNS only.
#[test]
fn services_of_a_host_found_by_mdns_are_found() {
    isolated("inside_services_of_a_host_found_by_mdns_are_found", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_services_of_a_host_found_by_mdns_are_found() {
    enter();
    let network = Network::new(2);
    let start = |index: usize, name: &str| {
        let (host, net) = (Host::new(), network.host(index));
        let (name, listen) = (
            format!("mts.name={name}"),
            format!("transport.tcp.listen=[\"{}:0\"]", net.ipv4()),
        );
        let set = [
            "--set",
            "discovery.mdns=true",
            "--set",
            "security.insecure=true",
            "--set",
            &name,
            "--set",
            &listen,
            "up",
        ];
        let gateway = net.enter(|| host.start(&set));
        (host, gateway)
    };
    let (near, _near_gateway) = start(0, "near");
    let (far, far_gateway) = start(1, "far");
    let mut watching = network
        .host(0)
        .enter(|| near.start(&["df", "watch", "--json"]));
    let _crane = network
        .host(1)
        .enter(|| far.start(&["df", "register", "crane", "lifting"]));
    let changed = next_json(&mut watching);
    assert_eq!(changed["agent"]["name"], "crane");
    far_gateway.signal("-INT");
    let expected = json!({ "event": "left", "name": "crane" });
    assert_eq!(next_json(&mut watching), expected);
}

#[test]
fn the_agents_of_a_platform_are_listed() {
    let host = Host::new();
    let alone = host.run(&["ams"]).failed(1);
    assert!(alone.contains("no agent management system"), "{alone}");
    let gateway = host.start(&["--set", "mts.name=robot", "up", "--json"]);
    let _parrot = host.echo("parrot");
    let listed = host.run(&["ams", "--json"]).done_json();
    assert_eq!(listed["ams"], "ams@robot");
    assert_eq!(listed["platform"]["name"], "robot");
    let address = format!("tcp://{}", gateway.tcp_address());
    assert_eq!(listed["platform"]["services"], json!({ "tcp": [address] }));
    let expected = json!([
        { "name": "ams@robot", "ownership": null, "state": "active" },
        { "name": "df@robot", "ownership": null, "state": "active" },
        { "name": "parrot", "ownership": null, "state": "active" },
    ]);
    assert_eq!(listed["agents"], expected);
    let table = host.run(&["ams", "--agent", "parrot"]).done();
    assert!(
        table.starts_with("platform robot of ams@robot\n"),
        "{table}"
    );
    assert!(
        table.contains("parrot") && !table.contains("df@robot"),
        "{table}"
    );
    let none = host
        .run(&["ams", "--state", "waiting", "--json"])
        .done_json();
    assert_eq!(none["agents"], json!([]));
    let wrong = host.run(&["ams", "--state", "dead"]).failed(2);
    assert!(wrong.contains("suspended"), "{wrong}");
}

#[test]
fn watch_formats_content_in_sl() {
    let host = Host::new();
    let _gateway = host.start(&["--set", "mts.name=robot", "up"]);
    let mut watching = host.start(&["watch", "--agent", "df@robot", "--content=4000"]);
    let _ = watching.line();
    host.run(&["df", "search", "--type", "lifting"]).done();
    let mut lines = Vec::new();
    while !lines.iter().any(|line: &String| line.contains("((result")) {
        lines.push(watching.line());
    }
    // A list of more than 80 bytes has several lines.
    let all = lines.join("\n");
    let request = lines
        .iter()
        .position(|line| line.trim_start().starts_with("((action"));
    let request = request.unwrap_or_else(|| panic!("{all}"));
    assert!(lines[request + 1].starts_with("     "), "{all}");
    assert!(!lines[request].contains("df-agent-description"), "{all}");
    drop(watching);
}
