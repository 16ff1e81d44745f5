//! Properties of QUIC: changes of address, independent letters, and hostile packets.
#![cfg(feature = "quic")]
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU16, Ordering};
use std::time::Duration;

use common::certificates::Host;
use common::{NAME, Party, Recorder, accepted, parcel, quic_config};
use fipa_testbed::until_some;
use fipa_transport::{Conclusion, Kind, Location, TransportErrorKind};
use fipa_transport_net::{QuicConfig, QuicTransport};

fn party(config: QuicConfig) -> Party<QuicTransport> {
    Party::over(Recorder::default(), |runtime| {
        QuicTransport::new(config, runtime)
    })
}

fn friends() -> (Party<QuicTransport>, Party<QuicTransport>) {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let of = |own: &Host, other: &Host| quic_config(&["127.0.0.1:0"], own.security(&[other]));
    (party(of(&rover, &crex)), party(of(&crex, &rover)))
}

/// A relay between two endpoints that can change the address seen by the accepting one.
struct Relay {
    front: SocketAddr,
    /// The port that the endpoint behind it sees.
    seen: Arc<AtomicU16>,
    moves: Arc<AtomicBool>,
    ended: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<()>>,
}

impl Relay {
    fn before(behind: SocketAddr) -> Self {
        let front = UdpSocket::bind("127.0.0.1:0").unwrap();
        let at = front.local_addr().unwrap();
        let (seen, moves, ended) = (
            Arc::new(AtomicU16::new(0)),
            Arc::new(AtomicBool::new(false)),
            Arc::new(AtomicBool::new(false)),
        );
        let (port, change, end) = (seen.clone(), moves.clone(), ended.clone());
        let fresh = move || {
            let back = UdpSocket::bind("127.0.0.1:0").unwrap();
            back.set_nonblocking(true).unwrap();
            port.store(back.local_addr().unwrap().port(), Ordering::SeqCst);
            back
        };
        front
            .set_read_timeout(Some(Duration::from_millis(1)))
            .unwrap();
        let thread = std::thread::spawn(move || {
            let (mut back, mut client) = (fresh(), None);
            let mut packet = vec![0; 65_536];
            while !end.load(Ordering::SeqCst) {
                if change.swap(false, Ordering::SeqCst) {
                    back = fresh();
                }
                if let Ok((len, from)) = front.recv_from(&mut packet) {
                    client = Some(from);
                    back.send_to(&packet[..len], behind).unwrap();
                }
                while let (Ok((len, _)), Some(client)) = (back.recv_from(&mut packet), client) {
                    front.send_to(&packet[..len], client).unwrap();
                }
            }
        });
        Self {
            front: at,
            seen,
            moves,
            ended,
            thread: Some(thread),
        }
    }

    fn location(&self) -> Location {
        Location::new(Kind::Quic, &self.front.to_string()).unwrap()
    }

    /// Changes its address, and waits for the change.
    fn relocate(&self) {
        let before = self.seen.load(Ordering::SeqCst);
        self.moves.store(true, Ordering::SeqCst);
        until_some("another address", || {
            (self.seen.load(Ordering::SeqCst) != before).then_some(())
        });
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::SeqCst);
        self.thread.take().unwrap().join().unwrap();
    }
}

#[test]
fn a_connection_outlives_a_change_of_address() {
    let (from, to) = friends();
    let relay = Relay::before(to.location().address().parse().unwrap());
    let location = relay.location();
    for attempt in 1..=30 {
        from.send(attempt, &location, parcel(attempt, "on the way"))
            .unwrap();
        if attempt % 10 == 5 {
            // Some letters are in flight.
            relay.relocate();
        }
        if attempt % 3 == 0 {
            assert_eq!(from.conclusion(attempt), accepted());
        }
    }
    for attempt in 1..=30 {
        assert_eq!(from.conclusion(attempt), accepted(), "{attempt}");
    }
    let record = to.sink.record.lock();
    let arrived: Vec<u64> = record.arrivals.iter().map(|it| it.0.sequence).collect();
    assert_eq!(arrived, (1..=30).collect::<Vec<_>>());
    assert_eq!(from.transport.counters().dialed, 1, "the same connection");
    assert_eq!(to.transport.counters().accepted, 1);
}

#[test]
fn many_large_letters_arrive_in_order() {
    let (from, to) = friends();
    // More than the windows hold, and more than there are streams.
    for attempt in 1..=100 {
        let content = vec![attempt as u8; 700_000];
        from.send(attempt, to.location(), parcel(attempt, content))
            .or_else(|error| match error.fault {
                TransportErrorKind::Congested => {
                    assert_eq!(from.conclusion(attempt - 40), accepted());
                    let content = vec![attempt as u8; 700_000];
                    from.send(attempt, to.location(), parcel(attempt, content))
                }
                _ => Err(error),
            })
            .unwrap();
    }
    for attempt in 1..=100 {
        assert_eq!(from.conclusion(attempt), accepted(), "{attempt}");
    }
    let record = to.sink.record.lock();
    let arrived: Vec<u64> = record.arrivals.iter().map(|it| it.0.sequence).collect();
    assert_eq!(arrived, (1..=100).collect::<Vec<_>>());
    for (arrived, _, _) in &record.arrivals {
        let content = vec![arrived.sequence as u8; 700_000];
        assert_eq!(*arrived, parcel(arrived.sequence, content));
    }
}

#[test]
fn malformed_packets_have_no_effect() {
    let (from, to) = friends();
    from.assert_reaches(1, &to);
    let hostile = UdpSocket::bind("127.0.0.1:0").unwrap();
    let at = to.location().address();
    for number in 0..2000_u64 {
        let mut random = fastrand::Rng::with_seed(number);
        let mut packet: Vec<u8> = (0..random.usize(1..1300)).map(|_| random.u8(..)).collect();
        if number % 2 == 0 {
            // Resembles the first packet of a connection (RFC 9000 section 17.2.2).
            packet.resize(1200, 0);
            packet[..6].copy_from_slice(&[0xc3, 0, 0, 0, 1, 8]);
        }
        // The socket may be full; further packets follow.
        let _ = hostile.send_to(&packet, at);
    }
    from.assert_reaches(2, &to);
    assert_eq!(from.transport.counters().dialed, 1);
}

#[test]
fn an_unfinished_handshake_is_dropped() {
    let (rover, crex) = (Host::new(NAME, &[]), Host::new(NAME, &[]));
    let mut config = quic_config(&["127.0.0.1:0"], crex.security(&[&rover]));
    config.limits.handshake_timeout = Duration::from_secs(2);
    config.limits.max_strangers = 4;
    let to = party(config);
    let at: SocketAddr = to.location().address().parse().unwrap();
    // First packets of real handshakes, whose answers are not read.
    let mut silent = Vec::new();
    for _ in 0..8 {
        let trap = UdpSocket::bind("127.0.0.1:0").unwrap();
        trap.set_read_timeout(Some(Duration::from_secs(30)))
            .unwrap();
        let location = Location::new(Kind::Quic, &trap.local_addr().unwrap().to_string()).unwrap();
        let config = quic_config(&[], rover.security(&[&crex]));
        let caller = party(config);
        caller.send(1, &location, parcel(1, "hello?")).unwrap();
        let mut packet = vec![0; 65_536];
        let (len, _) = trap.recv_from(&mut packet).unwrap();
        trap.send_to(&packet[..len], at).unwrap();
        silent.push((trap, caller));
    }
    until_some("they are let go", || {
        (to.transport.counters().refused_unproved >= 2).then_some(())
    });
    let honest = party(quic_config(&["127.0.0.1:0"], rover.security(&[&crex])));
    honest.assert_reaches(1, &to);
}

#[test]
fn a_peer_without_quic_is_reported_in_time() {
    let (from, _to) = friends();
    let silent = UdpSocket::bind("127.0.0.1:0").unwrap();
    let location = Location::new(Kind::Quic, &silent.local_addr().unwrap().to_string()).unwrap();
    from.send(1, &location, parcel(1, "hello?")).unwrap();
    let Conclusion::NotSent(error) = from.conclusion(1) else {
        panic!("{:?}", from.conclusion(1));
    };
    assert_eq!(error.fault, TransportErrorKind::Unreachable);
}
