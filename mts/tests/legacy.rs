//! Letters to and from agents of legacy peers: failures that are certain at once, and their
//! reasons.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::letter_for;
use fipa_sds::{Directory, StaticDirectory};
use fipa_transport::{
    Answer, AttemptId, Conclusion, FailureReason, Incarnation, Kind, Location, Outcome,
    TransportError, TransportErrorKind,
};

const ROVER: Incarnation = Incarnation::from_u64(0xb);
const DEADLINE: Duration = Duration::from_secs(5);

/// The core of the process of the agent `rover`, on virtual time. The agent `arm` belongs to a
/// legacy peer.
struct Bench {
    core: Core,
    start: Instant,
}

impl Bench {
    fn new(locations: &[&str]) -> Self {
        Self::with_window(locations, 16)
    }

    /// The same, with this many letters in transit at a time.
    fn with_window(locations: &[&str], window: usize) -> Self {
        Self::with_transports(vec![Kind::Shm, Kind::Tcp, Kind::Udp], locations, window)
    }

    /// The same, with these transports.
    fn with_transports(order: Vec<Kind>, locations: &[&str], window: usize) -> Self {
        let locations: Vec<Location> = locations.iter().map(|it| it.parse().unwrap()).collect();
        let directory: Arc<dyn Directory> =
            Arc::new(StaticDirectory::new([("arm", locations)]).unwrap());
        let config = CoreConfig {
            window,
            ..CoreConfig::new("mts", Incarnation::from_u64(1), order)
        };
        let mut core = Core::new(config, directory.view());
        core.register("rover".into(), ROVER);
        Self {
            core,
            start: Instant::now(),
        }
    }

    fn at(&self, ms: u64) -> Now {
        Now {
            instant: self.start + Duration::from_millis(ms),
            utc: SystemTime::UNIX_EPOCH,
        }
    }

    fn send(&mut self, ms: u64) {
        self.send_within(ms, DEADLINE);
    }

    fn send_within(&mut self, ms: u64, deadline: Duration) {
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .build()
            .unwrap();
        let submission = Submission {
            sender: ROVER,
            letter: letter_for(&message, SystemTime::UNIX_EPOCH).unwrap(),
            receivers: vec!["arm".into()],
            deadline,
        };
        self.core.submit(self.at(ms), submission);
    }

    /// The next letter that the core dispatches, and the location.
    fn dispatched(&mut self) -> (AttemptId, String) {
        let mut actions = std::iter::from_fn(|| self.core.poll_action());
        let next = actions.find(|action| !matches!(action, Action::Deliverable { .. }));
        match next {
            Some(Action::Dispatch {
                attempt, location, ..
            }) => (attempt, location.to_string()),
            other => panic!("{other:?}"),
        }
    }

    fn not_sent(&mut self, ms: u64, attempt: AttemptId, fault: TransportErrorKind) {
        let conclusion = Conclusion::NotSent(TransportError::new(fault, "for a test"));
        self.core
            .handle_conclusion(self.at(ms), attempt, conclusion);
    }

    fn outcome(&mut self) -> Option<Outcome> {
        std::iter::from_fn(|| self.core.poll_action()).find_map(|action| match action {
            Action::Outcome { outcome, .. } => Some(outcome),
            _ => None,
        })
    }
}

fn reason(outcome: &Outcome) -> FailureReason {
    match outcome {
        Outcome::Failed { reason, .. } => *reason,
        other => panic!("{other}"),
    }
}

#[test]
fn a_letter_that_the_dialect_cannot_express_fails_at_once() {
    let mut bench = Bench::new(&["tcp://10.0.0.3:6789;fipa-services"]);
    bench.send(0);
    let (attempt, _) = bench.dispatched();
    bench.not_sent(1, attempt, TransportErrorKind::Inexpressible);
    let outcome = bench.outcome().unwrap();
    assert_eq!(reason(&outcome), FailureReason::Inexpressible);
    assert_eq!(outcome.attempts().len(), 1);
    assert!(!bench.core.has_open_letters());

    // The route has not failed: the next letter goes there at once.
    bench.send(2);
    assert_eq!(bench.dispatched().1, "tcp://10.0.0.3:6789;fipa-services");
}

#[test]
fn a_letter_that_one_dialect_cannot_express_goes_by_another() {
    let mut bench = Bench::new(&[
        "tcp://10.0.0.3:6789;fipa-services",
        "tcp://10.0.0.3:6790;jade",
    ]);
    bench.send(0);
    let (attempt, _) = bench.dispatched();
    bench.not_sent(1, attempt, TransportErrorKind::Inexpressible);
    let (attempt, location) = bench.dispatched();
    assert_eq!(location, "tcp://10.0.0.3:6790;jade");
    bench
        .core
        .handle_conclusion(bench.at(2), attempt, Conclusion::Handed);
    let outcome = bench.outcome().unwrap();
    assert!(outcome.is_success(), "{outcome}");
}

#[test]
fn a_letter_that_another_location_may_carry_later_is_repeated() {
    let mut bench = Bench::new(&[
        "tcp://10.0.0.3:6789;fipa-services",
        "tcp://10.0.0.3:6790;jade",
    ]);
    bench.send(0);
    let (attempt, _) = bench.dispatched();
    bench.not_sent(1, attempt, TransportErrorKind::Inexpressible);
    let (attempt, _) = bench.dispatched();
    bench.not_sent(2, attempt, TransportErrorKind::Unreachable);
    assert_eq!(bench.outcome(), None);
    bench.core.handle_timeout(bench.at(5001));
    let outcome = bench.outcome().unwrap();
    assert_eq!(reason(&outcome), FailureReason::Unreachable);
}

#[test]
fn a_letter_to_an_agent_that_has_unsupported_transports_only_fails_at_once() {
    let mut bench = Bench::new(&["udt://10.0.0.3:6790;fipa-services"]);
    bench.send(0);
    let outcome = bench.outcome().unwrap();
    assert_eq!(reason(&outcome), FailureReason::Unsupported);
    assert_eq!(
        outcome.to_string(),
        "failed: unsupported transport; tried udt://10.0.0.3:6790;fipa-services: unsupported \
         transport: udt"
    );
    assert!(!bench.core.has_open_letters());

    // A supported location is used.
    let mut bench = Bench::new(&["udt://10.0.0.3:6790", "tcp://10.0.0.3:6789;fipa-services"]);
    bench.send(0);
    assert_eq!(bench.dispatched().1, "tcp://10.0.0.3:6789;fipa-services");
}

/// Letters in the dialect of legacy peers have no number, so a repeated one would be taken twice.
#[test]
fn a_service_of_this_project_is_not_reached_in_the_dialect_of_legacy_peers() {
    let known = "tcp://10.0.0.3:6789;fipa-services#00000000000000ab";
    let mut bench = Bench::new(&[known, "tcp://10.0.0.4:6789;fipa-services"]);
    bench.send(0);
    assert_eq!(bench.dispatched().1, "tcp://10.0.0.4:6789;fipa-services");
}

/// A legacy peer would take a copy for a new letter.
#[test]
fn a_letter_that_a_lost_gateway_may_have_sent_is_not_sent_by_another() {
    let gateways = [
        "shm://000000000000000a#000000000000000a",
        "shm://000000000000000b#000000000000000b",
    ];
    let lost = || TransportError::new(TransportErrorKind::Broken, "the gateway is gone");
    // It ended before it answered.
    let mut bench = Bench::new(&gateways);
    bench.send(0);
    let (attempt, _) = bench.dispatched();
    let unconfirmed = Conclusion::Unconfirmed(lost());
    bench
        .core
        .handle_conclusion(bench.at(1), attempt, unconfirmed);
    let outcome = bench.outcome().unwrap();
    assert_eq!(reason(&outcome), FailureReason::Unconfirmed);
    assert!(!bench.core.has_open_letters());

    // It took the letter, and its successor does not have it.
    let mut bench = Bench::new(&gateways);
    bench.send(0);
    let (attempt, _) = bench.dispatched();
    let custody = Conclusion::Answered(Answer::Custody);
    bench.core.handle_conclusion(bench.at(1), attempt, custody);
    bench.core.handle_timeout(bench.at(1100));
    let (question, _) = bench.dispatched();
    let denied = Conclusion::Answered(Answer::Returned { uncertain: true });
    bench
        .core
        .handle_conclusion(bench.at(1101), question, denied);
    let outcome = bench.outcome().unwrap();
    assert_eq!(reason(&outcome), FailureReason::Unconfirmed);

    // It never got the letter.
    let mut bench = Bench::new(&gateways);
    bench.send(0);
    let (attempt, _) = bench.dispatched();
    bench
        .core
        .handle_conclusion(bench.at(1), attempt, Conclusion::NotSent(lost()));
    assert_eq!(bench.dispatched().1, gateways[1]);
}

const LEGACY: &str = "tcp://10.0.0.3:6789;fipa-services";

/// The outcomes of all letters, in order.
fn outcomes(bench: &mut Bench) -> Vec<Outcome> {
    std::iter::from_fn(|| bench.outcome()).collect()
}

#[test]
fn letters_that_waited_for_a_dead_peer_report_the_attempts() {
    let mut bench = Bench::with_window(&[LEGACY], 1);
    for _ in 0..3 {
        bench.send(0);
    }
    let (attempt, _) = bench.dispatched();
    bench.not_sent(1, attempt, TransportErrorKind::Unreachable);
    bench.core.handle_timeout(bench.at(5001));
    let outcomes = outcomes(&mut bench);
    assert_eq!(outcomes.len(), 3);
    for outcome in outcomes {
        assert_eq!(reason(&outcome), FailureReason::Unreachable);
        let tried = outcome.attempts();
        assert_eq!(tried.len(), 1, "{outcome}");
        assert_eq!(tried[0].location.to_string(), LEGACY);
        assert_eq!(tried[0].error.fault, TransportErrorKind::Unreachable);
    }
    // Each failure message contains it, too.
    for _ in 0..3 {
        let failure = bench.core.take(ROVER).unwrap();
        let failure = Message::decode(failure.letter.payload()).unwrap();
        let text = String::from_utf8(failure.content().unwrap().to_vec()).unwrap();
        assert!(text.contains("unreachable: tcp://10.0.0.3:6789"), "{text}");
    }
    // The next letter does not report the attempts of earlier ones.
    bench.send(5002);
    bench.dispatched();
    bench.core.handle_timeout(bench.at(10_003));
    assert_eq!(bench.outcome(), None);
}

#[test]
fn letters_that_waited_for_a_silent_peer_report_its_location() {
    let mut bench = Bench::with_window(&[LEGACY], 1);
    for _ in 0..2 {
        bench.send(0);
    }
    let (_, _) = bench.dispatched();
    bench.core.handle_timeout(bench.at(5001));
    let outcome = bench.outcome().unwrap();
    assert_eq!(reason(&outcome), FailureReason::TimedOut);
    assert_eq!(outcome.attempts().len(), 1, "{outcome}");
    assert_eq!(outcome.attempts()[0].location.to_string(), LEGACY);
}

#[test]
fn a_letter_to_a_legacy_peer_that_pauses_is_not_given_up() {
    const FAR: Duration = Duration::from_secs(60);
    for location in [LEGACY, "udt://10.0.0.3:6790", "http://10.0.0.3:7778/acc"] {
        let order = vec![Kind::Tcp, Kind::Udt, Kind::Http];
        let mut bench = Bench::with_transports(order, &[location], 16);
        bench.send_within(0, FAR);
        let (attempt, at) = bench.dispatched();
        assert!(at.starts_with(location), "{at}");
        // Longer than a transport waits for a peer that has stopped reading.
        bench.core.handle_timeout(bench.at(13_500));
        assert!(bench.core.poll_action().is_none());
        bench
            .core
            .handle_conclusion(bench.at(13_600), attempt, Conclusion::Handed);
        let outcome = bench.outcome().unwrap();
        assert!(outcome.is_success(), "{outcome}");
    }
}

#[test]
fn the_last_error_of_each_location_is_reported() {
    const FAR: Duration = Duration::from_secs(600);
    let mut bench = Bench::new(&[LEGACY, "tcp://10.0.0.3:6790;jade"]);
    bench.send_within(0, FAR);
    let mut now = bench.start;
    for number in 0..30 {
        let attempt = loop {
            match bench.core.poll_action() {
                Some(Action::Dispatch { attempt, .. }) => break attempt,
                Some(other) => panic!("{other:?}"),
                None => now = bench.core.poll_timeout().unwrap(),
            }
            let utc = SystemTime::UNIX_EPOCH;
            bench.core.handle_timeout(Now { instant: now, utc });
        };
        let fault = match number {
            28.. => TransportErrorKind::Refused,
            _ => TransportErrorKind::Unreachable,
        };
        let ms = now.duration_since(bench.start).as_millis();
        bench.not_sent(u64::try_from(ms).unwrap(), attempt, fault);
    }
    bench.core.handle_timeout(bench.at(600_001));
    let outcome = bench.outcome().unwrap();
    for location in [LEGACY, "tcp://10.0.0.3:6790;jade"] {
        let mut tried = outcome.attempts().iter().rev();
        let last = tried.find(|attempt| attempt.location.to_string() == location);
        assert_eq!(
            last.unwrap().error.fault,
            TransportErrorKind::Refused,
            "{outcome}"
        );
    }
}
