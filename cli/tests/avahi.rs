//! Tests with the real Avahi on another host of a test network: `avahi-browse` lists the agents of a
//! gateway with the TXT keys of legacy peers, as long as the agents are registered.
//!
//! The tests need root and the Debian packages avahi-daemon, avahi-utils, dbus, iproute2 and
//! util-linux. If one is missing, the test prints a note and is skipped; in CI it fails.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

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
    isolated("inside_avahi_lists_the_agents", &Avahi::TOOLS);
}

const FIRST: &str = "arm.left@robot.local";
/// Legacy peers replace a dot by a question mark; `avahi-browse` prints it as a decimal escape.
const FIRST_LABEL: &str = r"arm\063left\064robot\063local";
const SECOND: &str = "camera";

#[test]
#[ignore = "is run by the other test in a network namespace"]
fn inside_avahi_lists_the_agents() {
    enter();
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
        "mts.transports=[\"shm\", \"unix\", \"tcp\", \"udt\"]",
        "--set",
        "transport.tcp.listen=[\"10.99.0.1:0\"]",
        "--set",
        "transport.udt.listen=[\"10.99.0.1:0\"]",
        "--set",
        "security.insecure=true",
        "--set",
        "platform.ams=false",
        "--set",
        "platform.df=false",
    ]);
    let first = start_first(&host);
    let second = host.echo(SECOND);
    let shown = wait_for(&[FIRST, SECOND]);
    let agents = host.run(&["agents", "--json"]).done_json();
    let locator = locator(&gateway);

    let arm = &shown[FIRST];
    assert_eq!(arm.label, FIRST_LABEL);
    assert_eq!(
        arm.legacy_values(),
        ["arm", &locator, "left; front", &timestamp(&agents, FIRST)]
    );
    let camera = &shown[SECOND];
    assert_eq!(camera.label, SECOND);
    assert_eq!(
        camera.legacy_values(),
        ["", &locator, "", &timestamp(&agents, SECOND)]
    );

    // One agent stays each time, so the other one disappears by its own goodbye.
    ends(first);
    wait_for(&[SECOND]);
    let _first = start_first(&host);
    wait_for(&[FIRST, SECOND]);
    ends(second);
    wait_for(&[FIRST]);
    // The agent is still registered, but without a gateway no other host can reach it.
    ends(gateway);
    wait_for(&[]);
}

#[test]
fn a_letter_to_a_legacy_peer_waits_until_the_peer_can_find_its_sender() {
    isolated("inside_a_letter_to_a_legacy_peer_waits", &Avahi::TOOLS);
}

#[test]
#[ignore = "is run by the other test in a network namespace"]
fn inside_a_letter_to_a_legacy_peer_waits() {
    enter();
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
        assert!(
            begun.elapsed() < WATCHDOG,
            "the legacy peer is not discovered"
        );
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
    gateway.wait_for_log(&[
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

/// The expected value of the key `LOCATOR`: the locations that legacy peers can use.
fn locator(gateway: &Running) -> String {
    let ready: Value = serde_json::from_str(&gateway.ready).unwrap();
    let locations = ready["locations"].as_array().unwrap();
    let locations: Vec<&str> = locations.iter().filter_map(Value::as_str).collect();
    let of_kind = |kind: &str| {
        let start = format!("{kind}://10.99.0.1:");
        let location = locations.iter().find(|one| one.starts_with(&start));
        let address = location.unwrap().split(['#', ';']).next().unwrap();
        format!("{address} fipa::services::transports::MessageTransport;")
    };
    of_kind("tcp") + &of_kind("udt")
}

/// The registration time of an agent in the format of legacy peers.
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
    /// The values of the keys of legacy peers. All keys are required.
    #[track_caller]
    fn legacy_values(&self) -> [&str; 4] {
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
            "expected exactly {names:?}: {shown:?}"
        );
    }
}

/// Timeout for hanging tests. No step is expected to take this long.
const WATCHDOG: Duration = Duration::from_secs(60);

/// The agents that `avahi-browse` shows, by their exact names.
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
        assert!(
            agents.insert(name, shown).is_none(),
            "duplicate name: {line}"
        );
    }
    agents
}
