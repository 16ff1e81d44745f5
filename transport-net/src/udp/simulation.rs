//! Two endpoints on virtual time. The network between them loses, delays, reorders and repeats
//! datagrams depending on a seed. Every run checks the guarantees of the transport.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use fipa_transport::{
    Answer, AttemptId, Body, Conclusion, Incarnation, Kind, Location, Parcel, Stream, Ticket,
    TransportErrorKind,
};

use super::config::UdpLimits;
use super::core::{Core, CoreEvent};
use super::packet::{self, BASE, Datagram, NO_COOKIE};
use crate::Identity;
use crate::datagrams::{DatagramCore, Path, Transmit};

const A: usize = 0;
const B: usize = 1;

/// The conditions of the simulated network.
#[derive(Debug, Clone, Copy)]
struct LinkConditions {
    loss: f64,
    twice: f64,
    delay: (u64, u64),
    /// Size of the largest datagram that the path carries.
    path: usize,
    /// Size of the largest datagram that the local interface accepts.
    interface: usize,
}

const FAIR: LinkConditions = LinkConditions {
    loss: 0.0,
    twice: 0.0,
    delay: (100, 200),
    path: 1452,
    interface: 1452,
};

struct Simulation {
    now: Instant,
    random: fastrand::Rng,
    conditions: LinkConditions,
    cores: [Core; 2],
    /// Datagrams in flight: time of arrival, receiver, sender.
    wire: BTreeMap<(Instant, u64), (usize, SocketAddr, Vec<u8>)>,
    count: u64,
    arrived: [Vec<Parcel>; 2],
    concluded: [HashMap<AttemptId, Vec<Conclusion>>; 2],
    /// Delayed answers.
    owed: BTreeMap<(Instant, u64), (usize, Ticket)>,
    /// Fraction of the arrivals that are answered late.
    late: f64,
    cut: bool,
}

fn address(who: usize) -> SocketAddr {
    SocketAddr::from(([192, 0, 2, who as u8 + 1], 7788))
}

fn to(who: usize) -> Location {
    Location::new(Kind::Udp, &address(who).to_string()).unwrap()
}

fn core(who: usize, seed: u64, limits: &UdpLimits, now: Instant) -> Core {
    let mut random = fastrand::Rng::with_seed(seed * 10 + who as u64);
    let identity = Identity {
        name: format!("mts-{who}"),
        incarnation: Incarnation::from_u64(random.u64(1..)),
        domain: "test".into(),
        host: format!("host-{who}"),
    };
    let listening = vec![address(who).to_string()];
    let draw = Box::new(move || random.u64(1..));
    Core::new(identity, limits.clone(), listening, draw, now)
}

impl Simulation {
    fn new(seed: u64, conditions: LinkConditions, limits: &UdpLimits) -> Self {
        let now = Instant::now();
        Self {
            now,
            random: fastrand::Rng::with_seed(seed),
            conditions,
            cores: [core(A, seed, limits, now), core(B, seed, limits, now)],
            wire: BTreeMap::new(),
            count: 0,
            arrived: Default::default(),
            concluded: Default::default(),
            owed: BTreeMap::new(),
            late: 0.0,
            cut: false,
        }
    }

    fn send(&mut self, from: usize, attempt: u64, len: usize) -> Result<(), TransportErrorKind> {
        let to = to(1 - from);
        let parcel = parcel(attempt, len);
        let fresh = self.cores[from]
            .post(self.now, AttemptId(attempt), &to, &parcel)
            .map_err(|error| error.fault)?;
        if let Some(fresh) = fresh {
            let path = Path {
                socket: 1,
                remote: address(1 - from),
                local: None,
            };
            self.cores[from].begin(self.now, fresh, vec![path]);
        }
        self.flush();
        Ok(())
    }

    /// Sends all pending datagrams and handles all events.
    fn flush(&mut self) {
        for who in [A, B] {
            loop {
                while let Some(event) = self.cores[who].poll_event() {
                    self.tell(who, event);
                }
                let Some(transmit) = self.cores[who].poll_transmit(self.now) else {
                    if self.cores[who].has_events() {
                        continue;
                    }
                    break;
                };
                self.transmit(who, transmit);
            }
        }
    }

    fn tell(&mut self, who: usize, event: CoreEvent) {
        match event {
            CoreEvent::Concluded(attempt, conclusion) => {
                let conclusions = self.concluded[who].entry(attempt).or_default();
                conclusions.push(conclusion);
            }
            CoreEvent::Introduced(_) | CoreEvent::Disconnected(_) => {}
            CoreEvent::Arrived { parcel, ticket, .. } => {
                self.arrived[who].push(*parcel);
                if self.random.f64() < self.late {
                    let after = Duration::from_micros(self.random.u64(0..400_000));
                    self.count += 1;
                    self.owed
                        .insert((self.now + after, self.count), (who, ticket));
                } else {
                    self.cores[who].answer(self.now, ticket, &Answer::Accepted);
                }
            }
        }
    }

    fn transmit(&mut self, who: usize, transmit: Transmit) {
        if transmit.path.remote != address(1 - who) {
            return;
        }
        let len = transmit.contents.len();
        if len > self.conditions.interface {
            if let Some(number) = transmit.connection {
                self.cores[who].too_big(number, len);
            }
            return;
        }
        let conditions = self.conditions;
        let copies = 1 + usize::from(self.random.f64() < conditions.twice);
        for _ in 0..copies {
            if self.cut || len > conditions.path || self.random.f64() < conditions.loss {
                continue;
            }
            let delay = self.random.u64(conditions.delay.0..=conditions.delay.1);
            self.count += 1;
            self.wire.insert(
                (self.now + Duration::from_micros(delay), self.count),
                (1 - who, address(who), transmit.contents.clone()),
            );
        }
    }

    /// Returns the time of the next event.
    fn next(&self) -> Option<Instant> {
        let next = [
            self.wire.keys().next().map(|(at, _)| *at),
            self.owed.keys().next().map(|(at, _)| *at),
            self.cores[A].poll_timeout(),
            self.cores[B].poll_timeout(),
        ];
        next.into_iter().flatten().min()
    }

    /// Advances to the next event. Returns false when there is none.
    fn step(&mut self) -> bool {
        let Some(next) = self.next() else {
            return false;
        };
        self.now = self.now.max(next);
        while let Some(entry) = self.wire.first_entry()
            && entry.key().0 <= self.now
        {
            let (to, from, bytes) = entry.remove();
            self.receive(to, from, &bytes);
        }
        while let Some(entry) = self.owed.first_entry()
            && entry.key().0 <= self.now
        {
            let (who, ticket) = entry.remove();
            self.cores[who].answer(self.now, ticket, &Answer::Accepted);
        }
        for core in &mut self.cores {
            core.handle_timeout(self.now);
        }
        self.flush();
        true
    }

    fn receive(&mut self, to: usize, from: SocketAddr, bytes: &[u8]) {
        let path = Path {
            socket: 1,
            remote: from,
            local: None,
        };
        self.cores[to].handle_datagram(self.now, path, true, bytes);
    }

    /// Runs until every attempt is concluded.
    fn until_concluded(&mut self, from: usize, attempts: &BTreeSet<u64>) {
        let deadline = self.now + Duration::from_secs(600);
        while self.concluded[from].len() < attempts.len() {
            assert!(self.step() && self.now < deadline, "an attempt stays open");
        }
    }

    /// Checks the guarantees that hold under all conditions. Returns the number of accepted
    /// letters.
    fn check(&self, from: usize, attempts: &BTreeSet<u64>) -> usize {
        let order: Vec<u64> = self.arrived[1 - from].iter().map(|p| p.sequence).collect();
        let arrived: BTreeSet<u64> = order.iter().copied().collect();
        assert_eq!(arrived.len(), order.len(), "a parcel arrived twice");
        assert!(order.is_sorted(), "out of order: {order:?}");
        let mut accepted = 0;
        for attempt in attempts {
            let conclusions = &self.concluded[from][&AttemptId(*attempt)];
            assert_eq!(conclusions.len(), 1, "{attempt}: {conclusions:?}");
            let arrived = arrived.contains(attempt);
            match &conclusions[0] {
                Conclusion::Answered(Answer::Accepted) => {
                    assert!(arrived, "{attempt} was accepted but did not arrive");
                    accepted += 1;
                }
                Conclusion::NotSent(error) => {
                    assert!(!arrived, "{attempt} arrived, but was not sent: {error}");
                }
                Conclusion::Unconfirmed(_) => {}
                other => panic!("{other:?}"),
            }
        }
        accepted
    }
}

fn parcel(sequence: u64, len: usize) -> Parcel {
    let payload = Payload {
        content: Bytes::from(vec![sequence as u8; len]),
        ..Payload::default()
    };
    Parcel {
        receiver: "arm".into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence,
        after: 0,
        remaining: Duration::from_secs(5),
        transfer: 0,
        body: Body::Letter(Letter::new(Bytes::from_static(b"envelope"), payload)),
    }
}

/// The hello of a stranger.
fn hello_of(incarnation: u64) -> crate::hello::Hello {
    crate::hello::Hello {
        identity: Identity {
            name: "x".into(),
            incarnation: Incarnation::from_u64(incarnation),
            domain: "test".into(),
            host: "x".into(),
        },
        max_letter: 1000,
        max_in_flight: 10,
        serial: 1,
        dialed: "x".into(),
        listening: Vec::new(),
        load: crate::hello::Load::Any,
    }
}

fn seeds() -> std::ops::Range<u64> {
    match std::env::var("FIPA_SIM_SEEDS") {
        Ok(count) => 0..count.parse().unwrap(),
        Err(_) => 0..60,
    }
}

/// Sends many letters of many sizes in both directions under some conditions. Returns the numbers
/// of sent and accepted letters.
fn run(seed: u64, conditions: LinkConditions, late: f64) -> (usize, usize) {
    let limits = UdpLimits {
        // A loss of 30 % in each direction must not count as silence.
        silence: Duration::from_secs(20),
        connect_timeout: Duration::from_secs(20),
        ..UdpLimits::default()
    };
    let mut simulation = Simulation::new(seed, conditions, &limits);
    simulation.late = late;
    let mut attempts = [BTreeSet::new(), BTreeSet::new()];
    for number in 0..200 {
        let from = usize::from(simulation.random.bool());
        let len = match simulation.random.u8(..) {
            0..200 => simulation.random.usize(0..300),
            200..250 => simulation.random.usize(0..1300),
            _ => simulation.random.usize(0..3000),
        };
        match simulation.send(from, number, len) {
            Ok(()) => {
                attempts[from].insert(number);
            }
            Err(fault) => assert_eq!(fault, TransportErrorKind::TooLarge, "seed {seed}"),
        }
        for _ in 0..simulation.random.u8(0..4) {
            simulation.step();
        }
        if simulation.random.u8(..) < 8
            && let Some(open) = attempts[from].last().copied()
            && !simulation.concluded[from].contains_key(&AttemptId(open))
        {
            simulation.cores[from].abandon(AttemptId(open), &to(1 - from));
            attempts[from].remove(&open);
        }
    }
    simulation.until_concluded(A, &attempts[A]);
    simulation.until_concluded(B, &attempts[B]);
    let sent = attempts[A].len() + attempts[B].len();
    let accepted = simulation.check(A, &attempts[A]) + simulation.check(B, &attempts[B]);
    (sent, accepted)
}

/// Runs every seed, and reports the seed of a failure.
fn every_seed(test: impl Fn(u64)) {
    for seed in seeds() {
        let run = std::panic::AssertUnwindSafe(|| test(seed));
        if let Err(panic) = std::panic::catch_unwind(run) {
            fipa_transport::log_limit::error!(seed, "broke");
            let said = panic
                .downcast_ref::<String>()
                .cloned()
                .or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()));
            panic!("seed {seed}: {}", said.unwrap_or_default());
        }
    }
}

#[test]
fn without_loss_every_letter_that_fits_is_accepted() {
    every_seed(|seed| {
        let (sent, accepted) = run(seed, FAIR, 0.0);
        assert!(sent - accepted <= 10, "{accepted} of {sent}");
    });
}

#[test]
fn guarantees_hold_under_loss() {
    every_seed(|seed| {
        let conditions = LinkConditions {
            loss: [0.01, 0.1, 0.3][seed as usize % 3],
            twice: 0.1,
            delay: (100, 30_000),
            ..FAIR
        };
        let (sent, accepted) = run(seed, conditions, 0.3);
        assert!(accepted * 10 > sent * 8, "{accepted} of {sent}");
    });
}

#[test]
fn guarantees_hold_over_any_path() {
    every_seed(|seed| {
        let mut random = fastrand::Rng::with_seed(seed);
        let interface = random.usize(BASE..70_000);
        let conditions = LinkConditions {
            loss: 0.02,
            path: random.usize(BASE..=interface),
            interface,
            delay: (50, random.u64(60..50_000)),
            twice: 0.02,
        };
        run(seed, conditions, 0.1);
    });
}

#[test]
fn a_vanished_peer_is_detected_and_no_letter_counts_as_accepted() {
    every_seed(|seed| {
        let mut simulation = Simulation::new(seed, FAIR, &UdpLimits::default());
        let mut attempts = BTreeSet::new();
        for number in 0..40 {
            if number == 20 {
                simulation.cut = true;
                simulation.wire.clear();
            }
            if simulation.send(A, number, 100).is_ok() {
                attempts.insert(number);
            }
            simulation.step();
        }
        let cut = simulation.now;
        simulation.until_concluded(A, &attempts);
        let accepted = simulation.check(A, &attempts);
        assert!(accepted < attempts.len());
        assert!(
            simulation.now < cut + Duration::from_secs(5),
            "noticed too late"
        );
        // Later letters open a new connection, which fails while the peer is absent.
        simulation.send(A, 100, 1).unwrap();
        while !simulation.concluded[A].contains_key(&AttemptId(100)) {
            assert!(simulation.step());
        }
        assert!(matches!(
            &simulation.concluded[A][&AttemptId(100)][0],
            Conclusion::NotSent(error) if error.fault == TransportErrorKind::Unreachable
        ));
        simulation.cut = false;
        simulation.send(A, 101, 1).unwrap();
        while !simulation.concluded[A].contains_key(&AttemptId(101)) {
            assert!(simulation.step());
        }
        let accepted = Conclusion::Answered(Answer::Accepted);
        assert_eq!(simulation.concluded[A][&AttemptId(101)], [accepted]);
    });
}

#[test]
fn a_restarted_peer_reports_the_unknown_connection() {
    let limits = UdpLimits::default();
    let mut simulation = Simulation::new(1, FAIR, &limits);
    simulation.send(A, 1, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1]));
    simulation.cores[B] = core(B, 2, &limits, simulation.now);
    let restarted = simulation.now;
    simulation.send(A, 2, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1, 2]));
    assert!(matches!(
        &simulation.concluded[A][&AttemptId(2)][0],
        Conclusion::Unconfirmed(error) if error.fault == TransportErrorKind::Broken
    ));
    assert!(simulation.now < restarted + Duration::from_millis(50));
    simulation.send(A, 3, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1, 2, 3]));
    assert_eq!(simulation.check(A, &BTreeSet::from([1, 3])), 1 + 1);
}

#[test]
fn idle_connections_are_removed_on_both_sides() {
    let mut simulation = Simulation::new(1, FAIR, &UdpLimits::default());
    simulation.send(A, 1, 10).unwrap();
    while simulation.step() {}
    assert_eq!(simulation.check(A, &BTreeSet::from([1])), 1);
    for core in &simulation.cores {
        assert_eq!(core.counters().connections, 0);
    }
}

#[test]
fn unproved_peers_leave_no_state_and_get_fewer_bytes_than_they_sent() {
    let mut simulation = Simulation::new(1, FAIR, &UdpLimits::default());
    let hello = hello_of(9);
    let spoofed = |n: u32| SocketAddr::from((n.to_be_bytes(), 99));
    let mut concluded = 0;
    for n in 1..2000_u32 {
        let cookie = if n % 2 == 0 { NO_COOKIE } else { [n as u8; 16] };
        let first = packet::hello(n.into(), &cookie, &hello);
        simulation.receive(B, spoofed(n), &first);
        let mut data = Vec::new();
        packet::put_data(&mut data, n.into(), 1);
        packet::put_ping(&mut data);
        simulation.receive(B, spoofed(n), &data);
        while let Some(reply) = simulation.cores[B].poll_transmit(simulation.now) {
            assert_eq!(reply.path.remote, spoofed(n));
            assert!(reply.contents.len() <= data.len().max(first.len() / 30));
            concluded += 1;
        }
    }
    assert_eq!(concluded, 2 * 1999);
    assert_eq!(simulation.cores[B].counters().accepted, 0);
    assert_eq!(simulation.cores[B].poll_timeout(), None);
}

#[test]
fn replayed_and_forged_datagrams_change_nothing() {
    let mut simulation = Simulation::new(1, FAIR, &UdpLimits::default());
    let mut recorded: Vec<(SocketAddr, Vec<u8>)> = Vec::new();
    for number in 0..20 {
        simulation.send(A, number, 50).unwrap();
        while !simulation.concluded[A].contains_key(&AttemptId(number)) {
            recorded.extend(
                simulation
                    .wire
                    .values()
                    .filter(|(to, ..)| *to == B)
                    .map(|(_, from, bytes)| (*from, bytes.clone())),
            );
            simulation.step();
        }
    }
    let stranger: SocketAddr = "203.0.113.9:7788".parse().unwrap();
    for (from, bytes) in recorded.clone() {
        // Again from the same address, from another, and with an unknown connection.
        simulation.receive(B, from, &bytes);
        simulation.receive(B, stranger, &bytes);
        let mut forged = bytes.clone();
        forged[8] ^= 1;
        simulation.receive(B, from, &forged);
        simulation.flush();
    }
    assert_eq!(simulation.arrived[B].len(), 20);
    assert_eq!(simulation.cores[B].counters().connections, 1);
    simulation.send(A, 100, 10).unwrap();
    while !simulation.concluded[A].contains_key(&AttemptId(100)) {
        assert!(simulation.step());
    }
    assert_eq!(simulation.arrived[B].len(), 21);
    // An attacker that does not know the number of the connection cannot end it.
    let unknown = packet::unknown(12345);
    simulation.receive(A, address(B), &unknown);
    assert!(matches!(
        Datagram::read(&unknown),
        Some(Datagram::Unknown { .. })
    ));
    assert_eq!(simulation.cores[A].counters().connections, 1);
}

#[test]
fn connections_of_one_address_are_bounded() {
    let limits = UdpLimits {
        max_connections: 16,
        max_per_address: 3,
        ..UdpLimits::default()
    };
    let mut simulation = Simulation::new(1, FAIR, &limits);
    for n in 0..30_u64 {
        let hello = hello_of(n + 1);
        let from = match n {
            0..10 => "198.51.100.7".to_owned(),
            // A host of IPv6 can use any number of addresses.
            10..20 => format!("[2001:db8::{n}]"),
            // All loopback addresses together have half of all slots.
            _ => format!("127.0.0.{n}"),
        };
        let from: SocketAddr = format!("{from}:{}", 1000 + n).parse().unwrap();
        simulation.receive(B, from, &packet::hello(n + 1, &NO_COOKIE, &hello));
        let reply = simulation.cores[B].poll_transmit(simulation.now).unwrap();
        let Some(Datagram::Cookie { cookie, .. }) = Datagram::read(&reply.contents) else {
            panic!("no cookie");
        };
        simulation.receive(B, from, &packet::hello(n + 1, &cookie, &hello));
        while simulation.cores[B].poll_transmit(simulation.now).is_some() {}
    }
    let counters = simulation.cores[B].counters();
    assert_eq!(
        (counters.accepted, counters.refused_crowd),
        (3 + 3 + 8, 7 + 7 + 2)
    );
    // Unused connections are removed.
    while simulation.step() {}
    assert_eq!(simulation.cores[B].counters().connections, 0);
}

#[test]
fn a_peer_beyond_its_rate_limit_is_delayed_without_loss() {
    let limits = UdpLimits {
        peer_letters: 20,
        ..UdpLimits::default()
    };
    let mut simulation = Simulation::new(1, FAIR, &limits);
    let begun = simulation.now;
    let attempts: BTreeSet<u64> = (0..100).collect();
    for number in &attempts {
        simulation.send(A, *number, 10).unwrap();
    }
    simulation.until_concluded(A, &attempts);
    assert_eq!(simulation.check(A, &attempts), attempts.len());
    assert!(simulation.now - begun >= Duration::from_secs(3), "too fast");
    let counters = simulation.cores[B].counters();
    assert!(counters.held_back > 0);
    assert_eq!((counters.accepted, counters.connections), (1, 1));
}

#[test]
fn an_interface_below_the_minimum_mtu_ends_the_connection() {
    let mut simulation = Simulation::new(1, FAIR, &UdpLimits::default());
    simulation.send(A, 1, 500).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1]));
    // Packets now leave by another interface.
    simulation.conditions.interface = 1000;
    let attempts = BTreeSet::from([1, 2, 3]);
    simulation.send(A, 2, 500).unwrap();
    simulation.send(A, 3, 1000).unwrap();
    simulation.until_concluded(A, &attempts);
    simulation.check(A, &attempts);
    let [Conclusion::Unconfirmed(error)] = &simulation.concluded[A][&AttemptId(3)][..] else {
        panic!("{:?}", simulation.concluded[A]);
    };
    assert_eq!(error.fault, TransportErrorKind::Broken);
    assert!(error.detail.contains("1200"), "{error}");
}

/// A peer that claims to be another one.
struct UnprovedSlot {
    from: SocketAddr,
    hello: crate::hello::Hello,
    cookie: packet::Cookie,
}

impl UnprovedSlot {
    /// A peer with the identity of B gets a cookie from A.
    fn as_b(simulation: &mut Simulation, from: &str, dialed: &str) -> Self {
        let hello = crate::hello::Hello {
            serial: 1 << 60,
            dialed: dialed.into(),
            ..simulation.cores[B].own_hello(0, String::new())
        };
        let from: SocketAddr = from.parse().unwrap();
        simulation.receive(A, from, &packet::hello(99, &NO_COOKIE, &hello));
        let reply = simulation.cores[A].poll_transmit(simulation.now).unwrap();
        let Some(Datagram::Cookie { cookie, .. }) = Datagram::read(&reply.contents) else {
            panic!("no cookie");
        };
        Self {
            from,
            hello,
            cookie,
        }
    }

    /// Sends a hello every 100 ms for this time. Datagrams of A to it are dropped.
    fn greets(&self, simulation: &mut Simulation, time: Duration) {
        let end = simulation.now + time;
        while simulation.now < end {
            let hello = packet::hello(99, &self.cookie, &self.hello);
            simulation.receive(A, self.from, &hello);
            simulation.flush();
            let next = simulation.now + Duration::from_millis(100);
            while simulation.next().is_some_and(|due| due <= next) {
                simulation.step();
            }
            simulation.now = next;
        }
    }
}

/// NetLimits with which no timeout ends a connection.
fn patient() -> UdpLimits {
    UdpLimits {
        connect_timeout: Duration::from_secs(1000),
        idle_close: Duration::from_secs(1000),
        ..UdpLimits::default()
    }
}

#[test]
fn an_unproved_peer_elsewhere_is_admitted_when_the_service_does_not_respond() {
    for gone in [false, true] {
        let mut simulation = Simulation::new(1, FAIR, &patient());
        simulation.send(A, 1, 10).unwrap();
        simulation.until_concluded(A, &BTreeSet::from([1]));
        let before = simulation.cores[A].counters();
        assert_eq!(before.connections, 1);
        simulation.cut = gone;
        let stranger = UnprovedSlot::as_b(&mut simulation, "192.0.2.99:7788", "x");
        stranger.greets(&mut simulation, Duration::from_millis(900));
        assert_eq!(
            simulation.cores[A].counters().accepted,
            before.accepted,
            "{gone}"
        );
        stranger.greets(&mut simulation, Duration::from_millis(900));
        let after = simulation.cores[A].counters();
        assert_eq!(after.connections, 1);
        assert_eq!(after.accepted - before.accepted, u64::from(gone));
        assert_eq!(after.refused_unproved > 0, !gone);
    }
}

#[test]
fn an_unproved_peer_at_the_service_address_is_admitted_when_the_service_does_not_respond() {
    for gone in [false, true] {
        let mut simulation = Simulation::new(1, FAIR, &patient());
        simulation.send(B, 1, 10).unwrap();
        let hello =
            simulation
                .wire
                .values()
                .find_map(|(_, _, bytes)| match Datagram::read(bytes) {
                    Some(Datagram::Hello { hello, .. }) => crate::hello::Hello::decode(hello),
                    _ => None,
                });
        let dialed = hello.unwrap().dialed;
        simulation.until_concluded(B, &BTreeSet::from([1]));
        assert_eq!(simulation.cores[A].counters().accepted, 1);
        simulation.cut = gone;
        let stranger = UnprovedSlot::as_b(&mut simulation, "192.0.2.2:99", &dialed);
        stranger.greets(&mut simulation, Duration::from_secs(2));
        let after = simulation.cores[A].counters();
        assert_eq!(
            (after.connections, after.accepted),
            (1, 1 + u64::from(gone))
        );
        // At its own address, the service itself may have opened another connection.
        assert_eq!(
            (after.refused_again > 0, after.refused_unproved),
            (!gone, 0)
        );
        // The letters of the service still arrive.
        if !gone {
            simulation.send(B, 2, 10).unwrap();
            simulation.until_concluded(B, &BTreeSet::from([1, 2]));
            assert_eq!(simulation.check(B, &BTreeSet::from([1, 2])), 2);
        }
    }
}

#[test]
fn a_service_is_admitted_at_once_at_each_listed_address() {
    let mut simulation = Simulation::new(1, FAIR, &patient());
    let other = "192.0.2.99:7788";
    simulation.cores[B].listens_on(vec![address(B).to_string(), other.to_owned()]);
    simulation.send(A, 1, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1]));
    let begun = simulation.now;
    let second = UnprovedSlot::as_b(&mut simulation, other, "x");
    second.greets(&mut simulation, Duration::from_millis(100));
    assert_eq!(simulation.cores[A].counters().connections, 2);
    // When the service has moved there, the first connection ends.
    simulation.cut = true;
    let third = UnprovedSlot::as_b(&mut simulation, other, "y");
    third.greets(&mut simulation, UdpLimits::default().silence);
    assert_eq!(
        simulation.cores[A].counters().connections,
        2,
        "{:?}",
        simulation.now - begun
    );
}

#[test]
fn a_peer_used_at_another_location_is_pinged_at_the_old_one() {
    let limits = UdpLimits {
        idle_close: Duration::from_secs(1000),
        ..UdpLimits::default()
    };
    let mut simulation = Simulation::new(1, FAIR, &limits);
    simulation.send(A, 1, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1]));
    simulation.cut = true;
    let begun = simulation.now;
    simulation.now += limits.silence / 4;
    let peer = simulation.cores[B].own_hello(0, String::new()).identity;
    let elsewhere = Location::new(Kind::Udp, "192.0.2.99:7788").unwrap();
    let elsewhere = elsewhere.with_incarnation(peer.incarnation);
    let fresh = simulation.cores[A].post(simulation.now, AttemptId(2), &elsewhere, &parcel(2, 10));
    assert_eq!(fresh.unwrap(), None, "over the existing connection");
    simulation.flush();
    simulation.until_concluded(A, &BTreeSet::from([1, 2]));
    assert!(simulation.now - begun <= limits.silence / 2);
    let fresh = simulation.cores[A].post(simulation.now, AttemptId(3), &elsewhere, &parcel(3, 10));
    assert!(fresh.unwrap().is_some(), "over another connection");
}

#[test]
fn a_connection_ends_soon_after_its_peer_has_announced_another_address() {
    for gone in [false, true] {
        let limits = UdpLimits::default();
        let mut simulation = Simulation::new(1, FAIR, &limits);
        simulation.send(A, 1, 10).unwrap();
        simulation.until_concluded(A, &BTreeSet::from([1]));
        simulation.cut = gone;
        let begun = simulation.now;
        simulation.send(A, 2, 10).unwrap();
        let incarnation = simulation.cores[B].own_hello(0, String::new()).identity;
        let incarnation = incarnation.incarnation;
        let elsewhere = Location::new(Kind::Udp, "192.0.2.99:7788").unwrap();
        // It was never at the first of these.
        for location in [elsewhere, to(B)] {
            let location = location.with_incarnation(incarnation);
            simulation.cores[A].location_vacated(simulation.now, &location);
        }
        simulation.flush();
        simulation.until_concluded(A, &BTreeSet::from([1, 2]));
        let took = simulation.now - begun;
        assert!(took <= Duration::from_millis(250), "{took:?}");
        let connections = simulation.cores[A].counters().connections;
        assert_eq!(connections, u64::from(!gone));
    }
}

#[test]
fn connections_of_a_removed_address_end() {
    let mut simulation = Simulation::new(1, FAIR, &UdpLimits::default());
    simulation.send(A, 1, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1]));
    let lost = HashSet::from([address(A).ip()]);
    simulation.cores[A].lost(&lost, |_| Some(address(B).ip()));
    assert_eq!(simulation.cores[A].counters().connections, 1);
    simulation.cores[A].lost(&lost, |_| Some(address(A).ip()));
    assert_eq!(simulation.cores[A].counters().connections, 0);
}
