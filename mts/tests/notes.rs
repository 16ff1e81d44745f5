//! Reports of a gateway: without room, and to services that do not answer.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_mts::core::{Action, Core, CoreConfig, MAX_DEADLINE, Now};
use fipa_sds::{Directory, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, Hop, Incarnation, Introduction, Kind, Location,
    Mandate, Parcel, Principal, Reaction, Stream, TransportError, TransportErrorKind,
};

use self::common::letter;

const ARM: Incarnation = Incarnation::from_u64(3);
const ROVER: Incarnation = Incarnation::from_u64(2);
const PROCESS: Incarnation = Incarnation::from_u64(9);

/// A gateway that has one agent, in a process of its host.
struct Gateway {
    core: Core,
    start: Instant,
    now: Instant,
    sequence: u64,
}

impl Gateway {
    fn new() -> Self {
        let directory = MemoryDirectory::new(MtsId::new("process", PROCESS));
        let at = Location::new(Kind::Shm, &PROCESS.to_string()).unwrap();
        let at = at.with_incarnation(PROCESS);
        let arm = Registration::new("arm", ARM, vec![at]);
        directory.register(arm).unwrap();
        let order = vec![Kind::Shm, Kind::Tcp];
        let config = CoreConfig {
            forwards: true,
            ..CoreConfig::new("gateway", Incarnation::from_u64(1), order)
        };
        let start = Instant::now();
        Self {
            core: Core::new(config, Arc::new(directory)),
            start,
            now: start,
            sequence: 0,
        }
    }

    fn clocks(&self) -> Now {
        Now {
            instant: self.now,
            utc: SystemTime::UNIX_EPOCH + (self.now - self.start),
        }
    }

    /// The next parcels that the gateway sends, other than the letter for its agent.
    fn sent(&mut self) -> Vec<(AttemptId, Parcel)> {
        let mut sent = Vec::new();
        while let Some(action) = self.core.poll_action() {
            match action {
                Action::Dispatch {
                    attempt, parcel, ..
                } => sent.push((attempt, parcel)),
                Action::Refresh { number } => {
                    let now = self.clocks();
                    self.core.handle_refreshed(now, number);
                }
                _ => {}
            }
        }
        sent
    }

    fn answer(&mut self, attempt: AttemptId, answer: Answer) {
        self.conclude(attempt, Conclusion::Answered(answer));
    }

    fn conclude(&mut self, attempt: AttemptId, conclusion: Conclusion) {
        let now = self.clocks();
        self.core.handle_conclusion(now, attempt, conclusion);
    }

    fn full(&mut self, attempt: AttemptId) {
        let full = TransportError::new(TransportErrorKind::Congested, "");
        self.conclude(attempt, Conclusion::NotSent(full));
    }

    fn letter(&mut self, from: &Hop) -> Reaction {
        self.sequence += 1;
        let parcel = Parcel {
            receiver: "arm".into(),
            stream: Stream::between(ROVER, ARM),
            sequence: self.sequence,
            after: 0,
            transfer: self.sequence,
            remaining: MAX_DEADLINE,
            body: Body::Letter(letter()),
        };
        let arrival = Arrival {
            parcel,
            from: from.clone(),
            ticket: None,
        };
        let now = self.clocks();
        let kind = from.location.kind();
        self.core.handle_arrival(now, kind, arrival)
    }

    /// A letter of this service is taken. Returns the report about it, if it is sent.
    fn report(&mut self, from: &Hop) -> Vec<(AttemptId, Parcel)> {
        assert_eq!(self.letter(from), Reaction::Now(Answer::Custody));
        let [(letter, _)] = &self.sent()[..] else {
            panic!("no letter");
        };
        self.answer(*letter, Answer::Accepted);
        self.sent()
    }

    /// Advances the time to the next timer, at most until then. Returns whether there was one.
    fn wait(&mut self, until: Duration) -> bool {
        match self.core.poll_timeout() {
            Some(due) if due <= self.start + until => {
                self.now = self.now.max(due);
                let now = self.clocks();
                self.core.handle_timeout(now);
                true
            }
            _ => false,
        }
    }
}

fn peer(number: u64) -> Hop {
    let location = Location::new(Kind::Tcp, &format!("192.0.2.{number}:7100")).unwrap();
    Hop {
        location: location.with_incarnation(Incarnation::from_u64(100 + number)),
        principal: Principal::Unproved,
    }
}

fn only(sent: &[(AttemptId, Parcel)]) -> (AttemptId, u64) {
    let [(attempt, parcel)] = sent else {
        panic!("{sent:?}");
    };
    assert!(matches!(parcel.body, Body::Report(_)));
    (*attempt, parcel.sequence)
}

#[test]
fn a_report_without_room_leaves_when_an_attempt_at_its_location_ends() {
    let mut gateway = Gateway::new();
    let peer = peer(1);
    let (under_way, _) = only(&gateway.report(&peer));
    let (first, _) = only(&gateway.report(&peer));
    gateway.full(first);
    assert_eq!(gateway.sent(), []);
    // Another one does not overtake it.
    assert_eq!(gateway.report(&peer), []);
    gateway.answer(under_way, Answer::Accepted);
    let (first, sequence) = only(&gateway.sent());
    assert_eq!(sequence, 2);
    gateway.answer(first, Answer::Accepted);
    let (second, sequence) = only(&gateway.sent());
    assert_eq!(sequence, 3);
    gateway.answer(second, Answer::Accepted);
    assert_eq!(gateway.sent(), []);
    assert!(!gateway.core.has_open_reports());
}

#[test]
fn a_report_without_room_is_tried_every_50_ms_however_often_it_was_refused() {
    let mut gateway = Gateway::new();
    let (mut attempt, _) = only(&gateway.report(&peer(1)));
    for times in 1..=200 {
        gateway.full(attempt);
        let sent = loop {
            let sent = gateway.sent();
            if !sent.is_empty() {
                break sent;
            }
            assert!(gateway.wait(Duration::from_secs(20)));
        };
        (attempt, _) = only(&sent);
        assert_eq!(
            gateway.now - gateway.start,
            Duration::from_millis(50) * times
        );
    }
}

/// The peer takes reports and answers none of them.
#[test]
fn a_peer_that_acknowledges_no_report_gets_a_few_repetitions_in_an_hour() {
    let mut gateway = Gateway::new();
    let reports = 1000;
    let mut sent = 0;
    for _ in 0..reports {
        sent += gateway.report(&peer(1)).len();
    }
    assert_eq!(sent, reports);
    let mut repeated = 0;
    while gateway.wait(MAX_DEADLINE + Duration::from_secs(120)) {
        repeated += gateway.sent().len();
    }
    // Four when each pause ends: twelve pauses that double, then one a minute.
    assert!(repeated <= 4 * (12 + 60), "{repeated}");
    assert!(repeated >= 100, "{repeated}");
    assert!(!gateway.core.has_open_reports());
}

#[test]
fn reports_that_are_not_acknowledged_use_up_the_share_of_their_peer_only() {
    let mut gateway = Gateway::new();
    for _ in 0..70_000 {
        gateway.report(&peer(1));
    }
    let (lost, sequence) = only(&gateway.report(&peer(2)));
    let broken = TransportError::new(TransportErrorKind::Broken, "");
    gateway.conclude(lost, Conclusion::Unconfirmed(broken));
    let to_second = |sent: Vec<(AttemptId, Parcel)>| {
        let mut numbers = sent.iter().map(|(_, parcel)| parcel.sequence);
        numbers.any(|number| number == sequence)
    };
    while !to_second(gateway.sent()) {
        assert!(gateway.wait(Duration::from_secs(10)), "it is not repeated");
    }
}

#[test]
fn reports_follow_at_once_when_their_peer_answers_again() {
    let mut gateway = Gateway::new();
    for _ in 0..50 {
        gateway.report(&peer(1));
    }
    while gateway.wait(Duration::from_secs(300)) {
        gateway.sent();
    }
    let introduction = Introduction {
        name: "peer".into(),
        hop: peer(1),
        dialed: None,
        mandate: Mandate::Unproved,
    };
    let now = gateway.clocks();
    gateway.core.handle_introduced(now, &introduction);
    let mut acknowledged = 0;
    loop {
        let sent = gateway.sent();
        if sent.is_empty() {
            break;
        }
        for (attempt, _) in sent {
            acknowledged += 1;
            gateway.answer(attempt, Answer::Accepted);
        }
    }
    // The latest repetitions may be under way.
    assert!(acknowledged >= 46, "{acknowledged}");
}

/// The service that handed a letter over asks for it, because the report was lost.
#[test]
fn a_question_about_a_letter_brings_its_report_again() {
    let mut gateway = Gateway::new();
    let peer = peer(1);
    let (_, sequence) = only(&gateway.report(&peer));
    while gateway.wait(Duration::from_secs(300)) {
        gateway.sent();
    }
    let parcel = Parcel {
        receiver: "arm".into(),
        stream: Stream::between(ROVER, ARM),
        sequence,
        after: 0,
        transfer: sequence,
        remaining: Duration::ZERO,
        body: Body::Predecessor,
    };
    let arrival = Arrival {
        parcel,
        from: peer,
        ticket: None,
    };
    let now = gateway.clocks();
    let verdict = gateway.core.handle_arrival(now, Kind::Tcp, arrival);
    assert_eq!(verdict, Reaction::Now(Answer::Accepted));
    let (_, again) = only(&gateway.sent());
    assert_eq!(again, sequence);
}
