//! Framed, acknowledged letters over a stream of bytes: what TCP, QUIC and Unix domain sockets
//! share.
//!
//! * [`frame`]: the bytes; [`place`]: memory for what arrives, from where it is passed on.
//! * [`connection`] with its [`outbox`]: the protocol of one connection, without socket or clock.
//! * [`link`]: a connection with its socket, which is a [`wire`]; [`source`] is where its peer is
//!   and [`proof`] what that peer has proved.
//! * [`endpoint`]: what the connections share; [`config`] and [`counters`].
//!
//! What must not live here: how a connection is opened or accepted. That is what the transports
//! differ in.

pub(crate) mod config;
mod connection;
pub(crate) mod counters;
pub(crate) mod endpoint;
pub(crate) mod frame;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
pub(crate) mod link;
mod outbox;
pub(crate) mod place;
pub(crate) mod proof;
pub(crate) mod source;
pub(crate) mod wire;
