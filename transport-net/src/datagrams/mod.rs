//! The parts that protocols over UDP share.
//!
//! * [`endpoint`]: the tasks around a protocol without sockets and clock ([`Protocol`]), with their
//!   [`socket`]s.
//! * [`connections`]: the connections of an endpoint, and the order in which they act.
//! * [`cookie`]: the address validation of unproved peers. [`dialing`]: the handshake of the
//!   dialing side. [`shares`]: the part of each address in the connections and the memory.
//!
//! The protocols themselves are in [`crate::udp`] and `crate::legacy::udt`.

pub(crate) mod connections;
pub(crate) mod cookie;
pub(crate) mod dialing;
pub(crate) mod endpoint;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
pub(crate) mod shares;
pub(crate) mod socket;

use std::collections::HashSet;
use std::net::{IpAddr, SocketAddr};
use std::time::Instant;

use fipa_transport::{Kind, Sink, TransportError};

/// The socket and addresses of a connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Path {
    /// The number of the socket.
    pub(crate) socket: u32,
    pub(crate) remote: SocketAddr,
    /// The local address that the peer sends to, if the socket has several.
    pub(crate) local: Option<IpAddr>,
}

/// A datagram with its destination.
pub(crate) type Outbound = (Path, Vec<u8>);

/// Datagrams to be sent.
#[derive(Debug)]
pub(crate) struct Transmit {
    /// The connection they belong to, if any.
    pub(crate) connection: Option<u32>,
    pub(crate) path: Path,
    pub(crate) contents: Vec<u8>,
    /// The size of each datagram except the last; `None` for a single datagram.
    pub(crate) segment: Option<usize>,
}

/// A source of unpredictable numbers.
pub(crate) type Random = Box<dyn FnMut() -> u64 + Send>;

/// Whether the system may fragment datagrams.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fragments {
    /// A datagram that is larger than the MTU of its path is lost or returned.
    Forbidden,
    /// The system fragments datagrams that are larger than the MTU of their path.
    Allowed,
}

/// Calls a function with a protocol, under its lock.
pub(crate) type WithProtocol<'a, P> = dyn Fn(&mut dyn FnMut(&mut P)) + 'a;

/// A protocol without sockets and clock: datagrams, calls and the time in, datagrams and events out.
///
/// A connection that this side opens is identified by a number until [`poll_gone`](Self::poll_gone)
/// returns that number.
pub(crate) trait DatagramCore: Sized + Send + 'static {
    /// An event for the sink.
    type Event: Send;

    /// Whether a new connection has yet to be opened.
    fn is_opening(&self, number: u32) -> bool;

    /// Sets the paths to the peer of a new connection.
    fn begin(&mut self, now: Instant, number: u32, paths: Vec<Path>);

    /// Handles a datagram. `listening` is whether the socket accepts datagrams of unproved peers.
    fn handle_datagram(&mut self, now: Instant, path: Path, listening: bool, bytes: &[u8]);

    /// Handles an error of the operating system on a path.
    fn handle_error(&mut self, now: Instant, number: u32, path: Path, what: &str);

    /// Returns the next datagrams to be sent.
    fn poll_transmit(&mut self, now: Instant) -> Option<Transmit>;

    /// Returns the next event.
    fn poll_event(&mut self) -> Option<Self::Event>;

    /// Whether there are events to deliver.
    fn has_events(&self) -> bool;

    /// Returns the next removed connection, so that its sockets can be closed.
    fn poll_gone(&mut self) -> Option<u32>;

    /// Returns the time at which [`handle_timeout`](Self::handle_timeout) must be called.
    fn poll_timeout(&self) -> Option<Instant>;

    /// Handles the timers that are due.
    fn handle_timeout(&mut self, now: Instant);
}

/// A core as the protocol of an [`endpoint`]: with its kind of transport, and with a sink for its events.
pub(crate) trait Protocol: DatagramCore {
    /// The kind of transport, for locations and logs.
    const KIND: Kind;

    /// Whether the system may fragment the datagrams of this protocol.
    const FRAGMENTS: Fragments;

    /// Sets the addresses at which peers reach this endpoint.
    fn listens_on(&mut self, listening: Vec<String>);

    /// Ends the connections that are bound to addresses that this host no longer has. `local`
    /// returns the address of a socket that belongs to one connection.
    fn lost(&mut self, lost: &HashSet<IpAddr>, local: impl Fn(u32) -> Option<IpAddr>);

    /// Ends a new connection that cannot be opened.
    fn cannot_begin(&mut self, number: u32, error: TransportError);

    /// Handles the failure to send the last datagram because of its size.
    fn too_big(&mut self, number: u32, size: usize);

    /// Ends every connection.
    fn close(&mut self);

    /// Delivers an event. It is called without a lock on the protocol; `with` calls a function with
    /// the protocol.
    fn deliver(event: Self::Event, sink: &dyn Sink, with: &WithProtocol<'_, Self>);
}
