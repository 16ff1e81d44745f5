//! A service that has announced another location and no longer the one of an attempt.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_sds::{Directory, Entry, MemoryDirectory, MtsId, Reach, Registration, Source, View};
use fipa_transport::{
    Answer, AttemptId, Conclusion, Hop, Incarnation, Introduction, Kind, Location, Mandate,
    Outcome, Principal, TransportError,
};

use self::common::letter;

const ROVER: Incarnation = Incarnation::from_u64(2);
const ARM: Incarnation = Incarnation::from_u64(3);
const PEER: Incarnation = Incarnation::from_u64(9);

fn tcp(host: u8) -> Location {
    let location = Location::new(Kind::Tcp, &format!("192.0.2.{host}:7100")).unwrap();
    location.with_incarnation(PEER)
}

/// A directory with the agent `arm` behind the gateway of another host.
fn directory(locations: Vec<Location>) -> MemoryDirectory {
    let directory = MemoryDirectory::new(MtsId::new("peer", PEER));
    let arm = Registration::new("arm", ARM, locations);
    directory.register(arm).unwrap();
    directory
}

/// The entry of `arm` as an announcement of this source.
fn entry(locations: Vec<Location>, source: Source) -> Arc<Entry> {
    let entry = directory(locations).named("arm").unwrap();
    let mut entry = Entry::clone(&entry);
    entry.reach = Reach::Remote { gateway: PEER };
    entry.source = source;
    Arc::new(entry)
}

struct One(Arc<Entry>);

impl View for One {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        (name == "arm").then(|| Arc::clone(&self.0))
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        (incarnation == ARM).then(|| Arc::clone(&self.0))
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        [Arc::clone(&self.0)].into()
    }
}

struct Gateway {
    core: Core,
    entry: Arc<Entry>,
    now: Now,
}

impl Gateway {
    fn new(locations: Vec<Location>) -> Self {
        let entry = entry(locations, Source::Exchange);
        let own = Incarnation::from_u64(1);
        let config = CoreConfig::new("gateway", own, vec![Kind::Tcp]);
        let mut core = Core::new(config, Arc::new(One(Arc::clone(&entry))));
        core.register("rover".into(), ROVER);
        let now = Now {
            instant: Instant::now(),
            utc: SystemTime::UNIX_EPOCH,
        };
        Self { core, entry, now }
    }

    /// The peer has a certificate.
    fn proves(&mut self) {
        let introduction = Introduction {
            name: "peer".into(),
            hop: Hop {
                location: tcp(1),
                principal: Principal::Certificate([1; 32]),
            },
            dialed: None,
            mandate: Mandate::Certified([].into()),
        };
        self.core.handle_introduced(self.now, &introduction);
    }

    fn send(&mut self) {
        let submission = Submission {
            sender: ROVER,
            letter: letter(),
            receivers: vec!["arm".into()],
            deadline: Duration::from_secs(60),
        };
        self.core.submit(self.now, submission);
    }

    /// Handles an announcement. Returns the locations that the peer has left.
    fn announced(&mut self, locations: Vec<Location>, source: Source) -> Vec<Location> {
        let after = entry(locations, source);
        let before = std::mem::replace(&mut self.entry, Arc::clone(&after));
        self.core.set_view(Arc::new(One(Arc::clone(&after))));
        let vacated = self.core.handle_relocation(&before, &after);
        self.core.handle_directory_change(self.now);
        vacated
    }

    fn dispatched(&mut self) -> Option<(AttemptId, Location)> {
        match self.core.poll_action() {
            Some(Action::Dispatch {
                attempt, location, ..
            }) => Some((attempt, location)),
            None => None,
            other => panic!("{other:?}"),
        }
    }

    fn abandoned(&mut self) -> Option<(AttemptId, TransportError)> {
        match self.core.poll_action() {
            Some(Action::Abandon { attempt, error, .. }) => Some((attempt, error)),
            None => None,
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn an_attempt_at_a_location_that_its_service_has_left_ends_and_the_letter_goes_to_the_new_one() {
    let mut gateway = Gateway::new(vec![tcp(1)]);
    gateway.send();
    let (first, at) = gateway.dispatched().unwrap();
    assert_eq!(at, tcp(1));
    assert_eq!(gateway.announced(vec![tcp(2)], Source::Mdns), [tcp(1)]);
    let (abandoned, error) = gateway.abandoned().unwrap();
    assert_eq!(abandoned, first);
    let conclusion = Conclusion::Unconfirmed(error);
    gateway
        .core
        .handle_conclusion(gateway.now, first, conclusion);
    // After the pause that follows any attempt without an answer.
    let (second, at) = loop {
        if let Some(dispatched) = gateway.dispatched() {
            break dispatched;
        }
        let due = gateway.core.poll_timeout().unwrap();
        gateway.now.instant = due;
        gateway.core.handle_timeout(gateway.now);
    };
    assert_eq!(at, tcp(2));
    let accepted = Conclusion::Answered(Answer::Accepted);
    gateway
        .core
        .handle_conclusion(gateway.now, second, accepted);
    let Some(Action::Outcome { outcome, .. }) = gateway.core.poll_action() else {
        panic!("no outcome");
    };
    assert!(matches!(outcome, Outcome::Delivered { .. }), "{outcome}");
}

#[test]
fn an_attempt_continues_while_its_location_is_announced() {
    let mut gateway = Gateway::new(vec![tcp(1)]);
    gateway.send();
    gateway.dispatched().unwrap();
    let none: [Location; 0] = [];
    assert_eq!(gateway.announced(vec![tcp(2), tcp(1)], Source::Mdns), none);
    assert_eq!(gateway.abandoned(), None);
}

/// Each host of the network can announce by mDNS.
#[test]
fn the_announcement_of_a_peer_with_a_certificate_counts_only_from_itself() {
    let mut gateway = Gateway::new(vec![tcp(1)]);
    gateway.proves();
    gateway.send();
    gateway.dispatched().unwrap();
    let none: [Location; 0] = [];
    assert_eq!(gateway.announced(vec![tcp(2)], Source::Mdns), none);
    assert_eq!(gateway.abandoned(), None);
    gateway.announced(vec![tcp(1)], Source::Exchange);
    assert_eq!(gateway.announced(vec![tcp(2)], Source::Exchange), [tcp(1)]);
    assert!(gateway.abandoned().is_some());
}
