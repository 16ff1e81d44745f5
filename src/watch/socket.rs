//! The sockets of both sides, as the runtime knows them.
//!
//! They are of the type SOCK_SEQPACKET: connected, so that both sides learn of each other's end
//! and only the sender's own buffer bounds what it may send; and every record stays whole. The
//! runtime has no type for them. One for datagrams makes the same calls, and a listener of
//! another type accepts them.

use std::io;
use std::os::fd::OwnedFd;

use tokio::net::{UnixDatagram, UnixListener, UnixStream};

/// A connected socket.
pub(super) fn connected(socket: OwnedFd) -> io::Result<UnixDatagram> {
    UnixDatagram::from_std(socket.into())
}

/// A listening socket.
pub(super) fn listening(socket: OwnedFd) -> io::Result<UnixListener> {
    UnixListener::from_std(socket.into())
}

/// A socket that was accepted from a listening one.
pub(super) fn accepted(socket: UnixStream) -> io::Result<UnixDatagram> {
    connected(socket.into_std()?.into())
}
