//! Framed, acknowledged letters over TCP.
//!
//! * [`frame`]: the bytes; [`place`]: memory for what arrives, from where it is passed on.
//! * [`connection`] with its [`outbox`]: the protocol of one connection, without socket or clock.
//! * [`link`]: a connection with its socket; [`dial`] and [`accept`] make them.
//! * [`endpoint`]: what the connections share.
//! * [`unframed`]: letters of old peers, on the same port.
//! * [`courier`]: letters to old peers, in their [`dialect`].

mod accept;
mod config;
mod connection;
mod counters;
mod courier;
mod dial;
mod dialect;
mod endpoint;
mod frame;
mod link;
mod outbox;
mod place;
mod proof;
#[cfg(feature = "secure")]
mod tls;
mod unframed;
mod wire;

use std::sync::Arc;

use fipa_transport::{
    Answer, AttemptId, Kind, ListenError, Location, Parcel, Signature, Sink, Ticket, Transport,
    WayError, WayFault,
};
use tokio::net::TcpListener;
use tokio::runtime::Handle;

pub use self::config::{Limits, TcpConfig};
use self::connection::{SendError, letter_len};
pub use self::counters::Counters;
use self::endpoint::{Endpoint, Way};
use self::link::Link;
use crate::address;
use crate::end::End;

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
    endpoint: Arc<Endpoint>,
}

impl TcpTransport {
    /// An endpoint that does its work on `runtime`, which must have input, output and time
    /// enabled. Nothing is opened before `listen`.
    #[must_use]
    pub fn new(config: TcpConfig, runtime: Handle) -> Self {
        Self {
            endpoint: Endpoint::new(config, runtime),
        }
    }

    /// What happened so far.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.endpoint.tally().read()
    }

    /// Starts the task of a connection that was made up.
    fn start(&self, link: Arc<Link>, sink: Arc<dyn Sink>, to: &Location) -> Result<(), WayError> {
        let dialling = dial::dial(self.endpoint.clone(), link.clone(), sink, to.clone());
        let task = self.endpoint.runtime.spawn(dialling);
        if task.is_finished() && !link.has_begun() {
            self.endpoint.forget(&link);
            let detail = "the runtime of this endpoint has been shut down";
            return Err(WayError::new(WayFault::Closed, detail));
        }
        Ok(())
    }

    /// Hands a letter to who takes those for an old peer.
    fn hand(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError> {
        let Some(sink) = self.endpoint.sink() else {
            return Err(End::Closed.after());
        };
        let couriers = &self.endpoint.couriers;
        if couriers.take(&self.endpoint, attempt, to, parcel)? {
            let run = courier::run(self.endpoint.clone(), sink, to.clone());
            let task = self.endpoint.runtime.spawn(run);
            if task.is_finished() && couriers.take_back(attempt, to) {
                let detail = "the runtime of this endpoint has been shut down";
                return Err(WayError::new(WayFault::Closed, detail));
            }
        }
        Ok(())
    }

    fn check(&self, to: &Location, parcel: &Parcel) -> Result<(), WayError> {
        if to.kind() != Kind::Tcp {
            let detail = format!("{to} is no TCP location");
            return Err(WayError::new(WayFault::Unreachable, detail));
        }
        if parcel.receiver.is_empty() || parcel.receiver.len() > Parcel::MAX_NAME {
            let detail = "the receiver's name is empty or too long";
            return Err(WayError::new(WayFault::Refused, detail));
        }
        let (len, max) = (letter_len(parcel), self.max_letter());
        if len > max as u64 {
            let detail = format!("{len} bytes; at most {max} are taken (max_letter)");
            return Err(WayError::new(WayFault::TooLarge, detail));
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
        if !self.endpoint.is_new() {
            return Err(ListenError::OpenedBefore);
        }
        let config = &self.endpoint.config;
        if let Some(fault) = config.identity.fault() {
            return Err(ListenError::Unavailable(fault));
        }
        let mut sockets = Vec::new();
        let mut listening = Vec::new();
        for text in &config.listen {
            let failed = |source| ListenError::Bind {
                address: text.clone(),
                source,
            };
            let socket = accept::bind(text)?;
            let bound = socket.local_addr().map_err(failed)?;
            let reachable = address::reachable(bound)
                .map_err(|error| ListenError::Unavailable(error.to_string()))?;
            listening.extend(reachable.iter().map(ToString::to_string));
            let _inside = self.endpoint.runtime.enter();
            sockets.push(TcpListener::from_std(socket).map_err(failed)?);
        }
        let locations = listening
            .iter()
            .map(|text| Location::new(Kind::Tcp, text))
            .map(|location| location.map(|it| it.with_incarnation(config.identity.incarnation)))
            .collect::<Result<_, _>>()
            .map_err(|error| ListenError::Unavailable(error.to_string()))?;
        let start = || {
            let runtime = &self.endpoint.runtime;
            sockets
                .into_iter()
                .map(|socket| runtime.spawn(accept::accept(self.endpoint.clone(), socket)))
                .map(|task| task.abort_handle())
                .collect()
        };
        if !self.endpoint.open(sink, listening, start) {
            return Err(ListenError::OpenedBefore);
        }
        Ok(locations)
    }

    fn dispatch(&self, attempt: AttemptId, to: &Location, parcel: Parcel) -> Result<(), WayError> {
        self.check(to, &parcel)?;
        if to.signature() != Signature::Frames {
            return self.hand(attempt, to, parcel);
        }
        loop {
            let (link, fresh) = match self.endpoint.way_to(to)? {
                Way::There(link) => (link, None),
                Way::ToDial(link, sink) => (link, Some(sink)),
            };
            let sent = link.send(attempt, &parcel);
            if let Some(sink) = fresh {
                self.start(link, sink, to)?;
                return sent.map_err(|error| match error {
                    SendError::Way(error) => error,
                    SendError::Ended => End::Closed.after(),
                });
            }
            match sent {
                Ok(()) => return Ok(()),
                Err(SendError::Way(error)) => return Err(error),
                // It ended in this moment: the next turn makes up another.
                Err(SendError::Ended) => self.endpoint.forget(&link),
            }
        }
    }

    fn abandon(&self, attempt: AttemptId) {
        for link in self.endpoint.links() {
            link.abandon(attempt);
        }
        self.endpoint.couriers.abandon(attempt);
    }

    fn answer(&self, ticket: Ticket, answer: Answer) {
        if let Some((link, id)) = self.endpoint.of_ticket(ticket) {
            link.answer(id, &answer);
        }
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
