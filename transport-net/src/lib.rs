//! Letters over sockets.
//!
//! * [`UnixTransport`] carries parcels in frames over Unix domain sockets, between the processes of
//!   one domain on one host.
//! * `TcpTransport` (feature `ip`) carries them in the same frames over one persistent connection
//!   per peer, and accepts the unframed letters of legacy peers on the same port.
//! * `HttpTransport` (feature `http`) exchanges letters with platforms that use FIPA's transport over
//!   HTTP, such as JADE.
//! * `UdpTransport` (feature `ip`) carries parcels over UDP, one acknowledged datagram each.
//! * `UdtTransport` (feature `udt`) exchanges letters with legacy peers over UDT.
//! * `QuicTransport` (feature `quic`) carries parcels in the same frames over QUIC, each in a
//!   stream of its own.
//!
//! Each has a module tree of its own. They share frames and connections (`stream`), the
//! introduction of endpoints ([`Identity`], `hello`), addresses as text (`address`), the encoding
//! of answers (`answer`), sockets and tasks over UDP (`datagrams`), the letters of legacy peers
//! (`legacy`), rate limits (`rate_limit`), the list of refused connections (`refusals`) and the reasons for which connections end
//! (`end`). `stream` depends on none of the transports.
//!
//! Routes, retries, order across transports and directories do not belong here: a transport tries
//! once and reports the result.

#[cfg(feature = "ip")]
mod address;
mod answer;
#[cfg(feature = "ip")]
mod datagrams;
mod end;
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub mod fuzzing;
mod hello;
mod identity;
#[cfg(feature = "ip")]
mod interfaces;
#[cfg(feature = "ip")]
mod legacy;
#[cfg(feature = "quic")]
mod quic;
#[cfg_attr(
    not(any(feature = "ip", test)),
    expect(dead_code, reason = "the processes of this host may send any number")
)]
mod rate_limit;
#[cfg(feature = "ip")]
mod refusals;
mod refused_dials;
#[cfg(feature = "secure")]
pub mod secure;
#[cfg(feature = "ip")]
mod sockets;
mod stream;
#[cfg(feature = "ip")]
mod tcp;
#[cfg(feature = "ip")]
mod udp;
mod unix;

#[cfg(feature = "ip")]
pub use address::{AddressError, look_up, reachable_at, resolve};
pub use identity::Identity;
#[cfg(feature = "http")]
pub use legacy::http::{HttpConfig, HttpTransport};
#[cfg(feature = "udt")]
pub use legacy::udt::{UdtConfig, UdtCounters, UdtLimits, UdtTransport};
#[cfg(feature = "quic")]
pub use quic::{QuicConfig, QuicTransport};
#[cfg(feature = "ip")]
pub use refusals::{Refusal, Refusals};
pub use refused_dials::{RefusedDial, RefusedDials};
pub use stream::config::NetLimits;
pub use stream::counters::Counters;
#[cfg(feature = "ip")]
pub use tcp::{TcpConfig, TcpTransport};
#[cfg(feature = "ip")]
pub use udp::{UdpConfig, UdpCounters, UdpLimits, UdpTransport};
pub use unix::{UnixConfig, UnixError, UnixTransport};
