//! Content for several receivers: stored once, released after use, and removed at the end.

#![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

mod common;

use std::sync::{Arc, Barrier};

use bytes::Bytes;
use common::{FRONT, RecordingSink, TestDomain, attempt, open, parcel};
use fipa_testbed::until;
use fipa_transport::{Answer, Conclusion, Transport, TransportErrorKind};
use fipa_transport_shm::ShmTransport;

/// Content for several receivers, with every byte set to `with`.
fn content(of: &ShmTransport, len: usize, with: u8) -> Bytes {
    let mut loan = of
        .loan_for_many(len)
        .unwrap()
        .expect("long enough for a segment");
    loan.content_mut().fill(with);
    loan.freeze()
}

/// Number of segments of this domain, and number of blocks that they use.
fn segments(domain: &TestDomain) -> (usize, u64) {
    let files = domain.files().into_iter();
    let files: Vec<_> = files.filter(|file| file.ends_with(".content")).collect();
    let blocks = files.iter().map(|file| {
        let found = std::fs::metadata(file);
        found.map_or(0, |found| std::os::unix::fs::MetadataExt::blocks(&found))
    });
    (files.len(), blocks.sum())
}

fn send(from: &ShmTransport, sink: &RecordingSink, to: &ShmTransport, content: &Bytes) {
    let one = attempt();
    from.post(one, &to.location(), parcel(content.clone()))
        .unwrap();
    until("answer", || sink.conclusion_of(one).is_some());
    let accepted = Some(Conclusion::Answered(Answer::Accepted));
    assert_eq!(sink.conclusion_of(one), accepted);
}

#[test]
fn one_megabyte_for_32_receivers_is_stored_once() {
    let domain = TestDomain::new();
    let (sender, sink) = domain.listening();
    let receivers: Vec<_> = (0..32).map(|_| domain.listening()).collect();
    for (receiver, _) in &receivers {
        send(&sender, &sink, receiver, &Bytes::new());
    }
    let used = || fipa_transport_shm::inspect(&domain.config()).unwrap().used;
    let before = used();
    let large = content(&sender, 1 << 20, 9);
    for (receiver, _) in &receivers {
        send(&sender, &sink, receiver, &large);
    }
    for (_, got) in &receivers {
        assert_eq!(got.content(1), vec![9; 1 << 20]);
    }
    let grown = used() - before;
    assert!((1 << 20..3 << 19).contains(&grown), "grown by {grown}");
    assert_eq!(segments(&domain).0, 1);
    assert_eq!(sender.counters().referring, 32);
    for (receiver, _) in &receivers {
        assert_eq!(receiver.counters().in_place, 1);
        assert_eq!(receiver.counters().copied_full, 0);
    }
}

#[test]
fn new_content_does_not_wait_for_readers_and_reuses_unread_segments() {
    let domain = TestDomain::new();
    let (sender, sink) = domain.listening();
    let (receiver, got) = domain.listening();
    for round in 0..64 {
        send(&sender, &sink, &receiver, &content(&sender, 100_000, round));
    }
    assert_eq!(segments(&domain).0, 64);
    // The receiver holds the maximum number of contents.
    let refused = sender
        .loan_for_many(100_000)
        .err()
        .expect("the limit is reached");
    assert_eq!(refused.fault, TransportErrorKind::Congested, "{refused}");
    // Content outside of a segment is copied.
    let copied = Bytes::from(vec![64; 100_000]);
    assert!(sender.copies_for_each(&copied));
    send(&sender, &sink, &receiver, &copied);
    for round in 0..65_u8 {
        assert_eq!(got.content(usize::from(round)), vec![round; 100_000]);
    }
    got.arrived.lock().unwrap().remove(3);
    let next = content(&sender, 90_000, 77);
    send(&sender, &sink, &receiver, &next);
    assert_eq!(segments(&domain).0, 64);
    assert_eq!(got.content(64), vec![77; 90_000]);
    // Short content is not put into a segment.
    assert!(sender.loan_for_many(100).unwrap().is_none());
    assert!(!sender.copies_for_each(&Bytes::from(vec![1; 100])));
    assert!(!sender.copies_for_each(&next));
}

#[test]
fn large_content_is_released_when_the_last_reader_stops() {
    let domain = TestDomain::new();
    let mut config = domain.config();
    config.capacity = 64 << 20;
    let (sender, sink) = domain.listening_with(config);
    let (receiver, got) = domain.listening();
    let large = content(&sender, 8 << 20, 5);
    send(&sender, &sink, &receiver, &large);
    drop(large);
    // Still read, and counted.
    let (files, blocks) = segments(&domain);
    assert_eq!(files, 1);
    assert!(blocks * 512 >= 8 << 20);
    assert_eq!(got.content(0), vec![5; 8 << 20]);
    got.arrived.lock().unwrap().clear();
    until("room", || segments(&domain) == (0, 0));
    // A shorter segment stays for the next content.
    send(&sender, &sink, &receiver, &content(&sender, 100_000, 1));
    got.arrived.lock().unwrap().clear();
    send(&sender, &sink, &receiver, &content(&sender, 100_000, 2));
    assert_eq!(segments(&domain).0, 1);
}

#[test]
fn exceeding_the_capacity_with_shared_content_is_an_error() {
    let domain = TestDomain::new();
    let mut config = domain.config();
    config.capacity = 8 << 20;
    let (sender, sink) = domain.listening_with(config);
    let (receiver, got) = domain.listening();
    let refused = |len| sender.loan_for_many(len).err().expect("memory is short");
    assert_eq!(refused(9 << 20).fault, TransportErrorKind::TooLarge);
    let held = content(&sender, 5 << 20, 1);
    let error = refused(4 << 20);
    assert_eq!(error.fault, TransportErrorKind::NoRoom);
    assert!(error.detail.contains("capacity"), "{error}");
    // An idle segment is released to make room.
    drop(held);
    let other = content(&sender, 6 << 20, 2);
    send(&sender, &sink, &receiver, &other);
    assert_eq!(got.content(0), vec![2; 6 << 20]);
}

#[test]
fn concurrent_allocations_stay_within_the_capacity() {
    let domain = TestDomain::new();
    let mut config = domain.config();
    config.capacity = 12 << 20;
    let (receiver, _got) = domain.listening();
    let senders: Vec<Arc<ShmTransport>> = (0..6)
        .map(|_| {
            config.incarnation = domain.config().incarnation;
            domain.listening_with(config.clone()).0
        })
        .collect();
    // Connect first, because connections use memory, too.
    let to = receiver.location();
    for sender in &senders {
        open(sender, &to);
    }
    let barrier = Barrier::new(senders.len());
    let loans = std::thread::scope(|scope| {
        let takers: Vec<_> = senders
            .iter()
            .map(|sender| {
                scope.spawn(|| {
                    barrier.wait();
                    let loans = (0..4).map(|_| {
                        let one = sender.loan(&to, FRONT, 2 << 20, 1).ok().flatten();
                        let many = sender.loan_for_many(1 << 20).ok().flatten();
                        (one, many)
                    });
                    loans.collect::<Vec<_>>()
                })
            })
            .collect();
        let taken = takers.into_iter().flat_map(|taker| taker.join().unwrap());
        taken.collect::<Vec<_>>()
    });
    let given = loans.iter().flat_map(|(one, many)| [one, many]).flatten();
    let given = given.count();
    assert!((4..loans.len()).contains(&given), "{given} loans");
    let used = fipa_transport_shm::inspect(&config).unwrap().used;
    assert!(used <= config.capacity, "{used} of {}", config.capacity);
}

#[test]
fn shared_content_outlives_both_transports() {
    let domain = TestDomain::new();
    let (sender, sink) = domain.listening();
    let (receiver, got) = domain.listening();
    let own = content(&sender, 100_000, 3);
    send(&sender, &sink, &receiver, &own);
    let received = got.content(0);
    got.arrived.lock().unwrap().clear();
    sender.close();
    receiver.close();
    assert!(sender.loan_for_many(100_000).is_err());
    drop((sender, receiver));
    // A cleanup of dead processes does not touch it.
    fipa_transport_shm::cleanup_dead(&domain.config()).unwrap();
    assert_eq!(own, vec![3; 100_000]);
    drop(own);
    assert_eq!(received, vec![3; 100_000]);
    drop(received);
    assert_eq!(domain.files(), Vec::<String>::new());
}
