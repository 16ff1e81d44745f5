//! What happens at the edges: endpoints that close, loans, floods, crowds, locks.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use parking_lot::Mutex;

use super::Fixture;
use super::party::{Party, accepted, assert_same, concluded, letter, parcel, pattern, until};
use crate::{
    Abandoned, Answer, Arrival, AttemptId, Body, Conclusion, Location, Transport, Verdict, WayFault,
};

/// An abandoned attempt has its conclusion at once and no other, and its neighbors go on.
pub fn an_abandoned_attempt_is_concluded_at_once(fixture: &dyn Fixture) {
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
    let unknown = a.transport.abandon(AttemptId(77));
    assert_eq!(unknown, Abandoned::Unconfirmed, "of an unknown attempt");
    a.send(1, &b, parcel(1, letter("x")));
    let end = a.transport.abandon(AttemptId(1));
    let twice = a.transport.abandon(AttemptId(1));
    assert_eq!(
        twice,
        Abandoned::Unconfirmed,
        "of an attempt that has ended"
    );
    abandoned.store(true, Ordering::Release);
    a.send(2, &b, parcel(2, letter("y")));
    assert_eq!(concluded(&[&a, &b], &a, 2), accepted());
    assert_eq!(a.conclusion(1), None);
    if end == Abandoned::NotSent {
        assert!(!b.has_arrived(1), "not sent, and it arrived");
    }
}

/// What was abandoned as not sent never arrives, at whatever moment that was: while the
/// connection is opened, while other parcels fill the window, and when nothing is in the way.
pub fn an_attempt_that_is_abandoned_unsent_never_arrives(fixture: &dyn Fixture) {
    let a = Party::new(fixture);
    let b = Party::new(fixture);
    let mut open = Vec::new();
    let mut unsent = Vec::new();
    for attempt in 1..=64 {
        let text = "x".repeat(1 << (attempt % 12));
        let to = &b.location;
        let sent = a
            .transport
            .dispatch(AttemptId(attempt), to, parcel(attempt, letter(text)));
        match sent {
            Ok(()) if attempt % 3 == 0 => {
                if a.transport.abandon(AttemptId(attempt)) == Abandoned::NotSent {
                    unsent.push(attempt);
                }
            }
            Ok(()) => open.push(attempt),
            Err(_) => {}
        }
        if attempt == 40
            && let Some(attempt) = open.pop()
        {
            concluded(&[&a, &b], &a, attempt);
        }
    }
    for attempt in open {
        concluded(&[&a, &b], &a, attempt);
    }
    for attempt in unsent {
        assert!(
            !b.has_arrived(attempt),
            "{attempt} was not sent, and it arrived"
        );
        assert_eq!(a.conclusion(attempt), None, "{attempt} has two conclusions");
    }
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
        let arrived = b.has_arrived(attempt);
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

/// Memory loaned for many arrives at all of them as the content it was filled with, and stays so
/// for whoever holds it while further contents follow; what is held and what is given back leaves
/// room for more.
pub fn content_for_many_arrives_everywhere(fixture: &dyn Fixture) {
    let (a, b, c) = (
        Party::new(fixture),
        Party::new(fixture),
        Party::new(fixture),
    );
    let len = 100_000.min(a.transport.max_letter() / 2);
    let filled = |round: u64| Bytes::from(vec![round as u8; len]);
    let mut kept = Vec::new();
    for round in 0..40 {
        let loan = a.transport.loan_for_many(len);
        let content = match loan {
            Ok(Some(mut loan)) => {
                assert_eq!(loan.content_mut().len(), len);
                loan.content_mut().copy_from_slice(&filled(round));
                let content = loan.freeze();
                assert!(!a.transport.copies_for_each(&content));
                content
            }
            Ok(None) if round == 0 => return,
            // What is held takes up the room there is, and letters go on without it.
            Err(error) if round > 0 => {
                assert_eq!(error.fault, WayFault::Congested, "{error}");
                filled(round)
            }
            other => panic!("round {round}: {:?}", other.map(|loan| loan.is_some())),
        };
        let sent = parcel(round, letter(content.clone()));
        for (index, to) in [(2 * round, &b), (2 * round + 1, &c)] {
            a.send(index, to, sent.clone());
        }
        for (index, to) in [(2 * round, &b), (2 * round + 1, &c)] {
            assert_eq!(concluded(&[&a, &b, &c], &a, index), accepted());
            assert_same(&to.arrived(to.arrivals() - 1), &sent);
        }
        if round < 20 {
            kept.push(content);
            continue;
        }
        for receiver in [&b, &c] {
            for (arrived, ..) in &receiver.sink.record.lock().arrivals {
                let sent = parcel(arrived.sequence, letter(filled(arrived.sequence)));
                assert_same(arrived, &sent);
            }
        }
        let own = kept.iter().enumerate();
        own.for_each(|(round, kept)| assert!(*kept == filled(round as u64), "changed"));
        // The sender gives back what it kept, and one receiver after the other.
        kept.clear();
        let receiver = if round % 2 == 0 { &b } else { &c };
        receiver.sink.record.lock().arrivals.clear();
    }
    b.sink.record.lock().arrivals.clear();
    c.sink.record.lock().arrivals.clear();
    assert!(
        a.transport
            .loan_for_many(len)
            .is_ok_and(|loan| loan.is_some()),
        "room comes back"
    );
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

/// A sink sends on what arrives, from within the very call that tells it.
pub fn a_sink_may_use_its_transport(fixture: &dyn Fixture) {
    type Onwards = Option<(Arc<dyn Transport>, Location)>;
    let relay: Arc<Mutex<Onwards>> = Arc::default();
    let way = Arc::clone(&relay);
    let (a, c) = (Party::new(fixture), Party::new(fixture));
    let b = Party::judging(fixture, move |arrival| {
        if let Some((transport, to)) = &*way.lock() {
            let attempt = AttemptId(arrival.parcel.sequence);
            transport.abandon(AttemptId(u64::MAX));
            transport
                .dispatch(attempt, to, arrival.parcel.clone())
                .expect("dispatches");
        }
        Verdict::Now(Answer::Accepted)
    });
    *relay.lock() = Some((Arc::clone(&b.transport), c.location.clone()));
    for attempt in 0..20 {
        a.send(attempt, &b, parcel(attempt, letter("pass it on")));
        assert_eq!(concluded(&[&a, &b, &c], &a, attempt), accepted());
        assert_eq!(concluded(&[&a, &b, &c], &b, attempt), accepted());
    }
    assert_eq!(c.arrivals(), 20);
    *relay.lock() = None;
}

/// The delivery core calls its transports with its own lock held, and its sink takes that lock.
pub fn a_caller_may_hold_a_lock_that_its_sink_wants(fixture: &dyn Fixture) {
    let core = Arc::new(Mutex::new(()));
    let locked = |core: &Arc<Mutex<()>>| {
        let core = Arc::clone(core);
        move |_: &Arrival| {
            let _held = core.lock();
            Verdict::Now(Answer::Accepted)
        }
    };
    let a = Party::judging(fixture, locked(&core));
    let b = Party::judging(fixture, locked(&core));
    let total = 300;
    std::thread::scope(|scope| {
        let done = Arc::new(AtomicBool::new(false));
        for party in [&a, &b] {
            let done = Arc::clone(&done);
            scope.spawn(move || {
                while !done.load(Ordering::Relaxed) {
                    if !party.transport.drive() {
                        std::thread::yield_now();
                    }
                }
            });
        }
        for attempt in 0..total {
            for (from, to) in [(&a, &b), (&b, &a)] {
                until(&[], "room for the next parcel", || {
                    let _held = core.lock();
                    let parcel = parcel(attempt, letter("both ways"));
                    from.transport
                        .dispatch(AttemptId(attempt), &to.location, parcel)
                        .ok()
                });
            }
        }
        for attempt in 0..total {
            concluded(&[], &a, attempt);
            concluded(&[], &b, attempt);
        }
        done.store(true, Ordering::Relaxed);
    });
}
