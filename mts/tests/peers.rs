//! Static peers: times of the checks of contact.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Peer, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Directory as _, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, AttemptId, Body, Conclusion, Hop, Incarnation, Introduction, Kind, Location, Mandate,
    Principal, TransportError, TransportErrorKind,
};

struct Bench {
    core: Core,
    now: Now,
}

impl Bench {
    fn new() -> Self {
        let incarnation = Incarnation::from_u64(1);
        let directory = MemoryDirectory::new(MtsId::new("mts", incarnation));
        let config = CoreConfig::new("mts", incarnation, vec![Kind::Udp, Kind::Tcp]);
        Self {
            core: Core::new(config, Arc::new(directory)),
            now: Now {
                instant: Instant::now(),
                utc: SystemTime::UNIX_EPOCH,
            },
        }
    }

    /// The check since the last call, if there was one.
    fn asked(&mut self) -> Option<(AttemptId, String)> {
        match self.core.poll_action()? {
            Action::Dispatch {
                attempt,
                location,
                parcel,
            } => {
                assert_eq!(parcel.body, Body::Credit);
                Some((attempt, location.to_string()))
            }
            other => panic!("{other:?}"),
        }
    }

    fn fails(&mut self, attempt: AttemptId) {
        let error = TransportError::new(TransportErrorKind::Unreachable, "no host");
        let conclusion = Conclusion::NotSent(error);
        self.core.handle_conclusion(self.now, attempt, conclusion);
    }

    fn answers(&mut self, attempt: AttemptId) {
        let conclusion = Conclusion::Answered(Answer::Accepted);
        self.core.handle_conclusion(self.now, attempt, conclusion);
    }

    /// Advances the time to the next timeout; returns the time that passed.
    fn wait(&mut self) -> Duration {
        let due = self.core.poll_timeout().unwrap();
        let waited = due - self.now.instant;
        self.now.instant = due;
        self.core.handle_timeout(self.now);
        waited
    }
}

fn peer(locations: &[&str]) -> Peer {
    let locations = locations.iter().map(|text| text.parse().unwrap()).collect();
    Peer {
        name: "crex".into(),
        locations,
    }
}

#[test]
fn every_location_is_asked_and_then_again_after_growing_pauses() {
    let mut bench = Bench::new();
    // In the order of the configured transports; others are left out.
    let listed = peer(&["quic://a:1", "tcp://a:2", "udp://a:3", "tcp://b:4"]);
    bench.core.keep_in_touch(bench.now, vec![listed]);
    let mut pauses = Vec::new();
    for _ in 0..9 {
        for expected in ["udp://a:3", "tcp://a:2", "tcp://b:4"] {
            let (attempt, asked) = bench.asked().unwrap();
            assert_eq!(asked, expected);
            bench.fails(attempt);
        }
        assert!(bench.asked().is_none());
        pauses.push(bench.wait());
    }
    assert!(pauses.is_sorted(), "{pauses:?}");
    assert_eq!(pauses.first(), Some(&Duration::from_millis(100)));
    assert_eq!(pauses.last(), Some(&Duration::from_secs(2)));
    let state = &bench.core.peers(bench.now)[0];
    assert_eq!((state.failures.len(), state.rounds), (3, 9));
    assert_eq!(state.answers, None);
}

#[test]
fn a_peer_that_answers_is_checked_seldom_and_after_its_connection_ends() {
    let mut bench = Bench::new();
    let listed = peer(&["tcp://a:2"]);
    bench.core.keep_in_touch(bench.now, vec![listed.clone()]);
    let (attempt, _) = bench.asked().unwrap();
    bench.answers(attempt);
    let state = &bench.core.peers(bench.now)[0];
    assert_eq!(state.answers, Some(listed.locations[0].clone()));
    assert_eq!(bench.wait(), Duration::from_secs(5));
    let (attempt, _) = bench.asked().unwrap();
    bench.answers(attempt);
    bench.now.instant += Duration::from_secs(1);
    let location: Location = "tcp://a:2".parse().unwrap();
    let disconnected = Introduction {
        name: "crex".into(),
        hop: Hop {
            location: location.clone(),
            principal: Principal::Unproved,
        },
        dialed: Some(location),
        mandate: Mandate::Unproved,
    };
    bench.core.handle_disconnected(bench.now, &disconnected);
    assert_eq!(bench.wait(), Duration::ZERO);
    let (attempt, _) = bench.asked().unwrap();
    bench.answers(attempt);
    // A connection that ends frequently does not cause frequent checks.
    bench.core.handle_disconnected(bench.now, &disconnected);
    assert_eq!(bench.wait(), Duration::from_millis(200));
    // A peer that answers and ends each connection is checked less and less often.
    for pause in [400, 800, 1600, 2000, 2000] {
        let (attempt, _) = bench.asked().unwrap();
        bench.answers(attempt);
        bench.core.handle_disconnected(bench.now, &disconnected);
        assert_eq!(bench.wait(), Duration::from_millis(pause));
    }
    // A connection that lasts until the next check resets the pause.
    for _ in 0..2 {
        let (attempt, _) = bench.asked().unwrap();
        bench.answers(attempt);
        bench.wait();
    }
    let (attempt, _) = bench.asked().unwrap();
    bench.answers(attempt);
    bench.core.handle_disconnected(bench.now, &disconnected);
    assert_eq!(bench.wait(), Duration::from_millis(200));
}

#[test]
fn a_location_that_is_silent_delays_no_other() {
    let mut bench = Bench::new();
    let both = vec![peer(&["tcp://a:2", "tcp://b:2"])];
    bench.core.keep_in_touch(bench.now, both);
    let (silent, at) = bench.asked().unwrap();
    assert_eq!(at, "tcp://a:2");
    let (answered, at) = bench.asked().unwrap();
    assert_eq!(at, "tcp://b:2");
    bench.answers(answered);
    let state = &bench.core.peers(bench.now)[0];
    assert_eq!(state.answers, Some("tcp://b:2".parse().unwrap()));
    bench.wait();
    let abandoned = bench.core.poll_action();
    assert!(
        matches!(abandoned, Some(Action::Abandon { attempt, .. }) if attempt == silent),
        "{abandoned:?}"
    );
    // While the peer answers at one location, only that one is checked.
    bench.wait();
    let (attempt, at) = bench.asked().unwrap();
    assert_eq!(at, "tcp://b:2");
    assert!(bench.asked().is_none());
    // After it stops answering there, all are checked.
    bench.fails(attempt);
    assert_eq!(bench.asked().unwrap().1, "tcp://a:2");
    assert_eq!(bench.wait(), Duration::from_millis(100));
    assert_eq!(bench.asked().unwrap().1, "tcp://b:2");
}

#[test]
fn silence_counts_as_a_failure() {
    let mut bench = Bench::new();
    let listed = vec![peer(&["tcp://a:2"])];
    bench.core.keep_in_touch(bench.now, listed);
    bench.asked().unwrap();
    bench.wait();
    assert!(matches!(
        bench.core.poll_action(),
        Some(Action::Abandon { .. })
    ));
    let state = &bench.core.peers(bench.now)[0];
    assert_eq!(state.failures[0].1.fault, TransportErrorKind::TimedOut);
}

#[test]
fn a_new_list_replaces_peers_and_keeps_the_state_of_common_ones() {
    let mut bench = Bench::new();
    let (first, second) = (peer(&["tcp://a:1"]), peer(&["tcp://b:1"]));
    bench.core.keep_in_touch(bench.now, vec![first.clone()]);
    let (attempt, _) = bench.asked().unwrap();
    bench.answers(attempt);
    let both = vec![second, first];
    bench.core.keep_in_touch(bench.now, both);
    assert_eq!(bench.asked().unwrap().1, "tcp://b:1");
    assert!(bench.asked().is_none(), "the first was asked a moment ago");
    bench.core.keep_in_touch(bench.now, Vec::new());
    assert!(matches!(
        bench.core.poll_action(),
        Some(Action::Abandon { .. })
    ));
    assert_eq!(bench.core.poll_timeout(), None);
}

#[test]
fn peers_are_checked_at_once_after_a_network_change() {
    let mut bench = Bench::new();
    bench
        .core
        .keep_in_touch(bench.now, vec![peer(&["tcp://a:2"])]);
    for _ in 0..9 {
        let (attempt, _) = bench.asked().unwrap();
        bench.fails(attempt);
        bench.wait();
    }
    let (attempt, _) = bench.asked().unwrap();
    bench.fails(attempt);
    bench.now.instant += Duration::from_millis(1);
    assert!(bench.asked().is_none());
    bench.core.handle_reachable(bench.now, None);
    let (attempt, asked) = bench.asked().unwrap();
    assert_eq!(asked, "tcp://a:2");
    // The backoff restarts at its minimum.
    bench.fails(attempt);
    assert_eq!(bench.wait(), Duration::from_millis(100));
}

#[test]
fn a_greeting_opens_a_connection_and_is_not_repeated() {
    let mut bench = Bench::new();
    let at: Location = "tcp://a:2".parse().unwrap();
    bench.core.announce_locations(vec![("crex".into(), at)]);
    let (attempt, asked) = bench.asked().unwrap();
    assert_eq!(asked, "tcp://a:2");
    bench.fails(attempt);
    assert!(bench.asked().is_none());
    assert_eq!(bench.core.poll_timeout(), None);
}

#[test]
fn waiting_letters_leave_when_their_receiver_is_reachable_again() {
    let gateway = Incarnation::from_u64(7);
    let directory = Arc::new(MemoryDirectory::new(MtsId::new(
        "mts",
        Incarnation::from_u64(1),
    )));
    let at: Location = "tcp://10.0.0.2:1".parse().unwrap();
    let at = at.with_incarnation(gateway);
    let arm = Registration::new("arm", Incarnation::from_u64(3), vec![at.clone()]);
    directory.register(arm).unwrap();
    let mut bench = Bench::new();
    let config = bench.core.config().clone();
    bench.core = Core::new(config, directory);
    let rover = Incarnation::from_u64(2);
    bench.core.register("rover".into(), rover);
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap();
    let submission = Submission {
        sender: rover,
        letter: letter_for(&message, bench.now.utc).unwrap(),
        receivers: vec!["arm".into()],
        deadline: Duration::from_secs(60),
    };
    bench.core.submit(bench.now, submission);
    let dispatched = |bench: &mut Bench| loop {
        match bench.core.poll_action()? {
            Action::Dispatch { attempt, .. } => return Some(attempt),
            Action::Outcome { outcome, .. } => panic!("{outcome:?}"),
            _ => {}
        }
    };
    // Until the backoff is long.
    let mut waited = Duration::ZERO;
    while waited < Duration::from_millis(200) {
        let attempt = dispatched(&mut bench);
        match attempt {
            Some(attempt) => bench.fails(attempt),
            None => waited = bench.wait(),
        }
    }
    if let Some(attempt) = dispatched(&mut bench) {
        bench.fails(attempt);
    }
    assert_eq!(dispatched(&mut bench), None);
    let other = Some(Incarnation::from_u64(8));
    bench.core.handle_reachable(bench.now, other);
    assert_eq!(dispatched(&mut bench), None, "another service");
    bench.core.handle_reachable(bench.now, Some(gateway));
    assert!(dispatched(&mut bench).is_some());
}
