//! Peers that offer weaker security than two hosts with keys require are refused.
#![cfg(feature = "quic")]
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::io::{Read as _, Write as _};
use std::net::{TcpListener, UdpSocket};
use std::time::Duration;

use common::certificates::Host;
use common::intruder::{
    ONLY_13, PROTOCOL, ROGUE, Versions, client, greet_quic, greet_tls, hear_tls, listen_quic, quic,
    server,
};
use common::{NAME, Party, Recorder, config, hello_of, parcel, quic_config};
use fipa_testbed::{frame, until_some};
use fipa_transport::{Conclusion, Kind, Location, Transport, TransportErrorKind};
use fipa_transport_net::{QuicTransport, TcpTransport};
use rustls::version::TLS12;

const ONLY_12: Versions = &[&TLS12];

/// The version of RFC 9000, and the last draft before it.
const VERSION: u32 = 1;
const DRAFT: u32 = 0xff00_0022;

/// A host that trusts the rogue, so that only the rogue's settings are wrong, over TCP and over
/// QUIC.
struct Trusting {
    rogue: Host,
    tcp: Party<TcpTransport>,
    quic: Party<QuicTransport>,
}

impl Trusting {
    fn new() -> Self {
        let (rogue, crex) = (Host::new(ROGUE, &[]), Host::new(NAME, &[]));
        let security = crex.security(&[&rogue]);
        let mut tcp = config(&["127.0.0.1:0"]);
        tcp.security = Some(security.clone());
        let over_quic = quic_config(&["127.0.0.1:0"], security);
        Self {
            rogue,
            tcp: Party::with(tcp),
            quic: Party::over(Recorder::default(), |runtime| {
                QuicTransport::new(over_quic, runtime)
            }),
        }
    }

    fn tcp_at(&self) -> &str {
        self.tcp.location().address()
    }

    fn quic_at(&self) -> &str {
        self.quic.location().address()
    }

    fn assert_nothing_came(&self) {
        assert_eq!(self.tcp.arrivals() + self.quic.arrivals(), 0);
    }
}

/// Asserts that a letter to a wrong peer is not sent. Returns the error text.
fn assert_not_sent<T: Transport>(from: &Party<T>, kind: Kind, at: &str) -> String {
    let to = Location::new(kind, at).unwrap();
    from.send(1, &to, parcel(1, "secret")).unwrap();
    let Conclusion::NotSent(error) = from.conclusion(1) else {
        panic!("{:?}", from.conclusion(1));
    };
    assert_eq!(error.fault, TransportErrorKind::Unreachable, "{error}");
    error.to_string()
}

#[test]
fn a_peer_that_meets_all_requirements_is_admitted() {
    let to = Trusting::new();
    let own = client(Some(&to.rogue), ONLY_13);
    let greeted = greet_tls(own.clone(), to.tcp_at()).unwrap();
    assert!(greeted.starts_with(b"fipa"));
    let greeted = greet_quic(quic(own, PROTOCOL, VERSION), to.quic_at()).unwrap();
    assert!(greeted.starts_with(b"fipa"));
    until_some("his letter", || (to.tcp.arrivals() == 1).then_some(()));
}

#[test]
fn tls_1_2_is_refused() {
    let to = Trusting::new();
    let error = greet_tls(client(Some(&to.rogue), ONLY_12), to.tcp_at()).unwrap_err();
    assert!(error.contains("ProtocolVersion"), "{error}");
    to.assert_nothing_came();
    // Nor does this side use it when it dials.
    let (at, received) = hear_tls(server(&to.rogue, ONLY_12));
    assert_not_sent(&to.tcp, Kind::Tcp, &at.to_string());
    received.join().unwrap().unwrap_err();
    // A peer with TLS 1.3 is admitted.
    let (at, received) = hear_tls(server(&to.rogue, ONLY_13));
    let at = Location::new(Kind::Tcp, &at.to_string()).unwrap();
    to.tcp.send(2, &at, parcel(2, "hello")).unwrap();
    assert!(received.join().unwrap().unwrap().starts_with(b"fipa"));
}

#[test]
fn a_peer_without_a_certificate_or_its_key_is_refused() {
    let to = Trusting::new();
    let thief = to.rogue.thief();
    for own in [None, Some(&thief)] {
        greet_tls(client(own, ONLY_13), to.tcp_at()).unwrap_err();
        let config = quic(client(own, ONLY_13), PROTOCOL, VERSION);
        greet_quic(config, to.quic_at()).unwrap_err();
    }
    to.assert_nothing_came();
    until_some("all of it was counted", || {
        let (tcp, quic) = (to.tcp.transport.counters(), to.quic.transport.counters());
        (tcp.refused_unproved == 2 && quic.refused_unproved == 2).then_some(())
    });
}

#[test]
fn another_protocol_over_quic_is_refused() {
    let to = Trusting::new();
    let own = client(Some(&to.rogue), ONLY_13);
    for protocol in [&b"h3"[..], b"fipa/0"] {
        let config = quic(own.clone(), protocol, VERSION);
        let error = greet_quic(config, to.quic_at()).unwrap_err();
        // No application protocol (RFC 7301 section 3.2).
        assert!(error.contains("error 120"), "{error}");
    }
    to.assert_nothing_came();
    // Nor is a listener for another protocol accepted.
    let runtime = common::runtime();
    let _inside = runtime.enter();
    let other = listen_quic(server(&to.rogue, ONLY_13), b"h3");
    let at = other.local_addr().unwrap().to_string();
    runtime.spawn(async move {
        while let Some(incoming) = other.accept().await {
            assert!(incoming.await.is_err());
        }
    });
    let error = assert_not_sent(&to.quic, Kind::Quic, &at);
    // No application protocol (RFC 7301 section 3.2).
    assert!(error.contains("error 120"), "{error}");
}

#[test]
fn other_versions_of_quic_are_refused() {
    let to = Trusting::new();
    let own = client(Some(&to.rogue), ONLY_13);
    let error = greet_quic(quic(own, PROTOCOL, DRAFT), to.quic_at()).unwrap_err();
    assert!(error.contains("version"), "{error}");
    to.assert_nothing_came();
    // An unknown version only gets the list of supported versions (RFC 9000 section 6.1).
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket
        .set_read_timeout(Some(Duration::from_secs(30)))
        .unwrap();
    let mut packet = vec![0; 1200];
    packet[..7].copy_from_slice(&[0xc0, 0x1a, 0x2a, 0x3a, 0x4a, 1, 7]);
    socket.send_to(&packet, to.quic_at()).unwrap();
    let mut answer = [0; 1500];
    let len = socket.recv(&mut answer).unwrap();
    assert_eq!(answer[1..5], [0; 4], "no version negotiation");
    assert_eq!(answer[len - 4..len], VERSION.to_be_bytes());
    assert_eq!(to.quic.transport.counters().refused_unproved, 0);
}

#[test]
fn a_listener_without_tls_gets_only_a_client_hello() {
    let to = Trusting::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap().to_string();
    let listening = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        // A fipa endpoint without keys would accept this.
        stream
            .write_all(&frame(1, 0, &hello_of(ROGUE, 77)))
            .unwrap();
        let mut received = Vec::new();
        // A reset is equivalent to an end of stream.
        let _ = stream.read_to_end(&mut received);
        listener.set_nonblocking(true).unwrap();
        (received, listener.accept().is_ok())
    });
    assert_not_sent(&to.tcp, Kind::Tcp, &at);
    let (received, came_again) = listening.join().unwrap();
    assert_eq!(received.first(), Some(&22), "no TLS record");
    for word in [
        &b"fipa"[..],
        NAME.as_bytes(),
        b"secret",
        b"arm_1",
        b"envelope",
    ] {
        let is_there = received.windows(word.len()).any(|part| part == word);
        assert!(
            !is_there,
            "{:?} in the clear",
            String::from_utf8_lossy(word)
        );
    }
    assert!(!came_again, "the dialler fell back to another protocol");
}
