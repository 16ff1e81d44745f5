//! Gateways on networks with IPv4 only, with unique local or link-local IPv6 addresses only, and with
//! all of them: agents of two hosts that have not met send requests and receive the replies, over
//! every transport, found by mDNS and by a static address.
//!
//! The hosts are network namespaces; see `fipa-testbed`.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]
#![allow(clippy::print_stdout, reason = "the test prints its progress")]

mod hosts;

use std::process::{Command, Stdio};

use fipa_testbed::{ChildGuard, Family, Host, Network, enter, isolated, until};
use hosts::PORT;
use serde_json::Value;

/// Defines a test, and the ignored test that it runs in namespaces.
macro_rules! on_a_network {
    ($name:ident, $inside:ident, $work:expr) => {
        #[test]
        fn $name() {
            isolated(stringify!($inside), &[]);
        }

        #[test]
        #[ignore = "is run by the other test in namespaces of its own"]
        fn $inside() {
            enter();
            let work: fn() = $work;
            work();
        }
    };
}

on_a_network!(
    agents_answer_over_ipv4,
    inside_agents_answer_over_ipv4,
    || agents_answer(Family::V4)
);

on_a_network!(
    agents_answer_over_unique_local_addresses,
    inside_agents_answer_over_unique_local_addresses,
    || agents_answer(Family::UniqueLocal)
);

on_a_network!(
    agents_answer_over_link_local_addresses,
    inside_agents_answer_over_link_local_addresses,
    || agents_answer(Family::LinkLocal)
);

on_a_network!(
    agents_answer_over_all_addresses,
    inside_agents_answer_over_all_addresses,
    || agents_answer(Family::Both)
);

/// How the gateways of two hosts find each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Found {
    /// Both by mDNS.
    ByMdns,
    /// The first host has an address of the second one, which does not know the first.
    ByAddress,
}

/// Agents of two hosts exchange requests and replies over each transport.
fn agents_answer(family: Family) {
    let network = Network::of(family, 2);
    hosts::make_keys(2);
    for (transport, has_keys) in [
        ("tcp", false),
        ("udp", false),
        ("tcp", true),
        ("quic", true),
    ] {
        for found in [Found::ByMdns, Found::ByAddress] {
            println!("{family:?}: {transport}, keys: {has_keys}, {found:?}");
            let pair = Pair::start(&network, transport, has_keys, found);
            // The first host meets a new agent with each request.
            pair.replies(0, 1);
            if found == Found::ByMdns {
                pair.replies(1, 0);
            }
        }
    }
}

on_a_network!(
    an_address_that_both_hosts_have_leads_to_no_host,
    inside_an_address_that_both_hosts_have_leads_to_no_host,
    || {
        let network = Network::of(Family::V4, 2);
        hosts::make_keys(2);
        for host in network.hosts() {
            // Listed before `eth0`, as the bridge of containers often is.
            host.ip("link add docker0 index 5 type veth peer name container");
            host.ip("addr add 172.17.0.1/16 dev docker0");
            host.ip("link set docker0 up");
            host.ip("link set container up");
        }
        for transport in ["tcp", "quic"] {
            let pair = Pair::start(&network, transport, true, Found::ByMdns);
            for (from, to) in [(0, 1), (1, 0)] {
                pair.replies(from, to);
                let mut routes = fipa(network.host(from), from);
                let routes = routes
                    .args(["routes", &format!("echo{to}")])
                    .output()
                    .unwrap();
                let routes = String::from_utf8_lossy(&routes.stdout).into_owned();
                assert!(routes.contains("172.17.0.1"), "{routes}");
                assert!(!routes.contains("unreachable"), "{routes}");
            }
        }
    }
);

on_a_network!(
    the_doctor_names_the_family_that_a_gateway_does_not_listen_on,
    inside_the_doctor_names_the_family_that_a_gateway_does_not_listen_on,
    || {
        let network = Network::of(Family::UniqueLocal, 1);
        let found = |listen: &str| {
            let mut doctor = fipa(network.host(0), 0);
            let listen = format!("transport.tcp.listen={listen}:{PORT}");
            doctor.args(["--set", "security.insecure=true", "--set", &listen]);
            let report = doctor.args(["doctor", "--json"]).output().unwrap().stdout;
            let report: Value = serde_json::from_slice(&report).unwrap();
            let mut checks = report["checks"].as_array().unwrap().iter();
            checks
                .find(|check| check["check"] == "locations")
                .unwrap()
                .clone()
        };
        let v4 = found("0.0.0.0");
        assert_eq!(v4["severity"], "bad", "{v4}");
        assert!(
            v4["found"].as_str().unwrap().contains("but fd99::1"),
            "{v4}"
        );
        let all = found("*");
        assert_eq!(all["severity"], "fine", "{all}");
        assert_eq!(all["found"], format!("tcp://[fd99::1]:{PORT}"));
    }
);

/// Two hosts with a gateway and an echo agent each.
struct Pair<'a> {
    network: &'a Network,
    _agents: Vec<ChildGuard>,
    _gateways: Vec<ChildGuard>,
}

impl<'a> Pair<'a> {
    fn start(network: &'a Network, transport: &str, has_keys: bool, found: Found) -> Self {
        let gateways = (0..2).map(|at| {
            let mut settings = vec![
                format!("domain=host{at}"),
                format!("mts.name=gateway{at}"),
                format!("mts.transports=shm,{transport}"),
                format!("transport.{transport}.listen=*:{PORT}"),
                format!("discovery.mdns={}", found == Found::ByMdns),
                match has_keys {
                    true => format!("security.keys={}", hosts::keys(at).dir().display()),
                    false => "security.insecure=true".to_owned(),
                },
            ];
            if (found, at) == (Found::ByAddress, 0) {
                let addresses = network.host(1).addresses().into_iter();
                let locations = addresses.map(|it| format!("\"{transport}://{it}:{PORT}\""));
                let locations = locations.collect::<Vec<_>>().join(", ");
                settings.push(format!("discovery.static={{ gateway1 = [{locations}] }}"));
            }
            let mut gateway = hosts::gateway(network.host(at), &settings);
            ChildGuard::until_ready(&mut gateway).0
        });
        let gateways = gateways.collect();
        let agents = (0..2).map(|at| {
            let mut echo = fipa(network.host(at), at);
            ChildGuard::until_ready(echo.args(["echo", &format!("echo{at}")])).0
        });
        Self {
            network,
            _agents: agents.collect(),
            _gateways: gateways,
        }
    }

    /// Sends a request from a new agent of one host to the echo agent of the other one, and checks that
    /// its reply arrives.
    fn replies(&self, from: usize, to: usize) {
        let mut send = fipa(self.network.host(from), from);
        let receiver = format!("echo{to}");
        until("the other host is found", || {
            let agents = fipa(self.network.host(from), from).arg("agents").output();
            String::from_utf8_lossy(&agents.unwrap().stdout).contains(&receiver)
        });
        send.args(["send", "--to", &receiver, "--content", "hello", "--wait"]);
        let sent = send.output().unwrap();
        let (out, errors) = (
            String::from_utf8_lossy(&sent.stdout),
            String::from_utf8_lossy(&sent.stderr),
        );
        assert!(sent.status.success(), "{from} to {to}: {out}{errors}");
    }
}

/// A command for the domain of this host.
fn fipa(host: &Host, at: usize) -> Command {
    let mut command = host.command(env!("CARGO_BIN_EXE_fipa"));
    command.args(["--set", &format!("domain=host{at}")]);
    command.stdin(Stdio::null());
    command
}
