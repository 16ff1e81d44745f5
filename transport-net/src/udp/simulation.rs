//! Two endpoints on virtual time, with a network between them that a seed makes lose, delay,
//! reorder and repeat datagrams, and the promises checked in every run.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use fipa_transport::{
    Answer, AttemptId, Body, Conclusion, Incarnation, Kind, Location, Parcel, Stream, Ticket,
    WayFault,
};

use super::config::UdpLimits;
use super::connection::Path;
use super::core::{Core, CoreEvent, Transmit};
use super::packet::{self, BASE, Datagram, NO_COOKIE};
use crate::Identity;

const A: usize = 0;
const B: usize = 1;

/// How the network treats datagrams.
#[derive(Debug, Clone, Copy)]
struct Weather {
    loss: f64,
    twice: f64,
    delay: (u64, u64),
    /// Largest datagram that gets through.
    path: usize,
    /// Largest datagram that the own interface takes.
    interface: usize,
}

const FAIR: Weather = Weather {
    loss: 0.0,
    twice: 0.0,
    delay: (100, 200),
    path: 1452,
    interface: 1452,
};

struct World {
    now: Instant,
    random: fastrand::Rng,
    weather: Weather,
    cores: [Core; 2],
    /// Datagrams under way: when they arrive, at whom, from whom.
    wire: BTreeMap<(Instant, u64), (usize, SocketAddr, Vec<u8>)>,
    count: u64,
    arrived: [Vec<Parcel>; 2],
    concluded: [HashMap<AttemptId, Vec<Conclusion>>; 2],
    /// Answers that come later.
    owed: BTreeMap<(Instant, u64), (usize, Ticket)>,
    /// How many of the arrivals are answered late.
    late: f64,
    cut: bool,
}

fn address(who: usize) -> SocketAddr {
    SocketAddr::from(([192, 0, 2, who as u8 + 1], 7788))
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

impl World {
    fn new(seed: u64, weather: Weather, limits: &UdpLimits) -> Self {
        let now = Instant::now();
        Self {
            now,
            random: fastrand::Rng::with_seed(seed),
            weather,
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

    fn send(&mut self, from: usize, attempt: u64, len: usize) -> Result<(), WayFault> {
        let to = Location::new(Kind::Udp, &address(1 - from).to_string()).unwrap();
        let parcel = parcel(attempt, len);
        let fresh = self.cores[from]
            .dispatch(self.now, AttemptId(attempt), &to, &parcel)
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

    /// Everybody sends what there is to send, and tells what there is to tell.
    fn flush(&mut self) {
        for who in [A, B] {
            loop {
                while let Some(told) = self.cores[who].poll_event() {
                    self.tell(who, told);
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

    fn tell(&mut self, who: usize, told: CoreEvent) {
        match told {
            CoreEvent::Concluded(attempt, conclusion) => {
                let heard = self.concluded[who].entry(attempt).or_default();
                heard.push(conclusion);
            }
            CoreEvent::Introduced(_) | CoreEvent::Parted(_) => {}
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
        if len > self.weather.interface {
            if let Some(number) = transmit.connection {
                self.cores[who].too_big(number, len);
            }
            return;
        }
        let weather = self.weather;
        let copies = 1 + usize::from(self.random.f64() < weather.twice);
        for _ in 0..copies {
            if self.cut || len > weather.path || self.random.f64() < weather.loss {
                continue;
            }
            let delay = self.random.u64(weather.delay.0..=weather.delay.1);
            self.count += 1;
            self.wire.insert(
                (self.now + Duration::from_micros(delay), self.count),
                (1 - who, address(who), transmit.contents.clone()),
            );
        }
    }

    /// When something happens next.
    fn next(&self) -> Option<Instant> {
        let next = [
            self.wire.keys().next().map(|(at, _)| *at),
            self.owed.keys().next().map(|(at, _)| *at),
            self.cores[A].poll_timeout(),
            self.cores[B].poll_timeout(),
        ];
        next.into_iter().flatten().min()
    }

    /// Goes on to what happens next. Nothing happens any more when it says no.
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

    /// What every run must keep, whatever the weather. Says how many were accepted.
    fn check(&self, from: usize, attempts: &BTreeSet<u64>) -> usize {
        let order: Vec<u64> = self.arrived[1 - from].iter().map(|p| p.sequence).collect();
        let arrived: BTreeSet<u64> = order.iter().copied().collect();
        assert_eq!(arrived.len(), order.len(), "something arrived twice");
        assert!(order.is_sorted(), "out of order: {order:?}");
        let mut accepted = 0;
        for attempt in attempts {
            let heard = &self.concluded[from][&AttemptId(*attempt)];
            assert_eq!(heard.len(), 1, "{attempt}: {heard:?}");
            let arrived = arrived.contains(attempt);
            match &heard[0] {
                Conclusion::Answered(Answer::Accepted) => {
                    assert!(arrived, "{attempt} was accepted by nobody");
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
        stream: Stream {
            sender: Incarnation::from_u64(1),
            receiver: Incarnation::from_u64(2),
        },
        sequence,
        after: 0,
        remaining: Duration::from_secs(5),
        transfer: 0,
        body: Body::Letter(Letter::new(Bytes::from_static(b"envelope"), payload)),
    }
}

fn seeds() -> std::ops::Range<u64> {
    match std::env::var("FIPA_SIM_SEEDS") {
        Ok(count) => 0..count.parse().unwrap(),
        Err(_) => 0..60,
    }
}

/// Many letters of many sizes in a weather, both ways; says how many were sent and accepted.
fn run(seed: u64, weather: Weather, late: f64) -> (usize, usize) {
    let limits = UdpLimits {
        // 30 % lost each way is no silence.
        silence: Duration::from_secs(20),
        connect_timeout: Duration::from_secs(20),
        ..UdpLimits::default()
    };
    let mut world = World::new(seed, weather, &limits);
    world.late = late;
    let mut attempts = [BTreeSet::new(), BTreeSet::new()];
    for number in 0..200 {
        let from = usize::from(world.random.bool());
        let len = match world.random.u8(..) {
            0..200 => world.random.usize(0..300),
            200..250 => world.random.usize(0..1300),
            _ => world.random.usize(0..3000),
        };
        match world.send(from, number, len) {
            Ok(()) => {
                attempts[from].insert(number);
            }
            Err(fault) => assert_eq!(fault, WayFault::TooLarge, "seed {seed}"),
        }
        for _ in 0..world.random.u8(0..4) {
            world.step();
        }
        if world.random.u8(..) < 8
            && let Some(open) = attempts[from].last().copied()
            && !world.concluded[from].contains_key(&AttemptId(open))
        {
            world.cores[from].abandon(AttemptId(open));
            attempts[from].remove(&open);
        }
    }
    world.until_concluded(A, &attempts[A]);
    world.until_concluded(B, &attempts[B]);
    let sent = attempts[A].len() + attempts[B].len();
    let accepted = world.check(A, &attempts[A]) + world.check(B, &attempts[B]);
    (sent, accepted)
}

/// Runs every seed, and says which one it was when something breaks.
fn every_seed(test: impl Fn(u64)) {
    for seed in seeds() {
        let run = std::panic::AssertUnwindSafe(|| test(seed));
        if let Err(panic) = std::panic::catch_unwind(run) {
            tracing::error!(seed, "broke");
            let said = panic
                .downcast_ref::<String>()
                .cloned()
                .or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()));
            panic!("seed {seed}: {}", said.unwrap_or_default());
        }
    }
}

#[test]
fn in_fair_weather_everything_that_fits_is_accepted() {
    every_seed(|seed| {
        let (sent, accepted) = run(seed, FAIR, 0.0);
        assert!(sent - accepted <= 10, "{accepted} of {sent}");
    });
}

#[test]
fn in_bad_weather_the_promises_hold() {
    every_seed(|seed| {
        let weather = Weather {
            loss: [0.01, 0.1, 0.3][seed as usize % 3],
            twice: 0.1,
            delay: (100, 30_000),
            ..FAIR
        };
        let (sent, accepted) = run(seed, weather, 0.3);
        assert!(accepted * 10 > sent * 8, "{accepted} of {sent}");
    });
}

#[test]
fn over_any_path_the_promises_hold() {
    every_seed(|seed| {
        let mut random = fastrand::Rng::with_seed(seed);
        let interface = random.usize(BASE..70_000);
        let weather = Weather {
            loss: 0.02,
            path: random.usize(BASE..=interface),
            interface,
            delay: (50, random.u64(60..50_000)),
            twice: 0.02,
        };
        run(seed, weather, 0.1);
    });
}

#[test]
fn a_peer_that_vanishes_is_noticed_and_nothing_is_claimed() {
    every_seed(|seed| {
        let mut world = World::new(seed, FAIR, &UdpLimits::default());
        let mut attempts = BTreeSet::new();
        for number in 0..40 {
            if number == 20 {
                world.cut = true;
                world.wire.clear();
            }
            if world.send(A, number, 100).is_ok() {
                attempts.insert(number);
            }
            world.step();
        }
        let cut = world.now;
        world.until_concluded(A, &attempts);
        let accepted = world.check(A, &attempts);
        assert!(accepted < attempts.len());
        assert!(world.now < cut + Duration::from_secs(5), "noticed too late");
        // What comes next begins anew, and fails while nobody is there.
        world.send(A, 100, 1).unwrap();
        while !world.concluded[A].contains_key(&AttemptId(100)) {
            assert!(world.step());
        }
        assert!(matches!(
            &world.concluded[A][&AttemptId(100)][0],
            Conclusion::NotSent(error) if error.fault == WayFault::Unreachable
        ));
        world.cut = false;
        world.send(A, 101, 1).unwrap();
        while !world.concluded[A].contains_key(&AttemptId(101)) {
            assert!(world.step());
        }
        let accepted = Conclusion::Answered(Answer::Accepted);
        assert_eq!(world.concluded[A][&AttemptId(101)], [accepted]);
    });
}

#[test]
fn a_peer_that_restarted_says_so() {
    let limits = UdpLimits::default();
    let mut world = World::new(1, FAIR, &limits);
    world.send(A, 1, 10).unwrap();
    world.until_concluded(A, &BTreeSet::from([1]));
    world.cores[B] = core(B, 2, &limits, world.now);
    let restarted = world.now;
    world.send(A, 2, 10).unwrap();
    world.until_concluded(A, &BTreeSet::from([1, 2]));
    assert!(matches!(
        &world.concluded[A][&AttemptId(2)][0],
        Conclusion::Unconfirmed(error) if error.fault == WayFault::Broken
    ));
    assert!(world.now < restarted + Duration::from_millis(50));
    world.send(A, 3, 10).unwrap();
    world.until_concluded(A, &BTreeSet::from([1, 2, 3]));
    assert_eq!(world.check(A, &BTreeSet::from([1, 3])), 1 + 1);
}

#[test]
fn what_is_idle_is_forgotten_at_both_sides() {
    let mut world = World::new(1, FAIR, &UdpLimits::default());
    world.send(A, 1, 10).unwrap();
    while world.step() {}
    assert_eq!(world.check(A, &BTreeSet::from([1])), 1);
    for core in &world.cores {
        assert_eq!(core.counters().connections, 0);
    }
}

#[test]
fn strangers_leave_nothing_behind_and_get_less_than_they_sent() {
    let mut world = World::new(1, FAIR, &UdpLimits::default());
    let hello = crate::hello::Hello {
        identity: Identity {
            name: "x".into(),
            incarnation: Incarnation::from_u64(9),
            domain: "test".into(),
            host: "x".into(),
        },
        max_letter: 1000,
        max_in_flight: 10,
        serial: 1,
        dialled: "x".into(),
        listening: Vec::new(),
    };
    let spoofed = |n: u32| SocketAddr::from((n.to_be_bytes(), 99));
    let mut told = 0;
    for n in 1..2000_u32 {
        let cookie = if n % 2 == 0 { NO_COOKIE } else { [n as u8; 16] };
        let first = packet::hello(n.into(), &cookie, &hello);
        world.receive(B, spoofed(n), &first);
        let mut data = Vec::new();
        packet::put_data(&mut data, n.into(), 1);
        packet::put_ping(&mut data);
        world.receive(B, spoofed(n), &data);
        while let Some(reply) = world.cores[B].poll_transmit(world.now) {
            assert_eq!(reply.path.remote, spoofed(n));
            assert!(reply.contents.len() <= data.len().max(first.len() / 30));
            told += 1;
        }
    }
    assert_eq!(told, 2 * 1999);
    assert_eq!(world.cores[B].counters().accepted, 0);
    assert_eq!(world.cores[B].poll_timeout(), None);
}

#[test]
fn replayed_and_forged_datagrams_change_nothing() {
    let mut world = World::new(1, FAIR, &UdpLimits::default());
    let mut recorded: Vec<(SocketAddr, Vec<u8>)> = Vec::new();
    for number in 0..20 {
        world.send(A, number, 50).unwrap();
        while !world.concluded[A].contains_key(&AttemptId(number)) {
            recorded.extend(
                world
                    .wire
                    .values()
                    .filter(|(to, ..)| *to == B)
                    .map(|(_, from, bytes)| (*from, bytes.clone())),
            );
            world.step();
        }
    }
    let stranger: SocketAddr = "203.0.113.9:7788".parse().unwrap();
    for (from, bytes) in recorded.clone() {
        // Again from the same address, from another, and with a connection that does not exist.
        world.receive(B, from, &bytes);
        world.receive(B, stranger, &bytes);
        let mut forged = bytes.clone();
        forged[8] ^= 1;
        world.receive(B, from, &forged);
        world.flush();
    }
    assert_eq!(world.arrived[B].len(), 20);
    assert_eq!(world.cores[B].counters().connections, 1);
    world.send(A, 100, 10).unwrap();
    while !world.concluded[A].contains_key(&AttemptId(100)) {
        assert!(world.step());
    }
    assert_eq!(world.arrived[B].len(), 21);
    // Somebody who has not seen the number of the connection cannot end it.
    let unknown = packet::unknown(12345);
    world.receive(A, address(B), &unknown);
    assert!(matches!(
        Datagram::read(&unknown),
        Some(Datagram::Unknown { .. })
    ));
    assert_eq!(world.cores[A].counters().connections, 1);
}

#[test]
fn one_address_opens_so_many_connections_and_no_more() {
    let limits = UdpLimits {
        max_connections: 16,
        max_per_address: 3,
        ..UdpLimits::default()
    };
    let mut world = World::new(1, FAIR, &limits);
    for n in 0..30_u64 {
        let hello = crate::hello::Hello {
            identity: Identity {
                name: "x".into(),
                incarnation: Incarnation::from_u64(n + 1),
                domain: "test".into(),
                host: "x".into(),
            },
            max_letter: 1000,
            max_in_flight: 10,
            serial: 1,
            dialled: "x".into(),
            listening: Vec::new(),
        };
        let from = match n {
            0..10 => "198.51.100.7".to_owned(),
            // A host of IPv6 takes as many addresses as it likes.
            10..20 => format!("[2001:db8::{n}]"),
            // All of loopback has half of all places.
            _ => format!("127.0.0.{n}"),
        };
        let from: SocketAddr = format!("{from}:{}", 1000 + n).parse().unwrap();
        world.receive(B, from, &packet::hello(n + 1, &NO_COOKIE, &hello));
        let reply = world.cores[B].poll_transmit(world.now).unwrap();
        let Some(Datagram::Cookie { cookie, .. }) = Datagram::read(&reply.contents) else {
            panic!("no cookie");
        };
        world.receive(B, from, &packet::hello(n + 1, &cookie, &hello));
        while world.cores[B].poll_transmit(world.now).is_some() {}
    }
    let counters = world.cores[B].counters();
    assert_eq!(
        (counters.accepted, counters.refused_crowd),
        (3 + 3 + 8, 7 + 7 + 2)
    );
    // They never said anything more, and are forgotten.
    while world.step() {}
    assert_eq!(world.cores[B].counters().connections, 0);
}

#[test]
fn a_peer_that_sends_more_than_it_may_is_held_back_and_loses_nothing() {
    let limits = UdpLimits {
        peer_letters: 20,
        ..UdpLimits::default()
    };
    let mut world = World::new(1, FAIR, &limits);
    let begun = world.now;
    let attempts: BTreeSet<u64> = (0..100).collect();
    for number in &attempts {
        world.send(A, *number, 10).unwrap();
    }
    world.until_concluded(A, &attempts);
    assert_eq!(world.check(A, &attempts), attempts.len());
    assert!(world.now - begun >= Duration::from_secs(3), "too fast");
    let counters = world.cores[B].counters();
    assert!(counters.held_back > 0);
    assert_eq!((counters.accepted, counters.connections), (1, 1));
}

#[test]
fn an_interface_that_takes_less_than_every_path_carries_ends_the_connection() {
    let mut world = World::new(1, FAIR, &UdpLimits::default());
    world.send(A, 1, 500).unwrap();
    world.until_concluded(A, &BTreeSet::from([1]));
    // Packets leave by another interface from now on.
    world.weather.interface = 1000;
    let attempts = BTreeSet::from([1, 2, 3]);
    world.send(A, 2, 500).unwrap();
    world.send(A, 3, 1000).unwrap();
    world.until_concluded(A, &attempts);
    world.check(A, &attempts);
    let [Conclusion::Unconfirmed(error)] = &world.concluded[A][&AttemptId(3)][..] else {
        panic!("{:?}", world.concluded[A]);
    };
    assert_eq!(error.fault, WayFault::Broken);
    assert!(error.detail.contains("1200"), "{error}");
}

/// A peer that says to be another one.
struct UnprovedSlot {
    from: SocketAddr,
    hello: crate::hello::Hello,
    cookie: packet::Cookie,
}

impl UnprovedSlot {
    /// A peer with the identity of B gets a cookie from A.
    fn as_b(world: &mut World, from: &str, dialled: &str) -> Self {
        let hello = crate::hello::Hello {
            serial: 1 << 60,
            dialled: dialled.into(),
            ..world.cores[B].own_hello(0, String::new())
        };
        let from: SocketAddr = from.parse().unwrap();
        world.receive(A, from, &packet::hello(99, &NO_COOKIE, &hello));
        let reply = world.cores[A].poll_transmit(world.now).unwrap();
        let Some(Datagram::Cookie { cookie, .. }) = Datagram::read(&reply.contents) else {
            panic!("no cookie");
        };
        Self {
            from,
            hello,
            cookie,
        }
    }

    /// Says hello every 100 ms for this time. What A sends it goes nowhere.
    fn greets(&self, world: &mut World, time: Duration) {
        let end = world.now + time;
        while world.now < end {
            let hello = packet::hello(99, &self.cookie, &self.hello);
            world.receive(A, self.from, &hello);
            world.flush();
            let next = world.now + Duration::from_millis(100);
            while world.next().is_some_and(|due| due <= next) {
                world.step();
            }
            world.now = next;
        }
    }
}

/// Nothing but what the tests are about ends a connection.
fn patient() -> UdpLimits {
    UdpLimits {
        connect_timeout: Duration::from_secs(1000),
        idle_close: Duration::from_secs(1000),
        ..UdpLimits::default()
    }
}

#[test]
fn a_stranger_elsewhere_is_served_when_the_service_gives_no_sign_of_life() {
    for gone in [false, true] {
        let mut world = World::new(1, FAIR, &patient());
        world.send(A, 1, 10).unwrap();
        world.until_concluded(A, &BTreeSet::from([1]));
        let before = world.cores[A].counters();
        assert_eq!(before.connections, 1);
        world.cut = gone;
        let stranger = UnprovedSlot::as_b(&mut world, "192.0.2.99:7788", "x");
        stranger.greets(&mut world, Duration::from_millis(900));
        assert_eq!(
            world.cores[A].counters().accepted,
            before.accepted,
            "{gone}"
        );
        stranger.greets(&mut world, Duration::from_millis(900));
        let after = world.cores[A].counters();
        assert_eq!(after.connections, 1);
        assert_eq!(after.accepted - before.accepted, u64::from(gone));
        assert_eq!(after.refused_unproved > 0, !gone);
    }
}

#[test]
fn a_stranger_at_the_address_of_the_service_is_served_when_that_gives_no_sign_of_life() {
    for gone in [false, true] {
        let mut world = World::new(1, FAIR, &patient());
        world.send(B, 1, 10).unwrap();
        let hello = world
            .wire
            .values()
            .find_map(|(_, _, bytes)| match Datagram::read(bytes) {
                Some(Datagram::Hello { hello, .. }) => crate::hello::Hello::decode(hello),
                _ => None,
            });
        let dialled = hello.unwrap().dialled;
        world.until_concluded(B, &BTreeSet::from([1]));
        assert_eq!(world.cores[A].counters().accepted, 1);
        world.cut = gone;
        let stranger = UnprovedSlot::as_b(&mut world, "192.0.2.2:99", &dialled);
        stranger.greets(&mut world, Duration::from_secs(2));
        let after = world.cores[A].counters();
        assert_eq!(
            (after.connections, after.accepted),
            (1, 1 + u64::from(gone))
        );
        // The letters of the service still arrive.
        if !gone {
            world.send(B, 2, 10).unwrap();
            world.until_concluded(B, &BTreeSet::from([1, 2]));
            assert_eq!(world.check(B, &BTreeSet::from([1, 2])), 2);
        }
    }
}

#[test]
fn a_service_is_served_at_once_at_each_address_that_its_first_connection_lists() {
    let mut world = World::new(1, FAIR, &patient());
    let other = "192.0.2.99:7788";
    world.cores[B].listens_on(vec![address(B).to_string(), other.to_owned()]);
    world.send(A, 1, 10).unwrap();
    world.until_concluded(A, &BTreeSet::from([1]));
    let begun = world.now;
    let second = UnprovedSlot::as_b(&mut world, other, "x");
    second.greets(&mut world, Duration::from_millis(100));
    assert_eq!(world.cores[A].counters().connections, 2);
    // When it has moved there, the first connection ends.
    world.cut = true;
    let third = UnprovedSlot::as_b(&mut world, other, "y");
    third.greets(&mut world, UdpLimits::default().silence);
    assert_eq!(
        world.cores[A].counters().connections,
        2,
        "{:?}",
        world.now - begun
    );
}

#[test]
fn a_peer_that_is_looked_for_elsewhere_is_asked_where_it_was() {
    let limits = UdpLimits {
        idle_close: Duration::from_secs(1000),
        ..UdpLimits::default()
    };
    let mut world = World::new(1, FAIR, &limits);
    world.send(A, 1, 10).unwrap();
    world.until_concluded(A, &BTreeSet::from([1]));
    world.cut = true;
    let begun = world.now;
    world.now += limits.silence / 4;
    let peer = world.cores[B].own_hello(0, String::new()).identity;
    let elsewhere = Location::new(Kind::Udp, "192.0.2.99:7788").unwrap();
    let elsewhere = elsewhere.with_incarnation(peer.incarnation);
    let fresh = world.cores[A].dispatch(world.now, AttemptId(2), &elsewhere, &parcel(2, 10));
    assert_eq!(fresh.unwrap(), None, "by the connection that is there");
    world.flush();
    world.until_concluded(A, &BTreeSet::from([1, 2]));
    assert!(world.now - begun <= limits.silence / 2);
    let fresh = world.cores[A].dispatch(world.now, AttemptId(3), &elsewhere, &parcel(3, 10));
    assert!(fresh.unwrap().is_some(), "by another one");
}

#[test]
fn connections_of_an_address_that_is_gone_end() {
    let mut world = World::new(1, FAIR, &UdpLimits::default());
    world.send(A, 1, 10).unwrap();
    world.until_concluded(A, &BTreeSet::from([1]));
    let lost = HashSet::from([address(A).ip()]);
    world.cores[A].lost(&lost, |_| Some(address(B).ip()));
    assert_eq!(world.cores[A].counters().connections, 1);
    world.cores[A].lost(&lost, |_| Some(address(A).ip()));
    assert_eq!(world.cores[A].counters().connections, 0);
}
