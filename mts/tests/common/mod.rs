//! Support for the tests of the core and its runtime: a letter, and a transport without peers.

#![allow(dead_code, reason = "each test file uses a part")]

use std::sync::{Arc, OnceLock};
use std::time::SystemTime;

use fipa_acl::{AgentId, Letter, Message, Performative};
use fipa_mts::letter_for;
use fipa_transport::{
    Abandoned, Answer, AttemptId, Kind, ListenError, Location, Parcel, Sink, Ticket, Transport,
    TransportError, TransportErrorKind,
};

/// A letter of `rover` to `arm`.
pub(crate) fn letter() -> Letter {
    let message = Message::builder(Performative::Inform)
        .sender(AgentId::new("rover").unwrap())
        .receiver(AgentId::new("arm").unwrap())
        .content("hello")
        .build()
        .unwrap();
    letter_for(&message, SystemTime::UNIX_EPOCH).unwrap()
}

/// A transport without peers, whose sink the test calls.
pub(crate) struct Silent {
    kind: Kind,
    sink: OnceLock<Arc<dyn Sink>>,
    /// Called by [`Transport::close`].
    closing: Box<dyn Fn() + Send + Sync>,
}

impl Silent {
    pub(crate) fn new(kind: Kind) -> Self {
        Self::closed_with(kind, || {})
    }

    /// A transport that calls this function when it is closed.
    pub(crate) fn closed_with(kind: Kind, closing: impl Fn() + Send + Sync + 'static) -> Self {
        Self {
            kind,
            sink: OnceLock::new(),
            closing: Box::new(closing),
        }
    }

    /// The sink of the service that has started with this transport.
    pub(crate) fn sink(&self) -> &dyn Sink {
        &**self.sink.get().unwrap()
    }
}

impl Transport for Silent {
    fn kind(&self) -> Kind {
        self.kind
    }

    fn max_letter(&self) -> usize {
        usize::MAX
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let _ = self.sink.set(sink);
        Ok(Vec::new())
    }

    fn post(&self, _: AttemptId, _: &Location, _: Parcel) -> Result<(), TransportError> {
        Err(TransportError::new(TransportErrorKind::Unreachable, ""))
    }

    fn abandon(&self, _: AttemptId, _: &Location) -> Abandoned {
        Abandoned::Unconfirmed
    }

    fn answer(&self, _: Ticket, _: Answer) {}

    fn close(&self) {
        (self.closing)();
    }
}
