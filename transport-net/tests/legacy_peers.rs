//! Letters of legacy peers, which send as fipa_services does: one connection per letter, closed
//! after it. No letter is lost, and those of one address arrive in the order of their connections.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{IpAddr, Ipv4Addr, Shutdown, SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use common::{Party, Threads, config, runtime};
use fipa_acl::{Dialect, Envelope, Letter, Message, Performative, Representation};
use fipa_testbed::until_some;
use fipa_transport::{
    Answer, Arrival, AttemptId, Conclusion, Kind, LegacySource, Reaction, Sink, Transport as _,
};
use fipa_transport_net::{NetLimits, TcpTransport};
use parking_lot::{Condvar, Mutex};
use socket2::{Domain, Socket, Type};

/// A recorded letter of a fipa_services peer to an agent `echo`.
const TCP_LETTER: &[u8] = include_bytes!("data/tcp_letter.bin");

const HERE: [u8; 4] = [127, 0, 0, 1];

/// An address of another source: all loopback addresses are one source.
const ELSEWHERE: [u8; 4] = [10, 99, 0, 1];

/// Makes a host with both addresses.
fn at_both_addresses() {
    fipa_testbed::enter();
    fipa_testbed::run("ip addr add 10.99.0.1/32 dev lo");
}

/// Records arriving letters, and can block the letters of 127.0.0.1, which then wait for the core
/// as on a busy machine.
#[derive(Default)]
struct Recorder {
    arrived: Mutex<Vec<(IpAddr, u64)>>,
    held: Mutex<bool>,
    released: Condvar,
}

impl Recorder {
    fn hold(&self) {
        *self.held.lock() = true;
    }

    fn release(&self) {
        *self.held.lock() = false;
        self.released.notify_all();
    }

    fn of(&self, ip: [u8; 4]) -> Vec<u64> {
        let arrived = self.arrived.lock();
        let of_ip = arrived.iter().filter(|(from, _)| *from == IpAddr::from(ip));
        of_ip.map(|(_, number)| *number).collect()
    }
}

impl Sink for Recorder {
    fn arrived(&self, _: Arrival) -> Reaction {
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, letter: Letter, via: Kind, from: LegacySource) {
        assert_eq!(via, Kind::Tcp);
        let (envelope, _) = Envelope::decode(&letter.envelope()).unwrap();
        assert_eq!(envelope.effective().intended_receivers[0].name(), "echo");
        let message = Message::decode(letter.payload()).unwrap();
        let content = message.content().unwrap().to_vec();
        let number = String::from_utf8(content).unwrap();
        let number = number.trim_end_matches('.').parse().unwrap();
        if from.address == IpAddr::from(HERE) {
            // Other tasks of this thread go on.
            tokio::task::block_in_place(|| {
                let mut held = self.held.lock();
                while *held {
                    self.released.wait(&mut held);
                }
            });
        }
        self.arrived.lock().push((from.address, number));
    }

    fn concluded(&self, _: AttemptId, _: Conclusion) {}
}

/// An endpoint that listens on every loopback address.
struct Gateway {
    sink: Arc<Recorder>,
    transport: TcpTransport,
    at: SocketAddr,
    _runtime: Threads,
}

impl Gateway {
    fn new() -> Self {
        let (runtime, sink) = (runtime(), Arc::new(Recorder::default()));
        let transport = TcpTransport::new(config(&["127.0.0.1:0"]), runtime.handle().clone());
        let locations = transport.listen(sink.clone()).unwrap();
        let at = locations[0].address().parse().unwrap();
        Self {
            sink,
            transport,
            at,
            _runtime: runtime,
        }
    }

    fn connect_from(&self, ip: [u8; 4]) -> TcpStream {
        let socket = Socket::new(Domain::IPV4, Type::STREAM, None).unwrap();
        socket
            .bind(&SocketAddr::from((Ipv4Addr::from(ip), 0)).into())
            .unwrap();
        socket.connect(&self.at.into()).unwrap();
        let stream = TcpStream::from(socket);
        // A watchdog for reads that never end.
        stream
            .set_read_timeout(Some(Duration::from_secs(60)))
            .unwrap();
        stream
    }

    /// Sends a letter over a connection of its own.
    fn send(&self, ip: [u8; 4], number: u64) {
        self.connect_from(ip).write_all(&letter(number, 0)).unwrap();
    }

    fn refused_crowd(&self) -> u64 {
        self.transport.counters().refused_crowd
    }
}

impl Drop for Gateway {
    fn drop(&mut self) {
        self.sink.release();
    }
}

/// The recorded letter with a number as its content, and as many bytes more.
fn letter(number: u64, more: usize) -> Vec<u8> {
    let (_, length) = Envelope::decode(TCP_LETTER).unwrap();
    let payload = Bytes::from_static(&TCP_LETTER[length..]).into();
    let recorded = Message::decode(&payload).unwrap();
    let message = Message::builder(Performative::Inform)
        .sender(recorded.sender().unwrap().clone())
        .receivers(recorded.receivers().iter().cloned())
        .content(format!("{number}{}", ".".repeat(more)))
        .build()
        .unwrap();
    let mut letter = TCP_LETTER[..length].to_vec();
    letter.extend(
        message
            .encode(Representation::BitEfficient, Dialect::FipaServices)
            .unwrap(),
    );
    letter
}

fn numbers(numbers: std::ops::Range<u64>) -> Vec<u64> {
    numbers.collect()
}

#[test]
fn a_burst_arrives_whole_and_in_the_order_of_its_connections() {
    let gateway = Gateway::new();
    for number in 0..1000 {
        gateway.send(HERE, number);
    }
    let arrived = until_some("all letters", || {
        let arrived = gateway.sink.of(HERE);
        (arrived.len() + gateway.refused_crowd() as usize >= 1000).then_some(arrived)
    });
    assert_eq!(arrived, numbers(0..1000));
}

#[test]
fn letters_of_any_length_arrive_in_the_order_of_their_connections() {
    let gateway = Gateway::new();
    gateway.sink.hold();
    for number in 0..200 {
        let long = if number % 10 == 0 { 100_000 } else { 0 };
        let mut stream = gateway.connect_from(HERE);
        stream.write_all(&letter(number, long)).unwrap();
    }
    gateway.sink.release();
    until_some("all letters", || {
        (gateway.sink.of(HERE).len() == 200).then_some(())
    });
    assert_eq!(gateway.sink.of(HERE), numbers(0..200));
}

/// The letters lie complete in the kernel's buffers, and their senders have long gone.
#[test]
fn letters_that_wait_for_a_busy_gateway_are_all_read_later() {
    fipa_testbed::isolated(
        "inside_letters_that_wait_for_a_busy_gateway_are_all_read_later",
        &["ip"],
    );
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_letters_that_wait_for_a_busy_gateway_are_all_read_later() {
    at_both_addresses();
    let gateway = Gateway::new();
    gateway.sink.hold();
    for number in 0..500 {
        gateway.send(HERE, number);
    }
    // Another address is not held up.
    for number in 0..100 {
        gateway.send(ELSEWHERE, number);
    }
    until_some("the letters of the other address", || {
        (gateway.sink.of(ELSEWHERE).len() == 100).then_some(())
    });
    assert_eq!(gateway.sink.of(ELSEWHERE), numbers(0..100));
    assert!(gateway.sink.of(HERE).is_empty());
    gateway.sink.release();
    until_some("the letters that waited", || {
        (gateway.sink.of(HERE).len() == 500).then_some(())
    });
    assert_eq!(gateway.sink.of(HERE), numbers(0..500));
    assert_eq!(gateway.refused_crowd(), 0);
}

#[test]
fn beyond_the_bounds_the_newest_connection_is_reset_and_its_sender_sees_it() {
    fipa_testbed::isolated(
        "inside_beyond_the_bounds_the_newest_connection_is_reset_and_its_sender_sees_it",
        &["ip"],
    );
}

#[test]
#[ignore = "is run by the other test in namespaces of its own"]
fn inside_beyond_the_bounds_the_newest_connection_is_reset_and_its_sender_sees_it() {
    at_both_addresses();
    let gateway = Gateway::new();
    gateway.sink.hold();
    let limits = NetLimits::default();
    let room = (limits.max_reads_per_address + limits.max_unread_per_address) as u64;
    assert_eq!(room, 32 + 512);
    for number in 0..room {
        gateway.send(HERE, number);
    }
    for number in 1..=20 {
        let mut stream = gateway.connect_from(HERE);
        let error = stream
            .write_all(&letter(number, 0))
            .and_then(|()| stream.read(&mut [0]));
        let error = error.unwrap_err().kind();
        let reset = [ErrorKind::ConnectionReset, ErrorKind::BrokenPipe];
        assert!(reset.contains(&error), "{error}");
        until_some("the count", || {
            (gateway.refused_crowd() == number).then_some(())
        });
    }
    gateway.send(ELSEWHERE, 1);
    until_some("a letter of another address", || {
        (gateway.sink.of(ELSEWHERE) == [1]).then_some(())
    });
    gateway.sink.release();
    until_some("the letters that waited", || {
        (gateway.sink.of(HERE).len() as u64 == room).then_some(())
    });
    assert_eq!(gateway.sink.of(HERE), numbers(0..room));
    assert_eq!(gateway.refused_crowd(), 20);
}

#[test]
fn letters_do_not_wait_for_connections_that_say_nothing() {
    let gateway = Gateway::new();
    let mut silent: Vec<TcpStream> = (0..40).map(|_| gateway.connect_from(HERE)).collect();
    let mut half = gateway.connect_from(HERE);
    half.write_all(&letter(4, 0)[..50]).unwrap();
    for number in 0..3 {
        gateway.send(HERE, number);
    }
    until_some("the letters behind them", || {
        (gateway.sink.of(HERE).len() == 3).then_some(())
    });
    // Those that speak after all are read.
    silent[7].write_all(&letter(3, 0)).unwrap();
    silent[7].shutdown(Shutdown::Write).unwrap();
    until_some("a late letter", || {
        (gateway.sink.of(HERE).len() == 4).then_some(())
    });
    half.write_all(&letter(4, 0)[50..]).unwrap();
    drop(half);
    until_some("the letter that stopped half way", || {
        (gateway.sink.of(HERE).len() == 5).then_some(())
    });
    assert_eq!(gateway.sink.of(HERE), numbers(0..5));
    assert_eq!(gateway.refused_crowd(), 0);
}

#[test]
fn half_letters_stop_neither_their_address_nor_framed_peers() {
    let gateway = Gateway::new();
    let _half: Vec<TcpStream> = (0..100)
        .map(|_| {
            let mut stream = gateway.connect_from(HERE);
            stream.write_all(&letter(9, 0)[..50]).unwrap();
            stream
        })
        .collect();
    gateway.send(HERE, 1);
    let framed = Party::new();
    let to = gateway.at.to_string();
    let to = fipa_transport::Location::new(Kind::Tcp, &to).unwrap();
    framed.send(1, &to, common::parcel(1, "x")).unwrap();
    assert_eq!(framed.conclusion(1), common::accepted());
    until_some("the letter behind them", || {
        (gateway.sink.of(HERE) == [1]).then_some(())
    });
}
