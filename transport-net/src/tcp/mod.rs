//! Letters over TCP: framed and acknowledged, or unframed for legacy peers.
//!
//! Frames and framed connections are in [`crate::stream`].
//!
//! * [`dial`] and [`accept`] open connections.
//! * [`accept_queue`]: the order in which accepted connections are read.
//! * [`unframed`]: letters from legacy peers, on the same port.
//! * [`legacy_sender`]: letters to legacy peers, in their [dialect](crate::legacy::dialect).
//! * [`legacy`]: the state of both, which an [`endpoint`] holds beside its framed connections.

mod accept;
mod accept_queue;
mod config;
mod dial;
mod endpoint;
mod legacy;
mod legacy_sender;
mod unframed;

use std::sync::Arc;

use fipa_transport::{
    Abandoned, Answer, AttemptId, Kind, ListenError, Location, Parcel, Signature, Sink, Ticket,
    Transport, TransportError,
};
use tokio::runtime::Handle;

pub use self::config::TcpConfig;
use self::endpoint::TcpEndpoint;
use self::legacy_sender::TcpSender;
use crate::end::ConnectionEnd;
use crate::legacy::queues::SenderContext;
use crate::sockets;
use crate::stream::config::StreamConfig;
use crate::stream::counters::Counters;
use crate::stream::endpoint::Endpoint;

/// Carries parcels over TCP.
///
/// The first parcel to a location opens a connection. That connection then carries all parcels to
/// and from the peer, whichever side opened it, until it reaches its idle timeout. Letters are
/// written from the memory that holds them, and read into one allocation each; large content is
/// read into memory of [the sink](Sink::memory_for), if it offers some.
///
/// To a location with the [signature](Signature) of a legacy peer, each letter is sent over a
/// connection of its own, in the dialect of that peer, and is concluded as
/// [handed](fipa_transport::Conclusion::Handed).
///
/// An address is a numeric `address:port`, with a scope where one is needed
/// (`[fe80::1%eth0]:7788`), or `name:port`.
///
/// Dropping it closes it. After [`close`](Transport::close) the threads of the runtime conclude the
/// attempts, so the runtime must run a moment longer.
#[derive(Debug)]
pub struct TcpTransport {
    listen: Vec<String>,
    endpoint: Arc<TcpEndpoint>,
}

impl TcpTransport {
    /// Creates an endpoint that runs its tasks on `runtime`, which must have I/O and time enabled.
    /// No socket is opened before `listen`.
    #[must_use]
    pub fn new(config: TcpConfig, runtime: Handle) -> Self {
        let TcpConfig {
            listen,
            identity,
            limits,
            processes,
            refusals,
            refused_dials,
            #[cfg(feature = "secure")]
            security,
        } = config;
        let config = StreamConfig {
            identity,
            limits,
            refused_dials,
            processes,
            refusals,
            #[cfg(feature = "secure")]
            security,
        };
        Self {
            listen,
            endpoint: TcpEndpoint::new(Endpoint::new(Kind::Tcp, config, runtime)),
        }
    }

    /// Returns the counters of this endpoint.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.endpoint.tally().read()
    }

    /// Queues a letter for a legacy peer.
    fn post_legacy(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        let Some(sink) = self.endpoint.sink() else {
            return Err(ConnectionEnd::Closed.after());
        };
        let endpoint = &self.endpoint;
        let context = SenderContext {
            limits: endpoint.limits(),
            runtime: &endpoint.runtime,
            sink,
        };
        let sender = || TcpSender {
            endpoint: endpoint.clone(),
            to: to.clone(),
        };
        let senders = &endpoint.legacy.senders;
        senders.send(context, attempt, to, parcel, sender)
    }
}

impl Transport for TcpTransport {
    fn kind(&self) -> Kind {
        Kind::Tcp
    }

    fn max_letter(&self) -> usize {
        self.endpoint.limits().max_letter
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let runtime = &self.endpoint.runtime;
        self.endpoint
            .listen(sink, &self.listen, sockets::listen, |socket| {
                runtime.spawn(accept::accept(self.endpoint.clone(), socket))
            })
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        self.endpoint.check(to, &parcel)?;
        if to.signature() != Signature::Frames {
            return self.post_legacy(attempt, to, parcel);
        }
        self.endpoint.post(attempt, to, &parcel, |link, sink| {
            let dialing = dial::dial(self.endpoint.clone(), link, sink, to.clone());
            self.endpoint.runtime.spawn(dialing)
        })
    }

    fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        self.endpoint.abandon(attempt, to)
    }

    fn location_vacated(&self, location: &Location) {
        self.endpoint.service_left(location);
    }

    fn answer(&self, ticket: Ticket, answer: Answer) {
        self.endpoint.answer(ticket, &answer);
    }

    fn close(&self) {
        self.endpoint.close();
    }
}

impl Drop for TcpTransport {
    fn drop(&mut self) {
        self.close();
    }
}
