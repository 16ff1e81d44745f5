//! Letters between hosts.
//!
//! * [`TcpTransport`] carries parcels in frames over one persistent connection per peer, and takes
//!   the unframed letters of old peers on the same port.
//! * [`UdpTransport`] carries parcels that fit one datagram, acknowledged.
//! * [`QuicTransport`] (feature `quic`) carries parcels in the same frames over QUIC, each in a
//!   stream of its own.
//!
//! Each has a module tree of its own. Beside them stands what they share: who is there
//! ([`Identity`]) and how they introduce themselves (`hello`), addresses as text (`address`), how
//! answers are written (`answer`), how much a peer may send (`ration`), and why a connection ends
//! (`end`).
//!
//! What must not live here: routes, retries, order across transports, directories. A transport
//! tries once and reports.

mod address;
mod answer;
mod end;
mod hello;
mod identity;
mod interfaces;
#[cfg(feature = "quic")]
mod quic;
mod ration;
#[cfg(feature = "secure")]
pub mod secure;
mod seldom;
mod tcp;
mod udp;

pub use address::{AddressError, reachable_at};
pub use identity::Identity;
#[cfg(feature = "quic")]
pub use quic::{QuicConfig, QuicTransport};
pub use tcp::{Counters, Limits, TcpConfig, TcpTransport};
pub use udp::{UdpConfig, UdpCounters, UdpLimits, UdpTransport};
