//! Tests hosts whose addresses change. A gateway that listens on all addresses stays reachable at
//! its current address, also for peers whose configuration has another address.
//!
//! The hosts are network namespaces of the test; see `fipa-testbed`. Each has one address, so that a host without
//! it cannot send at all.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]
#![allow(
    clippy::print_stderr,
    reason = "the time that a move takes is worth knowing"
)]

use std::io::{BufRead as _, BufReader};
use std::process::Stdio;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa::admin::keys::{Keys, VALID};
use fipa::config::Sources;
use fipa::{Agent, AgentId, Config, Deliveries, Domain, Entry, Incarnation, Outcome, Performative};
use fipa_testbed::{ChildGuard, Family, Host, Network, enter, isolated};
use serde_json::Value;
use tempfile::TempDir;
use tokio::runtime::Runtime;

/// Deadline of a letter that is sent as soon as a new address is usable. It is the maximum time for
/// which a gateway may be unreachable.
const BOUND: Duration = Duration::from_secs(3);
/// Timeout that ends a hung test.
const WATCHDOG: Duration = Duration::from_secs(60);
const PORT: u16 = 7788;

/// Defines a test of one family of addresses for the harness, and the ignored test that it runs in separate
/// namespaces.
macro_rules! in_family {
    ($name:ident, $outer:ident, $inside:ident, $family:expr) => {
        #[test]
        fn $outer() {
            let inside = concat!(stringify!($name), "::", stringify!($inside));
            isolated(inside, &["nft"]);
        }

        #[test]
        #[ignore = "is run by the other test in namespaces of its own"]
        fn $inside() {
            enter();
            WORK($family);
        }
    };
}

/// Defines the tests of this name, with IPv4, with unique local IPv6 addresses, and with link-local ones.
macro_rules! on_a_network {
    ($(#[$doc:meta])* $name:ident, $work:expr) => {
        $(#[$doc])*
        mod $name {
            use super::*;

            const WORK: fn(Family) = $work;
            in_family!($name, over_ipv4, inside_over_ipv4, Family::V4);
            in_family!($name, over_ipv6, inside_over_ipv6, Family::UniqueLocal);
            in_family!($name, on_one_link, inside_on_one_link, Family::LinkLocal);
        }
    };
}

on_a_network!(
    /// The moving host only receives, so none of its letters reveals its new address.
    a_receiver_moves_five_times_by_tcp,
    |family| a_receiver_moves_five_times(family, &["tcp"])
);

on_a_network!(a_receiver_moves_five_times_by_udp, |family| {
    a_receiver_moves_five_times(family, &["udp"])
});

on_a_network!(a_receiver_moves_five_times_by_quic, |family| {
    a_receiver_moves_five_times(family, &["quic"])
});

fn a_receiver_moves_five_times(family: Family, transports: &[&str]) {
    let (network, robots) = two_hosts(family, transports, &Discovery::Mdns);
    for number in 51..56 {
        network.host(1).move_to(number);
        robots[0].reaches(&robots[1]);
    }
}

on_a_network!(
    /// The sending host moves. Letters in both directions still arrive.
    a_sender_moves_five_times,
    |family| {
        let (network, robots) = two_hosts(family, &["tcp"], &Discovery::Mdns);
        for number in 51..56 {
            network.host(0).move_to(number);
            robots[0].reaches(&robots[1]);
            robots[1].reaches(&robots[0]);
        }
    }
);

on_a_network!(
    /// The moving host cannot connect from its new address, so only multicast announces that
    /// address.
    a_receiver_that_cannot_dial_moves_five_times,
    |family| {
        let (network, robots) = two_hosts(family, &["tcp"], &Discovery::Mdns);
        for rule in [
            "add table inet wall",
            "add chain inet wall in { type filter hook input priority 0; }",
            "add rule inet wall in iifname eth0 tcp dport 7788 drop",
        ] {
            let nft = network.host(0).command("nft").arg(rule).status();
            assert!(nft.unwrap().success(), "nft {rule}");
        }
        for number in 51..56 {
            network.host(1).move_to(number);
            robots[0].reaches(&robots[1]);
        }
    }
);

on_a_network!(
    /// A host has no address until the other host removes its agents, and then gets another
    /// address.
    a_receiver_is_away_and_comes_back_elsewhere,
    |family| {
        let (network, robots) = two_hosts(family, &["tcp"], &Discovery::Mdns);
        let ([here, there], host) = (&robots[..], network.host(1)) else {
            panic!("two robots")
        };
        host.flush();
        here.misses(&there.name);
        host.come_up(52);
        here.finds_after_announcement(there, &address(host, 52));
        here.reaches(there);
    }
);

on_a_network!(
    /// A gateway that starts on a host without an address announces no loopback location. It
    /// announces its location once the host has an address.
    a_gateway_starts_before_its_interface,
    |family| {
        let network = Network::of(family, 2);
        let host = network.host(1);
        host.flush();
        let all = robots_on(&network, &["tcp"], &Discovery::Mdns);
        let [here, there] = &all[..] else {
            panic!("two robots")
        };
        let own = there.own_gateway();
        assert!(own.contains("127.0.0.1"), "no loopback location for processes of the host: {own}");
        // The announcement reaches every interface that passes multicast.
        host.come_up(2);
        here.finds_after_announcement(there, &address(host, 2));
        let routes = here.fipa(network.host(0), &["routes", "--json", &there.name]);
        let ways = routes["gateway"]["routes"].to_string();
        // A link-local location has the interface of the reader.
        let there_now = address(host, 2);
        assert!(ways.contains(there_now.trim_end_matches("]:7788")), "{routes}");
        assert!(!ways.contains("127.0.0.1"), "{routes}");
        here.reaches(there);
    }
);

on_a_network!(
    /// The static peer has another address than the configured one. It connects, and letters return
    /// on that connection, including letters that were sent while it was away.
    a_static_peer_moves_and_dials,
    |family| {
        let (network, robots) = two_hosts(family, &["tcp"], &Discovery::Both);
        let host = network.host(1);
        host.flush();
        let waiting = robots[0].sends(&robots[1], Duration::from_secs(30));
        std::thread::sleep(Duration::from_secs(6));
        host.come_up(52);
        robots[0].reaches(&robots[1]);
        robots[0].was_delivered(waiting);
        for number in 53..57 {
            host.move_to(number);
            robots[0].reaches(&robots[1]);
        }
    }
);

on_a_network!(
    /// The moving host has no static peers. It reconnects to the gateways of its former
    /// connections.
    a_dialed_static_peer_moves,
    |family| {
        let (network, robots) = two_hosts(family, &["tcp"], &Discovery::FirstDials);
        for number in 51..56 {
            network.host(1).move_to(number);
            robots[0].reaches(&robots[1]);
        }
    }
);

on_a_network!(a_dialed_static_peer_moves_by_udp, |family| {
    let (network, robots) = two_hosts(family, &["udp"], &Discovery::FirstDials);
    for number in 51..56 {
        network.host(1).move_to(number);
        robots[0].reaches(&robots[1]);
    }
});

on_a_network!(commands_show_where_a_gateway_is_now, |family| {
    let (network, robots) = two_hosts(family, &["tcp"], &Discovery::Both);
    let host = network.host(1);
    let (before, after) = (address(host, 2), address(host, 52));
    host.move_to(52);
    let now = robots[1].gateway_has(&after);
    assert!(!now.contains(&before), "{now}");
    let report = robots[1].fipa(host, &["routes", "--json"]);
    let output_text = report["gateway"]["locations"].to_string();
    assert!(output_text.contains(&format!("tcp://{after}")), "{report}");
    assert!(!output_text.contains(&before), "{report}");
    let report = robots[1].fipa(host, &["doctor", "--json"]);
    let checks = report["checks"].as_array().unwrap();
    let listens = checks.iter().find(|it| it["check"] == "locations").unwrap();
    let found = listens["found"].as_str().unwrap();
    assert!(found.contains(&after), "{found}");
    assert!(!found.contains(&before), "{found}");
});

/// Method by which gateways find each other.
#[derive(Debug, PartialEq, Eq)]
enum Discovery {
    Mdns,
    /// Each gateway has the other one's initial address as a static peer.
    Both,
    /// Only the first gateway has the other one's initial address as a static peer.
    FirstDials,
}

/// A gateway process and an agent on one host.
struct Robot {
    name: String,
    settings: Vec<String>,
    _gateway: ChildGuard,
    runtime: Runtime,
    agent: Arc<Agent>,
    _keys: Arc<TempDir>,
}

/// A letter without an outcome yet.
type Waiting = tokio::task::JoinHandle<Deliveries>;

/// Starts two hosts and waits until their agents have exchanged letters.
fn two_hosts(family: Family, transports: &[&str], discovery: &Discovery) -> (Network, Vec<Robot>) {
    let network = Network::of(family, 2);
    let robots = robots_on(&network, transports, discovery);
    for (robot, other) in [(&robots[0], &robots[1]), (&robots[1], &robots[0])] {
        robot.waits_for(&other.name);
        robot.reaches(other);
    }
    (network, robots)
}

fn robots_on(network: &Network, transports: &[&str], discovery: &Discovery) -> Vec<Robot> {
    let dir = Arc::new(tempfile::tempdir().unwrap());
    let keys = |at: usize| Keys::at(dir.path().join(at.to_string()));
    if transports.contains(&"quic") {
        for at in 0..2 {
            keys(at).init(&format!("gateway{at}"), &[], VALID).unwrap();
        }
        for (at, other) in [(0, 1), (1, 0)] {
            let pem = std::fs::read(keys(other).own_file()).unwrap();
            keys(at).trust(&pem).unwrap();
        }
    }
    let robots = (0..2).map(|at| {
        let security = match transports.contains(&"quic") {
            true => format!("security.keys={}", keys(at).dir().display()),
            false => "security.insecure=true".to_owned(),
        };
        Robot::start(
            network,
            at,
            transports,
            discovery,
            (security, Arc::clone(&dir)),
        )
    });
    robots.collect()
}

impl Robot {
    fn start(
        network: &Network,
        at: usize,
        transports: &[&str],
        discovery: &Discovery,
        (security, keys): (String, Arc<TempDir>),
    ) -> Self {
        let host = network.host(at);
        let mut settings = vec![
            // A separate directory, so that tests can run concurrently.
            format!("domain=moving-{}", Incarnation::random()),
            format!("mts.name=gateway{at}"),
            format!("mts.transports=shm,{}", transports.join(",")),
            format!("discovery.mdns={}", *discovery == Discovery::Mdns),
            security,
        ];
        for transport in transports {
            settings.push(format!("transport.{transport}.listen=*:{PORT}"));
        }
        let dials = match discovery {
            Discovery::Mdns => false,
            Discovery::Both => true,
            Discovery::FirstDials => at == 0,
        };
        if dials {
            let other = 1 - at;
            let ways = transports.iter();
            let at = &network.host(other).addresses()[0];
            let ways: Vec<String> = ways
                .map(|kind| format!("\"{kind}://{at}:{PORT}\""))
                .collect();
            let line = format!("gateway{other} = [{}]", ways.join(", "));
            settings.push(format!("discovery.static={{ {line} }}"));
        }
        let mut up = host.command(env!("CARGO_BIN_EXE_fipa"));
        up.args(["up", "--json"]);
        for setting in &settings {
            up.args(["--set", setting]);
        }
        if std::env::var_os("FIPA_TEST_LOG").is_some() {
            up.arg("-v");
        }
        let mut gateway = ChildGuard::start(up.stdin(Stdio::null()).stdout(Stdio::piped()));
        let mut ready = String::new();
        let stdout = gateway.child().stdout.take().unwrap();
        BufReader::new(stdout).read_line(&mut ready).unwrap();
        assert!(ready.starts_with('{'), "the gateway is not ready: {ready}");
        let config = Config::load(&Sources {
            set: settings.clone(),
            ..Sources::default()
        });
        let (config, name) = (config.unwrap(), format!("agent{at}"));
        let (runtime, agent) = host.enter(|| {
            let mut builder = tokio::runtime::Builder::new_multi_thread();
            let runtime = builder.worker_threads(1).enable_all().build().unwrap();
            let domain = runtime.block_on(Domain::open(&config)).unwrap();
            let agent = runtime
                .block_on(async { domain.register(&name).await })
                .unwrap();
            (runtime, Arc::new(agent))
        });
        Self {
            name,
            settings,
            _gateway: gateway,
            runtime,
            agent,
            _keys: keys,
        }
    }

    /// Waits until this host's directory has the agent.
    fn waits_for(&self, name: &str) -> Arc<Entry> {
        let started = Instant::now();
        loop {
            if let Some(entry) = self.agent.domain().directory().lookup(name) {
                return entry;
            }
            assert!(
                started.elapsed() < WATCHDOG,
                "timed out waiting until the directory has {name}"
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits until the gateway of the other agent has this new address in its own host's directory,
    /// and then until the directory of this host has the other agent.
    fn finds_after_announcement(&self, other: &Self, address: &str) {
        let usable = Instant::now();
        other.gateway_has(address);
        let announced = usable.elapsed();
        self.waits_for(&other.name);
        let found = usable.elapsed();
        eprintln!(
            "{}: announced after {announced:.1?}, found after {found:.1?}",
            other.name
        );
    }

    /// Waits until this host's directory no longer has the agent.
    fn misses(&self, name: &str) {
        let started = Instant::now();
        while self.agent.domain().directory().lookup(name).is_some() {
            assert!(
                started.elapsed() < WATCHDOG,
                "timed out waiting until the directory drops {name}"
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Returns the locations of this host's gateway in the directory of the host.
    fn own_gateway(&self) -> String {
        let directory = self.agent.domain().directory();
        directory.refresh();
        let entries = directory.entries();
        let mut gateways = entries
            .iter()
            .filter(|entry| entry.role == fipa::Role::Gateway);
        gateways.next().map(|it| places(it)).unwrap_or_default()
    }

    /// Waits until the directory of this host has the gateway at this address.
    fn gateway_has(&self, address: &str) -> String {
        let started = Instant::now();
        loop {
            let places = self.own_gateway();
            if places.contains(address) {
                return places;
            }
            assert!(
                started.elapsed() < WATCHDOG,
                "the gateway is still at {places}"
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn sends(&self, to: &Self, deadline: Duration) -> Waiting {
        let message = self
            .agent
            .message(Performative::Inform)
            .receiver(AgentId::new(&*to.name).unwrap())
            .content("here you are")
            .build()
            .unwrap();
        let agent = Arc::clone(&self.agent);
        self.runtime
            .spawn(async move { agent.send_within(message, deadline).await.unwrap() })
    }

    /// Sends a letter and checks that it arrives within [`BOUND`].
    fn reaches(&self, to: &Self) {
        let sent = Instant::now();
        let letter = self.sends(to, BOUND);
        self.was_delivered(letter);
        eprintln!("{} to {}: {:.1?}", self.name, to.name, sent.elapsed());
    }

    fn was_delivered(&self, letter: Waiting) {
        let deliveries = self.runtime.block_on(letter).unwrap();
        let [delivery] = &deliveries.0[..] else {
            panic!("expected one receiver: {deliveries}")
        };
        let delivered = matches!(delivery.outcome, Outcome::Delivered { .. });
        assert!(delivered, "{}", delivery.outcome);
    }

    /// Runs a command and returns its JSON output.
    fn fipa(&self, host: &Host, args: &[&str]) -> Value {
        let mut command = host.command(env!("CARGO_BIN_EXE_fipa"));
        command.args(args);
        for setting in &self.settings {
            command.args(["--set", setting]);
        }
        let output = command.output().unwrap();
        let output_text = String::from_utf8_lossy(&output.stderr);
        serde_json::from_slice(&output.stdout)
            .unwrap_or_else(|error| panic!("{error}: {output_text}"))
    }
}

fn places(entry: &Entry) -> String {
    let places: Vec<String> = entry.locations.iter().map(ToString::to_string).collect();
    places.join(" ")
}

/// Returns the address and port of a host with this number, without the scope that its gateway leaves out.
fn address(host: &Host, number: u8) -> String {
    let address = host.addresses_with(number).remove(0);
    format!("{}:{PORT}", address.replace("%eth0", ""))
}
