//! Opening, driving, rejoining and closing of an endpoint.

#![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

mod common;

use std::fs::File;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, mpsc};
use std::time::Duration;

use bytes::Bytes;
use common::{RecordingSink, TestDomain, attempt, open, parcel};
use fipa_testbed::until;
use fipa_transport::{Abandoned, Answer, Conclusion, Incarnation, Transport, TransportErrorKind};
use fipa_transport_shm::{ShmConfig, ShmError, ShmTransport, cleanup_dead};

#[test]
fn closing_removes_all_files() {
    let domain = TestDomain::new();
    let (one, sink) = domain.listening();
    let (other, got) = domain.listening();
    one.post(attempt(), &other.location(), parcel(vec![1; 9000].into()))
        .unwrap();
    until("answer", || sink.conclusions() == 1);
    assert!(!domain.files().is_empty());
    // Content that is held keeps its memory and files.
    got.arrived.lock().unwrap().clear();
    one.close();
    other.close();
    domain.until_removed();
    one.close();
}

#[test]
fn domains_are_isolated() {
    let (here, there) = (TestDomain::new(), TestDomain::new());
    let (one, _) = here.listening();
    let (other, _) = there.listening();
    let refused = one
        .post(attempt(), &other.location(), parcel(Bytes::new()))
        .unwrap_err();
    assert_eq!(refused.fault, TransportErrorKind::Unreachable);
}

#[test]
fn many_threads_drive_one_endpoint() {
    let domain = TestDomain::new();
    let (one, sink) = domain.listening();
    let (other, got) = domain.listening();
    let done = AtomicBool::new(false);
    let mut attempts = Vec::new();
    std::thread::scope(|scope| {
        for endpoint in [&one, &one, &other, &other] {
            scope.spawn(|| {
                while !done.load(Ordering::Relaxed) {
                    endpoint.drive();
                }
            });
        }
        for number in 0..2000 {
            let mut parcel = parcel(Bytes::new());
            parcel.sequence = number + 1;
            let attempt = attempt();
            // The window is full at times.
            until("room", || {
                one.post(attempt, &other.location(), parcel.clone()).is_ok()
            });
            attempts.push((attempt, parcel.sequence));
        }
        until("answers", || sink.conclusions() == 2000);
        done.store(true, Ordering::Relaxed);
    });
    let arrived = got.arrived.lock().unwrap();
    let sequence: Vec<u64> = arrived.iter().map(|(parcel, _)| parcel.sequence).collect();
    // A parcel that waited for memory may find no room afterwards.
    let is_taken = |attempt| match sink.conclusion_of(attempt) {
        Some(Conclusion::NotSent(error)) => {
            assert_eq!(error.fault, TransportErrorKind::Congested, "{error}");
            false
        }
        conclusion => {
            assert_eq!(conclusion, Some(Conclusion::Answered(Answer::Accepted)));
            true
        }
    };
    let taken = attempts
        .into_iter()
        .filter(|(attempt, _)| is_taken(*attempt));
    let taken: Vec<u64> = taken.map(|(_, sequence)| sequence).collect();
    assert_eq!(sequence, taken);
    assert!(taken.len() > 1900, "{} of 2000 parcels", taken.len());
}

#[test]
fn a_full_window_is_an_error() {
    let domain = TestDomain::new();
    let (sender, _) = domain.listening();
    // Does not listen, so it answers nothing.
    let receiver = domain.endpoint();
    let window = domain.config().window;
    for _ in 0..window {
        sender
            .post(attempt(), &receiver.location(), parcel(Bytes::new()))
            .unwrap();
    }
    let refused = sender.post(attempt(), &receiver.location(), parcel(Bytes::new()));
    assert_eq!(refused.unwrap_err().fault, TransportErrorKind::Congested);
}

#[test]
fn an_answered_parcel_takes_no_place_in_the_window_and_its_successor_no_loan() {
    let domain = TestDomain::new();
    let config = domain.config();
    let (sender, sink) = domain.listening();
    let (receiver, received) = domain.listening();
    let to = receiver.location();
    send_until_accepted((&sender, &sink), &receiver);
    let post = |content: &'static [u8]| {
        let sent = sender.post(attempt(), &to, parcel(Bytes::from_static(content)));
        sent.map_err(|error| error.fault)
    };
    let answered = |number: usize| {
        until("answers", || {
            sender.drive();
            sink.conclusions() == number
        });
    };
    // The short parcel is answered, and memory is taken for another one.
    let before = sink.conclusions();
    post(b"short").unwrap();
    answered(before + 1);
    let loans: Vec<_> = (0..config.max_loans)
        .map(|_| sender.loan(&to, 100, 100, 1).unwrap().unwrap())
        .collect();
    // One that is too long for that memory can be sent beside all loans, too.
    post(&[7; 10_000]).unwrap();
    answered(before + 2);
    post(b"short").unwrap();
    answered(before + 3);
    drop(loans);
    // The receiver waits within the first of these parcels.
    let stopped = received.arrived.lock().unwrap();
    for _ in 0..config.window {
        post(b"short").unwrap();
    }
    assert_eq!(post(b"short"), Err(TransportErrorKind::Congested));
    drop(stopped);
    answered(before + 3 + config.window);
    post(b"short").unwrap();
    answered(before + 4 + config.window);
}

#[test]
fn an_abandoned_parcel_does_not_hide_later_ones() {
    let domain = TestDomain::new();
    let (sender, sink) = domain.listening();
    // Does not listen yet, so it takes nothing.
    let receiver = domain.endpoint();
    open(&sender, &receiver.location());
    let post = || {
        let attempt = attempt();
        let sent = sender.post(attempt, &receiver.location(), parcel(Bytes::new()));
        sent.unwrap();
        attempt
    };
    let abandoned = [post(), post(), post()][1];
    assert_eq!(
        sender.abandon(abandoned, &receiver.location()),
        Abandoned::Unconfirmed
    );
    let got = Arc::new(RecordingSink::default());
    receiver.listen(got.clone()).unwrap();
    until("answers", || sink.conclusions() == 2);
    // Three parcels were announced and two taken.
    for number in 3..20 {
        post();
        until("answer", || {
            receiver.drive();
            sender.drive();
            sink.conclusions() == number
        });
    }
    assert_eq!(got.arrivals(), 19);
}

#[test]
fn peers_are_bounded_and_the_least_recently_used_is_closed() {
    let domain = TestDomain::new();
    let mut config = domain.config();
    config.max_peers = 2;
    let (sender, sink) = domain.listening_with(config);
    let receivers: Vec<_> = (0..4).map(|_| domain.listening()).collect();
    for (sent, (receiver, _)) in receivers.iter().chain(&receivers).enumerate() {
        // A peer is idle when the thread that has opened its mailbox has ended.
        until("an idle peer", || {
            let parcel = parcel(vec![3; 2000].into());
            match sender.post(attempt(), &receiver.location(), parcel) {
                Ok(()) => true,
                Err(error) => {
                    assert_eq!(error.fault, TransportErrorKind::Congested);
                    false
                }
            }
        });
        until("answer", || sink.conclusions() == sent + 1);
    }
    for (_, got) in &receivers {
        assert_eq!(got.arrivals(), 2);
        assert_eq!(got.content(0), vec![3; 2000]);
    }
}

#[test]
fn wrong_configurations_and_open_directories_are_refused() {
    let domain = TestDomain::new();
    let handle = domain.runtime.handle();
    let refused = |config: ShmConfig| ShmTransport::new(config, handle.clone()).unwrap_err();
    for prefix in ["", "with/slash", "ümlaut", &"x".repeat(65)] {
        let config = ShmConfig::new(domain.directory.path(), prefix, Incarnation::random());
        assert!(
            matches!(refused(config), ShmError::Configuration(_)),
            "{prefix}"
        );
    }
    let config = ShmConfig::new("relative", "fine", Incarnation::random());
    assert!(matches!(refused(config), ShmError::Configuration(_)));

    let open = domain.directory.path().join("open");
    std::fs::create_dir(&open).unwrap();
    std::fs::set_permissions(&open, std::fs::Permissions::from_mode(0o755)).unwrap();
    let config = ShmConfig::new(&open, &domain.prefix, Incarnation::random());
    assert!(matches!(refused(config), ShmError::NotPrivate { .. }));

    let outside = tempfile::tempdir().unwrap();
    let link = outside.path().join("link");
    let private = domain.directory.path().join("private");
    std::fs::create_dir(&private).unwrap();
    std::fs::set_permissions(&private, std::fs::Permissions::from_mode(0o700)).unwrap();
    std::os::unix::fs::symlink(&private, &link).unwrap();
    let config = ShmConfig::new(&link, &domain.prefix, Incarnation::random());
    assert!(matches!(refused(config), ShmError::NotPrivate { .. }));
    domain.until_removed();
}

#[test]
fn a_failed_open_neither_blocks_nor_affects_other_endpoints() {
    let domain = TestDomain::new();
    let config = domain.config();
    let (one, _) = domain.listening_with(config.clone());
    // Its files exist already.
    let again = ShmTransport::new(config, domain.runtime.handle().clone());
    assert!(matches!(again.unwrap_err(), ShmError::File { .. }));
    let (other, sink) = domain.listening();
    other
        .post(attempt(), &one.location(), parcel(Bytes::new()))
        .unwrap();
    until("answer", || sink.conclusions() == 1);
}

#[test]
fn a_stopped_lock_holder_blocks_neither_dispatch_nor_close() {
    let domain = TestDomain::new();
    let (one, _) = domain.listening();
    let (other, sink) = domain.listening();
    // Starting, ending and cleaning processes take this lock; this holder does not release it.
    let stopped = domain.locked();
    let (refused, unsent) = (attempt(), attempt());
    other
        .post(refused, &one.location(), parcel(Bytes::new()))
        .unwrap();
    until("conclusion", || sink.conclusion_of(refused).is_some());
    match sink.conclusion_of(refused) {
        Some(Conclusion::NotSent(error)) => {
            assert_eq!(error.fault, TransportErrorKind::Congested);
            assert!(error.detail.contains("stopped"), "{error}");
        }
        end => panic!("{end:?}"),
    }
    other
        .post(unsent, &one.location(), parcel(Bytes::new()))
        .unwrap();
    let (done, finished) = mpsc::channel();
    std::thread::spawn(move || {
        other.close();
        one.close();
        done.send(()).unwrap();
    });
    let watchdog = Duration::from_secs(60);
    finished.recv_timeout(watchdog).unwrap();
    let end = sink.conclusion_of(unsent);
    assert!(matches!(end, Some(Conclusion::NotSent(_))), "{end:?}");
    assert_eq!(sink.conclusions(), 2);
    // After the release, the next process removes what was left.
    drop(stopped);
    let (next, _) = domain.listening();
    next.close();
    domain.until_removed();
}

#[test]
fn parcels_that_wait_for_an_open_mailbox_are_bounded() {
    let domain = TestDomain::new();
    let mut config = domain.config();
    config.max_letter = 100_000;
    let (sender, sink) = domain.listening_with(config.clone());
    let (many, large) = (domain.listening(), domain.listening());
    let stopped = domain.locked();
    let post = |to: &ShmTransport, content: usize| {
        let parcel = parcel(vec![1; content].into());
        sender.post(attempt(), &to.location(), parcel)
    };
    for _ in 0..config.window {
        post(&many.0, 10).unwrap();
    }
    let refused = post(&many.0, 10).unwrap_err();
    assert_eq!(refused.fault, TransportErrorKind::Congested);
    post(&large.0, 60_000).unwrap();
    let refused = post(&large.0, 60_000).unwrap_err();
    assert_eq!(refused.fault, TransportErrorKind::Congested);
    post(&large.0, 10_000).unwrap();
    drop(stopped);
    until("conclusions", || sink.conclusions() == config.window + 2);
}

#[test]
fn parcels_that_wait_for_the_mailbox_of_a_process_that_ends_are_not_sent() {
    let domain = TestDomain::new();
    let (sender, sink) = domain.listening();
    let (receiver, got) = domain.listening();
    let stopped = domain.locked();
    let one = attempt();
    sender
        .post(one, &receiver.location(), parcel(Bytes::new()))
        .unwrap();
    receiver.close();
    until("conclusion", || sink.conclusion_of(one).is_some());
    let end = sink.conclusion_of(one);
    assert!(matches!(end, Some(Conclusion::NotSent(_))), "{end:?}");
    drop(stopped);
    assert_eq!((got.arrivals(), sink.conclusions()), (0, 1));
}

/// A large letter needs more memory, which one process of the domain allocates at a time.
#[test]
fn a_letter_that_needs_memory_waits_for_a_process_that_allocates_some() {
    let accepted = Some(Conclusion::Answered(Answer::Accepted));
    // The wait has a timeout, which passes on a busy machine.
    for _ in 0..20 {
        let domain = TestDomain::new();
        let (sender, sink) = domain.listening();
        let (receiver, got) = domain.listening();
        let post = |content: usize| {
            let (one, content) = (attempt(), vec![2; content].into());
            sender
                .post(one, &receiver.location(), parcel(content))
                .unwrap();
            one
        };
        let first = post(10);
        until("answer", || sink.conclusion_of(first).is_some());
        let allocating = domain.memory_locked();
        let (large, small) = (post(300_000), post(10));
        // Allocates no memory, so it is on the heap.
        assert!(sender.loan(&receiver.location(), 100, 400_000, 1).is_err());
        assert!(sender.loan_for_many(400_000).is_err());
        drop(allocating);
        until("answers", || sink.conclusions() == 3);
        if sink.conclusion_of(large) != accepted {
            continue;
        }
        assert_eq!(sink.conclusion_of(small), accepted);
        assert_eq!((got.content(1).len(), got.content(2).len()), (300_000, 10));
        return;
    }
    panic!("the letter was never sent");
}

/// A process that waits for the lock of a directory must not clean up in a new directory that
/// another process has created and locked in its place.
#[test]
fn a_waiter_for_a_removed_directorys_lock_does_not_clean_up_the_new_directory() {
    let domain = TestDomain::new();
    domain.endpoint().close();
    let config = domain.config();
    let root = config.root.clone();
    let previous = File::open(&root).unwrap();
    previous.lock().unwrap();
    let waiting = std::thread::spawn(move || cleanup_dead(&config));
    let is_open = |directory: &Path| {
        let open = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
        let open = open.filter_map(|file| std::fs::read_link(file.path()).ok());
        open.filter(|file| file == directory).count() == 2
    };
    until("the waiting process", || is_open(&root));
    // Another process starts and has created this directory so far.
    std::fs::remove_dir(&root).unwrap();
    std::fs::create_dir(&root).unwrap();
    let starting = File::open(&root).unwrap();
    starting.lock().unwrap();
    let nodes = root.join("nodes");
    std::fs::create_dir(&nodes).unwrap();
    drop(previous);
    until("the end of the wait", || {
        waiting.is_finished() || is_open(&root)
    });
    assert!(nodes.exists());
    drop(starting);
    waiting.join().unwrap().unwrap();
    // No process has joined.
    assert!(!nodes.exists());
}

/// Sends letters until one is accepted. Earlier ones fail if a process has not rejoined yet.
fn send_until_accepted(from: (&ShmTransport, &RecordingSink), to: &ShmTransport) {
    until("an accepted letter", || {
        let one = attempt();
        let content = Bytes::from(vec![3; 9000]);
        if from.0.post(one, &to.location(), parcel(content)).is_err() {
            return false;
        }
        until("conclusion", || from.1.conclusion_of(one).is_some());
        matches!(
            from.1.conclusion_of(one),
            Some(Conclusion::Answered(Answer::Accepted))
        )
    });
}

/// The files that closing removes are not missing: a program does not report its own end as the work
/// of another one.
#[test]
fn a_closed_transport_misses_no_files() {
    let domain = TestDomain::new();
    let (one, _sink) = domain.listening();
    one.close();
    until("the files are removed", || {
        let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
        let mut names = files.map(|file| file.file_name().to_string_lossy().into_owned());
        !names.any(|name| name.starts_with(&domain.prefix))
    });
    assert!(one.is_there() && !one.rejoin().unwrap());
}

/// Every user may create files in `/dev/shm`, also with the names that the domain had before.
#[test]
fn names_that_another_program_has_created_beforehand_are_not_needed() {
    let domain = TestDomain::new();
    let (one, _sink) = domain.listening();
    let in_shm = |file: &String| file.starts_with("/dev/shm");
    let names: Vec<String> = domain.files().into_iter().filter(in_shm).collect();
    assert!(!names.is_empty());
    one.close();
    domain.until_removed();
    // No process can open or remove directories as files, whatever its rights.
    for name in &names {
        std::fs::create_dir(name).unwrap();
    }
    let (two, two_sink) = domain.listening();
    let (three, three_sink) = domain.listening();
    send_until_accepted((&two, &two_sink), &three);
    // The content would keep the last files.
    three_sink.arrived.lock().unwrap().clear();
    two.close();
    three.close();
    for name in &names {
        std::fs::remove_dir(name).unwrap();
    }
    domain.until_removed();
}

#[test]
fn a_domain_whose_files_were_removed_is_joined_again() {
    let domain = TestDomain::new();
    let (one, one_sink) = domain.listening();
    let (two, two_sink) = domain.listening();
    send_until_accepted((&one, &one_sink), &two);
    let held = two_sink.content(0);
    assert!(one.is_there() && !one.rejoin().unwrap());
    for round in 0..3 {
        let root = domain.config().root;
        match round {
            0 => std::fs::remove_dir_all(&root).unwrap(),
            1 => std::fs::rename(&root, domain.directory.path().join("away")).unwrap(),
            // As at the end of a login session, by systemd's RemoveIPC.
            _ => {
                for file in std::fs::read_dir("/dev/shm").unwrap().flatten() {
                    if file
                        .file_name()
                        .to_string_lossy()
                        .starts_with(&domain.prefix)
                    {
                        std::fs::remove_file(file.path()).unwrap();
                    }
                }
            }
        }
        assert!(!one.is_there() && !two.is_there());
        assert!(one.rejoin().unwrap());
        // Before the second one rejoins, a third process starts and cleans up.
        let (three, three_sink) = domain.listening();
        send_until_accepted((&one, &one_sink), &three);
        assert!(two.rejoin().unwrap());
        assert!(one.is_there() && two.is_there());
        for (from, to) in [
            ((&*one, &*one_sink), &two),
            ((&two, &two_sink), &one),
            ((&three, &three_sink), &two),
            ((&two, &two_sink), &three),
        ] {
            send_until_accepted(from, to);
        }
        three.close();
    }
    assert_eq!(held[..], [3; 9000]);
    drop(held);
    for sink in [&one_sink, &two_sink] {
        sink.arrived.lock().unwrap().clear();
    }
    // The content was the last reference to earlier mailboxes.
    assert!(one.is_there() && two.is_there());
    assert!(!one.rejoin().unwrap() && !two.rejoin().unwrap());
    send_until_accepted((&one, &one_sink), &two);
    send_until_accepted((&two, &two_sink), &one);
    for sink in [&one_sink, &two_sink] {
        sink.arrived.lock().unwrap().clear();
    }
    one.close();
    two.close();
    assert!(!one.rejoin().unwrap(), "a closed transport stays closed");
    std::fs::remove_dir_all(domain.directory.path().join("away")).unwrap();
    domain.until_removed();
}

#[test]
fn a_process_whose_directory_was_removed_counts_as_alive() {
    let domain = TestDomain::new();
    let (one, _) = domain.listening();
    let (two, _) = domain.listening();
    let write_shared = || {
        let mut loan = one.loan_for_many(100_000).unwrap().unwrap();
        loan.content_mut().fill(5);
        loan.freeze()
    };
    // Leaves an idle segment, which is emptied after the end of its process.
    drop(write_shared());
    std::fs::remove_dir_all(domain.config().root).unwrap();
    let (three, _) = domain.listening();
    let cleaned = cleanup_dead(&domain.config()).unwrap();
    assert_eq!((cleaned.alive, cleaned.removed), (3, 0), "{cleaned:?}");
    // An emptied segment would cause a bus error here.
    assert_eq!(write_shared()[..], [5; 100_000]);
    for endpoint in [one, two, three] {
        endpoint.close();
    }
}
