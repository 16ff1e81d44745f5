//! The rules of [`Transport`], as tests that every implementation runs.
//!
//! ```text
//! struct Mine { /* what endpoints need to reach each other */ }
//! impl fipa_transport::conformance::Fixture for Mine { /* … */ }
//! fipa_transport::conformance_tests!(Mine::new());
//! ```
//!
//! The suite knows nothing of runtimes: it waits by calling [`Transport::drive`] and sleeping a
//! little until a condition holds, and gives up after a time that no working transport needs.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use parking_lot::Mutex;

use crate::{
    Answer, Arrival, Attempt, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Kind,
    Location, Outcome, Parcel, Report, Sink, Stream, Ticket, Transport, Verdict, WayError,
    WayFault,
};

/// What an implementation brings to the suite.
pub trait Fixture {
    /// A new endpoint on which `listen` was not called yet. Endpoints of one fixture can reach
    /// each other, and stand for different processes.
    fn endpoint(&self) -> Arc<dyn Transport>;

    /// A location of this transport at which nobody is.
    fn nowhere(&self) -> Location;
}

/// Makes one test per rule. The argument is an expression for a new [`Fixture`].
#[macro_export]
macro_rules! conformance_tests {
    ($fixture:expr) => {
        $crate::conformance_tests!(@each $fixture;
            every_field_and_kind_arrives
            answers_come_back_as_given
            the_letter_is_the_sinks_before_it_is_confirmed
            a_late_answer_reaches_its_own_parcel
            order_is_kept
            pieces_arrive_as_one_letter
            content_of_many_sizes_arrives
            what_is_too_large_is_not_sent
            nobody_is_nowhere
            another_incarnation_is_somebody_else
            a_hop_can_be_answered
            an_abandoned_attempt_is_not_concluded
            a_closing_receiver_leaves_no_attempt_open
            a_closing_sender_leaves_no_attempt_open
            a_closed_transport_takes_nothing
            loaned_content_arrives
            a_flood_is_bounded_and_every_attempt_concluded
            many_talk_to_one_and_one_to_many
        );
    };
    (@each $fixture:expr; $($rule:ident)*) => {
        $(#[test]
        fn $rule() {
            $crate::conformance::$rule(&$fixture);
        })*
    };
}

/// How long the suite waits before it calls a transport broken.
const PATIENCE: Duration = Duration::from_secs(60);

type Judge = Box<dyn Fn(&Arrival) -> Verdict + Send + Sync>;

#[derive(Default)]
struct Record {
    arrivals: Vec<(Parcel, Hop, Ticket)>,
    concluded: HashMap<AttemptId, Vec<Conclusion>>,
}

struct Recorder {
    record: Mutex<Record>,
    judge: Judge,
}

impl Sink for Recorder {
    fn arrived(&self, arrival: Arrival) -> Verdict {
        let verdict = (self.judge)(&arrival);
        let Arrival {
            parcel,
            from,
            ticket,
        } = arrival;
        self.record.lock().arrivals.push((parcel, from, ticket));
        verdict
    }

    fn arrived_unframed(&self, _: Letter, _: Kind) {
        panic!("nobody sent an unframed letter");
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        self.record
            .lock()
            .concluded
            .entry(attempt)
            .or_default()
            .push(conclusion);
    }
}

/// An endpoint that listens, and what its sink has heard.
struct Party {
    transport: Arc<dyn Transport>,
    sink: Arc<Recorder>,
    location: Location,
}

impl Party {
    fn new(fixture: &dyn Fixture) -> Self {
        Self::judging(fixture, |_| Verdict::Now(Answer::Accepted))
    }

    fn judging(
        fixture: &dyn Fixture,
        judge: impl Fn(&Arrival) -> Verdict + Send + Sync + 'static,
    ) -> Self {
        let transport = fixture.endpoint();
        let sink = Arc::new(Recorder {
            record: Mutex::default(),
            judge: Box::new(judge),
        });
        let locations = transport
            .listen(Arc::clone(&sink) as Arc<dyn Sink>)
            .expect("listens");
        let location = locations.first().expect("a location").clone();
        assert_eq!(location.kind(), transport.kind());
        assert!(
            location.incarnation().is_known(),
            "{location} has no incarnation"
        );
        Self {
            transport,
            sink,
            location,
        }
    }

    fn send(&self, attempt: u64, to: &Party, parcel: Parcel) {
        self.transport
            .dispatch(AttemptId(attempt), &to.location, parcel)
            .unwrap_or_else(|error| panic!("dispatch {attempt}: {error}"));
    }

    fn conclusion(&self, attempt: u64) -> Option<Conclusion> {
        self.sink
            .record
            .lock()
            .concluded
            .get(&AttemptId(attempt))?
            .first()
            .cloned()
    }

    fn arrivals(&self) -> usize {
        self.sink.record.lock().arrivals.len()
    }

    fn arrived(&self, index: usize) -> Parcel {
        self.sink.record.lock().arrivals[index].0.clone()
    }

    /// Nobody was told twice about one attempt.
    fn check_single_conclusions(&self) {
        for (attempt, conclusions) in &self.sink.record.lock().concluded {
            assert_eq!(conclusions.len(), 1, "{attempt:?}: {conclusions:?}");
        }
    }
}

impl Drop for Party {
    fn drop(&mut self) {
        self.transport.close();
        if !std::thread::panicking() {
            self.check_single_conclusions();
        }
    }
}

fn until<T>(parties: &[&Party], what: &str, condition: impl Fn() -> Option<T>) -> T {
    let started = Instant::now();
    loop {
        let driven = parties
            .iter()
            .filter(|party| party.transport.drive())
            .count();
        if let Some(value) = condition() {
            return value;
        }
        assert!(started.elapsed() < PATIENCE, "gave up waiting for: {what}");
        if driven == 0 {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
}

fn concluded(parties: &[&Party], sender: &Party, attempt: u64) -> Conclusion {
    until(parties, "the conclusion of an attempt", || {
        sender.conclusion(attempt)
    })
}

fn accepted() -> Conclusion {
    Conclusion::Answered(Answer::Accepted)
}

fn letter(content: impl Into<Bytes>) -> Body {
    let payload = Payload {
        head: Bytes::from_static(b"head of the message"),
        content: content.into(),
        tail: Bytes::from_static(b"\x01"),
    };
    Body::Letter(Letter::new(Bytes::from_static(b"envelope"), payload))
}

fn parcel(sequence: u64, body: Body) -> Parcel {
    Parcel {
        receiver: "arm_1".into(),
        stream: Stream {
            sender: Incarnation::from_u64(0x5e4d),
            receiver: Incarnation::from_u64(0x4ec3),
        },
        sequence,
        after: 0,
        remaining: Duration::from_millis(2500),
        hops: 0,
        body,
    }
}

fn assert_same(arrived: &Parcel, sent: &Parcel) {
    match (&arrived.body, &sent.body) {
        (Body::Letter(arrived), Body::Letter(sent)) => {
            assert_eq!(arrived.envelope(), sent.envelope());
            assert!(
                arrived.payload().to_bytes() == sent.payload().to_bytes(),
                "payload differs"
            );
        }
        (arrived, sent) => assert_eq!(arrived, sent),
    }
    let header = |parcel: &Parcel| Parcel {
        body: Body::Credit,
        ..parcel.clone()
    };
    assert_eq!(header(arrived), header(sent));
}

fn pattern(len: usize) -> Bytes {
    (0..len)
        .map(|i| (i ^ (i >> 8)) as u8)
        .collect::<Vec<_>>()
        .into()
}

/// Letters, reports and credits arrive with everything that was said about them.
pub fn every_field_and_kind_arrives(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    let attempts = vec![Attempt {
        via: Kind::Tcp,
        location: "tcp://192.0.2.1:7#00000000000000aa"
            .parse()
            .expect("a location"),
        error: WayError::new(WayFault::TimedOut, "no answer in 250 ms"),
    }];
    let outcome = Outcome::Failed {
        reason: FailureReason::Unreachable,
        attempts,
    };
    let bodies = [
        letter("content"),
        Body::Report(Report { outcome }),
        Body::Credit,
    ];
    for (index, body) in bodies.into_iter().enumerate() {
        let sent = Parcel {
            receiver: "ärm.of [the] robot".into(),
            stream: Stream {
                sender: Incarnation::from_u64(u64::MAX),
                receiver: Incarnation::UNKNOWN,
            },
            sequence: u64::MAX - 1,
            after: 1 << 40,
            remaining: Duration::from_micros(1_234_567),
            hops: 2,
            body,
        };
        a.send(index as u64, &b, sent.clone());
        assert_eq!(concluded(&[&a, &b], &a, index as u64), accepted());
        assert_same(&b.arrived(index), &sent);
    }
}

/// Whatever the receiving sink says is what the sender is told.
pub fn answers_come_back_as_given(fixture: &dyn Fixture) {
    let answers = [
        Answer::Accepted,
        Answer::Custody,
        Answer::Busy,
        Answer::OutOfOrder { last: u64::MAX },
        Answer::failed(FailureReason::NoSuchAgent, "arm_1 left"),
        Answer::failed(FailureReason::Loop, ""),
    ];
    let given = answers.clone();
    let a = Party::new(fixture);
    let b = Party::judging(fixture, move |arrival| {
        Verdict::Now(given[arrival.parcel.sequence as usize].clone())
    });
    for (index, answer) in answers.into_iter().enumerate() {
        a.send(index as u64, &b, parcel(index as u64, letter("x")));
        assert_eq!(
            concluded(&[&a, &b], &a, index as u64),
            Conclusion::Answered(answer)
        );
    }
    // A long detail is cut, at a character boundary, and does no harm.
    let c = Party::judging(fixture, |_| {
        Verdict::Now(Answer::failed(FailureReason::Refused, "é".repeat(5000)))
    });
    a.send(100, &c, parcel(1, letter("x")));
    match concluded(&[&a, &c], &a, 100) {
        Conclusion::Answered(Answer::Failed {
            reason: FailureReason::Refused,
            detail,
        }) => {
            assert!(
                detail.starts_with('é') && detail.len() <= Answer::MAX_DETAIL,
                "{detail}"
            );
        }
        other => panic!("{other:?}"),
    }
}

/// Nothing is confirmed before the receiving sink has it.
pub fn the_letter_is_the_sinks_before_it_is_confirmed(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    for attempt in 0..50 {
        a.send(attempt, &b, parcel(attempt, letter("x")));
        until(&[&a, &b], "a confirmation", || {
            let concluded = a.conclusion(attempt);
            if concluded.is_some() {
                assert!(
                    b.arrivals() > attempt as usize,
                    "confirmed before it arrived"
                );
            }
            concluded
        });
    }
}

/// Where late answers are allowed, they find their parcel, in any order.
pub fn a_late_answer_reaches_its_own_parcel(fixture: &dyn Fixture) {
    let a = Party::new(fixture);
    if a.transport.answers_at_once() {
        return;
    }
    let b = Party::judging(fixture, |_| Verdict::Later);
    for attempt in 0..3 {
        a.send(attempt, &b, parcel(attempt, letter("x")));
    }
    until(&[&a, &b], "three arrivals", || {
        (b.arrivals() == 3).then_some(())
    });
    for attempt in [2_u64, 0, 1] {
        assert_eq!(a.conclusion(attempt), None);
        let ticket = b.sink.record.lock().arrivals[attempt as usize].2;
        b.transport
            .answer(ticket, Answer::OutOfOrder { last: attempt });
        assert_eq!(
            concluded(&[&a, &b], &a, attempt),
            Conclusion::Answered(Answer::OutOfOrder { last: attempt })
        );
        b.transport.answer(ticket, Answer::Accepted);
    }
}

/// Parcels to one location arrive in the order in which they were dispatched.
pub fn order_is_kept(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    let total = 500;
    for sequence in 0..total {
        // Alternating sizes: a transport may treat small and large ones differently.
        let content = pattern(if sequence % 7 == 0 { 40_000 } else { 20 });
        until(&[&a, &b], "room for the next parcel", || {
            match a.transport.dispatch(
                AttemptId(sequence),
                &b.location,
                parcel(sequence, letter(content.clone())),
            ) {
                Ok(()) => Some(()),
                Err(error) if error.fault == WayFault::Congested => None,
                Err(error) => panic!("{error}"),
            }
        });
    }
    for attempt in 0..total {
        assert_eq!(concluded(&[&a, &b], &a, attempt), accepted());
    }
    let record = b.sink.record.lock();
    let order: Vec<u64> = record
        .arrivals
        .iter()
        .map(|(parcel, ..)| parcel.sequence)
        .collect();
    assert_eq!(order, (0..total).collect::<Vec<_>>());
}

/// A letter may lie in pieces in the sender's memory; empty pieces are fine.
pub fn pieces_arrive_as_one_letter(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    let base = Bytes::from_static(b"base envelope");
    let whole = Letter::new(base.clone(), Bytes::from_static(b"whole message"));
    let letters = [
        whole.clone(),
        whole
            .clone()
            .stamped(Bytes::from_static(b"one"))
            .stamped(Bytes::from_static(b"two")),
        Letter::new(base.clone(), Payload::default()),
        Letter::new(
            base,
            Payload {
                head: Bytes::new(),
                content: pattern(9),
                tail: Bytes::from_static(b"t"),
            },
        ),
    ];
    for (index, letter) in letters.into_iter().enumerate() {
        let sent = parcel(index as u64, Body::Letter(letter));
        a.send(index as u64, &b, sent.clone());
        assert_eq!(concluded(&[&a, &b], &a, index as u64), accepted());
        assert_same(&b.arrived(index), &sent);
    }
}

/// Content from nothing to a few megabytes arrives unchanged, also while earlier content is held.
pub fn content_of_many_sizes_arrives(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    let largest = a.transport.max_letter().saturating_sub(200).min(4 << 20);
    let sizes = [
        0,
        1,
        7,
        8,
        255,
        256,
        4095,
        4096,
        65_535,
        65_536,
        1 << 20,
        4 << 20,
    ];
    let mut index = 0;
    for size in sizes.into_iter().filter(|size| *size <= largest) {
        for _ in 0..2 {
            let sent = parcel(index, letter(pattern(size)));
            a.send(index, &b, sent.clone());
            assert_eq!(concluded(&[&a, &b], &a, index), accepted(), "{size} bytes");
            assert_same(&b.arrived(index as usize), &sent);
            index += 1;
        }
    }
}

/// A letter above the limit is refused as too large, and nothing of it arrives.
pub fn what_is_too_large_is_not_sent(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    let limit = a.transport.max_letter();
    assert!(
        limit < 1 << 30,
        "the suite cannot make a letter above {limit} bytes"
    );
    let error = a
        .transport
        .dispatch(
            AttemptId(1),
            &b.location,
            parcel(1, letter(vec![0; limit + 1])),
        )
        .expect_err("too large");
    assert_eq!(error.fault, WayFault::TooLarge, "{error}");
    a.send(2, &b, parcel(2, letter("small")));
    assert_eq!(concluded(&[&a, &b], &a, 2), accepted());
    assert_eq!(b.arrivals(), 1);
}

/// Where nobody is, nothing was sent, and that is said.
pub fn nobody_is_nowhere(fixture: &dyn Fixture) {
    let a = Party::new(fixture);
    match a
        .transport
        .dispatch(AttemptId(1), &fixture.nowhere(), parcel(1, letter("x")))
    {
        Err(error) => assert_eq!(error.fault, WayFault::Unreachable, "{error}"),
        Ok(()) => match concluded(&[&a], &a, 1) {
            Conclusion::NotSent(error) => assert_eq!(error.fault, WayFault::Unreachable, "{error}"),
            other => panic!("{other:?}"),
        },
    }
}

/// A letter for a service that is gone is not given to the one that took its place.
pub fn another_incarnation_is_somebody_else(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    let stale = b
        .location
        .clone()
        .with_incarnation(Incarnation::from_u64(0xdead));
    let fault = match a
        .transport
        .dispatch(AttemptId(1), &stale, parcel(1, letter("x")))
    {
        Err(error) => error.fault,
        Ok(()) => match concluded(&[&a, &b], &a, 1) {
            Conclusion::NotSent(error) => error.fault,
            other => panic!("{other:?}"),
        },
    };
    assert!(
        matches!(fault, WayFault::WrongIncarnation | WayFault::Unreachable),
        "{fault:?}"
    );
    assert_eq!(b.arrivals(), 0);
}

/// Reports and credits find their way back to whoever handed a parcel over.
pub fn a_hop_can_be_answered(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    a.send(1, &b, parcel(1, letter("x")));
    assert_eq!(concluded(&[&a, &b], &a, 1), accepted());
    let hop = b.sink.record.lock().arrivals[0].1.clone();
    assert_eq!(hop.location.incarnation(), a.location.incarnation());
    b.transport
        .dispatch(AttemptId(1), &hop.location, parcel(1, Body::Credit))
        .expect("the way back is open");
    assert_eq!(concluded(&[&a, &b], &b, 1), accepted());
    assert_eq!(a.arrived(0).body, Body::Credit);
}

/// An abandoned attempt is heard of no more, and its neighbours are not harmed.
pub fn an_abandoned_attempt_is_not_concluded(fixture: &dyn Fixture) {
    let a = Party::new(fixture);
    // The answer must not be there before the attempt is abandoned.
    let abandoned = Arc::new(AtomicBool::new(false));
    let may_answer = Arc::clone(&abandoned);
    let b = Party::judging(fixture, move |_| {
        while !may_answer.load(Ordering::Acquire) {
            std::thread::yield_now();
        }
        Verdict::Now(Answer::Accepted)
    });
    a.transport.abandon(AttemptId(77));
    a.send(1, &b, parcel(1, letter("x")));
    a.transport.abandon(AttemptId(1));
    abandoned.store(true, Ordering::Release);
    a.send(2, &b, parcel(2, letter("y")));
    assert_eq!(concluded(&[&a, &b], &a, 2), accepted());
    assert_eq!(a.conclusion(1), None);
}

/// When the receiver goes away, every attempt towards it still gets its conclusion.
pub fn a_closing_receiver_leaves_no_attempt_open(fixture: &dyn Fixture) {
    let a = Party::new(fixture);
    let b = Party::new(fixture);
    a.send(0, &b, parcel(0, letter("x")));
    assert_eq!(concluded(&[&a, &b], &a, 0), accepted());
    let mut open = Vec::new();
    for attempt in 1..=4 {
        if a.transport
            .dispatch(
                AttemptId(attempt),
                &b.location,
                parcel(attempt, letter("x")),
            )
            .is_ok()
        {
            open.push(attempt);
        }
    }
    b.transport.close();
    for attempt in open {
        let end = concluded(&[&a], &a, attempt);
        let arrived = b
            .sink
            .record
            .lock()
            .arrivals
            .iter()
            .any(|(parcel, ..)| parcel.sequence == attempt);
        match end {
            Conclusion::NotSent(_) => assert!(!arrived, "{attempt} arrived, but was not sent"),
            Conclusion::Answered(Answer::Accepted) => assert!(arrived, "{attempt} did not arrive"),
            Conclusion::Unconfirmed(_) => {}
            other => panic!("{other:?}"),
        }
    }
}

/// When the sender goes away, every attempt it made still gets its conclusion.
pub fn a_closing_sender_leaves_no_attempt_open(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    let mut open = Vec::new();
    for attempt in 0..4 {
        if a.transport
            .dispatch(
                AttemptId(attempt),
                &b.location,
                parcel(attempt, letter("x")),
            )
            .is_ok()
        {
            open.push(attempt);
        }
    }
    a.transport.close();
    for attempt in open {
        concluded(&[&a, &b], &a, attempt);
    }
    a.transport.close();
}

/// After `close` nothing is taken any more, and no location answers.
pub fn a_closed_transport_takes_nothing(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    b.transport.close();
    let error = b
        .transport
        .dispatch(AttemptId(1), &a.location, parcel(1, letter("x")))
        .expect_err("closed");
    assert_eq!(error.fault, WayFault::Closed, "{error}");
    let not_sent = match a
        .transport
        .dispatch(AttemptId(1), &b.location, parcel(1, letter("x")))
    {
        Err(_) => true,
        Ok(()) => matches!(concluded(&[&a], &a, 1), Conclusion::NotSent(_)),
    };
    assert!(not_sent, "a closed endpoint was reached");
}

/// Loaned memory arrives as the content it was filled with; it stays readable for the sender,
/// and a letter filled for one location can still go to another.
pub fn loaned_content_arrives(fixture: &dyn Fixture) {
    let (a, b, c) = (
        Party::new(fixture),
        Party::new(fixture),
        Party::new(fixture),
    );
    let (head, tail) = (Bytes::from_static(b"head"), Bytes::from_static(b"\x01"));
    let envelope = Bytes::from_static(b"envelope");
    let len = 100_000.min(a.transport.max_letter() / 2);
    let room = "arm_1".len() + envelope.len() + head.len();
    for (index, to) in [(0, &b), (1, &c), (2, &b)] {
        let loan = a
            .transport
            .loan(&b.location, room, len, tail.len())
            .expect("room for a loan");
        let Some(mut loan) = loan else { return };
        assert_eq!(loan.content_mut().len(), len);
        loan.content_mut().copy_from_slice(&pattern(len));
        let content = loan.freeze();
        let payload = Payload {
            head: head.clone(),
            content: content.clone(),
            tail: tail.clone(),
        };
        let sent = parcel(index, Body::Letter(Letter::new(envelope.clone(), payload)));
        a.send(index, to, sent.clone());
        assert_eq!(concluded(&[&a, &b, &c], &a, index), accepted());
        let arrived = to.arrived(to.arrivals() - 1);
        assert_same(&arrived, &sent);
        assert!(
            content == pattern(len),
            "the sender's view of its content changed"
        );
    }
}

/// Whatever is dispatched without waiting is either refused at once or concluded; what was
/// accepted arrived once.
pub fn a_flood_is_bounded_and_every_attempt_concluded(fixture: &dyn Fixture) {
    let (a, b) = (Party::new(fixture), Party::new(fixture));
    let mut taken = Vec::new();
    for attempt in 0..20_000 {
        match a.transport.dispatch(
            AttemptId(attempt),
            &b.location,
            parcel(attempt, letter("x")),
        ) {
            Ok(()) => taken.push(attempt),
            Err(error) => assert_eq!(error.fault, WayFault::Congested, "{error}"),
        }
    }
    assert!(!taken.is_empty());
    for &attempt in &taken {
        assert_eq!(concluded(&[&a, &b], &a, attempt), accepted());
    }
    assert_eq!(b.arrivals(), taken.len());
    a.send(1_000_000, &b, parcel(1, letter("after the flood")));
    assert_eq!(concluded(&[&a, &b], &a, 1_000_000), accepted());
}

/// Several endpoints at once, in both directions.
pub fn many_talk_to_one_and_one_to_many(fixture: &dyn Fixture) {
    let hub = Party::new(fixture);
    let others: Vec<Party> = (0..4).map(|_| Party::new(fixture)).collect();
    let everyone: Vec<&Party> = others.iter().chain([&hub]).collect();
    for round in 0..20 {
        for (index, other) in others.iter().enumerate() {
            let attempt = round * 10 + index as u64;
            other.send(attempt, &hub, parcel(attempt, letter("in")));
            hub.send(attempt, other, parcel(attempt, letter("out")));
        }
        for (index, other) in others.iter().enumerate() {
            let attempt = round * 10 + index as u64;
            assert_eq!(concluded(&everyone, other, attempt), accepted());
            assert_eq!(concluded(&everyone, &hub, attempt), accepted());
        }
    }
    assert_eq!(hub.arrivals(), 80);
    assert!(others.iter().all(|other| other.arrivals() == 20));
}
