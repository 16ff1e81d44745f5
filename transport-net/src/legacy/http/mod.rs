//! Letters over HTTP (FIPA00084), as JADE exchanges them.
//!
//! The parsers and writers do no I/O:
//!
//! * [`head`], [`request`], [`response`], [`multipart`]: HTTP and MIME.
//! * [`letter`]: the letter of a body.
//! * [`repeats`]: letters that a platform repeats on another connection.
//! * [`connections`]: the accepted connections.
//! * `socket`, `tls`, `guarded`, `proved`: the sockets of connections, TLS over them for `https`, streams that end with
//!   the trust in their peer, and what platforms have proved.
//!
//! [`server`] and [`client`] do the I/O. A platform is a legacy peer: it proves no identity and
//! confirms no delivery. [`crate::legacy`] has the parts that it shares with those over TCP.

mod client;
mod config;
mod connections;
#[cfg(feature = "fuzzing")]
pub mod fuzzing;
#[cfg(feature = "secure")]
mod guarded;
mod head;
mod letter;
mod multipart;
#[cfg(feature = "secure")]
mod proved;
mod repeats;
mod request;
mod response;
mod server;
mod socket;
#[cfg(test)]
mod tests;
#[cfg(feature = "secure")]
mod tls;
mod url;

use std::hash::Hasher;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use fipa_transport::{
    Abandoned, Answer, AttemptId, Incarnation, Kind, ListenError, Location, Parcel, Sink, Ticket,
    Transport, TransportError,
};
use memchr::memmem;
use parking_lot::Mutex;
use siphasher::sip128::{Hasher128, SipHasher24};
use tokio::runtime::Handle;

use self::client::HttpSender;
pub use self::config::HttpConfig;
use self::connections::Connections;
use self::repeats::Repeats;
use crate::end::ConnectionEnd;
use crate::legacy::queues::{LegacySenders, SenderContext};
use crate::sockets;
use crate::stream::config::StreamConfig;
use crate::stream::counters::Counters;
use crate::stream::endpoint::Endpoint;

/// Number of digits of a boundary, as in JADE.
const BOUNDARY: usize = 31;

/// Maximum number of boundaries that are tried for a letter.
const MAX_BOUNDARIES: usize = 8;

/// Exchanges letters over HTTP (FIPA00084) with platforms such as JADE.
///
/// A platform is a legacy peer: letters to it are in JADE's dialect, with an XML envelope and a
/// string message, and are concluded as [handed](fipa_transport::Conclusion::Handed) when the
/// platform answers with status 200. A later failure comes as a message. Letters from platforms may
/// have messages in every encoding.
///
/// An address is `host:port/path`. The default port is 7778, the default path `/acc`, at which this
/// endpoint is reached, too.
///
/// Dropping it closes it. After [`close`](Transport::close) the threads of the runtime conclude the
/// attempts, so the runtime must run a moment longer.
#[derive(Debug)]
pub struct HttpTransport {
    listen: Vec<String>,
    endpoint: Arc<HttpEndpoint>,
}

/// The endpoint of an [`HttpTransport`].
#[derive(Debug)]
struct HttpEndpoint {
    /// Its sink, listening addresses and limits. It has no framed connections.
    stream: Arc<Endpoint>,
    senders: LegacySenders,
    connections: Connections,
    repeats: Mutex<Repeats>,
    /// The key of digests and boundaries, which peers cannot predict.
    key: (u64, u64),
    boundaries: AtomicU64,
    /// The credentials of `https`.
    #[cfg(feature = "secure")]
    tls: Option<crate::secure::Security>,
    #[cfg(feature = "secure")]
    proved: proved::Proved,
}

impl HttpEndpoint {
    /// The kind of the locations of this endpoint.
    fn kind(&self) -> Kind {
        #[cfg(feature = "secure")]
        if self.tls.is_some() {
            return Kind::Https;
        }
        Kind::Http
    }

    /// Returns a boundary that no part contains.
    fn boundary(&self, parts: &[&[u8]]) -> Option<String> {
        let mut tries = (0..MAX_BOUNDARIES).map(|_| {
            let mut hasher = SipHasher24::new_with_keys(self.key.0, self.key.1);
            hasher.write_u64(self.boundaries.fetch_add(1, Ordering::Relaxed));
            let mut text = format!("{:032x}", hasher.finish128().as_u128());
            text.truncate(BOUNDARY);
            text
        });
        tries.find(|boundary| {
            let finder = memmem::Finder::new(boundary);
            parts.iter().all(|part| finder.find(part).is_none())
        })
    }
}

impl HttpTransport {
    /// Creates an endpoint that runs its tasks on `runtime`, which must have I/O and time enabled.
    /// No socket is opened before `listen`.
    #[must_use]
    pub fn new(config: HttpConfig, runtime: Handle) -> Self {
        Self::over(
            Kind::Http,
            config,
            #[cfg(feature = "secure")]
            None,
            runtime,
        )
    }

    /// Creates an endpoint for `https`, with the credentials of this host. A platform proves its identity
    /// with a trusted certificate, or, when this endpoint dials it, with one of the
    /// [authorities](crate::secure::Security::set_authorities) for the host name in its address.
    ///
    /// A platform that dials and has no trusted certificate is subject to the rules of the configuration for
    /// peers that prove nothing.
    #[cfg(feature = "secure")]
    #[must_use]
    pub fn over_tls(
        config: HttpConfig,
        security: crate::secure::Security,
        runtime: Handle,
    ) -> Self {
        Self::over(Kind::Https, config, Some(security), runtime)
    }

    fn over(
        kind: Kind,
        config: HttpConfig,
        #[cfg(feature = "secure")] tls: Option<crate::secure::Security>,
        runtime: Handle,
    ) -> Self {
        let HttpConfig {
            listen,
            identity,
            limits,
            #[cfg(feature = "secure")]
            security,
        } = config;
        let config = StreamConfig {
            #[cfg(feature = "secure")]
            security,
            ..StreamConfig::new(identity, limits)
        };
        let endpoint = Arc::new(HttpEndpoint {
            stream: Endpoint::new(kind, config, runtime),
            senders: LegacySenders::default(),
            connections: Connections::default(),
            repeats: Mutex::default(),
            key: (
                Incarnation::random().as_u64(),
                Incarnation::random().as_u64(),
            ),
            boundaries: AtomicU64::default(),
            #[cfg(feature = "secure")]
            tls,
            #[cfg(feature = "secure")]
            proved: proved::Proved::default(),
        });
        Self { listen, endpoint }
    }

    /// Returns the counters of this endpoint.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.endpoint.stream.tally().read()
    }
}

impl Transport for HttpTransport {
    fn kind(&self) -> Kind {
        self.endpoint.kind()
    }

    fn max_letter(&self) -> usize {
        self.endpoint.stream.limits().max_letter
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let endpoint = &self.endpoint;
        endpoint
            .stream
            .listen(sink, &self.listen, sockets::listen, |socket| {
                let accepting = server::accept(endpoint.clone(), socket);
                endpoint.stream.runtime.spawn(accepting)
            })
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        let endpoint = &self.endpoint;
        endpoint.stream.check(to, &parcel)?;
        let Some(sink) = endpoint.stream.sink() else {
            return Err(ConnectionEnd::Closed.after());
        };
        let context = SenderContext {
            limits: endpoint.stream.limits(),
            runtime: &endpoint.stream.runtime,
            sink,
        };
        let sender = || HttpSender::new(endpoint.clone(), to.clone());
        endpoint.senders.send(context, attempt, to, parcel, sender)
    }

    fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        self.endpoint.senders.abandon(attempt, to)
    }

    fn answer(&self, _ticket: Ticket, _answer: Answer) {
        // No parcel arrives over HTTP, so there is no ticket.
    }

    fn close(&self) {
        self.endpoint.senders.close();
        self.endpoint.connections.close();
        self.endpoint.stream.close();
    }
}

impl Drop for HttpTransport {
    fn drop(&mut self) {
        self.close();
    }
}
