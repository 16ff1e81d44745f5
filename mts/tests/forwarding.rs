//! The gateway's role, step by step: custody, late answers, reports, stamps and loops.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::collections::VecDeque;
use std::net::{IpAddr, Ipv4Addr};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::Letter;
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission, Unframed};
use fipa_sds::{Directory, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Kind,
    LegacySource, Location, Outcome, Parcel, Principal, Reaction, Report, Signature, Stream,
    Ticket,
};

use self::common::letter;

const HERE: IpAddr = IpAddr::V4(Ipv4Addr::LOCALHOST);

/// The source of a letter from fipa_services at this address.
fn legacy(address: IpAddr) -> LegacySource {
    LegacySource {
        address,
        signature: Signature::FipaServices,
    }
}
const GATEWAY: Incarnation = Incarnation::from_u64(0x6a7e);
const ROVER: Incarnation = Incarnation::from_u64(0x50e4);
const ARM: Incarnation = Incarnation::from_u64(0xa53);

struct Gateway {
    core: Core,
    /// Actions that were not looked at yet.
    actions: VecDeque<Action>,
    /// Whether arrivals over shared memory may be answered later.
    late: bool,
    start: Instant,
}

impl Gateway {
    /// A gateway whose directory has one agent, `arm`, in a process of its host.
    fn new(forwards: bool) -> Self {
        let directory = MemoryDirectory::new(MtsId::new("process", Incarnation::from_u64(0x9)));
        let arm = Registration::new("arm", ARM, vec![shm(0x9)]);
        directory.register(arm).unwrap();
        let order = vec![Kind::Shm, Kind::Tcp];
        let config = CoreConfig {
            forwards,
            ..CoreConfig::new("gateway", GATEWAY, order)
        };
        Self {
            core: Core::new(config, Arc::new(directory)),
            actions: VecDeque::new(),
            late: false,
            start: Instant::now(),
        }
    }

    fn at(&self, ms: u64) -> Now {
        let since = Duration::from_millis(ms);
        Now {
            instant: self.start + since,
            utc: SystemTime::UNIX_EPOCH + since,
        }
    }

    fn arrive(&mut self, ms: u64, via: Kind, parcel: Parcel) -> Reaction {
        let from = Hop {
            location: tcp(0x1),
            principal: match via {
                Kind::Tcp => Principal::Unproved,
                _ => Principal::Host,
            },
        };
        let arrival = Arrival {
            parcel,
            from,
            ticket: (via != Kind::Shm || self.late).then_some(Ticket(7)),
        };
        let now = self.at(ms);
        let verdict = self.core.handle_arrival(now, via, arrival);
        // As the runtime does, also for the refresh that follows a contact.
        while let Some(action) = self.core.poll_action() {
            match action {
                Action::Refresh { number } => self.core.handle_refreshed(now, number),
                other => self.actions.push_back(other),
            }
        }
        verdict
    }

    fn poll_action(&mut self) -> Option<Action> {
        let earlier = self.actions.pop_front();
        earlier.or_else(|| self.core.poll_action())
    }

    fn conclude(&mut self, ms: u64, attempt: AttemptId, answer: Answer) {
        let now = self.at(ms);
        self.core
            .handle_conclusion(now, attempt, Conclusion::Answered(answer));
    }

    fn time(&mut self, ms: u64) {
        let now = self.at(ms);
        self.core.handle_timeout(now);
    }

    /// The next action except contacts.
    fn next(&mut self) -> Option<Action> {
        match self.poll_action() {
            Some(Action::ContactSeen { .. } | Action::Suspect { .. }) => self.poll_action(),
            other => other,
        }
    }

    fn dispatched(&mut self) -> (AttemptId, Location, Parcel) {
        match self.next() {
            Some(Action::Dispatch {
                attempt,
                location,
                parcel,
            }) => (attempt, location, parcel),
            other => panic!("a dispatch was expected, not {other:?}"),
        }
    }

    fn answered(&mut self) -> Answer {
        match self.poll_action() {
            Some(Action::Answer {
                kind: Kind::Tcp,
                ticket: Ticket(7),
                answer,
            }) => answer,
            other => panic!("an answer was expected, not {other:?}"),
        }
    }

    fn nothing_to_do(&mut self) {
        let action = self.poll_action();
        assert!(action.is_none(), "{action:?}");
    }
}

fn shm(of: u64) -> Location {
    let incarnation = Incarnation::from_u64(of);
    Location::new(Kind::Shm, &incarnation.to_string())
        .unwrap()
        .with_incarnation(incarnation)
}

fn tcp(of: u64) -> Location {
    let at = Location::new(Kind::Tcp, "192.0.2.1:7788").unwrap();
    at.with_incarnation(Incarnation::from_u64(of))
}

fn parcel(sequence: u64, letter: Letter) -> Parcel {
    Parcel {
        receiver: "arm".into(),
        stream: Stream::between(ROVER, ARM),
        sequence,
        after: 0,
        transfer: 1,
        remaining: Duration::from_secs(2),
        body: Body::Letter(letter),
    }
}

#[test]
fn the_answer_to_a_peer_waits_for_the_outcome() {
    let mut gateway = Gateway::new(true);
    assert_eq!(
        gateway.arrive(0, Kind::Tcp, parcel(1, letter())),
        Reaction::Later
    );
    let (attempt, location, passed_on) = gateway.dispatched();
    assert_eq!(location, shm(0x9));
    assert_eq!((passed_on.sequence, passed_on.after), (1, 0));
    assert!(
        passed_on.remaining < Duration::from_secs(2),
        "services further down the route time out earlier"
    );
    gateway.nothing_to_do();
    gateway.conclude(1, attempt, Answer::Accepted);
    assert_eq!(gateway.answered(), Answer::Accepted);
    gateway.nothing_to_do();
}

#[test]
fn the_answer_to_a_process_of_the_host_names_the_transport() {
    let mut gateway = Gateway::new(true);
    gateway.late = true;
    let verdict = gateway.arrive(0, Kind::Shm, parcel(1, letter()));
    assert_eq!(verdict, Reaction::Later);
    let (attempt, ..) = gateway.dispatched();
    gateway.nothing_to_do();
    gateway.conclude(1, attempt, Answer::Accepted);
    match gateway.core.poll_action() {
        Some(Action::Answer {
            kind: Kind::Shm,
            answer: Answer::Delivered { via: Kind::Shm },
            ..
        }) => {}
        other => panic!("{other:?}"),
    }
    gateway.nothing_to_do();
}

#[test]
fn a_slow_receiver_causes_custody_and_a_report() {
    let mut gateway = Gateway::new(true);
    assert_eq!(
        gateway.arrive(0, Kind::Tcp, parcel(1, letter())),
        Reaction::Later
    );
    let (attempt, ..) = gateway.dispatched();
    gateway.conclude(1, attempt, Answer::Busy);
    assert_eq!(gateway.answered(), Answer::Custody);
    gateway.time(500);
    let (attempt, ..) = gateway.dispatched();
    gateway.conclude(501, attempt, Answer::Accepted);
    let (_, back, report) = gateway.dispatched();
    assert_eq!(back, tcp(0x1));
    assert_eq!(report.sequence, 1);
    match report.body {
        Body::Report(Report::Settled(outcome)) => assert_eq!(outcome.via(), Some(Kind::Shm)),
        other => panic!("{other:?}"),
    }
}

#[test]
fn an_arrival_without_a_ticket_is_answered_at_once_with_custody() {
    let mut gateway = Gateway::new(true);
    let verdict = gateway.arrive(0, Kind::Shm, parcel(1, letter()));
    assert_eq!(verdict, Reaction::Now(Answer::Custody));
    let (attempt, ..) = gateway.dispatched();
    gateway.conclude(1, attempt, Answer::failed(FailureReason::Refused, "no"));
    let (attempt, _, report) = gateway.dispatched();
    match report.body {
        Body::Report(Report::Settled(outcome)) => assert!(matches!(
            outcome,
            Outcome::Failed {
                reason: FailureReason::Refused,
                ..
            }
        )),
        other => panic!("{other:?}"),
    }
    // A lost report is sent again.
    let broken =
        fipa_transport::TransportError::new(fipa_transport::TransportErrorKind::Broken, "");
    let now = gateway.at(2);
    gateway
        .core
        .handle_conclusion(now, attempt, Conclusion::Unconfirmed(broken));
    gateway.nothing_to_do();
    gateway.time(200);
    assert!(matches!(gateway.dispatched().2.body, Body::Report(_)));
}

#[test]
fn a_copy_of_a_letter_in_custody_is_not_a_second_letter() {
    let mut gateway = Gateway::new(true);
    assert_eq!(
        gateway.arrive(0, Kind::Shm, parcel(1, letter())),
        Reaction::Now(Answer::Custody)
    );
    let (attempt, ..) = gateway.dispatched();
    assert_eq!(
        gateway.arrive(1, Kind::Shm, parcel(1, letter())),
        Reaction::Now(Answer::Custody)
    );
    gateway.nothing_to_do();
    gateway.conclude(2, attempt, Answer::Accepted);
    assert!(matches!(gateway.dispatched().2.body, Body::Report(_)));
    gateway.nothing_to_do();
}

#[test]
fn a_forwarded_letter_is_stamped_and_a_returning_one_is_a_loop() {
    let mut gateway = Gateway::new(true);
    assert_eq!(
        gateway.arrive(0, Kind::Tcp, parcel(1, letter())),
        Reaction::Later
    );
    let (_, _, passed_on) = gateway.dispatched();
    let Body::Letter(stamped) = passed_on.body else {
        panic!("no letter")
    };
    assert!(stamped.envelope_len() > letter().envelope_len());
    assert_eq!(stamped.payload(), letter().payload());
    match gateway.arrive(1, Kind::Tcp, parcel(2, stamped.clone())) {
        Reaction::Now(Answer::Failed {
            reason: FailureReason::Loop,
            ..
        }) => {}
        other => panic!("{other:?}"),
    }
    // A stamp of another gateway with the same name is not a loop.
    let mut namesake = Gateway::new(true);
    let order = vec![Kind::Shm];
    let directory = MemoryDirectory::new(MtsId::new("process", Incarnation::from_u64(0x9)));
    directory
        .register(Registration::new("arm", ARM, vec![shm(0x9)]))
        .unwrap();
    let config = CoreConfig {
        forwards: true,
        ..CoreConfig::new("gateway", Incarnation::from_u64(0x6a7f), order)
    };
    namesake.core = Core::new(config, Arc::new(directory));
    assert_eq!(
        namesake.arrive(1, Kind::Tcp, parcel(2, stamped)),
        Reaction::Later
    );
}

#[test]
fn a_malformed_envelope_is_refused() {
    let mut gateway = Gateway::new(true);
    let nonsense = Letter::new(bytes::Bytes::from_static(b"\xfe\x00"), bytes::Bytes::new());
    match gateway.arrive(0, Kind::Tcp, parcel(1, nonsense)) {
        Reaction::Now(Answer::Failed {
            reason: FailureReason::Refused,
            detail,
        }) => {
            assert!(!detail.is_empty());
        }
        other => panic!("{other:?}"),
    }
    gateway.nothing_to_do();
}

#[test]
fn a_robot_process_forwards_nothing() {
    let mut process = Gateway::new(false);
    match process.arrive(0, Kind::Tcp, parcel(1, letter())) {
        Reaction::Now(Answer::Failed {
            reason: FailureReason::NoSuchAgent,
            ..
        }) => {}
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_lane_that_is_full_holds_back_and_gives_credit() {
    let mut gateway = Gateway::new(true);
    let bound = gateway.core.config().lane as u64;
    for sequence in 1..=bound {
        assert_eq!(
            gateway.arrive(0, Kind::Shm, parcel(sequence, letter())),
            Reaction::Now(Answer::Custody)
        );
    }
    assert_eq!(
        gateway.arrive(0, Kind::Shm, parcel(bound + 1, letter())),
        Reaction::Now(Answer::Busy)
    );
    let mut credits = 0;
    let mut delivered = 0;
    while delivered < bound {
        let (attempt, _, parcel) = gateway.dispatched();
        match parcel.body {
            Body::Letter(_) => delivered += 1,
            Body::Credit => credits += 1,
            Body::Report(_) | Body::Predecessor => {}
        }
        gateway.conclude(1, attempt, Answer::Accepted);
    }
    assert_eq!(credits, 1);
}

#[test]
fn a_legacy_peers_letter_goes_to_the_receiver_in_its_envelope() {
    let mut gateway = Gateway::new(true);
    let now = gateway.at(0);
    gateway.core.handle_unframed(
        now,
        Duration::from_secs(2),
        &mut read(&gateway.core, letter(), Kind::Tcp, HERE),
    );
    let (attempt, location, parcel) = gateway.dispatched();
    assert_eq!(location, shm(0x9));
    assert_eq!(&*parcel.receiver, "arm");
    assert_eq!(
        parcel.stream.sender, GATEWAY,
        "the gateway vouches for order and duplicates"
    );
    gateway.conclude(1, attempt, Answer::Accepted);
    gateway.nothing_to_do();
}

#[test]
fn a_failed_route_is_avoided_during_its_backoff() {
    let directory = MemoryDirectory::new(MtsId::new("process", Incarnation::from_u64(0x9)));
    directory
        .register(Registration::new("arm", ARM, vec![shm(0x9), tcp(0x9)]))
        .unwrap();
    let order = vec![Kind::Shm, Kind::Tcp];
    let config = CoreConfig::new("process", Incarnation::from_u64(0x8), order);
    let mut core = Core::new(config, Arc::new(directory));
    core.register("rover".into(), ROVER);
    let start = Instant::now();
    let at = |ms: u64| Now {
        instant: start + Duration::from_millis(ms),
        utc: SystemTime::UNIX_EPOCH,
    };
    let send = |core: &mut Core, ms| {
        let receivers = vec!["arm".into()];
        let deadline = Duration::from_secs(2);
        let letter = letter();
        core.submit(
            at(ms),
            Submission {
                sender: ROVER,
                letter,
                receivers,
                deadline,
            },
        );
        match core.poll_action() {
            Some(Action::Dispatch {
                attempt, location, ..
            }) => (attempt, location.kind()),
            other => panic!("{other:?}"),
        }
    };
    let accepted = || Conclusion::Answered(Answer::Accepted);
    let (attempt, first) = send(&mut core, 0);
    assert_eq!(first, Kind::Shm);
    let error = fipa_transport::TransportError::new(fipa_transport::TransportErrorKind::Broken, "");
    core.handle_conclusion(at(1), attempt, Conclusion::NotSent(error));
    let Some(Action::Dispatch {
        attempt, location, ..
    }) = core.poll_action()
    else {
        panic!()
    };
    assert_eq!(location.kind(), Kind::Tcp);
    core.handle_conclusion(at(2), attempt, accepted());
    match core.poll_action() {
        Some(Action::Outcome {
            outcome: Outcome::Delivered { via, attempts },
            ..
        }) => {
            assert_eq!(via, Kind::Tcp);
            assert_eq!(attempts.len(), 1);
        }
        other => panic!("{other:?}"),
    }
    let (attempt, next) = send(&mut core, 10);
    assert_eq!(next, Kind::Tcp, "a broken route is not tried twice");
    core.handle_conclusion(at(11), attempt, accepted());
    core.poll_action();
    let (_, later) = send(&mut core, 1000);
    assert_eq!(later, Kind::Shm, "the route is tried again");
}

#[test]
fn an_unknown_sender_becomes_a_contact() {
    let mut gateway = Gateway::new(true);
    assert_eq!(
        gateway.arrive(0, Kind::Tcp, parcel(1, letter())),
        Reaction::Later
    );
    match gateway.poll_action() {
        Some(Action::ContactSeen {
            name,
            agent,
            location,
            ..
        }) => {
            assert_eq!((&*name, agent, location), ("rover", ROVER, tcp(0x1)));
        }
        other => panic!("{other:?}"),
    }
    assert!(matches!(
        gateway.poll_action(),
        Some(Action::Dispatch { .. })
    ));
    // Senders of this host are in its directory, or must not be.
    gateway.arrive(0, Kind::Shm, parcel(2, letter()));
    assert!(matches!(
        gateway.poll_action(),
        Some(Action::Dispatch { .. })
    ));
}

/// A predecessor must be below its letter, and sequence numbers begin at 1.
#[test]
fn a_letter_whose_predecessor_is_not_below_it_is_refused() {
    let mut gateway = Gateway::new(true);
    for (sequence, after) in [(5, 5), (5, 7), (0, 0), (0, 3), (7, 5)] {
        let parcel = Parcel {
            after,
            ..parcel(sequence, letter())
        };
        let verdict = gateway.arrive(0, Kind::Tcp, parcel);
        if after < sequence {
            assert_eq!(verdict, Reaction::Later);
            continue;
        }
        let Reaction::Now(Answer::Failed { reason, .. }) = verdict else {
            panic!("{sequence} after {after}: {verdict:?}");
        };
        assert_eq!(reason, FailureReason::Refused);
    }
    let (_, _, first) = gateway.dispatched();
    assert_eq!((first.sequence, first.after), (7, 5));
}

/// A custodian forwards the predecessor as received, also when the predecessor failed here.
#[test]
fn a_custodian_never_lowers_a_predecessor_by_itself() {
    let mut gateway = Gateway::new(true);
    gateway.arrive(0, Kind::Tcp, parcel(7, letter()));
    gateway.dispatched();
    gateway.time(2500);
    let next = Parcel {
        after: 7,
        ..parcel(8, letter())
    };
    assert_eq!(gateway.arrive(2600, Kind::Tcp, next), Reaction::Later);
    let passed_on = std::iter::from_fn(|| gateway.next()).find_map(|action| match action {
        Action::Dispatch { parcel, .. } => {
            Some(parcel).filter(|it| matches!(it.body, Body::Letter(_)))
        }
        _ => None,
    });
    let passed_on = passed_on.unwrap();
    assert_eq!((passed_on.sequence, passed_on.after), (8, 7));
}

/// A letter whose predecessor does not arrive is returned, and does not wait any longer.
#[test]
fn a_letter_without_its_predecessor_is_returned() {
    let mut gateway = Gateway::new(true);
    let orphan = Parcel {
        after: 7,
        ..parcel(8, letter())
    };
    assert_eq!(gateway.arrive(0, Kind::Tcp, orphan), Reaction::Later);
    let (attempt, ..) = gateway.dispatched();
    gateway.conclude(1, attempt, Answer::OutOfOrder { last: 3 });
    gateway.nothing_to_do();
    gateway.time(49);
    gateway.nothing_to_do();
    gateway.time(51);
    assert_eq!(gateway.answered(), Answer::Returned { uncertain: false });
    gateway.nothing_to_do();
}

/// The same letter waits for its predecessor when that arrives in time.
#[test]
fn a_letter_waits_for_a_predecessor_that_comes() {
    let mut gateway = Gateway::new(true);
    let early = Parcel {
        after: 7,
        ..parcel(8, letter())
    };
    gateway.arrive(0, Kind::Tcp, early);
    let (attempt, ..) = gateway.dispatched();
    gateway.conclude(1, attempt, Answer::OutOfOrder { last: 3 });
    gateway.arrive(20, Kind::Tcp, parcel(7, letter()));
    // The letter leaves behind its predecessor, on the same route.
    let (first, _, parcel) = gateway.dispatched();
    assert_eq!(parcel.sequence, 7);
    let (second, _, parcel) = gateway.dispatched();
    assert_eq!((parcel.sequence, parcel.after), (8, 7));
    gateway.conclude(21, first, Answer::Accepted);
    assert_eq!(gateway.answered(), Answer::Accepted);
    gateway.conclude(22, second, Answer::Accepted);
    assert_eq!(gateway.answered(), Answer::Accepted);
    gateway.time(60);
    gateway.nothing_to_do();
}

/// A letter that came back while its predecessor is in transit waits for the end of that attempt.
#[test]
fn a_letter_waits_while_its_predecessor_is_under_way() {
    let mut gateway = Gateway::new(true);
    gateway.arrive(0, Kind::Tcp, parcel(7, letter()));
    let (first, ..) = gateway.dispatched();
    let behind = Parcel {
        after: 7,
        ..parcel(8, letter())
    };
    gateway.arrive(0, Kind::Tcp, behind);
    let (second, ..) = gateway.dispatched();
    gateway.conclude(1, second, Answer::OutOfOrder { last: 3 });
    gateway.time(100);
    gateway.nothing_to_do();
    gateway.conclude(101, first, Answer::Accepted);
    assert_eq!(gateway.answered(), Answer::Accepted);
    let (_, _, again) = gateway.dispatched();
    assert_eq!((again.sequence, again.after), (8, 7));
}

/// The sender's process sends a custodian the new predecessor of a letter after the previous one
/// failed: the letter continues without being returned.
#[test]
fn a_note_lowers_the_predecessor_of_a_held_letter() {
    let mut gateway = Gateway::new(true);
    let held = Parcel {
        after: 7,
        ..parcel(8, letter())
    };
    gateway.arrive(0, Kind::Tcp, held);
    let (attempt, ..) = gateway.dispatched();
    gateway.conclude(1, attempt, Answer::OutOfOrder { last: 3 });
    let note = Parcel {
        after: 3,
        body: Body::Predecessor,
        ..parcel(8, letter())
    };
    assert_eq!(
        gateway.arrive(2, Kind::Tcp, note),
        Reaction::Now(Answer::Accepted)
    );
    let (_, _, again) = gateway.dispatched();
    assert_eq!((again.sequence, again.after), (8, 3));
}

/// Parses the letter for this core.
fn read(core: &Core, letter: Letter, via: Kind, from: IpAddr) -> Unframed {
    Unframed::read(letter, via, legacy(from), &**core.view()).unwrap()
}
