//! The UDP endpoint on loopback: names, and hostile peers.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::net::UdpSocket;
use std::sync::Arc;
use std::time::Duration;

use common::{Recorder, accepted, parcel, rogue_hello, runtime, udp_config, written};
use fipa_testbed::until_some;
use fipa_transport::{AttemptId, Conclusion, Kind, Location, Sink, Transport, TransportErrorKind};
use fipa_transport_net::{UdpConfig, UdpTransport};

struct Party {
    transport: UdpTransport,
    sink: Arc<Recorder>,
    location: Location,
    _runtime: common::Threads,
}

impl Party {
    fn new() -> Self {
        Self::with(udp_config(&["127.0.0.1:0"]))
    }

    fn with(config: UdpConfig) -> Self {
        let runtime = runtime();
        let transport = UdpTransport::new(config, runtime.handle().clone());
        let sink = Arc::new(Recorder::default());
        let locations = transport
            .listen(Arc::clone(&sink) as Arc<dyn Sink>)
            .unwrap();
        Self {
            transport,
            sink,
            location: locations[0].clone(),
            _runtime: runtime,
        }
    }

    fn conclusion(&self, attempt: u64) -> Conclusion {
        until_some("a conclusion", || {
            let record = self.sink.record.lock();
            record.concluded.get(&AttemptId(attempt))?.first().cloned()
        })
    }

    fn assert_reaches(&self, attempt: u64, to: &Location) {
        self.transport
            .post(AttemptId(attempt), to, parcel(attempt, "there?"))
            .unwrap();
        assert_eq!(self.conclusion(attempt), accepted());
    }
}

/// The socket of an unproved peer, connected to an endpoint.
fn unknown_peer(to: &Party) -> UdpSocket {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    socket.connect(to.location.address()).unwrap();
    socket
        .set_read_timeout(Some(Duration::from_secs(60)))
        .unwrap();
    socket
}

fn hello(number: u64, cookie: [u8; 16]) -> Vec<u8> {
    let mut bytes = b"fipa\x03\x01\0\0".to_vec();
    bytes.extend([0; 8]);
    bytes.extend(number.to_le_bytes());
    bytes.extend(cookie);
    bytes.resize(1200, 0);
    bytes
}

#[test]
fn a_name_resolves_to_the_address_that_answers() {
    let (near, far) = (Party::new(), Party::new());
    let port = far.location.address().rsplit_once(':').unwrap().1;
    let named = Location::new(Kind::Udp, &format!("localhost:{port}")).unwrap();
    near.assert_reaches(1, &named);
    let unknown = Location::new(Kind::Udp, "nobody.invalid:7").unwrap();
    near.transport
        .post(AttemptId(2), &unknown, parcel(1, "x"))
        .unwrap();
    match near.conclusion(2) {
        Conclusion::NotSent(error) => {
            assert_eq!(error.fault, TransportErrorKind::Unreachable, "{error}")
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_flood_of_garbage_blocks_no_peer_and_leaves_no_state() {
    let (near, far) = (Party::new(), Party::new());
    near.assert_reaches(0, &far.location);
    let socket = unknown_peer(&far);
    let mut random = fastrand::Rng::with_seed(1);
    for round in 1..=50 {
        for _ in 0..400 {
            let mut bytes: Vec<u8> = (0..random.usize(0..200)).map(|_| random.u8(..)).collect();
            if random.bool() && bytes.len() > 6 {
                bytes[..5].copy_from_slice(b"fipa\x03");
                bytes[5] %= 8;
            }
            // Datagrams beyond the receive buffer are lost.
            let _ = socket.send(&bytes);
        }
        near.assert_reaches(round, &far.location);
    }
    let counters = far.transport.counters();
    assert!(counters.ignored > 0);
    assert_eq!((counters.accepted, counters.connections), (1, 1));
}

#[test]
fn hellos_without_a_cookie_take_no_memory_and_get_little() {
    let (near, far) = (Party::new(), Party::new());
    let socket = unknown_peer(&far);
    let mut replies = 0;
    let mut reply = [0; 2048];
    for number in 1..=2000_u64 {
        socket.send(&hello(number, [0; 16])).unwrap();
        socket.send(&hello(number, [7; 16])).unwrap();
        let len = socket.recv(&mut reply).unwrap();
        assert!(len <= 64, "{len} bytes for a stranger");
        replies += 1;
    }
    assert_eq!(replies, 2000);
    let counters = far.transport.counters();
    assert_eq!((counters.accepted, counters.connections), (0, 0));
    near.assert_reaches(1, &far.location);
}

/// Opens a connection as a hostile peer. Returns it with its number at the other side.
fn introduced(to: &Party, incarnation: u64) -> (UdpSocket, u64) {
    let socket = unknown_peer(to);
    let mut reply = [0; 2048];
    socket.send(&hello(1, [0; 16])).unwrap();
    socket.recv(&mut reply).unwrap();
    assert_eq!(reply[5], 2, "a cookie");
    let cookie = reply[16..32].try_into().unwrap();
    let mut bytes = hello(1, cookie);
    let body = rogue_hello(incarnation);
    bytes[40..42].copy_from_slice(&(body.len() as u16).to_le_bytes());
    bytes[42..42 + body.len()].copy_from_slice(&body);
    socket.send(&bytes).unwrap();
    socket.recv(&mut reply).unwrap();
    assert_eq!(reply[5], 3, "a welcome");
    (
        socket,
        u64::from_le_bytes(reply[16..24].try_into().unwrap()),
    )
}

/// A data packet of a connection.
fn packet(to: u64, number: u64, frames: &[u8]) -> Vec<u8> {
    let mut bytes = b"fipa\x03\x06\0\0".to_vec();
    bytes.extend(to.to_le_bytes());
    bytes.extend(number.to_le_bytes());
    bytes.extend(frames);
    bytes
}

#[test]
fn a_malformed_packet_after_the_handshake_ends_only_its_connection() {
    let (near, far) = (Party::new(), Party::new());
    near.assert_reaches(0, &far.location);
    let mut acknowledgement = vec![1];
    acknowledgement.extend(1_000_u64.to_le_bytes());
    acknowledgement.extend([0; 5]);
    let answer = [&[3][..], &7_u64.to_le_bytes(), &[1, 0]].concat();
    let torn = [&[2][..], &1_u64.to_le_bytes(), b"half a header"].concat();
    let far_away = [&[5][..], &u64::MAX.to_le_bytes()].concat();
    let nonsense = [vec![99, 1, 2], acknowledgement, answer, torn, far_away];
    for (refused, frames) in (1..).zip(&nonsense) {
        let (socket, number) = introduced(&far, refused);
        socket.send(&packet(number, 1, frames)).unwrap();
        until_some("an end", || {
            let counters = far.transport.counters();
            let ended = counters.refused_nonsense == refused && counters.connections == 1;
            ended.then_some(())
        });
        near.assert_reaches(refused, &far.location);
    }
}

#[test]
fn letters_that_wait_for_one_that_never_comes_take_bounded_memory() {
    let mut narrow = udp_config(&["127.0.0.1:0"]);
    narrow.limits.max_in_flight = 64;
    narrow.limits.max_queued_bytes = 1 << 20;
    let (near, far) = (Party::new(), Party::with(narrow));
    near.assert_reaches(0, &far.location);
    let (many, large) = (introduced(&far, 1), introduced(&far, 2));
    // Never the first one. Datagrams beyond the receive buffer are lost.
    for id in 2..5_000_u64 {
        for ((socket, number), len) in [(&many, 1), (&large, 60_000)] {
            let body = written(&parcel(id, vec![0; len]));
            let frames = [&[2][..], &id.to_le_bytes(), &body].concat();
            let _ = socket.send(&packet(*number, id, &frames));
        }
        if id % 500 == 0 {
            near.assert_reaches(id, &far.location);
        }
    }
    let counters = far.transport.counters();
    assert_eq!(counters.connections, 3);
    let waiting = counters.parcels_in - near.transport.counters().parcels_out;
    // The maximum number of letters of one peer, and 1 MiB of letters of the other.
    let most = 64 + (1 << 20) / 60_000;
    assert!((65..=most).contains(&waiting), "{waiting} of {most}");
    // No letter was delivered before its turn.
    assert_eq!(far.sink.record.lock().arrivals.len(), 10);
    near.assert_reaches(1, &far.location);
}

#[test]
fn a_peer_that_stops_answering_is_given_up() {
    let mut impatient = udp_config(&["127.0.0.1:0"]);
    impatient.limits.connect_timeout = Duration::from_millis(300);
    let near = Party::with(impatient);
    // A peer that receives and never sends.
    let mute = UdpSocket::bind("127.0.0.1:0").unwrap();
    let to = Location::new(Kind::Udp, &mute.local_addr().unwrap().to_string()).unwrap();
    for attempt in 0..3 {
        near.transport
            .post(AttemptId(attempt), &to, parcel(attempt, "x"))
            .unwrap();
    }
    for attempt in 0..3 {
        match near.conclusion(attempt) {
            Conclusion::NotSent(error) => {
                assert_eq!(error.fault, TransportErrorKind::Unreachable, "{error}")
            }
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(near.transport.counters().connections, 0);
}

#[test]
fn an_unreachable_peer_is_detected_by_an_error_of_the_system() {
    let near = Party::new();
    let far = Party::new();
    near.assert_reaches(1, &far.location);
    let gone = far.location.clone();
    drop(far);
    let port = gone.address().to_owned();
    // The peer is gone, and no other socket takes its port meanwhile.
    let same = UdpSocket::bind(&port).unwrap();
    same.connect(same.local_addr().unwrap()).unwrap();
    let sent = near
        .transport
        .post(AttemptId(2), &gone, parcel(2, "x"))
        .map(|()| near.conclusion(2));
    match sent {
        Ok(Conclusion::NotSent(error)) => {
            assert_eq!(error.fault, TransportErrorKind::Unreachable, "{error}")
        }
        // The letter was sent before the goodbye arrived.
        Ok(Conclusion::Unconfirmed(error)) => {
            assert_eq!(error.fault, TransportErrorKind::Broken, "{error}")
        }
        other => panic!("{other:?}"),
    }
}
