//! Acknowledged letters over UDP, one datagram each.
//!
//! * [`packet`]: the encoding.
//! * [`core`]: the protocol without sockets and clock, with the [`connection`]s in it. A connection
//!   is [`dialing`] at first; then it has [`received`], [`recovery`] and the [`mtu`] of its path.
//! * [`endpoint`]: the core as a [`Protocol`](crate::datagrams::Protocol). The tasks around it, with
//!   their sockets, are in [`crate::datagrams`], which it shares with UDT.
//!
//! A connection that does not answer is not replaced beside it, as a connection of
//! [`crate::stream`] is. TCP retransmits with growing pauses, so a stream connection delivers
//! nothing for some time after its path has healed, and its peer is given up only after
//! `keep_alive` (10 s). This protocol retransmits by itself: [`recovery`] limits the pause to
//! 300 ms, so the first packet after the path has healed arrives within that time. A path without
//! acknowledgments ends the connection after [`UdpLimits::silence`] (2 s), a peer that may have
//! moved after a quarter of it, and the next letter opens another one.

mod config;
mod connection;
mod core;
mod counters;
mod dialing;
mod endpoint;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod mtu;
mod packet;
mod received;
mod recovery;
#[cfg(test)]
mod simulation;

use std::fmt;
use std::sync::Arc;

use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Incarnation, Kind, ListenError, Location, Parcel,
    Signature, Sink, Ticket, Transport, TransportError, TransportErrorKind,
};
use tokio::runtime::Handle;

pub use self::config::{UdpConfig, UdpLimits};
pub(crate) use self::core::Core;
pub use self::counters::UdpCounters;
use self::packet::{BASE, LARGEST, PARCEL_OVERHEAD};
use crate::Identity;
use crate::datagrams::Random;
use crate::datagrams::endpoint::Endpoint;

/// Bytes reserved for the receiver's name in the largest datagram.
const NAME: usize = 255;

/// Carries parcels over UDP, each in one datagram.
///
/// The first parcel to a location opens a connection. Its handshake proves to both sides that the
/// other receives datagrams at its address, before either stores any state about the other. Lost
/// packets are retransmitted based on the measured round-trip time; parcels arrive once and in
/// order. A letter that does not fit an unfragmented datagram on the path is [too
/// large](TransportErrorKind::TooLarge).
///
/// An address is a numeric `address:port`, with a scope where one is needed
/// (`[fe80::1%eth0]:7788`), or `name:port`.
///
/// Dropping it closes it. After [`close`](Transport::close) the threads of the runtime conclude the
/// attempts, so the runtime must run a moment longer.
pub struct UdpTransport {
    identity: Identity,
    limits: UdpLimits,
    endpoint: Arc<Endpoint<Core>>,
}

impl UdpTransport {
    /// Creates an endpoint that runs its tasks on `runtime`, which must have I/O and time enabled.
    /// No socket is opened before `listen`.
    #[must_use]
    pub fn new(config: UdpConfig, runtime: Handle) -> Self {
        let UdpConfig {
            listen,
            identity,
            limits,
        } = config;
        Self {
            endpoint: Endpoint::new(listen, identity.incarnation, runtime),
            identity,
            limits,
        }
    }

    /// Returns the counters of this endpoint.
    #[must_use]
    pub fn counters(&self) -> UdpCounters {
        self.endpoint.read(Core::counters).unwrap_or_default()
    }

    fn check(&self, to: &Location, parcel: &Parcel) -> Result<(), TransportError> {
        if to.kind() != Kind::Udp || to.signature() != Signature::Frames {
            let detail = format!("{to} is not a UDP location");
            return Err(TransportError::new(TransportErrorKind::Unreachable, detail));
        }
        if let Body::Letter(letter) = &parcel.body
            && letter.len() > self.max_letter()
        {
            let (len, max) = (letter.len(), self.max_letter());
            let detail =
                format!("the letter has {len} bytes; at most {max} fit a datagram (max_datagram)");
            return Err(TransportError::new(TransportErrorKind::TooLarge, detail));
        }
        Ok(())
    }
}

impl fmt::Debug for UdpTransport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("UdpTransport").finish_non_exhaustive()
    }
}

impl Transport for UdpTransport {
    fn kind(&self) -> Kind {
        Kind::Udp
    }

    /// Returns the largest letter that fits a datagram. Paths between hosts carry less; see
    /// [`UdpLimits::max_datagram`].
    fn max_letter(&self) -> usize {
        let datagram = self.limits.max_datagram;
        datagram.clamp(BASE, LARGEST) - PARCEL_OVERHEAD - NAME
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        if let Some(fault) = self.identity.fault() {
            return Err(ListenError::Unavailable(fault));
        }
        // As unpredictable as an incarnation.
        let random: Random = Box::new(|| Incarnation::random().as_u64());
        let (identity, limits) = (self.identity.clone(), self.limits.clone());
        self.endpoint.open(sink, |listening, now| {
            Core::new(identity, limits, listening, random, now)
        })
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        self.check(to, &parcel)?;
        self.endpoint
            .post(to, |core, now| core.post(now, attempt, to, &parcel))
    }

    fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        let abandoned = self.endpoint.call(|core, _| core.abandon(attempt, to));
        abandoned.unwrap_or(Abandoned::Unconfirmed)
    }

    fn location_vacated(&self, location: &Location) {
        self.endpoint
            .call(|core, now| core.location_vacated(now, location));
    }

    fn answer(&self, ticket: Ticket, answer: Answer) {
        self.endpoint
            .call(|core, now| core.answer(now, ticket, &answer));
    }

    fn close(&self) {
        self.endpoint.close();
    }
}

impl Drop for UdpTransport {
    fn drop(&mut self) {
        self.close();
    }
}
