//! Tests of the meter.

use std::sync::Arc;
use std::time::SystemTime;

use bytes::Bytes;
use fipa::admin::watch::SeenEnvelope;
use fipa::{AgentId, Incarnation, Kind, Message, Performative};
use fipa_transport::{FailureReason, Stream};

use super::*;

const WINDOW: Duration = Duration::from_secs(5);

fn delivered(via: Kind) -> Outcome {
    Outcome::Delivered {
        via,
        attempts: Vec::new(),
    }
}

fn failed() -> Outcome {
    Outcome::Failed {
        reason: FailureReason::NoSuchAgent,
        attempts: Vec::new(),
    }
}

/// A letter with this number from `rover` to `arm`.
pub(in crate::command::top) fn passage(number: u64, fate: Fate) -> Passage {
    named(number, "rover", "arm", fate)
}

pub(in crate::command::top) fn named(
    number: u64,
    sender: &str,
    receiver: &str,
    fate: Fate,
) -> Passage {
    let message = Message::builder(Performative::Inform).sender(AgentId::new(sender).unwrap());
    let at = SystemTime::UNIX_EPOCH + Duration::from_secs(1000);
    let settled_at = match &fate {
        Fate::Settled(_) => Some(at + Duration::from_millis(20)),
        _ => None,
    };
    Passage {
        number,
        at,
        stream: Stream::between(Incarnation::from_u64(7), Incarnation::from_u64(8)),
        sequence: number,
        submission: Some(number),
        receiver: Arc::from(receiver),
        envelope: SeenEnvelope::default(),
        message: Some(message.build().unwrap()),
        content_len: None,
        content: Bytes::new(),
        size: 100,
        via: None,
        gateway: None,
        from_elsewhere: false,
        from_service: false,
        fate,
        settled_at,
    }
}

fn observed(passage: &Passage) -> Observed<'_> {
    Observed {
        passage,
        host: None,
    }
}

fn total(meter: &Meter, agent: &str) -> [u64; 4] {
    let mut agents = meter.agents();
    let (_, counter) = agents.find(|(name, _)| *name == agent).unwrap();
    let total = counter.total();
    [total.sent, total.received, total.failed, total.violations]
}

#[test]
fn a_letter_counts_for_its_sender_and_its_receiver() {
    let now = Instant::now();
    let mut meter = Meter::new(now, WINDOW);
    let letter = passage(1, Fate::Settled(delivered(Kind::Shm)));
    meter.letter(now, &observed(&letter), true);
    assert_eq!(total(&meter, "rover"), [1, 0, 0, 1]);
    assert_eq!(total(&meter, "arm"), [0, 1, 0, 0]);
    let slots = meter.slots();
    let latency = meter.all().latency(now, slots).unwrap();
    assert_eq!(latency.median, Duration::from_millis(20));
    for (_, counter) in meter.agents() {
        assert_eq!(counter.most_used(now, slots), Some(Kind::Shm));
    }
}

#[test]
fn news_of_a_letter_count_once() {
    let now = Instant::now();
    let mut meter = Meter::new(now, WINDOW);
    // Each history ends with one reception, one delivery time, or one failure.
    let taken_late = [
        Fate::UnderWay,
        Fate::Taken,
        Fate::Settled(delivered(Kind::Unix)),
    ];
    let failed_late = [
        Fate::UnderWay,
        Fate::Passed(failed()),
        Fate::Settled(failed()),
    ];
    let unconfirmed = [Fate::Taken, Fate::Settled(failed())];
    for (number, history) in (1..).zip([&taken_late[..], &failed_late, &unconfirmed]) {
        for (place, fate) in history.iter().enumerate() {
            let letter = passage(number, fate.clone());
            match place {
                0 => meter.letter(now, &observed(&letter), false),
                _ => meter.later(now, &observed(&letter)),
            }
        }
    }
    assert_eq!(total(&meter, "rover"), [3, 0, 2, 0]);
    assert_eq!(total(&meter, "arm"), [0, 2, 0, 0]);
    assert!(meter.open.is_empty());
}

#[test]
fn a_service_that_reports_a_failure_is_no_agent() {
    let now = Instant::now();
    let mut meter = Meter::new(now, WINDOW);
    let report = Passage {
        from_service: true,
        submission: None,
        ..named(1, "sherpa-4711", "rover", Fate::Taken)
    };
    meter.letter(now, &observed(&report), false);
    let names: Vec<&str> = meter.agents().map(|(name, _)| name).collect();
    assert_eq!(names, ["rover"]);
}

#[test]
fn letters_of_another_host_count_for_it() {
    let now = Instant::now();
    let mut meter = Meter::new(now, WINDOW);
    let to = passage(1, Fate::Settled(delivered(Kind::Tcp)));
    let from = Passage {
        from_elsewhere: true,
        submission: None,
        via: Some(Kind::Tcp),
        ..named(2, "arm", "rover", Fate::Taken)
    };
    for letter in [&to, &from, &from] {
        let host = Some("crex-mts");
        let observed = Observed {
            passage: letter,
            host,
        };
        meter.letter(now, &observed, false);
    }
    let host = meter.of_host("crex-mts").unwrap();
    let total = host.total();
    assert_eq!((total.sent, total.received), (2, 1));
    let latency = host.latency(now, meter.slots()).unwrap();
    assert_eq!(latency.median, Duration::from_millis(20));
    assert_eq!(host.most_used(now, meter.slots()), Some(Kind::Tcp));
}

#[test]
fn invented_names_take_bounded_memory_and_displace_no_registered_agent() {
    let now = Instant::now();
    let mut meter = Meter::new(now, WINDOW);
    meter.register(now, ["rover", "arm"].into_iter());
    let invent = |meter: &mut Meter, now, from: u64| {
        for number in from..from + 3000 {
            let name = format!("invented-{number}");
            let letter = named(number, &name, &name, Fate::UnderWay);
            let host = Some(name.as_str());
            let passage = &letter;
            meter.letter(now, &Observed { passage, host }, false);
        }
    };
    invent(&mut meter, now, 0);
    assert_eq!(meter.agents().count(), MAX_AGENTS);
    assert_eq!(meter.hosts.len(), MAX_HOSTS);
    let others = meter.others().unwrap().total();
    assert_eq!(others.sent, 3000 - (MAX_AGENTS as u64 - 2));
    assert_eq!(meter.all().total().sent, 3000);
    let letter = passage(9000, Fate::Taken);
    meter.letter(now, &observed(&letter), false);
    assert_eq!(total(&meter, "rover"), [1, 0, 0, 0]);

    // Idle names make room for active ones.
    let later = now + WINDOW + Duration::from_secs(1);
    let letter = named(9001, "late", "arm", Fate::Taken);
    meter.letter(later, &observed(&letter), false);
    assert_eq!(total(&meter, "late"), [1, 0, 0, 0]);
    assert_eq!(total(&meter, "rover"), [1, 0, 0, 0]);
    invent(&mut meter, later, 10_000);
    assert_eq!(meter.agents().count(), MAX_AGENTS);
    for number in 0..2 * MAX_OPEN as u64 {
        let letter = passage(20_000 + number, Fate::UnderWay);
        meter.letter(later, &observed(&letter), false);
    }
    assert_eq!(meter.open.len(), MAX_OPEN);
}

#[test]
fn an_agent_that_has_ended_is_removed_after_a_while() {
    let now = Instant::now();
    let mut meter = Meter::new(now, WINDOW);
    meter.register(now, ["arm"].into_iter());
    let letter = passage(1, Fate::Taken);
    meter.letter(now, &observed(&letter), false);
    meter.register(now + KEPT / 2, ["arm"].into_iter());
    assert_eq!(
        meter.agents().count(),
        2,
        "rover is not registered, but active"
    );
    meter.register(now + KEPT * 2, ["arm"].into_iter());
    let names: Vec<&str> = meter.agents().map(|(name, _)| name).collect();
    assert_eq!(names, ["arm"]);
}
