//! Several processes, some of which are killed. Every test starts its own from this binary.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on says so")]
#![allow(
    clippy::print_stdout,
    reason = "processes tell each other what they see"
)]

mod common;

use std::io::{BufRead, BufReader};
use std::os::fd::AsRawFd;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use bytes::Bytes;
use common::{Place, attempt, location_of, parcel, wait_for};
use fipa_transport::{Answer, Conclusion, Incarnation, Transport, WayFault};
use fipa_transport_shm::{ShmConfig, ShmTransport, cleanup_dead};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

const ROLE: &str = "FIPA_SHM_TEST_ROLE";

/// A process of its own, killed in the end.
struct Process {
    child: Child,
    incarnation: Incarnation,
}

impl Process {
    /// Roles: `receive` what comes and keep it, or `drop` it; `tell` where its content lies, besides; `send` to
    /// a process without end, or `many`, which is content for many; `clean` up, and end.
    fn start(place: &Place, role: &str, to: Incarnation) -> Self {
        let config = place.config();
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "--nocapture"])
            .arg("a_process_of_its_own")
            .env(
                ROLE,
                format!(
                    "{role} {} {} {} {to}",
                    config.root.display(),
                    config.prefix,
                    config.incarnation
                ),
            )
            .stdout(match role {
                "tell" => Stdio::piped(),
                _ => Stdio::null(),
            })
            .spawn()
            .unwrap();
        Self {
            child,
            incarnation: config.incarnation,
        }
    }

    fn signal(&self, signal: &str) {
        let pid = self.child.id().to_string();
        let done = Command::new("kill").args([signal, &pid]).status().unwrap();
        assert!(done.success());
    }

    /// SIGKILL.
    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Waits until it can be reached.
    fn wait_until_up(&self, from: &ShmTransport) {
        let to = location_of(self.incarnation);
        wait_for("process", || {
            from.dispatch(attempt(), &to, parcel(Bytes::new())).is_ok()
        });
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Killed already, or not.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
#[ignore = "started by the other tests"]
fn a_process_of_its_own() {
    let role = std::env::var(ROLE).expect("started by another test");
    let mut words = role.split(' ');
    let mut word = || words.next().unwrap();
    let role = word();
    let config = ShmConfig::new(word(), word(), word().parse().unwrap());
    let to = location_of(word().parse().unwrap());
    if role == "clean" {
        return clean_without_descriptors(&config);
    }
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let endpoint = ShmTransport::new(config, runtime.handle().clone()).unwrap();
    let told = Arc::new(common::Told::default());
    endpoint.listen(told.clone()).unwrap();
    let content = Bytes::from(vec![7; 5000]);
    let mut seen = 0;
    loop {
        match role {
            "receive" => std::thread::park(),
            "drop" => {
                told.arrived.lock().unwrap().clear();
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            "tell" => {
                wait_for_ever(|| told.arrivals() > seen);
                let content = told.content(seen);
                seen += 1;
                if !content.is_empty() {
                    let sum: u64 = content.iter().map(|byte| u64::from(*byte)).sum();
                    println!("\nLIES {} {} {sum}", lies(&content), content.len());
                }
            }
            "many" => {
                // All are held or read already.
                let Ok(Some(mut loan)) = endpoint.loan_for_many(100_000) else {
                    std::thread::yield_now();
                    continue;
                };
                loan.content_mut().fill(7);
                let _ = endpoint.dispatch(attempt(), &to, parcel(loan.freeze()));
            }
            _ => {
                // Full, or gone.
                if endpoint
                    .dispatch(attempt(), &to, parcel(content.clone()))
                    .is_err()
                {
                    std::thread::yield_now();
                }
            }
        }
    }
}

fn wait_for_ever(condition: impl Fn() -> bool) {
    while !condition() {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
}

/// Where content lies: device and number of the file, and the place in it.
fn lies(content: &[u8]) -> String {
    let address = content.as_ptr() as usize;
    let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
    let place = maps.lines().find_map(|line| {
        let mut fields = line.split_whitespace();
        let (start, end) = fields.next()?.split_once('-')?;
        let start = usize::from_str_radix(start, 16).ok()?;
        let end = usize::from_str_radix(end, 16).ok()?;
        let offset = usize::from_str_radix(fields.nth(1)?, 16).ok()?;
        let (device, inode) = (fields.next()?, fields.next()?);
        let here = (start..end).contains(&address) && address + content.len() <= end;
        here.then(|| format!("{device} {inode} {}", address - start + offset))
    });
    place.unwrap()
}

#[test]
fn receivers_in_two_processes_read_the_same_memory() {
    let place = Place::new();
    let (sender, sent) = place.listening();
    let nobody = Incarnation::from_u64(1);
    let mut receivers = [(); 2].map(|()| Process::start(&place, "tell", nobody));
    for receiver in &receivers {
        receiver.wait_until_up(&sender);
    }
    let mut loan = sender.loan_for_many(1 << 20).unwrap().unwrap();
    let bytes = loan.content_mut().iter_mut();
    bytes
        .enumerate()
        .for_each(|(at, byte)| *byte = (at % 251) as u8);
    let content = loan.freeze();
    let sum: u64 = content.iter().map(|byte| u64::from(*byte)).sum();
    let expected = format!("LIES {} {} {sum}", lies(&content), content.len());
    for receiver in &mut receivers {
        let to = location_of(receiver.incarnation);
        let one = attempt();
        sender.dispatch(one, &to, parcel(content.clone())).unwrap();
        wait_for("answer", || sent.conclusion_of(one).is_some());
        let lines = BufReader::new(receiver.child.stdout.take().unwrap()).lines();
        let mut lines = lines.map_while(Result::ok);
        let told = lines.find(|line| line.starts_with("LIES"));
        assert_eq!(told, Some(expected.clone()));
    }
    assert_eq!(sender.counters().referring, 2);
    // Killed while they hold it, they do not keep it from being used again.
    for receiver in &mut receivers {
        receiver.kill();
    }
    let before = lies(&content);
    drop(content);
    let again = sender.loan_for_many(1 << 20).unwrap().unwrap().freeze();
    assert_eq!(lies(&again), before);
}

#[test]
fn content_for_many_of_a_killed_sender_stays_as_long_as_it_is_read() {
    let place = Place::new();
    let (receiver, got) = place.listening();
    let own = receiver.location().incarnation();
    let mut sender = Process::start(&place, "many", own);
    wait_for("letters", || got.arrivals() >= 8);
    sender.kill();
    wait_for("notice", || receiver.counters().peers_gone == 1);
    let dead = sender.incarnation.to_string();
    wait_for("removal", || {
        !place.traces().iter().any(|file| file.contains(&dead))
    });
    for number in 0..got.arrivals() {
        assert!(got.content(number).iter().all(|byte| *byte == 7));
    }
    got.arrived.lock().unwrap().clear();
    assert_eq!(receiver.counters().borrowed, 0);
    wait_for("the end of the mapping", || {
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        !maps.contains(&format!("{dead}."))
    });
    receiver.close();
    assert_eq!(place.traces(), Vec::<String>::new());
}

#[test]
fn a_killed_receiver_leaves_no_attempt_open() {
    let place = Place::new();
    let (sender, sent) = place.listening();
    let mut receiver = Process::start(&place, "receive", Incarnation::from_u64(1));
    receiver.wait_until_up(&sender);
    wait_for("answer", || sent.conclusions() == 1);
    let to = location_of(receiver.incarnation);

    receiver.signal("-STOP");
    let attempts: Vec<_> = (0..5).map(|_| attempt()).collect();
    for one in &attempts {
        sender
            .dispatch(*one, &to, parcel(vec![1; 3000].into()))
            .unwrap();
    }
    receiver.kill();
    wait_for("conclusions", || sent.conclusions() == 6);
    for one in &attempts {
        match sent.conclusion_of(*one) {
            Some(Conclusion::Unconfirmed(e)) => assert_eq!(e.fault, WayFault::Broken),
            other => panic!("{other:?}"),
        }
    }
    let refused = sender
        .dispatch(attempt(), &to, parcel(Bytes::new()))
        .unwrap_err();
    assert_eq!(refused.fault, WayFault::Unreachable);
    assert_eq!(sender.counters().peers_gone, 1);
    // The survivor removes what the dead one left, while it lives itself.
    let dead = receiver.incarnation.to_string();
    wait_for("removal", || {
        !place.traces().iter().any(|file| file.contains(&dead))
    });
    sender.close();
    assert_eq!(place.traces(), Vec::<String>::new());
}

#[test]
fn content_of_a_killed_sender_stays() {
    let place = Place::new();
    let (receiver, got) = place.listening();
    let own = receiver.location().incarnation();
    let mut sender = Process::start(&place, "send", own);
    // More than are taken at a time, so that it is known.
    wait_for("letters", || got.arrivals() > 64);
    sender.kill();
    wait_for("notice", || receiver.counters().peers_gone == 1);
    let dead = sender.incarnation.to_string();
    wait_for("removal", || {
        !place.traces().iter().any(|file| file.contains(&dead))
    });
    assert!(receiver.counters().borrowed > 0);
    for number in 0..got.arrivals() {
        assert!(got.content(number).iter().all(|byte| *byte == 7));
    }
    got.arrived.lock().unwrap().clear();
    receiver.close();
    assert_eq!(place.traces(), Vec::<String>::new());
}

#[test]
fn a_receiver_survives_more_killed_senders_than_it_has_connections() {
    let place = Place::new();
    let (receiver, got) = place.listening();
    let own = receiver.location().incarnation();
    for _ in 0..18 {
        // Four at a time, killed in the middle of sending.
        let mut senders: Vec<_> = (0..4)
            .map(|_| Process::start(&place, "send", own))
            .collect();
        wait_for("letters", || got.arrivals() > 8);
        for sender in &mut senders {
            sender.kill();
        }
        got.arrived.lock().unwrap().clear();
    }
    let (sender, sent) = place.listening();
    let one = attempt();
    sender
        .dispatch(one, &receiver.location(), parcel(vec![1; 5000].into()))
        .unwrap();
    wait_for("answer", || sent.conclusion_of(one).is_some());
    assert_eq!(
        sent.conclusion_of(one),
        Some(Conclusion::Answered(Answer::Accepted))
    );
    assert!(receiver.counters().peers_gone > 0);
    drop(got);
    sender.close();
    receiver.close();
    drop((sender, receiver));
    cleanup_dead(&place.config()).unwrap();
    assert_eq!(place.traces(), Vec::<String>::new());
}

#[test]
fn the_dead_are_cleaned_up_after_when_their_last_letters_have_been_taken() {
    let place = Place::new();
    let mut receiver = Process::start(&place, "drop", Incarnation::from_u64(1));
    let connected = |file: &String| file.ends_with(".connection");
    let connections = || place.traces().iter().filter(|file| connected(file)).count();
    let mut sender = Process::start(&place, "send", receiver.incarnation);
    wait_for("connection", || connections() >= 2);
    // Too busy to look for longer than anybody might think it takes.
    receiver.signal("-STOP");
    std::thread::sleep(std::time::Duration::from_millis(50));
    sender.kill();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(std::time::Duration::from_millis(300));
            receiver.signal("-CONT");
        });
        let cleaned = cleanup_dead(&place.config()).unwrap();
        assert_eq!((cleaned.alive, cleaned.failed), (1, 0));
    });
    wait_for("end of the connection", || connections() == 0);
    receiver.kill();
    cleanup_dead(&place.config()).unwrap();
    assert_eq!(place.traces(), Vec::<String>::new());
}

#[test]
fn whoever_leaves_waits_until_its_last_letters_have_been_taken() {
    let place = Place::new();
    let mut receiver = Process::start(&place, "drop", Incarnation::from_u64(1));
    let (sender, sent) = place.listening();
    receiver.wait_until_up(&sender);
    wait_for("answer", || sent.conclusions() == 1);
    receiver.signal("-STOP");
    let to = location_of(receiver.incarnation);
    for number in 0..4 {
        let one = attempt();
        sender
            .dispatch(one, &to, parcel(vec![1; 3000].into()))
            .unwrap();
        if number % 2 == 0 {
            sender.abandon(one);
        }
    }
    std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(std::time::Duration::from_millis(300));
            receiver.signal("-CONT");
        });
        sender.close();
    });
    assert_eq!(sent.conclusions(), 3);
    wait_for("end of the connection", || {
        !place
            .traces()
            .iter()
            .any(|file| file.ends_with(".connection"))
    });
    receiver.kill();
    cleanup_dead(&place.config()).unwrap();
    assert_eq!(place.traces(), Vec::<String>::new());
}

#[test]
fn a_tool_removes_what_the_dead_have_left() {
    let place = Place::new();
    let mut receiver = Process::start(&place, "receive", Incarnation::from_u64(1));
    let mut sender = Process::start(&place, "send", receiver.incarnation);
    // Both are up, and have a connection.
    wait_for("connection", || {
        place
            .traces()
            .iter()
            .filter(|file| file.ends_with(".connection"))
            .count()
            >= 2
    });
    let cleaned = cleanup_dead(&place.config()).unwrap();
    assert_eq!((cleaned.alive, cleaned.removed), (2, 0));
    // So that neither cleans up after the other.
    sender.signal("-STOP");
    receiver.kill();
    sender.kill();
    assert!(!place.traces().is_empty());
    let cleaned = cleanup_dead(&place.config()).unwrap();
    assert_eq!((cleaned.alive, cleaned.removed, cleaned.failed), (0, 2, 0));
    assert_eq!(place.traces(), Vec::<String>::new());
}

/// What iceoryx2 leaves of a connection whose maker was killed before it said which end it is: a
/// file whose state is that of no end, so that neither is the last to go.
#[test]
fn a_connection_that_nobody_has_an_end_of_is_removed() {
    let place = Place::new();
    let ((sender, sent), (receiver, got)) = (place.listening(), place.listening());
    let exchange = || {
        let one = attempt();
        let content = vec![1; 5000].into();
        sender
            .dispatch(one, &receiver.location(), parcel(content))
            .unwrap();
        wait_for("answer", || sent.conclusion_of(one).is_some());
        assert_eq!(
            sent.conclusion_of(one),
            Some(Conclusion::Answered(Answer::Accepted))
        );
    };
    exchange();
    let connections = || {
        let mut found = place.traces();
        found.retain(|file| file.ends_with(".connection"));
        found
    };
    let of_the_living = connections();
    assert_eq!(of_the_living.len(), 2);
    for file in &of_the_living {
        // The end of somebody who is gone in place of the second, then of the first.
        let name = file.strip_suffix(".connection").unwrap();
        let (first, _) = name.rsplit_once('_').unwrap();
        let (front, _) = first.rsplit_once('_').unwrap();
        for orphan in [
            format!("{first}_77.connection"),
            format!("{front}_77_78.connection"),
        ] {
            std::fs::write(orphan, vec![0; 49_220]).unwrap();
        }
    }
    assert!(connections().len() > 2);
    cleanup_dead(&place.config()).unwrap();
    assert_eq!(connections(), of_the_living);
    exchange();
    // What it holds is content in the sender's memory.
    drop(got.arrived.lock().unwrap().split_off(0));
    sender.close();
    receiver.close();
    drop((sender, receiver));
    assert_eq!(place.traces(), Vec::<String>::new());
}

/// With few descriptors left, of which another thread takes one now and then.
fn clean_without_descriptors(config: &ShmConfig) {
    // What is opened gets the lowest number that is free.
    let free = std::fs::File::open("/dev/null").unwrap().as_raw_fd();
    let free = u64::try_from(free).unwrap();
    let limits = getrlimit(Resource::Nofile);
    // Ends with the process.
    std::thread::spawn(|| {
        loop {
            drop(std::fs::File::open("/dev/null"));
        }
    });
    for left in 0..200 {
        let limit = Rlimit {
            current: Some(free + left % 10),
            ..limits
        };
        setrlimit(Resource::Nofile, limit).unwrap();
        // Refused, or done.
        let _ = cleanup_dead(config);
    }
}

/// Who cannot open a file must not take its owner for dead.
#[test]
fn who_has_no_descriptors_left_removes_nothing_of_the_living() {
    let place = Place::new();
    let (receiver, _) = place.listening();
    let exchange = || {
        let (sender, told) = place.listening();
        let (to, sent) = (receiver.location(), attempt());
        sender.dispatch(sent, &to, parcel(Bytes::new())).unwrap();
        wait_for("answer", || told.conclusion_of(sent).is_some());
        sender
    };
    let living = exchange();
    let before = place.traces();
    let mut cleaner = Process::start(&place, "clean", Incarnation::from_u64(1));
    assert!(cleaner.child.wait().unwrap().success());
    assert_eq!(place.traces(), before);
    // Its mailbox can still be found.
    exchange().close();
    living.close();
}

/// What iceoryx2 leaves of a mailbox when whoever takes the last node out of it is killed at that
/// moment: nobody says any more that it is used.
#[test]
fn a_mailbox_that_nobody_uses_is_removed() {
    let place = Place::new();
    let (living, _) = place.listening();
    let of_the_living = place.traces();
    let made_since = |end: &str| {
        let mut made = place.traces();
        made.retain(|file| file.ends_with(end) && !of_the_living.contains(file));
        made
    };
    let mut receiver = Process::start(&place, "receive", Incarnation::from_u64(1));
    wait_for("mailbox", || !made_since(".port_tag").is_empty());
    receiver.kill();
    assert_eq!(made_since(".dynamic").len(), 1);
    // What is removed before: its ports, and that its node has a part in it.
    for end in [".data", ".port_tag", ".service_tag"] {
        for file in made_since(end) {
            std::fs::remove_file(file).unwrap();
        }
    }
    cleanup_dead(&place.config()).unwrap();
    assert_eq!(place.traces(), of_the_living);
    living.close();
}

#[test]
fn whoever_starts_later_removes_it_too() {
    let place = Place::new();
    let mut gone = Process::start(&place, "receive", Incarnation::from_u64(1));
    {
        let (other, _) = place.listening();
        gone.wait_until_up(&other);
    }
    gone.kill();
    assert!(!place.traces().is_empty());
    let (newcomer, _) = place.listening();
    let dead = gone.incarnation.to_string();
    wait_for("removal", || {
        !place.traces().iter().any(|file| file.contains(&dead))
    });
    newcomer.close();
    assert_eq!(place.traces(), Vec::<String>::new());
}
