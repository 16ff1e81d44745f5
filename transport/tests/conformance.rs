//! The conformance suite for a minimal transport: a table of endpoints in this process. Shows that
//! the rules can be satisfied, and that [`Faulty`] without faults satisfies them, too.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use fipa_transport::conformance::{Fixture, KeyedEndpoint};
use fipa_transport::{
    Abandoned, Answer, Arrival, AttemptId, Conclusion, Faulty, Hop, Incarnation, Kind, ListenError,
    Location, Parcel, Principal, Reaction, Sink, Ticket, Transport, TransportError,
    TransportErrorKind, wire,
};
use parking_lot::Mutex;

const MAX_LETTER: usize = 8 << 20;
const WINDOW: usize = 64;

#[derive(Default)]
struct EndpointTable(Mutex<HashMap<Location, Arc<Endpoint>>>);

struct Endpoint {
    table: Arc<EndpointTable>,
    location: Location,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    sink: Option<Arc<dyn Sink>>,
    closed: bool,
    inbox: VecDeque<(Arc<Endpoint>, AttemptId, Parcel)>,
    open: HashSet<AttemptId>,
    unanswered: HashMap<Ticket, (Arc<Endpoint>, AttemptId)>,
    next_ticket: u64,
    conclusions: VecDeque<(AttemptId, Conclusion)>,
}

impl Endpoint {
    fn conclude(&self, attempt: AttemptId, conclusion: Conclusion) {
        let mut state = self.state.lock();
        if state.open.remove(&attempt) {
            state.conclusions.push_back((attempt, conclusion));
        }
    }

    fn answered(&self, attempt: AttemptId, mut answer: Answer) {
        if let Answer::Failed { detail, .. } = &mut answer {
            *detail = wire::truncated(detail, Answer::MAX_DETAIL).to_owned();
        }
        self.conclude(attempt, Conclusion::Answered(answer));
    }
}

/// The transport: a handle to an endpoint, so that endpoints can refer to each other.
struct TableTransport(Arc<Endpoint>);

impl Transport for TableTransport {
    fn kind(&self) -> Kind {
        Kind::Tcp
    }

    fn max_letter(&self) -> usize {
        MAX_LETTER
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let endpoint = &self.0;
        endpoint.state.lock().sink = Some(sink);
        endpoint
            .table
            .0
            .lock()
            .insert(endpoint.location.clone(), Arc::clone(endpoint));
        Ok(vec![endpoint.location.clone()])
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        let refused = |fault| Err(TransportError::new(fault, ""));
        if self.0.state.lock().closed {
            return refused(TransportErrorKind::Closed);
        }
        if matches!(&parcel.body, fipa_transport::Body::Letter(l) if l.len() > MAX_LETTER) {
            return refused(TransportErrorKind::TooLarge);
        }
        let Some(peer) = self.0.table.0.lock().get(to).cloned() else {
            return refused(TransportErrorKind::Unreachable);
        };
        let room = match parcel.body {
            fipa_transport::Body::Letter(_) => WINDOW - WINDOW / 4,
            _ => WINDOW,
        };
        if peer.state.lock().inbox.len() >= room {
            return refused(TransportErrorKind::Congested);
        }
        self.0.state.lock().open.insert(attempt);
        peer.state
            .lock()
            .inbox
            .push_back((Arc::clone(&self.0), attempt, parcel));
        Ok(())
    }

    fn abandon(&self, attempt: AttemptId, _to: &Location) -> Abandoned {
        let mut state = self.0.state.lock();
        state.open.remove(&attempt);
        state.conclusions.retain(|(other, _)| *other != attempt);
        // The parcel is or was in the other side's inbox.
        Abandoned::Unconfirmed
    }

    fn answer(&self, ticket: Ticket, answer: Answer) {
        let waiting = self.0.state.lock().unanswered.remove(&ticket);
        if let Some((sender, attempt)) = waiting {
            sender.answered(attempt, answer);
        }
    }

    fn drive(&self) -> bool {
        let mut did_something = false;
        loop {
            let mut state = self.0.state.lock();
            let Some(sink) = state.sink.clone() else {
                return did_something;
            };
            if let Some((attempt, conclusion)) = state.conclusions.pop_front() {
                drop(state);
                sink.concluded(attempt, conclusion);
            } else if let Some((sender, attempt, parcel)) = state.inbox.pop_front() {
                state.next_ticket += 1;
                let ticket = Ticket(state.next_ticket);
                state
                    .unanswered
                    .insert(ticket, (Arc::clone(&sender), attempt));
                drop(state);
                let from = Hop {
                    location: sender.location.clone(),
                    principal: Principal::Host,
                };
                if let Reaction::Now(answer) = sink.arrived(Arrival {
                    parcel,
                    from,
                    ticket: Some(ticket),
                }) {
                    self.answer(ticket, answer);
                }
            } else {
                return did_something;
            }
            did_something = true;
        }
    }

    fn close(&self) {
        let endpoint = &self.0;
        endpoint.table.0.lock().remove(&endpoint.location);
        let broken = || TransportError::new(TransportErrorKind::Broken, "closed");
        let mut state = endpoint.state.lock();
        state.closed = true;
        let refused: Vec<_> = state.inbox.drain(..).collect();
        let unanswered: Vec<_> = state.unanswered.drain().collect();
        let open: Vec<_> = state.open.iter().copied().collect();
        drop(state);
        for (sender, attempt, _) in refused {
            sender.conclude(attempt, Conclusion::NotSent(broken()));
        }
        for (_, (sender, attempt)) in unanswered {
            sender.conclude(attempt, Conclusion::Unconfirmed(broken()));
        }
        for attempt in open {
            endpoint.conclude(attempt, Conclusion::Unconfirmed(broken()));
        }
        self.drive();
    }
}

#[derive(Default)]
struct TableFixture {
    table: Arc<EndpointTable>,
    next: AtomicU64,
}

impl Fixture for TableFixture {
    fn endpoint(&self) -> Arc<dyn Transport> {
        let number = self.next.fetch_add(1, Ordering::Relaxed) + 1;
        let location = Location::new(Kind::Tcp, &format!("table:{number}")).expect("an address");
        Arc::new(TableTransport(Arc::new(Endpoint {
            table: Arc::clone(&self.table),
            location: location.with_incarnation(Incarnation::from_u64(number)),
            state: Mutex::default(),
        })))
    }

    fn nowhere(&self) -> Location {
        "tcp://table:none#00000000000000ff"
            .parse()
            .expect("a location")
    }

    fn keyed_pair(&self, _: Duration) -> Option<[KeyedEndpoint; 2]> {
        None
    }
}

#[derive(Default)]
struct FaultyFixture(TableFixture);

impl Fixture for FaultyFixture {
    fn endpoint(&self) -> Arc<dyn Transport> {
        Arc::new(Faulty::new(self.0.endpoint(), 1, &[]))
    }

    fn nowhere(&self) -> Location {
        self.0.nowhere()
    }

    fn keyed_pair(&self, _: Duration) -> Option<[KeyedEndpoint; 2]> {
        None
    }
}

mod table_transport {
    fipa_transport::conformance_tests!(super::TableFixture::default());
}

mod faulty_without_faults {
    fipa_transport::conformance_tests!(super::FaultyFixture::default());
}

mod faults {
    use super::*;
    use fipa_transport::{Body, Fault, Stream};

    #[derive(Default)]
    struct RecordingSink {
        arrived: Mutex<u64>,
        concluded: Mutex<Vec<(AttemptId, Conclusion)>>,
    }

    impl Sink for RecordingSink {
        fn arrived(&self, _: Arrival) -> Reaction {
            *self.arrived.lock() += 1;
            Reaction::Now(Answer::Accepted)
        }

        fn arrived_unframed(&self, _: fipa_acl::Letter, _: Kind, _: fipa_transport::LegacySource) {}

        fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
            self.concluded.lock().push((attempt, conclusion));
        }
    }

    fn credit() -> Parcel {
        let unknown = Incarnation::UNKNOWN;
        Parcel {
            receiver: "x".into(),
            stream: Stream::between(unknown, unknown),
            sequence: 1,
            after: 0,
            remaining: Duration::ZERO,
            transfer: 0,
            body: Body::Credit,
        }
    }

    #[test]
    fn each_fault_has_its_documented_effect() {
        let fixture = TableFixture::default();
        let sender = Faulty::new(fixture.endpoint(), 7, &[]);
        let receiver = fixture.endpoint();
        let (at_sender, at_receiver) = (
            Arc::new(RecordingSink::default()),
            Arc::new(RecordingSink::default()),
        );
        sender.listen(at_sender.clone()).unwrap();
        let to = receiver.listen(at_receiver.clone()).unwrap().remove(0);
        let attempt = |number: u64, fault| {
            sender.force(Some(fault));
            let result = sender.post(AttemptId(number), &to, credit());
            while receiver.drive() || sender.drive() {}
            result
        };
        assert_eq!(
            attempt(1, Fault::Unreachable).unwrap_err().fault,
            TransportErrorKind::Unreachable
        );
        attempt(2, Fault::Lost).unwrap();
        attempt(3, Fault::Silence).unwrap();
        assert_eq!(*at_receiver.arrived.lock(), 0);
        attempt(4, Fault::AnswerLost).unwrap();
        assert_eq!(*at_receiver.arrived.lock(), 1);
        let concluded = at_sender.concluded.lock();
        assert_eq!(
            concluded
                .iter()
                .map(|(attempt, _)| attempt.0)
                .collect::<Vec<_>>(),
            [2, 4]
        );
        assert!(
            concluded
                .iter()
                .all(|(_, end)| matches!(end, Conclusion::Unconfirmed(_)))
        );
        assert_eq!(sender.injected(), 4);
    }

    #[test]
    fn the_seed_determines_the_faults() {
        let run = |seed| {
            let fixture = TableFixture::default();
            let sender = Faulty::new(fixture.endpoint(), seed, &[(Fault::Unreachable, 0.3)]);
            sender.listen(Arc::new(RecordingSink::default())).unwrap();
            let receiver = fixture.endpoint();
            let to = receiver
                .listen(Arc::new(RecordingSink::default()))
                .unwrap()
                .remove(0);
            (0..40)
                .map(|n| sender.post(AttemptId(n), &to, credit()).is_ok())
                .collect::<Vec<_>>()
        };
        assert_eq!(run(3), run(3));
        assert_ne!(run(3), run(4));
    }
}
