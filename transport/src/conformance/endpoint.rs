//! Endpoints under test, with sinks that record their calls.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{Letter, Payload};
use parking_lot::Mutex;

use super::Fixture;
use crate::{
    Answer, Arrival, AttemptId, Body, Conclusion, Hop, Incarnation, Introduction, Kind,
    LegacySource, Location, Parcel, Reaction, Sink, Stream, Ticket, Transport, TransportErrorKind,
};

/// Timeout after which the suite considers a transport broken.
pub(super) const TIMEOUT: Duration = Duration::from_secs(60);

type VerdictOf = Box<dyn Fn(&Arrival) -> Reaction + Send + Sync>;

#[derive(Default)]
pub(super) struct Record {
    pub(super) arrivals: Vec<(Parcel, Hop, Option<Ticket>)>,
    pub(super) concluded: HashMap<AttemptId, Vec<Conclusion>>,
    /// Numbers of connections that were opened, and that have ended.
    pub(super) introduced: usize,
    pub(super) disconnected: usize,
}

pub(super) struct RecordingSink {
    pub(super) record: Mutex<Record>,
    reaction_of: VerdictOf,
}

impl Sink for RecordingSink {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        let reaction = (self.reaction_of)(&arrival);
        let Arrival {
            parcel,
            from,
            ticket,
        } = arrival;
        self.record.lock().arrivals.push((parcel, from, ticket));
        reaction
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {
        panic!("an unframed letter arrived, and none was sent");
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        self.record
            .lock()
            .concluded
            .entry(attempt)
            .or_default()
            .push(conclusion);
    }

    fn introduced(&self, _: &Introduction) {
        self.record.lock().introduced += 1;
    }

    fn disconnected(&self, _: &Introduction) {
        self.record.lock().disconnected += 1;
    }
}

/// An endpoint that listens, with its recording sink.
pub(super) struct TestEndpoint {
    pub(super) transport: Arc<dyn Transport>,
    pub(super) sink: Arc<RecordingSink>,
    pub(super) location: Location,
}

impl TestEndpoint {
    pub(super) fn new(fixture: &dyn Fixture) -> Self {
        Self::with_verdict(fixture, |_| Reaction::Now(Answer::Accepted))
    }

    pub(super) fn with_verdict(
        fixture: &dyn Fixture,
        reaction_of: impl Fn(&Arrival) -> Reaction + Send + Sync + 'static,
    ) -> Self {
        let transport = fixture.endpoint();
        let sink = Arc::new(RecordingSink {
            record: Mutex::default(),
            reaction_of: Box::new(reaction_of),
        });
        let locations = transport
            .listen(Arc::clone(&sink) as Arc<dyn Sink>)
            .expect("listens");
        let location = locations.first().expect("a location").clone();
        assert_eq!(location.kind(), transport.kind());
        assert!(
            location.incarnation().is_known(),
            "{location} has no incarnation"
        );
        Self {
            transport,
            sink,
            location,
        }
    }

    pub(super) fn send(&self, attempt: u64, to: &TestEndpoint, parcel: Parcel) {
        self.transport
            .post(AttemptId(attempt), &to.location, parcel)
            .unwrap_or_else(|error| panic!("post {attempt}: {error}"));
    }

    pub(super) fn conclusion(&self, attempt: u64) -> Option<Conclusion> {
        self.sink
            .record
            .lock()
            .concluded
            .get(&AttemptId(attempt))?
            .first()
            .cloned()
    }

    pub(super) fn arrivals(&self) -> usize {
        self.sink.record.lock().arrivals.len()
    }

    /// Whether a parcel with this sequence has arrived here.
    pub(super) fn has_arrived(&self, sequence: u64) -> bool {
        let record = self.sink.record.lock();
        record
            .arrivals
            .iter()
            .any(|(parcel, ..)| parcel.sequence == sequence)
    }

    pub(super) fn arrived(&self, index: usize) -> Parcel {
        self.sink.record.lock().arrivals[index].0.clone()
    }

    /// Checks that no attempt has two conclusions.
    fn check_single_conclusions(&self) {
        for (attempt, conclusions) in &self.sink.record.lock().concluded {
            assert_eq!(conclusions.len(), 1, "{attempt:?}: {conclusions:?}");
        }
    }
}

impl Drop for TestEndpoint {
    fn drop(&mut self) {
        self.transport.close();
        if !std::thread::panicking() {
            self.check_single_conclusions();
        }
    }
}

pub(super) fn until<T>(
    endpoints: &[&TestEndpoint],
    what: &str,
    condition: impl Fn() -> Option<T>,
) -> T {
    let started = Instant::now();
    loop {
        let driven = endpoints
            .iter()
            .filter(|endpoint| endpoint.transport.drive())
            .count();
        if let Some(value) = condition() {
            return value;
        }
        assert!(started.elapsed() < TIMEOUT, "timed out waiting for {what}");
        if driven == 0 {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
}

pub(super) fn concluded(
    endpoints: &[&TestEndpoint],
    sender: &TestEndpoint,
    attempt: u64,
) -> Conclusion {
    until(endpoints, "the conclusion of an attempt", || {
        sender.conclusion(attempt)
    })
}

/// Whether a parcel was accepted. One that had to wait for memory may find no room afterwards.
pub(super) fn is_accepted(
    endpoints: &[&TestEndpoint],
    sender: &TestEndpoint,
    attempt: u64,
) -> bool {
    match concluded(endpoints, sender, attempt) {
        Conclusion::NotSent(error) => {
            assert_eq!(error.fault, TransportErrorKind::Congested, "{error}");
            false
        }
        conclusion => {
            assert_eq!(conclusion, accepted());
            true
        }
    }
}

pub(super) fn accepted() -> Conclusion {
    Conclusion::Answered(Answer::Accepted)
}

pub(super) fn letter(content: impl Into<Bytes>) -> Body {
    let payload = Payload {
        head: Bytes::from_static(b"head of the message"),
        content: content.into(),
        tail: Bytes::from_static(b"\x01"),
    };
    Body::Letter(Letter::new(Bytes::from_static(b"envelope"), payload))
}

pub(super) fn parcel(sequence: u64, body: Body) -> Parcel {
    Parcel {
        receiver: "arm_1".into(),
        stream: Stream::between(Incarnation::from_u64(0x5e4d), Incarnation::from_u64(0x4ec3)),
        sequence,
        after: 0,
        transfer: 1,
        remaining: Duration::from_millis(2500),
        body,
    }
}

pub(super) fn assert_same(arrived: &Parcel, sent: &Parcel) {
    match (&arrived.body, &sent.body) {
        (Body::Letter(arrived), Body::Letter(sent)) => {
            assert_eq!(arrived.envelope(), sent.envelope());
            assert!(
                arrived.payload().to_bytes() == sent.payload().to_bytes(),
                "payload differs"
            );
        }
        (arrived, sent) => assert_eq!(arrived, sent),
    }
    let header = |parcel: &Parcel| Parcel {
        body: Body::Credit,
        ..parcel.clone()
    };
    assert_eq!(header(arrived), header(sent));
}

pub(super) fn pattern(len: usize) -> Bytes {
    (0..len)
        .map(|i| (i ^ (i >> 8)) as u8)
        .collect::<Vec<_>>()
        .into()
}
