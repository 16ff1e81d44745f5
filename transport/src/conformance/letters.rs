//! Rules on contents, order and answers of parcels.

use std::time::Duration;

use bytes::Bytes;
use fipa_acl::{Letter, Payload};

use super::Fixture;
use super::endpoint::{
    TestEndpoint, accepted, assert_same, concluded, is_accepted, letter, parcel, pattern, until,
};
use crate::{
    Answer, Attempt, AttemptId, Body, Conclusion, FailureReason, Incarnation, Kind, Outcome,
    Parcel, Reaction, Report, Stream, TransportError, TransportErrorKind,
};

/// Letters, reports and credits arrive with all fields unchanged.
pub fn every_field_and_kind_arrives(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let attempts = vec![Attempt {
        via: Kind::Tcp,
        location: "tcp://192.0.2.1:7#00000000000000aa"
            .parse()
            .expect("a location"),
        error: TransportError::new(TransportErrorKind::TimedOut, "no answer in 250 ms"),
    }];
    let outcome = Outcome::Failed {
        reason: FailureReason::Unreachable,
        attempts,
    };
    let bodies = [
        letter("content"),
        Body::Report(Report::Settled(outcome)),
        Body::Report(Report::Returned { uncertain: true }),
        Body::Credit,
        Body::Predecessor,
    ];
    for (index, body) in bodies.into_iter().enumerate() {
        let sent = Parcel {
            receiver: "ärm.of [the] robot".into(),
            stream: Stream::between(Incarnation::from_u64(u64::MAX), Incarnation::UNKNOWN),
            sequence: u64::MAX - 1,
            after: 1 << 40,
            transfer: 1 << 41,
            remaining: Duration::from_micros(1_234_567),
            body,
        };
        a.send(index as u64, &b, sent.clone());
        assert_eq!(concluded(&[&a, &b], &a, index as u64), accepted());
        assert_same(&b.arrived(index), &sent);
    }
}

/// The sender gets the answer of the receiving sink unchanged.
pub fn answers_come_back_as_given(fixture: &dyn Fixture) {
    let answers = [
        Answer::Accepted,
        Answer::Custody,
        Answer::Busy,
        Answer::OutOfOrder { last: u64::MAX },
        Answer::Returned { uncertain: false },
        Answer::Returned { uncertain: true },
        Answer::Moved,
        Answer::Delivered { via: Kind::Tcp },
        Answer::failed(FailureReason::NoSuchAgent, "arm_1 left"),
        Answer::failed(FailureReason::Loop, ""),
    ];
    let given = answers.clone();
    let a = TestEndpoint::new(fixture);
    let b = TestEndpoint::with_verdict(fixture, move |arrival| {
        Reaction::Now(given[arrival.parcel.sequence as usize].clone())
    });
    for (index, answer) in answers.into_iter().enumerate() {
        a.send(index as u64, &b, parcel(index as u64, letter("x")));
        assert_eq!(
            concluded(&[&a, &b], &a, index as u64),
            Conclusion::Answered(answer)
        );
    }
    // A long detail is truncated at a character boundary.
    let c = TestEndpoint::with_verdict(fixture, |_| {
        Reaction::Now(Answer::failed(FailureReason::Refused, "é".repeat(5000)))
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

/// A connection ends whose peer answers that letters are out of order after it has taken their
/// predecessors. Letters with other answers, and a transport without connections, are not affected.
pub fn contradictions_end_a_connection(fixture: &dyn Fixture) {
    let most = u64::from(Answer::MAX_CONTRADICTIONS);
    let a = TestEndpoint::new(fixture);
    let b = TestEndpoint::with_verdict(fixture, |arrival| {
        let last = arrival.parcel.transfer;
        Reaction::Now(Answer::OutOfOrder { last })
    });
    let mut sequence = 0;
    let mut send = |last: u64| {
        sequence += 1;
        let sent = Parcel {
            after: 7,
            transfer: last,
            ..parcel(sequence, letter("x"))
        };
        a.send(sequence, &b, sent);
        let conclusion = concluded(&[&a, &b], &a, sequence);
        (
            conclusion,
            Conclusion::Answered(Answer::OutOfOrder { last }),
        )
    };
    let mut answered = |last: u64| {
        let (conclusion, expected) = send(last);
        assert_eq!(conclusion, expected);
    };
    for _ in 0..2 * most {
        answered(6);
    }
    for last in 1..most {
        answered(6 + last);
    }
    let counts = || {
        let record = a.sink.record.lock();
        (record.introduced, record.disconnected)
    };
    let (introduced, disconnected) = counts();
    assert_eq!(disconnected, 0);
    let (conclusion, expected) = send(7);
    match introduced {
        0 => assert_eq!(conclusion, expected),
        _ => assert!(
            matches!(conclusion, Conclusion::Unconfirmed(_)),
            "{conclusion:?}"
        ),
    }
    until(&[&a, &b], "the end of the connection", || {
        let (_, disconnected) = counts();
        (disconnected == introduced).then_some(())
    });
    // Another connection can be opened.
    let (conclusion, expected) = send(6);
    assert_eq!(conclusion, expected);
}

/// A letter is confirmed only after the receiving sink has it.
pub fn the_sink_has_the_letter_before_it_is_confirmed(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    for attempt in 0..50 {
        a.send(attempt, &b, parcel(attempt, letter("x")));
        until(&[&a, &b], "a confirmation", || {
            let concluded = a.conclusion(attempt);
            if concluded.is_some() {
                assert!(
                    b.arrivals() > attempt as usize,
                    "confirmed before the letter arrived"
                );
            }
            concluded
        });
    }
}

/// Late answers conclude their own parcels in any order.
pub fn a_late_answer_concludes_its_own_parcel(fixture: &dyn Fixture) {
    let a = TestEndpoint::new(fixture);
    let b = TestEndpoint::with_verdict(fixture, |_| Reaction::Later);
    for attempt in 0..3 {
        a.send(attempt, &b, parcel(attempt, letter("x")));
    }
    until(&[&a, &b], "three arrivals", || {
        (b.arrivals() == 3).then_some(())
    });
    for attempt in [2_u64, 0, 1] {
        assert_eq!(a.conclusion(attempt), None);
        let ticket = b.sink.record.lock().arrivals[attempt as usize].2;
        let ticket = ticket.expect("few arrivals are unanswered");
        b.transport
            .answer(ticket, Answer::OutOfOrder { last: attempt });
        assert_eq!(
            concluded(&[&a, &b], &a, attempt),
            Conclusion::Answered(Answer::OutOfOrder { last: attempt })
        );
        b.transport.answer(ticket, Answer::Accepted);
    }
}

/// Parcels to one location arrive in the order in which they were posted.
pub fn order_is_kept(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let total = 500;
    for sequence in 0..total {
        // Alternating sizes: a transport may treat short and long parcels differently.
        let content = pattern(if sequence % 7 == 0 { 40_000 } else { 20 });
        until(&[&a, &b], "room for the next parcel", || {
            match a.transport.post(
                AttemptId(sequence),
                &b.location,
                parcel(sequence, letter(content.clone())),
            ) {
                Ok(()) => Some(()),
                Err(error) if error.fault == TransportErrorKind::Congested => None,
                Err(error) => panic!("{error}"),
            }
        });
    }
    let mut taken: Vec<u64> = (0..total).collect();
    taken.retain(|attempt| is_accepted(&[&a, &b], &a, *attempt));
    assert!(taken.len() as u64 > total / 2);
    let record = b.sink.record.lock();
    let order: Vec<u64> = record
        .arrivals
        .iter()
        .map(|(parcel, ..)| parcel.sequence)
        .collect();
    assert_eq!(order, taken);
}

/// A letter in several pieces of memory arrives as one; empty pieces are allowed.
pub fn pieces_arrive_as_one_letter(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
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

/// Content from zero bytes to a few MiB arrives unchanged, also while earlier content is held.
pub fn content_of_many_sizes_arrives(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
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

/// A letter above the limit is refused as too large, and no part of it arrives.
pub fn a_letter_above_the_limit_is_not_sent(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let limit = a.transport.max_letter();
    assert!(
        limit < 1 << 30,
        "the suite cannot create a letter above {limit} bytes"
    );
    let error = a
        .transport
        .post(
            AttemptId(1),
            &b.location,
            parcel(1, letter(vec![0; limit + 1])),
        )
        .expect_err("the letter is too large");
    assert_eq!(error.fault, TransportErrorKind::TooLarge, "{error}");
    a.send(2, &b, parcel(2, letter("small")));
    assert_eq!(concluded(&[&a, &b], &a, 2), accepted());
    assert_eq!(b.arrivals(), 1);
}

/// A parcel to a location without an endpoint is reported as not sent.
pub fn a_location_without_an_endpoint_is_unreachable(fixture: &dyn Fixture) {
    let a = TestEndpoint::new(fixture);
    match a
        .transport
        .post(AttemptId(1), &fixture.nowhere(), parcel(1, letter("x")))
    {
        Err(error) => assert_eq!(error.fault, TransportErrorKind::Unreachable, "{error}"),
        Ok(()) => match concluded(&[&a], &a, 1) {
            Conclusion::NotSent(error) => {
                assert_eq!(error.fault, TransportErrorKind::Unreachable, "{error}")
            }
            other => panic!("{other:?}"),
        },
    }
}

/// A letter for one incarnation is not delivered to another one at the same address.
pub fn a_letter_for_another_incarnation_is_not_delivered(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    let stale = b
        .location
        .clone()
        .with_incarnation(Incarnation::from_u64(0xdead));
    let fault = match a
        .transport
        .post(AttemptId(1), &stale, parcel(1, letter("x")))
    {
        Err(error) => error.fault,
        Ok(()) => match concluded(&[&a, &b], &a, 1) {
            Conclusion::NotSent(error) => error.fault,
            other => panic!("{other:?}"),
        },
    };
    assert!(
        matches!(
            fault,
            TransportErrorKind::WrongIncarnation | TransportErrorKind::Unreachable
        ),
        "{fault:?}"
    );
    assert_eq!(b.arrivals(), 0);
}

/// Reports and credits reach the service that handed the parcel over.
pub fn parcels_can_be_sent_back_to_the_hop(fixture: &dyn Fixture) {
    let (a, b) = (TestEndpoint::new(fixture), TestEndpoint::new(fixture));
    a.send(1, &b, parcel(1, letter("x")));
    assert_eq!(concluded(&[&a, &b], &a, 1), accepted());
    let hop = b.sink.record.lock().arrivals[0].1.clone();
    assert_eq!(hop.location.incarnation(), a.location.incarnation());
    b.transport
        .post(AttemptId(1), &hop.location, parcel(1, Body::Credit))
        .expect("the hop can be reached");
    assert_eq!(concluded(&[&a, &b], &b, 1), accepted());
    assert_eq!(a.arrived(0).body, Body::Credit);
}
