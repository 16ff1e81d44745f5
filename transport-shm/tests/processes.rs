//! Several processes, some of which are killed. Every test starts its own from this binary.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on says so")]

mod common;

use std::process::{Child, Command, Stdio};
use std::sync::Arc;

use bytes::Bytes;
use common::{Place, attempt, location_of, parcel, wait_for};
use fipa_transport::{Answer, Conclusion, Incarnation, Transport, WayFault};
use fipa_transport_shm::{ShmConfig, ShmTransport, cleanup_dead};

const ROLE: &str = "FIPA_SHM_TEST_ROLE";

/// A process of its own, killed in the end.
struct Process {
    child: Child,
    incarnation: Incarnation,
}

impl Process {
    /// Roles: `receive` what comes and keep it; `send` to a process without end.
    fn start(place: &Place, role: &str, to: Incarnation) -> Self {
        let config = place.config();
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--ignored", "--exact", "a_process_of_its_own"])
            .env(
                ROLE,
                format!(
                    "{role} {} {} {} {to}",
                    config.root.display(),
                    config.prefix,
                    config.incarnation
                ),
            )
            .stdout(Stdio::null())
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
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(1)
        .enable_all()
        .build()
        .unwrap();
    let endpoint = ShmTransport::new(config, runtime.handle().clone()).unwrap();
    let told = Arc::new(common::Told::default());
    endpoint.listen(told).unwrap();
    let content = Bytes::from(vec![7; 5000]);
    loop {
        match role {
            "receive" => std::thread::park(),
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
    wait_for("letter", || got.arrivals() > 0);
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
    receiver.kill();
    sender.kill();
    assert!(!place.traces().is_empty());
    let cleaned = cleanup_dead(&place.config()).unwrap();
    assert_eq!((cleaned.alive, cleaned.removed, cleaned.failed), (0, 2, 0));
    assert_eq!(place.traces(), Vec::<String>::new());
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
