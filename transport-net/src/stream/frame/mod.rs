//! Frames: the encoding of a connection between two endpoints.
//!
//! A frame is a [`FrameHeader`] of 24 bytes, little-endian, and a body:
//!
//! | kind | id | body |
//! |---|---|---|
//! | 1 hello | 0 | see [`crate::hello`] |
//! | 2 parcel | the sender's number of the parcel, increasing | [`ParcelHeader`], then its body |
//! | 3 answer | the parcel it answers | see [`fipa_transport::wire::write_answer`] |
//! | 4 ping, 5 pong | 0 | none |
//! | 6 goodbye | the last accepted parcel; later ones are never accepted | none |
//!
//! A side that receives a frame of another version before the hello answers with a goodbye and ends the connection.
//! From its first eight bytes, a peer of any version learns the version of this side.
//!
//! The first byte distinguishes a frame (`f`) from the letter of a legacy peer (`FE`, `FD`, `<`).
//!
//! [`FrameReader`] turns bytes in pieces of any size into frames.

mod reader;

use bytes::{Buf, BufMut, Bytes, BytesMut};
use fipa_transport::wire::{
    self, HEADER_LEN as PARCEL_HEADER_LEN, MAX_ANSWER_LEN, ParcelHeader, WireError,
};
use fipa_transport::{Answer, Parcel};
use zerocopy::little_endian::{U16, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::hello::{Hello, MAX_HELLO};

pub(crate) use self::reader::{FrameReader, Placed, Space};

/// The header of every frame. A later version of the protocol keeps the layout of the first eight
/// bytes.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout, Unaligned,
)]
#[repr(C)]
struct FrameHeader {
    magic: [u8; 4],
    version: u8,
    kind: u8,
    /// Written as zero and ignored on receipt; reserved for optional extensions.
    flags: U16,
    id: U64,
    body_len: U64,
}

pub(crate) const HEADER_LEN: usize = size_of::<FrameHeader>();

/// Length of the first bytes of a header, whose layout is that of every version.
const COMMON_LEN: usize = 8;

pub(crate) const MAGIC: [u8; 4] = *b"fipa";
/// The version of the frames of this side.
pub(crate) const VERSION: u8 = 3;

const HELLO: u8 = 1;
const PARCEL: u8 = 2;
const ANSWER: u8 = 3;
const PING: u8 = 4;
const PONG: u8 = 5;
const GOODBYE: u8 = 6;

/// Maximum length of a parcel's body beyond the letter: the receiver's name, or a whole report.
const PARCEL_ALLOWANCE: u64 = 128 * 1024;

/// A decoded frame.
#[derive(Debug, PartialEq)]
pub(crate) enum Frame {
    Hello(Hello),
    Parcel { id: u64, parcel: Box<Parcel> },
    Answer { id: u64, answer: Answer },
    Ping,
    Pong,
    Goodbye { last: u64 },
}

/// An error in the bytes of a frame.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum FrameError {
    #[error("unknown start of a frame: {0:02x?}")]
    Magic([u8; 4]),
    #[error("unsupported protocol version {0}; this side supports {VERSION}")]
    Version(u8),
    #[error("unknown frame kind {0}")]
    Kind(u8),
    #[error("frame of kind {kind} announces {announced} bytes; allowed are {min} to {max}")]
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

/// Decodes the header of a frame of this side. Returns whether the frame is a parcel, and its
/// length with the header.
#[cfg(feature = "quic")]
pub(crate) fn begun(bytes: &[u8]) -> Option<(bool, u64)> {
    let (header, _) = FrameHeader::read_from_prefix(bytes).ok()?;
    let len = header.body_len.get().checked_add(HEADER_LEN as u64)?;
    Some((header.kind == PARCEL, len))
}

/// Encodes a hello.
pub(crate) fn hello(hello: &Hello) -> Bytes {
    let body = hello.encode();
    let mut frame = BytesMut::with_capacity(HEADER_LEN + body.len());
    put_header(&mut frame, HELLO, 0, body.len() as u64);
    frame.put_slice(&body);
    frame.freeze()
}

/// Encodes a parcel as ordered, nonempty pieces. The letter is not copied.
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

/// Encodes an answer.
pub(crate) fn answer(id: u64, answer: &Answer) -> Bytes {
    let mut frame = BytesMut::with_capacity(HEADER_LEN + MAX_ANSWER_LEN);
    put_header(&mut frame, ANSWER, id, wire::answer_len(answer) as u64);
    wire::write_answer(answer, &mut frame);
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

impl FrameHeader {
    fn checked_body_len(&self, max_parcel: u64) -> Result<usize, FrameError> {
        if self.version != VERSION {
            return Err(FrameError::Version(self.version));
        }
        let (min, max) = match self.kind {
            HELLO => (0, MAX_HELLO as u64),
            PARCEL => (PARCEL_HEADER_LEN as u64, max_parcel),
            ANSWER => (0, MAX_ANSWER_LEN as u64),
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
            let parcel_header = parcel_header(&mut body)?;
            let parcel = Box::new(parcel_header.parcel(body)?);
            Frame::Parcel { id, parcel }
        }
        ANSWER => {
            let answer = wire::read_answer(&body).ok_or(FrameError::Answer)?;
            Frame::Answer { id, answer }
        }
        PING => Frame::Ping,
        PONG => Frame::Pong,
        GOODBYE => Frame::Goodbye { last: id },
        other => return Err(FrameError::Kind(other)),
    })
}

/// Decodes a parcel whose content is in separate memory.
fn finish_apart(
    header: FrameHeader,
    mut front: Bytes,
    content: Bytes,
    tail: Bytes,
) -> Result<Frame, FrameError> {
    let parcel_header = parcel_header(&mut front)?;
    let parcel = parcel_header.parcel_of_pieces(front, content, tail)?;
    Ok(Frame::Parcel {
        id: header.id.get(),
        parcel: Box::new(parcel),
    })
}

/// Removes the parcel header from the front of a body.
fn parcel_header(body: &mut Bytes) -> Result<ParcelHeader, WireError> {
    let Ok((header, _)) = ParcelHeader::read_from_prefix(body) else {
        let found = body.len() as u64;
        let announced = PARCEL_HEADER_LEN as u64;
        return Err(WireError::BodyLength { announced, found });
    };
    body.advance(PARCEL_HEADER_LEN);
    Ok(header)
}

#[cfg(test)]
mod tests;
