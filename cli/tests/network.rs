//! Gateways on faulty networks: links go down and up, addresses change, gateways are killed, packets
//! are lost, hosts are disconnected. Every letter has one outcome, no letter is received twice, the
//! order is kept, and traffic resumes when the network works again.
//!
//! The hosts are network namespaces; see `fipa-testbed`.

#![allow(clippy::unwrap_used, reason = "a panic fails the test")]

mod fleet;
mod hosts;

use std::io::{BufRead as _, BufReader};
use std::process::Stdio;
use std::sync::mpsc::channel;
use std::time::Duration;

use fipa::Kind;
use fipa_testbed::{ChildGuard, Family, Network, enter, isolated};
use fleet::{ADDRESSES, Fleet, Plan};
use serde_json::Value;

const TOOLS: &[&str] = &["nft"];

fn pause(milliseconds: u64) {
    std::thread::sleep(Duration::from_millis(milliseconds));
}

/// Defines a test, and the ignored test that it runs in namespaces.
macro_rules! on_a_network {
    ($(#[$doc:meta])* $name:ident, $inside:ident, $work:expr) => {
        $(#[$doc])*
        #[test]
        fn $name() {
            isolated(stringify!($inside), TOOLS);
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
    traffic_resumes_after_link_failures,
    inside_traffic_resumes_after_link_failures,
    || {
        let fleet = Fleet::new(&Plan::default());
        fleet.through(10_000, |fleet| {
            for at in [0, 1, 2, 0] {
                let host = fleet.network.host(at);
                fleet.until_delivered(&[0, 1, 2]);
                // The kernel reports this failure to the processes.
                host.ip("link set eth0 down");
                pause(300);
                host.ip("link set eth0 up");
                fleet.until_delivered(&[0, 1, 2]);
                // This failure is not reported.
                host.unplug();
                pause(700);
                host.plug();
            }
        });
    }
);

/// Kills gateways and starts them again.
fn gateways_are_killed(family: Family) {
    let fleet = Fleet::new(&Plan {
        family,
        ..Plan::default()
    });
    fleet.through(10_000, |fleet| {
        for at in [0, 1, 2, 1] {
            fleet.until_delivered(&[0, 1, 2]);
            fleet.kill_gateway(at);
            pause(200);
            fleet.start_gateway(at);
        }
    });
}

on_a_network!(
    traffic_resumes_after_gateways_are_killed,
    inside_traffic_resumes_after_gateways_are_killed,
    || gateways_are_killed(Family::Both)
);

on_a_network!(
    traffic_resumes_after_gateways_are_killed_over_unique_local_addresses,
    inside_traffic_resumes_after_gateways_are_killed_over_unique_local_addresses,
    || gateways_are_killed(Family::UniqueLocal)
);

on_a_network!(
    traffic_resumes_after_gateways_are_killed_over_link_local_addresses,
    inside_traffic_resumes_after_gateways_are_killed_over_link_local_addresses,
    || gateways_are_killed(Family::LinkLocal)
);

/// Changes the address of the second host, and then changes it back.
fn change_address_twice(fleet: &Fleet) {
    let host = fleet.network.host(1);
    let [usual, other] = ADDRESSES;
    for (from, to) in [(usual, other), (other, usual)] {
        fleet.until_delivered(&[0, 1, 2]);
        host.ip(&format!("addr del {from}/24 dev eth0"));
        host.ip(&format!("addr add {to}/24 dev eth0"));
        fleet.until_delivered(&[0, 1, 2]);
    }
}

on_a_network!(
    traffic_resumes_after_address_changes,
    inside_traffic_resumes_after_address_changes,
    || {
        let fleet = Fleet::new(&Plan::default());
        fleet.through(10_000, |fleet| {
            change_address_twice(fleet);
        });
    }
);

on_a_network!(
    /// QUIC migrates the connection when the address of the dialing host changes.
    no_letter_fails_when_a_dialing_quic_peer_moves,
    inside_no_letter_fails_when_a_dialing_quic_peer_moves,
    || {
        let fleet = Fleet::new(&Plan {
            // No other transport can replace QUIC.
            transports: &["shm", "quic"],
            dials: Some(1),
            ..Plan::default()
        });
        fleet.through(6_000, |fleet| {
            change_address_twice(fleet);
            assert!(fleet.delivered_via(Kind::Quic), "no letter was delivered via QUIC");
            for (from, to) in [(0, 1), (1, 0), (1, 2), (2, 1)] {
                assert_eq!(fleet.failed(from, to), 0, "{from} to {to}");
            }
        });
    }
);

on_a_network!(
    /// QUIC cannot migrate when the address of the dialed host changes. The gateway dials the new
    /// address and repeats unacknowledged letters.
    no_letter_fails_when_a_dialed_quic_peer_moves,
    inside_no_letter_fails_when_a_dialed_quic_peer_moves,
    || {
        let fleet = Fleet::new(&Plan {
            transports: &["shm", "quic"],
            // The gateway needs four seconds to detect the change.
            deadline: Duration::from_secs(20),
            is_dialed: Some(1),
            ..Plan::default()
        });
        fleet.through(6_000, |fleet| {
            change_address_twice(fleet);
            assert!(fleet.delivered_via(Kind::Quic), "no letter was delivered via QUIC");
            for (from, to) in [(0, 1), (1, 0), (1, 2), (2, 1), (0, 2), (2, 0)] {
                assert_eq!(fleet.failed(from, to), 0, "{from} to {to}");
            }
        });
    }
);

on_a_network!(
    tcp_and_quic_replace_each_other_on_failure,
    inside_tcp_and_quic_replace_each_other_on_failure,
    || {
        let fleet = Fleet::new(&Plan {
            transports: &["shm", "quic", "tcp"],
            ..Plan::default()
        });
        fleet.through(3_000, |fleet| {
            fleet.until_delivered(&[0, 1, 2]);
            assert!(
                fleet.delivered_via(Kind::Quic),
                "no letter was delivered via QUIC"
            );
            fleet.block("udp");
            fleet.until_delivered(&[0, 1, 2]);
            assert!(
                fleet.delivered_via(Kind::Tcp),
                "no letter was delivered via TCP"
            );
            fleet.restore();
            fleet.block("tcp");
            fleet.until_delivered(&[0, 1, 2]);
        });
    }
);

on_a_network!(
    tcp_tolerates_packet_loss,
    inside_tcp_tolerates_packet_loss,
    || {
        let fleet = Fleet::new(&Plan::default());
        for percent in [1, 10, 30] {
            fleet.through(3_500, |fleet| {
                fleet.lose("tcp", percent);
                pause(4000);
                fleet.restore();
            });
        }
    }
);

on_a_network!(
    a_disconnected_host_does_not_affect_others,
    inside_a_disconnected_host_does_not_affect_others,
    || {
        let fleet = Fleet::new(&Plan::default());
        fleet.through(10_000, |fleet| {
            fleet.until_delivered(&[0, 1, 2]);
            fleet.network.host(2).unplug();
            // Every letter has its outcome within its deadline, so the senders continue.
            for (from, to) in [(0, 2), (1, 2), (2, 0), (2, 1)] {
                fleet.until_failing(from, to);
            }
            fleet.until_delivered(&[0, 1]);
            for (from, to) in [(0, 1), (1, 0)] {
                assert_eq!(
                    fleet.failed(from, to),
                    0,
                    "{from} to {to}: the other hosts are affected"
                );
            }
            fleet.network.host(2).plug();
        });
    }
);

on_a_network!(
    udp_tolerates_packet_loss,
    inside_udp_tolerates_packet_loss,
    || {
        let fleet = Fleet::new(&Plan {
            transports: &["shm", "udp", "tcp"],
            ..Plan::default()
        });
        for percent in [1, 10, 30] {
            fleet.through(3_500, |fleet| {
                fleet.lose("udp", percent);
                pause(4000);
                fleet.restore();
            });
            assert!(
                fleet.delivered_via(Kind::Udp),
                "no letter was delivered via UDP"
            );
        }
    }
);

/// Blocks the first transport and then the second one. Letters are delivered via the other one.
fn block_each_transport(transports: &'static [&'static str], first: Kind, second: Kind) {
    let fleet = Fleet::new(&Plan {
        transports,
        ..Plan::default()
    });
    fleet.through(3_000, |fleet| {
        fleet.until_delivered(&[0, 1, 2]);
        assert!(
            fleet.delivered_via(first),
            "no letter was delivered via {first}"
        );
        fleet.block(first.name());
        fleet.until_delivered(&[0, 1, 2]);
        assert!(
            fleet.delivered_via(second),
            "no letter was delivered via {second}"
        );
        fleet.restore();
        fleet.block(second.name());
        fleet.until_delivered(&[0, 1, 2]);
        fleet.restore();
    });
}

on_a_network!(
    tcp_replaces_failed_udp,
    inside_tcp_replaces_failed_udp,
    || {
        block_each_transport(&["shm", "udp", "tcp"], Kind::Udp, Kind::Tcp);
    }
);

on_a_network!(
    udp_replaces_failed_tcp,
    inside_udp_replaces_failed_tcp,
    || {
        block_each_transport(&["shm", "tcp", "udp"], Kind::Tcp, Kind::Udp);
    }
);

on_a_network!(
    /// No error comes back from a host whose firewall drops packets.
    a_firewall_that_drops_is_logged_once_and_reported_by_the_doctor,
    inside_a_firewall_that_drops_is_logged_once_and_reported_by_the_doctor,
    || {
        let network = Network::new(2);
        let (here, there) = (network.host(0), network.host(1));
        hosts::filter(there, "iifname eth0 tcp dport 7788 drop");
        let peer = format!("discovery.static={{ crex = [\"tcp://{}:7788\"] }}", there.ipv4());
        let settings = ["discovery.mdns=false", "security.insecure=true", &peer].map(str::to_owned);
        let mut gateway = hosts::gateway(here, &settings);
        gateway.stdout(Stdio::null()).stderr(Stdio::piped());
        let mut gateway = ChildGuard::start(&mut gateway);
        let log = BufReader::new(gateway.child().stderr.take().unwrap());
        let (sender, lines) = channel();
        std::thread::spawn(move || log.lines().map_while(Result::ok).try_for_each(|it| sender.send(it)));
        let expected = format!("nothing answered on {}:7788", there.ipv4());
        let line = loop {
            let line: String = lines.recv_timeout(Duration::from_secs(60)).unwrap();
            if line.contains(&expected) {
                break line;
            }
        };
        assert!(line.contains("WARN"), "{line}");
        assert!(line.contains("sudo ufw allow 7788/tcp"), "{line}");

        let mut doctor = here.command(env!("CARGO_BIN_EXE_fipa"));
        doctor.args(["doctor", "--json"]);
        doctor.args(settings.iter().flat_map(|setting| ["--set", setting.as_str()]));
        let report = doctor.stderr(Stdio::inherit()).output().unwrap().stdout;
        let report: Value = serde_json::from_slice(&report).unwrap();
        let checks = report["checks"].as_array().unwrap();
        let check = |name: &str| checks.iter().find(|check| check["check"] == name).unwrap();
        let port = check("ports of static peers");
        assert!(port["found"].as_str().unwrap().contains("nothing answered"), "{port}");
        assert!(port["advice"].as_str().unwrap().contains("sudo ufw allow 7788/tcp"), "{port}");
        let gateways = check("configuration of the running gateway");
        assert_eq!(gateways["severity"], "fine", "{gateways}");

        // The gateway has tried again meanwhile.
        gateway.signal("-TERM");
        assert!(gateway.wait().success());
        assert!(lines.iter().all(|line| !line.contains("nothing answered")));
    }
);
