//! Letters that are answered later: they hold slots of their sender, and no other letter waits for
//! them.

#![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

mod common;

use std::sync::{Arc, Mutex};

use bytes::Bytes;
use common::{RecordingSink, TestDomain, attempt, parcel};
use fipa_acl::Letter;
use fipa_testbed::until;
use fipa_transport::{
    Answer, Arrival, AttemptId, Conclusion, Kind, LegacySource, Reaction, Sink, Ticket, Transport,
};
use fipa_transport_shm::ShmTransport;

/// A sink that defers each answer that it may defer, and answers the others with custody.
#[derive(Default)]
struct DeferringSink(Mutex<Vec<Option<Ticket>>>);

impl DeferringSink {
    fn tickets(&self) -> Vec<Option<Ticket>> {
        self.0.lock().unwrap().clone()
    }
}

impl Sink for DeferringSink {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        self.0.lock().unwrap().push(arrival.ticket);
        match arrival.ticket {
            Some(_) => Reaction::Later,
            None => Reaction::Now(Answer::Custody),
        }
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

    fn concluded(&self, _: AttemptId, _: Conclusion) {}
}

/// An endpoint that answers late, with its sink.
fn deferring(domain: &TestDomain) -> (ShmTransport, Arc<DeferringSink>) {
    let mut config = domain.config();
    config.answers_late = true;
    let endpoint = domain.endpoint_with(config);
    let sink = Arc::new(DeferringSink::default());
    endpoint.listen(sink.clone()).unwrap();
    (endpoint, sink)
}

fn send(from: &ShmTransport, to: &ShmTransport, content: &Bytes) -> AttemptId {
    let attempt = attempt();
    let parcel = parcel(content.clone());
    from.post(attempt, &to.location(), parcel).unwrap();
    attempt
}

fn conclusion(sink: &RecordingSink, attempt: AttemptId) -> Conclusion {
    until("the conclusion", || sink.conclusion_of(attempt).is_some());
    sink.conclusion_of(attempt).unwrap()
}

/// Short content is copied, and long content holds its slot also without a late answer.
fn half_of_the_slots_wait_for_late_answers(content: &Bytes) {
    let domain = TestDomain::new();
    let (sender, concluded) = domain.listening();
    let (receiver, sink) = deferring(&domain);
    let half = domain.config().window / 2;
    let late: Vec<AttemptId> = (0..half)
        .map(|_| send(&sender, &receiver, content))
        .collect();
    until("the letters", || sink.tickets().len() == half);
    assert!(sink.tickets().iter().all(Option::is_some));
    // The answers to letters behind them do not wait for theirs.
    for _ in 0..3 * half {
        let attempt = send(&sender, &receiver, content);
        let custody = Conclusion::Answered(Answer::Custody);
        assert_eq!(conclusion(&concluded, attempt), custody);
    }
    assert!(sink.tickets()[half..].iter().all(Option::is_none));
    // In another order than that of the letters.
    let tickets = sink.tickets();
    for number in (0..half).rev() {
        assert_eq!(concluded.conclusion_of(late[number]), None);
        let last = number as u64;
        let ticket = tickets[number].unwrap();
        receiver.answer(ticket, Answer::OutOfOrder { last });
        let answered = Conclusion::Answered(Answer::OutOfOrder { last });
        assert_eq!(conclusion(&concluded, late[number]), answered);
        // A second answer is ignored.
        receiver.answer(ticket, Answer::Custody);
    }
    // Their slots are free again.
    send(&sender, &receiver, content);
    until("the last letter", || sink.tickets().len() == 4 * half + 1);
    assert!(sink.tickets()[4 * half].is_some());
    assert_eq!(receiver.counters().deferred, half as u64 + 1);
}

#[test]
fn half_of_the_slots_of_short_letters_wait_for_late_answers() {
    half_of_the_slots_wait_for_late_answers(&Bytes::from_static(b"short"));
}

#[test]
fn half_of_the_slots_of_long_letters_wait_for_late_answers() {
    half_of_the_slots_wait_for_late_answers(&vec![7; 100_000].into());
}

#[test]
fn a_process_that_closes_drops_the_letters_that_it_has_not_answered() {
    let domain = TestDomain::new();
    let (sender, concluded) = domain.listening();
    let (receiver, sink) = deferring(&domain);
    let attempt = send(&sender, &receiver, &Bytes::new());
    until("the letter", || sink.tickets().len() == 1);
    receiver.close();
    let end = conclusion(&concluded, attempt);
    assert!(matches!(end, Conclusion::Unconfirmed(_)), "{end:?}");
    // Too late.
    receiver.answer(sink.tickets()[0].unwrap(), Answer::Accepted);
}

#[test]
fn an_answer_to_a_sender_that_has_ended_is_dropped() {
    let domain = TestDomain::new();
    let (receiver, sink) = deferring(&domain);
    for round in 0..50 {
        let (sender, _) = domain.listening();
        send(&sender, &receiver, &Bytes::new());
        until("the letter", || sink.tickets().len() == round + 1);
        drop(sender);
        let ticket = sink.tickets()[round];
        // Each sender is another one, so the limit of senders with held slots is not reached.
        receiver.answer(ticket.unwrap(), Answer::Accepted);
    }
}
