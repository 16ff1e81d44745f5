//! TCP endpoints on loopback.
#![allow(
    clippy::unwrap_used,
    reason = "a test or bench that cannot go on may panic"
)]

mod common;

use std::net::{Ipv4Addr, SocketAddr, TcpStream};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use common::{Party, Recorder, accepted, config, letter_parcel, parcel};
use fipa_acl::{ErrorChain, Letter};
use fipa_testbed::{until, until_async, until_some};
use fipa_transport::{
    Answer, AttemptId, Body, Conclusion, FailureReason, Incarnation, Kind, ListenError, Location,
    Reaction, Transport, TransportErrorKind,
};
use fipa_transport_net::TcpTransport;

#[test]
fn letters_that_are_sent_in_a_row_share_a_write() {
    // One thread: the task of the connection runs only while this test waits.
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let b = Party::new();
    let sink = Arc::new(Recorder::default());
    let mut of_gateway = config(&["127.0.0.1:0"]);
    of_gateway.processes = false;
    let a = TcpTransport::new(of_gateway, runtime.handle().clone());
    runtime.block_on(async {
        a.listen(sink.clone()).unwrap();
        let send = |attempt| {
            let parcel = parcel(attempt, "x");
            a.post(AttemptId(attempt), b.location(), parcel).unwrap();
        };
        let concluded = || sink.record.lock().concluded.len();
        send(0);
        until_async("the first answer", || concluded() == 1).await;
        let before = a.counters().writes;
        (1..=20).for_each(send);
        until_async("all answers", || concluded() == 21).await;
        // The first letter alone, twice eight letters, and the rest.
        assert_eq!(a.counters().writes - before, 4);
        // A letter without another one under way is written at once, and not by the task.
        let before = a.counters().writes;
        send(21);
        until("the letter", || b.arrivals() == 22);
        until_async("the answer", || concluded() == 22).await;
        assert_eq!(a.counters().writes - before, 1);
    });
    a.close();
}

#[test]
fn late_answers_may_come_in_any_order() {
    let a = Party::new();
    let b = Party::judging(config(&["127.0.0.1:0"]), Reaction::Later);
    for attempt in 0..100 {
        a.send(attempt, b.location(), parcel(attempt, "x")).unwrap();
    }
    until_some("all arrivals", || (b.arrivals() == 100).then_some(()));
    let tickets: Vec<_> = {
        let record = b.sink.record.lock();
        let order: Vec<u64> = record.arrivals.iter().map(|(p, ..)| p.sequence).collect();
        assert_eq!(order, (0..100).collect::<Vec<_>>());
        record.arrivals.iter().map(|arrival| arrival.2).collect()
    };
    let answer = |number: u64| Answer::Failed {
        reason: FailureReason::Refused,
        detail: number.to_string(),
    };
    for (number, ticket) in tickets.into_iter().enumerate().rev() {
        b.transport.answer(ticket, answer(number as u64));
    }
    for number in 0..100 {
        assert_eq!(a.conclusion(number), Conclusion::Answered(answer(number)));
    }
}

#[test]
fn big_letters_and_letters_of_many_pieces_arrive_whole_among_small_ones() {
    let (a, b) = (Party::new(), Party::new());
    let big: Bytes = (0..16 << 20).map(|i: u32| (i ^ (i >> 9)) as u8).collect();
    let mut many = Letter::new(Bytes::from_static(b"base"), Bytes::from_static(b"message"));
    for number in 0..500_u16 {
        many = many.stamped(Bytes::from(number.to_be_bytes().repeat(11)));
    }
    for round in 0..3 {
        let letters = [
            parcel(0, big.clone()),
            letter_parcel(1, many.clone()),
            parcel(2, "x"),
        ];
        for (attempt, letter) in (round * 3..).zip(letters) {
            a.send(attempt, b.location(), letter.clone()).unwrap();
            // The other direction is not delayed.
            b.send(attempt, a.location(), parcel(attempt, "y")).unwrap();
        }
    }
    for attempt in 0..9 {
        assert_eq!(a.conclusion(attempt), accepted());
        assert_eq!(b.conclusion(attempt), accepted());
    }
    let record = b.sink.record.lock();
    for (index, (arrived, ..)) in record.arrivals.iter().enumerate() {
        let Body::Letter(letter) = &arrived.body else {
            panic!("a letter was sent")
        };
        match index % 3 {
            0 => assert!(letter.payload().content == big),
            1 => assert!(letter.to_bytes() == many.to_bytes()),
            _ => assert_eq!(letter.payload().content, "x"),
        }
    }
}

#[test]
fn one_connection_serves_both_directions_even_without_a_listener() {
    let silent = Party::judging(config(&[]), Reaction::Now(Answer::Accepted));
    assert_eq!(silent.locations, []);
    let b = Party::new();
    silent.assert_reaches(1, &b);
    let hop = b.sink.record.lock().arrivals[0].1.clone();
    assert!(!hop.is_remote());
    b.send(1, &hop.location, parcel(1, "back")).unwrap();
    assert_eq!(b.conclusion(1), accepted());
    assert_eq!(silent.arrivals(), 1);
    let counters = b.transport.counters();
    assert_eq!((counters.accepted, counters.dialed), (1, 0));
    assert_eq!(counters.connections, 1);
}

#[test]
fn another_host_or_domain_is_remote() {
    let b = Party::new();
    for (attempt, (host, domain)) in [("there", "test"), ("here", "other")]
        .into_iter()
        .enumerate()
    {
        let mut far = config(&["127.0.0.1:0"]);
        far.identity.host = host.into();
        far.identity.domain = domain.into();
        Party::with(far).assert_reaches(1, &b);
        assert!(b.sink.record.lock().arrivals[attempt].1.is_remote());
    }
}

/// A gateway does not list loopback, so its letters are not relayed although it repeats the host and
/// the domain of the gateway.
#[test]
fn a_peer_that_repeats_host_and_domain_is_remote_unless_loopback_is_listed() {
    for (listed, is_remote) in [(true, false), (false, true)] {
        let mut near = config(&["127.0.0.1:0"]);
        near.processes = listed;
        let near = Party::with(near);
        Party::new().assert_reaches(1, &near);
        assert_eq!(near.sink.record.lock().arrivals[0].1.is_remote(), is_remote);
    }
}

#[test]
fn a_restarted_peer_has_another_incarnation_and_is_reachable_again() {
    let a = Party::new();
    let b = Party::new();
    a.assert_reaches(0, &b);
    let old = b.location().clone();
    let address = old.address().to_owned();
    drop(b);
    until_some("the port to be free", || {
        std::net::TcpListener::bind(&address).ok()
    });
    let b = Party::with(config(&[&address]));
    assert_eq!(b.location().address(), address);
    let fault = until_some("the old connection to be gone", || {
        static ATTEMPT: std::sync::atomic::AtomicU64 = std::sync::atomic::AtomicU64::new(100);
        let attempt = ATTEMPT.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        a.send(attempt, &old, parcel(1, "to the old one")).ok()?;
        match a.conclusion(attempt) {
            Conclusion::NotSent(error) if error.fault == TransportErrorKind::WrongIncarnation => {
                Some(error)
            }
            Conclusion::NotSent(_) | Conclusion::Unconfirmed(_) => None,
            other => panic!("{other:?}"),
        }
    });
    assert!(
        fault
            .detail
            .contains(&b.location().incarnation().to_string()),
        "{fault}"
    );
    assert_eq!(b.arrivals(), 0);
    a.assert_reaches(1, &b);
    let anyone = Location::new(Kind::Tcp, &address).unwrap();
    a.send(2, &anyone, parcel(2, "any incarnation")).unwrap();
    assert_eq!(a.conclusion(2), accepted());
}

#[test]
fn an_idle_connection_closes_and_opens_again() {
    let mut impatient = config(&["127.0.0.1:0"]);
    impatient.limits.idle_close = Duration::from_millis(50);
    let (a, b) = (Party::with(impatient), Party::new());
    for attempt in 0..3 {
        a.assert_reaches(attempt, &b);
        until_some("the connection to close", || {
            let open = |party: &Party| party.transport.counters().connections;
            (open(&a) == 0 && open(&b) == 0).then_some(())
        });
    }
    assert_eq!(a.transport.counters().dialed, 3);
    assert_eq!(b.transport.counters().refused_nonsense, 0);
}

#[test]
fn a_connection_kept_open_by_an_unanswered_letter_is_kept_alive() {
    let mut lively = config(&["127.0.0.1:0"]);
    lively.limits.idle_close = Duration::from_millis(20);
    lively.limits.keep_alive = Duration::from_millis(500);
    let a = Party::with(lively);
    let b = Party::judging(config(&["127.0.0.1:0"]), Reaction::Later);
    a.send(1, b.location(), parcel(1, "x")).unwrap();
    until_some("the arrival", || (b.arrivals() == 1).then_some(()));
    // Several times the time after which a silent peer is given up.
    std::thread::sleep(Duration::from_secs(3));
    let ticket = b.sink.record.lock().arrivals[0].2;
    b.transport.answer(ticket, Answer::Custody);
    assert_eq!(a.conclusion(1), Conclusion::Answered(Answer::Custody));
}

#[test]
fn both_may_connect_at_the_same_time() {
    for _ in 0..20 {
        let (a, b) = (Party::new(), Party::new());
        std::thread::scope(|scope| {
            for (from, to) in [(&a, &b), (&b, &a)] {
                scope.spawn(move || {
                    for attempt in 0..20 {
                        let to = to.location();
                        from.send(attempt, to, parcel(attempt, "x")).unwrap();
                    }
                });
            }
        });
        for attempt in 0..20 {
            assert_eq!(a.conclusion(attempt), accepted());
            assert_eq!(b.conclusion(attempt), accepted());
        }
        for party in [&a, &b] {
            let record = party.sink.record.lock();
            let order: Vec<u64> = record.arrivals.iter().map(|(p, ..)| p.sequence).collect();
            assert_eq!(order, (0..20).collect::<Vec<_>>());
        }
    }
}

#[test]
fn an_unreachable_peer_is_reported_with_its_address() {
    let a = Party::new();
    let listener = tokio::net::TcpSocket::new_v4().unwrap();
    listener.bind("127.0.0.1:0".parse().unwrap()).unwrap();
    let address = listener.local_addr().unwrap().to_string();
    for (attempt, text) in [address.as_str(), "no.such.name.invalid:7788", "no-port"]
        .into_iter()
        .enumerate()
    {
        let attempt = attempt as u64;
        let to = Location::new(Kind::Tcp, text).unwrap();
        a.send(attempt, &to, parcel(1, "x")).unwrap();
        match a.conclusion(attempt) {
            Conclusion::NotSent(error) => {
                assert_eq!(error.fault, TransportErrorKind::Unreachable);
                assert!(error.detail.contains(text), "{error}");
            }
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(a.transport.counters().dial_failures, 3);
}

#[test]
fn a_port_in_use_is_reported_with_address_and_remedy() {
    let a = Party::new();
    let taken = a.location().address();
    let sink = a.sink.clone();
    let runtime = a.runtime.handle().clone();
    let second = TcpTransport::new(config(&["127.0.0.1:0", taken]), runtime.clone());
    match second.listen(sink.clone()) {
        Err(error @ ListenError::Bind { .. }) => {
            let text = ErrorChain(&error).to_string();
            assert!(text.contains(taken), "{text}");
            assert!(text.contains("choose another port"), "{text}");
        }
        other => panic!("{other:?}"),
    }
    let nonsense = TcpTransport::new(config(&["localhost"]), runtime.clone());
    let error = nonsense.listen(sink.clone()).unwrap_err().to_string();
    assert!(error.contains("127.0.0.1:7788"), "{error}");
    let mut unknown = config(&[]);
    unknown.identity.incarnation = Incarnation::UNKNOWN;
    let unknown = TcpTransport::new(unknown, runtime);
    assert!(matches!(
        unknown.listen(sink),
        Err(ListenError::Unavailable(_))
    ));
}

#[test]
fn listening_on_all_interfaces_reports_reachable_addresses() {
    let b = Party::with(config(&["0.0.0.0:0", "[::]:0"]));
    assert!(!b.locations.is_empty());
    for location in &b.locations {
        assert!(!location.address().contains("0.0.0.0"), "{location}");
        let anyone = Location::new(Kind::Tcp, location.address()).unwrap();
        // The connections of one service do not conflict.
        let a = Party::new();
        a.send(1, &anyone, parcel(1, "x")).unwrap();
        assert_eq!(a.conclusion(1), accepted(), "{location}");
    }
}

#[test]
fn a_runtime_that_was_shut_down_is_reported() {
    let (a, b) = (Party::new(), Party::new());
    let orphan = {
        let runtime = common::runtime();
        let orphan = TcpTransport::new(config(&["127.0.0.1:0"]), runtime.handle().clone());
        orphan.listen(a.sink.clone()).unwrap();
        orphan
    };
    let error = orphan
        .post(AttemptId(1), b.location(), parcel(1, "x"))
        .unwrap_err();
    assert_eq!(error.fault, TransportErrorKind::Closed, "{error}");
}

/// An address at which the system ignores connections while the returned sockets are kept.
fn silent() -> (socket2::Socket, TcpStream, String) {
    let full = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).unwrap();
    full.bind(&SocketAddr::from((Ipv4Addr::LOCALHOST, 0)).into())
        .unwrap();
    // The accept queue has one slot, which is taken.
    full.listen(0).unwrap();
    let address = full.local_addr().unwrap().as_socket().unwrap();
    let first = TcpStream::connect(address).unwrap();
    (full, first, address.to_string())
}

#[test]
fn the_addresses_of_a_service_are_raced_without_duplicating_letters() {
    let (near, far, other) = (Party::new(), Party::new(), Party::new());
    let (_full, _first, silent) = silent();
    let working = far.location();
    let to = Location::new(Kind::Tcp, &silent).unwrap();
    let to = to.with_incarnation(working.incarnation());
    // Addresses of other services are not tried.
    *near.sink.also_at.lock() = vec![other.location().clone(), working.clone()];
    for attempt in 0..20 {
        near.send(attempt, &to, parcel(attempt + 1, "x")).unwrap();
    }
    // Long before the attempt at the silent address times out.
    for attempt in 0..20 {
        assert_eq!(near.conclusion(attempt), accepted());
    }
    let arrived: Vec<u64> = {
        let record = far.sink.record.lock();
        let arrivals = record.arrivals.iter();
        arrivals.map(|(parcel, _, _)| parcel.sequence).collect()
    };
    assert_eq!(arrived, (1..=20).collect::<Vec<_>>());
    assert_eq!(other.transport.counters().accepted, 0);
    assert_eq!(far.transport.counters().accepted, 1);
    // The other address uses the same connection.
    near.assert_reaches(100, &far);
    assert_eq!(far.transport.counters().accepted, 1);
}
