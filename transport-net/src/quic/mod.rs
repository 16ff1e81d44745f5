//! Letters over QUIC (RFC 9000), each in a stream of its own.
//!
//! Frames, hello, limits and the states of parcels are those of [`crate::stream`], trust is that of
//! TCP with TLS ([`crate::secure`]). This module contains the differences: sockets, the opening of
//! connections, and the assignment of frames to streams.
//!
//! * [`streams`]: the streams of one connection.
//! * [`sockets`]: the sockets of an endpoint, and the handshake.
//! * `settings`: transport parameters.
//! * [`dial`] and [`accept`] open connections.
//!
//! A connection survives a change of address of the dialing side: peers identify it by its number,
//! and follow it once the new address has been validated (RFC 9000 section 9). When the accepting
//! side moves, it falls silent and is dialed again. Datagrams are not used, nor is early data,
//! which could be replayed.

mod accept;
mod dial;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod settings;
mod sockets;
mod streams;

use std::sync::Arc;

use fipa_transport::{
    Abandoned, Answer, AttemptId, Kind, ListenError, Location, Parcel, Sink, Ticket, Transport,
    TransportError,
};
use tokio::runtime::Handle;

use self::sockets::Sockets;
use crate::secure::Security;
use crate::stream::config::StreamConfig;
use crate::stream::endpoint::Endpoint;
use crate::{Counters, Identity, NetLimits, Refusals, RefusedDials};

/// Configuration of a [`QuicTransport`].
#[derive(Debug, Clone)]
pub struct QuicConfig {
    /// Numeric addresses to listen on, as for [`TcpConfig::listen`](crate::TcpConfig::listen).
    pub listen: Vec<String>,
    /// Identity of this endpoint.
    pub identity: Identity,
    /// NetLimits and timeouts. In addition, a connection holds at most 33 MiB of unread and 8 MiB of
    /// unacknowledged bytes.
    pub limits: NetLimits,
    /// Receives the connections of this side that peers refuse.
    pub refused_dials: RefusedDials,
    /// Credentials and trust. QUIC always requires them; the exceptions of its rules do not apply
    /// here.
    pub security: Security,
    /// Receives the connections that are refused because of certificates or of another version of the protocol.
    pub refusals: Refusals,
}

/// Carries parcels over QUIC, between services that have proved their identity to each other.
///
/// Addresses have the form that they have for [`TcpTransport`](crate::TcpTransport); connections
/// are kept, shared and closed in the same way.
///
/// Dropping it closes it. After [`close`](Transport::close) the threads of the runtime conclude the
/// attempts, so the runtime must run a moment longer.
#[derive(Debug)]
pub struct QuicTransport {
    listen: Vec<String>,
    endpoint: Arc<Endpoint>,
    sockets: Arc<Sockets>,
}

impl QuicTransport {
    /// Creates an endpoint that runs its tasks on `runtime`, which must have I/O and time enabled.
    /// No socket is opened before `listen`.
    #[must_use]
    pub fn new(config: QuicConfig, runtime: Handle) -> Self {
        let QuicConfig {
            listen,
            identity,
            limits,
            refused_dials,
            security,
            refusals,
        } = config;
        let sockets = Arc::new(Sockets::new(security.clone(), &limits));
        let config = StreamConfig {
            identity,
            limits,
            refused_dials,
            processes: false,
            refusals,
            security: Some(security),
        };
        Self {
            listen,
            endpoint: Endpoint::new(Kind::Quic, config, runtime),
            sockets,
        }
    }

    /// Returns the counters of this endpoint.
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

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let open = |address| self.sockets.listen(address);
        self.endpoint.listen(sink, &self.listen, open, |socket| {
            let accept = accept::accept(self.endpoint.clone(), self.sockets.clone(), socket);
            self.endpoint.runtime.spawn(accept)
        })
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        self.endpoint.check(to, &parcel)?;
        self.endpoint.post(attempt, to, &parcel, |link, sink| {
            let (endpoint, sockets) = (self.endpoint.clone(), self.sockets.clone());
            let dialing = dial::dial(endpoint, sockets, link, sink, to.clone());
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
        self.sockets.close();
    }
}

impl Drop for QuicTransport {
    fn drop(&mut self) {
        self.close();
    }
}
