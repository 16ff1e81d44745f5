//! Gateways on real networks that misbehave: links go down and up, addresses change, gateways are
//! killed, packets are lost, hosts are cut off. Every letter has one outcome, none is taken twice,
//! the order is kept, and traffic goes on by itself when the network does.
//!
//! The hosts are network namespaces of the test's own; see `fipa-testbed`.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on ends")]

mod fleet;
mod hosts;

use std::time::Duration;

use fipa::Kind;
use fipa_testbed::{enter, isolated};
use fleet::{ADDRESSES, Fleet, Plan};

const TOOLS: &[&str] = &["nft"];

fn pause(milliseconds: u64) {
    std::thread::sleep(Duration::from_millis(milliseconds));
}

/// A test that the harness sees, and the one that it runs in namespaces of its own.
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

on_a_network!(links_go_down_and_up, inside_links_go_down_and_up, || {
    let fleet = Fleet::new(&Plan::default());
    fleet.through(10_000, |fleet| {
        for at in [0, 1, 2, 0] {
            let host = fleet.network.host(at);
            fleet.until_delivered(&[0, 1, 2]);
            // The kernel tells of this,
            host.ip("link set eth0 down");
            pause(300);
            host.ip("link set eth0 up");
            fleet.until_delivered(&[0, 1, 2]);
            // and nobody of this.
            host.unplug();
            pause(700);
            host.plug();
        }
    });
});

on_a_network!(gateways_are_killed, inside_gateways_are_killed, || {
    let fleet = Fleet::new(&Plan::default());
    fleet.through(10_000, |fleet| {
        for at in [0, 1, 2, 1] {
            fleet.until_delivered(&[0, 1, 2]);
            fleet.kill_gateway(at);
            pause(200);
            fleet.start_gateway(at);
        }
    });
});

/// The second host has another address, and then its own again.
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

on_a_network!(addresses_change, inside_addresses_change, || {
    let fleet = Fleet::new(&Plan::default());
    fleet.through(10_000, |fleet| {
        change_address_twice(fleet);
    });
});

on_a_network!(
    /// Nothing is lost when the host that dialled has another address.
    a_quic_peer_moves,
    inside_a_quic_peer_moves,
    || {
        let fleet = Fleet::new(&Plan {
            // Nothing stands in for it.
            transports: &["shm", "quic"],
            dials: Some(1),
            ..Plan::default()
        });
        fleet.through(6_000, |fleet| {
            change_address_twice(fleet);
            assert!(fleet.went_by(Kind::Quic), "nothing went by QUIC");
            for (from, to) in [(0, 1), (1, 0), (1, 2), (2, 1)] {
                assert_eq!(fleet.failed(from, to), 0, "{from} to {to}");
            }
        });
    }
);

on_a_network!(
    /// QUIC does not follow a host that was dialled: it is dialled again where it is now, and what
    /// it had not acknowledged is repeated.
    a_dialled_quic_peer_moves,
    inside_a_dialled_quic_peer_moves,
    || {
        let fleet = Fleet::new(&Plan {
            transports: &["shm", "quic"],
            // It takes four seconds to find out.
            deadline: Duration::from_secs(20),
            is_dialled: Some(1),
            ..Plan::default()
        });
        fleet.through(6_000, |fleet| {
            change_address_twice(fleet);
            assert!(fleet.went_by(Kind::Quic), "nothing went by QUIC");
            for (from, to) in [(0, 1), (1, 0), (1, 2), (2, 1), (0, 2), (2, 0)] {
                assert_eq!(fleet.failed(from, to), 0, "{from} to {to}");
            }
        });
    }
);

on_a_network!(quic_then_tcp_fails, inside_quic_then_tcp_fails, || {
    let fleet = Fleet::new(&Plan {
        transports: &["shm", "quic", "tcp"],
        ..Plan::default()
    });
    fleet.through(3_000, |fleet| {
        fleet.until_delivered(&[0, 1, 2]);
        assert!(fleet.went_by(Kind::Quic), "nothing went by QUIC");
        fleet.pull("udp");
        fleet.until_delivered(&[0, 1, 2]);
        assert!(fleet.went_by(Kind::Tcp), "nothing went by TCP");
        fleet.lose_nothing();
        fleet.pull("tcp");
        fleet.until_delivered(&[0, 1, 2]);
    });
});

on_a_network!(tcp_loses_packets, inside_tcp_loses_packets, || {
    let fleet = Fleet::new(&Plan::default());
    for of_a_hundred in [1, 10, 30] {
        fleet.through(3_500, |fleet| {
            fleet.lose("tcp", of_a_hundred);
            pause(4000);
            fleet.lose_nothing();
        });
    }
});

on_a_network!(a_host_is_cut_off, inside_a_host_is_cut_off, || {
    let fleet = Fleet::new(&Plan::default());
    fleet.through(10_000, |fleet| {
        fleet.until_delivered(&[0, 1, 2]);
        fleet.network.host(2).unplug();
        // Each has its outcome within its deadline: those that wait for one go on, then.
        for (from, to) in [(0, 2), (1, 2), (2, 0), (2, 1)] {
            fleet.until_failing(from, to);
        }
        fleet.until_delivered(&[0, 1]);
        for (from, to) in [(0, 1), (1, 0)] {
            assert_eq!(fleet.failed(from, to), 0, "{from} to {to}: others noticed");
        }
        fleet.network.host(2).plug();
    });
});

on_a_network!(udp_loses_packets, inside_udp_loses_packets, || {
    let fleet = Fleet::new(&Plan {
        transports: &["shm", "udp", "tcp"],
        ..Plan::default()
    });
    for of_a_hundred in [1, 10, 30] {
        fleet.through(3_500, |fleet| {
            fleet.lose("udp", of_a_hundred);
            pause(4000);
            fleet.lose_nothing();
        });
        assert!(fleet.went_by(Kind::Udp), "nothing went by UDP");
    }
});

/// Each transport fails while it is the first, and while it is the second.
fn plugs_are_pulled(transports: &'static [&'static str], first: Kind, second: Kind) {
    let fleet = Fleet::new(&Plan {
        transports,
        ..Plan::default()
    });
    fleet.through(3_000, |fleet| {
        fleet.until_delivered(&[0, 1, 2]);
        assert!(fleet.went_by(first), "nothing went by {first}");
        fleet.pull(first.name());
        fleet.until_delivered(&[0, 1, 2]);
        assert!(fleet.went_by(second), "nothing went by {second}");
        fleet.lose_nothing();
        fleet.pull(second.name());
        fleet.until_delivered(&[0, 1, 2]);
        fleet.lose_nothing();
    });
}

on_a_network!(udp_then_tcp_fails, inside_udp_then_tcp_fails, || {
    plugs_are_pulled(&["shm", "udp", "tcp"], Kind::Udp, Kind::Tcp);
});

on_a_network!(tcp_then_udp_fails, inside_tcp_then_udp_fails, || {
    plugs_are_pulled(&["shm", "tcp", "udp"], Kind::Tcp, Kind::Udp);
});
