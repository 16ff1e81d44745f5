//! Several processes, some of which are killed. Each test starts its own processes from this
//! binary.

#![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]
#![allow(clippy::print_stdout, reason = "processes report their observations")]

mod common;

use std::io::{BufRead, BufReader, Lines};
use std::os::fd::AsRawFd;
use std::os::unix::fs::PermissionsExt as _;
use std::process::{ChildStdout, Stdio};
use std::sync::Arc;

use bytes::Bytes;
use common::{GatedSink, RecordingSink, TestDomain, attempt, location_of, mapping_of, parcel};
use fipa_acl::Letter;
use fipa_testbed::{ChildGuard, ignored_test, until};
use fipa_transport::{
    Answer, Arrival, AttemptId, Conclusion, Incarnation, Kind, LegacySource, Reaction, Sink,
    Transport, TransportErrorKind,
};
use fipa_transport_shm::{ShmConfig, ShmTransport, cleanup_dead};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

const ROLE: &str = "FIPA_SHM_TEST_ROLE";

/// A child process, killed at the end.
struct Process {
    child: ChildGuard,
    incarnation: Incarnation,
}

impl Process {
    /// Roles: `receive` keeps what arrives, and `drop` drops it; `tell` also prints the position of
    /// its content; `halt` never returns from the first letter with content; `send` sends to a process in a loop, and `many` does so with content for
    /// several receivers; `clean` cleans up and ends.
    fn start(domain: &TestDomain, role: &str, to: Incarnation) -> Self {
        let config = domain.config();
        let mut command = ignored_test("process_entry");
        command
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
                "tell" | "halt" => Stdio::piped(),
                _ => Stdio::null(),
            });
        Self {
            child: ChildGuard::start(&mut command),
            incarnation: config.incarnation,
        }
    }

    /// The lines that the process prints.
    fn lines(&mut self) -> Lines<BufReader<ChildStdout>> {
        BufReader::new(self.child.child().stdout.take().unwrap()).lines()
    }

    fn signal(&self, signal: &str) {
        self.child.signal(signal);
    }

    /// Sends SIGKILL and waits for the end.
    fn kill(&mut self) {
        self.child.kill();
    }

    /// Waits until the process can be reached.
    fn wait_until_up(&self, from: &ShmTransport) {
        let to = location_of(self.incarnation);
        until("process", || {
            from.post(attempt(), &to, parcel(Bytes::new())).is_ok()
        });
    }
}

#[test]
#[ignore = "started by the other tests"]
fn process_entry() {
    let role = std::env::var(ROLE).expect("the other tests set it");
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
    if role == "halt" {
        endpoint.listen(Arc::new(HaltingSink)).unwrap();
    }
    let sink = Arc::new(RecordingSink::default());
    if role != "halt" {
        endpoint.listen(sink.clone()).unwrap();
    }
    let content = Bytes::from(vec![7; 5000]);
    let mut seen = 0;
    loop {
        match role {
            "receive" | "halt" => std::thread::park(),
            "drop" => {
                sink.arrived.lock().unwrap().clear();
                std::thread::sleep(std::time::Duration::from_millis(1));
            }
            "tell" => {
                wait_without_limit(|| sink.arrivals() > seen);
                let content = sink.content(seen);
                seen += 1;
                if !content.is_empty() {
                    let sum: u64 = content.iter().map(|byte| u64::from(*byte)).sum();
                    println!("\nPOSITION {} {} {sum}", position(&content), content.len());
                }
            }
            "many" => {
                // All segments are held or read.
                let Ok(Some(mut loan)) = endpoint.loan_for_many(100_000) else {
                    std::thread::yield_now();
                    continue;
                };
                loan.content_mut().fill(7);
                let _ = endpoint.post(attempt(), &to, parcel(loan.freeze()));
            }
            _ => {
                // The mailbox is full, or its process has ended.
                if endpoint
                    .post(attempt(), &to, parcel(content.clone()))
                    .is_err()
                {
                    std::thread::yield_now();
                }
            }
        }
    }
}

fn wait_without_limit(condition: impl Fn() -> bool) {
    while !condition() {
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
}

/// Device, inode and offset of content in memory, as one line of text.
fn position(content: &[u8]) -> String {
    let at = mapping_of(content);
    format!("{} {} {}", at.device, at.inode, at.offset)
}

#[test]
fn receivers_in_two_processes_read_the_same_memory() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let unused = Incarnation::from_u64(1);
    let mut receivers = [(); 2].map(|()| Process::start(&domain, "tell", unused));
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
    let expected = format!("POSITION {} {} {sum}", position(&content), content.len());
    for receiver in &mut receivers {
        let to = location_of(receiver.incarnation);
        let one = attempt();
        sender.post(one, &to, parcel(content.clone())).unwrap();
        until("answer", || sent.conclusion_of(one).is_some());
        let mut lines = receiver.lines().map_while(Result::ok);
        let reported = lines.find(|line| line.starts_with("POSITION"));
        assert_eq!(reported, Some(expected.clone()));
    }
    assert_eq!(sender.counters().referring, 2);
    // A receiver that is killed while it holds the content does not keep the memory from being
    // reused.
    for receiver in &mut receivers {
        receiver.kill();
    }
    let before = position(&content);
    drop(content);
    let again = sender.loan_for_many(1 << 20).unwrap().unwrap().freeze();
    assert_eq!(position(&again), before);
}

#[test]
fn shared_content_of_a_killed_sender_stays_while_it_is_read() {
    let domain = TestDomain::new();
    let (receiver, got) = domain.listening();
    let own = receiver.location().incarnation();
    let mut sender = Process::start(&domain, "many", own);
    until("letters", || got.arrivals() >= 8);
    sender.kill();
    let dead = sender.incarnation.to_string();
    until("removal", || {
        !domain.files().iter().any(|file| file.contains(&dead))
    });
    for number in 0..got.arrivals() {
        assert!(got.content(number).iter().all(|byte| *byte == 7));
    }
    got.arrived.lock().unwrap().clear();
    assert_eq!(receiver.counters().borrowed, 0);
    until("the end of the mapping", || {
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        !maps.contains(&format!("{dead}."))
    });
    receiver.close();
    domain.until_removed();
}

/// The process is found dead when a letter to it is sent; there was no connection to it before.
#[test]
fn the_files_of_a_process_that_ended_before_any_connection_are_removed() {
    let domain = TestDomain::new();
    let (receiver, _) = domain.listening();
    let mut stranger = Process::start(&domain, "receive", Incarnation::from_u64(1));
    let dead = stranger.incarnation;
    let is_up = |file: &String| file.contains(&dead.to_string()) && file.ends_with(".live");
    until("files", || domain.files().iter().any(is_up));
    stranger.kill();
    let refused = receiver
        .post(attempt(), &location_of(dead), parcel(Bytes::new()))
        .unwrap_err();
    assert_eq!(refused.fault, TransportErrorKind::Unreachable);
    assert_eq!(receiver.counters().peers_gone, 0);
    until("removal", || {
        let files = domain.files();
        !files.iter().any(|file| file.contains(&dead.to_string()))
    });
    receiver.close();
    domain.until_removed();
}

#[test]
fn attempts_to_a_killed_receiver_are_concluded() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let mut receiver = Process::start(&domain, "receive", Incarnation::from_u64(1));
    receiver.wait_until_up(&sender);
    until("answer", || sent.conclusions() == 1);
    let to = location_of(receiver.incarnation);

    receiver.signal("-STOP");
    let attempts: Vec<_> = (0..5).map(|_| attempt()).collect();
    for one in &attempts {
        sender
            .post(*one, &to, parcel(vec![1; 3000].into()))
            .unwrap();
    }
    receiver.kill();
    until("conclusions", || sent.conclusions() == 6);
    for one in &attempts {
        match sent.conclusion_of(*one) {
            Some(Conclusion::Unconfirmed(e)) => assert_eq!(e.fault, TransportErrorKind::Broken),
            other => panic!("{other:?}"),
        }
    }
    let refused = sender
        .post(attempt(), &to, parcel(Bytes::new()))
        .unwrap_err();
    assert_eq!(refused.fault, TransportErrorKind::Unreachable);
    assert_eq!(sender.counters().peers_gone, 1);
    // The survivor removes the files of the dead process while it runs.
    let dead = receiver.incarnation.to_string();
    until("removal", || {
        !domain.files().iter().any(|file| file.contains(&dead))
    });
    sender.close();
    domain.until_removed();
}

/// A sink whose first call with content does not return.
struct HaltingSink;

impl Sink for HaltingSink {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        if let fipa_transport::Body::Letter(letter) = &arrival.parcel.body
            && !letter.payload().content.is_empty()
        {
            println!("\nHALTED");
            loop {
                std::thread::park();
            }
        }
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

    fn concluded(&self, _: AttemptId, _: Conclusion) {}
}

/// Waits until the process answers in words.
fn wait_until_answered_in_a_word(sender: &ShmTransport, sink: &RecordingSink, to: Incarnation) {
    let before = sender.counters().answered_in_words;
    until("an answer in a word", || {
        let one = attempt();
        sender
            .post(one, &location_of(to), parcel(Bytes::new()))
            .unwrap();
        until("answer", || sink.conclusion_of(one).is_some());
        sender.counters().answered_in_words > before
    });
}

#[test]
fn a_letter_whose_receiver_is_killed_before_its_answer_is_unconfirmed() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let mut receiver = Process::start(&domain, "halt", Incarnation::from_u64(1));
    receiver.wait_until_up(&sender);
    wait_until_answered_in_a_word(&sender, &sent, receiver.incarnation);
    let before = sender.counters().answered_in_words;
    let to = location_of(receiver.incarnation);
    let [taken, waiting] = [attempt(), attempt()];
    for (one, content) in [(taken, vec![1; 3000]), (waiting, vec![])] {
        sender.post(one, &to, parcel(content.into())).unwrap();
    }
    let mut lines = receiver.lines().map_while(Result::ok);
    assert!(lines.any(|line| line == "HALTED"));
    receiver.kill();
    for one in [taken, waiting] {
        until("conclusion", || sent.conclusion_of(one).is_some());
        let end = sent.conclusion_of(one).unwrap();
        assert!(matches!(end, Conclusion::Unconfirmed(_)), "{end:?}");
    }
    assert_eq!(sender.counters().answered_in_words, before);
    sender.close();
    domain.until_removed();
}

/// The sender looks for the answer after the receiver was killed.
#[test]
fn a_letter_whose_receiver_is_killed_after_its_answer_is_answered() {
    let domain = TestDomain::new();
    let sender = domain.endpoint();
    let sink = Arc::new(GatedSink::default());
    sender.listen(sink.clone()).unwrap();
    let sent = &sink.recorded;
    let mut receiver = Process::start(&domain, "tell", Incarnation::from_u64(1));
    receiver.wait_until_up(&sender);
    wait_until_answered_in_a_word(&sender, sent, receiver.incarnation);
    let to = location_of(receiver.incarnation);
    let post = |content: Vec<u8>| {
        let one = attempt();
        sender.post(one, &to, parcel(content.into())).unwrap();
        one
    };
    sink.close_gate();
    post(vec![]);
    until("the first conclusion", || sink.is_waiting());
    let before = sender.counters().answered_in_words;
    let answered = post(vec![]);
    // When this letter has arrived, the one before it is answered.
    post(vec![1; 3000]);
    let mut lines = receiver.lines().map_while(Result::ok);
    assert!(lines.any(|line| line.starts_with("POSITION")));
    receiver.kill();
    assert_eq!(sent.conclusion_of(answered), None);
    sink.open_gate();
    until("conclusion", || sent.conclusion_of(answered).is_some());
    let accepted = Some(Conclusion::Answered(Answer::Accepted));
    assert_eq!(sent.conclusion_of(answered), accepted);
    assert!(sender.counters().answered_in_words > before);
    sender.close();
    domain.until_removed();
}

#[test]
fn content_of_a_killed_sender_stays_readable() {
    let domain = TestDomain::new();
    let (receiver, got) = domain.listening();
    let own = receiver.location().incarnation();
    let mut sender = Process::start(&domain, "send", own);
    until("letters", || got.arrivals() > 64);
    sender.kill();
    let dead = sender.incarnation.to_string();
    until("removal", || {
        !domain.files().iter().any(|file| file.contains(&dead))
    });
    assert!(receiver.counters().borrowed > 0);
    for number in 0..got.arrivals() {
        assert!(got.content(number).iter().all(|byte| *byte == 7));
    }
    got.arrived.lock().unwrap().clear();
    receiver.close();
    domain.until_removed();
}

#[test]
fn a_receiver_survives_more_killed_senders_than_it_has_connections() {
    let domain = TestDomain::new();
    let (receiver, got) = domain.listening();
    let own = receiver.location().incarnation();
    for _ in 0..18 {
        // Four at a time, killed while they send.
        let mut senders: Vec<_> = (0..4)
            .map(|_| Process::start(&domain, "send", own))
            .collect();
        until("letters", || got.arrivals() > 8);
        for sender in &mut senders {
            sender.kill();
        }
        got.arrived.lock().unwrap().clear();
    }
    let (sender, sent) = domain.listening();
    let one = attempt();
    sender
        .post(one, &receiver.location(), parcel(vec![1; 5000].into()))
        .unwrap();
    until("answer", || sent.conclusion_of(one).is_some());
    assert_eq!(
        sent.conclusion_of(one),
        Some(Conclusion::Answered(Answer::Accepted))
    );
    assert!(receiver.counters().peers_gone > 0);
    drop(got);
    sender.close();
    receiver.close();
    drop((sender, receiver));
    cleanup_dead(&domain.config()).unwrap();
    domain.until_removed();
}

#[test]
fn cleanup_waits_until_the_last_letters_of_dead_processes_are_taken() {
    let domain = TestDomain::new();
    let mut receiver = Process::start(&domain, "drop", Incarnation::from_u64(1));
    let connected = |file: &String| file.ends_with(".connection");
    let connections = || domain.files().iter().filter(|file| connected(file)).count();
    let mut sender = Process::start(&domain, "send", receiver.incarnation);
    until("connection", || connections() >= 2);
    // Stopped, so that it does not poll for a while.
    receiver.signal("-STOP");
    sender.kill();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            std::thread::sleep(std::time::Duration::from_millis(300));
            receiver.signal("-CONT");
        });
        let cleaned = cleanup_dead(&domain.config()).unwrap();
        assert_eq!((cleaned.alive, cleaned.failed), (1, 0));
    });
    until("end of the connection", || connections() == 0);
    receiver.kill();
    cleanup_dead(&domain.config()).unwrap();
    domain.until_removed();
}

#[test]
fn close_waits_until_the_last_letters_are_taken() {
    let domain = TestDomain::new();
    let mut receiver = Process::start(&domain, "drop", Incarnation::from_u64(1));
    let (sender, sent) = domain.listening();
    receiver.wait_until_up(&sender);
    until("answer", || sent.conclusions() == 1);
    receiver.signal("-STOP");
    let to = location_of(receiver.incarnation);
    for number in 0..4 {
        let one = attempt();
        sender.post(one, &to, parcel(vec![1; 3000].into())).unwrap();
        if number % 2 == 0 {
            sender.abandon(one, &to);
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
    until("end of the connection", || {
        !domain
            .files()
            .iter()
            .any(|file| file.ends_with(".connection"))
    });
    receiver.kill();
    cleanup_dead(&domain.config()).unwrap();
    domain.until_removed();
}

#[test]
fn cleanup_dead_removes_the_files_of_killed_processes() {
    let domain = TestDomain::new();
    let mut receiver = Process::start(&domain, "receive", Incarnation::from_u64(1));
    let mut sender = Process::start(&domain, "send", receiver.incarnation);
    // Both processes run and are connected.
    until("connection", || {
        domain
            .files()
            .iter()
            .filter(|file| file.ends_with(".connection"))
            .count()
            >= 2
    });
    let cleaned = cleanup_dead(&domain.config()).unwrap();
    assert_eq!((cleaned.alive, cleaned.removed), (2, 0));
    // Stopped, so that neither cleans up after the other.
    sender.signal("-STOP");
    receiver.kill();
    sender.kill();
    assert!(!domain.files().is_empty());
    let cleaned = cleanup_dead(&domain.config()).unwrap();
    assert_eq!((cleaned.alive, cleaned.removed, cleaned.failed), (0, 2, 0));
    domain.until_removed();
}

/// iceoryx2 leaves a connection like this if its creator is killed before it records its own end:
/// the state in the file is that of no end, so neither end is the last to close.
#[test]
fn a_connection_without_ports_is_removed() {
    let domain = TestDomain::new();
    let ((sender, sent), (receiver, got)) = (domain.listening(), domain.listening());
    let exchange = || {
        let one = attempt();
        let content = vec![1; 5000].into();
        sender
            .post(one, &receiver.location(), parcel(content))
            .unwrap();
        until("answer", || sent.conclusion_of(one).is_some());
        assert_eq!(
            sent.conclusion_of(one),
            Some(Conclusion::Answered(Answer::Accepted))
        );
    };
    exchange();
    let connections = || {
        let mut found = domain.files();
        found.retain(|file| file.ends_with(".connection"));
        found
    };
    let of_the_living = connections();
    assert_eq!(of_the_living.len(), 2);
    for file in &of_the_living {
        // First the second end, then the first end is that of a missing port.
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
    cleanup_dead(&domain.config()).unwrap();
    assert_eq!(connections(), of_the_living);
    exchange();
    // The recorded content is in the sender's memory.
    drop(got.arrived.lock().unwrap().split_off(0));
    sender.close();
    receiver.close();
    drop((sender, receiver));
    domain.until_removed();
}

/// Cleans up with few free descriptors, of which another thread takes one now and then.
fn clean_without_descriptors(config: &ShmConfig) {
    // A new descriptor gets the lowest free number.
    let free = std::fs::File::open("/dev/null").unwrap().as_raw_fd();
    let free = u64::try_from(free).unwrap();
    let limits = getrlimit(Resource::Nofile);
    // Ends with the process.
    std::thread::spawn(|| {
        loop {
            drop(std::fs::File::open("/dev/null"));
        }
    });
    for more in 0..200 {
        let limit = Rlimit {
            current: Some(free + more % 10),
            ..limits
        };
        setrlimit(Resource::Nofile, limit).unwrap();
        // May fail or succeed.
        let _ = cleanup_dead(config);
    }
}

/// A process that cannot open a file must not consider its owner dead.
#[test]
fn a_cleanup_without_free_descriptors_keeps_the_files_of_living_processes() {
    let domain = TestDomain::new();
    let (receiver, _) = domain.listening();
    let exchange = || {
        let (sender, sink) = domain.listening();
        let (to, sent) = (receiver.location(), attempt());
        sender.post(sent, &to, parcel(Bytes::new())).unwrap();
        until("answer", || sink.conclusion_of(sent).is_some());
        sender
    };
    let living = exchange();
    let before = domain.files();
    let mut cleaner = Process::start(&domain, "clean", Incarnation::from_u64(1));
    assert!(cleaner.child.wait().success());
    assert_eq!(domain.files(), before);
    // Its mailbox can still be found.
    exchange().close();
    living.close();
}

/// iceoryx2 leaves a mailbox like this if the process that removes its last node is killed at that
/// moment: no node claims to use it.
#[test]
fn an_unused_mailbox_is_removed() {
    let domain = TestDomain::new();
    let (living, _) = domain.listening();
    let of_the_living = domain.files();
    let made_since = |end: &str| {
        let mut files = domain.files();
        files.retain(|file| file.ends_with(end) && !of_the_living.contains(file));
        files
    };
    let mut receiver = Process::start(&domain, "receive", Incarnation::from_u64(1));
    until("mailbox", || !made_since(".port_tag").is_empty());
    receiver.kill();
    assert_eq!(made_since(".dynamic").len(), 1);
    // The files that the process removes earlier: its ports, and its node's claim.
    for end in [".data", ".port_tag", ".service_tag"] {
        for file in made_since(end) {
            std::fs::remove_file(file).unwrap();
        }
    }
    cleanup_dead(&domain.config()).unwrap();
    // The endpoint may clean up at the same time, and still be about to remove files.
    until("removal", || domain.files() == of_the_living);
    living.close();
}

#[test]
fn a_process_that_starts_later_cleans_up() {
    let domain = TestDomain::new();
    let mut gone = Process::start(&domain, "receive", Incarnation::from_u64(1));
    {
        let (other, _) = domain.listening();
        gone.wait_until_up(&other);
    }
    gone.kill();
    assert!(!domain.files().is_empty());
    let (newcomer, _) = domain.listening();
    let dead = gone.incarnation.to_string();
    until("removal", || {
        !domain.files().iter().any(|file| file.contains(&dead))
    });
    newcomer.close();
    domain.until_removed();
}

/// The files in shared memory are gone after a crash of the system, and the descriptions of nodes and
/// services on a disk may be empty, because they are not synchronized.
#[test]
fn descriptions_that_a_crash_of_the_system_has_emptied_are_removed() {
    let domain = TestDomain::new();
    let mut gone = Process::start(&domain, "receive", Incarnation::from_u64(1));
    let is_made = || {
        domain
            .files()
            .iter()
            .any(|file| file.ends_with(".port_tag"))
    };
    until("mailbox", is_made);
    gone.kill();
    let mut emptied = 0;
    for file in domain.files() {
        if file.starts_with("/dev/shm") {
            std::fs::remove_file(file).unwrap();
        } else if std::fs::metadata(&file).is_ok_and(|found| found.is_file() && found.len() > 0) {
            std::fs::remove_file(&file).unwrap();
            std::fs::write(&file, []).unwrap();
            let finished = std::fs::Permissions::from_mode(0o400);
            std::fs::set_permissions(&file, finished).unwrap();
            emptied += 1;
        }
    }
    assert!(
        emptied >= 2,
        "{emptied}: a node and a service have a description"
    );
    // Processes start, and reach each other.
    let (one, sink) = domain.listening();
    let (other, _) = domain.listening();
    one.post(attempt(), &other.location(), parcel(Bytes::new()))
        .unwrap();
    until("an answer", || sink.conclusions() == 1);
    other.close();
    one.close();
    domain.until_removed();
}
