//! The conformance suite, run against a transport that is as simple as one can be: a table of
//! endpoints in this process. It shows that the rules can be kept, and that [`Faulty`] without
//! faults keeps them too.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use fipa_transport::conformance::Fixture;
use fipa_transport::{
    Abandoned, Answer, Arrival, AttemptId, Conclusion, Faulty, Hop, Incarnation, Kind, ListenError,
    Location, Parcel, Principal, Sink, Ticket, Transport, Verdict, WayError, WayFault, wire,
};
use parking_lot::Mutex;

const MAX_LETTER: usize = 8 << 20;
const WINDOW: usize = 64;

#[derive(Default)]
struct Exchange(Mutex<HashMap<Location, Arc<Endpoint>>>);

struct Endpoint {
    exchange: Arc<Exchange>,
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

/// The transport: a handle to an endpoint, so that endpoints can name each other.
struct Local(Arc<Endpoint>);

impl Transport for Local {
    fn kind(&self) -> Kind {
        Kind::Tcp
    }

    fn max_letter(&self) -> usize {
        MAX_LETTER
    }

    fn answers_at_once(&self) -> bool {
        false
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let endpoint = &self.0;
        endpoint.state.lock().sink = Some(sink);
        endpoint
            .exchange
            .0
            .lock()
            .insert(endpoint.location.clone(), Arc::clone(endpoint));
        Ok(vec![endpoint.location.clone()])
    }

    fn dispatch(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError> {
        let refused = |fault| Err(WayError::new(fault, ""));
        if self.0.state.lock().closed {
            return refused(WayFault::Closed);
        }
        if matches!(&parcel.body, fipa_transport::Body::Letter(l) if l.len() > MAX_LETTER) {
            return refused(WayFault::TooLarge);
        }
        let Some(peer) = self.0.exchange.0.lock().get(to).cloned() else {
            return refused(WayFault::Unreachable);
        };
        if peer.state.lock().inbox.len() >= WINDOW {
            return refused(WayFault::Congested);
        }
        self.0.state.lock().open.insert(attempt);
        peer.state
            .lock()
            .inbox
            .push_back((Arc::clone(&self.0), attempt, parcel));
        Ok(())
    }

    fn abandon(&self, attempt: AttemptId) -> Abandoned {
        let mut state = self.0.state.lock();
        state.open.remove(&attempt);
        state.conclusions.retain(|(other, _)| *other != attempt);
        // It is in the other side's inbox, or was.
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
                if let Verdict::Now(answer) = sink.arrived(Arrival {
                    parcel,
                    from,
                    ticket,
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
        endpoint.exchange.0.lock().remove(&endpoint.location);
        let broken = || WayError::new(WayFault::Broken, "closed");
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
struct Plain {
    exchange: Arc<Exchange>,
    next: AtomicU64,
}

impl Fixture for Plain {
    fn endpoint(&self) -> Arc<dyn Transport> {
        let number = self.next.fetch_add(1, Ordering::Relaxed) + 1;
        let location = Location::new(Kind::Tcp, &format!("table:{number}")).expect("an address");
        Arc::new(Local(Arc::new(Endpoint {
            exchange: Arc::clone(&self.exchange),
            location: location.with_incarnation(Incarnation::from_u64(number)),
            state: Mutex::default(),
        })))
    }

    fn nowhere(&self) -> Location {
        "tcp://table:none#00000000000000ff"
            .parse()
            .expect("a location")
    }
}

#[derive(Default)]
struct Wrapped(Plain);

impl Fixture for Wrapped {
    fn endpoint(&self) -> Arc<dyn Transport> {
        Arc::new(Faulty::new(self.0.endpoint(), 1, &[]))
    }

    fn nowhere(&self) -> Location {
        self.0.nowhere()
    }
}

mod plain {
    fipa_transport::conformance_tests!(super::Plain::default());
}

mod wrapped_without_faults {
    fipa_transport::conformance_tests!(super::Wrapped::default());
}

mod faults {
    use super::*;
    use fipa_transport::{Body, Fault, Stream};

    #[derive(Default)]
    struct Heard {
        arrived: Mutex<u64>,
        concluded: Mutex<Vec<(AttemptId, Conclusion)>>,
    }

    impl Sink for Heard {
        fn arrived(&self, _: Arrival) -> Verdict {
            *self.arrived.lock() += 1;
            Verdict::Now(Answer::Accepted)
        }

        fn arrived_unframed(&self, _: fipa_acl::Letter, _: Kind, _: fipa_transport::LegacySource) {}

        fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
            self.concluded.lock().push((attempt, conclusion));
        }
    }

    fn credit() -> Parcel {
        let nobody = Incarnation::UNKNOWN;
        Parcel {
            receiver: "x".into(),
            stream: Stream {
                sender: nobody,
                receiver: nobody,
            },
            sequence: 1,
            after: 0,
            remaining: std::time::Duration::ZERO,
            transfer: 0,
            body: Body::Credit,
        }
    }

    #[test]
    fn each_fault_does_what_it_says() {
        let fixture = Plain::default();
        let sender = Faulty::new(fixture.endpoint(), 7, &[]);
        let receiver = fixture.endpoint();
        let (at_sender, at_receiver) = (Arc::new(Heard::default()), Arc::new(Heard::default()));
        sender.listen(at_sender.clone()).unwrap();
        let to = receiver.listen(at_receiver.clone()).unwrap().remove(0);
        let attempt = |number: u64, fault| {
            sender.force(Some(fault));
            let result = sender.dispatch(AttemptId(number), &to, credit());
            while receiver.drive() || sender.drive() {}
            result
        };
        assert_eq!(
            attempt(1, Fault::Unreachable).unwrap_err().fault,
            WayFault::Unreachable
        );
        attempt(2, Fault::Lost).unwrap();
        attempt(3, Fault::Silence).unwrap();
        assert_eq!(*at_receiver.arrived.lock(), 0);
        attempt(4, Fault::AnswerLost).unwrap();
        assert_eq!(*at_receiver.arrived.lock(), 1);
        let heard = at_sender.concluded.lock();
        assert_eq!(
            heard
                .iter()
                .map(|(attempt, _)| attempt.0)
                .collect::<Vec<_>>(),
            [2, 4]
        );
        assert!(
            heard
                .iter()
                .all(|(_, end)| matches!(end, Conclusion::Unconfirmed(_)))
        );
        assert_eq!(sender.injected(), 4);
    }

    #[test]
    fn the_seed_decides() {
        let run = |seed| {
            let fixture = Plain::default();
            let sender = Faulty::new(fixture.endpoint(), seed, &[(Fault::Unreachable, 0.3)]);
            sender.listen(Arc::new(Heard::default())).unwrap();
            let receiver = fixture.endpoint();
            let to = receiver
                .listen(Arc::new(Heard::default()))
                .unwrap()
                .remove(0);
            (0..40)
                .map(|n| sender.dispatch(AttemptId(n), &to, credit()).is_ok())
                .collect::<Vec<_>>()
        };
        assert_eq!(run(3), run(3));
        assert_ne!(run(3), run(4));
    }
}
