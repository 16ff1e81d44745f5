//! Rules on abandoning, closing, loans, load and locks.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use parking_lot::Mutex;

use super::Fixture;
use super::endpoint::{
    TestEndpoint, accepted, assert_same, concluded, is_accepted, letter, parcel, pattern, until,
};
use crate::{
    Abandoned, Answer, Arrival, AttemptId, Body, Conclusion, Location, Reaction, Transport,
    TransportErrorKind,
};

/// An abandoned attempt is concluded once and at once, and other attempts go on.
pub fn an_abandoned_attempt_is_concluded_at_once(fixture: &dyn Fixture) {
    let a = TestEndpoint::new(fixture);
    // The answer must not come before the attempt is abandoned.
    let abandoned = Arc::new(AtomicBool::new(false));
    let may_answer = Arc::clone(&abandoned);
    let b = TestEndpoint::with_verdict(fixture, move |_| {
        while !may_answer.load(Ordering::Acquire) {
            std::thread::yield_now();
        }
        Reaction::Now(Answer::Accepted)
    });
    let unknown = a.transport.abandon(AttemptId(77), &b.location);
    assert_eq!(unknown, Abandoned::Unconfirmed, "for an unknown attempt");
    a.send(1, &b, parcel(1, letter("x")));
    let end = a.transport.abandon(AttemptId(1), &b.location);
    let twice = a.transport.abandon(AttemptId(1), &b.location);
    assert_eq!(
        twice,
        Abandoned::Unconfirmed,
        "for an attempt that has ended"
    );
    abandoned.store(true, Ordering::Release);
    a.send(2, &b, parcel(2, letter("y")));
    assert_eq!(concluded(&[&a, &b], &a, 2), accepted());
    assert_eq!(a.conclusion(1), None);
    if end == Abandoned::NotSent {
        assert!(!b.has_arrived(1), "concluded as not sent, but it arrived");
    }
}

/// An attempt that was abandoned as not sent never arrives: neither while the connection is opened,
/// nor while other parcels fill the window, nor on an idle connection.
pub fn an_attempt_that_is_abandoned_unsent_never_arrives(fixture: &dyn Fixture) {
    let a = TestEndpoint::new(fixture);
    let b = TestEndpoint::new(fixture);
    let mut open = Vec::new();
    let mut unsent = Vec::new();
    for attempt in 1..=64 {
        let text = "x".repeat(1 << (attempt % 12));
        let to = &b.location;
        let sent = a
            .transport
            .post(AttemptId(attempt), to, parcel(attempt, letter(text)));
        match sent {
            Ok(()) if attempt % 3 == 0 => {
                if a.transport.abandon(AttemptId(attempt), to) == Abandoned::NotSent {
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
            "{attempt} was concluded as not sent, but it arrived"
        );
        assert_eq!(a.conclusion(attempt), None, "{attempt} has two conclusions");
    }
}

/// Posts letters from `a` to `b` with the numbers of these attempts. Returns the attempts that have begun.
fn posted(a: &TestEndpoint, b: &TestEndpoint, attempts: impl IntoIterator<Item = u64>) -> Vec<u64> {
    let begins = |attempt: &u64| {
        let parcel = parcel(*attempt, letter("x"));
        let begun = a.transport.post(AttemptId(*attempt), &b.location, parcel);
        begun.is_ok()
    };
    attempts.into_iter().filter(begins).collect()
}

/// Every attempt to a receiver that closes is concluded.
pub fn attempts_to_a_closing_receiver_are_concluded(fixture: &dyn Fixture) {
    let a = TestEndpoint::new(fixture);
    let b = TestEndpoint::new(fixture);
    a.send(0, &b, parcel(0, letter("x")));
    assert_eq!(concluded(&[&a, &b], &a, 0), accepted());
    let open = posted(&a, &b, 1..=4);
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

/// Every attempt of a sender that closes is concluded.
pub fn attempts_of_a_closing_sender_are_concluded(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let open = posted(&a, &b, 0..4);
    a.transport.close();
    for attempt in open {
        concluded(&[&a, &b], &a, attempt);
    }
    a.transport.close();
}

/// After `close`, later calls of `post` fail, and the location cannot be reached.
pub fn a_closed_transport_refuses_parcels(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    b.transport.close();
    let error = b
        .transport
        .post(AttemptId(1), &a.location, parcel(1, letter("x")))
        .expect_err("the transport is closed");
    assert_eq!(error.fault, TransportErrorKind::Closed, "{error}");
    let not_sent = match a
        .transport
        .post(AttemptId(1), &b.location, parcel(1, letter("x")))
    {
        Err(_) => true,
        Ok(()) => matches!(concluded(&[&a], &a, 1), Conclusion::NotSent(_)),
    };
    assert!(not_sent, "a closed endpoint was reached");
}

/// No call waits for a lock that another process holds. Parcels that need such a lock leave in order
/// when it is free, unless they were abandoned.
pub fn no_call_waits_for_another_process(fixture: &dyn Fixture) {
    // A transport gives up waiting for the lock after a while, which passes on a busy machine.
    for _ in 0..20 {
        let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
        let Some(obstacle) = fixture.obstacle() else {
            return;
        };
        // A call that waited would fail, because the lock is released only afterwards.
        for attempt in 1..=3 {
            a.send(attempt, &b, parcel(attempt, letter("x")));
        }
        let end = a.transport.abandon(AttemptId(2), &b.location);
        assert_eq!(end, Abandoned::NotSent);
        a.transport.drive();
        // A loan may fail, but does not wait either.
        let _ = a.transport.loan(&b.location, 64, 1000, 1);
        drop(obstacle);
        let ends = [1, 3].map(|attempt| concluded(&[&a, &b], &a, attempt));
        if ends.contains(&accepted()) {
            assert_eq!(ends, [accepted(), accepted()]);
            let arrived: Vec<u64> = (0..2).map(|it| b.arrived(it).sequence).collect();
            assert_eq!((b.arrivals(), arrived), (2, vec![1, 3]));
            assert_eq!(a.conclusion(2), None);
            return;
        }
        for end in ends {
            assert!(matches!(end, Conclusion::NotSent(_)), "{end:?}");
        }
        assert_eq!(b.arrivals(), 0);
    }
    panic!("no parcel was sent after the lock was released");
}

/// Parcels that are posted before and while the way to a location is opened arrive in the order
/// of the calls, each once.
pub fn the_first_parcels_arrive_in_order(fixture: &dyn Fixture) {
    for _ in 0..20 {
        let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
        let mut taken = Vec::new();
        let mut attempt = 0;
        while taken.len() < 8 || a.conclusion(taken[0]).is_none() {
            attempt += 1;
            let one = parcel(attempt, letter("x"));
            match a.transport.post(AttemptId(attempt), &b.location, one) {
                Ok(()) => taken.push(attempt),
                Err(error) => assert_eq!(error.fault, TransportErrorKind::Congested, "{error}"),
            }
            a.transport.drive();
            b.transport.drive();
        }
        // The way may lack room for a parcel that waited for it.
        taken.retain(|attempt| match concluded(&[&a, &b], &a, *attempt) {
            Conclusion::NotSent(error) => {
                assert_eq!(error.fault, TransportErrorKind::Congested, "{error}");
                false
            }
            end => {
                assert_eq!(end, accepted());
                true
            }
        });
        let arrived: Vec<u64> = (0..b.arrivals()).map(|it| b.arrived(it).sequence).collect();
        assert!(!arrived.is_empty());
        assert_eq!(arrived, taken);
    }
}

/// Small and large letters of one stream arrive in the order of the calls, each once.
pub fn letters_of_all_lengths_arrive_in_order(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let large = 200_000.min(a.transport.max_letter() / 2);
    let mut taken = Vec::new();
    for attempt in 1..=40 {
        let len = match attempt % 5 {
            0 | 3 => large,
            _ => 10,
        };
        let content = vec![attempt as u8; len];
        loop {
            let one = parcel(attempt, letter(content.clone()));
            match a.transport.post(AttemptId(attempt), &b.location, one) {
                Ok(()) => break taken.push(attempt),
                Err(error) => assert_eq!(error.fault, TransportErrorKind::Congested, "{error}"),
            }
            a.transport.drive();
            b.transport.drive();
        }
        // Once in a while, the stream is idle.
        if attempt % 11 == 0 {
            concluded(&[&a, &b], &a, attempt);
        }
    }
    for attempt in &taken {
        assert_eq!(concluded(&[&a, &b], &a, *attempt), accepted());
    }
    let arrived: Vec<u64> = (0..b.arrivals()).map(|it| b.arrived(it).sequence).collect();
    assert_eq!(arrived, taken);
}

/// When letters find no room, there is room for a parcel of another kind, which may make room for them.
pub fn letters_leave_room_for_other_parcels(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let mut attempt = 0;
    let mut send = |body: Body| {
        attempt += 1;
        let sent = a
            .transport
            .post(AttemptId(attempt), &b.location, parcel(attempt, body));
        match sent {
            Ok(()) => Some(attempt),
            Err(error) => {
                assert_eq!(error.fault, TransportErrorKind::Congested, "{error}");
                None
            }
        }
    };
    for _ in 0..20 {
        let letters: Vec<u64> = std::iter::from_fn(|| send(letter("x"))).collect();
        let credit = send(Body::Credit).expect("there is room for a credit");
        for attempt in letters {
            is_accepted(&[&a, &b], &a, attempt);
        }
        assert_eq!(concluded(&[&a, &b], &a, credit), accepted());
    }
}

/// Loaned memory arrives with the content that was written to it and stays readable for the sender.
/// A letter that was loaned for one location can also go to another.
pub fn loaned_content_arrives(fixture: &dyn Fixture) {
    let (a, b, c) = (
        TestEndpoint::new(fixture),
        TestEndpoint::new(fixture),
        TestEndpoint::new(fixture),
    );
    let (head, tail) = (Bytes::from_static(b"head"), Bytes::from_static(b"\x01"));
    let envelope = Bytes::from_static(b"envelope");
    let len = 100_000.min(a.transport.max_letter() / 2);
    let room = "arm_1".len() + envelope.len() + head.len();
    for (index, to) in [(0, &b), (1, &c), (2, &b)] {
        // A transport may first have to open a connection.
        let loan = until(&[&a, &b], "room for a loan", || {
            match a.transport.loan(&b.location, room, len, tail.len()) {
                Err(error) if error.fault == TransportErrorKind::Congested => None,
                loan => Some(loan.expect("there is room for a loan")),
            }
        });
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

/// Memory loaned for several receivers arrives at all of them with the content that was written to
/// it. It stays unchanged while it is held and further contents follow. Held and released contents
/// leave room for more.
pub fn shared_content_arrives_at_all_receivers(fixture: &dyn Fixture) {
    let (a, b, c) = (
        TestEndpoint::new(fixture),
        TestEndpoint::new(fixture),
        TestEndpoint::new(fixture),
    );
    let len = 100_000.min(a.transport.max_letter() / 2);
    let filled = |round: u64| Bytes::from(vec![round as u8; len]);
    let mut contents = Vec::new();
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
            // Held contents use all the room, and letters are sent without a loan.
            Err(error) if round > 0 => {
                assert_eq!(error.fault, TransportErrorKind::Congested, "{error}");
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
            contents.push(content);
            continue;
        }
        for receiver in [&b, &c] {
            for (arrived, ..) in &receiver.sink.record.lock().arrivals {
                let sent = parcel(arrived.sequence, letter(filled(arrived.sequence)));
                assert_same(arrived, &sent);
            }
        }
        let own = contents.iter().enumerate();
        own.for_each(|(round, content)| assert!(*content == filled(round as u64), "changed"));
        // The sender releases its contents, and the receivers in turn release theirs.
        contents.clear();
        let receiver = if round % 2 == 0 { &b } else { &c };
        receiver.sink.record.lock().arrivals.clear();
    }
    b.sink.record.lock().arrivals.clear();
    c.sink.record.lock().arrivals.clear();
    assert!(
        a.transport
            .loan_for_many(len)
            .is_ok_and(|loan| loan.is_some()),
        "there is room again"
    );
}

/// Each of many parcels that are posted without a pause is refused at once or concluded, and each accepted
/// parcel arrives once.
pub fn a_flood_is_bounded_and_every_attempt_concluded(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let mut taken = Vec::new();
    for attempt in 0..20_000 {
        match a.transport.post(
            AttemptId(attempt),
            &b.location,
            parcel(attempt, letter("x")),
        ) {
            Ok(()) => taken.push(attempt),
            Err(error) => assert_eq!(error.fault, TransportErrorKind::Congested, "{error}"),
        }
    }
    taken.retain(|attempt| is_accepted(&[&a, &b], &a, *attempt));
    let arrived = taken.len();
    assert!(arrived > 0);
    assert_eq!(b.arrivals(), arrived);
    a.send(1_000_000, &b, parcel(1, letter("after the flood")));
    assert_eq!(concluded(&[&a, &b], &a, 1_000_000), accepted());
}

/// Several endpoints exchange letters with one at the same time.
pub fn many_endpoints_exchange_letters_with_one(fixture: &dyn Fixture) {
    let hub = TestEndpoint::new(fixture);
    let others: Vec<TestEndpoint> = (0..4).map(|_| TestEndpoint::new(fixture)).collect();
    let all: Vec<&TestEndpoint> = others.iter().chain([&hub]).collect();
    for round in 0..20 {
        for (index, other) in others.iter().enumerate() {
            let attempt = round * 10 + index as u64;
            other.send(attempt, &hub, parcel(attempt, letter("in")));
            hub.send(attempt, other, parcel(attempt, letter("out")));
        }
        for (index, other) in others.iter().enumerate() {
            let attempt = round * 10 + index as u64;
            assert_eq!(concluded(&all, other, attempt), accepted());
            assert_eq!(concluded(&all, &hub, attempt), accepted());
        }
    }
    assert_eq!(hub.arrivals(), 80);
    assert!(others.iter().all(|other| other.arrivals() == 20));
}

/// A sink may post and abandon from within `arrived`.
pub fn a_sink_may_call_its_transport(fixture: &dyn Fixture) {
    type NextHop = Option<(Arc<dyn Transport>, Location)>;
    let relay: Arc<Mutex<NextHop>> = Arc::default();
    let next_hop = Arc::clone(&relay);
    let (a, c) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let b = TestEndpoint::with_verdict(fixture, move |arrival| {
        if let Some((transport, to)) = &*next_hop.lock() {
            let attempt = AttemptId(arrival.parcel.sequence);
            transport.abandon(AttemptId(u64::MAX), to);
            transport
                .post(attempt, to, arrival.parcel.clone())
                .expect("it is posted");
        }
        Reaction::Now(Answer::Accepted)
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

/// The delivery core calls its transports while it holds its own lock, which its sink takes.
pub fn a_caller_may_hold_a_lock_that_its_sink_takes(fixture: &dyn Fixture) {
    let core = Arc::new(Mutex::new(()));
    let locked = |core: &Arc<Mutex<()>>| {
        let core = Arc::clone(core);
        move |_: &Arrival| {
            let _held = core.lock();
            Reaction::Now(Answer::Accepted)
        }
    };
    let a = TestEndpoint::with_verdict(fixture, locked(&core));
    let b = TestEndpoint::with_verdict(fixture, locked(&core));
    let total = 300;
    std::thread::scope(|scope| {
        let done = Arc::new(AtomicBool::new(false));
        for endpoint in [&a, &b] {
            let done = Arc::clone(&done);
            scope.spawn(move || {
                while !done.load(Ordering::Relaxed) {
                    if !endpoint.transport.drive() {
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
                        .post(AttemptId(attempt), &to.location, parcel)
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
