//! Content for several receivers: once in memory, given back, and left behind by nobody.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on says so")]

mod common;

use std::sync::{Arc, Barrier};

use bytes::Bytes;
use common::{FRONT, Place, Told, attempt, parcel, wait_for};
use fipa_transport::{Answer, Conclusion, Transport, WayFault};
use fipa_transport_shm::ShmTransport;

/// Content for many, every byte of it `with`.
fn content(of: &ShmTransport, len: usize, with: u8) -> Bytes {
    let mut loan = of.loan_for_many(len).unwrap().expect("long enough");
    loan.content_mut().fill(with);
    loan.freeze()
}

/// The segments of this place, and the blocks that they take.
fn segments(place: &Place) -> (usize, u64) {
    let files = place.traces().into_iter();
    let files: Vec<_> = files.filter(|file| file.ends_with(".content")).collect();
    let blocks = files.iter().map(|file| {
        let found = std::fs::metadata(file);
        found.map_or(0, |found| std::os::unix::fs::MetadataExt::blocks(&found))
    });
    (files.len(), blocks.sum())
}

fn send(from: &ShmTransport, told: &Told, to: &ShmTransport, content: &Bytes) {
    let one = attempt();
    from.dispatch(one, &to.location(), parcel(content.clone()))
        .unwrap();
    wait_for("answer", || told.conclusion_of(one).is_some());
    let accepted = Some(Conclusion::Answered(Answer::Accepted));
    assert_eq!(told.conclusion_of(one), accepted);
}

#[test]
fn one_megabyte_for_32_receivers_is_there_once() {
    let place = Place::new();
    let (sender, told) = place.listening();
    let receivers: Vec<_> = (0..32).map(|_| place.listening()).collect();
    for (receiver, _) in &receivers {
        send(&sender, &told, receiver, &Bytes::new());
    }
    let used = || fipa_transport_shm::inspect(&place.config()).unwrap().used;
    let before = used();
    let large = content(&sender, 1 << 20, 9);
    for (receiver, _) in &receivers {
        send(&sender, &told, receiver, &large);
    }
    for (_, got) in &receivers {
        assert_eq!(got.content(1), vec![9; 1 << 20]);
    }
    let grown = used() - before;
    assert!((1 << 20..3 << 19).contains(&grown), "grown by {grown}");
    assert_eq!(segments(&place).0, 1);
    assert_eq!(sender.counters().referring, 32);
    for (receiver, _) in &receivers {
        assert_eq!(receiver.counters().in_place, 1);
        assert_eq!(receiver.counters().copied_full, 0);
    }
}

#[test]
fn the_next_content_waits_for_no_reader_and_takes_the_place_of_what_nobody_reads() {
    let place = Place::new();
    let (sender, told) = place.listening();
    let (receiver, got) = place.listening();
    for round in 0..8 {
        send(&sender, &told, &receiver, &content(&sender, 100_000, round));
    }
    assert_eq!(segments(&place).0, 8);
    // The receiver holds all that there may be.
    let refused = sender.loan_for_many(100_000).err().expect("no more");
    assert_eq!(refused.fault, WayFault::Congested, "{refused}");
    // What is sent then is copied.
    let copied = Bytes::from(vec![8; 100_000]);
    assert!(sender.copies_for_each(&copied));
    send(&sender, &told, &receiver, &copied);
    for round in 0..9_u8 {
        assert_eq!(got.content(usize::from(round)), vec![round; 100_000]);
    }
    got.arrived.lock().unwrap().remove(3);
    let next = content(&sender, 90_000, 77);
    send(&sender, &told, &receiver, &next);
    assert_eq!(segments(&place).0, 8);
    assert_eq!(got.content(8), vec![77; 90_000]);
    // Shorter contents are not worth it, and others are their own.
    assert!(sender.loan_for_many(100).unwrap().is_none());
    assert!(!sender.copies_for_each(&Bytes::from(vec![1; 100])));
    assert!(!sender.copies_for_each(&next));
}

#[test]
fn large_content_is_given_back_when_the_last_reader_stops() {
    let place = Place::new();
    let mut config = place.config();
    config.capacity = 64 << 20;
    let (sender, told) = place.listening_with(config);
    let (receiver, got) = place.listening();
    let large = content(&sender, 8 << 20, 5);
    send(&sender, &told, &receiver, &large);
    drop(large);
    // Still read, and accounted for.
    let (files, blocks) = segments(&place);
    assert_eq!(files, 1);
    assert!(blocks * 512 >= 8 << 20);
    assert_eq!(got.content(0), vec![5; 8 << 20]);
    got.arrived.lock().unwrap().clear();
    wait_for("room", || segments(&place) == (0, 0));
    // What is not as large stays for the next one.
    send(&sender, &told, &receiver, &content(&sender, 100_000, 1));
    got.arrived.lock().unwrap().clear();
    send(&sender, &told, &receiver, &content(&sender, 100_000, 2));
    assert_eq!(segments(&place).0, 1);
}

#[test]
fn capacity_is_an_error_for_many_too() {
    let place = Place::new();
    let mut config = place.config();
    config.capacity = 8 << 20;
    let (sender, told) = place.listening_with(config);
    let (receiver, got) = place.listening();
    let refused = |len| sender.loan_for_many(len).err().expect("no room");
    assert_eq!(refused(9 << 20).fault, WayFault::TooLarge);
    let held = content(&sender, 5 << 20, 1);
    let error = refused(4 << 20);
    assert_eq!(error.fault, WayFault::Congested);
    assert!(error.detail.contains("capacity"), "{error}");
    // What lies idle makes room.
    drop(held);
    let other = content(&sender, 6 << 20, 2);
    send(&sender, &told, &receiver, &other);
    assert_eq!(got.content(0), vec![2; 6 << 20]);
}

#[test]
fn who_takes_memory_at_the_same_time_stays_within_the_capacity() {
    let place = Place::new();
    let mut config = place.config();
    config.capacity = 12 << 20;
    let (receiver, _got) = place.listening();
    let senders: Vec<Arc<ShmTransport>> = (0..6)
        .map(|_| {
            config.incarnation = place.config().incarnation;
            place.listening_with(config.clone()).0
        })
        .collect();
    // Connections first, which take memory too.
    let to = receiver.location();
    for sender in &senders {
        drop(sender.loan(&to, FRONT, 100, 1).unwrap());
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
fn content_for_many_outlives_both_transports() {
    let place = Place::new();
    let (sender, told) = place.listening();
    let (receiver, got) = place.listening();
    let own = content(&sender, 100_000, 3);
    send(&sender, &told, &receiver, &own);
    let received = got.content(0);
    got.arrived.lock().unwrap().clear();
    sender.close();
    receiver.close();
    assert!(sender.loan_for_many(100_000).is_err());
    drop((sender, receiver));
    // Whoever looks for what the dead have left leaves it alone.
    fipa_transport_shm::cleanup_dead(&place.config()).unwrap();
    assert_eq!(own, vec![3; 100_000]);
    drop(own);
    assert_eq!(received, vec![3; 100_000]);
    drop(received);
    assert_eq!(place.traces(), Vec::<String>::new());
}
