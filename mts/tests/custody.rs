//! A letter in custody whose report never arrives or is rejected: the service before the custodian
//! asks periodically, and a custodian without the letter has lost it.

#![expect(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod common;

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_mts::core::{Action, Core, CoreConfig, Now, Submission};
use fipa_sds::{Directory, Entry, MemoryDirectory, MtsId, Reach, Registration, View};
use fipa_transport::{
    Answer, Arrival, AttemptId, Body, Conclusion, FailureReason, Hop, Incarnation, Kind, Location,
    Outcome, Parcel, Principal, Reaction, Report, Stream, TransportError, TransportErrorKind,
};

use self::common::letter;

const OWN: Incarnation = Incarnation::from_u64(1);
const ROVER: Incarnation = Incarnation::from_u64(2);
const ARM: Incarnation = Incarnation::from_u64(3);
const NEXT: Incarnation = Incarnation::from_u64(9);
/// Deadline of every letter. No test takes that long.
const DEADLINE: Duration = Duration::from_secs(60);

/// The core of one service, whose directory has one agent `arm`, behind another service.
struct Service {
    core: Core,
    directory: Arc<MemoryDirectory>,
    start: Instant,
    /// The time of the last call.
    now: Now,
}

impl Service {
    fn new(forwards: bool) -> Self {
        Self::with_view(forwards, |directory| directory)
    }

    /// Creates a service whose directory shows the agent on another host.
    fn towards_another_host(forwards: bool) -> Self {
        Self::with_view(forwards, |directory| Arc::new(Abroad(directory)))
    }

    fn with_view(forwards: bool, view: impl FnOnce(Arc<MemoryDirectory>) -> Arc<dyn View>) -> Self {
        let directory = Arc::new(MemoryDirectory::new(MtsId::new("mts", NEXT)));
        let at = shm(NEXT);
        directory
            .register(Registration::new("arm", ARM, vec![at]))
            .unwrap();
        let config = CoreConfig {
            forwards,
            ..CoreConfig::new("mts", OWN, vec![Kind::Shm])
        };
        let mut core = Core::new(config, view(Arc::clone(&directory)));
        core.register("rover".into(), ROVER);
        let start = Instant::now();
        Self {
            core,
            directory,
            start,
            now: Now {
                instant: start,
                utc: SystemTime::UNIX_EPOCH,
            },
        }
    }

    fn at(&mut self, ms: u64) -> Now {
        let since = Duration::from_millis(ms);
        self.now = Now {
            instant: self.start + since,
            utc: SystemTime::UNIX_EPOCH + since,
        };
        self.now
    }

    fn send(&mut self) {
        self.send_at(0);
    }

    fn send_at(&mut self, ms: u64) {
        let submission = Submission {
            sender: ROVER,
            letter: letter(),
            receivers: vec!["arm".into()],
            deadline: DEADLINE,
        };
        let now = self.at(ms);
        self.core.submit(now, submission);
    }

    /// A letter arrives for `arm`, in this transfer of the previous service.
    fn arrive(&mut self, ms: u64, sequence: u64, transfer: u64) -> Reaction {
        self.receive(ms, Kind::Shm, {
            let body = Body::Letter(letter());
            parcel(sequence, transfer, body)
        })
    }

    fn receive(&mut self, ms: u64, via: Kind, parcel: Parcel) -> Reaction {
        self.receive_from(ms, via, shm(OWN), parcel)
    }

    fn receive_from(&mut self, ms: u64, via: Kind, location: Location, parcel: Parcel) -> Reaction {
        let from = Hop {
            location,
            principal: Principal::Host,
        };
        let arrival = Arrival {
            parcel,
            from,
            ticket: None,
        };
        let now = self.at(ms);
        self.core.handle_arrival(now, via, arrival)
    }

    fn conclude(&mut self, ms: u64, attempt: AttemptId, conclusion: Conclusion) {
        let now = self.at(ms);
        self.core.handle_conclusion(now, attempt, conclusion);
    }

    fn answer(&mut self, ms: u64, attempt: AttemptId, answer: Answer) {
        self.conclude(ms, attempt, Conclusion::Answered(answer));
    }

    /// Advances the time in steps until something is dispatched, at most until then.
    fn wait_for_dispatch(&mut self, mut ms: u64, until: u64) -> Option<(u64, AttemptId, Parcel)> {
        loop {
            if let Some((attempt, parcel)) = self.dispatched() {
                return Some((ms, attempt, parcel));
            }
            if ms >= until {
                return None;
            }
            ms += 10;
            let now = self.at(ms);
            self.core.handle_timeout(now);
        }
    }

    /// Returns the next action, and refreshes the directory, which is in memory, when the core
    /// requests it.
    fn next_action(&mut self) -> Option<Action> {
        loop {
            match self.core.poll_action()? {
                Action::Refresh { number } => self.core.handle_refreshed(self.now, number),
                action => return Some(action),
            }
        }
    }

    fn dispatched(&mut self) -> Option<(AttemptId, Parcel)> {
        std::iter::from_fn(|| self.next_action()).find_map(|action| match action {
            Action::Dispatch {
                attempt, parcel, ..
            } => Some((attempt, parcel)),
            _ => None,
        })
    }

    fn outcome(&mut self) -> Option<Outcome> {
        std::iter::from_fn(|| self.next_action()).find_map(|action| match action {
            Action::Outcome { outcome, .. } => Some(outcome),
            _ => None,
        })
    }
}

/// A view of a directory that shows its agents on another host.
struct Abroad(Arc<MemoryDirectory>);

fn abroad(entry: &Arc<Entry>) -> Arc<Entry> {
    let mut entry = Entry::clone(entry);
    entry.reach = Reach::Remote { gateway: NEXT };
    Arc::new(entry)
}

impl View for Abroad {
    fn named(&self, name: &str) -> Option<Arc<Entry>> {
        self.0.named(name).as_ref().map(abroad)
    }

    fn registered(&self, incarnation: Incarnation) -> Option<Arc<Entry>> {
        self.0.registered(incarnation).as_ref().map(abroad)
    }

    fn all(&self) -> Arc<[Arc<Entry>]> {
        self.0.all().iter().map(abroad).collect()
    }
}

fn shm(service: Incarnation) -> Location {
    let text = format!("shm://{service}#{service}");
    text.parse().unwrap()
}

fn parcel(sequence: u64, transfer: u64, body: Body) -> Parcel {
    Parcel {
        receiver: "arm".into(),
        stream: Stream::between(ROVER, ARM),
        sequence,
        after: 0,
        transfer,
        remaining: DEADLINE,
        body,
    }
}

/// Sends a letter that goes into custody. Returns its hand-over.
fn in_custody(sender: &mut Service) -> Parcel {
    sender.send();
    let (attempt, handed) = sender.dispatched().unwrap();
    sender.answer(1, attempt, Answer::Custody);
    handed
}

#[test]
fn a_letter_that_its_custodian_does_not_have_is_sent_again() {
    let mut sender = Service::new(false);
    let handed = in_custody(&mut sender);
    let (ms, ask, question) = sender.wait_for_dispatch(1, 10_000).unwrap();
    assert_eq!(question.body, Body::Predecessor);
    assert_eq!(
        (question.sequence, question.transfer),
        (handed.sequence, handed.transfer)
    );
    sender.answer(ms, ask, Answer::Returned { uncertain: true });
    let (ms, attempt, again) = sender.wait_for_dispatch(ms, 10_000).unwrap();
    assert!(matches!(again.body, Body::Letter(_)));
    assert_eq!(again.sequence, handed.sequence);
    assert!(again.transfer > handed.transfer);
    sender.answer(ms, attempt, Answer::Accepted);
    let outcome = sender.outcome();
    assert!(
        matches!(outcome, Some(Outcome::Delivered { .. })),
        "{outcome:?}"
    );
}

#[test]
fn a_late_answer_names_the_transport_between_the_hosts() {
    let mut sender = Service::new(false);
    sender.send();
    let (attempt, _) = sender.dispatched().unwrap();
    sender.answer(100, attempt, Answer::Delivered { via: Kind::Quic });
    let delivered = Outcome::Delivered {
        via: Kind::Quic,
        attempts: Vec::new(),
    };
    assert_eq!(sender.outcome(), Some(delivered));
    // No report follows, so the custodian is not asked.
    assert!(sender.wait_for_dispatch(100, 10_000).is_none());
}

#[test]
fn a_letter_that_its_custodian_does_not_have_may_have_been_taken() {
    let mut sender = Service::new(false);
    in_custody(&mut sender);
    let (ms, ask, _) = sender.wait_for_dispatch(1, 10_000).unwrap();
    sender.answer(ms, ask, Answer::Returned { uncertain: true });
    let (ms, attempt, _) = sender.wait_for_dispatch(ms, 10_000).unwrap();
    sender.answer(ms, attempt, Answer::failed(FailureReason::Refused, ""));
    let outcome = sender.outcome();
    let Some(Outcome::Failed { reason, .. }) = outcome else {
        panic!("{outcome:?}");
    };
    assert_eq!(reason, FailureReason::Unconfirmed);
}

#[test]
fn a_custodian_that_has_the_letter_keeps_it_and_is_asked_again() {
    let mut sender = Service::new(false);
    in_custody(&mut sender);
    let mut ms = 1;
    for _ in 0..5 {
        let (later, ask, question) = sender.wait_for_dispatch(ms, ms + 10_000).unwrap();
        assert_eq!(question.body, Body::Predecessor);
        let conclusion = match ms {
            1 => Conclusion::Unconfirmed(TransportError::new(TransportErrorKind::TimedOut, "")),
            _ => Conclusion::Answered(Answer::Accepted),
        };
        sender.conclude(later, ask, conclusion);
        ms = later;
    }
    assert_eq!(sender.outcome(), None);
}

/// A letter that moved to the receiver's new registration is before the others in the lane, so that
/// the first letter of the lane is not one for the registration that ended.
#[test]
fn letters_for_an_ended_registration_wait_two_seconds_behind_one_for_its_successor() {
    const NEW: Incarnation = Incarnation::from_u64(4);
    let mut sender = Service::new(false);
    let moving = in_custody(&mut sender);
    in_custody(&mut sender);
    sender.directory.deregister("arm", ARM).unwrap();
    let new = Registration::new("arm", NEW, vec![shm(NEXT)]);
    sender.directory.register(new).unwrap();
    let now = sender.at(10);
    sender.core.handle_directory_change(now);
    let moved = Body::Report(Report::Moved);
    let report = parcel(moving.sequence, moving.transfer, moved);
    sender.receive_from(20, Kind::Shm, shm(NEXT), report);
    let (attempt, again) = sender.dispatched().unwrap();
    assert_eq!(again.stream.receiver, NEW);
    // Any change of the directory.
    let now = sender.at(30);
    sender.core.handle_directory_change(now);
    sender.answer(40, attempt, Answer::Accepted);
    let outcome = sender.outcome();
    assert!(
        matches!(outcome, Some(Outcome::Delivered { .. })),
        "{outcome:?}"
    );
    sender.send_at(50);
    let mut ms = 50;
    let outcome = loop {
        ms += 10;
        let now = sender.at(ms);
        sender.core.handle_timeout(now);
        let mut ended = None;
        while let Some(action) = sender.next_action() {
            match action {
                Action::Outcome { outcome, .. } => ended = Some(outcome),
                // The custodian has the letter.
                Action::Dispatch {
                    attempt, parcel, ..
                } if parcel.body == Body::Predecessor => {
                    sender.answer(ms, attempt, Answer::Accepted);
                }
                Action::Dispatch { parcel, .. } => panic!("sent early: {parcel:?}"),
                _ => {}
            }
            if ended.is_some() {
                break;
            }
        }
        if let Some(ended) = ended {
            break ended;
        }
        assert!(ms < 2100, "the letter in custody has no outcome");
    };
    assert!(
        matches!(&outcome, Outcome::Failed { reason, .. } if *reason == FailureReason::Unconfirmed),
        "{outcome:?}"
    );
    let (_, next) = sender.dispatched().unwrap();
    assert_eq!(next.stream.receiver, NEW);
}

#[test]
fn a_gateway_answers_which_letters_it_has() {
    let mut gateway = Service::new(true);
    let asked =
        |gateway: &mut Service, ms, sequence, transfer| match gateway.receive(ms, Kind::Shm, {
            parcel(sequence, transfer, Body::Predecessor)
        }) {
            Reaction::Now(answer) => answer,
            Reaction::Later => panic!("notes are answered at once"),
        };
    let without = Answer::Returned { uncertain: true };
    assert_eq!(asked(&mut gateway, 0, 5, 70), without);
    assert_eq!(gateway.arrive(0, 5, 70), Reaction::Now(Answer::Custody));
    let (attempt, _) = gateway.dispatched().unwrap();
    assert_eq!(asked(&mut gateway, 1, 5, 70), Answer::Accepted);
    assert_eq!(asked(&mut gateway, 1, 6, 71), without);
    // A report that names another transfer is ignored.
    assert_eq!(asked(&mut gateway, 1, 5, 72), without);
    gateway.answer(2, attempt, Answer::Accepted);
    // Its report is on the way and tells more.
    let (report, _) = gateway.dispatched().unwrap();
    assert_eq!(asked(&mut gateway, 3, 5, 70), Answer::Accepted);
    assert_eq!(asked(&mut gateway, 3, 5, 72), without);
    gateway.answer(4, report, Answer::Accepted);
    assert_eq!(asked(&mut gateway, 5, 5, 70), without);
}

#[test]
fn a_gateway_answers_that_the_receivers_queue_is_full() {
    let mut gateway = Service::new(true);
    gateway.arrive(0, 5, 70);
    let (attempt, _) = gateway.dispatched().unwrap();
    gateway.answer(1, attempt, Answer::Busy);
    let asked = |gateway: &mut Service, ms| {
        gateway.receive(ms, Kind::Shm, parcel(5, 70, Body::Predecessor))
    };
    assert_eq!(asked(&mut gateway, 2), Reaction::Now(Answer::Busy));
    gateway.arrive(3, 6, 71);
    let (ms, attempt, _) = gateway.wait_for_dispatch(3, 1000).unwrap();
    gateway.answer(ms, attempt, Answer::Accepted);
    // The queue has room again, and letter 6 has no answer yet.
    let question = parcel(6, 71, Body::Predecessor);
    let answer = gateway.receive(ms, Kind::Shm, question);
    assert_eq!(answer, Reaction::Now(Answer::Accepted));
}

/// The receiver is asked behind a custodian that answers like this. Returns the reason for a letter that
/// came back and waits behind one in custody until its deadline, and the times of the questions in milliseconds.
fn reason_behind_custody(answer: &Answer) -> (Option<FailureReason>, Vec<u64>) {
    let mut gateway = Service::new(true);
    gateway.arrive(0, 5, 70);
    let (first, _) = gateway.dispatched().unwrap();
    gateway.answer(0, first, Answer::Custody);
    let behind = Parcel {
        after: 5,
        remaining: Duration::from_millis(3500),
        ..parcel(6, 71, Body::Letter(letter()))
    };
    gateway.receive(0, Kind::Shm, behind);
    let (second, _) = gateway.dispatched().unwrap();
    gateway.answer(0, second, Answer::Returned { uncertain: false });
    let (mut ms, mut asked) = (0, Vec::new());
    while let Some((later, attempt, note)) = gateway.wait_for_dispatch(ms, 10_000) {
        match note.body {
            Body::Predecessor => {
                gateway.answer(later, attempt, answer.clone());
                asked.push(later);
            }
            Body::Report(Report::Settled(Outcome::Failed { reason, .. })) => {
                assert_eq!(note.sequence, 6);
                return (Some(reason), asked);
            }
            other => panic!("{other:?}"),
        }
        ms = later;
    }
    (None, asked)
}

#[test]
fn a_letter_behind_one_whose_custodian_tells_of_a_full_queue_fails_for_that_reason() {
    let (reason, asked) = reason_behind_custody(&Answer::Busy);
    assert_eq!(reason, Some(FailureReason::QueueFull));
    assert_eq!(asked, [1000, 2000, 3000]);
    let (reason, asked) = reason_behind_custody(&Answer::Accepted);
    assert_eq!(reason, Some(FailureReason::TimedOut));
    assert_eq!(asked, [1000, 3000]);
}

/// Brings a gateway into the state in which an attempt may have delivered the letter in its custody, and in
/// which its directory no longer has the receiver.
fn with_absent_receiver(mut gateway: Service) -> Service {
    gateway.arrive(0, 5, 70);
    let (attempt, _) = gateway.dispatched().unwrap();
    gateway.directory.deregister("arm", ARM).unwrap();
    let now = gateway.at(10);
    gateway.core.handle_directory_change(now);
    let broken = TransportError::new(TransportErrorKind::Broken, "");
    gateway.conclude(20, attempt, Conclusion::Unconfirmed(broken));
    gateway
}

#[test]
fn a_letter_that_may_have_arrived_is_sent_again_when_its_receiver_returns() {
    let mut gateway = with_absent_receiver(Service::towards_another_host(true));
    assert_eq!(gateway.wait_for_dispatch(20, 900), None);
    let arm = Registration::new("arm", ARM, vec![shm(NEXT)]);
    gateway.directory.register(arm).unwrap();
    let now = gateway.at(910);
    gateway.core.handle_directory_change(now);
    let (ms, attempt, again) = gateway.wait_for_dispatch(910, 10_000).unwrap();
    assert_eq!(again.sequence, 5);
    gateway.answer(ms, attempt, Answer::Accepted);
    let (_, report) = gateway.dispatched().unwrap();
    let is_delivered = matches!(
        &report.body,
        Body::Report(Report::Settled(Outcome::Delivered { .. }))
    );
    assert!(is_delivered, "{report:?}");
}

#[test]
fn a_letter_that_may_have_arrived_waits_one_second_for_its_receiver() {
    let mut gateway = with_absent_receiver(Service::towards_another_host(true));
    let (ms, _, report) = gateway.wait_for_dispatch(20, 10_000).unwrap();
    assert!((1_000..1_100).contains(&ms), "{ms} ms");
    let Body::Report(Report::Settled(Outcome::Failed { reason, .. })) = report.body else {
        panic!("{report:?}");
    };
    assert_eq!(reason, FailureReason::Unconfirmed);
}

/// Brings a sender into the state in which attempts may have delivered these letters, and in which its directory
/// no longer has their receiver.
fn without_receiver(mut sender: Service, letters: usize) -> Service {
    let mut attempts = Vec::new();
    for _ in 0..letters {
        sender.send();
        attempts.extend(sender.dispatched());
    }
    assert_eq!(attempts.len(), letters);
    sender.directory.deregister("arm", ARM).unwrap();
    let now = sender.at(10);
    sender.core.handle_directory_change(now);
    for (attempt, _) in attempts {
        let broken = TransportError::new(TransportErrorKind::Broken, "");
        sender.conclude(20, attempt, Conclusion::Unconfirmed(broken));
    }
    sender
}

#[test]
fn a_sender_sends_a_letter_again_when_its_receiver_on_another_host_returns() {
    let mut sender = without_receiver(Service::towards_another_host(false), 1);
    assert_eq!(sender.wait_for_dispatch(20, 900), None);
    let arm = Registration::new("arm", ARM, vec![shm(NEXT)]);
    sender.directory.register(arm).unwrap();
    let now = sender.at(910);
    sender.core.handle_directory_change(now);
    let (ms, attempt, again) = sender.wait_for_dispatch(910, 10_000).unwrap();
    assert_eq!(again.sequence, 1);
    sender.answer(ms, attempt, Answer::Accepted);
    assert!(sender.outcome().unwrap().is_success());
}

#[test]
fn letters_that_may_have_arrived_wait_one_second_together_for_their_receiver_on_another_host() {
    let mut sender = without_receiver(Service::towards_another_host(false), 3);
    let mut failed = Vec::new();
    for ms in (20..10_000).step_by(10) {
        let now = sender.at(ms);
        sender.core.handle_timeout(now);
        failed.extend(std::iter::from_fn(|| sender.outcome()).map(|outcome| (ms, outcome)));
    }
    assert_eq!(failed.len(), 3);
    for (ms, outcome) in failed {
        assert!((1_000..1_100).contains(&ms), "{ms} ms");
        let is_unconfirmed = matches!(
            outcome,
            Outcome::Failed {
                reason: FailureReason::Unconfirmed,
                ..
            }
        );
        assert!(is_unconfirmed, "{outcome:?}");
    }
}

#[test]
fn a_letter_that_may_have_arrived_does_not_wait_for_a_receiver_of_this_host() {
    let mut sender = without_receiver(Service::new(false), 1);
    let is_unconfirmed = |outcome: &Outcome| matches!(outcome, Outcome::Failed { reason, .. } if *reason == FailureReason::Unconfirmed);
    let outcome = sender.outcome().unwrap();
    assert!(is_unconfirmed(&outcome), "{outcome:?}");
    let mut gateway = with_absent_receiver(Service::new(true));
    let (_, report) = gateway.dispatched().unwrap();
    let Body::Report(Report::Settled(outcome)) = report.body else {
        panic!("{report:?}");
    };
    assert!(is_unconfirmed(&outcome), "{outcome:?}");
}

#[test]
fn a_report_that_is_refused_hides_no_lost_letter() {
    let mut gateway = Service::new(true);
    gateway.arrive(0, 5, 70);
    let (attempt, _) = gateway.dispatched().unwrap();
    gateway.answer(1, attempt, Answer::Accepted);
    let (report, _) = gateway.dispatched().unwrap();
    gateway.answer(
        2,
        report,
        Answer::failed(FailureReason::Refused, "impostor"),
    );
    let asked = gateway.receive(3, Kind::Shm, parcel(5, 70, Body::Predecessor));
    assert_eq!(asked, Reaction::Now(Answer::Returned { uncertain: true }));
}

#[test]
fn a_report_that_is_refused_is_repeated() {
    let mut gateway = Service::new(true);
    gateway.arrive(0, 5, 70);
    let (attempt, _) = gateway.dispatched().unwrap();
    gateway.answer(1, attempt, Answer::Accepted);
    let (first, report) = gateway.dispatched().unwrap();
    let is_report = |parcel: &Parcel| matches!(parcel.body, Body::Report(Report::Settled(_)));
    assert!(is_report(&report));
    gateway.answer(2, first, Answer::failed(FailureReason::Refused, "impostor"));
    let (ms, second, report) = gateway.wait_for_dispatch(2, 10_000).unwrap();
    assert!(is_report(&report));
    gateway.answer(ms, second, Answer::Accepted);
    assert_eq!(gateway.wait_for_dispatch(ms, ms + 10_000), None);
}

/// Letter 2 came back to the gateway because letter 1 is missing. Returns the time for which the
/// gateway waits for letter 1 until it returns letter 2.
fn timeout(gateway: &mut Service, began: u64) -> u64 {
    let letter = Parcel {
        after: 100,
        ..parcel(101, 900, Body::Letter(letter()))
    };
    gateway.receive(began, Kind::Shm, letter);
    let (attempt, _) = gateway.dispatched().unwrap();
    gateway.answer(began, attempt, Answer::OutOfOrder { last: 0 });
    let (ms, _, returned) = gateway.wait_for_dispatch(began, began + 10_000).unwrap();
    let is_return = matches!(returned.body, Body::Report(Report::Returned { .. }));
    assert!(is_return, "{returned:?}");
    ms - began
}

#[test]
fn predecessors_have_two_round_trips_to_arrive() {
    let mut gateway = Service::new(true);
    assert_eq!(timeout(&mut gateway, 0), 50);
    // A service that takes 200 ms to acknowledge a report.
    let mut gateway = Service::new(true);
    gateway.arrive(0, 5, 70);
    let (attempt, _) = gateway.dispatched().unwrap();
    gateway.answer(0, attempt, Answer::Accepted);
    let (report, _) = gateway.dispatched().unwrap();
    gateway.answer(200, report, Answer::Accepted);
    assert_eq!(timeout(&mut gateway, 1000), 400);
}

/// With a wait for each of them, letters of a long lane would come back slower than their sender sends
/// them again.
#[test]
fn letters_behind_one_without_its_predecessor_are_returned_with_it() {
    let mut gateway = Service::new(true);
    let mut attempts = Vec::new();
    for sequence in 101..=110 {
        let letter = Parcel {
            after: sequence - 1,
            ..parcel(sequence, 800 + sequence, Body::Letter(letter()))
        };
        gateway.receive(0, Kind::Shm, letter);
        attempts.extend(gateway.dispatched());
    }
    for (attempt, _) in attempts {
        gateway.answer(0, attempt, Answer::OutOfOrder { last: 0 });
    }
    let mut returned = Vec::new();
    let mut ms = 0;
    while let Some((later, attempt, report)) = gateway.wait_for_dispatch(ms, 10_000) {
        let is_return = matches!(report.body, Body::Report(Report::Returned { .. }));
        assert!(is_return, "{report:?}");
        gateway.answer(later, attempt, Answer::Accepted);
        returned.push((later, report.sequence));
        ms = later;
    }
    let expected: Vec<_> = (101..=110).map(|sequence| (50, sequence)).collect();
    assert_eq!(returned, expected);
}

#[test]
fn a_gateway_that_ends_returns_the_letters_in_its_custody() {
    let mut gateway = Service::new(true);
    let mut attempts = Vec::new();
    for (sequence, transfer) in [(5, 70), (6, 71), (7, 72), (8, 73)] {
        gateway.arrive(0, sequence, transfer);
        attempts.extend(gateway.dispatched().map(|(attempt, _)| attempt));
    }
    gateway.answer(1, attempts[0], Answer::Custody);
    gateway.answer(1, attempts[1], Answer::Busy);
    assert!(!gateway.core.has_open_reports());
    let now = gateway.at(2);
    gateway.core.give_up(now);
    let error = || TransportError::new(TransportErrorKind::Closed, "");
    let mut reports = Vec::new();
    let mut ends = vec![
        Conclusion::NotSent(error()),
        Conclusion::Unconfirmed(error()),
    ];
    while let Some(action) = gateway.next_action() {
        match action {
            Action::Abandon { attempt, .. } => {
                gateway.conclude(2, attempt, ends.pop().unwrap());
            }
            Action::Dispatch {
                attempt, parcel, ..
            } => reports.push((attempt, parcel)),
            _ => {}
        }
    }
    assert!(!gateway.core.has_open_letters());
    assert!(gateway.core.has_open_reports());
    let reported = |(_, parcel): &(AttemptId, Parcel)| match parcel.body {
        Body::Report(Report::Returned { uncertain }) => {
            (parcel.sequence, parcel.transfer, uncertain)
        }
        _ => panic!("{parcel:?}"),
    };
    let mut reported: Vec<_> = reports.iter().map(reported).collect();
    reported.sort_unstable();
    assert_eq!(
        reported,
        [(5, 70, true), (6, 71, false), (7, 72, true), (8, 73, false)]
    );
    // A report that is lost is repeated.
    let (lost, _) = reports.remove(0);
    gateway.conclude(3, lost, Conclusion::Unconfirmed(error()));
    for (report, _) in reports {
        gateway.answer(3, report, Answer::Accepted);
    }
    let (ms, again, _) = gateway.wait_for_dispatch(3, 1000).unwrap();
    assert!(gateway.core.has_open_reports());
    gateway.answer(ms, again, Answer::Accepted);
    assert!(!gateway.core.has_open_reports());
    // Further letters stay with the services before it.
    assert_eq!(gateway.arrive(ms, 9, 74), Reaction::Now(Answer::Busy));
}

/// With a round over the routes of its own, each letter would wait for the end of the one before it.
#[test]
fn letters_whose_routes_all_failed_are_sent_again_together() {
    let mut sender = Service::new(false);
    let mut attempts = Vec::new();
    for _ in 0..5 {
        sender.send();
        attempts.extend(sender.dispatched());
    }
    let handed: Vec<_> = attempts.iter().map(|(_, it)| it.sequence).collect();
    for (attempt, _) in attempts {
        let broken = TransportError::new(TransportErrorKind::Broken, "");
        sender.conclude(0, attempt, Conclusion::NotSent(broken));
    }
    let (_, _, first) = sender.wait_for_dispatch(0, 10_000).unwrap();
    let mut again = vec![first.sequence];
    while let Some((_, parcel)) = sender.dispatched() {
        again.push(parcel.sequence);
    }
    assert_eq!(again, handed);
}

/// Sends letters one after the other. The first attempt of each ends like this, the second one goes into
/// custody and is reported as delivered. Returns the times between the two attempts, in milliseconds.
fn delays_of_second_attempts(letters: usize, first: &TransportError) -> Vec<u64> {
    let mut sender = Service::new(false);
    let mut ms = 0;
    let delays = (0..letters).map(|_| {
        ms += 10_000;
        sender.send_at(ms);
        let (attempt, _) = sender.dispatched().unwrap();
        sender.conclude(ms, attempt, Conclusion::NotSent(first.clone()));
        let (again, attempt, handed) = sender.wait_for_dispatch(ms, ms + 5000).unwrap();
        sender.answer(again, attempt, Answer::Custody);
        let delivered = Outcome::Delivered {
            via: Kind::Shm,
            attempts: Vec::new(),
        };
        let settled = Body::Report(Report::Settled(delivered));
        let report = parcel(handed.sequence, handed.transfer, settled);
        sender.receive_from(again + 1, Kind::Shm, shm(NEXT), report);
        let outcome = sender.outcome();
        assert!(
            matches!(outcome, Some(Outcome::Delivered { .. })),
            "{outcome:?}"
        );
        again - ms
    });
    delays.collect()
}

#[test]
fn a_full_route_is_waited_for_after_any_number_of_letters_in_custody() {
    let full = TransportError::new(TransportErrorKind::Congested, "the window is full");
    let delays = delays_of_second_attempts(100, &full);
    assert!(delays.iter().all(|delay| *delay == 20), "{delays:?}");
}

#[test]
fn pauses_do_not_grow_with_letters_that_were_delivered_from_custody() {
    let closed = TransportError::new(TransportErrorKind::Unreachable, "closed");
    let delays = delays_of_second_attempts(100, &closed);
    assert!(delays.iter().all(|delay| *delay == delays[0]), "{delays:?}");
}
