//! Framed, acknowledged letters over TCP.
//!
//! Frames, connections and what they share are in [`crate::stream`].
//!
//! * [`dial`] and [`accept`] open connections; [`tls`] is for peers that prove who they are.
//! * [`accept_queue`]: the order in which accepted connections are read.
//! * [`unframed`]: letters of old peers, on the same port.
//! * [`courier`]: letters to old peers, in their [`dialect`].
//! * [`legacy`]: what an endpoint keeps for both.

mod accept;
mod accept_queue;
mod config;
mod dial;
mod dialect;
mod endpoint;
mod legacy;
mod legacy_sender;
mod unframed;

use std::sync::Arc;

use fipa_transport::{
    Abandoned, Answer, AttemptId, Kind, ListenError, Location, Parcel, Signature, Sink, Ticket,
    Transport, WayError, WayFault,
};
use tokio::runtime::Handle;

pub use self::config::TcpConfig;
use self::endpoint::TcpEndpoint;
use crate::end::ConnectionEnd;
use crate::stream::config::StreamConfig;
use crate::stream::counters::Counters;
use crate::stream::endpoint::Endpoint;

/// Carries parcels over TCP.
///
/// The first parcel to a location opens a connection, which then carries everything to and from
/// that peer, whoever opened it, until it has been idle for some time. Letters are written from
/// the memory they lie in, and read into one piece of memory each; large content into memory of
/// [the sink's](Sink::memory_for), if it offers some.
///
/// To a location with the [signature](Signature) of an old peer, each letter goes over a connection
/// of its own, in that peer's dialect, and is concluded as [handed](fipa_transport::Conclusion::Handed).
///
/// An address is a numeric `address:port`, with a scope where one is needed
/// (`[fe80::1%eth0]:7788`), or `name:port`.
///
/// Dropping it closes it. After [`close`](Transport::close) the attempts are concluded by the
/// runtime's threads, so the runtime must live on for a moment.
#[derive(Debug)]
pub struct TcpTransport {
    listen: Vec<String>,
    endpoint: Arc<TcpEndpoint>,
}

impl TcpTransport {
    /// An endpoint that does its work on `runtime`, which must have input, output and time
    /// enabled. Nothing is opened before `listen`.
    #[must_use]
    pub fn new(config: TcpConfig, runtime: Handle) -> Self {
        let TcpConfig {
            listen,
            identity,
            limits,
            processes,
            #[cfg(feature = "secure")]
            security,
        } = config;
        let config = StreamConfig {
            identity,
            limits,
            processes,
            #[cfg(feature = "secure")]
            security,
        };
        Self {
            listen,
            endpoint: TcpEndpoint::new(Endpoint::new(Kind::Tcp, config, runtime)),
        }
    }

    /// What happened so far.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.endpoint.tally().read()
    }

    /// Hands a letter to who takes those for an old peer.
    fn hand(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError> {
        let Some(sink) = self.endpoint.sink() else {
            return Err(ConnectionEnd::Closed.after());
        };
        let senders = &self.endpoint.legacy.senders;
        if senders.take(&self.endpoint, attempt, to, parcel)? {
            let run = legacy_sender::run(self.endpoint.clone(), sink, to.clone());
            let task = self.endpoint.runtime.spawn(run);
            if task.is_finished() && senders.take_back(attempt, to) {
                let detail = "the runtime of this endpoint has been shut down";
                return Err(WayError::new(WayFault::Closed, detail));
            }
        }
        Ok(())
    }
}

impl Transport for TcpTransport {
    fn kind(&self) -> Kind {
        Kind::Tcp
    }

    fn max_letter(&self) -> usize {
        self.endpoint.limits().max_letter
    }

    fn answers_at_once(&self) -> bool {
        false
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let runtime = &self.endpoint.runtime;
        self.endpoint
            .listen(sink, &self.listen, accept::listen, |socket| {
                runtime.spawn(accept::accept(self.endpoint.clone(), socket))
            })
    }

    fn dispatch(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError> {
        self.endpoint.check(to, &parcel)?;
        if to.signature() != Signature::Frames {
            return self.hand(attempt, to, parcel);
        }
        self.endpoint.dispatch(attempt, to, &parcel, |link, sink| {
            let dialling = dial::dial(self.endpoint.clone(), link, sink, to.clone());
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
    }
}

impl Drop for TcpTransport {
    fn drop(&mut self) {
        self.close();
    }
}
