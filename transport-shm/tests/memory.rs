//! The memory that contains content, and the limits on its amount.

#![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

mod common;

use bytes::Bytes;
use common::{FRONT, TestDomain, attempt, mapping_of, open, parcel};
use fipa_testbed::until;
use fipa_transport::{Answer, Conclusion, Transport, TransportErrorKind};
use fipa_transport_shm::is_in_place;

fn pattern(len: usize) -> Bytes {
    (0..len)
        .map(|at| (at % 251) as u8)
        .collect::<Vec<u8>>()
        .into()
}

#[test]
fn loaned_content_is_never_copied() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let (receiver, got) = domain.listening();
    open(&sender, &receiver.location());
    for (number, len) in [2000, 4 << 20, 16 << 20].into_iter().enumerate() {
        let loan = sender.loan(&receiver.location(), FRONT, len, 1);
        let mut loan = loan.unwrap().expect("shared memory supports loans");
        assert_eq!(loan.content_mut().len(), len);
        loan.content_mut().copy_from_slice(&pattern(len));
        let content = loan.freeze();
        let from = mapping_of(&content);
        let path = from
            .path
            .as_deref()
            .expect("loaned memory is mapped from a file");
        assert!(
            path.starts_with(&format!("/dev/shm/{}", domain.prefix)),
            "{path}"
        );

        sender
            .post(attempt(), &receiver.location(), parcel(content.clone()))
            .unwrap();
        until("letter", || got.arrivals() == number + 1);
        let received = got.content(number);
        assert_eq!(received, pattern(len));
        // The same bytes of the same file, mapped a second time, and not a copy.
        assert_ne!(received.as_ptr(), content.as_ptr());
        assert_eq!(mapping_of(&received), from);
        assert_eq!(received.as_ptr() as usize % 8, 0);
    }
    until("answers", || sent.conclusions() == 3);
    assert_eq!(sender.counters().loans_sent, 3);
    assert_eq!(sender.counters().loans_copied, 0);
    assert_eq!(receiver.counters().in_place, 3);
    assert_eq!(receiver.counters().copied_full, 0);
}

#[test]
fn loaned_content_can_be_sent_again_and_to_another_receiver() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let (first, got_first) = domain.listening();
    let (second, got_second) = domain.listening();
    open(&sender, &first.location());
    let mut loan = sender
        .loan(&first.location(), FRONT, 5000, 1)
        .unwrap()
        .unwrap();
    loan.content_mut().copy_from_slice(&pattern(5000));
    let content = loan.freeze();
    for to in [&first, &first, &second] {
        sender
            .post(attempt(), &to.location(), parcel(content.clone()))
            .unwrap();
    }
    until("letters", || {
        got_first.arrivals() == 2 && got_second.arrivals() == 1
    });
    until("answers", || sent.conclusions() == 3);
    for received in [
        got_first.content(0),
        got_first.content(1),
        got_second.content(0),
    ] {
        assert_eq!(received, pattern(5000));
    }
    assert_eq!(content, pattern(5000));
    assert_eq!(sender.counters().loans_sent, 1);
    assert_eq!(sender.counters().loans_copied, 1);
}

#[test]
fn a_letter_with_a_longer_front_than_announced_is_copied() {
    let domain = TestDomain::new();
    let (sender, _) = domain.listening();
    let (receiver, got) = domain.listening();
    open(&sender, &receiver.location());
    let mut loan = sender
        .loan(&receiver.location(), 8, 5000, 1)
        .unwrap()
        .unwrap();
    loan.content_mut().copy_from_slice(&pattern(5000));
    sender
        .post(attempt(), &receiver.location(), parcel(loan.freeze()))
        .unwrap();
    until("letter", || got.arrivals() == 1);
    assert_eq!(got.content(0), pattern(5000));
    assert_eq!(sender.counters().loans_copied, 1);
}

#[test]
fn a_loan_outlives_larger_ones_and_its_transport() {
    let domain = TestDomain::new();
    let (sender, _) = domain.listening();
    let (receiver, got) = domain.listening();
    open(&sender, &receiver.location());
    let mut small = sender
        .loan(&receiver.location(), FRONT, 2000, 1)
        .unwrap()
        .unwrap();
    small.content_mut().copy_from_slice(&pattern(2000));
    let small = small.freeze();
    // Creates a new segment; content in the old one is copied when sent, see `Outbox::send_loan`.
    let large = sender
        .loan(&receiver.location(), FRONT, 1 << 20, 1)
        .unwrap()
        .unwrap();
    sender
        .post(attempt(), &receiver.location(), parcel(small.clone()))
        .unwrap();
    until("letter", || got.arrivals() == 1);
    assert_eq!(got.content(0), pattern(2000));
    drop(large);
    sender.close();
    drop(sender);
    assert_eq!(small, pattern(2000));
}

#[test]
fn loans_are_bounded_and_leave_room_for_letters() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let (receiver, _) = domain.listening();
    let to = receiver.location();
    open(&sender, &to);
    let most = domain.config().max_loans;
    let loans: Vec<_> = (0..most)
        .map(|_| sender.loan(&to, FRONT, 100, 1).unwrap().unwrap())
        .collect();
    let refused = sender
        .loan(&to, FRONT, 100, 1)
        .err()
        .expect("the limit is reached");
    assert_eq!(refused.fault, TransportErrorKind::Congested);
    sender.post(attempt(), &to, parcel(Bytes::new())).unwrap();
    until("answer", || sent.conclusions() == 1);
    drop(loans);
    assert!(sender.loan(&to, FRONT, 100, 1).is_ok());
}

#[test]
fn held_content_is_bounded_and_then_copied() {
    let domain = TestDomain::new();
    let mut config = domain.config();
    config.max_borrowed = 5;
    let (receiver, got) = domain.listening_with(config);
    let (sender, sent) = domain.listening();
    let to = receiver.location();
    // More than a window: no letter may wait for the release of content.
    for number in 0..40 {
        let one = attempt();
        sender
            .post(one, &to, parcel(pattern(3000 + number)))
            .unwrap();
        until("answer", || sent.conclusion_of(one).is_some());
        assert_eq!(
            sent.conclusion_of(one),
            Some(Conclusion::Answered(Answer::Accepted))
        );
    }
    let counters = receiver.counters();
    assert_eq!(
        (counters.in_place, counters.copied_full, counters.borrowed),
        (5, 35, 5)
    );
    for number in 0..40 {
        let content = got.content(number);
        assert_eq!(content, pattern(3000 + number));
        assert_eq!(is_in_place(&content), number < 5, "{number}");
        assert_eq!(is_in_place(&content[1000..]), number < 5, "{number}");
    }
    assert!(!is_in_place(&[]));
    got.arrived.lock().unwrap().clear();
    assert_eq!(receiver.counters().borrowed, 0);
    sender.post(attempt(), &to, parcel(pattern(3000))).unwrap();
    until("letter", || got.arrivals() == 1);
    assert_eq!(receiver.counters().in_place, 6);
}

#[test]
fn one_slot_of_each_sender_stays_free() {
    let domain = TestDomain::new();
    let mut config = domain.config();
    config.window = 4;
    config.max_loans = 2;
    let (receiver, _got) = domain.listening_with(config);
    let (sender, sent) = domain.listening();
    for _ in 0..12 {
        let one = attempt();
        sender
            .post(one, &receiver.location(), parcel(pattern(2000)))
            .unwrap();
        until("answer", || sent.conclusion_of(one).is_some());
    }
    let counters = receiver.counters();
    assert_eq!((counters.in_place, counters.copied_full), (3, 9));
}

#[test]
fn small_content_is_copied_and_holds_no_slot() {
    let domain = TestDomain::new();
    let (receiver, got) = domain.listening();
    let (sender, _) = domain.listening();
    sender
        .post(attempt(), &receiver.location(), parcel(pattern(10)))
        .unwrap();
    until("letter", || got.arrivals() == 1);
    assert_eq!(got.content(0), pattern(10));
    let counters = receiver.counters();
    assert_eq!((counters.copied_small, counters.borrowed), (1, 0));
}

#[test]
fn exceeding_the_capacity_is_an_error_and_not_a_signal() {
    let domain = TestDomain::new();
    let mut config = domain.config();
    config.capacity = 8 << 20;
    let (sender, sent) = domain.listening_with(config);
    let (receiver, _got) = domain.listening();
    let to = receiver.location();
    // The first letter to a process is sent after its mailbox has been opened.
    let one = attempt();
    sender.post(one, &to, parcel(pattern(9 << 20))).unwrap();
    until("conclusion", || sent.conclusion_of(one).is_some());
    match sent.conclusion_of(one) {
        Some(Conclusion::NotSent(error)) => assert_eq!(error.fault, TransportErrorKind::TooLarge),
        end => panic!("{end:?}"),
    }
    let refused = sender
        .post(attempt(), &to, parcel(pattern(9 << 20)))
        .unwrap_err();
    assert_eq!(refused.fault, TransportErrorKind::TooLarge);
    // The receiver keeps every letter, so each one takes new memory.
    let mut taken = 1;
    let refused = loop {
        match sender.post(attempt(), &to, parcel(pattern(1 << 20))) {
            Ok(()) => taken += 1,
            Err(e) => break e,
        }
        until("answer", || sent.conclusions() == taken);
        assert!(taken < 10);
    };
    assert!(taken > 2, "{taken}");
    assert_eq!(refused.fault, TransportErrorKind::NoRoom);
    assert!(refused.detail.contains("capacity"), "{refused}");
    sender.post(attempt(), &to, parcel(pattern(500))).unwrap();
    until("answer", || sent.conclusions() == taken + 1);
}

#[test]
fn content_outlives_both_transports() {
    let domain = TestDomain::new();
    let (receiver, got) = domain.listening();
    let (sender, _) = domain.listening();
    sender
        .post(attempt(), &receiver.location(), parcel(pattern(100_000)))
        .unwrap();
    until("letter", || got.arrivals() == 1);
    let content = got.content(0);
    got.arrived.lock().unwrap().clear();
    assert!(mapping_of(&content).path.is_some());
    sender.close();
    receiver.close();
    assert_eq!(content, pattern(100_000));
    drop((sender, receiver));
    let elsewhere = std::thread::spawn(move || content == pattern(100_000));
    assert!(elsewhere.join().unwrap());
    domain.until_removed();
}
