//! Framed, acknowledged letters over a byte stream: the part that TCP, QUIC and Unix domain sockets
//! share.
//!
//! * [`frame`]: the encoding; [`budget`]: memory for arriving letters.
//! * [`connection`] with its [`outbox`]: the protocol of one connection, without sockets and clock.
//! * [`link`]: a connection with its socket, which is a [`wire`]; [`source`] is the origin of the
//!   connection and [`proof`] is the proved identity of its peer.
//! * [`endpoint`]: the registry of connections; [`config`] and [`counters`].
//! * `dialing`: the addresses of a location; `tls`: TLS over a socket.
//!
//! This module does not open or accept connections: the transports differ in that, and this module
//! does not depend on them.

pub(crate) mod budget;
pub(crate) mod config;
mod connection;
pub(crate) mod counters;
#[cfg(feature = "ip")]
pub(crate) mod dialing;
pub(crate) mod endpoint;
pub(crate) mod frame;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
pub(crate) mod link;
mod outbox;
pub(crate) mod proof;
pub(crate) mod source;
#[cfg(feature = "secure")]
pub(crate) mod tls;
pub(crate) mod wire;
