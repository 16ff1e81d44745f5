//! Answers in words of shared memory, and answers that need a response of iceoryx2 all the same.

#![allow(clippy::unwrap_used, reason = "a failed precondition fails the test")]

mod common;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, mpsc};

use bytes::Bytes;
use common::{GatedSink, RecordingSink, TestDomain, attempt, open, parcel};
use fipa_acl::Letter;
use fipa_testbed::until;
use fipa_transport::{
    Abandoned, Answer, Arrival, AttemptId, Conclusion, FailureReason, Kind, LegacySource, Reaction,
    Sink, Transport,
};
use fipa_transport_shm::ShmTransport;

/// Number of words of a process.
const WORDS: usize = 54;

fn post(from: &ShmTransport, to: &ShmTransport, content: &Bytes) -> AttemptId {
    let attempt = attempt();
    from.post(attempt, &to.location(), parcel(content.clone()))
        .unwrap();
    attempt
}

fn conclusion(sink: &RecordingSink, attempt: AttemptId) -> Conclusion {
    until("the conclusion", || sink.conclusion_of(attempt).is_some());
    sink.conclusion_of(attempt).unwrap()
}

fn accepted() -> Conclusion {
    Conclusion::Answered(Answer::Accepted)
}

/// Sends letters until one is answered in a word: the receiver opens the status page of a sender when it wakes
/// the sender.
fn send_until_answered_in_a_word(
    (sender, sent): (&ShmTransport, &RecordingSink),
    receiver: &ShmTransport,
) {
    let before = sender.counters().answered_in_words;
    until("an answer in a word", || {
        let attempt = post(sender, receiver, &Bytes::new());
        assert_eq!(conclusion(sent, attempt), accepted());
        sender.counters().answered_in_words > before
    });
}

/// A sink that gives one answer to all letters.
struct AnsweringSink {
    answer: Mutex<Answer>,
    held: Mutex<Vec<Arrival>>,
}

impl AnsweringSink {
    /// Lets a receiver listen with such a sink, which accepts the letters, until one is answered in a word.
    fn listen(sender: (&ShmTransport, &RecordingSink), receiver: &ShmTransport) -> Arc<Self> {
        let sink = Arc::new(Self {
            answer: Mutex::new(Answer::Accepted),
            held: Mutex::default(),
        });
        receiver.listen(sink.clone()).unwrap();
        send_until_answered_in_a_word(sender, receiver);
        sink
    }
}

impl Sink for AnsweringSink {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        self.held.lock().unwrap().push(arrival);
        Reaction::Now(self.answer.lock().unwrap().clone())
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {}

    fn concluded(&self, _: AttemptId, _: Conclusion) {}
}

#[test]
fn answers_without_data_need_no_response() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let receiver = domain.endpoint();
    let sink = AnsweringSink::listen((&sender, &sent), &receiver);
    open(&sender, &receiver.location());
    let content = |len: usize| Bytes::from(vec![7; len]);
    let loaned = || {
        let loan = sender.loan(&receiver.location(), common::FRONT, 9000, 1);
        let mut loan = loan.unwrap().unwrap();
        loan.content_mut().fill(7);
        loan.freeze()
    };
    let shared = || {
        let mut loan = sender.loan_for_many(100_000).unwrap().unwrap();
        loan.content_mut().fill(7);
        loan.freeze()
    };
    for (answer, in_word) in [
        (Answer::Accepted, true),
        (Answer::Custody, true),
        (Answer::Busy, true),
        (Answer::Moved, true),
        (Answer::Delivered { via: Kind::Tcp }, false),
        (Answer::OutOfOrder { last: 9 }, false),
        (Answer::Returned { uncertain: true }, false),
        (Answer::failed(FailureReason::Refused, "no"), false),
    ] {
        *sink.answer.lock().unwrap() = answer.clone();
        for content in [content(10), content(5000), loaned(), shared()] {
            let before = sender.counters().answered_in_words;
            let sent_now = post(&sender, &receiver, &content);
            let answered = Conclusion::Answered(answer.clone());
            assert_eq!(conclusion(&sent, sent_now), answered);
            let in_words = sender.counters().answered_in_words - before;
            assert_eq!(in_words, u64::from(in_word), "{answer:?}");
            sink.held.lock().unwrap().clear();
        }
    }
    assert_eq!(receiver.counters().refused, 0);
    assert_eq!(receiver.counters().borrowed, 0);
}

/// Its content stays readable, and its slot is free after that.
#[test]
fn content_in_place_is_refused_with_a_response() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let receiver = domain.endpoint();
    let sink = AnsweringSink::listen((&sender, &sent), &receiver);
    *sink.answer.lock().unwrap() = Answer::OutOfOrder { last: 3 };
    for _ in 0..3 * domain.config().window {
        sink.held.lock().unwrap().clear();
        let content = Bytes::from(vec![7; 5000]);
        let attempt = post(&sender, &receiver, &content);
        let answered = Conclusion::Answered(Answer::OutOfOrder { last: 3 });
        assert_eq!(conclusion(&sent, attempt), answered);
        match &sink.held.lock().unwrap()[0].parcel.body {
            fipa_transport::Body::Letter(letter) => assert_eq!(letter.payload().content, content),
            other => panic!("{other:?}"),
        }
        assert_eq!(receiver.counters().borrowed, 1);
    }
    assert_eq!(receiver.counters().copied_full, 0);
}

#[test]
fn without_a_free_word_a_response_answers() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let (receiver, _) = domain.listening();
    send_until_answered_in_a_word((&sender, &sent), &receiver);
    // They do not listen, so they answer nothing.
    let window = domain.config().window;
    let silent: Vec<_> = (0..WORDS.div_ceil(window))
        .map(|_| domain.endpoint())
        .collect();
    let mut unanswered = Vec::new();
    for one in &silent {
        open(&sender, &one.location());
        unanswered.extend((0..window).map(|_| post(&sender, one, &Bytes::new())));
    }
    let before = sender.counters().answered_in_words;
    for _ in 0..3 {
        let attempt = post(&sender, &receiver, &Bytes::new());
        assert_eq!(conclusion(&sent, attempt), accepted());
    }
    assert_eq!(sender.counters().answered_in_words, before);
    // Their words are free when they are concluded.
    drop(silent);
    for attempt in unanswered {
        let end = conclusion(&sent, attempt);
        assert!(matches!(end, Conclusion::Unconfirmed(_)), "{end:?}");
    }
    let attempt = post(&sender, &receiver, &Bytes::new());
    assert_eq!(conclusion(&sent, attempt), accepted());
    assert_eq!(sender.counters().answered_in_words, before + 1);
}

/// The word of an abandoned letter is lent to the next one, to another receiver.
#[test]
fn a_late_answer_to_an_abandoned_letter_is_not_that_to_the_next_one() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let receivers = [domain.listening(), domain.listening()];
    for (receiver, _) in &receivers {
        send_until_answered_in_a_word((&sender, &sent), receiver);
    }
    let [(late, late_sink), (next, next_sink)] = &receivers;
    let done = AtomicBool::new(false);
    let answer_to = |attempt| {
        until("the answer", || {
            sender.drive();
            sent.conclusion_of(attempt).is_some()
        });
        assert_eq!(sent.conclusion_of(attempt), Some(accepted()));
    };
    std::thread::scope(|scope| {
        // The runtime's thread may be the one that waits within a letter.
        for receiver in [late, next] {
            scope.spawn(|| {
                while !done.load(Ordering::Relaxed) {
                    receiver.drive();
                }
            });
        }
        for _ in 0..20 {
            // Each receiver waits within the letter.
            let late_waits = late_sink.arrived.lock().unwrap();
            let next_waits = next_sink.arrived.lock().unwrap();
            let taken = late.counters().arrived;
            let abandoned = post(&sender, late, &Bytes::new());
            until("the letter", || late.counters().arrived > taken);
            let end = sender.abandon(abandoned, &late.location());
            assert_eq!(end, Abandoned::Unconfirmed);
            let following = post(&sender, next, &Bytes::new());
            drop(late_waits);
            // The answer to a later letter shows that the first one has its answer.
            let third = post(&sender, late, &Bytes::new());
            answer_to(third);
            assert_eq!(sent.conclusion_of(following), None);
            assert_eq!(sent.conclusion_of(abandoned), None);
            drop(next_waits);
            answer_to(following);
        }
        done.store(true, Ordering::Relaxed);
    });
}

/// The answer comes after the last poll, while the sender still states that it polls: the receiver does not ring.
#[test]
fn a_sender_that_stops_polling_finds_the_answer() {
    let domain = TestDomain::new();
    let sender = domain.endpoint();
    let sink = Arc::new(GatedSink::default());
    sender.listen(sink.clone()).unwrap();
    let sent = &sink.recorded;
    let (receiver, _) = domain.listening();
    send_until_answered_in_a_word((&sender, sent), &receiver);
    // The runtime's thread does nothing else.
    let (end, ended) = mpsc::channel::<()>();
    let (start, started) = mpsc::channel();
    domain.runtime.spawn(async move {
        start.send(()).unwrap();
        let _ = ended.recv();
    });
    started.recv().unwrap();
    for _ in 0..20 {
        let before = sender.counters().answered_in_words;
        sink.close_gate();
        let first = post(&sender, &receiver, &Bytes::new());
        std::thread::scope(|scope| {
            let driving = scope.spawn(|| {
                while sent.conclusion_of(first).is_none() {
                    sender.drive();
                }
            });
            until("the first conclusion", || {
                receiver.drive();
                sink.is_waiting()
            });
            let (rung, arrived) = (receiver.counters().rung, receiver.counters().arrived);
            let second = post(&sender, &receiver, &Bytes::new());
            until("the second letter", || {
                receiver.drive();
                receiver.counters().arrived > arrived
            });
            assert_eq!(receiver.counters().rung, rung);
            assert_eq!(sent.conclusion_of(second), None);
            sink.open_gate();
            driving.join().unwrap();
            assert_eq!(sent.conclusion_of(second), Some(accepted()));
        });
        assert_eq!(sender.counters().answered_in_words, before + 2);
    }
    drop(end);
}

/// A sender joins its domain again while a receiver is within its letter. The receiver has the earlier status page
/// open when the next letter arrives.
#[test]
fn a_receiver_does_not_answer_on_the_earlier_page_of_a_sender() {
    let domain = TestDomain::new();
    let (sender, sent) = domain.listening();
    let (receiver, received) = domain.listening();
    for _ in 0..3 {
        send_until_answered_in_a_word((&sender, &sent), &receiver);
        let waits = received.arrived.lock().unwrap();
        let before = post(&sender, &receiver, &Bytes::new());
        std::fs::remove_file(&sender.files()[0]).unwrap();
        assert!(sender.rejoin().unwrap());
        let end = conclusion(&sent, before);
        assert!(matches!(end, Conclusion::Unconfirmed(_)), "{end:?}");
        open(&sender, &receiver.location());
        let after = post(&sender, &receiver, &Bytes::new());
        drop(waits);
        assert_eq!(conclusion(&sent, after), accepted());
    }
}
