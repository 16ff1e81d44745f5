//! Letters over UDT before they are sent: a task translates them into the dialect of the peer. In most
//! tests, the tasks of the sender run only while the test waits for something.
#![cfg(feature = "udt")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod common;

use std::sync::Arc;
use std::time::{Duration, Instant};

use common::{Party, Recorder, letter_parcel, message_parcel, udt_config};
use fipa_acl::{
    AclRepresentation, AgentId, Envelope, EnvelopeParams, Letter, Message, Performative,
};
use fipa_testbed::until_some;
use fipa_transport::{
    Abandoned, AttemptId, Body, Conclusion, Kind, Location, Parcel, Transport, TransportError,
    TransportErrorKind,
};
use fipa_transport_net::{UdtConfig, UdtTransport};
use tokio::runtime::Runtime;

/// A test that waits this long has failed.
const TIMEOUT: Duration = Duration::from_secs(60);

/// An endpoint whose tasks run only while the test waits.
struct Paused {
    transport: UdtTransport,
    sink: Arc<Recorder>,
    runtime: Runtime,
}

impl Paused {
    fn new(config: UdtConfig) -> Self {
        let mut builder = tokio::runtime::Builder::new_current_thread();
        let runtime = builder.enable_all().build().unwrap();
        let transport = UdtTransport::new(config, runtime.handle().clone());
        let sink = Arc::new(Recorder::default());
        transport.listen(sink.clone()).unwrap();
        Self {
            transport,
            sink,
            runtime,
        }
    }

    fn send(&self, attempt: u64, to: &Location, parcel: Parcel) -> Result<(), TransportError> {
        self.transport.post(AttemptId(attempt), to, parcel)
    }

    fn abandon(&self, attempt: u64, to: &Location) -> Abandoned {
        self.transport.abandon(AttemptId(attempt), to)
    }

    fn run_until_concluded(&self, count: usize) {
        run_until_concluded(&self.runtime, &self.sink, count);
    }
}

/// Lets the tasks run until this number of attempts are concluded.
fn run_until_concluded(runtime: &Runtime, sink: &Recorder, count: usize) {
    let began = Instant::now();
    runtime.block_on(async {
        while concluded(sink).len() < count {
            assert!(began.elapsed() < TIMEOUT, "{:?}", concluded(sink));
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    });
}

/// Returns the conclusions by attempt. Asserts that no attempt has two.
fn concluded(sink: &Recorder) -> Vec<(u64, Conclusion)> {
    let record = sink.record.lock();
    let mut all: Vec<_> = record
        .concluded
        .iter()
        .map(|(attempt, conclusions)| match &conclusions[..] {
            [one] => (attempt.0, one.clone()),
            more => panic!("{attempt:?}: {more:?}"),
        })
        .collect();
    all.sort_by_key(|(attempt, _)| *attempt);
    all
}

fn receiver() -> Party<UdtTransport> {
    Party::over(Recorder::default(), |runtime| {
        UdtTransport::new(udt_config(&["127.0.0.1:0"]), runtime)
    })
}

/// Waits for so many letters, and returns their contents in the order of arrival.
fn contents(party: &Party<UdtTransport>, count: usize) -> Vec<String> {
    until_some("the letters", || {
        let record = party.sink.record.lock();
        (record.unframed.len() >= count).then_some(())
    });
    let record = party.sink.record.lock();
    let letters = record.unframed.iter().map(|(letter, _)| {
        let message = Message::decode(letter.payload()).unwrap();
        String::from_utf8(message.content().unwrap().to_vec()).unwrap()
    });
    letters.collect()
}

/// A letter with this envelope and content.
fn letter(base: EnvelopeParams, content: &str) -> Parcel {
    let arm = AgentId::new("arm_1").unwrap();
    let base = EnvelopeParams {
        from: Some(AgentId::new("rover").unwrap()),
        acl_representation: Some(AclRepresentation::BitEfficient),
        date: Some("20261120T112644481Z".parse().unwrap()),
        ..base
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(arm)
        .content(content.to_owned())
        .build()
        .unwrap();
    let letter = Letter::new(envelope.encode_standard().unwrap(), message.to_payload());
    letter_parcel(1, letter)
}

/// A letter that fipa_services cannot read: its envelope has a user-defined parameter.
fn inexpressible() -> Parcel {
    let base = EnvelopeParams {
        to: vec![AgentId::new("arm_1").unwrap()],
        user_defined: vec![("priority".to_owned(), "high".to_owned())],
        ..EnvelopeParams::default()
    };
    letter(base, "lost")
}

/// A letter whose receiver has so many parameters. Their translation takes a while, and their
/// representation in the dialect of fipa_services has more than twice as many bytes.
fn costly(parameters: usize, content: &str) -> Parcel {
    let arm = (0..parameters).fold(AgentId::new("arm_1").unwrap(), |arm, number| {
        arm.with_user_defined(format!("p{number}"), "v").unwrap()
    });
    let base = EnvelopeParams {
        to: vec![arm],
        ..EnvelopeParams::default()
    };
    letter(base, content)
}

fn fault(conclusion: &Conclusion) -> TransportErrorKind {
    match conclusion {
        Conclusion::NotSent(error) => error.fault,
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_letter_that_the_dialect_cannot_express_is_concluded_later_as_not_sent() {
    let receiver = receiver();
    let sender = Paused::new(udt_config(&[]));
    let to = receiver.location();
    sender.send(1, to, inexpressible()).unwrap();
    assert!(concluded(&sender.sink).is_empty());
    sender.run_until_concluded(1);
    let all = concluded(&sender.sink);
    assert_eq!(all[0].0, 1);
    assert_eq!(fault(&all[0].1), TransportErrorKind::Inexpressible);
    let counters = sender.transport.counters();
    assert_eq!(
        (counters.connections, counters.dialed),
        (0, 0),
        "for nothing"
    );

    sender.send(2, to, message_parcel(2, "next")).unwrap();
    sender.run_until_concluded(2);
    assert_eq!(concluded(&sender.sink)[1], (2, Conclusion::Handed));
    assert_eq!(contents(&receiver, 1), ["next"]);
}

#[test]
fn a_letter_that_its_translation_makes_too_large_is_concluded_as_not_sent() {
    let receiver = receiver();
    let parcel = costly(100, "large");
    let Body::Letter(letter) = &parcel.body else {
        panic!("a letter");
    };
    let mut config = udt_config(&[]);
    config.limits.max_letter = letter.len();
    let sender = Paused::new(config);
    sender.send(1, receiver.location(), parcel).unwrap();
    sender.run_until_concluded(1);
    let (_, conclusion) = &concluded(&sender.sink)[0];
    assert_eq!(fault(conclusion), TransportErrorKind::TooLarge);
}

#[test]
fn faults_that_are_certain_at_once_are_returned() {
    let mut config = udt_config(&[]);
    config.limits.max_letter = 200;
    config.limits.max_in_flight = 2;
    let runtime = common::runtime();
    let unopened = UdtTransport::new(config.clone(), runtime.handle().clone());
    let to = Location::new(Kind::Udt, "127.0.0.1:9").unwrap();
    let refused = unopened.post(AttemptId(1), &to, message_parcel(1, "x"));
    let error = refused.unwrap_err();
    assert_eq!(error.fault, TransportErrorKind::Closed);
    assert!(error.detail.contains("listen"), "{error}");

    let sender = Paused::new(config);
    let other = Location::new(Kind::Tcp, "127.0.0.1:9").unwrap();
    let credit = Parcel {
        body: Body::Credit,
        ..message_parcel(1, "x")
    };
    let long = "x".repeat(200);
    for (to, parcel, fault) in [
        (
            &other,
            message_parcel(1, "x"),
            TransportErrorKind::Unreachable,
        ),
        (&to, credit, TransportErrorKind::Incompatible),
        (&to, message_parcel(1, &long), TransportErrorKind::TooLarge),
    ] {
        let refused = sender.send(1, to, parcel);
        assert_eq!(refused.unwrap_err().fault, fault);
    }
    for attempt in 1..=2 {
        sender.send(attempt, &to, inexpressible()).unwrap();
    }
    let refused = sender.send(3, &to, inexpressible());
    assert_eq!(refused.unwrap_err().fault, TransportErrorKind::Congested);
    sender.run_until_concluded(2);
    sender.send(3, &to, inexpressible()).unwrap();
    sender.run_until_concluded(3);
}

#[test]
fn letters_arrive_in_the_order_of_dispatch_however_long_their_translation_takes() {
    let (receiver, sender) = (receiver(), receiver());
    let mut sent = Vec::new();
    for number in 0..40 {
        let content = number.to_string();
        let parcel = match number % 4 {
            0 => costly(5_000, &content),
            1 => costly(200, &content),
            _ => message_parcel(number, &content),
        };
        sender.send(number, receiver.location(), parcel).unwrap();
        sent.push(content);
    }
    for number in 0..40 {
        assert_eq!(sender.conclusion(number), Conclusion::Handed);
    }
    assert_eq!(contents(&receiver, 40), sent);
    assert_eq!(sender.transport.counters().dialed, 1);
}

#[test]
fn a_letter_that_is_abandoned_before_its_translation_is_never_sent() {
    let receiver = receiver();
    let sender = Paused::new(udt_config(&[]));
    let to = receiver.location();
    for attempt in 1..=3 {
        let parcel = message_parcel(attempt, &attempt.to_string());
        sender.send(attempt, to, parcel).unwrap();
    }
    for attempt in [1, 3] {
        assert_eq!(sender.abandon(attempt, to), Abandoned::NotSent);
        assert_eq!(sender.abandon(attempt, to), Abandoned::Unconfirmed);
    }
    sender.run_until_concluded(1);
    sender.send(4, to, message_parcel(4, "4")).unwrap();
    sender.run_until_concluded(2);
    let handed = [(2, Conclusion::Handed), (4, Conclusion::Handed)];
    assert_eq!(concluded(&sender.sink), handed);
    assert_eq!(contents(&receiver, 2), ["2", "4"]);
}

#[test]
fn closing_concludes_the_letters_that_wait_for_their_translation() {
    let receiver = receiver();
    let to = receiver.location();
    let assert_not_sent = |sink: &Recorder| {
        let all = concluded(sink);
        assert_eq!(all.len(), 3);
        for (_, conclusion) in all {
            assert_eq!(fault(&conclusion), TransportErrorKind::Closed);
        }
    };
    let with_letters = || {
        let sender = Paused::new(udt_config(&[]));
        for attempt in 1..=3 {
            sender.send(attempt, to, costly(100, "lost")).unwrap();
        }
        sender
    };

    let sender = with_letters();
    sender.transport.close();
    let refused = sender.send(4, to, message_parcel(4, "late"));
    assert_eq!(refused.unwrap_err().fault, TransportErrorKind::Closed);
    assert_eq!(sender.abandon(1, to), Abandoned::NotSent);
    sender.run_until_concluded(2);
    assert!(
        concluded(&sender.sink)
            .iter()
            .all(|(attempt, _)| *attempt != 1)
    );

    let Paused {
        transport,
        sink,
        runtime,
    } = with_letters();
    drop(transport);
    run_until_concluded(&runtime, &sink, 3);
    assert_not_sent(&sink);

    // The runtime ends before the translation begins, and the transport is closed with it.
    let Paused {
        transport,
        sink,
        runtime,
    } = with_letters();
    drop(runtime);
    assert_not_sent(&sink);
    let refused = transport.post(AttemptId(4), to, message_parcel(4, "late"));
    assert_eq!(refused.unwrap_err().fault, TransportErrorKind::Closed);
    assert_eq!(receiver.transport.counters().accepted, 0);
}
