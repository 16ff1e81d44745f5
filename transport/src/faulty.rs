//! A transport decorator that injects faults.

use std::collections::HashMap;
use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use bytes::Bytes;
use fipa_acl::Letter;
use parking_lot::Mutex;

use crate::transport::LoanedContent;
use crate::{
    Abandoned, Answer, Arrival, Arriving, AttemptId, Conclusion, Introduction, Kind, LegacySource,
    ListenError, Location, Parcel, Reaction, Sink, Ticket, Transport, TransportError,
    TransportErrorKind,
};

/// A kind of fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Fault {
    /// `post` fails at once; nothing is sent.
    Unreachable,
    /// The parcel is lost; the attempt concludes as unconfirmed.
    Lost,
    /// The parcel arrives, but its answer is lost; the attempt concludes as unconfirmed.
    AnswerLost,
    /// The parcel is lost, and the attempt has no conclusion.
    Silence,
}

/// Wraps a transport and makes some of its attempts fail, to test the layers above it.
///
/// Faults are drawn from a seed, so that a run can be repeated, or forced with
/// [`force`](Self::force). [`Fault::Silence`] breaks the rule of one conclusion on purpose: the
/// delivery core must have its own timeout.
pub struct Faulty {
    inner: Arc<dyn Transport>,
    shared: Arc<Shared>,
}

struct Shared {
    plan: Mutex<Plan>,
    /// Attempts whose actual conclusion is replaced.
    pending: Mutex<HashMap<AttemptId, Fault>>,
    /// Conclusions of attempts that did not reach the inner transport.
    substituted: Mutex<Vec<(AttemptId, Conclusion)>>,
    sink: Mutex<Option<Arc<dyn Sink>>>,
    injected: AtomicU64,
}

struct Plan {
    random: fastrand::Rng,
    rates: Vec<(Fault, f64)>,
    forced: Option<Fault>,
}

impl fmt::Debug for Faulty {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Faulty")
            .field("kind", &self.inner.kind())
            .finish_non_exhaustive()
    }
}

impl Faulty {
    /// Wraps `inner`. Each `post` gets one of the faults with its rate (0 to 1), drawn from
    /// `seed`.
    pub fn new(inner: Arc<dyn Transport>, seed: u64, rates: &[(Fault, f64)]) -> Self {
        let random = fastrand::Rng::with_seed(seed);
        Self {
            inner,
            shared: Arc::new(Shared {
                plan: Mutex::new(Plan {
                    random,
                    rates: rates.to_vec(),
                    forced: None,
                }),
                pending: Mutex::default(),
                substituted: Mutex::default(),
                sink: Mutex::default(),
                injected: AtomicU64::new(0),
            }),
        }
    }

    /// Forces this fault for every `post` from now on; `None` returns to drawn faults.
    pub fn force(&self, fault: Option<Fault>) {
        self.shared.plan.lock().forced = fault;
    }

    /// Number of injected faults so far.
    #[must_use]
    pub fn injected(&self) -> u64 {
        self.shared.injected.load(Ordering::Relaxed)
    }

    fn draw(&self) -> Option<Fault> {
        let mut plan = self.shared.plan.lock();
        if plan.forced.is_some() {
            return plan.forced;
        }
        let mut remaining = plan.random.f64();
        for (fault, rate) in plan.rates.clone() {
            if remaining < rate {
                return Some(fault);
            }
            remaining -= rate;
        }
        None
    }
}

fn lost() -> Conclusion {
    Conclusion::Unconfirmed(TransportError::new(
        TransportErrorKind::Broken,
        "injected fault",
    ))
}

impl Transport for Faulty {
    fn kind(&self) -> Kind {
        self.inner.kind()
    }

    fn max_letter(&self) -> usize {
        self.inner.max_letter()
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        *self.shared.sink.lock() = Some(Arc::clone(&sink));
        self.inner.listen(Arc::new(Filter {
            sink,
            shared: Arc::clone(&self.shared),
        }))
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        let fault = self.draw();
        if fault.is_some() {
            self.shared.injected.fetch_add(1, Ordering::Relaxed);
        }
        match fault {
            Some(Fault::Unreachable) => Err(TransportError::new(
                TransportErrorKind::Unreachable,
                "injected fault",
            )),
            Some(Fault::Lost) => {
                self.shared.substituted.lock().push((attempt, lost()));
                Ok(())
            }
            Some(Fault::Silence) => Ok(()),
            Some(Fault::AnswerLost) => {
                self.shared
                    .pending
                    .lock()
                    .insert(attempt, Fault::AnswerLost);
                let sent = self.inner.post(attempt, to, parcel);
                if sent.is_err() {
                    self.shared.pending.lock().remove(&attempt);
                }
                sent
            }
            None => self.inner.post(attempt, to, parcel),
        }
    }

    fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        self.shared.pending.lock().remove(&attempt);
        self.shared
            .substituted
            .lock()
            .retain(|(other, _)| *other != attempt);
        self.inner.abandon(attempt, to)
    }

    fn location_vacated(&self, location: &Location) {
        self.inner.location_vacated(location);
    }

    fn answer(&self, ticket: Ticket, answer: Answer) {
        self.inner.answer(ticket, answer);
    }

    fn drive(&self) -> bool {
        let substituted = std::mem::take(&mut *self.shared.substituted.lock());
        let sink = self.shared.sink.lock().clone();
        let mut did_something = false;
        if let Some(sink) = sink {
            for (attempt, conclusion) in substituted {
                did_something = true;
                sink.concluded(attempt, conclusion);
            }
        }
        self.inner.drive() || did_something
    }

    fn loan(
        &self,
        to: &Location,
        head_room: usize,
        len: usize,
        tail_room: usize,
    ) -> Result<Option<Box<dyn LoanedContent>>, TransportError> {
        self.inner.loan(to, head_room, len, tail_room)
    }

    fn loan_for_many(&self, len: usize) -> Result<Option<Box<dyn LoanedContent>>, TransportError> {
        self.inner.loan_for_many(len)
    }

    fn copies_for_each(&self, content: &Bytes) -> bool {
        self.inner.copies_for_each(content)
    }

    fn close(&self) {
        self.inner.close();
        self.drive();
    }
}

/// The sink of the inner transport.
struct Filter {
    sink: Arc<dyn Sink>,
    shared: Arc<Shared>,
}

impl Sink for Filter {
    fn arrived(&self, arrival: Arrival) -> Reaction {
        self.sink.arrived(arrival)
    }

    fn arrived_unframed(&self, letter: Letter, via: Kind, from: LegacySource) {
        self.sink.arrived_unframed(letter, via, from);
    }

    fn refused_unframed(&self, letter: Letter, via: Kind, from: LegacySource, reason: &str) {
        self.sink.refused_unframed(letter, via, from, reason);
    }

    fn concluded(&self, attempt: AttemptId, conclusion: Conclusion) {
        let fault = self.shared.pending.lock().remove(&attempt);
        let conclusion = if fault.is_some() { lost() } else { conclusion };
        self.sink.concluded(attempt, conclusion);
    }

    fn memory_for(&self, arriving: &Arriving<'_>) -> Option<Box<dyn LoanedContent>> {
        self.sink.memory_for(arriving)
    }

    fn also_at(&self, location: &Location) -> Vec<Location> {
        self.sink.also_at(location)
    }

    fn relocated(&self, locations: Vec<Location>) {
        self.sink.relocated(locations);
    }

    fn accepts(&self, peer: &Introduction) -> bool {
        self.sink.accepts(peer)
    }

    fn introduced(&self, peer: &Introduction) {
        self.sink.introduced(peer);
    }

    fn disconnected(&self, peer: &Introduction) {
        self.sink.disconnected(peer);
    }
}
