//! Legacy peers and hostile peers: raw bytes sent to the port.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::{Arc, Barrier};
use std::thread::JoinHandle;
use std::time::Duration;

use common::{Party, accepted, config, parcel, rogue_hello, written};
use fipa_acl::Envelope;
use fipa_testbed::{frame_header, until_some};
use fipa_transport::{
    Conclusion, Kind, Location, Parcel, Reaction, Transport as _, TransportErrorKind,
};
use fipa_transport_net::{Counters, NetLimits};
use socket2::{Domain, Socket, Type};

/// A recorded letter of a fipa_services peer.
const TCP_LETTER: &[u8] = include_bytes!("data/tcp_letter.bin");

/// A recorded letter of that peer to a JADE location: XML envelope, string message.
const TCP_LETTER_JADE: &[u8] = include_bytes!("data/tcp_letter_jade.bin");

fn impatient() -> Party {
    let mut config = config(&["127.0.0.1:0"]);
    config.limits.handshake_timeout = Duration::from_secs(1);
    config.limits.stall_timeout = Duration::from_secs(1);
    Party::with(config)
}

fn connect(to: &Party) -> TcpStream {
    let stream = TcpStream::connect(to.location().address()).unwrap();
    // A watchdog for reads that never end.
    stream
        .set_read_timeout(Some(Duration::from_secs(60)))
        .unwrap();
    stream
}

/// Waits until the other side closes the connection.
fn assert_shut_out(stream: &mut TcpStream) {
    let mut bytes = [0; 1024];
    loop {
        match stream.read(&mut bytes) {
            Ok(0) => return,
            Ok(_) => {}
            Err(error) => {
                assert_eq!(error.kind(), std::io::ErrorKind::ConnectionReset, "{error}");
                return;
            }
        }
    }
}

fn counted(party: &Party, what: impl Fn(&Counters) -> u64, expected: u64) {
    until_some("a counter", || {
        (what(&party.transport.counters()) == expected).then_some(())
    });
}

fn hello(incarnation: u64) -> Vec<u8> {
    fipa_testbed::frame(1, 1, &rogue_hello(incarnation))
}

/// A parcel frame of a hostile peer.
fn frame(id: u64, parcel: &Parcel) -> Vec<u8> {
    fipa_testbed::frame(2, id, &written(parcel))
}

#[test]
fn recorded_letters_of_legacy_peers_arrive_in_the_standard_dialect() {
    arrives_in_the_standard_dialect(TCP_LETTER);
    arrives_in_the_standard_dialect(TCP_LETTER_JADE);
}

fn arrives_in_the_standard_dialect(recorded: &[u8]) {
    let (original, length) = Envelope::decode(recorded).unwrap();
    let party = Party::new();
    for (number, step) in [recorded.len(), 7].into_iter().enumerate() {
        let mut stream = connect(&party);
        for piece in recorded.chunks(step) {
            stream.write_all(piece).unwrap();
        }
        stream.shutdown(Shutdown::Write).unwrap();
        counted(&party, |c| c.unframed_in, number as u64 + 1);
    }
    let record = until_some("both letters", || {
        let record = party.sink.record.lock();
        (record.unframed.len() == 2).then_some(record)
    });
    for (letter, via) in &record.unframed {
        assert_eq!(*via, Kind::Tcp);
        assert_ne!(letter.envelope(), recorded[..length]);
        let (envelope, read) = Envelope::decode(&letter.envelope()).unwrap();
        assert_eq!(read, letter.envelope_len());
        assert_eq!(envelope.encode_standard().unwrap(), letter.envelope());
        assert_eq!(envelope.effective(), original.effective());
        let receivers = envelope.effective().intended_receivers;
        let names: Vec<&str> = receivers.iter().map(|receiver| receiver.name()).collect();
        assert_eq!(names, ["echo"]);
        assert_eq!(letter.payload().to_bytes(), recorded[length..]);
    }
}

#[test]
fn malformed_letters_are_refused() {
    let party = impatient();
    let garbage: [&[u8]; 9] = [
        b"GET / HTTP/1.1\r\n\r\n",
        b"\0",
        b"fipX",
        &frame_header(1, 1, 1 << 40),
        &frame_header(99, 1, 0),
        &frame_header(4, 1, 0),
        &[0xfe, 0xff, 0xff, 0xff],
        b"<?xml version=\"1.0\"?><envelope>",
        b"<!DOCTYPE html><html/>",
    ];
    for bytes in garbage {
        let mut stream = connect(&party);
        // The other side may close the connection before all bytes are written.
        let _ = stream.write_all(bytes);
        let _ = stream.shutdown(Shutdown::Write);
        assert_shut_out(&mut stream);
    }
    counted(&party, |c| c.refused_nonsense, garbage.len() as u64);
    Party::new().assert_reaches(1, &party);
}

#[test]
fn slow_connections_are_closed_without_effect_on_others() {
    let party = impatient();
    let mut after_hello = hello(76);
    after_hello.extend(&frame_header(2, 1, 1000)[..10]);
    let mut half_a_parcel = hello(77);
    half_a_parcel.extend(frame_header(2, 1, 60 << 20));
    let beginnings: [&[u8]; 5] = [b"", b"fip", &after_hello, &half_a_parcel, &TCP_LETTER[..20]];
    let streams: Vec<TcpStream> = beginnings
        .iter()
        .map(|beginning| {
            let mut stream = connect(&party);
            stream.write_all(beginning).unwrap();
            stream
        })
        .collect();
    Party::new().assert_reaches(1, &party);
    for (index, mut stream) in streams.into_iter().enumerate() {
        // Single bytes do not save connections that began properly.
        let mut drip = stream.try_clone().unwrap();
        let dripping = std::thread::spawn(move || {
            while index >= 2 && drip.write_all(b"\0").is_ok() {
                std::thread::sleep(Duration::from_millis(50));
            }
        });
        assert_shut_out(&mut stream);
        dripping.join().unwrap();
    }
    counted(&party, |c| c.refused_nonsense, beginnings.len() as u64);
    counted(&party, |c| c.connections, 0);
    assert_eq!(party.arrivals(), 1);
}

#[test]
fn announcing_gigabytes_is_refused_at_once() {
    let party = Party::new();
    let mut stream = connect(&party);
    let mut bytes = hello(77);
    bytes.extend(frame_header(2, 1, 4 << 30));
    stream.write_all(&bytes).unwrap();
    assert_shut_out(&mut stream);
    counted(&party, |c| c.refused_nonsense, 1);
}

#[test]
fn a_letter_of_a_legacy_peer_is_bounded() {
    let mut small = config(&["127.0.0.1:0"]);
    small.limits.max_letter = 100_000;
    let party = Party::with(small);
    let mut stream = connect(&party);
    let piece = [0xfe; 10_000];
    while stream.write_all(&piece).is_ok() {}
    assert_shut_out(&mut stream);
    counted(&party, |c| c.refused_nonsense, 1);
}

#[test]
fn a_thousand_silent_connections_hold_few_descriptors_and_block_no_peer() {
    let party = Party::new();
    let max = NetLimits::default().max_strangers as u64;
    let mut streams: Vec<TcpStream> = Vec::new();
    for _ in 0..1000 {
        streams.push(connect(&party));
        if streams.len() > 200 {
            // Evicted connections are closed here too: the test has few descriptors.
            let mut oldest = streams.remove(0);
            assert_shut_out(&mut oldest);
        }
    }
    Party::new().assert_reaches(1, &party);
    // The honest peer has evicted one more, unless it came and went before the last silent ones
    // lost their turn.
    until_some("those that are too many are pushed out", || {
        (party.transport.counters().refused_crowd >= 1000 - max).then_some(())
    });
}

#[test]
fn introduced_peers_beyond_the_limit_are_refused_with_a_reason() {
    let mut few = config(&["127.0.0.1:0"]);
    few.limits.max_connections = 4;
    let party = Party::with(few);
    // All loopback addresses together have half of the slots.
    let peers: Vec<Party> = (0..5).map(|_| Party::new()).collect();
    peers[0].assert_reaches(1, &party);
    peers[1].assert_reaches(1, &party);
    peers[2].send(1, party.location(), parcel(1, "x")).unwrap();
    match peers[2].conclusion(1) {
        Conclusion::NotSent(error) => {
            assert_eq!(error.fault, TransportErrorKind::Refused, "{error}")
        }
        other => panic!("{other:?}"),
    }
    // The other slots are for connections that this side opens, and for other hosts.
    party.assert_reaches(1, &peers[2]);
    party.assert_reaches(2, &peers[3]);
    let error = party
        .send(3, peers[4].location(), parcel(1, "x"))
        .unwrap_err();
    assert_eq!(error.fault, TransportErrorKind::Congested, "{error}");
    peers[0].assert_reaches(2, &party);
}

#[test]
fn a_server_of_another_protocol_is_incompatible() {
    let party = Party::new();
    for (attempt, greeting) in [&b"SSH-2.0-OpenSSH_9.6\r\n"[..], b""]
        .into_iter()
        .enumerate()
    {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap().to_string();
        let server = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            stream.write_all(greeting).unwrap();
            // Reads the received bytes, so that closing sends no reset.
            let _ = stream.read(&mut [0; 1000]);
        });
        let to = Location::new(Kind::Tcp, &address).unwrap();
        party.send(attempt as u64, &to, parcel(1, "x")).unwrap();
        match party.conclusion(attempt as u64) {
            Conclusion::NotSent(error) => {
                assert_eq!(error.fault, TransportErrorKind::Incompatible, "{error}")
            }
            other => panic!("{other:?}"),
        }
        server.join().unwrap();
    }
}

#[test]
fn a_peer_that_stops_reading_is_given_up() {
    let mut lively = config(&["127.0.0.1:0"]);
    lively.limits.keep_alive = Duration::from_millis(300);
    let party = Party::with(lively);
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let server = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(&hello(77)).unwrap();
        stream
    });
    let to = Location::new(Kind::Tcp, &address).unwrap();
    // More than the buffers of the system hold.
    for attempt in 0..3 {
        party
            .send(attempt, &to, parcel(attempt, vec![0; 16 << 20]))
            .unwrap();
    }
    match party.conclusion(0) {
        Conclusion::Unconfirmed(error) => {
            assert_eq!(error.fault, TransportErrorKind::TimedOut, "{error}")
        }
        other => panic!("{other:?}"),
    }
    match party.conclusion(2) {
        Conclusion::NotSent(error) => {
            assert_eq!(error.fault, TransportErrorKind::TimedOut, "{error}")
        }
        other => panic!("{other:?}"),
    }
    drop(server.join().unwrap());
}

/// The test also fails if a thread spins: the socket of a broken connection is always writable.
#[test]
fn a_peer_that_resets_during_the_goodbye_blocks_nothing() {
    let party = Party::new();
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let server = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.write_all(&hello(77)).unwrap();
        stream.read_exact(&mut [0; 100_000]).unwrap();
        stream
    });
    let to = Location::new(Kind::Tcp, &address).unwrap();
    // More than the buffers of the system hold: the goodbye waits behind it.
    party.send(1, &to, parcel(1, vec![0; 16 << 20])).unwrap();
    let peer = server.join().unwrap();
    party.transport.close();
    match party.conclusion(1) {
        Conclusion::Unconfirmed(error) => {
            assert_eq!(error.fault, TransportErrorKind::Closed, "{error}")
        }
        other => panic!("{other:?}"),
    }
    // Closing with unread bytes sends a reset.
    drop(peer);
    until_some("every task has ended", || {
        (party.runtime.metrics().num_alive_tasks() == 0).then_some(())
    });
}

#[test]
fn a_flooding_peer_is_closed_without_effect_on_others() {
    let mut narrow = config(&["127.0.0.1:0"]);
    narrow.limits.max_in_flight = 64;
    // One side has as many unanswered parcels as allowed; the other answers, and its answers are
    // not read.
    let late = Party::judging(narrow.clone(), Reaction::Later);
    let busy = Party::with(narrow);
    for party in [&late, &busy] {
        let mut stream = connect(party);
        stream.write_all(&hello(77)).unwrap();
        let mut sent = 0;
        let flood = (1..).map(|id| frame(id, &parcel(id, "x"))).map(|frame| {
            sent += 1;
            stream.write_all(&frame)
        });
        // Ends when the other side has closed the connection.
        let error = flood.into_iter().find_map(Result::err).unwrap();
        let kinds = [
            std::io::ErrorKind::ConnectionReset,
            std::io::ErrorKind::BrokenPipe,
        ];
        assert!(kinds.contains(&error.kind()), "{error}");
        assert!(sent > 64, "{sent}");
        counted(party, |c| c.refused_nonsense, 1);
        counted(party, |c| c.connections, 0);
    }
    // No more parcels than max_in_flight were accepted.
    assert_eq!(late.arrivals(), 64);
    Party::new().assert_reaches(1, &busy);
}

#[test]
fn memory_for_announced_content_is_bounded_without_effect_on_others() {
    const EACH: usize = 8 << 20;
    let mut generous = config(&["127.0.0.1:0"]);
    generous.limits.max_arriving = 20 << 20;
    let party = Party::lending(generous);
    let rogues: Vec<TcpStream> = (1..=5)
        .map(|n| {
            let mut stream = connect(&party);
            stream.write_all(&hello(n)).unwrap();
            // A letter of which only the start is sent.
            let letter = frame(1, &parcel(1, vec![0; EACH]));
            stream.write_all(&letter[..10_000]).unwrap();
            stream
        })
        .collect();
    counted(&party, |c| c.connections, 5);
    until_some("two places", || (party.lent().0 == 2 * EACH).then_some(()));
    // A peer that really sends gets memory too, or is served without it.
    let honest = Party::new();
    for (attempt, len) in [(1, 1 << 20), (2, EACH), (3, 100)] {
        let sent = parcel(attempt, vec![attempt as u8; len]);
        honest.send(attempt, party.location(), sent).unwrap();
        assert_eq!(honest.conclusion(attempt), accepted());
    }
    let (_, most) = party.lent();
    assert_eq!(most, 2 * EACH + (1 << 20));
    let counters = party.transport.counters();
    assert_eq!((counters.placed, counters.parcels_in), (1, 3));
    // A connection that ends releases its memory.
    drop(rogues);
    until_some("no place", || (party.lent().0 == 0).then_some(()));
}

/// A peer that sends a hello. From this start on, it announces a letter of `len` bytes, sends half of it, and then
/// just enough to keep the connection. Returns whether the connection was closed.
fn sends_half(
    party: &Party,
    incarnation: u64,
    len: usize,
    at_a_time: usize,
    start: &Arc<Barrier>,
) -> JoinHandle<bool> {
    let mut stream = connect(party);
    stream.write_all(&hello(incarnation)).unwrap();
    let start = Arc::clone(start);
    std::thread::spawn(move || {
        let letter = frame(1, &parcel(1, vec![0; len]));
        let (begun, rest) = letter.split_at(letter.len() / 2);
        let mut rest = rest.chunks(at_a_time);
        start.wait();
        let mut open = stream.write_all(begun).is_ok();
        while let Some(piece) = rest.next().filter(|_| open) {
            std::thread::sleep(Duration::from_millis(50));
            open = stream.write_all(piece).is_ok();
        }
        !open
    })
}

#[test]
fn half_letters_stay_within_the_memory_budget_and_block_no_peer() {
    const EACH: usize = 1 << 20;
    let mut small = config(&["127.0.0.1:0"]);
    small.limits.max_arriving = usize::MAX;
    small.limits.max_incoming = 4 * EACH;
    // Loopback has twice the limit.
    small.limits.max_incoming_per_source = EACH + EACH / 4;
    small.limits.stall_timeout = Duration::from_millis(500);
    // All of them together would have 32 MiB.
    let party = Party::lending(small);
    let start = Arc::new(Barrier::new(33));
    let rogues: Vec<JoinHandle<bool>> = (1..=32)
        .map(|n| sends_half(&party, n, EACH, 5000, &start))
        .collect();
    counted(&party, |c| c.connections, 32);
    start.wait();
    until_some("two letters", || (party.lent().0 == 2 * EACH).then_some(()));
    let honest = Party::new();
    for attempt in 1..=3 {
        let sent = parcel(attempt, vec![attempt as u8; EACH]);
        honest.send(attempt, party.location(), sent).unwrap();
    }
    for attempt in 1..=3 {
        assert_eq!(honest.conclusion(attempt), accepted());
    }
    assert_eq!(honest.transport.counters().dialed, 1);
    assert!(party.lent().1 <= 2 * EACH, "{:?}", party.lent());
    let shut_out = rogues.into_iter().map(|rogue| rogue.join().unwrap());
    assert!(shut_out.filter(|out| *out).count() >= 2);
}

/// Its pings are not read meanwhile, but it gets pongs of this side.
#[test]
fn a_connection_that_is_not_read_for_lack_of_memory_stays_open() {
    let lively = || {
        let mut config = config(&["127.0.0.1:0"]);
        config.limits.keep_alive = Duration::from_millis(500);
        config
    };
    let mut small = lively();
    small.limits.max_incoming = 1 << 20;
    small.limits.stall_timeout = Duration::from_secs(4);
    let party = Party::lending(small);
    let rogue = sends_half(&party, 77, 1 << 20, 500, &Arc::new(Barrier::new(1)));
    until_some("its letter", || (party.lent().0 == 1 << 20).then_some(()));
    let honest = Party::with(lively());
    let sent = parcel(1, vec![1; 1 << 20]);
    honest.send(1, party.location(), sent).unwrap();
    assert_eq!(honest.conclusion(1), accepted());
    assert_eq!(party.transport.counters().refused_nonsense, 1);
    assert!(rogue.join().unwrap());
}

#[test]
fn the_address_of_a_third_party_in_a_hello_is_never_dialed() {
    let third = std::net::TcpListener::bind("127.0.0.2:0").unwrap();
    let party = Party::new();
    let mut stream = connect(&party);
    let listening = third.local_addr().unwrap();
    let mut body = rogue_hello(77);
    // Replaces the empty list of addresses.
    body.pop();
    body.push(1);
    let text = listening.to_string();
    body.extend((text.len() as u16).to_le_bytes());
    body.extend(text.as_bytes());
    stream.write_all(&fipa_testbed::frame(1, 1, &body)).unwrap();
    stream
        .write_all(&frame(1, &parcel(1, "answer there")))
        .unwrap();
    let back = until_some("its letter", || {
        let record = party.sink.record.lock();
        Some(record.arrivals.first()?.1.location.clone())
    });
    let mut at = stream.local_addr().unwrap();
    at.set_port(listening.port());
    assert_eq!(back.address(), at.to_string());
    drop(stream);
    counted(&party, |c| c.connections, 0);
    party.send(1, &back, parcel(1, "answer")).unwrap();
    assert!(matches!(party.conclusion(1), Conclusion::NotSent(_)));
    third.set_nonblocking(true).unwrap();
    let dialed = third.accept().unwrap_err();
    assert_eq!(dialed.kind(), std::io::ErrorKind::WouldBlock);
}

/// A connection from this loopback address.
fn connect_from(ip: [u8; 4], to: &Party) -> TcpStream {
    let socket = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
    socket.bind(&SocketAddr::from((ip, 0)).into()).unwrap();
    let at: SocketAddr = to.location().address().parse().unwrap();
    socket.connect(&at.into()).unwrap();
    let stream = TcpStream::from(socket);
    // A watchdog for reads that never end.
    stream
        .set_read_timeout(Some(Duration::from_secs(60)))
        .unwrap();
    stream
}

#[test]
fn an_unproved_peer_that_claims_a_connected_service_is_refused_while_that_responds() {
    let party = Party::new();
    let service = Party::new();
    service.assert_reaches(1, &party);
    let incarnation = service.location().incarnation().as_u64();
    for ip in [[127, 0, 0, 2], [127, 0, 0, 3]] {
        let mut stranger = connect_from(ip, &party);
        let mut said = hello(incarnation);
        said.extend(frame(1, &parcel(1, "I am the service")));
        stranger.write_all(&said).unwrap();
        assert_shut_out(&mut stranger);
    }
    let counters = party.transport.counters();
    assert_eq!((counters.connections, counters.refused_unproved), (1, 2));
    service.assert_reaches(2, &party);
    assert_eq!(service.transport.counters().dialed, 1);
    assert_eq!(party.arrivals(), 2);
}

/// Under load, a healthy service opens a second connection because an answer on the first one is late.
#[test]
fn a_second_connection_of_a_service_is_refused_without_suspicion_while_the_first_responds() {
    const PING: u8 = 4;
    let party = Party::new();
    let mut first = connect(&party);
    first.write_all(&hello(77)).unwrap();
    counted(&party, |c| c.accepted, 1);
    let mut second = connect(&party);
    second.write_all(&hello(77)).unwrap();
    until_some("the refusal", || {
        first.write_all(&fipa_testbed::frame(PING, 0, &[])).unwrap();
        (party.transport.counters().refused_again == 1).then_some(())
    });
    assert_shut_out(&mut second);
    let counters = party.transport.counters();
    assert_eq!((counters.connections, counters.refused_unproved), (1, 0));
}

#[test]
fn a_service_that_moved_is_admitted_when_its_older_connection_does_not_respond() {
    let party = Party::new();
    for (ip, arrivals) in [([127, 0, 0, 1], 1), ([127, 0, 0, 2], 2)] {
        let mut older = connect_from(ip, &party);
        older.write_all(&hello(77)).unwrap();
        counted(&party, |c| c.accepted, 2 * arrivals - 1);
        let mut moved = connect_from([127, 0, 0, 3], &party);
        let mut said = hello(77);
        said.extend(frame(1, &parcel(1, "I am here now")));
        moved.write_all(&said).unwrap();
        until_some("its letter", || {
            (party.arrivals() as u64 == arrivals).then_some(())
        });
        assert_shut_out(&mut older);
        drop(moved);
        counted(&party, |c| c.connections, 0);
    }
    assert_eq!(party.transport.counters().refused_unproved, 0);
}
