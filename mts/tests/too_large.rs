//! A letter that is too large for one route waits for another that the directory does not show at
//! present. An error that no repetition changes ends a letter. A letter that is too long without its content is neither
//! sent nor taken.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, Envelope, EnvelopeTemplate, Letter, Message, Performative};
use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_mts::{LetterDraft, letter_by, letter_for};
use fipa_sds::{Directory as _, MemoryDirectory, MtsId, Registration};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Kind, Location,
    Outcome, Parcel, Principal, Reaction, Stream, Ticket, TransportError, TransportErrorKind,
};

const ARM: Incarnation = Incarnation::from_u64(0xa);
const ROVER: Incarnation = Incarnation::from_u64(0xb);

struct Bench {
    directory: Arc<MemoryDirectory>,
    core: Core,
    start: Instant,
}

impl Bench {
    fn new() -> Self {
        let mts = MtsId::new("mts", Incarnation::from_u64(1));
        let directory = Arc::new(MemoryDirectory::new(mts));
        let order = vec![Kind::Shm, Kind::Udp, Kind::Tcp];
        let config = CoreConfig::new("mts", Incarnation::from_u64(1), order);
        let shared: Arc<dyn fipa_sds::View> = Arc::clone(&directory) as _;
        let mut core = Core::new(config, shared);
        core.register("rover".into(), ROVER);
        let start = Instant::now();
        Self {
            directory,
            core,
            start,
        }
    }

    fn at(&self, ms: u64) -> Now {
        Now {
            instant: self.start + Duration::from_millis(ms),
            utc: SystemTime::UNIX_EPOCH,
        }
    }

    /// Sets the routes to the arm.
    fn reached_by(&mut self, ms: u64, routes: &[&str]) {
        let _ = self.directory.deregister("arm", ARM);
        let locations: Vec<Location> = routes.iter().map(|it| it.parse().unwrap()).collect();
        let arm = Registration::new("arm", ARM, locations);
        self.directory.register(arm).unwrap();
        self.core.handle_directory_change(self.at(ms));
    }

    fn send(&mut self) {
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .build()
            .unwrap();
        let submission = Submission {
            sender: ROVER,
            letter: letter_for(&message, SystemTime::UNIX_EPOCH).unwrap(),
            receivers: vec!["arm".into()],
            deadline: Duration::from_secs(5),
        };
        self.core.submit(self.at(0), submission);
    }

    fn dispatched(&mut self) -> (AttemptId, Kind) {
        match self.core.poll_action() {
            Some(Action::Dispatch {
                attempt, location, ..
            }) => (attempt, location.kind()),
            other => panic!("{other:?}"),
        }
    }

    fn is_too_large(&mut self, ms: u64, attempt: AttemptId) {
        self.fails(ms, attempt, TransportErrorKind::TooLarge);
    }

    fn fails(&mut self, ms: u64, attempt: AttemptId, fault: TransportErrorKind) {
        let error = TransportError::new(fault, "");
        let conclusion = Conclusion::NotSent(error);
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

#[test]
fn a_route_that_comes_back_carries_the_letter() {
    let mut bench = Bench::new();
    bench.reached_by(0, &["udp://192.0.2.1:1"]);
    bench.send();
    let (attempt, kind) = bench.dispatched();
    assert_eq!(kind, Kind::Udp);
    bench.is_too_large(1, attempt);
    assert_eq!(bench.outcome(), None);
    bench.reached_by(500, &["tcp://192.0.2.1:1"]);
    bench.core.handle_timeout(bench.at(600));
    let (attempt, kind) = bench.dispatched();
    assert_eq!(kind, Kind::Tcp);
    let accepted = Conclusion::Answered(Answer::Accepted);
    bench
        .core
        .handle_conclusion(bench.at(601), attempt, accepted);
    let outcome = bench.outcome().unwrap();
    assert!(outcome.is_success(), "{outcome}");
}

#[test]
fn a_letter_too_large_for_every_route_fails_at_once() {
    let mut bench = Bench::new();
    bench.reached_by(0, &["udp://192.0.2.1:1", "tcp://192.0.2.1:1"]);
    bench.send();
    for _ in 0..2 {
        let (attempt, _) = bench.dispatched();
        bench.is_too_large(1, attempt);
    }
    let outcome = bench.outcome().unwrap();
    let reason = FailureReason::TooLarge;
    assert!(matches!(outcome, Outcome::Failed { reason: it, .. } if it == reason));
}

/// A legacy peer announces all its addresses at once.
#[test]
fn a_letter_too_large_for_a_legacy_peer_fails_at_once() {
    let mut bench = Bench::new();
    bench.reached_by(0, &["tcp://192.0.2.1:1;fipa-services"]);
    bench.send();
    let (attempt, kind) = bench.dispatched();
    assert_eq!(kind, Kind::Tcp);
    bench.is_too_large(1, attempt);
    let outcome = bench.outcome().unwrap();
    let reason = FailureReason::TooLarge;
    assert!(matches!(outcome, Outcome::Failed { reason: it, .. } if it == reason));
}

/// A repetition would not change a certificate that is not trusted. The other addresses are tried.
#[test]
fn a_letter_to_a_peer_that_is_not_trusted_fails_at_once() {
    let mut bench = Bench::new();
    let routes = ["udp://192.0.2.1:1", "tcp://192.0.2.1:1"];
    bench.reached_by(0, &routes);
    bench.send();
    for _ in routes {
        let (attempt, _) = bench.dispatched();
        bench.fails(1, attempt, TransportErrorKind::Distrusted);
    }
    let outcome = bench.outcome().unwrap();
    let Outcome::Failed { reason, attempts } = outcome else {
        panic!("{outcome}");
    };
    assert_eq!((reason, attempts.len()), (FailureReason::Refused, 2));
}

/// As that of a platform that has just started.
#[test]
fn an_earlier_error_of_the_same_address_does_not_prolong_a_permanent_one() {
    let mut bench = Bench::new();
    bench.reached_by(0, &["tcp://192.0.2.1:1;fipa-services"]);
    bench.send();
    let (attempt, _) = bench.dispatched();
    bench.fails(1, attempt, TransportErrorKind::Unreachable);
    bench.core.handle_timeout(bench.at(1000));
    let (attempt, _) = bench.dispatched();
    bench.fails(1001, attempt, TransportErrorKind::Distrusted);
    let outcome = bench.outcome().unwrap();
    let reason = FailureReason::Refused;
    assert!(matches!(outcome, Outcome::Failed { reason: it, .. } if it == reason));
}

#[test]
fn the_reason_at_the_deadline_is_the_size() {
    let mut bench = Bench::new();
    bench.reached_by(0, &["udp://192.0.2.1:1"]);
    bench.send();
    let (attempt, _) = bench.dispatched();
    bench.is_too_large(1, attempt);
    bench.core.handle_timeout(bench.at(5001));
    let outcome = bench.outcome().unwrap();
    let reason = FailureReason::TooLarge;
    assert!(matches!(outcome, Outcome::Failed { reason: it, .. } if it == reason));
}

/// Later letters wait behind it.
#[test]
fn the_wait_for_another_route_is_short() {
    let mut bench = Bench::new();
    bench.reached_by(0, &["udp://192.0.2.1:1"]);
    bench.send();
    let mut tried = 0;
    for ms in (0..3000).step_by(10) {
        bench.core.handle_timeout(bench.at(ms));
        while let Some(action) = bench.core.poll_action() {
            match action {
                Action::Dispatch { attempt, .. } => {
                    tried += 1;
                    bench.is_too_large(ms, attempt);
                }
                Action::Outcome { outcome, .. } => {
                    let reason = FailureReason::TooLarge;
                    assert!(matches!(outcome, Outcome::Failed { reason: it, .. } if it == reason));
                    assert!(ms >= 1900, "{ms} ms");
                    assert!(tried > 1);
                    return;
                }
                _ => {}
            }
        }
    }
    panic!("the letter still waits");
}

/// A message whose letter has this many bytes besides the content.
fn around(len: usize, content: usize) -> Message {
    let padded = |padding: usize| {
        Message::builder(Performative::Inform)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap())
            .reply_with("x".repeat(padding))
            .content(vec![7; content])
            .build()
            .unwrap()
    };
    let padding = len - 500;
    let short = letter_for(&padded(padding), SystemTime::UNIX_EPOCH).unwrap();
    padded(padding + len - short.around_len())
}

#[test]
fn a_letter_has_at_most_1_mib_besides_its_content() {
    let utc = SystemTime::UNIX_EPOCH;
    let most = Letter::MAX_AROUND;
    for content in [0, 3 << 20] {
        let letter = letter_for(&around(most, content), utc).unwrap();
        assert_eq!(letter.around_len(), most);
        let mut template = EnvelopeTemplate::default();
        let long = around(most + 1, content);
        for refused in [
            letter_for(&long, utc).err(),
            letter_by(&mut template, &long, utc).err(),
            LetterDraft::new(long, content, utc, &mut template).err(),
        ] {
            let reason = refused.unwrap().to_string();
            assert!(
                reason.contains("1048577 bytes besides its content"),
                "{reason}"
            );
            assert!(reason.contains("1048576"), "{reason}");
        }
    }
}

/// Returns the answer of a service of this kind to a letter with this many bytes besides the content, to
/// `arm` in its own process or in another one. `None` if it answers later.
fn answer(forwards: bool, is_own: bool, len: usize) -> Option<Answer> {
    let own = Incarnation::from_u64(1);
    let directory = MemoryDirectory::new(MtsId::new("mts", own));
    let at = "shm://0000000000000009#0000000000000009".parse().unwrap();
    let arm = Registration::new("arm", ARM, vec![at]);
    directory.register(arm).unwrap();
    let config = CoreConfig {
        forwards,
        ..CoreConfig::new("mts", own, vec![Kind::Shm, Kind::Tcp])
    };
    let mut core = Core::new(config, Arc::new(directory));
    if is_own {
        core.register("arm".into(), ARM);
    }
    let short = letter_for(&around(1000, 3 << 20), SystemTime::UNIX_EPOCH).unwrap();
    let mut payload = short.payload().clone();
    let mut envelope = short.parse_envelope().unwrap();
    envelope.base.comments = Some("x".repeat(len - 1100));
    let missing = |envelope: &Envelope| {
        let letter = Letter::new(envelope.encode_standard().unwrap(), payload.clone());
        len - letter.around_len()
    };
    envelope.base.comments = Some("x".repeat(len - 1100 + missing(&envelope)));
    payload.content = vec![7; 3 << 20].into();
    let letter = Letter::new(envelope.encode_standard().unwrap(), payload);
    assert_eq!(letter.around_len(), len);
    let location = "tcp://192.0.2.1:1#0000000000000002".parse().unwrap();
    let arrival = Arrival {
        parcel: Parcel {
            receiver: "arm".into(),
            stream: Stream::between(ROVER, ARM),
            sequence: 1,
            after: 0,
            transfer: 1,
            remaining: Duration::from_secs(5),
            body: Body::Letter(letter),
        },
        from: Hop {
            location,
            principal: Principal::Unproved,
        },
        ticket: Some(Ticket(7)),
    };
    let now = Now {
        instant: Instant::now(),
        utc: SystemTime::UNIX_EPOCH,
    };
    match core.handle_arrival(now, Kind::Tcp, arrival) {
        Reaction::Now(answer) => Some(answer),
        Reaction::Later => None,
    }
}

#[test]
fn a_longer_letter_is_refused_on_arrival_and_one_with_stamps_is_not() {
    let most = Letter::MAX_AROUND + (64 << 10);
    assert_eq!(answer(false, true, most), Some(Answer::Accepted));
    assert_eq!(answer(true, false, most), None, "taken into custody");
    for (forwards, is_own) in [(false, true), (true, true), (true, false)] {
        match answer(forwards, is_own, most + 1) {
            Some(Answer::Failed {
                reason: FailureReason::TooLarge,
                detail,
            }) => assert!(detail.contains("besides its content"), "{detail}"),
            other => panic!("{other:?}"),
        }
    }
}
