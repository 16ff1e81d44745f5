//! Frames: what stands on a connection between two endpoints.
//!
//! A frame is a [`FrameHeader`] of 24 bytes, little-endian, and a body:
//!
//! | kind | id | body |
//! |---|---|---|
//! | 1 hello | 0 | see [`crate::hello`] |
//! | 2 parcel | the sender's number of the parcel, rising | [`ParcelHeader`], then its body |
//! | 3 answer | the parcel it answers | see [`crate::answer`] |
//! | 4 ping, 5 pong | 0 | none |
//! | 6 goodbye | the last parcel that was taken; later ones have not been and never will be | none |
//!
//! The first byte tells a frame (`f`) from the letter of an old peer (`FE`, `FD`, `<`).
//!
//! [`FrameReader`] turns bytes in pieces of any size into frames. A large body is read straight
//! into one buffer of its own, which grows as the bytes arrive: announcing much takes no memory.

use bytes::buf::Limit;
use bytes::{Buf, BufMut, Bytes, BytesMut};
use fipa_transport::wire::{HEADER_LEN as PARCEL_HEADER_LEN, ParcelHeader, WireError};
use fipa_transport::{Answer, Parcel};
use zerocopy::little_endian::{U16, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::answer::{self, MAX_ANSWER};
use crate::hello::{Hello, MAX_HELLO};

/// What every frame begins with. A later version of the protocol keeps these eight bytes' layout.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout, Unaligned,
)]
#[repr(C)]
struct FrameHeader {
    magic: [u8; 4],
    version: u8,
    kind: u8,
    /// Written as zero, not looked at: for what may be left out by who does not know it.
    flags: U16,
    id: U64,
    body_len: U64,
}

pub(crate) const HEADER_LEN: usize = size_of::<FrameHeader>();
pub(crate) const MAGIC: [u8; 4] = *b"fipa";
const VERSION: u8 = 1;

const HELLO: u8 = 1;
const PARCEL: u8 = 2;
const ANSWER: u8 = 3;
const PING: u8 = 4;
const PONG: u8 = 5;
const GOODBYE: u8 = 6;

/// Room in a parcel's body beside the letter: receiver name, or a whole report.
const PARCEL_ALLOWANCE: u64 = 128 * 1024;

/// Bytes of the buffer that headers and small bodies are read into.
const CHUNK: usize = 16 * 1024;

/// A body's own buffer begins with at most this much, and grows to at most four times what has
/// arrived. Memory that nothing was put into is not really taken from the system.
const FIRST_STEP: usize = 4 << 20;

/// A frame as it arrived.
#[derive(Debug, PartialEq)]
pub(crate) enum Frame {
    Hello(Hello),
    Parcel { id: u64, parcel: Box<Parcel> },
    Answer { id: u64, answer: Answer },
    Ping,
    Pong,
    Goodbye { last: u64 },
}

/// Bytes that are not frames.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum FrameError {
    #[error("no frame begins with {0:02x?}")]
    Magic([u8; 4]),
    #[error("version {0} of the protocol; this side speaks {VERSION}")]
    Version(u8),
    #[error("unknown kind of frame: {0}")]
    Kind(u8),
    #[error("a frame of kind {kind} with {announced} bytes; {min} to {max} are allowed")]
    Length {
        kind: u8,
        announced: u64,
        min: u64,
        max: u64,
    },
    #[error("malformed hello")]
    Hello,
    #[error("malformed answer")]
    Answer,
    #[error("malformed parcel: {0}")]
    Parcel(#[from] WireError),
}

/// A hello, ready to be written.
pub(crate) fn hello(hello: &Hello) -> Bytes {
    let body = hello.encode();
    let mut frame = BytesMut::with_capacity(HEADER_LEN + body.len());
    put_header(&mut frame, HELLO, 0, body.len() as u64);
    frame.put_slice(&body);
    frame.freeze()
}

/// A parcel, ready to be written: pieces in order, none of them empty. The letter is not copied.
pub(crate) fn parcel(id: u64, parcel: &Parcel) -> Result<Vec<Bytes>, WireError> {
    let (header, mut pieces) = ParcelHeader::of(parcel)?;
    let name = pieces.first().map_or(&[][..], |piece| piece);
    let mut front = BytesMut::with_capacity(HEADER_LEN + PARCEL_HEADER_LEN + name.len());
    let body_len = (PARCEL_HEADER_LEN as u64).saturating_add(header.body_len());
    put_header(&mut front, PARCEL, id, body_len);
    front.put_slice(header.as_bytes());
    front.put_slice(name);
    match pieces.first_mut() {
        Some(first) => *first = front.freeze(),
        None => pieces.push(front.freeze()),
    }
    Ok(pieces)
}

/// An answer, ready to be written.
pub(crate) fn answer(id: u64, answer: &Answer) -> Bytes {
    let mut frame = BytesMut::with_capacity(HEADER_LEN + MAX_ANSWER);
    put_header(&mut frame, ANSWER, id, answer::len(answer) as u64);
    answer::encode(answer, &mut frame);
    frame.freeze()
}

pub(crate) fn ping() -> Bytes {
    bodiless(PING, 0)
}

pub(crate) fn pong() -> Bytes {
    bodiless(PONG, 0)
}

pub(crate) fn goodbye(last: u64) -> Bytes {
    bodiless(GOODBYE, last)
}

fn bodiless(kind: u8, id: u64) -> Bytes {
    let mut frame = BytesMut::with_capacity(HEADER_LEN);
    put_header(&mut frame, kind, id, 0);
    frame.freeze()
}

fn put_header(out: &mut BytesMut, kind: u8, id: u64, body_len: u64) {
    let header = FrameHeader {
        magic: MAGIC,
        version: VERSION,
        kind,
        flags: U16::ZERO,
        id: U64::new(id),
        body_len: U64::new(body_len),
    };
    out.put_slice(header.as_bytes());
}

/// Bytes in, frames out.
#[derive(Debug)]
pub(crate) struct FrameReader {
    /// Longest body of a parcel frame.
    max_parcel: u64,
    /// Headers, small bodies and the beginnings of large ones.
    chunk: BytesMut,
    /// The frame whose body is arriving.
    body: Option<PartialBody>,
}

#[derive(Debug)]
struct PartialBody {
    header: FrameHeader,
    bytes: BytesMut,
    /// Length of the whole body.
    len: usize,
}

impl FrameReader {
    /// A reader for a connection on which `begun` has arrived already, with room for letters of
    /// `max_letter` bytes.
    pub(crate) fn new(max_letter: usize, begun: BytesMut) -> Self {
        Self {
            max_parcel: (max_letter as u64).saturating_add(PARCEL_ALLOWANCE),
            chunk: begun,
            body: None,
        }
    }

    /// Where the next bytes are to be put. To be called again after each time bytes were put
    /// there, and [`next`](Self::next) in between until it has no more.
    pub(crate) fn space(&mut self) -> Limit<&mut BytesMut> {
        if let Some(body) = &mut self.body
            && body.missing() >= CHUNK
        {
            // What is missing of a large body goes where it stays. Its rest, once smaller than
            // the chunk, is fetched together with what follows it.
            body.make_room();
            let limit = body.missing().min(body.bytes.capacity() - body.bytes.len());
            return (&mut body.bytes).limit(limit);
        }
        self.chunk
            .reserve(CHUNK.saturating_sub(self.chunk.len()).max(1));
        let limit = self.chunk.capacity() - self.chunk.len();
        (&mut self.chunk).limit(limit)
    }

    /// The next whole frame, if it has arrived.
    ///
    /// # Errors
    /// When what arrived is no frame. The connection is of no use then.
    pub(crate) fn next(&mut self) -> Result<Option<Frame>, FrameError> {
        let mut body = match self.body.take() {
            Some(body) => body,
            None => match self.begin()? {
                Some(body) => body,
                None => return Ok(None),
            },
        };
        body.take_from(&mut self.chunk);
        if body.missing() > 0 {
            self.body = Some(body);
            return Ok(None);
        }
        finish(body.header, body.bytes.freeze()).map(Some)
    }

    /// Whether a frame has begun to arrive and is not complete.
    pub(crate) fn is_partial(&self) -> bool {
        self.body.is_some() || !self.chunk.is_empty()
    }

    fn begin(&mut self) -> Result<Option<PartialBody>, FrameError> {
        // Nonsense is recognised by its first bytes, not only once there is enough of it.
        let begun = self.chunk.len().min(MAGIC.len());
        if self.chunk[..begun] != MAGIC[..begun] {
            let mut found = [0; 4];
            found[..begun].copy_from_slice(&self.chunk[..begun]);
            return Err(FrameError::Magic(found));
        }
        let Ok((header, _)) = FrameHeader::read_from_prefix(&self.chunk) else {
            return Ok(None);
        };
        let len = header.checked_body_len(self.max_parcel)?;
        self.chunk.advance(HEADER_LEN);
        Ok(Some(PartialBody {
            header,
            bytes: BytesMut::with_capacity(len.min(FIRST_STEP)),
            len,
        }))
    }
}

impl PartialBody {
    /// Moves what there is of this body from the chunk.
    fn take_from(&mut self, chunk: &mut BytesMut) {
        let there = self.missing().min(chunk.len());
        self.bytes.put_slice(&chunk[..there]);
        chunk.advance(there);
    }

    fn missing(&self) -> usize {
        self.len - self.bytes.len()
    }

    fn make_room(&mut self) {
        if self.bytes.len() == self.bytes.capacity() {
            let step = self.bytes.len().saturating_mul(3).min(self.missing());
            self.bytes.reserve(step);
        }
    }
}

impl FrameHeader {
    fn checked_body_len(&self, max_parcel: u64) -> Result<usize, FrameError> {
        if self.version != VERSION {
            return Err(FrameError::Version(self.version));
        }
        let (min, max) = match self.kind {
            HELLO => (0, MAX_HELLO as u64),
            PARCEL => (PARCEL_HEADER_LEN as u64, max_parcel),
            ANSWER => (0, MAX_ANSWER as u64),
            PING | PONG | GOODBYE => (0, 0),
            other => return Err(FrameError::Kind(other)),
        };
        let announced = self.body_len.get();
        let too_long = FrameError::Length {
            kind: self.kind,
            announced,
            min,
            max,
        };
        match usize::try_from(announced) {
            Ok(len) if (min..=max).contains(&announced) => Ok(len),
            _ => Err(too_long),
        }
    }
}

fn finish(header: FrameHeader, mut body: Bytes) -> Result<Frame, FrameError> {
    let id = header.id.get();
    Ok(match header.kind {
        HELLO => Frame::Hello(Hello::decode(&body).ok_or(FrameError::Hello)?),
        PARCEL => {
            let Ok((parcel_header, _)) = ParcelHeader::read_from_prefix(&body) else {
                let found = body.len() as u64;
                let announced = PARCEL_HEADER_LEN as u64;
                return Err(WireError::BodyLength { announced, found }.into());
            };
            body.advance(PARCEL_HEADER_LEN);
            let parcel = Box::new(parcel_header.parcel(body)?);
            Frame::Parcel { id, parcel }
        }
        ANSWER => {
            let answer = answer::decode(&body).ok_or(FrameError::Answer)?;
            Frame::Answer { id, answer }
        }
        PING => Frame::Ping,
        PONG => Frame::Pong,
        GOODBYE => Frame::Goodbye { last: id },
        other => return Err(FrameError::Kind(other)),
    })
}

#[cfg(test)]
#[path = "frame_tests.rs"]
mod tests;
