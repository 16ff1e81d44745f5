//! The networks that other tests rely on do what they say.

// The exception that clippy.toml makes for tests does not reach what they call.
#![allow(clippy::unwrap_used)]

use std::net::UdpSocket;
use std::time::Duration;

use fipa_testbed::{Host, Network};

#[test]
fn hosts_reach_each_other_unless_they_are_cut_off() {
    fipa_testbed::isolated("inside_hosts_reach_each_other", &[]);
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_hosts_reach_each_other() {
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
    two.hears_multicast(false);
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
    let patience = Some(Duration::from_millis(300));
    socket.set_read_timeout(patience).unwrap();
    socket
}

/// Sent again a few times: who is cut off never hears it, others need not at once.
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
        // What cannot be sent does not arrive.
        let _ = socket.send_to(b"x", to);
        receiver.recv(&mut [0; 8]).is_ok()
    })
}
