//! Tests of the networks that other tests use.

// The exception in clippy.toml covers test functions, but not the functions that they call.
#![allow(clippy::unwrap_used)]

use std::net::UdpSocket;
use std::time::Duration;

use fipa_testbed::{Host, Network};

#[test]
fn packets_reach_only_connected_hosts() {
    fipa_testbed::isolated("inside_packets_reach_only_connected_hosts", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_packets_reach_only_connected_hosts() {
    fipa_testbed::enter();
    let network = Network::new(2);
    let (one, two) = (network.host(0), network.host(1));
    let receiver = receiver(two);
    assert!(arrives(one, two, &receiver));
    one.unplug();
    assert!(!arrives(one, two, &receiver));
    one.plug();
    assert!(arrives(one, two, &receiver));
    assert!(multicast_arrives(one, &receiver));
    two.forward_multicast(false);
    assert!(!multicast_arrives(one, &receiver));
    assert!(arrives(one, two, &receiver));
    two.ip("link set eth0 down");
    assert!(!arrives(one, two, &receiver));
}

fn receiver(host: &Host) -> UdpSocket {
    let address = host.ipv4();
    let socket = host.enter(move || UdpSocket::bind("0.0.0.0:7000").unwrap());
    socket
        .join_multicast_v4(&"239.1.2.3".parse().unwrap(), &address)
        .unwrap();
    let timeout = Some(Duration::from_millis(300));
    socket.set_read_timeout(timeout).unwrap();
    socket
}

/// Whether one of five packets is received: a connected host may lose the first ones.
fn arrives(from: &Host, to: &Host, receiver: &UdpSocket) -> bool {
    sent(from, &format!("{}:7000", to.ipv4()), receiver)
}

fn multicast_arrives(from: &Host, receiver: &UdpSocket) -> bool {
    sent(from, "239.1.2.3:7000", receiver)
}

fn sent(from: &Host, to: &str, receiver: &UdpSocket) -> bool {
    let address = from.ipv4();
    let socket = from.enter(move || UdpSocket::bind((address, 0)).unwrap());
    (0..5).any(|_| {
        // A packet that cannot be sent counts as not received.
        let _ = socket.send_to(b"x", to);
        receiver.recv(&mut [0; 8]).is_ok()
    })
}
