//! Rules on connections with peers that have proved their identity: the connections end with the trust
//! in the peer.
//!
//! They also hold for transports to legacy peers, which hand letters over without a parcel.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{
    AclRepresentation, AgentId, Envelope, EnvelopeParams, Letter, Message, Performative,
};
use parking_lot::Mutex;

use super::Fixture;
use super::endpoint::{TIMEOUT, accepted, parcel};
use crate::{
    Answer, Arrival, AttemptId, Body, Conclusion, Kind, LegacySource, Location, Reaction, Sink,
    Transport,
};

/// An endpoint whose peers prove their identity with certificates.
pub struct KeyedEndpoint {
    /// The endpoint, which does not listen yet.
    pub transport: Arc<dyn Transport>,
    /// Withdraws the trust of this endpoint in all peers.
    pub withdraw: Box<dyn Fn()>,
}

impl fmt::Debug for KeyedEndpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("KeyedEndpoint").finish_non_exhaustive()
    }
}

/// Validity of a certificate that ends during a test, with time for handshakes under load.
const SHORT: Duration = Duration::from_secs(8);
const DAY: Duration = Duration::from_secs(86_400);

#[derive(Default)]
struct Record {
    arrived: Mutex<usize>,
    concluded: Mutex<HashMap<AttemptId, Conclusion>>,
}

impl Sink for Record {
    fn arrived(&self, _: Arrival) -> Reaction {
        *self.arrived.lock() += 1;
        Reaction::Now(Answer::Accepted)
    }

    fn arrived_unframed(&self, _: Letter, _: Kind, _: LegacySource) {
        *self.arrived.lock() += 1;
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        self.concluded.lock().insert(attempt, conclusion);
    }
}

/// An endpoint that listens.
struct Party {
    endpoint: KeyedEndpoint,
    record: Arc<Record>,
    location: Location,
}

impl Party {
    fn new(endpoint: KeyedEndpoint) -> Self {
        let record = Arc::new(Record::default());
        let sink = Arc::clone(&record) as Arc<dyn Sink>;
        let locations = endpoint.transport.listen(sink).expect("listens");
        Self {
            location: locations.first().expect("a location").clone(),
            endpoint,
            record,
        }
    }

    /// Hands over a letter to the other endpoint. Returns whether it has arrived there.
    fn reaches(&self, other: &Self, attempt: u64) -> bool {
        let id = AttemptId(attempt);
        let transport = &self.endpoint.transport;
        let before = *other.record.arrived.lock();
        let sent = parcel(attempt, letter(attempt));
        if transport.post(id, &other.location, sent).is_err() {
            return false;
        }
        let started = Instant::now();
        let conclusion = loop {
            let driven = [self, other].map(|it| it.endpoint.transport.drive());
            if let Some(conclusion) = self.record.concluded.lock().remove(&id) {
                break conclusion;
            }
            assert!(started.elapsed() < TIMEOUT, "attempt {attempt} has no end");
            if driven == [false; 2] {
                std::thread::sleep(Duration::from_micros(200));
            }
        };
        let is_taken = conclusion == accepted() || conclusion == Conclusion::Handed;
        let has_arrived = *other.record.arrived.lock() > before;
        assert!(has_arrived || !is_taken, "{conclusion:?}");
        has_arrived
    }
}

impl Drop for Party {
    fn drop(&mut self) {
        self.endpoint.transport.close();
    }
}

/// A letter that legacy peers can read, with another content for each number.
fn letter(number: u64) -> Body {
    let (from, to) = (agent("rover"), agent("arm_1"));
    let message = Message::builder(Performative::Inform)
        .sender(from.clone())
        .receiver(to.clone())
        .content(number.to_string())
        .build()
        .expect("a message");
    let base = EnvelopeParams {
        from: Some(from),
        to: vec![to.clone()],
        intended_receivers: vec![to],
        acl_representation: Some(AclRepresentation::BitEfficient),
        date: Some("20261120T112644481Z".parse().expect("a date")),
        ..EnvelopeParams::default()
    };
    let envelope = Envelope {
        base,
        extensions: Vec::new(),
    };
    let envelope = envelope.encode_standard().expect("an envelope");
    Body::Letter(Letter::new(envelope, message.to_payload()))
}

fn agent(name: &str) -> AgentId {
    AgentId::new(name).expect("a name")
}

/// Two endpoints with open connections in both directions. The certificate of the first one is valid for
/// this time.
fn connected(fixture: &dyn Fixture, valid_for: Duration) -> Option<[Party; 2]> {
    let pair = fixture.keyed_pair(valid_for)?.map(Party::new);
    let [one, other] = &pair;
    assert!(one.reaches(other, 1) && other.reaches(one, 2));
    Some(pair)
}

/// After trust was withdrawn, no letter passes over a connection that is open, in either direction,
/// whichever side has withdrawn it.
pub fn withdrawn_trust_ends_open_connections(fixture: &dyn Fixture) {
    for withdrawing in [0, 1] {
        for first_to_send in [0, 1] {
            let Some(pair) = connected(fixture, DAY) else {
                return;
            };
            (pair[withdrawing].endpoint.withdraw)();
            for (attempt, from) in [
                (3, first_to_send),
                (4, 1 - first_to_send),
                (5, first_to_send),
            ] {
                assert!(!pair[from].reaches(&pair[1 - from], attempt));
            }
        }
    }
}

/// After the certificate of one side has ended, no letter passes over a connection that is open, in
/// either direction. Until then, letters pass.
pub fn the_end_of_a_certificate_ends_open_connections(fixture: &dyn Fixture) {
    let end = SystemTime::now() + SHORT;
    let Some([one, other]) = connected(fixture, SHORT) else {
        return;
    };
    let started = Instant::now();
    let mut attempt = 3;
    let mut passes = |from: &Party, to: &Party| {
        attempt += 1;
        from.reaches(to, attempt)
    };
    // Letters keep the connections from being closed as idle.
    while passes(&one, &other) | passes(&other, &one) {
        assert!(started.elapsed() < TIMEOUT, "letters still pass");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(SystemTime::now() >= end, "ended before the certificate");
    assert!(!passes(&one, &other) && !passes(&other, &one));
}
