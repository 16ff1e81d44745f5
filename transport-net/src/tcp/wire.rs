//! What a link reads from and writes to: a socket, or TLS over one.
//!
//! Frames know nothing of it. What has been handed to TLS counts as begun, as what has been handed
//! to the kernel does: it may arrive.

use std::io::{self, IoSlice};
#[cfg(feature = "secure")]
use std::sync::Arc;

use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};

use super::frame::Space;
#[cfg(feature = "secure")]
use super::tls::{Incoming, Session};

/// The end that is read.
pub(crate) enum Reading {
    Plain(OwnedReadHalf),
    #[cfg(feature = "secure")]
    Tls(OwnedReadHalf, Incoming),
}

/// The end that is written.
#[derive(Debug)]
pub(crate) enum Writing {
    Plain(OwnedWriteHalf),
    #[cfg(feature = "secure")]
    Tls(OwnedWriteHalf, Arc<Session>),
}

/// Both ends of a socket, as it is.
pub(crate) fn plain(stream: TcpStream) -> (Reading, Writing) {
    let (read, write) = stream.into_split();
    (Reading::Plain(read), Writing::Plain(write))
}

impl Reading {
    /// Reads what is there, as far as there is space. Nothing is lost when this is dropped.
    pub(crate) async fn read(&mut self, space: &mut Space<'_>) -> io::Result<usize> {
        match self {
            Self::Plain(socket) => match space {
                Space::Buffer(buffer) => socket.read_buf(buffer).await,
                Space::Content(content) => socket.read(content).await,
            },
            #[cfg(feature = "secure")]
            Self::Tls(socket, incoming) => incoming.read(socket, space).await,
        }
    }

    /// Waits until the peer has closed its direction, whatever comes before.
    pub(crate) async fn drain(&mut self) {
        let mut ignored = [0; 4096];
        let socket = match self {
            Self::Plain(socket) => socket,
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => socket,
        };
        while matches!(socket.read(&mut ignored).await, Ok(1..)) {}
    }
}

impl Writing {
    /// Hands over what is taken at once.
    pub(crate) fn try_write(&self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        match self {
            Self::Plain(socket) => socket.try_write_vectored(slices),
            #[cfg(feature = "secure")]
            Self::Tls(socket, session) => session.write(socket, slices),
        }
    }

    /// Sees to it that the kernel has all that was taken; an error of the kind `WouldBlock` when it
    /// does not take it now.
    pub(crate) fn try_finish(&self) -> io::Result<()> {
        match self {
            Self::Plain(_) => Ok(()),
            #[cfg(feature = "secure")]
            Self::Tls(socket, session) => session.push(socket),
        }
    }

    /// Waits until the kernel takes more.
    pub(crate) async fn writable(&self) -> io::Result<()> {
        match self {
            Self::Plain(socket) => socket.writable().await,
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => socket.writable().await,
        }
    }
}
