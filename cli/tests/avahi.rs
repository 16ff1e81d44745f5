//! With the real Avahi, on another host of a network of its own: `avahi-browse` lists the agents of a
//! gateway with the keys of the peers, for as long as they are there.
//!
//! Needs root, and of Debian the packages avahi-daemon, avahi-utils, dbus, iproute2 and
//! util-linux. Where they are missing the test says so and is skipped; in CI it fails.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod common;

use std::collections::BTreeMap;
use std::io::Read;
use std::net::TcpListener;
use std::time::{Duration, Instant};

use common::{Host, Running};
use fipa_testbed::{Avahi, Network, enter, isolated};
use serde_json::Value;

#[test]
fn avahi_lists_the_agents() {
    isolated("in_the_namespace", &Avahi::TOOLS);
}

const FIRST: &str = "arm.left@robot.local";
/// A dot is a question mark to the peers; the rest are `avahi-browse`'s decimal escapes.
const FIRST_LABEL: &str = r"arm\063left\064robot\063local";
const SECOND: &str = "camera";

#[test]
#[ignore = "is run by the other test in a network namespace"]
fn in_the_namespace() {
    enter();
    fipa_testbed::run("mount -t tmpfs tmpfs /dev/shm");
    let network = Network::new(2);
    let avahi = Avahi::start(network.host(1));
    network.host(0).enter(|| agents_come_and_go(&avahi));
}

fn agents_come_and_go(avahi: &Avahi<'_>) {
    let wait_for = |names: &[&str]| wait_for(avahi, names);
    let host = Host::new();
    let gateway = host.start(&[
        "up",
        "--json",
        "--set",
        "discovery.mdns=true",
        "--set",
        "transport.tcp.listen=[\"10.99.0.1:0\"]",
        "--set",
        "security.insecure=true",
    ]);
    let first = start_first(&host);
    let second = host.echo(SECOND);
    let shown = wait_for(&[FIRST, SECOND]);
    let agents = host.run(&["agents", "--json"]).done_json();
    let locator = locator(&gateway);

    let arm = &shown[FIRST];
    assert_eq!(arm.label, FIRST_LABEL);
    assert_eq!(
        arm.of_the_peers(),
        ["arm", &locator, "left; front", &timestamp(&agents, FIRST)]
    );
    let camera = &shown[SECOND];
    assert_eq!(camera.label, SECOND);
    assert_eq!(
        camera.of_the_peers(),
        ["", &locator, "", &timestamp(&agents, SECOND)]
    );

    // One of them stays each time, so what is seen to go has gone by itself.
    ends(first);
    wait_for(&[SECOND]);
    let _first = start_first(&host);
    wait_for(&[FIRST, SECOND]);
    ends(second);
    wait_for(&[FIRST]);
    // The agent is there still, but nobody on the network could reach it.
    ends(gateway);
    wait_for(&[]);
}

#[test]
fn a_letter_to_a_legacy_peer_waits_for_its_sender_to_be_found() {
    isolated("in_the_namespace_with_a_legacy_peer", &Avahi::TOOLS);
}

#[test]
#[ignore = "is run by the other test in a network namespace"]
fn in_the_namespace_with_a_legacy_peer() {
    enter();
    fipa_testbed::run("mount -t tmpfs tmpfs /dev/shm");
    let network = Network::new(2);
    let avahi = Avahi::start(network.host(1));
    let peer = network
        .host(1)
        .enter(|| TcpListener::bind("10.99.0.2:0").unwrap());
    let signature = "fipa::services::transports::MessageTransport";
    let locator = format!("LOCATOR=tcp://{} {signature};", peer.local_addr().unwrap());
    let _cpp = avahi.publish(
        "cpp",
        "_fipa_service_directory._udp",
        0,
        &["TYPE=cpp", &locator, "DESCRIPTION="],
    );
    network.host(0).enter(|| a_letter_waits(&peer));
}

fn a_letter_waits(peer: &TcpListener) {
    let host = Host::new();
    let mut gateway = host.start(&[
        "up",
        "-v",
        "--set",
        "discovery.mdns=true",
        "--set",
        "transport.tcp.listen=[\"10.99.0.1:0\"]",
        "--set",
        "security.insecure=true",
    ]);
    let begun = Instant::now();
    while !host.run(&["agents"]).done().contains("cpp") {
        assert!(begun.elapsed() < WATCHDOG, "the legacy peer is not found");
    }
    let before = Instant::now();
    let mut command = host.command(&["send", "--to", "cpp", "--content", "hello"]);
    let mut sending = command.spawn().unwrap();
    let (mut stream, _) = peer.accept().unwrap();
    let waited = before.elapsed();
    let mut letter = Vec::new();
    stream.read_to_end(&mut letter).unwrap();
    drop(stream);
    assert!(sending.wait().unwrap().success());
    assert!(letter.windows(5).any(|bytes| bytes == b"hello"));
    assert!(waited >= Duration::from_millis(1500), "{waited:?}");
    gateway.tells(&[
        "letters wait until the legacy peer has found their sender",
        "cpp",
    ]);
}

fn start_first(host: &Host) -> Running {
    let echo = ["echo", FIRST];
    let about_it = ["--type", "arm", "--description", "left; front"];
    host.start(&[echo.as_slice(), &about_it].concat())
}

#[track_caller]
fn ends(running: Running) {
    assert_eq!(running.signal("-INT"), (Some(0), String::new()));
}

/// What the peers have to read about where the gateway listens.
fn locator(gateway: &Running) -> String {
    let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
    let locations = ready["locations"].as_array().unwrap();
    let mut locations = locations.iter().filter_map(Value::as_str);
    let location = locations.find(|one| one.starts_with("tcp://10.99.0.1:"));
    let address = location.unwrap().split('#').next().unwrap();
    format!("{address} fipa::services::transports::MessageTransport;")
}

/// When the agent was registered, as the peers write it.
fn timestamp(agents: &Value, name: &str) -> String {
    let agents = agents["agents"].as_array().unwrap();
    let agent = agents.iter().find(|agent| agent["name"] == name).unwrap();
    let time = agent["registered"].as_str().unwrap();
    let (date, time) = time.split_once('T').unwrap();
    let (seconds, millis) = time.trim_end_matches('Z').split_once('.').unwrap();
    format!("{}-{seconds}:{millis:0<6}", date.replace('-', ""))
}

/// An agent as `avahi-browse` shows it.
#[derive(Debug)]
struct Shown {
    label: String,
    txt: Vec<String>,
}

impl Shown {
    /// The values of the keys that the peers know, all of which have to be there.
    #[track_caller]
    fn of_the_peers(&self) -> [&str; 4] {
        ["TYPE", "LOCATOR", "DESCRIPTION", "TIMESTAMP"].map(|key| {
            let value = self.value(key);
            value.unwrap_or_else(|| panic!("no {key} in {self:?}"))
        })
    }

    fn value(&self, key: &str) -> Option<&str> {
        let mut pairs = self.txt.iter().filter_map(|text| text.split_once('='));
        pairs.find_map(|(found, value)| (found == key).then_some(value))
    }
}

/// Waits until `avahi-browse` shows these agents and no other.
#[track_caller]
fn wait_for(avahi: &Avahi<'_>, names: &[&str]) -> BTreeMap<String, Shown> {
    let start = Instant::now();
    loop {
        let shown = browse(avahi);
        if shown.keys().eq(names) {
            return shown;
        }
        assert!(
            start.elapsed() < WATCHDOG,
            "never just {names:?}: {shown:?}"
        );
    }
}

/// Ends a test that hangs; nothing is expected to take this long.
const WATCHDOG: Duration = Duration::from_secs(60);

/// What `avahi-browse` shows, by the exact name.
fn browse(avahi: &Avahi<'_>) -> BTreeMap<String, Shown> {
    let mut agents = BTreeMap::new();
    for line in avahi.browse("_fipa_service_directory._udp") {
        // =;interface;protocol;label;type;domain;host;address;port;"key=value" ...
        let fields: Vec<&str> = line.splitn(10, ';').collect();
        let &["=", "eth0", "IPv4", label, .., txt] = &fields[..] else {
            continue;
        };
        let txt = txt.trim_matches('"').split("\" \"");
        let shown = Shown {
            label: label.to_owned(),
            txt: txt.map(str::to_owned).collect(),
        };
        let name = shown.value("fipa-name").unwrap().to_owned();
        assert!(agents.insert(name, shown).is_none(), "twice: {line}");
    }
    agents
}
