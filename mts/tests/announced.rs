//! A gateway holds the letters of a newly registered agent until a legacy peer that was found by
//! mDNS can have found that agent.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Directory, Entry, MtsId, Reach, Role, Source, Subscriber};
use fipa_transport::{
    Answer, Arrival, Conclusion, Hop, Incarnation, Kind, Parcel, Principal, Reaction,
};

const ROVER: Incarnation = Incarnation::from_u64(0xb);
const PROCESS: Incarnation = Incarnation::from_u64(0x1);
const GATEWAY: Incarnation = Incarnation::from_u64(0x7);

/// A directory that does not change.
struct Fixed(Arc<[Arc<Entry>]>);

impl Directory for Fixed {
    fn known(&self, name: &str) -> Option<Arc<Entry>> {
        self.0.iter().find(|entry| &*entry.name == name).cloned()
    }

    fn known_incarnation(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        let mut known = self.0.iter().filter(|entry| entry.incarnation.is_known());
        known
            .find(|entry| entry.incarnation == incarnation)
            .cloned()
    }

    fn entries(&self) -> Arc<[Arc<Entry>]> {
        Arc::clone(&self.0)
    }

    fn generation(&self) -> u64 {
        0
    }

    fn subscribe(&self, _: &Subscriber) {}
}

fn entry(name: &str, incarnation: Incarnation, at: &str) -> Entry {
    Entry {
        name: name.into(),
        agent_type: String::new(),
        incarnation,
        locations: vec![at.parse().unwrap()],
        mts: MtsId::new("mts", PROCESS),
        description: String::new(),
        registered: SystemTime::UNIX_EPOCH,
        source: Source::Host,
        reach: Reach::Local,
        peer: fipa_transport::PeerId::THIS_HOST,
        role: Role::Agent,
    }
}

/// The agent `arm`, as in the gateway's directory.
fn arm(at: &str, source: Source) -> Entry {
    Entry {
        source,
        reach: Reach::Remote {
            gateway: Incarnation::UNKNOWN,
        },
        ..entry("arm", Incarnation::UNKNOWN, at)
    }
}

const LEGACY: &str = "tcp://10.0.0.3:6789;fipa-services";

/// A gateway on virtual time, which starts when the agent `rover` is registered.
struct Gateway {
    core: Core,
    start: Instant,
    registered: SystemTime,
}

impl Gateway {
    fn new(arm: Entry) -> Self {
        let registered = SystemTime::UNIX_EPOCH + Duration::from_secs(1 << 30);
        let rover = Entry {
            registered,
            ..entry("rover", ROVER, "shm://1#0000000000000001")
        };
        let config = CoreConfig {
            forwards: true,
            ..CoreConfig::new("gateway", GATEWAY, vec![Kind::Shm, Kind::Tcp])
        };
        let directory = Fixed([Arc::new(rover), Arc::new(arm)].into());
        Self {
            core: Core::new(config, Arc::new(directory)),
            start: Instant::now(),
            registered,
        }
    }

    fn at(&self, ms: u64) -> Now {
        let since = Duration::from_millis(ms);
        Now {
            instant: self.start + since,
            utc: self.registered + since,
        }
    }

    /// A letter from `rover` to `arm` arrives, and is taken into custody.
    fn takes(&mut self, ms: u64, remaining: Duration) {
        let arrival = Arrival {
            parcel: Parcel {
                remaining,
                ..parcel()
            },
            from: Hop {
                location: "shm://1#0000000000000001".parse().unwrap(),
                principal: Principal::Host,
            },
            ticket: None,
        };
        let now = self.at(ms);
        let verdict = self.core.handle_arrival(now, Kind::Shm, arrival);
        assert_eq!(verdict, Reaction::Now(Answer::Custody));
    }

    /// The time at which the letter is dispatched, by the timers of the core alone.
    fn dispatches_at(&mut self) -> Duration {
        let mut now = self.start;
        loop {
            match self.core.poll_action() {
                Some(Action::Dispatch {
                    attempt, location, ..
                }) => {
                    assert_eq!(location.kind(), Kind::Tcp);
                    let at = now.duration_since(self.start);
                    let conclusion = Conclusion::Handed;
                    let then = self.at(u64::try_from(at.as_millis()).unwrap());
                    self.core.handle_conclusion(then, attempt, conclusion);
                    return at;
                }
                Some(other) => panic!("{other:?}"),
                None => {
                    now = self.core.poll_timeout().unwrap();
                    let since = now.duration_since(self.start);
                    let utc = self.registered + since;
                    self.core.handle_timeout(Now { instant: now, utc });
                }
            }
        }
    }
}

/// The parcel of a letter from `rover` to `arm`, as the process of `rover` dispatches it.
fn parcel() -> Parcel {
    let at = "shm://7#0000000000000007";
    let remote = arm(at, Source::Mdns);
    let config = CoreConfig::new("mts", PROCESS, vec![Kind::Shm]);
    let mut core = Core::new(config, Arc::new(Fixed([Arc::new(remote)].into())));
    core.register("rover".into(), ROVER);
    let message = Message::builder(Performative::Request)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .build()
        .unwrap();
    let now = Now {
        instant: Instant::now(),
        utc: SystemTime::UNIX_EPOCH,
    };
    let submission = Submission {
        sender: ROVER,
        letter: letter_for(&message, now.utc).unwrap(),
        receivers: vec!["arm".into()],
        deadline: Duration::from_secs(5),
    };
    core.submit(now, submission);
    match core.poll_action() {
        Some(Action::Dispatch { parcel, .. }) => parcel,
        other => panic!("{other:?}"),
    }
}

const LONG: Duration = Duration::from_secs(5);

fn ms(milliseconds: u64) -> Duration {
    Duration::from_millis(milliseconds)
}

#[test]
fn a_letter_to_a_legacy_peer_waits_until_its_sender_can_be_found() {
    let mut gateway = Gateway::new(arm(LEGACY, Source::Mdns));
    gateway.takes(100, LONG);
    assert_eq!(gateway.dispatches_at(), ms(1500));
}

#[test]
fn letters_of_an_agent_that_was_registered_earlier_do_not_wait() {
    let mut gateway = Gateway::new(arm(LEGACY, Source::Mdns));
    gateway.takes(1500, LONG);
    assert!(matches!(
        gateway.core.poll_action(),
        Some(Action::Dispatch { .. })
    ));
}

#[test]
fn a_letter_with_a_short_deadline_waits_for_less() {
    let mut gateway = Gateway::new(arm(LEGACY, Source::Mdns));
    gateway.takes(0, ms(1000));
    assert_eq!(gateway.dispatches_at(), ms(750));
    let mut gateway = Gateway::new(arm(LEGACY, Source::Mdns));
    gateway.takes(0, ms(100));
    assert_eq!(gateway.dispatches_at(), ms(50));
}

#[test]
fn letters_to_other_receivers_do_not_wait() {
    let frames = "tcp://10.0.0.3:7788#0000000000000009";
    for arm in [arm(LEGACY, Source::Static), arm(frames, Source::Mdns)] {
        let mut gateway = Gateway::new(arm);
        gateway.takes(0, LONG);
        assert!(matches!(
            gateway.core.poll_action(),
            Some(Action::Dispatch { .. })
        ));
    }
}

#[test]
fn a_clock_that_was_set_back_does_not_prolong_the_wait() {
    let mut gateway = Gateway::new(arm(LEGACY, Source::Mdns));
    gateway.registered -= Duration::from_secs(3600);
    gateway.takes(0, LONG);
    assert_eq!(gateway.dispatches_at(), ms(1500));
}
