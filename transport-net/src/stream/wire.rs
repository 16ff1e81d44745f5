//! What a link reads from and writes to: a socket, TLS over one, or the streams of QUIC.
//!
//! Frames know nothing of it. What has been handed to TLS counts as begun, as what has been handed
//! to the kernel does: it may arrive.

use std::io::{self, IoSlice};
#[cfg(feature = "ip")]
use std::net::IpAddr;
#[cfg(feature = "secure")]
use std::sync::Arc;

use tokio::io::{AsyncRead, AsyncReadExt};
#[cfg(feature = "ip")]
use tokio::net::TcpStream;
#[cfg(feature = "ip")]
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::{UnixStream, unix};

use super::frame::{FrameReader, Space};
use super::place::Room;
#[cfg(feature = "quic")]
use crate::quic::streams as quic;
#[cfg(feature = "secure")]
use crate::tcp::tls::{Incoming, Session};

/// The end that is read.
pub(crate) enum Reading {
    Unix(unix::OwnedReadHalf),
    #[cfg(feature = "ip")]
    Plain(OwnedReadHalf),
    #[cfg(feature = "secure")]
    Tls(OwnedReadHalf, Incoming),
    /// The stream of everything but letters; those have streams of their own.
    #[cfg(feature = "quic")]
    Quic(quic::Control, Option<Box<quic::Letters>>),
}

/// The end that is written.
#[derive(Debug)]
pub(crate) enum Writing {
    Unix(unix::OwnedWriteHalf),
    #[cfg(feature = "ip")]
    Plain(OwnedWriteHalf),
    #[cfg(feature = "secure")]
    Tls(OwnedWriteHalf, Arc<Session>),
    #[cfg(feature = "quic")]
    Quic(quic::Outgoing),
}

/// Both ends of a Unix domain socket.
pub(crate) fn unix(stream: UnixStream) -> (Reading, Writing) {
    let (read, write) = stream.into_split();
    (Reading::Unix(read), Writing::Unix(write))
}

/// Both ends of a TCP socket, as it is.
#[cfg(feature = "ip")]
pub(crate) fn plain(stream: TcpStream) -> (Reading, Writing) {
    let (read, write) = stream.into_split();
    (Reading::Plain(read), Writing::Plain(write))
}

/// What arrives beside the one stream of a link: letters, where each has a stream of its own.
#[derive(Default)]
pub(crate) struct Beside {
    #[cfg(feature = "quic")]
    letters: Option<Box<quic::Letters>>,
}

impl Beside {
    /// Reads what has arrived; for ever, when there are no such streams. Nothing is lost when this
    /// is dropped.
    pub(crate) async fn read(&mut self) -> io::Result<usize> {
        #[cfg(feature = "quic")]
        if let Some(letters) = &mut self.letters {
            return letters.read().await;
        }
        std::future::pending().await
    }

    /// What was read, as frames.
    pub(crate) fn reader(&mut self) -> Option<&mut FrameReader> {
        #[cfg(feature = "quic")]
        if let Some(letters) = &mut self.letters {
            return Some(letters.reader());
        }
        None
    }

    /// Whether the letter whose turn it is waits for memory.
    pub(crate) fn is_blocked(&mut self) -> bool {
        self.reader().is_some_and(|reader| reader.is_blocked())
    }

    /// Whether a letter has begun to arrive and is not complete.
    pub(crate) fn is_partial(&mut self) -> bool {
        self.reader().is_some_and(|reader| reader.is_partial())
    }
}

impl Reading {
    /// Takes out what is to be read beside the one stream.
    pub(crate) fn take_beside(&mut self) -> Beside {
        match self {
            #[cfg(feature = "quic")]
            Self::Quic(_, letters) => Beside {
                letters: letters.take(),
            },
            _ => Beside::default(),
        }
    }

    /// Lets the peer send ahead as much as is usual, if there is room for what it may send beyond the
    /// minimum. The room is to be kept as long as the connection. Only QUIC buffers that much.
    pub(crate) fn widen(&self, take: impl FnOnce(usize) -> Option<Room>) -> Option<Room> {
        match self {
            #[cfg(feature = "quic")]
            Self::Quic(control, _) => control.widen(take),
            _ => {
                let _unbuffered = take;
                None
            }
        }
    }

    /// Reads what is there, as far as there is space. Nothing is lost when this is dropped.
    pub(crate) async fn read(&mut self, space: &mut Space<'_>) -> io::Result<usize> {
        match self {
            Self::Unix(socket) => read(socket, space).await,
            #[cfg(feature = "ip")]
            Self::Plain(socket) => read(socket, space).await,
            #[cfg(feature = "secure")]
            Self::Tls(socket, incoming) => incoming.read(socket, space).await,
            #[cfg(feature = "quic")]
            Self::Quic(control, _) => control.read(space).await,
        }
    }

    /// Waits until the peer has closed its direction, whatever comes before.
    pub(crate) async fn drain(&mut self) {
        match self {
            Self::Unix(socket) => drain(socket).await,
            #[cfg(feature = "ip")]
            Self::Plain(socket) => drain(socket).await,
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => drain(socket).await,
            #[cfg(feature = "quic")]
            Self::Quic(control, _) => control.drain().await,
        }
    }
}

async fn read(socket: &mut (impl AsyncRead + Unpin), space: &mut Space<'_>) -> io::Result<usize> {
    match space {
        Space::Buffer(buffer) => socket.read_buf(buffer).await,
        Space::Content(content) => socket.read(content).await,
    }
}

async fn drain(socket: &mut (impl AsyncRead + Unpin)) {
    let mut ignored = [0; 4096];
    while matches!(socket.read(&mut ignored).await, Ok(1..)) {}
}

impl Writing {
    /// The address of this host that the connection stays with. None when the connection can go on
    /// from another one, or has no address.
    #[cfg(feature = "ip")]
    pub(crate) fn local_ip(&self) -> Option<IpAddr> {
        match self {
            Self::Unix(_) => None,
            Self::Plain(socket) => Some(socket.local_addr().ok()?.ip()),
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => Some(socket.local_addr().ok()?.ip()),
            #[cfg(feature = "quic")]
            Self::Quic(outgoing) => outgoing.local_ip(),
        }
    }

    /// Has the kernel forget, when the socket is closed, what the peer has not acknowledged, and tell
    /// the peer that the connection is over.
    pub(crate) fn discard(&self) {
        #[cfg(feature = "ip")]
        let socket = match self {
            Self::Plain(socket) => socket,
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => socket,
            _ => return,
        };
        // Without it, the peer notices later.
        #[cfg(feature = "ip")]
        let _ = socket2::SockRef::from(socket.as_ref()).set_linger(Some(std::time::Duration::ZERO));
    }

    /// Hands over what is taken at once.
    pub(crate) fn try_write(&self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        match self {
            Self::Unix(socket) => socket.try_write_vectored(slices),
            #[cfg(feature = "ip")]
            Self::Plain(socket) => socket.try_write_vectored(slices),
            #[cfg(feature = "secure")]
            Self::Tls(socket, session) => session.write(socket, slices),
            #[cfg(feature = "quic")]
            Self::Quic(outgoing) => outgoing.write(slices),
        }
    }

    /// Sees to it that the kernel has all that was taken; an error of the kind `WouldBlock` when it
    /// does not take it now.
    pub(crate) fn try_finish(&self) -> io::Result<()> {
        match self {
            Self::Unix(_) => Ok(()),
            #[cfg(feature = "ip")]
            Self::Plain(_) => Ok(()),
            #[cfg(feature = "secure")]
            Self::Tls(socket, session) => session.push(socket),
            #[cfg(feature = "quic")]
            Self::Quic(_) => Ok(()),
        }
    }

    /// Waits until the kernel takes more.
    pub(crate) async fn writable(&self) -> io::Result<()> {
        match self {
            Self::Unix(socket) => socket.writable().await,
            #[cfg(feature = "ip")]
            Self::Plain(socket) => socket.writable().await,
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => socket.writable().await,
            #[cfg(feature = "quic")]
            Self::Quic(outgoing) => outgoing.writable().await,
        }
    }
}
