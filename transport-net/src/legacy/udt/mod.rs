//! Letters of legacy peers over UDT (draft-gg-udt-03), one message each, as fipa_services sends them
//! with libudt 4.11.
//!
//! * [`packet`]: the encoding. [`sequence`] and [`ranges`]: the arithmetic of sequence numbers.
//! * [`core`]: the protocol without sockets and clock, with the [`connection`]s in it. A connection
//!   has a [`sender`] with its [`rate`] control, or a [`receiver`] with its measurement of
//!   [`arrivals`].
//! * [`untranslated`]: the letters that wait for their translation into the dialect of the peer.
//! * [`endpoint`]: the core as a [`Protocol`](crate::datagrams::Protocol), and the task that translates
//!   letters. The other tasks, with their sockets, are in [`crate::datagrams`], which it shares with
//!   UDP.
//!
//! Absent are streams, the rendezvous of two clients, and messages out of order, which fipa_services
//! does not use.

mod arrivals;
mod config;
mod connection;
mod core;
mod counters;
mod endpoint;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod packet;
mod ranges;
mod rate;
mod receiver;
mod round_trip;
mod sender;
mod sequence;
#[cfg(test)]
mod simulation;
mod untranslated;

use std::sync::Arc;
use std::time::Duration;

use fipa_transport::{
    Abandoned, Answer, AttemptId, Body, Incarnation, Kind, ListenError, Location, Parcel, Sink,
    Ticket, Transport, TransportError, TransportErrorKind,
};
use tokio::runtime::Handle;

pub use self::config::{UdtConfig, UdtLimits};
use self::core::Core;
pub use self::counters::UdtCounters;
use self::endpoint::Translator;
use crate::datagrams::Random;
use crate::datagrams::endpoint::Endpoint;

/// The time after which an acknowledgment is sent at the latest, and the period of the rate control
/// (draft-gg-udt-03 section 4).
const SYN: Duration = Duration::from_millis(10);

/// Exchanges letters with legacy peers over UDT.
///
/// The first letter to a location opens a connection. That connection carries all letters to the
/// location until it has been idle for a while; letters arrive once and in order. The peer answers
/// over a connection of its own. A task translates letters into the dialect of the peer before they are
/// sent. A letter that the peer has acknowledged is concluded as
/// [handed](fipa_transport::Conclusion::Handed): it is in the receive buffer of the peer.
///
/// An address is a numeric `address:port` or `name:port`.
///
/// Dropping it closes it. After [`close`](Transport::close) the threads of the runtime conclude the
/// attempts, so the runtime must run a moment longer.
pub struct UdtTransport {
    config: UdtConfig,
    endpoint: Arc<Endpoint<Core>>,
    runtime: Handle,
}

impl std::fmt::Debug for UdtTransport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("UdtTransport").finish_non_exhaustive()
    }
}

impl UdtTransport {
    /// Creates an endpoint that runs its tasks on `runtime`, which must have I/O and time enabled.
    /// No socket is opened before `listen`.
    #[must_use]
    pub fn new(config: UdtConfig, runtime: Handle) -> Self {
        let listen = config.listen.clone();
        Self {
            endpoint: Endpoint::new(listen, config.identity.incarnation, runtime.clone()),
            config,
            runtime,
        }
    }

    /// Returns the counters of this endpoint.
    #[must_use]
    pub fn counters(&self) -> UdtCounters {
        self.endpoint.read(Core::counters).unwrap_or_default()
    }
}

impl Transport for UdtTransport {
    fn kind(&self) -> Kind {
        Kind::Udt
    }

    fn max_letter(&self) -> usize {
        self.config.limits.max_letter
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        if let Some(fault) = self.config.identity.fault() {
            return Err(ListenError::Unavailable(fault));
        }
        // As unpredictable as an incarnation.
        let random: Random = Box::new(|| Incarnation::random().as_u64());
        let (limits, access) = (self.config.limits.clone(), self.config.access());
        self.endpoint.open(sink, |_, now| {
            Core::new(limits, Box::new(access), random, now)
        })
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        if to.kind() != Kind::Udt {
            let detail = format!("{to} is not a UDT location");
            return Err(TransportError::new(TransportErrorKind::Unreachable, detail));
        }
        let Body::Letter(letter) = parcel.body else {
            let detail = "a legacy peer accepts letters only";
            return Err(TransportError::new(
                TransportErrorKind::Incompatible,
                detail,
            ));
        };
        let max = self.config.limits.max_letter;
        if letter.len() > max {
            return Err(too_large(letter.len(), max));
        }
        let starts = self
            .endpoint
            .queue(|core| core.post(attempt, to, parcel.receiver, letter))?;
        if starts {
            let translator = Translator::new(Arc::clone(&self.endpoint), max);
            self.runtime.spawn(translator.run());
        }
        Ok(())
    }

    fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        let abandoned = self.endpoint.call(|core, _| core.abandon(attempt, to));
        abandoned.unwrap_or(Abandoned::Unconfirmed)
    }

    /// Does nothing: letters of legacy peers are not answered.
    fn answer(&self, _ticket: Ticket, _answer: Answer) {}

    fn close(&self) {
        self.endpoint.close();
    }
}

impl Drop for UdtTransport {
    fn drop(&mut self) {
        self.close();
    }
}

fn too_large(len: usize, max: usize) -> TransportError {
    let detail = format!("the letter has {len} bytes; the limit is {max} (max_letter)");
    TransportError::new(TransportErrorKind::TooLarge, detail)
}
