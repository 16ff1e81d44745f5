//! Two endpoints on virtual time. The network between them loses, delays, reorders and repeats
//! packets depending on a seed. Every run checks the guarantees of the transport.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::Letter;
use fipa_transport::{
    Abandoned, AttemptId, Conclusion, Kind, Location, TransportError, TransportErrorKind,
};

use super::config::UdtLimits;
use super::core::{Core, CoreEvent};
use super::packet::{
    self, CONCLUSION, Control, DATAGRAMS, Data, HANDSHAKE_LEN, Handshake, Packet, Position,
    REFUSAL, REQUEST, VERSION,
};
use super::untranslated::Translation;
use crate::datagrams::{DatagramCore, Path, Transmit};

const A: usize = 0;
const B: usize = 1;

/// The conditions of the simulated network.
#[derive(Debug, Clone, Copy)]
struct LinkConditions {
    loss: f64,
    twice: f64,
    /// Shortest and longest delay in microseconds.
    delay: (u64, u64),
    /// Packets per second; more are delayed.
    capacity: u64,
    /// Longest delay of that kind in microseconds; longer ones are losses.
    queue: u64,
    /// Longest time of the translation of a letter in microseconds.
    translation: u64,
}

const FAIR: LinkConditions = LinkConditions {
    loss: 0.0,
    twice: 0.0,
    delay: (100, 200),
    capacity: 1_000_000,
    queue: 1_000_000,
    translation: 0,
};

/// Packets in flight: time of arrival and number; receiver, sender and contents.
type Wire = BTreeMap<(Instant, u64), (usize, SocketAddr, Vec<u8>)>;

struct Simulation {
    now: Instant,
    random: fastrand::Rng,
    conditions: LinkConditions,
    cores: [Core; 2],
    /// The letter that each side translates, and the time at which the translation ends.
    translations: [Option<(Instant, Translation)>; 2],
    wire: Wire,
    /// Time until which the link from each side is busy.
    busy: [Instant; 2],
    count: u64,
    /// The numbers of the letters that arrived.
    arrived: [Vec<u64>; 2],
    /// The beginnings of letters that were too large.
    too_large: [Vec<Bytes>; 2],
    concluded: [HashMap<AttemptId, Vec<Conclusion>>; 2],
    cut: bool,
    /// Packets of data that were sent by each side.
    data: [u64; 2],
}

fn address(who: usize) -> SocketAddr {
    SocketAddr::from(([192, 0, 2, who as u8 + 1], 7790))
}

fn path(remote: SocketAddr) -> Path {
    Path {
        socket: 1,
        remote,
        local: None,
    }
}

fn core(who: usize, seed: u64, limits: &UdtLimits, now: Instant) -> Core {
    let mut random = fastrand::Rng::with_seed(seed * 10 + who as u64);
    let draw = Box::new(move || random.u64(1..));
    Core::new(limits.clone(), Box::new(|_| true), draw, now)
}

/// A letter of this length or more, with its number in front.
fn letter(number: u64, len: usize) -> [Bytes; 2] {
    let mut bytes = number.to_le_bytes().to_vec();
    let len = len.max(bytes.len());
    let mut random = fastrand::Rng::with_seed(number);
    bytes.resize_with(len, || random.u8(..));
    let bytes = Bytes::from(bytes);
    let middle = len / 2;
    [bytes.slice(..middle), bytes.slice(middle..)]
}

/// Returns the pieces of a letter unchanged.
fn pieces(translation: &Translation) -> [Bytes; 2] {
    let letter = &translation.letter;
    [letter.envelope(), letter.payload().to_bytes()]
}

fn to(who: usize) -> Location {
    Location::new(Kind::Udt, &address(who).to_string()).unwrap()
}

impl Simulation {
    fn new(seed: u64, conditions: LinkConditions, limits: &UdtLimits) -> Self {
        let now = Instant::now();
        Self {
            now,
            random: fastrand::Rng::with_seed(seed),
            conditions,
            cores: [core(A, seed, limits, now), core(B, seed, limits, now)],
            translations: [None, None],
            wire: BTreeMap::new(),
            busy: [now; 2],
            count: 0,
            arrived: Default::default(),
            too_large: Default::default(),
            concluded: Default::default(),
            cut: false,
            data: [0; 2],
        }
    }

    fn send(&mut self, from: usize, number: u64, len: usize) -> Result<(), TransportErrorKind> {
        let [envelope, message] = letter(number, len);
        let letter = Letter::new(envelope, message);
        self.cores[from]
            .post(AttemptId(number), &to(1 - from), "arm".into(), letter)
            .map_err(|error| error.fault)?;
        self.flush();
        Ok(())
    }

    /// Translates the letters of one side, as far as there is time.
    fn translate(&mut self, who: usize) {
        loop {
            if let Some((ends, _)) = &self.translations[who]
                && *ends > self.now
            {
                return;
            }
            if let Some((_, translation)) = self.translations[who].take() {
                let fresh = self.cores[who].handle_translated(self.now, Ok(pieces(&translation)));
                if let Some(fresh) = fresh {
                    self.cores[who].begin(self.now, fresh, vec![path(address(1 - who))]);
                }
            }
            let Some(next) = self.cores[who].begin_translation() else {
                return;
            };
            let took = match self.conditions.translation {
                0 => 0,
                longest => self.random.u64(..longest),
            };
            self.translations[who] = Some((self.now + Duration::from_micros(took), next));
        }
    }

    /// Sends all pending packets and handles all events.
    fn flush(&mut self) {
        for who in [A, B] {
            self.translate(who);
            loop {
                while let Some(event) = self.cores[who].poll_event() {
                    self.handle(who, event);
                }
                let Some(transmit) = self.cores[who].poll_transmit(self.now) else {
                    if self.cores[who].has_events() {
                        continue;
                    }
                    break;
                };
                self.transmit(who, &transmit);
            }
        }
    }

    fn handle(&mut self, who: usize, event: CoreEvent) {
        match event {
            CoreEvent::Concluded(attempt, conclusion) => {
                let concluded = self.concluded[who].entry(attempt).or_default();
                concluded.push(conclusion);
            }
            CoreEvent::TooLarge(beginning, from) => {
                assert_eq!(from, address(1 - who));
                self.too_large[who].push(beginning);
            }
            CoreEvent::Arrived(arrived, from) => {
                assert_eq!(from, address(1 - who));
                let number = arrived.bytes.first_chunk().copied().unwrap();
                let number = u64::from_le_bytes(number);
                let sent = letter(number, arrived.bytes.len()).concat();
                assert_eq!(arrived.bytes, sent, "letter {number} has changed");
                self.arrived[who].push(number);
            }
        }
    }

    fn transmit(&mut self, who: usize, transmit: &Transmit) {
        if transmit.path.remote != address(1 - who) {
            return;
        }
        let segment = transmit.segment.unwrap_or(transmit.contents.len());
        for packet in transmit.contents.chunks(segment) {
            assert!(packet.len() <= 1472);
            if let Some((_, Packet::Data(_))) = Packet::read(packet) {
                self.data[who] += 1;
            }
            let conditions = self.conditions;
            let begins = self.busy[who].max(self.now);
            if begins > self.now + Duration::from_micros(conditions.queue) {
                continue;
            }
            let ends = begins + Duration::from_nanos(1_000_000_000 / conditions.capacity);
            self.busy[who] = ends;
            let copies = 1 + usize::from(self.random.f64() < conditions.twice);
            for _ in 0..copies {
                if self.cut || self.random.f64() < conditions.loss {
                    continue;
                }
                let delay = self.random.u64(conditions.delay.0..=conditions.delay.1);
                self.count += 1;
                self.wire.insert(
                    (ends + Duration::from_micros(delay), self.count),
                    (1 - who, address(who), packet.to_vec()),
                );
            }
        }
    }

    /// Returns the time of the next event.
    fn next(&self) -> Option<Instant> {
        let translated = |who: usize| self.translations[who].as_ref().map(|(ends, _)| *ends);
        let next = [
            translated(A),
            translated(B),
            self.wire.keys().next().map(|(at, _)| *at),
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
        for core in &mut self.cores {
            core.handle_timeout(self.now);
        }
        self.flush();
        true
    }

    fn receive(&mut self, to: usize, from: SocketAddr, bytes: &[u8]) {
        self.cores[to].handle_datagram(self.now, path(from), true, bytes);
    }

    /// Runs until every attempt is concluded.
    fn until_concluded(&mut self, from: usize, attempts: &BTreeSet<u64>) {
        let deadline = self.now + Duration::from_secs(600);
        while self.concluded[from].len() < attempts.len() {
            assert!(self.step() && self.now < deadline, "an attempt stays open");
        }
    }

    /// Runs for this time.
    fn pass(&mut self, time: Duration) {
        let until = self.now + time;
        while self.next().is_some_and(|next| next <= until) {
            self.step();
        }
        self.now = until;
    }

    /// Checks the guarantees that hold under all conditions. Returns the number of letters that were
    /// handed over.
    fn check(&self, from: usize, attempts: &BTreeSet<u64>) -> usize {
        let order = &self.arrived[1 - from];
        let arrived: BTreeSet<u64> = order.iter().copied().collect();
        assert_eq!(arrived.len(), order.len(), "a letter arrived twice");
        assert!(order.is_sorted(), "out of order: {order:?}");
        let mut handed = 0;
        for attempt in attempts {
            let concluded = &self.concluded[from][&AttemptId(*attempt)];
            assert_eq!(concluded.len(), 1, "{attempt}: {concluded:?}");
            let arrived = arrived.contains(attempt);
            match &concluded[0] {
                Conclusion::Handed => {
                    assert!(arrived, "{attempt} was handed over but did not arrive");
                    handed += 1;
                }
                Conclusion::NotSent(error) => {
                    assert!(!arrived, "{attempt} arrived, but was not sent: {error}");
                }
                Conclusion::Unconfirmed(_) => {}
                other => panic!("{other:?}"),
            }
        }
        handed
    }
}

fn seeds() -> std::ops::Range<u64> {
    match std::env::var("FIPA_SIM_SEEDS") {
        Ok(count) => 0..count.parse().unwrap(),
        Err(_) => 0..9,
    }
}

/// Runs every seed, and reports the seed of a failure.
fn every_seed(test: impl Fn(u64)) {
    for seed in seeds() {
        let run = std::panic::AssertUnwindSafe(|| test(seed));
        if let Err(panic) = std::panic::catch_unwind(run) {
            let said = panic
                .downcast_ref::<String>()
                .cloned()
                .or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()));
            panic!("seed {seed}: {}", said.unwrap_or_default());
        }
    }
}

/// Sends letters of many sizes in both directions under some conditions, and abandons a few.
/// Checks that all others are handed over.
fn run(seed: u64, conditions: LinkConditions) -> Simulation {
    let limits = UdtLimits {
        // A loss of 30 % in each direction must not count as silence.
        silence: Duration::from_secs(30),
        connect_timeout: Duration::from_secs(30),
        stall_timeout: Duration::from_secs(60),
        ..UdtLimits::default()
    };
    let mut simulation = Simulation::new(seed, conditions, &limits);
    let mut attempts = [BTreeSet::new(), BTreeSet::new()];
    for number in 0..60 {
        let from = usize::from(simulation.random.bool());
        let len = match simulation.random.u8(..) {
            0..150 => simulation.random.usize(0..2000),
            150..250 => simulation.random.usize(0..30_000),
            _ => simulation.random.usize(0..300_000),
        };
        simulation.send(from, number, len).unwrap();
        attempts[from].insert(number);
        for _ in 0..simulation.random.u8(0..8) {
            simulation.step();
        }
        if simulation.random.u8(..) < 8
            && let Some(open) = attempts[from].last().copied()
            && !simulation.concluded[from].contains_key(&AttemptId(open))
        {
            let abandoned = simulation.cores[from].abandon(AttemptId(open), &to(1 - from));
            attempts[from].remove(&open);
            assert!(
                abandoned != Abandoned::NotSent || !simulation.arrived[1 - from].contains(&open)
            );
        }
    }
    for from in [A, B] {
        simulation.until_concluded(from, &attempts[from]);
        let handed = simulation.check(from, &attempts[from]);
        assert_eq!(handed, attempts[from].len());
    }
    simulation
}

#[test]
fn every_letter_is_handed_over_once_and_in_order() {
    every_seed(|seed| {
        let simulation = run(seed, FAIR);
        for core in &simulation.cores {
            let counters = core.counters();
            assert_eq!((counters.dialed, counters.accepted), (1, 1));
        }
    });
}

#[test]
fn guarantees_hold_under_loss_reordering_and_duplication() {
    every_seed(|seed| {
        let conditions = LinkConditions {
            loss: [0.01, 0.05, 0.3][seed as usize % 3],
            twice: 0.1,
            delay: (100, [300, 5_000, 30_000][seed as usize / 3 % 3]),
            translation: [0, 1_000, 50_000][seed as usize % 3],
            ..FAIR
        };
        run(seed, conditions);
    });
}

#[test]
fn guarantees_hold_over_narrow_links() {
    every_seed(|seed| {
        let mut random = fastrand::Rng::with_seed(seed);
        let conditions = LinkConditions {
            loss: 0.01,
            twice: 0.01,
            delay: (50, random.u64(60..20_000)),
            capacity: random.u64(2_000..100_000),
            queue: random.u64(2_000..50_000),
            ..FAIR
        };
        run(seed, conditions);
    });
}

#[test]
fn most_of_a_narrow_link_is_used_and_few_packets_are_sent_in_vain() {
    for (capacity, delay) in [(2_000, 500), (5_000, 2_000), (20_000, 2_000)] {
        let conditions = LinkConditions {
            delay: (delay, delay + 10),
            capacity,
            queue: 20_000,
            ..FAIR
        };
        let mut simulation = Simulation::new(1, conditions, &UdtLimits::default());
        let attempts: BTreeSet<u64> = (0..5).collect();
        for number in &attempts {
            simulation.send(A, *number, 3_000_000).unwrap();
        }
        let begun = simulation.now;
        simulation.until_concluded(A, &attempts);
        assert_eq!(simulation.check(A, &attempts), attempts.len());
        let time = (simulation.now - begun).as_secs_f64();
        let packets = 5.0 * (3_000_000_f64 / 1456.0).ceil();
        let used = packets / time / capacity as f64;
        let in_vain = simulation.data[A] as f64 / packets - 1.0;
        assert!(used > 0.4, "{used} of {capacity} packets per second");
        assert!(in_vain < 0.3, "{in_vain} at {capacity} packets per second");
    }
}

#[test]
fn the_largest_letter_arrives_over_a_lossy_link() {
    let conditions = LinkConditions {
        loss: 0.05,
        delay: (100, 2_000),
        capacity: 100_000,
        queue: 20_000,
        ..FAIR
    };
    let mut simulation = Simulation::new(1, conditions, &UdtLimits::default());
    simulation.send(A, 1, 10_000_000).unwrap();
    let attempts = BTreeSet::from([1]);
    simulation.until_concluded(A, &attempts);
    assert_eq!(simulation.check(A, &attempts), 1);
}

#[test]
fn letters_that_arrive_together_with_the_end_of_their_connection_are_delivered() {
    let conditions = LinkConditions {
        delay: (100, 100),
        ..FAIR
    };
    let mut simulation = Simulation::new(1, conditions, &UdtLimits::default());
    simulation.send(A, 0, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([0]));
    for number in 1..8 {
        simulation.send(A, number, 10).unwrap();
    }
    let now = simulation.now;
    simulation.cores[A].close(now);
    while let Some(transmit) = simulation.cores[A].poll_transmit(now) {
        simulation.transmit(A, &transmit);
    }
    // The last letters and the shutdown are read before an event is delivered.
    simulation.now += Duration::from_millis(1);
    simulation.step();
    assert_eq!(simulation.arrived[B], (0..8).collect::<Vec<_>>());
    assert_eq!(simulation.cores[B].counters().connections, 0);
    assert_eq!(simulation.cores[B].counters().letters_in, 8);
}

#[test]
fn the_beginning_of_a_letter_that_is_too_large_is_reported() {
    let mut simulation = Simulation::new(1, FAIR, &UdtLimits::default());
    simulation.cores[B] = core(
        B,
        1,
        &UdtLimits {
            max_letter: 100_000,
            ..UdtLimits::default()
        },
        simulation.now,
    );
    for (number, len) in [(1, 100_001), (2, 100_000)] {
        simulation.send(A, number, len).unwrap();
    }
    simulation.until_concluded(A, &BTreeSet::from([1, 2]));
    assert_eq!(simulation.arrived[B], [2]);
    let [beginning] = &simulation.too_large[B][..] else {
        panic!("{:?}", simulation.too_large[B]);
    };
    let sent = letter(1, 100_001).concat();
    assert_eq!(*beginning, sent[..beginning.len()]);
    assert!(beginning.len() >= 1024);
}

#[test]
fn a_vanished_peer_is_detected_and_no_letter_counts_as_handed_over() {
    every_seed(|seed| {
        let mut simulation = Simulation::new(seed, FAIR, &UdtLimits::default());
        let mut attempts = BTreeSet::new();
        for number in 0..40 {
            if number == 20 {
                simulation.cut = true;
                simulation.wire.clear();
            }
            simulation.send(A, number, 100).unwrap();
            attempts.insert(number);
            simulation.step();
        }
        let cut = simulation.now;
        simulation.until_concluded(A, &attempts);
        assert!(simulation.check(A, &attempts) < attempts.len());
        assert!(simulation.now < cut + Duration::from_secs(5), "too late");
        // Later letters open a new connection, which fails while the peer is absent.
        simulation.send(A, 100, 1).unwrap();
        attempts.insert(100);
        simulation.until_concluded(A, &attempts);
        assert!(matches!(
            &simulation.concluded[A][&AttemptId(100)][0],
            Conclusion::NotSent(error) if error.fault == TransportErrorKind::Unreachable
        ));
        simulation.cut = false;
        simulation.send(A, 101, 1).unwrap();
        attempts.insert(101);
        simulation.until_concluded(A, &attempts);
        assert_eq!(
            simulation.concluded[A][&AttemptId(101)],
            [Conclusion::Handed]
        );
    });
}

#[test]
fn an_idle_connection_is_kept_alive_and_closed_by_the_side_that_opened_it() {
    let limits = UdtLimits::default();
    let mut simulation = Simulation::new(1, FAIR, &limits);
    simulation.send(A, 1, 10).unwrap();
    simulation.pass(limits.idle_close - Duration::from_secs(1));
    for core in &simulation.cores {
        assert_eq!(core.counters().connections, 1);
    }
    simulation.pass(Duration::from_secs(2));
    for core in &simulation.cores {
        assert_eq!(core.counters().connections, 0);
        assert_eq!(core.poll_timeout(), None);
    }
    assert_eq!(simulation.check(A, &BTreeSet::from([1])), 1);
}

#[test]
fn a_peer_that_vanished_is_forgotten() {
    let limits = UdtLimits::default();
    let mut simulation = Simulation::new(1, FAIR, &limits);
    simulation.send(A, 1, 10).unwrap();
    simulation.pass(Duration::from_secs(1));
    simulation.cut = true;
    simulation.pass(limits.silence + Duration::from_secs(1));
    assert_eq!(simulation.cores[A].counters().connections, 0);
    assert_eq!(simulation.cores[B].counters().connections, 1);
    simulation.pass(limits.idle_close);
    assert_eq!(simulation.cores[B].counters().connections, 0);
}

#[test]
fn a_restarted_side_is_reached_over_a_new_connection() {
    let limits = UdtLimits::default();
    let mut simulation = Simulation::new(1, FAIR, &limits);
    simulation.send(A, 1, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1]));
    simulation.cores[B] = core(B, 2, &limits, simulation.now);
    simulation.send(A, 2, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1, 2]));
    assert!(matches!(
        &simulation.concluded[A][&AttemptId(2)][0],
        Conclusion::Unconfirmed(error) if error.fault == TransportErrorKind::TimedOut
    ));
    simulation.send(A, 3, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1, 2, 3]));
    // The sender restarts.
    simulation.cores[A] = core(A, 3, &limits, simulation.now);
    simulation.send(A, 4, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1, 2, 3, 4]));
    assert_eq!(simulation.check(A, &BTreeSet::from([1, 3, 4])), 3);
    assert_eq!(simulation.arrived[B], [1, 3, 4]);
}

#[test]
fn a_receiver_that_closes_ends_the_connection_at_once() {
    let mut simulation = Simulation::new(1, FAIR, &UdtLimits::default());
    simulation.send(A, 1, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1]));
    simulation.send(A, 2, 5_000_000).unwrap();
    let now = simulation.now;
    simulation.cores[B].close(now);
    simulation.until_concluded(A, &BTreeSet::from([1, 2]));
    assert!(simulation.now < now + Duration::from_millis(50));
    assert!(matches!(
        &simulation.concluded[A][&AttemptId(2)][0],
        Conclusion::Unconfirmed(error) if error.fault == TransportErrorKind::Broken
    ));
}

#[test]
fn a_peer_beyond_its_rate_limit_is_delayed_without_loss() {
    let limits = UdtLimits {
        peer_letters: 20,
        ..UdtLimits::default()
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

fn handshake(socket: u32, request: i32, cookie: u32) -> Vec<u8> {
    packet::control(
        &Control::Handshake(handshake_of(socket, request, cookie)),
        0,
        0,
    )
}

fn handshake_of(socket: u32, request: i32, cookie: u32) -> Handshake {
    Handshake {
        version: VERSION,
        kind: DATAGRAMS,
        initial: 5,
        max_packet: 1500,
        window: 8192,
        request,
        socket,
        cookie,
        address: [0; 4],
    }
}

/// Returns the answer of B to a handshake.
fn answer(simulation: &mut Simulation, from: SocketAddr, bytes: &[u8]) -> (u32, Handshake) {
    simulation.receive(B, from, bytes);
    let reply = loop {
        let reply = simulation.cores[B].poll_transmit(simulation.now).unwrap();
        if reply.path.remote == from {
            break reply;
        }
    };
    match Packet::read(&reply.contents) {
        Some((to, Packet::Control(Control::Handshake(handshake)))) => (to, handshake),
        other => panic!("{other:?}"),
    }
}

#[test]
fn unproved_peers_leave_no_state_and_get_no_more_bytes_than_they_sent() {
    let mut simulation = Simulation::new(1, FAIR, &UdtLimits::default());
    let spoofed = |n: u32| SocketAddr::from((n.to_be_bytes(), 99));
    let mut replies = 0;
    for n in 1..2000_u32 {
        let (request, cookie) = match n % 3 {
            0 => (REQUEST, 0),
            1 => (CONCLUSION, n),
            _ => (77, 0),
        };
        let hello = handshake(n, request, cookie);
        assert_eq!(hello.len(), HANDSHAKE_LEN);
        simulation.receive(B, spoofed(n), &hello);
        let data = Data {
            sequence: n,
            position: Position::Only,
            in_order: true,
            message: 1,
            payload: b"x",
        };
        let mut bytes = Vec::new();
        packet::put_data(&mut bytes, &data, 0, n);
        simulation.receive(B, spoofed(n), &bytes);
        for control in [Control::KeepAlive, Control::Shutdown, Control::Ack2(n)] {
            simulation.receive(B, spoofed(n), &packet::control(&control, 0, n));
        }
        while let Some(reply) = simulation.cores[B].poll_transmit(simulation.now) {
            assert_eq!(reply.path.remote, spoofed(n));
            assert!(reply.contents.len() <= hello.len());
            replies += 1;
        }
    }
    assert_eq!(replies, 1999);
    let counters = simulation.cores[B].counters();
    assert_eq!((counters.accepted, counters.connections), (0, 0));
    assert_eq!(simulation.cores[B].poll_timeout(), None);
}

#[test]
fn a_peer_opens_a_connection_as_libudt_does() {
    let mut simulation = Simulation::new(1, FAIR, &UdtLimits::default());
    let from: SocketAddr = "192.0.2.7:4000".parse().unwrap();
    let (to, first) = answer(&mut simulation, from, &handshake(9, REQUEST, 0));
    assert_eq!((to, first.request, first.socket), (9, REQUEST, 9));
    // A cookie of another peer or socket is not valid.
    let other: SocketAddr = "192.0.2.8:4000".parse().unwrap();
    for (from, socket) in [(other, 9), (from, 10)] {
        let again = handshake(socket, CONCLUSION, first.cookie);
        assert_eq!(answer(&mut simulation, from, &again).1.request, REQUEST);
    }
    let conclusion = handshake(9, CONCLUSION, first.cookie);
    let (to, opened) = answer(&mut simulation, from, &conclusion);
    assert_eq!((to, opened.request, opened.initial), (9, CONCLUSION, 5));
    assert_eq!((opened.max_packet, opened.window), (1500, 8192));
    assert_ne!(opened.socket, 9);
    // If the answer is lost, it is repeated.
    assert_eq!(answer(&mut simulation, from, &conclusion).1, opened);
    assert_eq!(simulation.cores[B].counters().accepted, 1);
    // A client of streams is refused.
    let streams = Handshake {
        kind: 1,
        ..handshake_of(11, REQUEST, 0)
    };
    let streams = packet::control(&Control::Handshake(streams), 0, 0);
    assert_eq!(answer(&mut simulation, from, &streams).1.request, REFUSAL);
    // Later the cookie has expired.
    simulation.now += Duration::from_secs(45);
    let late = handshake(12, CONCLUSION, first.cookie);
    assert_eq!(answer(&mut simulation, from, &late).1.request, REQUEST);
}

#[test]
fn connections_of_one_address_are_bounded_and_idle_ones_make_room() {
    let limits = UdtLimits {
        max_connections: 16,
        max_per_address: 3,
        ..UdtLimits::default()
    };
    let mut simulation = Simulation::new(1, FAIR, &limits);
    let open = |simulation: &mut Simulation, from: &str, socket: u32| {
        let from: SocketAddr = from.parse().unwrap();
        let (_, first) = answer(simulation, from, &handshake(socket, REQUEST, 0));
        let conclusion = handshake(socket, CONCLUSION, first.cookie);
        answer(simulation, from, &conclusion).1
    };
    let mut sockets = Vec::new();
    for n in 1..=5 {
        let opened = open(&mut simulation, &format!("198.51.100.7:{n}"), n);
        sockets.push((n, opened.socket));
        let request = if n <= 3 { CONCLUSION } else { REFUSAL };
        assert_eq!(opened.request, request);
    }
    for n in 1..=10 {
        let opened = open(&mut simulation, &format!("127.0.0.{n}:1"), n);
        let request = if n <= 8 { CONCLUSION } else { REFUSAL };
        assert_eq!(
            opened.request, request,
            "half of all for loopback addresses"
        );
    }
    let counters = simulation.cores[B].counters();
    assert_eq!((counters.accepted, counters.refused_crowd), (11, 4));
    // Peers that are alive, but send no letters.
    let end = simulation.now + limits.idle_close;
    while simulation.now < end {
        simulation.pass(Duration::from_secs(10));
        for (n, socket) in &sockets {
            let from: SocketAddr = format!("198.51.100.7:{n}").parse().unwrap();
            let alive = packet::control(&Control::KeepAlive, 0, *socket);
            simulation.receive(B, from, &alive);
        }
        simulation.flush();
    }
    let opened = open(&mut simulation, "198.51.100.7:9", 9);
    assert_eq!(opened.request, CONCLUSION);
}

#[test]
fn peers_without_access_are_neither_answered_nor_dialed() {
    let now = Instant::now();
    let mut simulation = Simulation::new(1, FAIR, &UdtLimits::default());
    let access = Box::new(|ip| ip == address(A).ip());
    let draw = Box::new(|| 7);
    simulation.cores[B] = Core::new(UdtLimits::default(), access, draw, now);
    let stranger: SocketAddr = "192.0.2.99:7790".parse().unwrap();
    simulation.receive(B, stranger, &handshake(9, REQUEST, 0));
    assert!(simulation.cores[B].poll_transmit(now).is_none());
    assert_eq!(simulation.cores[B].counters().refused_unproved, 1);
    simulation.receive(B, address(A), &handshake(9, REQUEST, 0));
    assert!(simulation.cores[B].poll_transmit(now).is_some());
    let location = Location::new(Kind::Udt, &stranger.to_string()).unwrap();
    let core = &mut simulation.cores[B];
    let [envelope, message] = letter(1, 9);
    let letter = Letter::new(envelope, message);
    let starts = core.post(AttemptId(1), &location, "arm".into(), letter);
    assert!(starts.unwrap());
    let translation = core.begin_translation().unwrap();
    let fresh = core.handle_translated(now, Ok(pieces(&translation)));
    core.begin(now, fresh.unwrap(), vec![path(stranger)]);
    assert!(core.poll_transmit(now).is_none());
    assert!(matches!(
        core.poll_event(),
        Some(CoreEvent::Concluded(AttemptId(1), Conclusion::NotSent(error)))
            if error.fault == TransportErrorKind::Refused
    ));
}

#[test]
fn replayed_and_forged_packets_change_nothing() {
    let mut simulation = Simulation::new(1, FAIR, &UdtLimits::default());
    let mut recorded: Vec<(SocketAddr, Vec<u8>)> = Vec::new();
    for number in 0..20 {
        simulation.send(A, number, 3000).unwrap();
        while !simulation.concluded[A].contains_key(&AttemptId(number)) {
            let packets = simulation.wire.values().filter(|(to, ..)| *to == B);
            recorded.extend(packets.map(|(_, from, bytes)| (*from, bytes.clone())));
            simulation.step();
        }
    }
    let stranger: SocketAddr = "203.0.113.9:7790".parse().unwrap();
    for (from, bytes) in recorded {
        simulation.receive(B, from, &bytes);
        simulation.receive(B, stranger, &bytes);
        let mut forged = bytes.clone();
        forged[15] ^= 1;
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
}

#[test]
fn connections_of_a_removed_address_end() {
    let mut simulation = Simulation::new(1, FAIR, &UdtLimits::default());
    simulation.send(A, 1, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([1]));
    let lost = HashSet::from([address(A).ip()]);
    let now = simulation.now;
    simulation.cores[A].lost(now, &lost, |_| Some(address(B).ip()));
    assert_eq!(simulation.cores[A].counters().connections, 1);
    simulation.cores[A].lost(now, &lost, |_| Some(address(A).ip()));
    assert_eq!(simulation.cores[A].counters().connections, 0);
}

/// Conditions under which a translation takes a while.
const SLOW: LinkConditions = LinkConditions {
    translation: 1_000_000,
    ..FAIR
};

#[test]
fn letters_are_not_sent_before_their_translation() {
    let mut simulation = Simulation::new(1, SLOW, &UdtLimits::default());
    for number in 1..=3 {
        simulation.send(A, number, 10).unwrap();
    }
    assert_eq!(simulation.cores[A].counters().connections, 0);
    assert_eq!(simulation.cores[A].poll_timeout(), None);
    let attempts = BTreeSet::from([1, 2, 3]);
    simulation.until_concluded(A, &attempts);
    assert_eq!(simulation.check(A, &attempts), 3);
}

#[test]
fn letters_that_are_abandoned_before_their_translation_ends_are_never_sent() {
    let mut simulation = Simulation::new(1, SLOW, &UdtLimits::default());
    for number in 1..=4 {
        simulation.send(A, number, 10).unwrap();
    }
    assert!(simulation.translations[A].is_some(), "the first letter");
    for abandoned in [1, 3] {
        let core = &mut simulation.cores[A];
        let end = core.abandon(AttemptId(abandoned), &to(B));
        assert_eq!(end, Abandoned::NotSent);
        let again = core.abandon(AttemptId(abandoned), &to(B));
        assert_eq!(again, Abandoned::Unconfirmed, "it is unknown");
    }
    let attempts = BTreeSet::from([2, 4]);
    simulation.until_concluded(A, &attempts);
    simulation.pass(Duration::from_secs(5));
    assert_eq!(simulation.check(A, &attempts), 2);
    assert_eq!(simulation.arrived[B], [2, 4]);
    assert_eq!(simulation.concluded[A].len(), 2);
}

#[test]
fn a_letter_that_cannot_be_translated_opens_no_connection() {
    let mut simulation = Simulation::new(1, SLOW, &UdtLimits::default());
    for number in 1..=2 {
        simulation.send(A, number, 10).unwrap();
        let error = TransportError::new(TransportErrorKind::Inexpressible, "for a test");
        let core = &mut simulation.cores[A];
        let fresh = core.handle_translated(simulation.now, Err(error.clone()));
        assert_eq!(fresh, None);
        simulation.translations[A] = None;
        if number == 1 {
            let event = core.poll_event();
            assert!(
                matches!(&event, Some(CoreEvent::Concluded(AttemptId(1), Conclusion::NotSent(it))) if *it == error),
                "{event:?}"
            );
        } else {
            // Abandoned before the conclusion has been reported.
            assert_eq!(core.abandon(AttemptId(2), &to(B)), Abandoned::NotSent);
        }
        assert!(core.poll_event().is_none());
        assert!(core.begin_translation().is_none());
    }
    assert_eq!(simulation.cores[A].counters().connections, 0);
    simulation.send(A, 3, 10).unwrap();
    simulation.until_concluded(A, &BTreeSet::from([3]));
    assert_eq!(simulation.check(A, &BTreeSet::from([3])), 1);
}

#[test]
fn closing_concludes_letters_before_their_translation_as_not_sent() {
    let mut simulation = Simulation::new(1, SLOW, &UdtLimits::default());
    let attempts: BTreeSet<u64> = (1..=3).collect();
    for number in &attempts {
        simulation.send(A, *number, 10).unwrap();
    }
    let now = simulation.now;
    simulation.cores[A].close(now);
    simulation.flush();
    for attempt in &attempts {
        assert!(matches!(
            &simulation.concluded[A][&AttemptId(*attempt)][..],
            [Conclusion::NotSent(error)] if error.fault == TransportErrorKind::Closed
        ));
    }
    // The first translation ends afterwards.
    simulation.pass(Duration::from_secs(5));
    assert_eq!(simulation.check(A, &attempts), 0);
    assert_eq!(simulation.cores[A].counters().connections, 0);
}

#[test]
fn letters_before_their_translation_count_for_the_limits() {
    let limits = UdtLimits {
        max_in_flight: 3,
        max_queued_bytes: 1000,
        max_connections: 2,
        ..UdtLimits::default()
    };
    let mut simulation = Simulation::new(1, SLOW, &limits);
    simulation.send(A, 1, 10).unwrap();
    let congested = Err(TransportErrorKind::Congested);
    assert_eq!(simulation.send(A, 9, 995), congested, "too many bytes");
    simulation.until_concluded(A, &BTreeSet::from([1]));
    // One letter that is under way, and two that wait.
    simulation.cut = true;
    simulation.send(A, 2, 10).unwrap();
    while simulation.translations[A].is_some() {
        simulation.step();
    }
    for number in 3..=4 {
        simulation.send(A, number, 10).unwrap();
    }
    assert_eq!(simulation.send(A, 9, 10), congested, "too many letters");
    // Each location needs a connection.
    let location = |n: u8| Location::new(Kind::Udt, &format!("192.0.2.{n}:7790")).unwrap();
    let mut post = |attempt: u64, n: u8| {
        let letter = Letter::new(Bytes::from_static(b"x"), Bytes::new());
        let core = &mut simulation.cores[A];
        let queued = core.post(AttemptId(attempt), &location(n), "arm".into(), letter);
        queued.map_err(|error| error.fault)
    };
    assert_eq!(post(10, 77), Ok(false));
    assert_eq!(post(11, 78), congested.map(|()| false));
    assert_eq!(post(12, 77), Ok(false));
}

#[test]
fn a_letter_that_outgrows_its_room_by_the_translation_is_concluded_as_not_sent() {
    let limits = UdtLimits {
        max_queued_bytes: 1000,
        ..UdtLimits::default()
    };
    let mut simulation = Simulation::new(1, SLOW, &limits);
    simulation.cut = true;
    for (number, len) in [(1, 10), (2, 991)] {
        simulation.send(A, number, 10).unwrap();
        let translated = [Bytes::from(vec![0; len]), Bytes::new()];
        let core = &mut simulation.cores[A];
        core.handle_translated(simulation.now, Ok(translated));
        simulation.translations[A] = None;
        assert!(core.begin_translation().is_none());
    }
    simulation.flush();
    let concluded = &simulation.concluded[A];
    assert_eq!(concluded.len(), 1, "the first letter waits: {concluded:?}");
    assert!(matches!(
        &concluded[&AttemptId(2)][..],
        [Conclusion::NotSent(error)] if error.fault == TransportErrorKind::Congested
    ));
}
