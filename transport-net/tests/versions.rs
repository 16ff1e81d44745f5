//! Peers whose frames have another version of the protocol: both sides say which version each has.
#![cfg(feature = "quic")]
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::{UnixListener, UnixStream};
use std::time::Duration;

use common::certificates::Host;
use common::intruder::{
    ONLY_13, PROTOCOL, ROGUE, answer_tls, client, listen_quic, quic, say_quic, say_tls, server,
};
use common::{NAME, Party, Recorder, config, parcel, quic_config, unix_config};
use fipa_testbed::{frame, until_some};
use fipa_transport::{
    Conclusion, Incarnation, Kind, Location, Transport, TransportError, TransportErrorKind,
};
use fipa_transport_net::{QuicTransport, Refusals, TcpTransport, UnixTransport};

const HELLO: u8 = 1;
const GOODBYE: u8 = 6;

/// The version of this side.
const VERSION: u8 = 3;

/// Earlier and later versions.
const OTHERS: [u8; 3] = [0, 1, 9];

/// Time after which a hung test fails.
const WATCHDOG: Duration = Duration::from_secs(60);

const REMEDY: &str = "install the same release of fipa on both hosts";

/// A hello of this version. Its body has another layout.
fn hello(version: u8) -> Vec<u8> {
    let mut hello = frame(HELLO, 0, b"the body of a hello of another version");
    hello[4] = version;
    hello
}

/// Asserts that a peer of any version learns the version of this side from its answer.
fn assert_tells_its_version(answer: &[u8]) {
    assert_eq!(&answer[..4], b"fipa");
    assert_eq!(answer[4..6], [VERSION, GOODBYE]);
}

fn assert_names_versions(text: &str, peer: u8) {
    let peer = format!("the peer has version {peer} of the protocol");
    let own = format!("this host has version {VERSION}");
    for part in [&peer, &own, REMEDY] {
        assert!(text.contains(part), "{text}");
    }
    assert!(!text.contains("keys"), "{text}");
}

fn not_sent<T: Transport>(from: &Party<T>, attempt: u64, to: &Location) -> TransportError {
    from.send(attempt, to, parcel(attempt, "hello")).unwrap();
    match from.conclusion(attempt) {
        Conclusion::NotSent(error) => error,
        other => panic!("{other:?}"),
    }
}

/// Asserts that the latest refusal names this version.
fn assert_listed(refusals: &Refusals, peer: u8) {
    let version = format!("version {peer} ");
    let latest = until_some("the refusal", || {
        let latest = refusals.latest().into_iter().next()?;
        latest.why.contains(&version).then_some(latest)
    });
    assert!(latest.from.is_loopback());
    assert_names_versions(&latest.why, peer);
}

#[test]
fn a_peer_of_another_version_gets_one_frame_and_is_listed() {
    let config = config(&["127.0.0.1:0"]);
    let refusals = config.refusals.clone();
    let to = Party::with(config);
    for (number, version) in OTHERS.into_iter().enumerate() {
        // The header of another version may be shorter, and more may follow.
        let said = match version {
            9 => hello(version)[..8].to_vec(),
            _ => hello(version),
        };
        let mut stream = TcpStream::connect(to.location().address()).unwrap();
        stream.set_read_timeout(Some(WATCHDOG)).unwrap();
        stream.write_all(&said).unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        assert_tells_its_version(&answer);
        assert_eq!(answer.len(), 24, "one frame");
        assert_listed(&refusals, version);
        assert_eq!(to.transport.counters().refused_nonsense, number as u64 + 1);
    }
    assert_eq!(to.arrivals(), 0);
    assert!(to.sink.record.lock().introduced.is_empty());
}

#[test]
fn a_peer_of_another_version_that_goes_on_sending_is_cut_off() {
    // More than the kernel buffers.
    const MOST: usize = 256 << 20;
    let to = Party::new();
    let mut stream = TcpStream::connect(to.location().address()).unwrap();
    stream.set_write_timeout(Some(WATCHDOG)).unwrap();
    stream.write_all(&hello(9)).unwrap();
    let more = vec![0; 1 << 20];
    let mut sent = 0;
    let error = loop {
        match stream.write(&more) {
            Ok(len) => sent += len,
            Err(error) => break error.kind(),
        }
        assert!(sent < MOST, "the peer is read without end");
    };
    let is_cut = matches!(error, ErrorKind::BrokenPipe | ErrorKind::ConnectionReset);
    assert!(is_cut, "{error:?}");
}

#[test]
fn the_sender_learns_which_version_the_peer_answered_with() {
    let from = Party::new();
    for (attempt, version) in (1..).zip(OTHERS) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let at = listener.local_addr().unwrap().to_string();
        let peer = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            let mut received = [0; 8];
            stream.read_exact(&mut received).unwrap();
            let said = match version {
                9 => hello(version)[..8].to_vec(),
                _ => hello(version),
            };
            stream.write_all(&said).unwrap();
            // Until the other side closes the connection.
            let mut rest = Vec::new();
            let _ = stream.read_to_end(&mut rest);
            received
        });
        let to = Location::new(Kind::Tcp, &at).unwrap();
        let error = not_sent(&from, attempt, &to);
        assert_eq!(error.fault, TransportErrorKind::Incompatible, "{error}");
        assert_names_versions(&error.to_string(), version);
        let received = peer.join().unwrap();
        assert_eq!(received[..6], *b"fipa\x03\x01", "the hello of this side");
    }
}

/// Gateways of earlier releases close the connection without an answer.
#[test]
fn without_an_answer_another_version_is_one_of_the_possible_causes() {
    let from = Party::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap().to_string();
    let peer = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let _ = stream.read(&mut [0; 1000]);
    });
    let error = not_sent(&from, 1, &Location::new(Kind::Tcp, &at).unwrap());
    peer.join().unwrap();
    assert_eq!(error.fault, TransportErrorKind::Incompatible, "{error}");
    for part in ["possible causes", "set security.keys here", REMEDY] {
        assert!(error.detail.contains(part), "{error}");
    }
}

#[test]
fn versions_are_told_over_tls() {
    let (rogue, crex) = (Host::new(ROGUE, &[]), Host::new(NAME, &[]));
    let mut config = config(&["127.0.0.1:0"]);
    config.security = Some(crex.security(&[&rogue]));
    let refusals = config.refusals.clone();
    let party: Party<TcpTransport> = Party::with(config);
    let own = client(Some(&rogue), ONLY_13);
    let answer = say_tls(own, party.location().address(), &hello(9)).unwrap();
    assert_tells_its_version(&answer);
    assert_listed(&refusals, 9);

    let (at, received) = answer_tls(server(&rogue, ONLY_13), hello(1));
    let to = Location::new(Kind::Tcp, &at.to_string()).unwrap();
    let error = not_sent(&party, 1, &to);
    assert_eq!(error.fault, TransportErrorKind::Incompatible, "{error}");
    assert_names_versions(&error.to_string(), 1);
    assert!(received.join().unwrap().unwrap().starts_with(b"fipa\x03"));
}

#[test]
fn versions_are_told_over_quic() {
    let (rogue, crex) = (Host::new(ROGUE, &[]), Host::new(NAME, &[]));
    let config = quic_config(&["127.0.0.1:0"], crex.security(&[&rogue]));
    let refusals = config.refusals.clone();
    let party = Party::over(Recorder::default(), |runtime| {
        QuicTransport::new(config, runtime)
    });
    let own = client(Some(&rogue), ONLY_13);
    let at = party.location().address();
    let answer = say_quic(quic(own.clone(), PROTOCOL, 1), at, &hello(9)).unwrap();
    assert_tells_its_version(&answer);
    assert_listed(&refusals, 9);
    // Another version of the protocol over QUIC.
    say_quic(quic(own, b"fipa/2", 1), at, &hello(9)).unwrap_err();
    let why = until_some("the refusal", || {
        let latest = refusals.latest().into_iter().next()?;
        latest.why.contains("fipa/1").then_some(latest.why)
    });
    assert!(why.contains(REMEDY), "{why}");

    let runtime = common::runtime();
    let _inside = runtime.enter();
    let listener = listen_quic(server(&rogue, ONLY_13), PROTOCOL);
    let at = listener.local_addr().unwrap().to_string();
    runtime.spawn(async move {
        let connection = listener.accept().await.unwrap().await.unwrap();
        let (mut send, _receive) = connection.accept_bi().await.unwrap();
        send.write_all(&hello(1)).await.unwrap();
        connection.closed().await;
    });
    let error = not_sent(&party, 1, &Location::new(Kind::Quic, &at).unwrap());
    assert_eq!(error.fault, TransportErrorKind::Incompatible, "{error}");
    assert_names_versions(&error.to_string(), 1);

    let other = listen_quic(server(&rogue, ONLY_13), b"fipa/2");
    let at = other.local_addr().unwrap().to_string();
    runtime.spawn(async move {
        while let Some(incoming) = other.accept().await {
            assert!(incoming.await.is_err());
        }
    });
    let error = not_sent(&party, 2, &Location::new(Kind::Quic, &at).unwrap());
    for part in ["no_application_protocol (120)", "fipa/1", REMEDY] {
        assert!(error.detail.contains(part), "{error}");
    }
}

#[test]
fn between_processes_of_one_host_the_remedy_is_about_the_processes() {
    const OWN: &str = "this process has version 3";
    const SAME: &str = "run both processes with the same release of fipa";
    let home = tempfile::tempdir().unwrap();
    let directory = home.path().join("unix");
    let config = unix_config(&directory);
    let party = Party::over(Recorder::default(), |runtime| {
        UnixTransport::new(config, runtime)
    });
    let own = directory.join(party.location().address());
    let mut stream = UnixStream::connect(own).unwrap();
    stream.set_read_timeout(Some(WATCHDOG)).unwrap();
    stream.write_all(&hello(9)).unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).unwrap();
    assert_tells_its_version(&answer);

    let name = Incarnation::random().to_string();
    let listener = UnixListener::bind(directory.join(&name)).unwrap();
    let peer = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(&hello(9)).unwrap();
        let mut rest = Vec::new();
        let _ = stream.read_to_end(&mut rest);
    });
    let error = not_sent(&party, 1, &Location::new(Kind::Unix, &name).unwrap());
    peer.join().unwrap();
    assert_eq!(error.fault, TransportErrorKind::Incompatible, "{error}");
    for part in ["version 9", OWN, SAME] {
        assert!(error.detail.contains(part), "{error}");
    }
}
