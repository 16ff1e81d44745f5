//! `fipa up` and `fipa agents` in processes of their own.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod common;

use std::net::TcpListener;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use common::{Host, Ran, Running};
use fipa_testbed::until;
use serde_json::{Value, json};

#[test]
fn the_gateway_prints_its_name_and_locations() {
    let host = Host::new();
    let gateway = host.start(&["up", "--json", "--set", "mts.name=sherpa"]);
    let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
    assert_eq!(
        (&ready["name"], &ready["domain"]),
        (&json!("sherpa"), &json!(host.domain))
    );
    assert_eq!(ready["discovery"], json!({ "mdns": false }));
    let locations = ready["locations"].as_array().unwrap();
    assert!(
        locations
            .iter()
            .any(|one| one.as_str().unwrap().starts_with("tcp://127.0.0.1:"))
    );
    let listed = host.run(&["agents", "--json"]).done_json();
    assert_eq!(listed["gateway"], "sherpa");
    let agents = listed["agents"].as_array().unwrap();
    let entry = agents.iter().find(|it| it["name"] == "sherpa").unwrap();
    assert_eq!(entry["role"], json!("gateway"));
    for (name, agent_type) in [("ams@sherpa", "fipa-ams"), ("df@sherpa", "fipa-df")] {
        let agent = agents.iter().find(|it| it["name"] == name).unwrap();
        assert_eq!(agent["type"], agent_type);
        assert_eq!(agent["mts"]["name"], "sherpa");
    }
    assert_eq!(entry["incarnation"], ready["incarnation"]);
    assert_eq!(entry["locations"], ready["locations"]);
    assert_eq!(gateway.signal("-TERM"), (Some(0), String::new()));
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
}

#[test]
fn agents_that_join_and_leave_are_logged() {
    let host = Host::new();
    let _before = host.echo("arm_1");
    let mut gateway = host.start(&["up", "-v", "--json"]);
    gateway.wait_for_log(&["INFO", "present", "arm_1"]);
    let echo = host.echo("arm_2");
    gateway.wait_for_log(&["INFO", "joined", "arm_2"]);
    assert_eq!(echo.signal("-INT"), (Some(0), String::new()));
    gateway.wait_for_log(&["INFO", "left", "arm_2"]);
    let (code, log) = gateway.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
}

#[test]
fn a_removed_runtime_directory_is_logged_once_and_joined_again() {
    let host = Host::new();
    let mut gateway = host.start(&["up", "--json", "--set", "mts.name=sherpa"]);
    let mut parrot = host.echo("parrot");
    // In one step: files that the processes create again are not removed.
    std::fs::rename(host.path("run"), host.path("removed")).unwrap();
    std::fs::remove_dir_all(host.path("removed")).unwrap();
    for process in [&mut gateway, &mut parrot] {
        process.wait_for_log(&[
            "WARN",
            "another program removed files",
            "joining the domain again",
        ]);
    }
    let watchdog = Instant::now() + Duration::from_secs(60);
    loop {
        let listed = host.run(&["agents", "--json"]).done_json();
        let names = listed["agents"].as_array().unwrap().iter();
        let names: Vec<&str> = names.filter_map(|entry| entry["name"].as_str()).collect();
        if names.contains(&"parrot") && names.contains(&"sherpa") {
            break;
        }
        assert!(Instant::now() < watchdog, "not listed again: {listed}");
    }
    loop {
        let letter = ["send", "--to", "parrot", "--content", "hello"];
        let sent = host.run(&letter);
        if sent.code == Some(0) {
            break;
        }
        assert!(Instant::now() < watchdog, "not delivered: {sent:?}");
    }
    for process in [gateway, parrot] {
        let (code, log) = process.signal("-INT");
        assert_eq!(code, Some(0), "{log}");
        assert_eq!(
            log.matches("another program removed files").count(),
            1,
            "{log}"
        );
        assert!(!log.contains("ERROR"), "{log}");
    }
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
}

#[test]
fn processes_meet_in_the_configured_runtime_directory() {
    let host = Host::new();
    let configured = host.path("configured");
    let set = format!("runtime_dir={}", configured.display());
    let command = |arguments: &[&str]| {
        let mut command = host.command(&[&["--set", &set], arguments].concat());
        command.env_remove("FIPA_RUNTIME_DIR");
        command
    };
    let gateway = Running::new(command(&["up", "--json", "--set", "mts.name=sherpa"]));
    let listed = Ran::from(command(&["agents", "--json"]).output().unwrap()).done_json();
    assert_eq!(listed["gateway"], "sherpa");
    assert!(configured.join(&host.domain).is_dir());
    let listed = host.run(&["--set", &set, "agents", "--json"]).done_json();
    assert_eq!(
        listed["gateway"],
        Value::Null,
        "the variable precedes the key"
    );
    let (code, log) = gateway.signal("-INT");
    assert_eq!(code, Some(0), "{log}");
}

#[test]
fn two_gateways_of_one_name_are_reported_on_both_hosts() {
    let (here, there) = (Host::new(), Host::new());
    let named = ["up", "--json", "--set", "mts.name=twin"];
    let mut far = there.start(&named);
    let peer = format!(
        "discovery.static={{ twin = [\"tcp://{}\"] }}",
        far.tcp_address()
    );
    let mut near = here.start(&[&named[..], &["--set", &peer]].concat());
    for gateway in [&mut near, &mut far] {
        gateway.wait_for_log(&["WARN", "has the name of this gateway, twin", "mts.name"]);
    }
    for gateway in [near, far] {
        let (_, log) = gateway.signal("-TERM");
        assert_eq!(
            log.matches("has the name of this gateway").count(),
            1,
            "{log}"
        );
    }
}

#[test]
fn a_port_in_use_is_reported() {
    let host = Host::new();
    let holder = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = holder.local_addr().unwrap();
    let listen = format!("transport.tcp.listen=[\"{address}\"]");
    let output = host.run(&["up", "--set", &listen]).failed(1);
    let expected = format!("error: cannot listen on {address}: Address already in use");
    assert!(output.starts_with(&expected), "{output}");
    assert!(
        output.contains("where: transport.tcp.listen of the configuration\n"),
        "{output}"
    );
    assert!(
        output.matches("choose another port").count() == 1 && output.contains("`ss -lntup`"),
        "{output}"
    );
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
}

#[test]
fn a_second_gateway_of_the_domain_is_rejected() {
    let host = Host::new();
    let _gateway = host.start(&["up", "--set", "mts.name=first"]);
    let output = host.run(&["up", "--set", "mts.name=second"]).failed(1);
    let expected = "error: the domain already has a gateway, \"first\"\n";
    assert!(output.starts_with(expected), "{output}");
}

#[test]
fn an_invalid_configuration_stops_every_command() {
    let host = Host::new();
    std::fs::write(host.path("robot.toml"), "[mts]\nqueue = 0\n").unwrap();
    for command in [
        &["up"][..],
        &["agents"],
        &["echo", "x"],
        &["send", "--to", "x"],
    ] {
        let arguments = [command, &["--config", "robot.toml"]].concat();
        let output = host.run(&arguments).failed(2);
        assert!(output.contains("where: robot.toml:2\n"), "{output}");
    }
    assert_eq!(host.left_behind(), Vec::<PathBuf>::new());
}

#[test]
fn agents_are_listed_and_filtered() {
    let host = Host::new();
    let empty = host.run(&["agents"]).done();
    assert!(empty.starts_with("no agent is known in domain "), "{empty}");
    let _arm = host.start(&[
        "echo",
        "arm_1",
        "--type",
        "arm",
        "--description",
        "left front",
    ]);
    let _camera = host.start(&["echo", "camera", "--type", "eye"]);

    let table = host.run(&["agents"]).done();
    let lines: Vec<&str> = table.lines().collect();
    assert!(
        lines[0].starts_with("NAME    HOST       TYPE  AGE "),
        "{table}"
    );
    assert!(lines[1].starts_with("arm_1   this host  arm   "), "{table}");
    assert!(table.contains("\ncamera  this host  eye   "), "{table}");
    assert!(
        lines
            .iter()
            .all(|line| line.len() <= 80 && !line.contains("://")),
        "{table}"
    );
    let long = host.run(&["agents", "--long"]).done();
    assert!(long.contains("  ready  shm://"), "{long}");

    let listed = host.run(&["agents", "--json"]).done_json();
    assert_eq!(
        (&listed["domain"], &listed["gateway"]),
        (&json!(host.domain), &Value::Null)
    );
    let arm = &listed["agents"][0];
    for (key, value) in [
        ("name", "arm_1"),
        ("type", "arm"),
        ("description", "left front"),
        ("role", "agent"),
        ("reach", "local"),
        ("source", "host"),
    ] {
        assert_eq!(arm[key], value, "{arm}");
    }
    assert!(arm["registered"].as_str().unwrap().ends_with('Z'), "{arm}");
    assert!(
        arm["locations"][0].as_str().unwrap().starts_with("shm://"),
        "{arm}"
    );

    for (search, found) in [
        (&["arm_.*"][..], json!(["arm_1"])),
        (&["arm_1"], json!(["arm_1"])),
        (&["arm"], json!([])),
        (&["--type", "eye"], json!(["camera"])),
        (&[".*", "--type", "arm|eye"], json!(["arm_1", "camera"])),
        (&["--description", "left.*"], json!(["arm_1"])),
        (&["--location", "shm://.*"], json!(["arm_1", "camera"])),
        (&["--location", "udp://.*"], json!([])),
        (&["--local", "--type", "eye"], json!(["camera"])),
        (&["--remote"], json!([])),
    ] {
        let listed = host
            .run(&[&["agents", "--json"], search].concat())
            .done_json();
        let names = listed["agents"].as_array().unwrap().iter();
        let names: Vec<&Value> = names.map(|agent| &agent["name"]).collect();
        assert_eq!(json!(names), found, "{search:?}");
    }
    let output = host.run(&["agents", "arm_["]).failed(2);
    assert!(output.contains("unclosed character class"), "{output}");
}

#[test]
fn agents_that_join_and_leave_are_watched() {
    let host = Host::new();
    let _arm = host.start(&["echo", "arm", "--type", "arm"]);
    let mut watching = host.start(&["agents", "--watch", "--json", "arm.*"]);
    let change = |line: &str| {
        let line: Value = serde_json::from_str(line).unwrap();
        assert!(line["time"].as_str().unwrap().ends_with('Z'), "{line}");
        let name = line["agent"]["name"].as_str().unwrap();
        format!("{} {name}", line["change"].as_str().unwrap())
    };
    assert_eq!(change(&watching.ready), "present arm");
    let _other = host.echo("leg");
    let newcomer = host.echo("arm_2");
    assert_eq!(change(&watching.line()), "joined arm_2");
    assert_eq!(newcomer.signal("-INT"), (Some(0), String::new()));
    assert_eq!(change(&watching.line()), "left arm_2");
    assert_eq!(watching.signal("-INT"), (Some(0), String::new()));

    let mut watching = host.start(&["agents", "-w"]);
    assert!(watching.ready.starts_with("watching domain cli-"));
    let present = watching.line();
    assert!(present.contains("  present  arm (arm)  this host  shm://"));
    assert_eq!(watching.signal("-TERM"), (Some(0), String::new()));
}

#[test]
fn an_agent_on_another_host_is_listed_and_reached() {
    let (here, there) = (Host::new(), Host::new());
    let name = format!("arm-{}", there.domain);
    let mdns = [
        "--set",
        "discovery.mdns=true",
        "--set",
        "discovery.interfaces=[\"lo\"]",
    ];
    let up = |host: &Host| {
        let named = format!("mts.name=mts-{}", host.domain);
        host.start(&[&["up", "-v", "--json", "--set", &named], &mdns[..]].concat())
    };
    let (mut gateway, _other) = (up(&here), up(&there));
    let echo = there.echo(&name);
    gateway.wait_for_log(&["INFO", "joined", &name]);

    // The processes of this host learn of the agent shortly after the gateway.
    let mut listed = Value::Null;
    for _ in 0..600 {
        listed = here.run(&["agents", &name, "--json"]).done_json()["agents"][0].take();
        if !listed.is_null() {
            break;
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    assert_eq!(listed["reach"], "remote", "{listed}");
    assert_eq!(
        listed["gateway"],
        format!("mts-{}", here.domain),
        "{listed}"
    );
    assert_eq!(
        listed["mts"]["name"],
        format!("mts-{}", there.domain),
        "{listed}"
    );
    let table = here.run(&["agents", &name]).done();
    assert!(
        table.contains(&format!("  mts-{}  ", there.domain)) && !table.contains("://"),
        "{table}"
    );

    let sent = here.run(&[
        "send",
        "--to",
        &name,
        "--content",
        "hello",
        "--wait",
        "--json",
    ]);
    let json = sent.done_json();
    assert_eq!(json["deliveries"][0]["via"], "tcp", "{json}");
    assert_eq!(json["reply"]["content"], "hello", "{json}");

    assert_eq!(echo.signal("-INT"), (Some(0), String::new()));
    gateway.wait_for_log(&["INFO", "left", &name]);
}

#[test]
fn a_host_that_is_gone_is_listed_as_lost_and_named_in_outcomes() {
    let (here, there) = (Host::new(), Host::new());
    let other = there.start(&["up", "--json", "--set", "mts.name=crex-mts"]);
    let peer = format!(
        "discovery.static={{ crex-mts = [\"tcp://{}\"] }}",
        other.tcp_address()
    );
    let _gateway = here.start(&["up", "--set", &peer]);
    let name = format!("arm-{}", there.domain);
    let _arm = there.echo(&name);
    // The agents of the other gateway itself are listed first.
    until("the agent is listed", || {
        let table = here.run(&["agents", &name]).done();
        table.contains(&name) && table.contains("  not encrypted")
    });
    assert_eq!(other.signal("-INT").0, Some(0));
    until("the host is lost", || {
        here.run(&["agents"]).done().contains("  lost ")
    });
    let listed = here.run(&["agents", "--json"]).done_json();
    assert_eq!(listed["lost"][0]["name"], "crex-mts", "{listed}");
    for filter in [&["--local"][..], &["--type", "arm"], &["no-such-name"]] {
        let table = here.run(&[&["agents"], filter].concat()).done();
        assert!(!table.contains("lost"), "{table}");
    }
    until("a letter names the host", || {
        let (outcome, error) = here.run(&["send", &name, "hello"]).failed_text();
        outcome.contains("unreachable") && error.contains("its host crex-mts was last seen ")
    });
}

#[test]
fn sighup_reloads_the_configuration() {
    let host = Host::new();
    let file = host.path("robot.toml");
    let port = |number| format!("[transport.tcp]\nlisten = [\"127.0.0.1:{number}\"]\n");
    std::fs::write(&file, port(0)).unwrap();
    let mut gateway = host.start(&["up", "-v", "--json", "--config", "robot.toml"]);
    let _arm = host.echo("arm");
    let peers = || host.run(&["routes", "--json"]).done_json()["gateway"]["peers"].clone();
    assert_eq!(peers(), json!([]));

    let peer = "[discovery.static]\ncrex = [\"tcp://127.0.0.1:9\"]\n";
    std::fs::write(&file, port(1) + peer).unwrap();
    gateway.send_signal("-HUP");
    let started = Instant::now();
    while peers()[0]["name"] != "crex" {
        assert!(started.elapsed().as_secs() < 60, "the new peer is not used");
    }
    gateway.wait_for_log(&["warning", "transport.tcp.listen", "restarted"]);
    // An invalid configuration changes nothing.
    std::fs::write(&file, "[mts]\nqueue = 0\n").unwrap();
    gateway.send_signal("-HUP");
    gateway.wait_for_log(&["robot.toml:2"]);
    assert_eq!(peers()[0]["name"], "crex");
    std::fs::write(&file, port(0)).unwrap();
    gateway.send_signal("-HUP");
    while peers() != json!([]) {
        assert!(started.elapsed().as_secs() < 60, "the peer is still used");
    }
    let (code, log) = gateway.signal("-TERM");
    assert_eq!(code, Some(0), "{log}");
}

/// The test holds the directory lock, as a process does that stops while it joins, registers or leaves.
#[test]
fn a_second_signal_ends_a_command_that_waits_for_the_directory_lock() {
    let host = Host::new();
    let mut echo = host.echo("arm");
    let lock = host.path("run").join(&host.domain).join("directory/lock");
    let lock = std::fs::File::open(lock).unwrap();
    lock.lock().unwrap();
    while !echo.has_ended() {
        echo.send_signal("-INT");
    }
    assert_eq!(echo.end().0, Some(1));
}

#[test]
fn a_program_logs_its_events_at_the_level_info() {
    let host = Host::new();
    let _arm = host.echo("arm_1");
    let mut command = host.command(&["listen", "rover"]);
    command.env("RUST_LOG", "info");
    let mut rover = Running::new(command);
    rover.wait_for_log(&["INFO", "present", "name=arm_1"]);
    let eye = host.echo("eye");
    rover.wait_for_log(&["INFO", "joined", "name=eye"]);
    eye.send_signal("-KILL");
    rover.wait_for_log(&["INFO", "left", "name=eye"]);

    // Without a subscriber for these lines, none is written.
    assert_eq!(rover.signal("-INT").0, Some(0));
    let mut silent = host.start(&["listen", "rover"]);
    let _other = host.echo("other");
    silent.send_signal("-INT");
    assert_eq!(silent.end(), (Some(0), String::new()));
}
