//! Interoperation with Avahi on another host: `avahi-browse` shows the announcements of this
//! project as the legacy peers need them, and the announcements of `avahi-publish` are found.
//!
//! Needs root, and the Debian packages avahi-daemon, avahi-utils, dbus and iproute2. Without them
//! the test reports that it is skipped; in CI it fails.

// The exception in clippy.toml for tests does not apply to functions that they call.
#![allow(clippy::unwrap_used, clippy::print_stdout, clippy::print_stderr)]

mod common;

use common::registration;
use fipa_sds::{Change, Directory, Entry, MdnsConfig, MdnsDirectory, MtsId, Role, Source};
use fipa_testbed::{Avahi, Network, until_some_async};
use fipa_transport::{Incarnation, Location};

const SERVICE_TYPE: &str = "_fipa_service_directory._udp";
const SIGNATURE: &str = "fipa::services::transports::MessageTransport";

#[test]
fn avahi_and_we_read_each_other() {
    fipa_testbed::isolated("inside_avahi_and_we_read_each_other", &Avahi::TOOLS);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_avahi_and_we_read_each_other() {
    fipa_testbed::enter();
    let network = Network::new(2);
    let avahi = Avahi::start(network.host(1));
    network.host(0).enter(|| {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        runtime.block_on(async {
            let directory = open("sherpa-mts");
            we_are_read(&directory, &avahi).await;
            peers_are_read(&directory, &avahi).await;
            split_values_are_read(&directory, &avahi).await;
            records_with_little_in_them_are_read(&directory, &avahi).await;
            names_conflict(&directory, &avahi).await;
            assert_eq!(directory.status().last_error, None);
            assert_eq!(directory.status().refused, 0);
            all_interfaces_include_loopback().await;
        });
    });
}

fn open(name: &str) -> MdnsDirectory {
    let config = MdnsConfig {
        interfaces: vec!["eth0".to_owned()],
        ..MdnsConfig::new(MtsId::new(name, Incarnation::random()))
    };
    MdnsDirectory::open(config).unwrap()
}

/// Runs in the namespace too, because otherwise its packets would leave this machine.
async fn all_interfaces_include_loopback() {
    let open = |interfaces: &[&str]| {
        let config = MdnsConfig {
            interfaces: interfaces.iter().map(ToString::to_string).collect(),
            port: 5454,
            ..MdnsConfig::new(MtsId::new("mts", Incarnation::random()))
        };
        MdnsDirectory::open(config).unwrap()
    };
    let (everywhere, loopback) = (open(&[]), open(&["lo"]));
    loopback.register(registration("leg")).unwrap();
    everywhere.register(registration("foot")).unwrap();
    until_some_async("heard on loopback", || everywhere.lookup("leg")).await;
    until_some_async("said on loopback", || loopback.lookup("foot")).await;
}

/// The line of `avahi-browse` about a resolved record that contains all of these parts.
fn browsed(avahi: &Avahi<'_>, parts: &[&str]) -> Option<String> {
    let lines = avahi.browse(SERVICE_TYPE);
    let wanted =
        |line: &String| line.starts_with('=') && parts.iter().all(|part| line.contains(part));
    lines.into_iter().find(wanted)
}

async fn we_are_read(directory: &MdnsDirectory, avahi: &Avahi<'_>) {
    let mut agent = registration("arm.left");
    agent.description = "left".to_owned();
    agent.locations = vec![
        "quic://10.99.0.1:7787".parse().unwrap(),
        "tcp://10.99.0.1:7788".parse().unwrap(),
    ];
    directory.register(agent.clone()).unwrap();
    let line = until_some_async("avahi-browse shows the agent", || {
        browsed(avahi, &[r"arm\063left"])
    })
    .await;
    for expected in [
        "\"TYPE=gripper\"",
        &format!("\"LOCATOR=tcp://10.99.0.1:7788 {SIGNATURE};\""),
        "\"DESCRIPTION=left\"",
        "\"TIMESTAMP=2",
        "\"fipa-name=arm.left\"",
        ";10.99.0.1;0;",
    ] {
        assert!(line.contains(expected), "{expected} is not in: {line}");
    }

    agent.description = "turned".to_owned();
    directory.register(agent.clone()).unwrap();
    until_some_async("avahi-browse shows the change", || {
        browsed(avahi, &[r"arm\063left", "\"DESCRIPTION=turned\""])
    })
    .await;

    // Avahi also processes a goodbye.
    directory.deregister("arm.left", agent.incarnation).unwrap();
    until_some_async("avahi-browse no longer shows it", || {
        let lines = avahi.browse(SERVICE_TYPE);
        let gone = !lines.iter().any(|line| line.contains("arm"));
        gone.then_some(())
    })
    .await;
}

async fn peers_are_read(directory: &MdnsDirectory, avahi: &Avahi<'_>) {
    let locator =
        format!("LOCATOR=udt://192.0.2.2:1 {SIGNATURE};tcp://192.0.2.2:7788 {SIGNATURE};");
    let peer = avahi.publish(
        "echo@192?0?2?2:1099/JADE",
        SERVICE_TYPE,
        0,
        &[
            "TYPE=echo agent",
            &locator,
            "DESCRIPTION=answers",
            "TIMESTAMP=20261120-11:00:00:123456",
        ],
    );
    let name = "echo@192.0.2.2:1099/JADE";
    let found = until_some_async("the peer", || directory.lookup(name)).await;
    assert_eq!(found.agent_type, "echo agent");
    assert_eq!(found.description, "answers");
    assert_eq!(found.source, Source::Mdns);
    assert_eq!(found.role, Role::Agent);
    assert_eq!(
        found.locations,
        [
            "tcp://192.0.2.2:7788;fipa-services",
            "udt://192.0.2.2:1;fipa-services"
        ]
        .map(|location| location.parse::<Location>().unwrap())
    );
    drop(peer);
    gone(directory, name).await;
}

/// A record like that of fipa_services for an agent with many transports: 1,300 bytes, with values
/// split into strings of 200 bytes that repeat the key.
async fn split_values_are_read(directory: &MdnsDirectory, avahi: &Avahi<'_>) {
    let mut watch = directory.watch();
    let location =
        |number: u16, scheme: &str| format!("{scheme}://10.99.0.2:{number} {SIGNATURE};");
    let locator: String = (7000..7006)
        .map(|number| location(number, "tcp") + &location(number, "udt"))
        .collect();
    let description = "d".repeat(250);
    let mut strings = vec!["TYPE=crane".to_owned()];
    for (key, value) in [("LOCATOR", &locator), ("DESCRIPTION", &description)] {
        for part in value.as_bytes().chunks(200 - key.len() - 1) {
            strings.push(format!("{key}={}", String::from_utf8_lossy(part)));
        }
    }
    strings.push("TIMESTAMP=20261120-11:00:00:123456".to_owned());
    let total: usize = strings.iter().map(|string| string.len() + 1).sum();
    assert!((1100..=1300).contains(&total), "{total}");
    let strings: Vec<&str> = strings.iter().map(String::as_str).collect();
    let peer = avahi.publish("crane", SERVICE_TYPE, 0, &strings);

    let found = until_some_async("all of the peer's locations", || {
        let found = directory.lookup("crane")?;
        (found.locations.len() == Entry::MAX_LOCATIONS).then_some(found)
    })
    .await;
    let addresses: Vec<_> = found.locations.iter().map(ToString::to_string).collect();
    // Those of TCP come first.
    let all =
        |kind| (7000..7006).map(move |port| format!("{kind}://10.99.0.2:{port};fipa-services"));
    let expected: Vec<_> = all("tcp").chain(all("udt")).take(8).collect();
    assert_eq!(addresses, expected);
    assert_eq!(found.description, description);
    assert_eq!(found.agent_type, "crane");
    drop(peer);
    gone(directory, "crane").await;
    // It joined once and left once, regardless of what arrived in between.
    let mut changes = Vec::new();
    while let Some(change) = watch.try_next() {
        changes.push(change);
    }
    assert!(
        matches!(changes.first(), Some(Change::Joined(_))),
        "{changes:?}"
    );
    assert!(
        matches!(changes.last(), Some(Change::Left(_))),
        "{changes:?}"
    );
    let between = &changes[1..changes.len() - 1];
    assert!(
        between
            .iter()
            .all(|change| matches!(change, Change::Changed { .. }))
    );
}

/// Keys in another order, twice, and none at all; binary values.
async fn records_with_little_in_them_are_read(directory: &MdnsDirectory, avahi: &Avahi<'_>) {
    let one = format!("locator=tcp://10.99.0.2:7001 {SIGNATURE};");
    let two = format!("LOCATOR=tcp://10.99.0.2:7002 {SIGNATURE};");
    let peers = [
        avahi.publish(
            "twice",
            SERVICE_TYPE,
            7,
            &["TIMESTAMP=x", &one, "TYPE=t", &two],
        ),
        avahi.publish("bare", SERVICE_TYPE, 0, &[]),
    ];
    let twice = until_some_async("both locations", || {
        directory
            .lookup("twice")
            .filter(|found| found.locations.len() == 2)
    })
    .await;
    assert_eq!(twice.agent_type, "t");
    assert_eq!(twice.locations[0].address(), "10.99.0.2:7001");
    let bare = until_some_async("a record without keys", || directory.lookup("bare")).await;
    assert_eq!((bare.locations.len(), &*bare.agent_type), (0, ""));
    drop(peers);
    gone(directory, "twice").await;
    gone(directory, "bare").await;
}

/// Records of one name have labels of their own.
async fn names_conflict(directory: &MdnsDirectory, avahi: &Avahi<'_>) {
    // The own registration first: Avahi renames the peer.
    let ours = registration("lift");
    directory.register(ours.clone()).unwrap();
    until_some_async("avahi-browse shows ours", || {
        browsed(avahi, &["lift", "fipa-name"])
    })
    .await;
    let peer = avahi.publish("lift", SERVICE_TYPE, 0, &["TYPE=theirs"]);
    let found = until_some_async("the peer by its new name", || directory.lookup("lift #2")).await;
    assert_eq!(found.agent_type, "theirs");
    assert!(browsed(avahi, &["lift;", "fipa-name=lift"]).is_some());
    assert_eq!(directory.status().announced, 1);
    drop(peer);
    gone(directory, "lift #2").await;
    directory.deregister("lift", ours.incarnation).unwrap();

    // The peer first: both keep the name, under labels of their own.
    let strings = ["TYPE=theirs", "TIMESTAMP=20200101-00:00:00:000000"];
    let _peer = avahi.publish("winch", SERVICE_TYPE, 0, &strings);
    until_some_async("the peer", || directory.lookup("winch")).await;
    let newcomer = open("newcomer");
    newcomer.register(registration("winch")).unwrap();
    until_some_async("both records", || {
        let lines = avahi.browse(SERVICE_TYPE);
        let resolved = lines.iter().filter(|line| line.starts_with('='));
        let winches: Vec<_> = resolved.filter(|line| line.contains("winch")).collect();
        let is_own = |line: &&&String| line.contains("fipa-name=winch");
        let own = winches.iter().filter(is_own).count();
        (winches.len() == 2 && own == 1).then_some(())
    })
    .await;
    let seen = until_some_async("the newcomer sees the peer", || newcomer.lookup("winch")).await;
    assert_eq!(seen.agent_type, "theirs");
    let seen = directory.lookup("winch").unwrap();
    assert_eq!(seen.agent_type, "theirs", "the first one keeps the name");
}

async fn gone(directory: &MdnsDirectory, name: &str) {
    until_some_async(&format!("{name:?} has left"), || {
        directory.lookup(name).is_none().then_some(())
    })
    .await;
}
