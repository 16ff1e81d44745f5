//! An endpoint's life: opening, driving, closing.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on says so")]

mod common;

use std::fs::File;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc;
use std::time::Duration;

use bytes::Bytes;
use common::{Place, Told, attempt, parcel, wait_for};
use fipa_transport::{Answer, Conclusion, Incarnation, Transport, WayFault};
use fipa_transport_shm::{ShmConfig, ShmError, ShmTransport, cleanup_dead};

#[test]
fn nothing_is_left_behind() {
    let place = Place::new();
    let (one, told) = place.listening();
    let (other, got) = place.listening();
    one.dispatch(attempt(), &other.location(), parcel(vec![1; 9000].into()))
        .unwrap();
    wait_for("answer", || told.conclusions() == 1);
    assert!(!place.traces().is_empty());
    // Content that is held keeps what it lies in.
    got.arrived.lock().unwrap().clear();
    one.close();
    other.close();
    assert_eq!(place.traces(), Vec::<String>::new());
    one.close();
}

#[test]
fn domains_do_not_meet() {
    let (here, there) = (Place::new(), Place::new());
    let (one, _) = here.listening();
    let (other, _) = there.listening();
    let refused = one
        .dispatch(attempt(), &other.location(), parcel(Bytes::new()))
        .unwrap_err();
    assert_eq!(refused.fault, WayFault::Unreachable);
}

#[test]
fn many_threads_drive_one_endpoint() {
    let place = Place::new();
    let (one, told) = place.listening();
    let (other, got) = place.listening();
    let done = AtomicBool::new(false);
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
            // Full at times.
            wait_for("room", || {
                one.dispatch(attempt(), &other.location(), parcel.clone())
                    .is_ok()
            });
        }
        wait_for("answers", || told.conclusions() == 2000);
        done.store(true, Ordering::Relaxed);
    });
    let arrived = got.arrived.lock().unwrap();
    let sequence: Vec<u64> = arrived.iter().map(|(parcel, _)| parcel.sequence).collect();
    assert_eq!(sequence, (1..=2000).collect::<Vec<u64>>());
}

#[test]
fn a_full_window_is_an_error() {
    let place = Place::new();
    let (sender, _) = place.listening();
    // Not listening, so it answers nothing.
    let receiver = place.endpoint();
    let window = place.config().window;
    for _ in 0..window {
        sender
            .dispatch(attempt(), &receiver.location(), parcel(Bytes::new()))
            .unwrap();
    }
    let refused = sender.dispatch(attempt(), &receiver.location(), parcel(Bytes::new()));
    assert_eq!(refused.unwrap_err().fault, WayFault::Congested);
}

#[test]
fn peers_are_bounded_and_the_oldest_forgotten() {
    let place = Place::new();
    let mut config = place.config();
    config.max_peers = 2;
    let (sender, told) = place.listening_with(config);
    let receivers: Vec<_> = (0..4).map(|_| place.listening()).collect();
    for (sent, (receiver, _)) in receivers.iter().chain(&receivers).enumerate() {
        sender
            .dispatch(
                attempt(),
                &receiver.location(),
                parcel(vec![3; 2000].into()),
            )
            .unwrap();
        wait_for("answer", || told.conclusions() == sent + 1);
    }
    for (_, got) in &receivers {
        assert_eq!(got.arrivals(), 2);
        assert_eq!(got.content(0), vec![3; 2000]);
    }
}

#[test]
fn wrong_configurations_and_open_directories_are_refused() {
    let place = Place::new();
    let handle = place.runtime.handle();
    let refused = |config: ShmConfig| ShmTransport::new(config, handle.clone()).unwrap_err();
    for prefix in ["", "with/slash", "ümlaut", &"x".repeat(65)] {
        let config = ShmConfig::new(place.directory.path(), prefix, Incarnation::random());
        assert!(
            matches!(refused(config), ShmError::Configuration(_)),
            "{prefix}"
        );
    }
    let config = ShmConfig::new("relative", "fine", Incarnation::random());
    assert!(matches!(refused(config), ShmError::Configuration(_)));

    let open = place.directory.path().join("open");
    std::fs::create_dir(&open).unwrap();
    std::fs::set_permissions(&open, std::fs::Permissions::from_mode(0o755)).unwrap();
    let config = ShmConfig::new(&open, &place.prefix, Incarnation::random());
    assert!(matches!(refused(config), ShmError::NotPrivate { .. }));

    let outside = tempfile::tempdir().unwrap();
    let link = outside.path().join("link");
    let private = place.directory.path().join("private");
    std::fs::create_dir(&private).unwrap();
    std::fs::set_permissions(&private, std::fs::Permissions::from_mode(0o700)).unwrap();
    std::os::unix::fs::symlink(&private, &link).unwrap();
    let config = ShmConfig::new(&link, &place.prefix, Incarnation::random());
    assert!(matches!(refused(config), ShmError::NotPrivate { .. }));
    assert_eq!(place.traces(), Vec::<String>::new());
}

#[test]
fn what_cannot_be_opened_waits_for_nobody_and_harms_nobody() {
    let place = Place::new();
    let config = place.config();
    let (one, _) = place.listening_with(config.clone());
    // Its files are there already.
    let again = ShmTransport::new(config, place.runtime.handle().clone());
    assert!(matches!(again.unwrap_err(), ShmError::File { .. }));
    let (other, told) = place.listening();
    other
        .dispatch(attempt(), &one.location(), parcel(Bytes::new()))
        .unwrap();
    wait_for("answer", || told.conclusions() == 1);
}

#[test]
fn who_has_the_lock_and_was_stopped_holds_up_neither_letters_nor_the_end() {
    let place = Place::new();
    let (one, _) = place.listening();
    let (other, told) = place.listening();
    let root = place.directory.path().join("domain");
    // What processes do when they start, end or clean up; but this one does not go on.
    let stopped = File::open(&root).unwrap();
    stopped.lock().unwrap();
    let (done, finished) = mpsc::channel();
    let refused = std::thread::spawn(move || {
        let refused = other.dispatch(attempt(), &one.location(), parcel(Bytes::new()));
        other.close();
        one.close();
        done.send(()).unwrap();
        refused
    });
    let watchdog = Duration::from_secs(60);
    finished.recv_timeout(watchdog).unwrap();
    let refused = refused.join().unwrap().unwrap_err();
    assert_eq!(refused.fault, WayFault::Congested);
    assert!(refused.detail.contains("stopped"), "{refused}");
    assert_eq!(told.conclusions(), 0);
    // It goes on, and whoever comes next removes what was left.
    drop(stopped);
    let (next, _) = place.listening();
    next.close();
    assert_eq!(place.traces(), Vec::<String>::new());
}

/// Whoever waits for the lock of a directory that is removed meanwhile must not clean up in the one
/// that somebody else has made, and locked, in its place.
#[test]
fn who_waited_too_long_does_not_clean_up_after_those_who_start_anew() {
    let place = Place::new();
    place.endpoint().close();
    let config = place.config();
    let root = config.root.clone();
    let leaving = File::open(&root).unwrap();
    leaving.lock().unwrap();
    let waiting = std::thread::spawn(move || cleanup_dead(&config));
    let is_open = |directory: &Path| {
        let open = std::fs::read_dir("/proc/self/fd").unwrap().flatten();
        let open = open.filter_map(|file| std::fs::read_link(file.path()).ok());
        open.filter(|file| file == directory).count() == 2
    };
    wait_for("whoever waits", || is_open(&root));
    // Somebody starts anew, and has come as far as making this.
    std::fs::remove_dir(&root).unwrap();
    std::fs::create_dir(&root).unwrap();
    let starting = File::open(&root).unwrap();
    starting.lock().unwrap();
    let nodes = root.join("nodes");
    std::fs::create_dir(&nodes).unwrap();
    drop(leaving);
    wait_for("whoever waited", || waiting.is_finished() || is_open(&root));
    assert!(nodes.exists());
    drop(starting);
    waiting.join().unwrap().unwrap();
    // Nobody came.
    assert!(!nodes.exists());
}

/// Sends a letter until it was taken: those before fail, as others may not have joined again.
fn until_answered(from: (&ShmTransport, &Told), to: &ShmTransport) {
    wait_for("letter that is taken", || {
        let one = attempt();
        let content = Bytes::from(vec![3; 9000]);
        if from
            .0
            .dispatch(one, &to.location(), parcel(content))
            .is_err()
        {
            return false;
        }
        wait_for("conclusion", || from.1.conclusion_of(one).is_some());
        matches!(
            from.1.conclusion_of(one),
            Some(Conclusion::Answered(Answer::Accepted))
        )
    });
}

#[test]
fn a_domain_whose_files_were_removed_is_joined_again() {
    let place = Place::new();
    let (one, one_told) = place.listening();
    let (two, two_told) = place.listening();
    until_answered((&one, &one_told), &two);
    let held = two_told.content(0);
    assert!(one.is_there() && !one.rejoin().unwrap());
    for round in 0..3 {
        let root = place.config().root;
        match round {
            0 => std::fs::remove_dir_all(&root).unwrap(),
            1 => std::fs::rename(&root, place.directory.path().join("away")).unwrap(),
            // As at the end of a login session, by systemd's RemoveIPC.
            _ => {
                for file in std::fs::read_dir("/dev/shm").unwrap().flatten() {
                    if file
                        .file_name()
                        .to_string_lossy()
                        .starts_with(&place.prefix)
                    {
                        std::fs::remove_file(file.path()).unwrap();
                    }
                }
            }
        }
        assert!(!one.is_there() && !two.is_there());
        assert!(one.rejoin().unwrap());
        // Between the two, a third process starts, and cleans up.
        let (three, three_told) = place.listening();
        until_answered((&one, &one_told), &three);
        assert!(two.rejoin().unwrap());
        assert!(one.is_there() && two.is_there());
        for (from, to) in [
            ((&*one, &*one_told), &two),
            ((&two, &two_told), &one),
            ((&three, &three_told), &two),
            ((&two, &two_told), &three),
        ] {
            until_answered(from, to);
        }
        three.close();
    }
    assert_eq!(held[..], [3; 9000]);
    drop(held);
    for told in [&one_told, &two_told] {
        told.arrived.lock().unwrap().clear();
    }
    // With the last content of a mailbox before, iceoryx2 removes the file of the present one.
    for endpoint in [&one, &two] {
        let needed = !endpoint.is_there();
        assert_eq!(endpoint.rejoin().unwrap(), needed);
        assert!(endpoint.is_there());
    }
    until_answered((&one, &one_told), &two);
    until_answered((&two, &two_told), &one);
    for told in [&one_told, &two_told] {
        told.arrived.lock().unwrap().clear();
    }
    one.close();
    two.close();
    assert!(!one.rejoin().unwrap(), "a closed one stays so");
    std::fs::remove_dir_all(place.directory.path().join("away")).unwrap();
    assert_eq!(place.traces(), Vec::<String>::new());
}

#[test]
fn a_process_whose_directory_was_removed_is_not_taken_for_dead() {
    let place = Place::new();
    let (one, _) = place.listening();
    let (two, _) = place.listening();
    let write_for_many = || {
        let mut loan = one.loan_for_many(100_000).unwrap().unwrap();
        loan.content_mut().fill(5);
        loan.freeze()
    };
    // Leaves a segment that is not in use, which is emptied after the end of its process.
    drop(write_for_many());
    std::fs::remove_dir_all(place.config().root).unwrap();
    let (three, _) = place.listening();
    let cleaned = cleanup_dead(&place.config()).unwrap();
    assert_eq!((cleaned.alive, cleaned.removed), (3, 0), "{cleaned:?}");
    // A bus error, if the segment was emptied.
    assert_eq!(write_for_many()[..], [5; 100_000]);
    for endpoint in [one, two, three] {
        endpoint.close();
    }
}
