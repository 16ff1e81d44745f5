//! The sockets of both sides as types of the runtime.
//!
//! They are of the type SOCK_SEQPACKET. They are connected, so each side detects the end of the other,
//! and only the sender's buffer limits the data in transit. Records keep their boundaries. tokio has
//! no type for them: its datagram socket makes the same calls, and its stream listener accepts them.

use std::io;
use std::os::fd::OwnedFd;

use tokio::net::{UnixDatagram, UnixListener, UnixStream};

/// Registers a connected socket with the runtime.
pub(crate) fn connected(socket: OwnedFd) -> io::Result<UnixDatagram> {
    UnixDatagram::from_std(socket.into())
}

/// Registers a listening socket with the runtime.
pub(crate) fn listening(socket: OwnedFd) -> io::Result<UnixListener> {
    UnixListener::from_std(socket.into())
}

/// Registers a socket that the listener accepted with the runtime.
pub(crate) fn accepted(socket: UnixStream) -> io::Result<UnixDatagram> {
    connected(socket.into_std()?.into())
}
