//! Letters over QUIC (RFC 9000), each in a stream of its own.
//!
//! Frames, hello, limits and the account of parcels are those of [`crate::stream`], trust is that of
//! TCP with TLS ([`crate::secure`]); here is what differs: sockets, how connections are made, and which streams
//! frames go in.
//!
//! * [`streams`]: the streams of one connection.
//! * [`sockets`]: the sockets of an endpoint, and what is agreed upon with peers.
//! * [`dial`] and [`accept`] make connections.
//!
//! A connection outlives a change of address of the side that dialled: peers go by its number, and
//! follow it once the new address has been proved to be on its way (RFC 9000 section 9). When the
//! side that was dialled moves, it falls silent and is dialled anew. Datagrams are not used, nor is
//! early data, which could be replayed.

mod accept;
mod dial;
mod settings;
mod sockets;
mod streams;

use std::sync::Arc;

use fipa_transport::{
    Abandoned, Answer, AttemptId, Kind, ListenError, Location, Parcel, Sink, Ticket, Transport,
    WayError,
};
use tokio::runtime::Handle;

use self::sockets::Sockets;
use crate::secure::Security;
use crate::stream::config::StreamConfig;
use crate::stream::endpoint::Endpoint;
use crate::{Counters, Identity, Limits};

/// Configuration of a [`QuicTransport`].
#[derive(Debug, Clone)]
pub struct QuicConfig {
    /// Numeric addresses to listen on, as for [`TcpConfig::listen`](crate::TcpConfig::listen).
    pub listen: Vec<String>,
    /// How this endpoint introduces itself.
    pub identity: Identity,
    /// What it takes and how long it waits. Beside it a connection holds at most 33 MiB that have
    /// arrived and are not read, and 8 MiB that were sent and are not acknowledged.
    pub limits: Limits,
    /// What this host is known by, and whom it knows. QUIC is never spoken without; its rules leave
    /// nobody out here.
    pub security: Security,
}

/// Carries parcels over QUIC, between services that have proved to each other who they are.
///
/// An address is what it is for [`TcpTransport`](crate::TcpTransport); connections are kept, shared
/// and closed as there.
///
/// Dropping it closes it. After [`close`](Transport::close) the attempts are concluded by the
/// runtime's threads, so the runtime must live on for a moment.
#[derive(Debug)]
pub struct QuicTransport {
    listen: Vec<String>,
    endpoint: Arc<Endpoint>,
    sockets: Arc<Sockets>,
}

impl QuicTransport {
    /// An endpoint that does its work on `runtime`, which must have input, output and time
    /// enabled. Nothing is opened before `listen`.
    #[must_use]
    pub fn new(config: QuicConfig, runtime: Handle) -> Self {
        let QuicConfig {
            listen,
            identity,
            limits,
            security,
        } = config;
        let sockets = Arc::new(Sockets::new(security.clone(), &limits));
        let config = StreamConfig {
            identity,
            limits,
            processes: false,
            security: Some(security),
        };
        Self {
            listen,
            endpoint: Endpoint::new(Kind::Quic, config, runtime),
            sockets,
        }
    }

    /// What happened so far.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.endpoint.tally().read()
    }
}

impl Transport for QuicTransport {
    fn kind(&self) -> Kind {
        Kind::Quic
    }

    fn max_letter(&self) -> usize {
        self.endpoint.limits().max_letter
    }

    fn answers_at_once(&self) -> bool {
        false
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let open = |text: &str| self.sockets.listen(text);
        self.endpoint.listen(sink, &self.listen, open, |socket| {
            let accept = accept::accept(self.endpoint.clone(), self.sockets.clone(), socket);
            self.endpoint.runtime.spawn(accept)
        })
    }

    fn dispatch(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError> {
        self.endpoint.check(to, &parcel)?;
        self.endpoint.dispatch(attempt, to, &parcel, |link, sink| {
            let (endpoint, sockets) = (self.endpoint.clone(), self.sockets.clone());
            let dialling = dial::dial(endpoint, sockets, link, sink, to.clone());
            self.endpoint.runtime.spawn(dialling)
        })
    }

    fn abandon(&self, attempt: AttemptId) -> Abandoned {
        self.endpoint.abandon(attempt)
    }

    fn answer(&self, ticket: Ticket, answer: Answer) {
        self.endpoint.answer(ticket, &answer);
    }

    fn close(&self) {
        self.endpoint.close();
        self.sockets.close();
    }
}

impl Drop for QuicTransport {
    fn drop(&mut self) {
        self.close();
    }
}
