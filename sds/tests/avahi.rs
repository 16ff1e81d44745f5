//! With the real Avahi, in a network namespace of its own: what we announce, `avahi-browse` shows
//! to the peers' taste, and what `avahi-publish` announces, we find.
//!
//! Needs root, and of Debian the packages avahi-daemon, avahi-utils, dbus, iproute2 and
//! util-linux. Where they are missing the test says so and is skipped; in CI it fails.

// The exception that clippy.toml makes for tests does not reach what they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

mod common;

use std::path::Path;
use std::process::{Child, Command, Stdio};

use common::{eventually, registration};
use fipa_sds::{Directory, MdnsConfig, MdnsDirectory, Mts, Source};
use fipa_transport::{Incarnation, Location};

const TOOLS: [&str; 6] = [
    "avahi-daemon",
    "avahi-browse",
    "avahi-publish",
    "dbus-daemon",
    "ip",
    "unshare",
];

#[test]
fn avahi_and_we_read_each_other() {
    let mut missing: Vec<&str> = TOOLS.into_iter().filter(|tool| !is_there(tool)).collect();
    if !rustix::process::geteuid().is_root() {
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
    // What is started in there ends with it: the namespace of processes, too, is its own.
    let status = Command::new("unshare")
        .args(["--net", "--mount", "--pid", "--fork", "--kill-child"])
        .args(["--mount-proc", "--"])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", "in_the_namespace", "--ignored", "--nocapture"])
        .env(INSIDE, "1")
        .status()
        .unwrap();
    assert!(status.success(), "see above");
}

const INSIDE: &str = "FIPA_SDS_TEST_IN_NAMESPACE";

fn is_there(tool: &str) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    let mut dirs = std::env::split_paths(&path).chain(["/usr/sbin".into(), "/sbin".into()]);
    dirs.any(|dir| dir.join(tool).is_file())
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
struct Running(Child);

impl Running {
    fn start(command: &mut Command) -> Self {
        Self(command.env(BUS_VARIABLE, BUS).spawn().unwrap())
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn run(command: &str) {
    let mut words = command.split(' ');
    let status = Command::new(words.next().unwrap()).args(words).status();
    assert!(status.unwrap().success(), "{command}");
}

#[tokio::test]
#[ignore = "is run by the other test in a network namespace"]
async fn in_the_namespace() {
    assert!(
        std::env::var_os(INSIDE).is_some(),
        "started by the other test"
    );
    // Avahi keeps its process number and socket in /run, and takes no loopback interface.
    run("mount -t tmpfs tmpfs /run");
    run("ip link set lo up");
    run("ip link add fipa0 type veth peer name fipa1");
    run("ip addr add 10.99.0.1/24 dev fipa0");
    run("ip link set fipa0 up");
    run("ip link set fipa1 up");
    std::fs::write("/run/bus.conf", BUS_CONFIG).unwrap();
    std::fs::write("/run/avahi.conf", AVAHI_CONFIG).unwrap();
    let _bus = Running::start(
        Command::new("dbus-daemon").args(["--config-file=/run/bus.conf", "--nofork"]),
    );
    eventually("the bus", || {
        Path::new("/run/fipa-test-bus").exists().then_some(())
    })
    .await;
    let _avahi = Running::start(Command::new("avahi-daemon").args([
        "--no-drop-root",
        "--no-chroot",
        "--no-rlimits",
        "--file=/run/avahi.conf",
    ]));
    eventually("Avahi", || {
        let check = Command::new("avahi-daemon").arg("--check").status();
        check.unwrap().success().then_some(())
    })
    .await;

    let directory = MdnsDirectory::open(MdnsConfig {
        interfaces: vec!["fipa0".to_owned()],
        ..MdnsConfig::new(Mts::new("sherpa-mts", Incarnation::random()))
    })
    .unwrap();
    we_are_read(&directory).await;
    peers_are_read(&directory).await;
    assert_eq!(directory.status().last_error, None);
    all_interfaces_include_loopback().await;
}

/// In the namespace, too, because outside it would be heard beyond this machine.
async fn all_interfaces_include_loopback() {
    let open = |interfaces: &[&str]| {
        let config = MdnsConfig {
            interfaces: interfaces.iter().map(ToString::to_string).collect(),
            port: 5454,
            ..MdnsConfig::new(Mts::new("mts", Incarnation::random()))
        };
        MdnsDirectory::open(config).unwrap()
    };
    let (everywhere, loopback) = (open(&[]), open(&["lo"]));
    loopback.register(registration("leg")).unwrap();
    everywhere.register(registration("foot")).unwrap();
    eventually("heard on loopback", || everywhere.lookup("leg")).await;
    eventually("said on loopback", || loopback.lookup("foot")).await;
}

/// The lines of `avahi-browse` about our agent.
fn browse() -> String {
    let output = Command::new("avahi-browse")
        .args(["-rpt", "_fipa_service_directory._udp"])
        .env(BUS_VARIABLE, BUS)
        .stderr(Stdio::inherit())
        .output()
        .unwrap();
    assert!(output.status.success(), "avahi-browse failed");
    String::from_utf8(output.stdout).unwrap()
}

async fn we_are_read(directory: &MdnsDirectory) {
    let mut agent = registration("arm.left");
    agent.description = "left".to_owned();
    agent.locations = vec![
        "quic://10.99.0.1:7787".parse().unwrap(),
        "tcp://10.99.0.1:7788".parse().unwrap(),
    ];
    directory.register(agent.clone()).unwrap();
    let line = eventually("avahi-browse shows the agent", || {
        let lines = browse();
        // `=` is a record resolved; the label comes in decimal escapes.
        let found = lines
            .lines()
            .find(|line| line.starts_with('=') && line.contains(r"arm\063left"));
        found.map(str::to_owned)
    })
    .await;
    for expected in [
        "\"TYPE=gripper\"",
        "\"LOCATOR=tcp://10.99.0.1:7788 fipa::services::transports::MessageTransport;\"",
        "\"DESCRIPTION=left\"",
        "\"TIMESTAMP=2",
        "\"fipa-name=arm.left\"",
        ";10.99.0.1;0;",
    ] {
        assert!(line.contains(expected), "{expected} is not in: {line}");
    }

    // A goodbye is understood, too.
    directory.deregister("arm.left", agent.incarnation).unwrap();
    eventually("avahi-browse no longer shows it", || {
        (!browse().contains("arm")).then_some(())
    })
    .await;
}

async fn peers_are_read(directory: &MdnsDirectory) {
    let peer = Running::start(Command::new("avahi-publish").args([
        "-s",
        "echo@192?0?2?2:1099/JADE",
        "_fipa_service_directory._udp",
        "0",
        "TYPE=echo agent",
        "LOCATOR=udt://192.0.2.2:1 fipa::services::transports::MessageTransport;\
         tcp://192.0.2.2:7788 fipa::services::transports::MessageTransport;",
        "DESCRIPTION=answers",
        "TIMESTAMP=20261120-11:00:00:123456",
    ]));
    let name = "echo@192.0.2.2:1099/JADE";
    let found = eventually("the peer", || directory.lookup(name)).await;
    assert_eq!(found.agent_type, "echo agent");
    assert_eq!(found.description, "answers");
    assert_eq!(found.source, Source::Mdns);
    assert_eq!(
        found.locations,
        ["tcp://192.0.2.2:7788;fipa-services"
            .parse::<Location>()
            .unwrap()]
    );
    drop(peer);
    eventually("the peer has left", || {
        directory.lookup(name).is_none().then_some(())
    })
    .await;
}
