use std::time::Duration;

use bytes::{BufMut, Bytes, BytesMut};
use fipa_acl::Letter;
use fipa_transport::Stream;
use proptest::prelude::*;

use super::super::frame::{FrameReader, HEADER_LEN, Space};
use super::*;
use crate::hello::tests::sample;

fn parcel(sequence: u64, len: usize) -> Parcel {
    Parcel {
        receiver: "arm".into(),
        stream: Stream::between(Incarnation::from_u64(1), Incarnation::from_u64(2)),
        sequence,
        after: 0,
        remaining: Duration::from_secs(1),
        transfer: 0,
        body: Body::Letter(Letter::new(
            Bytes::from_static(b"e"),
            Bytes::from(vec![7; len]),
        )),
    }
}

fn limits() -> NetLimits {
    NetLimits {
        max_letter: 5000,
        max_in_flight: 8,
        ..NetLimits::default()
    }
}

/// One side of a simulated connection, with its results and the bytes in the network.
struct Side {
    connection: Connection,
    reader: FrameReader,
    /// Bytes on their way to this side.
    coming: BytesMut,
    /// Arrived parcels by their sequence, and unanswered ones by number.
    arrived: Vec<u64>,
    open: Vec<u64>,
    concluded: BTreeMap<AttemptId, Vec<Conclusion>>,
    dispatched: Vec<u64>,
    abandoned: Vec<u64>,
    end: Option<ConnectionEnd>,
}

impl Side {
    fn new(role: Role, incarnation: u64, now: Instant) -> Self {
        let mut hello = sample(incarnation);
        hello.max_letter = limits().max_letter as u64;
        let mut connection = Connection::new(limits(), role, hello, now);
        if role != Role::Acceptor {
            connection.connected(now);
        }
        Self {
            connection,
            reader: FrameReader::new(limits().max_letter, BytesMut::new()),
            coming: BytesMut::new(),
            arrived: Vec::new(),
            open: Vec::new(),
            concluded: BTreeMap::new(),
            dispatched: Vec::new(),
            abandoned: Vec::new(),
            end: None,
        }
    }

    fn post(&mut self, len: usize) -> Result<(), SendError> {
        let sequence = self.dispatched.len() as u64;
        self.connection
            .send(AttemptId(sequence), &parcel(sequence, len))?;
        self.dispatched.push(sequence);
        Ok(())
    }

    /// Puts up to `max` bytes into the network.
    fn transmit(&mut self, max: usize, to: &mut BytesMut, now: Instant) {
        let mut slices = [IoSlice::new(&[]); 5];
        let count = self.connection.gather(&mut slices);
        let shown: Vec<u8> = slices[..count].iter().flat_map(|s| s.to_vec()).collect();
        let taken = shown.len().min(max);
        to.put_slice(&shown[..taken]);
        self.connection.written(taken, now);
    }

    /// Takes up to `max` bytes out of the network.
    fn receive(&mut self, max: usize, now: Instant) {
        let step = {
            let Space::Buffer(mut space) = self.reader.space() else {
                panic!("no memory was offered");
            };
            let step = max.min(self.coming.len()).min(space.remaining_mut());
            space.put_slice(&self.coming.split_to(step));
            step
        };
        while let Some(frame) = self.reader.next(|_| None).unwrap() {
            if let Err(end) = self.connection.handle_frame(frame, now) {
                self.finish(end);
            }
            self.take_events();
        }
        let partial = self.reader.is_partial();
        self.connection.received(Reader::Main, step, partial, now);
    }

    fn take_events(&mut self) {
        while let Some(event) = self.connection.poll_event() {
            match event {
                Event::Greeted => self.connection.welcome(),
                Event::Arrived { id, parcel } => {
                    self.arrived.push(parcel.sequence);
                    self.open.push(id);
                }
                Event::Concluded(attempt, conclusion) => {
                    self.concluded.entry(attempt).or_default().push(conclusion);
                }
            }
        }
    }

    fn finish(&mut self, end: ConnectionEnd) {
        for (attempt, conclusion) in self.connection.end(&end) {
            self.concluded.entry(attempt).or_default().push(conclusion);
        }
        self.end.get_or_insert(end);
    }

    fn answer(&mut self, pick: usize, now: Instant) {
        if !self.open.is_empty() {
            let id = self.open.swap_remove(pick % self.open.len());
            self.connection.answer(id, &Answer::Accepted, now);
        }
    }

    /// Checks the conclusions after this side has ended and the other has received everything.
    fn check(&self, other: &Self) -> Result<(), TestCaseError> {
        for sequence in &self.dispatched {
            let conclusions = self.concluded.get(&AttemptId(*sequence));
            if self.abandoned.contains(sequence) {
                continue;
            }
            let Some([conclusion]) = conclusions.map(Vec::as_slice) else {
                return Err(TestCaseError::fail(format!("{sequence}: {conclusions:?}")));
            };
            let arrived = other.arrived.contains(sequence);
            match conclusion {
                Conclusion::NotSent(_) => prop_assert!(!arrived, "{sequence} was sent"),
                Conclusion::Answered(_) => prop_assert!(arrived, "{sequence} had not arrived"),
                _ => {}
            }
        }
        prop_assert!(other.arrived.is_sorted(), "order: {:?}", other.arrived);
        let mut once = other.arrived.clone();
        once.dedup();
        prop_assert_eq!(&once, &other.arrived);
        Ok(())
    }
}

#[derive(Debug, Clone)]
enum Step {
    Dispatch(usize),
    Abandon(usize),
    Answer(usize),
    Transmit(usize),
    Receive(usize),
}

fn step() -> impl Strategy<Value = (bool, Step)> {
    let step = prop_oneof![
        4 => (0_usize..5000).prop_map(Step::Dispatch),
        1 => any::<usize>().prop_map(Step::Abandon),
        3 => any::<usize>().prop_map(Step::Answer),
        6 => (1_usize..6000).prop_map(Step::Transmit),
        6 => (1_usize..6000).prop_map(Step::Receive),
    ];
    (any::<bool>(), step)
}

fn perform(step: &Step, this: &mut Side, other: &mut Side, now: Instant) {
    match step {
        Step::Dispatch(len) => match this.post(*len) {
            Err(SendError::Transport(error)) => {
                assert_eq!(error.fault, TransportErrorKind::Congested)
            }
            Err(SendError::Ended) => assert!(this.end.is_some()),
            Ok(()) => {}
        },
        Step::Abandon(pick) if !this.dispatched.is_empty() => {
            let sequence = this.dispatched[pick % this.dispatched.len()];
            if !this.concluded.contains_key(&AttemptId(sequence)) {
                this.connection.abandon(AttemptId(sequence), now);
                this.abandoned.push(sequence);
            }
        }
        Step::Abandon(_) => {}
        Step::Answer(pick) => this.answer(*pick, now),
        Step::Transmit(max) => this.transmit(*max, &mut other.coming, now),
        Step::Receive(max) => this.receive(*max, now),
    }
}

fn pair(now: Instant) -> (Side, Side) {
    let expected = Incarnation::from_u64(2);
    (
        Side::new(Role::Dialler { expected }, 1, now),
        Side::new(Role::Acceptor, 2, now),
    )
}

/// Lets both sides make progress. Returns whether both are done.
fn settle(a: &mut Side, b: &mut Side, now: Instant) {
    for _ in 0..2000 {
        for pick in 0..2 {
            a.answer(pick, now);
            b.answer(pick, now);
        }
        a.transmit(usize::MAX, &mut b.coming, now);
        b.transmit(usize::MAX, &mut a.coming, now);
        a.receive(usize::MAX, now);
        b.receive(usize::MAX, now);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    /// A connection that does not end answers every parcel, for any order of events.
    #[test]
    fn every_parcel_is_answered_once_and_in_order(
        steps in prop::collection::vec(step(), 0..200),
    ) {
        let now = Instant::now();
        let (mut a, mut b) = pair(now);
        for (first, step) in &steps {
            let (this, other) = if *first { (&mut a, &mut b) } else { (&mut b, &mut a) };
            perform(step, this, other, now);
        }
        settle(&mut a, &mut b, now);
        prop_assert_eq!((&a.end, &b.end), (&None, &None));
        a.check(&b)?;
        b.check(&a)?;
        for side in [&a, &b] {
            prop_assert!(side.connection.sent.is_empty());
            prop_assert!(side.connection.attempts.is_empty());
            prop_assert_eq!(side.connection.begun, 0);
            prop_assert_eq!(side.connection.outbox.parcel_bytes(), 0);
            prop_assert!(side.connection.is_idle());
        }
    }

    /// No parcel that was concluded as not sent arrives, for any end of the connection.
    #[test]
    fn conclusions_are_true_when_a_connection_ends(
        steps in prop::collection::vec(step(), 0..120),
        end in prop_oneof![
            Just(ConnectionEnd::Hangup),
            Just(ConnectionEnd::Closed),
            Just(ConnectionEnd::Idle),
            Just(ConnectionEnd::Silent),
        ],
        lost in any::<bool>(),
        first in any::<bool>(),
    ) {
        let now = Instant::now();
        let (mut a, mut b) = pair(now);
        for (first, step) in &steps {
            let (this, other) = if *first { (&mut a, &mut b) } else { (&mut b, &mut a) };
            perform(step, this, other, now);
        }
        let (ending, other) = if first { (&mut a, &mut b) } else { (&mut b, &mut a) };
        let orderly = end.is_orderly();
        ending.finish(end);
        if orderly && !lost {
            settle(ending, other, now);
        } else {
            // The peer's kernel may hold what the ended side wrote.
            while !lost && !other.coming.is_empty() {
                other.receive(1000, now);
            }
        }
        other.finish(ConnectionEnd::Hangup);
        ending.check(other)?;
        other.check(ending)?;
    }
}

/// Two sides that have exchanged their hello.
fn greeted(now: Instant) -> (Side, Side) {
    let (mut a, mut b) = pair(now);
    settle(&mut a, &mut b, now);
    assert!(a.connection.peer().is_some() && b.connection.peer().is_some());
    (a, b)
}

#[test]
fn another_incarnation_ends_the_connection_before_a_parcel_is_sent() {
    let now = Instant::now();
    let expected = Incarnation::from_u64(3);
    let mut a = Side::new(Role::Dialler { expected }, 1, now);
    let mut b = Side::new(Role::Acceptor, 2, now);
    a.post(10).unwrap();
    settle(&mut a, &mut b, now);
    let found = Incarnation::from_u64(2);
    assert_eq!(
        a.end,
        Some(ConnectionEnd::WrongIncarnation { expected, found })
    );
    match &a.concluded[&AttemptId(0)][..] {
        [Conclusion::NotSent(error)] => {
            assert_eq!(error.fault, TransportErrorKind::WrongIncarnation)
        }
        other => panic!("{other:?}"),
    }
    assert!(b.arrived.is_empty(), "{:?}", b.arrived);
}

#[test]
fn a_connection_that_leads_back_names_the_cause_on_both_ends() {
    let now = Instant::now();
    for expected in [Incarnation::UNKNOWN, Incarnation::from_u64(3)] {
        let mut a = Side::new(Role::Dialler { expected }, 1, now);
        let mut b = Side::new(Role::Acceptor, 1, now);
        a.post(10).unwrap();
        settle(&mut a, &mut b, now);
        assert_eq!(a.end, Some(ConnectionEnd::Itself));
        assert_eq!(b.end, Some(ConnectionEnd::Itself));
        match &a.concluded[&AttemptId(0)][..] {
            // Another incarnation at an address would mean that the peer has ended.
            [Conclusion::NotSent(error)] => {
                assert_eq!(error.fault, TransportErrorKind::Unreachable)
            }
            other => panic!("{other:?}"),
        }
        assert!(b.arrived.is_empty(), "{:?}", b.arrived);
    }
}

#[test]
fn a_letter_that_the_peer_does_not_accept_is_not_sent() {
    let now = Instant::now();
    let (mut a, mut b) = pair(now);
    b.connection.hello.max_letter = 100;
    a.post(101).unwrap();
    a.post(10).unwrap();
    settle(&mut a, &mut b, now);
    match &a.concluded[&AttemptId(0)][..] {
        [Conclusion::NotSent(error)] => assert_eq!(error.fault, TransportErrorKind::TooLarge),
        other => panic!("{other:?}"),
    }
    assert_eq!(b.arrived, [1]);
    assert!(matches!(a.post(101), Err(SendError::Transport(error))
        if error.fault == TransportErrorKind::TooLarge));
}

#[test]
fn the_window_of_the_peer_is_respected_and_congestion_reported() {
    let now = Instant::now();
    let (mut a, mut b) = pair(now);
    b.connection.hello.max_in_flight = 2;
    settle(&mut a, &mut b, now);
    // A quarter is for parcels other than letters.
    for _ in 0..limits().max_in_flight * 3 / 4 {
        a.post(10).unwrap();
    }
    assert!(matches!(a.post(10), Err(SendError::Transport(error))
        if error.fault == TransportErrorKind::Congested));
    a.transmit(usize::MAX, &mut b.coming, now);
    a.transmit(usize::MAX, &mut b.coming, now);
    assert!(a.connection.is_flushed());
    b.receive(usize::MAX, now);
    assert_eq!(b.arrived, [0, 1]);
}

#[test]
fn queued_bytes_are_bounded_and_one_letter_always_fits() {
    let now = Instant::now();
    let (mut a, _) = pair(now);
    a.connection.limits.max_queued_bytes = 100;
    a.post(4000).unwrap();
    assert!(matches!(a.post(1), Err(SendError::Transport(error))
        if error.fault == TransportErrorKind::Congested));
    a.connection.abandon(AttemptId(0), now);
    a.post(1).unwrap();
}

#[test]
fn a_protocol_violation_ends_the_connection() {
    let now = Instant::now();
    let nonsense = |frames: Vec<Frame>| {
        let (mut a, _) = greeted(now);
        let last = frames
            .into_iter()
            .map(|frame| a.connection.handle_frame(frame, now))
            .last();
        assert!(
            matches!(last, Some(Err(ConnectionEnd::ProtocolViolation(_)))),
            "{last:?}"
        );
    };
    let arrive = |id, len| Frame::Parcel {
        id,
        parcel: Box::new(parcel(1, len)),
    };
    let answer = Frame::Answer {
        id: 1,
        answer: Answer::Accepted,
    };
    nonsense(vec![Frame::Hello(sample(2))]);
    nonsense(vec![arrive(2, 1), arrive(2, 1)]);
    nonsense(vec![arrive(MAX_ID, 1)]);
    nonsense(vec![arrive(1, 5001)]);
    nonsense((1..=9).map(|id| arrive(id, 1)).collect());
    nonsense(vec![answer]);
    let (_, mut slot) = pair(now);
    let end = slot.connection.handle_frame(Frame::Ping, now);
    assert!(matches!(end, Err(ConnectionEnd::ProtocolViolation(_))));
}

#[test]
fn a_peer_that_pings_and_does_not_read_gets_few_pongs() {
    let now = Instant::now();
    let (mut a, _) = greeted(now);
    for _ in 0..1000 {
        a.connection.handle_frame(Frame::Ping, now).unwrap();
    }
    let mut pongs = BytesMut::new();
    a.transmit(usize::MAX, &mut pongs, now);
    assert!(pongs.len() <= MAX_CONTROL * HEADER_LEN);
}

#[test]
fn a_silent_peer_gets_a_ping_and_is_then_given_up() {
    let mut now = Instant::now();
    let (mut a, mut b) = greeted(now);
    a.connection.limits.idle_close = Duration::from_secs(1000);
    let keep_alive = limits().keep_alive;
    // As long as the peer answers pings, nothing happens.
    for _ in 0..5 {
        now += keep_alive;
        assert!(a.connection.poll_timeout().unwrap() <= now);
        a.connection.handle_timeout(now, [0; 2]).unwrap();
        settle(&mut a, &mut b, now);
    }
    now += keep_alive;
    a.connection.handle_timeout(now, [0; 2]).unwrap();
    a.transmit(usize::MAX, &mut b.coming, now);
    now += keep_alive;
    assert_eq!(
        a.connection.handle_timeout(now, [0; 2]),
        Err(ConnectionEnd::Silent)
    );
}

#[test]
fn a_silent_peer_is_given_up_although_letters_are_written_to_it() {
    let mut now = Instant::now();
    let (mut a, _b) = greeted(now);
    let keep_alive = limits().keep_alive;
    let mut ended = Ok(());
    // The kernel of this host takes each of them at once.
    for _ in 0..6 {
        now += keep_alive / 2;
        a.post(100).unwrap();
        a.transmit(usize::MAX, &mut BytesMut::new(), now);
        ended = ended.and_then(|()| a.connection.handle_timeout(now, [0; 2]));
    }
    assert_eq!(ended, Err(ConnectionEnd::Silent));
}

#[test]
fn a_ping_behind_a_large_letter_has_the_usual_time() {
    let mut now = Instant::now();
    let (mut a, _b) = greeted(now);
    let keep_alive = limits().keep_alive;
    a.post(4000).unwrap();
    for _ in 0..10 {
        now += keep_alive / 2;
        a.transmit(100, &mut BytesMut::new(), now);
        a.connection.handle_timeout(now, [0; 2]).unwrap();
    }
    a.transmit(usize::MAX, &mut BytesMut::new(), now);
    assert!(a.connection.is_flushed());
    a.connection.handle_timeout(now, [0; 2]).unwrap();
    now += keep_alive;
    assert_eq!(
        a.connection.handle_timeout(now, [0; 2]),
        Err(ConnectionEnd::Silent)
    );
}

#[test]
fn a_peer_in_doubt_has_a_quarter_of_the_usual_time() {
    let start = Instant::now();
    let (mut a, mut b) = greeted(start);
    let timeout = limits().keep_alive / 4;
    assert!(
        !a.connection.doubt(start, timeout),
        "a byte has just arrived"
    );
    // A peer that responds keeps its connection.
    let mut now = start + timeout;
    assert!(a.connection.doubt(now, timeout));
    settle(&mut a, &mut b, now);
    now += timeout;
    a.connection.handle_timeout(now, [0; 2]).unwrap();
    // A peer that does not respond is given up; doubting again grants no more time.
    assert!(a.connection.doubt(now, Duration::ZERO));
    a.transmit(usize::MAX, &mut b.coming, now);
    let due = a.connection.poll_timeout().unwrap();
    assert_eq!(due, now + timeout);
    now += timeout / 2;
    assert!(a.connection.doubt(now, Duration::ZERO));
    a.connection.handle_timeout(now, [0; 2]).unwrap();
    assert_eq!(
        a.connection.handle_timeout(due, [0; 2]),
        Err(ConnectionEnd::Silent)
    );
}

#[test]
fn a_peer_in_doubt_that_still_reads_is_not_given_up() {
    let start = Instant::now();
    let (mut a, _b) = greeted(start);
    a.post(4000).unwrap();
    let timeout = limits().keep_alive / 4;
    assert!(a.connection.doubt(start, Duration::ZERO));
    let mut now = start;
    for _ in 0..10 {
        now += timeout / 2;
        a.transmit(100, &mut BytesMut::new(), now);
        a.connection.handle_timeout(now, [0; 2]).unwrap();
    }
    // The written bytes have time to arrive.
    now += timeout + Duration::from_millis(10);
    assert_eq!(
        a.connection.handle_timeout(now, [0; 2]),
        Err(ConnectionEnd::Silent)
    );
}

#[test]
fn an_attempt_without_an_answer_makes_a_silent_connection_suspect() {
    let start = Instant::now();
    let (mut a, mut b) = greeted(start);
    let timeout = limits().keep_alive / 20 + Duration::from_millis(50);
    let post = |a: &mut Side, now| {
        a.post(10).unwrap();
        a.transmit(usize::MAX, &mut BytesMut::new(), now);
        AttemptId(a.connection.last_sent - 1)
    };
    let now = start + Duration::from_millis(1);
    let first = post(&mut a, now);
    // A letter with a short deadline does not make the connection suspect.
    a.connection.abandon(first, now + timeout / 2);
    assert!(!a.connection.is_suspect());
    let second = post(&mut a, now);
    a.connection
        .received(Reader::Main, 1, false, now + timeout / 2);
    a.connection.abandon(second, now + timeout * 2);
    assert!(!a.connection.is_suspect(), "a byte arrived meanwhile");
    let now = now + timeout * 3;
    let third = post(&mut a, now);
    a.connection.abandon(third, now + timeout);
    assert!(a.connection.is_suspect());
    // The peer gets a ping, and its response counts.
    let mut asked = BytesMut::new();
    a.transmit(usize::MAX, &mut asked, now + timeout);
    assert!(!asked.is_empty());
    a.connection.received(Reader::Main, 1, false, now + timeout);
    assert!(!a.connection.is_suspect());
    settle(&mut a, &mut b, now + timeout);
}

#[test]
fn an_idle_connection_closes_unless_a_parcel_is_open() {
    let start = Instant::now();
    let (mut a, mut b) = greeted(start);
    let mut now = start;
    a.post(1).unwrap();
    a.transmit(usize::MAX, &mut b.coming, now);
    b.receive(usize::MAX, now);
    for _ in 0..20 {
        now += limits().keep_alive;
        a.connection.handle_timeout(now, [0; 2]).unwrap();
        b.connection.handle_timeout(now, [0; 2]).unwrap();
        a.transmit(usize::MAX, &mut b.coming, now);
        b.receive(usize::MAX, now);
        b.transmit(usize::MAX, &mut a.coming, now);
        a.receive(usize::MAX, now);
    }
    settle(&mut a, &mut b, now);
    assert_eq!(a.concluded.len(), 1);
    now += limits().idle_close;
    assert_eq!(
        a.connection.handle_timeout(now, [0; 2]),
        Err(ConnectionEnd::Idle)
    );
    assert_eq!(a.post(1), Err(SendError::Ended));
}

#[test]
fn a_stalled_frame_ends_the_connection_and_a_slow_one_does_not() {
    let mut now = Instant::now();
    let (mut a, _) = greeted(now);
    a.connection.received(Reader::Main, 100, true, now);
    for _ in 0..3 {
        now += limits().stall_timeout / 2;
        a.connection
            .received(Reader::Main, NetLimits::MIN_PROGRESS as usize, true, now);
        now += limits().stall_timeout / 2;
        a.connection.handle_timeout(now, [0; 2]).unwrap();
    }
    // One byte a second.
    for _ in 0..10 {
        now += limits().stall_timeout / 10;
        a.connection.received(Reader::Main, 1, true, now);
    }
    assert!(matches!(
        a.connection.handle_timeout(now, [0; 2]),
        Err(ConnectionEnd::TooSlow(_))
    ));
}

#[test]
fn bytes_of_one_reader_are_no_progress_of_a_frame_at_the_other() {
    let start = Instant::now();
    for (stalled, other) in [
        (Reader::Main, Reader::Parcels),
        (Reader::Parcels, Reader::Main),
    ] {
        let (mut a, _) = greeted(start);
        a.connection.received(stalled, 100, true, start);
        let due = start + limits().stall_timeout;
        let half = start + limits().stall_timeout / 2;
        for partial in [true, false] {
            let enough = 2 * NetLimits::MIN_PROGRESS as usize;
            a.connection.received(other, enough, partial, half);
        }
        assert!(a.connection.poll_timeout().unwrap() <= due);
        let end = a.connection.handle_timeout(due, [0; 2]);
        assert!(matches!(end, Err(ConnectionEnd::TooSlow(_))), "{end:?}");
    }
}

#[test]
fn a_hello_must_come_in_time() {
    let now = Instant::now();
    let (mut a, b) = pair(now);
    let late = now + limits().handshake_timeout;
    assert_eq!(b.connection.poll_timeout(), Some(late));
    assert!(matches!(
        a.connection.handle_timeout(late, [0; 2]),
        Err(ConnectionEnd::TooSlow(_))
    ));
}

#[test]
fn a_peer_that_claims_to_be_this_service_is_refused() {
    let now = Instant::now();
    for role in [
        Role::Acceptor,
        Role::Dialler {
            expected: Incarnation::UNKNOWN,
        },
    ] {
        let mut connection = Connection::new(limits(), role, sample(1), now);
        connection.connected(now);
        let other = connection.handle_frame(Frame::Hello(sample(1)), now);
        assert_eq!(other, Err(ConnectionEnd::Itself));
        assert_eq!(connection.poll_event(), None);
    }
}
