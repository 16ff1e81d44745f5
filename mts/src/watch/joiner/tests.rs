use std::time::UNIX_EPOCH;

use fipa_acl::{AgentId, Letter, Performative};
use fipa_transport::FailureReason;

use super::super::record::{Wish, of};
use super::*;
use crate::core::{News, Notice};

const A: RecordSource = RecordSource(1);
const B: RecordSource = RecordSource(2);
const GATEWAY: RecordSource = RecordSource(3);

fn id(sender: u64, sequence: u64) -> LetterId {
    LetterId {
        stream: Stream::between(Incarnation::from_u64(sender), Incarnation::from_u64(99)),
        sequence,
    }
}

fn letter() -> SeenLetter {
    let message = Message::builder(Performative::Request)
        .sender(AgentId::new("rover").unwrap())
        .build()
        .unwrap();
    let LetterId { stream, sequence } = id(7, 1);
    let notice = Notice {
        stream,
        sequence,
        receiver: "arm_1".into(),
        news: News::Taken {
            via: None,
            letter: Letter::new(Bytes::new(), message.to_payload()),
        },
    };
    let record = Record::parse(&of(&notice, Wish::default(), at(0))).unwrap();
    let RecordBody::Letter { letter, .. } = record.body else {
        panic!("not a letter");
    };
    letter
}

fn at(ms: u64) -> SystemTime {
    UNIX_EPOCH + Duration::from_millis(1_700_000_000_000 + ms)
}

fn record(ms: u64, body: RecordBody) -> Record {
    Record {
        at: at(ms),
        lost: 0,
        body,
    }
}

fn seen(ms: u64, id: LetterId, place: Seen) -> Record {
    let letter = letter();
    record(ms, RecordBody::Letter { id, place, letter })
}

fn delivered(via: Kind) -> Outcome {
    Outcome::Delivered {
        via,
        attempts: Vec::new(),
    }
}

fn failed() -> Outcome {
    Outcome::Failed {
        reason: FailureReason::TimedOut,
        attempts: Vec::new(),
    }
}

fn settled(ms: u64, id: LetterId, outcome: Outcome, sender: bool) -> Record {
    record(
        ms,
        RecordBody::Settled {
            id,
            outcome,
            sender,
        },
    )
}

fn all(joiner: &mut Joiner, now: Instant) -> Vec<Event> {
    std::iter::from_fn(|| joiner.poll_event(now)).collect()
}

fn only(mut events: Vec<Event>) -> Arc<Passage> {
    assert_eq!(events.len(), 1, "{events:?}");
    match events.remove(0) {
        Event::Letter(passage) | Event::Later(passage) => passage,
        lost => panic!("{lost:?}"),
    }
}

#[test]
fn records_of_sender_and_receiver_are_one_letter() {
    let (mut joiner, now) = (Joiner::new(), Instant::now());
    joiner.handle(now, B, seen(2, id(7, 1), Seen::Taken(Some(Kind::Shm))));
    joiner.handle(now, A, seen(1, id(7, 1), Seen::Sent(Some(4))));
    joiner.handle(now, A, settled(3, id(7, 1), delivered(Kind::Shm), true));
    assert!(joiner.poll_event(now).is_none(), "held back");
    assert_eq!(joiner.poll_timeout(), Some(now + HOLD));
    let passage = only(all(&mut joiner, now + HOLD));
    assert_eq!(
        (passage.number, passage.submission, passage.at),
        (1, Some(4), at(1))
    );
    assert_eq!(passage.fate, Fate::Settled(delivered(Kind::Shm)));
    assert_eq!(
        (passage.via, passage.sender()),
        (Some(Kind::Shm), Some("rover"))
    );
    joiner.handle(now, B, seen(2, id(7, 1), Seen::Taken(Some(Kind::Shm))));
    assert!(
        all(&mut joiner, now + TIMEOUT * 2).is_empty(),
        "reported already"
    );
}

#[test]
fn a_late_outcome_is_an_event_of_its_own() {
    let (mut joiner, now) = (Joiner::new(), Instant::now());
    joiner.handle(now, A, seen(1, id(7, 1), Seen::Sent(None)));
    assert_eq!(only(all(&mut joiner, now + TIMEOUT)).fate, Fate::UnderWay);
    joiner.handle(now, A, settled(900, id(7, 1), failed(), true));
    let later = only(all(&mut joiner, now + TIMEOUT));
    assert_eq!((later.number, &later.fate), (1, &Fate::Settled(failed())));
}

#[test]
fn an_outcome_that_equals_the_report_of_the_receiver_adds_only_its_time() {
    let (mut joiner, now) = (Joiner::new(), Instant::now());
    joiner.handle(now, A, seen(1, id(7, 1), Seen::Sent(Some(4))));
    joiner.handle(now, B, seen(2, id(7, 1), Seen::Taken(Some(Kind::Shm))));
    let taken = only(all(&mut joiner, now + TIMEOUT));
    assert_eq!((&taken.fate, taken.delivery_time()), (&Fate::Taken, None));
    for _ in 0..2 {
        let outcome = delivered(Kind::Shm);
        joiner.handle(now, A, settled(901, id(7, 1), outcome, true));
    }
    let mut events = all(&mut joiner, now + TIMEOUT);
    assert_eq!(events.len(), 1, "{events:?}");
    let Event::Confirmed(confirmed) = events.remove(0) else {
        panic!("the sender has the same outcome");
    };
    assert_eq!(confirmed.fate, Fate::Settled(delivered(Kind::Shm)));
    let time = Duration::from_millis(900);
    assert_eq!(confirmed.delivery_time(), Some(time));
}

#[test]
fn the_delivery_time_needs_the_records_of_sending_and_of_the_outcome() {
    for sent in [None, Some(4)] {
        let (mut joiner, now) = (Joiner::new(), Instant::now());
        let outcome = || settled(31, id(7, 1), delivered(Kind::Shm), true);
        // The outcome arrives before the letter.
        joiner.handle(now, A, outcome());
        let place = sent.map_or(Seen::Taken(Some(Kind::Shm)), |it| Seen::Sent(Some(it)));
        joiner.handle(now, A, seen(1, id(7, 1), place));
        let passage = only(all(&mut joiner, now + HOLD));
        let expected = sent.map(|_| Duration::from_millis(30));
        assert_eq!(passage.delivery_time(), expected);
    }
}

#[test]
fn letters_are_reported_in_the_order_of_sending() {
    let (mut joiner, now) = (Joiner::new(), Instant::now());
    // The record of the answer arrives before that of the question.
    joiner.handle(now, B, seen(5, id(8, 1), Seen::Sent(None)));
    joiner.handle(now, B, settled(6, id(8, 1), delivered(Kind::Shm), true));
    let soon = now + HOLD / 2;
    joiner.handle(soon, A, seen(1, id(7, 1), Seen::Sent(None)));
    joiner.handle(soon, A, settled(7, id(7, 1), delivered(Kind::Shm), true));
    assert!(
        all(&mut joiner, now + HOLD).is_empty(),
        "the first letter is still held back"
    );
    let senders: Vec<u64> = all(&mut joiner, soon + HOLD)
        .iter()
        .map(|event| match event {
            Event::Letter(passage) => passage.stream.sender.as_u64(),
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(senders, [7, 8]);
}

#[test]
fn a_letter_through_the_gateway_has_the_transport_between_the_hosts() {
    let (mut joiner, now) = (Joiner::new(), Instant::now());
    let hello = RecordBody::Hello {
        name: "rover-mts".into(),
        incarnation: Incarnation::from_u64(3),
        gateway: true,
    };
    joiner.handle_begin(GATEWAY, "process 3");
    joiner.handle(now, GATEWAY, record(0, hello));
    // Outgoing.
    joiner.handle(now, A, seen(1, id(7, 1), Seen::Sent(None)));
    joiner.handle(
        now,
        GATEWAY,
        seen(2, id(7, 1), Seen::Passed(Kind::Shm, Origin::ThisHost)),
    );
    joiner.handle(
        now,
        GATEWAY,
        settled(3, id(7, 1), delivered(Kind::Tcp), false),
    );
    joiner.handle(now, A, settled(4, id(7, 1), delivered(Kind::Tcp), true));
    let out = only(all(&mut joiner, now + HOLD));
    assert_eq!(out.via, Some(Kind::Tcp));
    assert_eq!(out.gateway.as_deref(), Some("rover-mts"));
    // Incoming.
    joiner.handle(
        now,
        GATEWAY,
        seen(5, id(9, 1), Seen::Passed(Kind::Tcp, Origin::OtherHost)),
    );
    joiner.handle(now, B, seen(6, id(9, 1), Seen::Taken(Some(Kind::Shm))));
    joiner.handle(
        now,
        GATEWAY,
        settled(7, id(9, 1), delivered(Kind::Shm), false),
    );
    let into = only(all(&mut joiner, now + HOLD));
    assert_eq!((into.via, into.from_elsewhere), (Some(Kind::Tcp), true));
    assert_eq!(into.fate, Fate::Taken);
}

#[test]
fn lost_records_are_reported_once() {
    let (mut joiner, now) = (Joiner::new(), Instant::now());
    joiner.handle_begin(A, "process 1");
    for lost in [0, 3, 3, 10] {
        let record = Record {
            lost,
            ..record(0, RecordBody::Lost)
        };
        joiner.handle(now, A, record);
    }
    let lost: Vec<u64> = all(&mut joiner, now)
        .iter()
        .map(|event| match event {
            Event::Lost { records, .. } => *records,
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(lost, [3, 7]);
}

#[test]
fn a_process_that_sends_invalid_data_is_named() {
    let mut joiner = Joiner::new();
    joiner.handle_begin(A, "process 1");
    joiner.handle_malformed(A, RecordError::Version(9));
    let event = joiner.poll_event(Instant::now());
    let Some(Event::Refused { process, why }) = event else {
        panic!("{event:?}");
    };
    assert_eq!((&*process, why), ("process 1", RecordError::Version(9)));
}

#[test]
fn memory_for_letters_without_an_outcome_is_bounded() {
    let (mut joiner, now) = (Joiner::new(), Instant::now());
    let mut reported = 0;
    for sequence in 0..(MAX_WAITING + MAX_OPEN + 5000) as u64 {
        joiner.handle(now, A, seen(sequence, id(7, sequence), Seen::Sent(None)));
        joiner.handle(now, A, settled(1, id(8, sequence), failed(), true));
        reported += all(&mut joiner, now).len();
    }
    assert_eq!(reported, MAX_OPEN + 5000);
    assert!(joiner.waiting.len() <= MAX_WAITING && joiner.open.len() <= MAX_OPEN);
    assert!(
        joiner.letters.len() <= MAX_WAITING + MAX_OPEN
            && joiner.outcomes_before_letters.len() <= MAX_EARLY
    );
}

#[test]
fn letters_with_an_outcome_are_remembered_for_a_while() {
    let (mut joiner, start) = (Joiner::new(), Instant::now());
    let count = MAX_SETTLED as u64 + 5000;
    let mut reported = 0;
    for sequence in 0..count {
        joiner.handle(start, A, seen(sequence, id(7, sequence), Seen::Sent(None)));
        let outcome = delivered(Kind::Shm);
        joiner.handle(start, A, settled(sequence, id(7, sequence), outcome, true));
        reported += all(&mut joiner, start + HOLD).len();
    }
    assert_eq!(reported as u64, count);
    assert_eq!(joiner.settled.len(), MAX_SETTLED);
    assert_eq!(joiner.settled_in_order.len(), MAX_SETTLED);
    // The receiver's record of a letter that was reported long ago adds none.
    let taken = seen(count, id(7, count - MAX_SETTLED as u64), Seen::Taken(None));
    joiner.handle(start, B, taken);
    assert!(joiner.letters.is_empty());
}

/// Letters of several senders, with up to four records each that arrive late, in any order, twice
/// or not at all: each letter with at least one record is reported once, in the order of sending,
/// with the outcome that its sender knows.
#[test]
fn each_letter_is_reported_once_and_in_order() {
    for seed in 0..300 {
        let mut random = fastrand::Rng::with_seed(seed);
        let start = Instant::now();
        let mut arrivals: Vec<(u64, RecordSource, Record)> = Vec::new();
        let mut expected: HashMap<Key, Option<Outcome>> = HashMap::new();
        for ms in 0..60 {
            let (sender, sequence) = (random.u64(1..4), ms + 1);
            let letter = || id(sender, sequence);
            let outcome = if random.bool() {
                delivered(Kind::Shm)
            } else {
                failed()
            };
            let reported = random.u8(..);
            let records = [
                (A, seen(ms, letter(), Seen::Sent(Some(sequence)))),
                (B, seen(ms, letter(), Seen::Taken(Some(Kind::Shm)))),
                (
                    GATEWAY,
                    seen(ms, letter(), Seen::Passed(Kind::Shm, Origin::ThisHost)),
                ),
                (A, settled(ms, letter(), outcome.clone(), true)),
            ];
            for (bit, (source, record)) in records.into_iter().enumerate() {
                if reported & (1 << bit) == 0 {
                    continue;
                }
                for _ in 0..random.u8(1..3) {
                    let late = ms + random.u64(..HOLD.as_millis() as u64);
                    arrivals.push((late, source, record.clone()));
                }
            }
            if reported & 0b0111 != 0 {
                let known = (reported & 0b1000 != 0).then_some(outcome);
                expected.insert((Incarnation::from_u64(sender), sequence), known);
            }
        }
        random.shuffle(&mut arrivals);
        arrivals.sort_by_key(|(ms, ..)| *ms);
        let mut joiner = Joiner::new();
        let mut reported: Vec<(SystemTime, Key, Fate)> = Vec::new();
        let mut take = |joiner: &mut Joiner, now| {
            while let Some(event) = joiner.poll_event(now) {
                match event {
                    Event::Letter(it) => {
                        reported.push((it.at, (it.stream.sender, it.sequence), it.fate.clone()));
                    }
                    Event::Later(it) | Event::Confirmed(it) => {
                        let key = (it.stream.sender, it.sequence);
                        let first = reported
                            .iter_mut()
                            .find(|(_, reported, _)| *reported == key);
                        first.expect("reported before").2 = it.fate.clone();
                    }
                    other => panic!("{other:?}"),
                }
            }
        };
        for (ms, source, record) in arrivals {
            let now = start + Duration::from_millis(ms);
            joiner.handle(now, source, record);
            take(&mut joiner, now);
        }
        take(&mut joiner, start + Duration::from_secs(10));
        assert!(
            reported.is_sorted_by_key(|(at, ..)| *at),
            "seed {seed}: {reported:?}"
        );
        assert_eq!(reported.len(), expected.len(), "seed {seed}");
        for (_, key, fate) in &reported {
            match expected.remove(key) {
                Some(Some(outcome)) => assert_eq!(*fate, Fate::Settled(outcome), "seed {seed}"),
                Some(None) => assert!(!matches!(fate, Fate::Settled(_)), "seed {seed}"),
                None => panic!("seed {seed}: {key:?} was reported twice, or never sent"),
            }
        }
        assert!(joiner.finish().is_none() && joiner.poll_timeout().is_none());
    }
}
