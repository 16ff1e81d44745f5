//! With the real Avahi, in a network namespace of its own: `avahi-browse` lists the agents of a
//! gateway with the keys of the peers, for as long as they are there.
//!
//! Needs root, and of Debian the packages avahi-daemon, avahi-utils, dbus, iproute2 and
//! util-linux. Where they are missing the test says so and is skipped; in CI it fails.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use common::{Host, Running};
use serde_json::Value;

const TOOLS: [&str; 6] = [
    "avahi-daemon",
    "avahi-browse",
    "dbus-daemon",
    "ip",
    "mount",
    "unshare",
];

#[test]
fn avahi_lists_the_agents() {
    let mut missing: Vec<&str> = TOOLS.into_iter().filter(|tool| !is_there(tool)).collect();
    if fs::metadata("/proc/self").unwrap().uid() != 0 {
        missing.push("root");
    }
    if !missing.is_empty() {
        let missing = missing.join(", ");
        assert!(
            std::env::var("CI").as_deref() != Ok("true"),
            "missing: {missing}"
        );
        eprintln!("SKIPPED, not a success: the test with Avahi needs {missing}");
        return;
    }
    // What is started in there ends with it, and what is mounted and set up is gone.
    let inside = Command::new("unshare")
        .args(["--net", "--mount", "--pid", "--fork", "--kill-child"])
        .args(["--mount-proc", "--"])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", "in_the_namespace", "--ignored", "--nocapture"])
        .env(INSIDE, "1")
        .env("TMPDIR", "/run")
        .output()
        .unwrap();
    assert!(
        inside.status.success(),
        "{}{}",
        String::from_utf8_lossy(&inside.stdout),
        String::from_utf8_lossy(&inside.stderr)
    );
}

const INSIDE: &str = "FIPA_CLI_TEST_IN_NAMESPACE";

fn is_there(tool: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|dir| dir.join(tool).is_file())
}

const FIRST: &str = "arm.left@robot.local";
/// A dot is a question mark to the peers; the rest are `avahi-browse`'s decimal escapes.
const FIRST_LABEL: &str = r"arm\063left\064robot\063local";
const SECOND: &str = "camera";

#[test]
#[ignore = "is run by the other test in a network namespace"]
fn in_the_namespace() {
    assert!(
        std::env::var_os(INSIDE).is_some(),
        "started by the other test"
    );
    let _daemons = start_avahi();
    let host = Host::new();
    let gateway = host.start(&[
        "up",
        "--json",
        "--set",
        "discovery.mdns=true",
        "--set",
        "transport.tcp.listen=[\"10.99.0.1:0\"]",
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
fn wait_for(names: &[&str]) -> BTreeMap<String, Shown> {
    let start = Instant::now();
    loop {
        let shown = browse();
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
fn browse() -> BTreeMap<String, Shown> {
    let output = Command::new("avahi-browse")
        .args(["-rpt", "_fipa_service_directory._udp"])
        .env(BUS_VARIABLE, BUS)
        .stderr(Stdio::inherit())
        .output()
        .unwrap();
    // It may have failed, and then an empty list means nothing.
    assert!(output.status.success(), "{}", output.status);
    let mut agents = BTreeMap::new();
    for line in String::from_utf8(output.stdout).unwrap().lines() {
        // =;interface;protocol;label;type;domain;host;address;port;"key=value" ...
        let fields: Vec<&str> = line.splitn(10, ';').collect();
        let &["=", "fipa0", "IPv4", label, .., txt] = &fields[..] else {
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

const BUS_CONFIG: &str = r#"<!DOCTYPE busconfig PUBLIC
 "-//freedesktop//DTD D-Bus Bus Configuration 1.0//EN"
 "http://www.freedesktop.org/standards/dbus/1.0/busconfig.dtd">
<busconfig><type>system</type><listen>unix:path=/run/fipa-test-bus</listen>
<auth>EXTERNAL</auth><policy context="default"><allow user="*"/><allow own="*"/>
<allow send_destination="*"/><allow receive_sender="*"/></policy></busconfig>"#;

const AVAHI_CONFIG: &str = "[server]\nhost-name=peer\nallow-interfaces=fipa0\nuse-ipv6=no\n\
[publish]\npublish-workstation=no\n";

const BUS_VARIABLE: &str = "DBUS_SYSTEM_BUS_ADDRESS";
const BUS: &str = "unix:path=/run/fipa-test-bus";

/// A process that ends with the test.
struct Daemon(Child);

impl Daemon {
    fn start(program: &str, arguments: &[&str]) -> Self {
        let mut command = Command::new(program);
        Self(
            command
                .args(arguments)
                .env(BUS_VARIABLE, BUS)
                .spawn()
                .unwrap(),
        )
    }

    #[track_caller]
    fn wait_until(&mut self, ready: impl Fn() -> bool) {
        let start = Instant::now();
        while !ready() {
            assert_eq!(self.0.try_wait().unwrap(), None, "it has ended");
            assert!(start.elapsed() < WATCHDOG, "it was never ready");
            thread::sleep(Duration::from_millis(5));
        }
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Avahi, and before it the bus on which its tools find it.
fn start_avahi() -> [Daemon; 2] {
    // Avahi keeps its process number and socket in /run, and takes no loopback interface.
    run("mount -t tmpfs tmpfs /run");
    run("mount -t tmpfs tmpfs /dev/shm");
    run("ip link set lo up");
    run("ip link add fipa0 type veth peer name fipa1");
    run("ip addr add 10.99.0.1/24 dev fipa0");
    run("ip link set fipa0 up");
    run("ip link set fipa1 up");
    fs::write("/run/bus.conf", BUS_CONFIG).unwrap();
    fs::write("/run/avahi.conf", AVAHI_CONFIG).unwrap();
    let mut bus = Daemon::start("dbus-daemon", &["--config-file=/run/bus.conf", "--nofork"]);
    bus.wait_until(|| Path::new("/run/fipa-test-bus").exists());
    let mut avahi = Daemon::start(
        "avahi-daemon",
        &[
            "--no-drop-root",
            "--no-chroot",
            "--no-rlimits",
            "--file=/run/avahi.conf",
        ],
    );
    // Its tools find it on the bus, where it comes some time after it has begun to run.
    avahi.wait_until(|| {
        let browse = Command::new("avahi-browse")
            .args(["-t", "_fipa_service_directory._udp"])
            .env(BUS_VARIABLE, BUS)
            .stderr(Stdio::null())
            .status();
        browse.unwrap().success()
    });
    [avahi, bus]
}

fn run(command: &str) {
    let mut words = command.split(' ');
    let status = Command::new(words.next().unwrap()).args(words).status();
    assert!(status.unwrap().success(), "{command}");
}
