//! The wires of a link: a socket, TLS over a socket, or the streams of a multiplexed connection.
//!
//! Frames do not depend on the wire. Bytes handed to TLS count as begun, like bytes handed to the
//! kernel: they may arrive.

use std::io::{self, IoSlice, Write as _};
#[cfg(feature = "ip")]
use std::net::IpAddr;
use std::net::Shutdown;
use std::os::unix::net::UnixStream as StdUnixStream;
#[cfg(feature = "quic")]
use std::pin::Pin;
use std::sync::Arc;

use parking_lot::Mutex;
use tokio::io::{AsyncRead, AsyncReadExt};
#[cfg(feature = "ip")]
use tokio::net::TcpStream;
use tokio::net::UnixStream;
#[cfg(feature = "ip")]
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::net::unix::pipe;

use super::budget::ReservedBytes;
use super::frame::{FrameReader, Space};
#[cfg(feature = "secure")]
use super::tls::{Incoming, Session};

/// The reading half of a wire.
pub(crate) enum Reading {
    Unix(pipe::Receiver),
    #[cfg(feature = "ip")]
    Plain(OwnedReadHalf),
    #[cfg(feature = "secure")]
    Tls(OwnedReadHalf, Incoming),
    /// The stream of all frames except parcels, which have streams of their own.
    #[cfg(feature = "quic")]
    Streams(Box<dyn ControlStream>, Option<Box<dyn ParcelStreams>>),
}

/// The writing half of a wire.
#[derive(Debug)]
pub(crate) enum Writing {
    Unix(UnixWriter),
    #[cfg(feature = "ip")]
    Plain(OwnedWriteHalf),
    #[cfg(feature = "secure")]
    Tls(OwnedWriteHalf, Arc<Session>),
    #[cfg(feature = "quic")]
    Streams(Box<dyn StreamWriter>),
}

/// A future of a wire whose type is not known here.
#[cfg(feature = "quic")]
pub(crate) type BoxFuture<'a, T> = Pin<Box<dyn Future<Output = T> + Send + 'a>>;

/// The reading half of a wire that carries each parcel on a stream of its own: the stream of all
/// other frames. A future that is dropped loses no bytes.
#[cfg(feature = "quic")]
pub(crate) trait ControlStream: Send {
    /// Reads the available bytes into `space`; 0 at the end of the stream.
    fn read<'a>(&'a mut self, space: &'a mut Space<'_>) -> BoxFuture<'a, io::Result<usize>>;

    /// Number of bytes by which [`widen`](Self::widen) increases the receive window.
    fn extra_window(&self) -> usize;

    /// Increases the receive window from its minimum to its usual size.
    fn widen(&self);

    /// Waits until the peer has closed the connection.
    fn drain(&mut self) -> BoxFuture<'_, ()>;
}

/// The streams that carry one parcel each. A future that is dropped loses no bytes.
#[cfg(feature = "quic")]
pub(crate) trait ParcelStreams: Send {
    /// Reads the available bytes of the current stream.
    fn read(&mut self) -> BoxFuture<'_, io::Result<usize>>;

    /// The reader that receives these bytes.
    fn reader(&mut self) -> &mut FrameReader;
}

/// The writing half of such a wire.
#[cfg(feature = "quic")]
pub(crate) trait StreamWriter: std::fmt::Debug + Send + Sync {
    /// The local address that the connection is bound to, if it is bound to one.
    fn local_ip(&self) -> Option<IpAddr>;

    /// Writes as many bytes as there is room for.
    fn write(&self, slices: &[IoSlice<'_>]) -> io::Result<usize>;

    /// Waits until there is room again.
    fn writable(&self) -> BoxFuture<'_, io::Result<()>>;
}

/// Splits a Unix domain socket into its halves.
///
/// The kernel reports a Unix socket as writable whenever the peer has read something. A socket that is
/// registered for that, as tokio's are, wakes this process for each of its letters. Therefore the
/// reading half is registered for reading only, as tokio's end of a pipe: tokio reads from any kind of
/// descriptor that way.
///
/// # Errors
/// Fails without a free descriptor.
pub(crate) fn unix(stream: UnixStream) -> io::Result<(Reading, Writing)> {
    let socket = stream.into_std()?;
    let read = pipe::Receiver::from_owned_fd_unchecked(socket.try_clone()?.into())?;
    let writer = UnixWriter {
        socket,
        room: Mutex::default(),
    };
    Ok((Reading::Unix(read), Writing::Unix(writer)))
}

/// The writing half of a Unix domain socket. Dropping it closes this direction.
#[derive(Debug)]
pub(crate) struct UnixWriter {
    socket: StdUnixStream,
    /// Waits until the socket takes more bytes; exists only while it takes none.
    room: Mutex<Option<Arc<pipe::Sender>>>,
}

impl UnixWriter {
    fn try_write(&self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        match &*self.room.lock() {
            Some(room) => room.try_write_vectored(slices),
            None => (&self.socket).write_vectored(slices),
        }
    }

    /// Ends the wait for room after all bytes were written.
    fn finish(&self) {
        *self.room.lock() = None;
    }

    async fn writable(&self) -> io::Result<()> {
        let room = {
            let mut room = self.room.lock();
            match &*room {
                Some(room) => Arc::clone(room),
                None => {
                    let socket = self.socket.try_clone()?.into();
                    let sender = pipe::Sender::from_owned_fd_unchecked(socket)?;
                    Arc::clone(room.insert(Arc::new(sender)))
                }
            }
        };
        room.writable().await
    }
}

impl Drop for UnixWriter {
    fn drop(&mut self) {
        // Fails if the peer has closed the connection.
        let _ = self.socket.shutdown(Shutdown::Write);
    }
}

/// Splits a TCP socket without TLS into its halves.
#[cfg(feature = "ip")]
pub(crate) fn plain(stream: TcpStream) -> (Reading, Writing) {
    let (read, write) = stream.into_split();
    (Reading::Plain(read), Writing::Plain(write))
}

/// The streams of parcels of a link whose wire has them; otherwise empty.
#[derive(Default)]
pub(crate) struct ExtraStreams {
    #[cfg(feature = "quic")]
    letters: Option<Box<dyn ParcelStreams>>,
}

impl ExtraStreams {
    /// Reads the available bytes. Never completes without such streams. A future that is dropped
    /// loses no bytes.
    pub(crate) async fn read(&mut self) -> io::Result<usize> {
        #[cfg(feature = "quic")]
        if let Some(letters) = &mut self.letters {
            return letters.read().await;
        }
        std::future::pending().await
    }

    /// Returns the reader that received the bytes.
    pub(crate) fn reader(&mut self) -> Option<&mut FrameReader> {
        #[cfg(feature = "quic")]
        if let Some(letters) = &mut self.letters {
            return Some(letters.reader());
        }
        None
    }

    /// Whether the current letter waits for memory.
    pub(crate) fn is_blocked(&mut self) -> bool {
        self.reader().is_some_and(|reader| reader.is_blocked())
    }
}

impl Reading {
    /// Takes the streams of parcels out of the wire.
    pub(crate) fn take_extra_streams(&mut self) -> ExtraStreams {
        match self {
            #[cfg(feature = "quic")]
            Self::Streams(_, letters) => ExtraStreams {
                letters: letters.take(),
            },
            _ => ExtraStreams::default(),
        }
    }

    /// Increases the receive window from its minimum to its usual size if `take` reserves the
    /// additional bytes. The caller keeps the reservation as long as the connection. Only wires
    /// with streams of their own for parcels buffer that much.
    pub(crate) fn widen(
        &self,
        take: impl FnOnce(usize) -> Option<ReservedBytes>,
    ) -> Option<ReservedBytes> {
        match self {
            #[cfg(feature = "quic")]
            Self::Streams(control, _) => {
                let room = take(control.extra_window())?;
                control.widen();
                Some(room)
            }
            _ => {
                let _unbuffered = take;
                None
            }
        }
    }

    /// Reads the available bytes into `space`. A future that is dropped loses no bytes.
    pub(crate) async fn read(&mut self, space: &mut Space<'_>) -> io::Result<usize> {
        match self {
            Self::Unix(socket) => read(socket, space).await,
            #[cfg(feature = "ip")]
            Self::Plain(socket) => read(socket, space).await,
            #[cfg(feature = "secure")]
            Self::Tls(socket, incoming) => incoming.read(socket, space).await,
            #[cfg(feature = "quic")]
            Self::Streams(control, _) => control.read(space).await,
        }
    }

    /// Waits until the peer has closed its direction or has sent `most` bytes, and discards the bytes that arrive
    /// until then.
    pub(crate) async fn drain(&mut self, most: usize) {
        match self {
            Self::Unix(socket) => drain(socket, most).await,
            #[cfg(feature = "ip")]
            Self::Plain(socket) => drain(socket, most).await,
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => drain(socket, most).await,
            // The receive window bounds the bytes.
            #[cfg(feature = "quic")]
            Self::Streams(control, _) => control.drain().await,
        }
    }
}

async fn read(socket: &mut (impl AsyncRead + Unpin), space: &mut Space<'_>) -> io::Result<usize> {
    match space {
        Space::Buffer(buffer) => socket.read_buf(buffer).await,
        Space::Content(content) => socket.read(content).await,
    }
}

async fn drain(socket: &mut (impl AsyncRead + Unpin), most: usize) {
    let mut ignored = [0; 4096];
    let mut remaining = most;
    while remaining > 0 {
        match socket.read(&mut ignored).await {
            Ok(len @ 1..) => remaining = remaining.saturating_sub(len),
            _ => return,
        }
    }
}

impl Writing {
    /// Returns the local address that the connection is bound to. `None` when the connection has no
    /// address or survives a change of address.
    #[cfg(feature = "ip")]
    pub(crate) fn local_ip(&self) -> Option<IpAddr> {
        match self {
            Self::Unix(_) => None,
            Self::Plain(socket) => Some(socket.local_addr().ok()?.ip()),
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => Some(socket.local_addr().ok()?.ip()),
            #[cfg(feature = "quic")]
            Self::Streams(outgoing) => outgoing.local_ip(),
        }
    }

    /// Whether the wire may lead to another host.
    pub(crate) fn leads_out(&self) -> bool {
        !matches!(self, Self::Unix(_))
    }

    /// Makes closing the socket reset the connection: the kernel discards unacknowledged bytes and
    /// notifies the peer.
    pub(crate) fn discard(&self) {
        #[cfg(feature = "ip")]
        let socket = match self {
            Self::Plain(socket) => socket,
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => socket,
            _ => return,
        };
        // On failure, the peer only notices later.
        #[cfg(feature = "ip")]
        let _ = socket2::SockRef::from(socket.as_ref()).set_linger(Some(std::time::Duration::ZERO));
    }

    /// Writes as many bytes as the wire takes without waiting.
    pub(crate) fn try_write(&self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        match self {
            Self::Unix(socket) => socket.try_write(slices),
            #[cfg(feature = "ip")]
            Self::Plain(socket) => socket.try_write_vectored(slices),
            #[cfg(feature = "secure")]
            Self::Tls(socket, session) => session.write(socket, slices),
            #[cfg(feature = "quic")]
            Self::Streams(outgoing) => outgoing.write(slices),
        }
    }

    /// Hands all accepted bytes to the kernel. Fails with `WouldBlock` if the kernel does not take
    /// them now.
    pub(crate) fn try_finish(&self) -> io::Result<()> {
        match self {
            Self::Unix(socket) => {
                socket.finish();
                Ok(())
            }
            #[cfg(feature = "ip")]
            Self::Plain(_) => Ok(()),
            #[cfg(feature = "secure")]
            Self::Tls(socket, session) => session.push(socket),
            #[cfg(feature = "quic")]
            Self::Streams(_) => Ok(()),
        }
    }

    /// Waits until the wire takes more bytes.
    pub(crate) async fn writable(&self) -> io::Result<()> {
        match self {
            Self::Unix(socket) => socket.writable().await,
            #[cfg(feature = "ip")]
            Self::Plain(socket) => socket.writable().await,
            #[cfg(feature = "secure")]
            Self::Tls(socket, _) => socket.writable().await,
            #[cfg(feature = "quic")]
            Self::Streams(outgoing) => outgoing.writable().await,
        }
    }
}
