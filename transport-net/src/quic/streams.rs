//! The streams of one connection.
//!
//! The dialing side opens one bidirectional stream for hello, answers, pings and goodbye. Every
//! parcel has a stream of its own. Parcels are read in the order in which their streams were
//! opened, because letters to one location must arrive in order. Streams that have arrived and are
//! not read yet wait in the windows of [`super::settings`]. So an answer never waits behind a
//! letter on the wire, and a lost packet only delays its own letter.

use std::future::{pending, poll_fn};
use std::io::{self, IoSlice};
use std::net::IpAddr;
use std::pin::Pin;
use std::task::{Context, Poll, Waker};

use bytes::{Bytes, BytesMut};
use parking_lot::Mutex;
use quinn::{Connection, ConnectionError, ReadError, RecvStream, SendStream, VarInt, WriteError};

use super::settings;
use super::sockets::lost;
use crate::stream::frame::{self, FrameReader, Space};
use crate::stream::wire::{BoxFuture, ControlStream, ParcelStreams, StreamWriter};

/// Priority of the control stream: answers precede letters.
const URGENT: i32 = 1;

/// The receiving side of the control stream.
pub(super) struct Control {
    connection: Connection,
    stream: RecvStream,
}

impl Control {
    pub(super) fn new(connection: &Connection, stream: RecvStream) -> Self {
        let connection = connection.clone();
        Self { connection, stream }
    }

    async fn read(&mut self, space: &mut Space<'_>) -> io::Result<usize> {
        match fill(&mut self.stream, space).await {
            Ok(Some(len)) => Ok(len),
            Ok(None) | Err(ReadError::ConnectionLost(ConnectionError::ApplicationClosed(_))) => {
                Ok(0)
            }
            Err(ReadError::ConnectionLost(error)) => Err(lost(&error)),
            Err(error) => Err(error.into()),
        }
    }
}

impl ControlStream for Control {
    fn read<'a>(&'a mut self, space: &'a mut Space<'_>) -> BoxFuture<'a, io::Result<usize>> {
        Box::pin(self.read(space))
    }

    fn extra_window(&self) -> usize {
        settings::WIDENING
    }

    fn widen(&self) {
        settings::widen(&self.connection);
    }

    fn drain(&mut self) -> BoxFuture<'_, ()> {
        Box::pin(async {
            self.connection.closed().await;
        })
    }
}

impl Drop for Control {
    fn drop(&mut self) {
        // The peer has had time to read the bytes that are still on their way.
        self.connection.close(VarInt::from_u32(0), b"");
    }
}

/// The streams that the peer opens for its parcels.
pub(super) trait PeerStreams: Send + Sync {
    type Stream: PeerStream;

    /// Waits for the next stream, in the order of opening.
    fn accept(&self) -> impl Future<Output = Result<Self::Stream, ConnectionError>> + Send;
}

/// The bytes of one stream.
pub(super) trait PeerStream: Send {
    /// Waits for the next bytes, at most `most`. `None` at the end of the stream.
    fn next(
        &mut self,
        most: usize,
    ) -> impl Future<Output = Result<Option<Bytes>, ReadError>> + Send;
}

impl PeerStreams for Connection {
    type Stream = RecvStream;

    async fn accept(&self) -> Result<RecvStream, ConnectionError> {
        self.accept_uni().await
    }
}

impl PeerStream for RecvStream {
    async fn next(&mut self, most: usize) -> Result<Option<Bytes>, ReadError> {
        let chunk = self.read_chunk(most, true).await?;
        Ok(chunk.map(|chunk| chunk.bytes))
    }
}

/// The reader of the peer's parcels, which reads the streams one after the other.
pub(super) struct Letters<C: PeerStreams> {
    connection: C,
    stream: Option<C::Stream>,
    /// Whether bytes of the stream have been read.
    begun: bool,
    reader: FrameReader,
}

impl<C: PeerStreams> Letters<C> {
    pub(super) fn new(connection: C, max_letter: usize) -> Self {
        Self {
            connection,
            stream: None,
            begun: false,
            reader: FrameReader::new(max_letter, BytesMut::new()),
        }
    }

    /// Reads the available bytes of the current parcel; 0 for a stream without bytes, so that a peer
    /// that opens many of them does not keep the link from other work. Never completes after the
    /// connection is lost: the control stream reports the loss after the frames that precede it.
    async fn read(&mut self) -> io::Result<usize> {
        loop {
            let stream = match &mut self.stream {
                Some(stream) => stream,
                none => match self.connection.accept().await {
                    Ok(stream) => none.insert(stream),
                    Err(_lost) => return pending().await,
                },
            };
            match fill(stream, &mut self.reader.space()).await {
                Ok(Some(len)) => {
                    self.begun = true;
                    return Ok(len);
                }
                Ok(None) if self.reader.is_partial() => {
                    let what = "a stream ended in the middle of a letter";
                    return Err(io::Error::new(io::ErrorKind::InvalidData, what));
                }
                Ok(None) => {
                    self.stream = None;
                    if !std::mem::take(&mut self.begun) {
                        return Ok(0);
                    }
                }
                Err(ReadError::ConnectionLost(_)) => return pending().await,
                Err(error) => return Err(error.into()),
            }
        }
    }
}

impl<C: PeerStreams> ParcelStreams for Letters<C> {
    fn read(&mut self) -> BoxFuture<'_, io::Result<usize>> {
        Box::pin(self.read())
    }

    fn reader(&mut self) -> &mut FrameReader {
        &mut self.reader
    }
}

/// Copies the available bytes into the space. Returns `None` at the end of the stream.
async fn fill(
    stream: &mut impl PeerStream,
    space: &mut Space<'_>,
) -> Result<Option<usize>, ReadError> {
    let bytes = stream.next(space.room()).await?;
    Ok(bytes.map(|bytes| space.fill(&bytes)))
}

fn not_written(error: WriteError) -> io::Error {
    match error {
        WriteError::ConnectionLost(error) => lost(&error),
        other => other.into(),
    }
}

/// The sending side of a connection, which takes frames one after the other.
#[derive(Debug)]
pub(super) struct Outgoing {
    connection: Connection,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    control: SendStream,
    /// The stream of the parcel that has begun, or a stream for the next one.
    letter: Option<SendStream>,
    /// The number of the latest of these streams.
    latest: Option<u64>,
    /// The frame that has begun.
    begun: Option<Begun>,
    /// The stream that the next byte waits for.
    blocked: Lane,
}

#[derive(Debug, Clone, Copy)]
struct Begun {
    lane: Lane,
    /// Number of missing bytes.
    remaining: u64,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Lane {
    Control,
    Letter,
}

impl Outgoing {
    pub(super) fn new(connection: &Connection, control: SendStream) -> Self {
        // An error means that the connection is lost, which the next write reports.
        let _ = control.set_priority(URGENT);
        Self {
            connection: connection.clone(),
            state: Mutex::new(State {
                control,
                letter: None,
                latest: None,
                begun: None,
                blocked: Lane::Control,
            }),
        }
    }

    /// Writes some of these bytes, which begin within or at the start of one frame.
    fn put(&self, state: &mut State, bytes: &[u8]) -> io::Result<usize> {
        let begun = match state.begun {
            Some(begun) => begun,
            None => {
                // Frames of this side begin with their whole header in one piece.
                let (is_parcel, remaining) =
                    frame::begun(bytes).ok_or(io::ErrorKind::InvalidInput)?;
                let lane = if is_parcel {
                    Lane::Letter
                } else {
                    Lane::Control
                };
                Begun { lane, remaining }
            }
        };
        state.blocked = begun.lane;
        let mut context = Context::from_waker(Waker::noop());
        if begun.lane == Lane::Letter && state.letter.is_none() {
            let opening = std::pin::pin!(self.connection.open_uni());
            match opening.poll(&mut context) {
                Poll::Ready(opened) => state.keep(opened.map_err(|error| lost(&error))?),
                Poll::Pending => return Err(io::ErrorKind::WouldBlock.into()),
            }
        }
        let most = usize::try_from(begun.remaining)
            .map_or(bytes.len(), |remaining| remaining.min(bytes.len()));
        let stream = state
            .stream(begun.lane)
            .ok_or(io::ErrorKind::NotConnected)?;
        let wanted = bytes.get(..most).unwrap_or(bytes);
        let taken = match Pin::new(stream).poll_write(&mut context, wanted) {
            Poll::Ready(taken) => taken.map_err(not_written)?,
            // Another frame may precede this one, if it has not begun.
            Poll::Pending => return Err(io::ErrorKind::WouldBlock.into()),
        };
        let remaining = begun.remaining.saturating_sub(taken as u64);
        state.begun = (remaining > 0).then_some(Begun { remaining, ..begun });
        if remaining == 0
            && begun.lane == Lane::Letter
            && let Some(mut letter) = state.letter.take()
        {
            letter.finish().map_err(io::Error::other)?;
        }
        Ok(taken)
    }

    /// Waits until there is room for the bytes that were not taken.
    async fn writable(&self) -> io::Result<()> {
        let opens = {
            let state = self.state.lock();
            state.blocked == Lane::Letter && state.letter.is_none()
        };
        if opens {
            let opened = self.connection.open_uni().await;
            let opened = opened.map_err(|error| lost(&error))?;
            let mut state = self.state.lock();
            // Another thread may have opened a later stream meanwhile. Then this one ends without a
            // byte, and its reader skips it: parcels are read in the order of their streams.
            state.keep(opened);
            return Ok(());
        }
        poll_fn(|context| {
            let mut state = self.state.lock();
            let lane = state.blocked;
            match state.stream(lane) {
                // An empty write tests whether bytes could be written.
                Some(stream) => match Pin::new(stream).poll_write(context, &[]) {
                    Poll::Ready(Ok(_)) => Poll::Ready(Ok(())),
                    Poll::Ready(Err(error)) => Poll::Ready(Err(not_written(error))),
                    Poll::Pending => Poll::Pending,
                },
                None => Poll::Ready(Ok(())),
            }
        })
        .await
    }
}

impl StreamWriter for Outgoing {
    /// Returns the local address that the peer dialed. A connection that this side dialed has
    /// none: it survives a change of address (RFC 9000 section 9).
    fn local_ip(&self) -> Option<IpAddr> {
        self.connection.local_ip()
    }

    fn write(&self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        let mut state = self.state.lock();
        let mut taken = 0;
        for slice in slices {
            let mut rest: &[u8] = slice;
            while !rest.is_empty() {
                match self.put(&mut state, rest) {
                    Ok(len) => {
                        taken += len;
                        rest = rest.get(len..).unwrap_or_default();
                    }
                    Err(_) if taken > 0 => return Ok(taken),
                    Err(error) => return Err(error),
                }
            }
        }
        Ok(taken)
    }

    fn writable(&self) -> BoxFuture<'_, io::Result<()>> {
        Box::pin(self.writable())
    }
}

impl State {
    /// Keeps a stream for the next parcel, if no later one has been used.
    fn keep(&mut self, opened: SendStream) {
        let number = opened.id().index();
        if self.letter.is_none() && self.latest.is_none_or(|latest| latest < number) {
            self.latest = Some(number);
            self.letter = Some(opened);
        }
    }

    fn stream(&mut self, lane: Lane) -> Option<&mut SendStream> {
        match lane {
            Lane::Control => Some(&mut self.control),
            Lane::Letter => self.letter.as_mut(),
        }
    }
}
