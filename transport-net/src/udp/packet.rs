//! Datagrams between two endpoints.
//!
//! A datagram begins with a [`Header`] of 16 bytes, little-endian, whose first eight bytes are
//! those of a TCP frame. `to` is the receiver's own number of the connection.
//!
//! | kind | `to` | what follows |
//! |---|---|---|
//! | 1 hello | 0 | the sender's number (8), a cookie (16, zeros at first), length of the hello (2), [`crate::hello`]; padded to [`BASE`] |
//! | 2 cookie | the number in the hello | a cookie (16) |
//! | 3 welcome | the number in the hello | the sender's number (8), length of the hello (2), [`crate::hello`] |
//! | 4 refused | the number in the hello | nothing |
//! | 5 unknown | 0 | the number of the unknown connection (8) |
//! | 6 data | | number of the packet (8), then frames |
//!
//! Frames of a data packet:
//!
//! | frame | what follows |
//! |---|---|
//! | 0 padding | ignored, to the end |
//! | 1 acknowledgment | highest packet (8), its delay in µs (4), length n (1), n bytes: bit i is set if the packet i + 1 below it arrived |
//! | 2 parcel | its number, increasing by one (8), [`ParcelHeader`], its body, to the end |
//! | 3 answer | the parcel it answers (8), length (1), see [`fipa_transport::wire::write_answer`] |
//! | 4 ping | nothing; is acknowledged |
//! | 5 skipped | the number of a parcel that never comes (8) |
//! | 6 goodbye | the last accepted parcel; later ones are never accepted (8) |
//!
//! A hello is larger than every reply to it, and its receiver stores no state before the cookie has
//! come back. A spoofed source address therefore neither amplifies traffic nor consumes memory.

use bytes::{Buf, BufMut};
use fipa_transport::Answer;
use fipa_transport::wire::{self, HEADER_LEN as PARCEL_HEADER_LEN, MAX_ANSWER_LEN, ParcelHeader};
use zerocopy::little_endian::{U16, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::hello::Hello;

/// Size of a datagram that every path must carry (RFC 8200 section 5: 1,280 bytes, less the headers
/// of IPv6 and UDP and a margin for tunnels), as in QUIC.
pub(crate) const BASE: usize = 1200;

/// Size of the largest datagram, which fits the loopback interface's 65,536 bytes with IPv6.
pub(crate) const LARGEST: usize = 65_487;

/// Number of bytes in front of a parcel's name in a packet that carries nothing else.
pub(crate) const PARCEL_OVERHEAD: usize = DATA_LEN + 1 + 8 + PARCEL_HEADER_LEN;

pub(crate) const HEADER_LEN: usize = size_of::<Header>();
/// Header and number of a data packet.
pub(crate) const DATA_LEN: usize = HEADER_LEN + 8;
/// Maximum length of an acknowledgment.
pub(crate) const MAX_ACK: usize = 1 + 8 + 4 + 1 + BITMAP;
/// Maximum length of the bitmap in an acknowledgment, in bytes.
pub(crate) const BITMAP: usize = 32;
pub(crate) const ANSWER_OVERHEAD: usize = 1 + 8 + 1;

const MAGIC: [u8; 4] = *b"fipa";
const VERSION: u8 = 3;

const HELLO: u8 = 1;
const COOKIE: u8 = 2;
const WELCOME: u8 = 3;
const REFUSED: u8 = 4;
const UNKNOWN: u8 = 5;
const DATA: u8 = 6;

const PADDING: u8 = 0;
const ACK: u8 = 1;
const PARCEL: u8 = 2;
const ANSWER: u8 = 3;
const PING: u8 = 4;
const SKIPPED: u8 = 5;
const GOODBYE: u8 = 6;

pub(crate) use crate::datagrams::cookie::Cookie;

pub(crate) const NO_COOKIE: Cookie = [0; 16];

#[derive(
    Debug, Clone, Copy, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout, Unaligned,
)]
#[repr(C)]
struct Header {
    magic: [u8; 4],
    version: u8,
    kind: u8,
    flags: U16,
    to: U64,
}

/// A decoded datagram.
#[derive(Debug, PartialEq)]
pub(crate) enum Datagram<'a> {
    Hello {
        initiator: u64,
        cookie: Cookie,
        /// Not decoded before the cookie has been checked.
        hello: &'a [u8],
    },
    Cookie {
        to: u64,
        cookie: Cookie,
    },
    Welcome {
        to: u64,
        acceptor: u64,
        hello: &'a [u8],
    },
    Refused {
        to: u64,
    },
    Unknown {
        number: u64,
    },
    Data {
        to: u64,
        number: u64,
        frames: &'a [u8],
    },
}

impl<'a> Datagram<'a> {
    /// Decodes a datagram. Returns `None` when it is not one of this protocol and version.
    pub(crate) fn read(bytes: &'a [u8]) -> Option<Self> {
        let (header, mut rest) = Header::read_from_prefix(bytes).ok()?;
        if header.magic != MAGIC || header.version != VERSION {
            return None;
        }
        let to = header.to.get();
        Some(match header.kind {
            HELLO if bytes.len() >= BASE => Self::Hello {
                initiator: rest.try_get_u64_le().ok().filter(|number| *number != 0)?,
                cookie: cookie(&mut rest)?,
                hello: counted(&mut rest)?,
            },
            COOKIE => Self::Cookie {
                to,
                cookie: cookie(&mut rest)?,
            },
            WELCOME => Self::Welcome {
                to,
                acceptor: rest.try_get_u64_le().ok().filter(|number| *number != 0)?,
                hello: counted(&mut rest)?,
            },
            REFUSED => Self::Refused { to },
            UNKNOWN => Self::Unknown {
                number: rest.try_get_u64_le().ok()?,
            },
            DATA => Self::Data {
                to,
                number: rest.try_get_u64_le().ok()?,
                frames: rest,
            },
            _ => return None,
        })
    }
}

fn cookie(rest: &mut &[u8]) -> Option<Cookie> {
    let (cookie, after) = rest.split_first_chunk()?;
    *rest = after;
    Some(*cookie)
}

fn counted<'a>(rest: &mut &'a [u8]) -> Option<&'a [u8]> {
    let len = rest.try_get_u16_le().ok()?;
    let (counted, after) = rest.split_at_checked(usize::from(len))?;
    *rest = after;
    Some(counted)
}

fn put_header(out: &mut Vec<u8>, kind: u8, to: u64) {
    let header = Header {
        magic: MAGIC,
        version: VERSION,
        kind,
        flags: U16::ZERO,
        to: U64::new(to),
    };
    out.put_slice(header.as_bytes());
}

pub(crate) fn hello(initiator: u64, cookie: &Cookie, hello: &Hello) -> Vec<u8> {
    let mut out = Vec::with_capacity(BASE);
    put_header(&mut out, HELLO, 0);
    out.put_u64_le(initiator);
    out.put_slice(cookie);
    put_hello(&mut out, hello);
    out.resize(BASE, 0);
    out
}

pub(crate) fn cookie_for(to: u64, cookie: &Cookie) -> Vec<u8> {
    let mut out = Vec::new();
    put_header(&mut out, COOKIE, to);
    out.put_slice(cookie);
    out
}

pub(crate) fn welcome(to: u64, acceptor: u64, hello: &Hello) -> Vec<u8> {
    let mut out = Vec::with_capacity(BASE);
    put_header(&mut out, WELCOME, to);
    out.put_u64_le(acceptor);
    put_hello(&mut out, hello);
    out
}

pub(crate) fn refused(to: u64) -> Vec<u8> {
    let mut out = Vec::new();
    put_header(&mut out, REFUSED, to);
    out
}

pub(crate) fn unknown(number: u64) -> Vec<u8> {
    let mut out = Vec::new();
    put_header(&mut out, UNKNOWN, 0);
    out.put_u64_le(number);
    out
}

/// Appends a hello that fits one datagram of size [`BASE`]: listening addresses that do not fit are
/// left out, the last first.
fn put_hello(out: &mut Vec<u8>, hello: &Hello) {
    let room = BASE - out.len() - 2;
    let mut hello = hello.clone();
    let mut body = hello.encode();
    while body.len() > room && hello.listening.pop().is_some() {
        body = hello.encode();
    }
    out.put_u16_le(body.len() as u16);
    out.put_slice(&body);
}

/// Begins a data packet.
pub(crate) fn put_data(out: &mut Vec<u8>, to: u64, number: u64) {
    put_header(out, DATA, to);
    out.put_u64_le(number);
}

/// An acknowledgment of packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Ack {
    pub(crate) largest: u64,
    pub(crate) delay_us: u32,
    /// Bit i: the packet `largest - 1 - i`.
    pub(crate) before: [u8; BITMAP],
}

impl Ack {
    pub(crate) fn covers(&self, number: u64) -> bool {
        match self.largest.checked_sub(number) {
            None => false,
            Some(0) => true,
            Some(distance) => {
                let bit = distance - 1;
                let byte = usize::try_from(bit / 8).unwrap_or(usize::MAX);
                self.before
                    .get(byte)
                    .is_some_and(|byte| byte & (1 << (bit % 8)) != 0)
            }
        }
    }
}

pub(crate) fn put_ack(out: &mut Vec<u8>, ack: &Ack) {
    let last = ack.before.iter().rposition(|byte| *byte != 0);
    let before = &ack.before[..last.map_or(0, |last| last + 1)];
    out.put_u8(ACK);
    out.put_u64_le(ack.largest);
    out.put_u32_le(ack.delay_us);
    out.put_u8(before.len() as u8);
    out.put_slice(before);
}

/// Appends the header of a parcel frame.
pub(crate) fn put_parcel(out: &mut Vec<u8>, id: u64) {
    out.put_u8(PARCEL);
    out.put_u64_le(id);
}

pub(crate) fn put_answer(out: &mut Vec<u8>, id: u64, body: &[u8]) {
    out.put_u8(ANSWER);
    out.put_u64_le(id);
    out.put_u8(body.len() as u8);
    out.put_slice(body);
}

pub(crate) fn put_ping(out: &mut Vec<u8>) {
    out.put_u8(PING);
}

pub(crate) fn put_skipped(out: &mut Vec<u8>, id: u64) {
    out.put_u8(SKIPPED);
    out.put_u64_le(id);
}

pub(crate) fn put_goodbye(out: &mut Vec<u8>, last: u64) {
    out.put_u8(GOODBYE);
    out.put_u64_le(last);
}

/// A frame of a data packet.
#[derive(Debug, PartialEq)]
pub(crate) enum Frame<'a> {
    Ack(Ack),
    Parcel { id: u64, bytes: &'a [u8] },
    Answer { id: u64, answer: Answer },
    Ping,
    Skipped { id: u64 },
    Goodbye { last: u64 },
}

/// The frames of a data packet; an error ends them.
#[derive(Debug)]
pub(crate) struct Frames<'a>(pub(crate) &'a [u8]);

impl<'a> Iterator for Frames<'a> {
    type Item = Result<Frame<'a>, ()>;

    fn next(&mut self) -> Option<Self::Item> {
        let (kind, rest) = self.0.split_first()?;
        if *kind == PADDING {
            self.0 = &[];
            return None;
        }
        self.0 = rest;
        let frame = self.read(*kind);
        if frame.is_none() {
            self.0 = &[];
        }
        Some(frame.ok_or(()))
    }
}

impl<'a> Frames<'a> {
    fn read(&mut self, kind: u8) -> Option<Frame<'a>> {
        let rest = &mut self.0;
        Some(match kind {
            ACK => {
                let largest = rest.try_get_u64_le().ok()?;
                let delay_us = rest.try_get_u32_le().ok()?;
                let len = usize::from(rest.try_get_u8().ok()?);
                let (received, after) = rest.split_at_checked(len)?;
                let mut before = [0; BITMAP];
                before.get_mut(..len)?.copy_from_slice(received);
                *rest = after;
                Frame::Ack(Ack {
                    largest,
                    delay_us,
                    before,
                })
            }
            PARCEL => {
                let id = rest.try_get_u64_le().ok()?;
                let bytes = std::mem::take(rest);
                Frame::Parcel { id, bytes }
            }
            ANSWER => {
                let id = rest.try_get_u64_le().ok()?;
                let len = usize::from(rest.try_get_u8().ok()?);
                if len > MAX_ANSWER_LEN {
                    return None;
                }
                let (body, after) = rest.split_at_checked(len)?;
                *rest = after;
                let answer = wire::read_answer(body)?;
                Frame::Answer { id, answer }
            }
            PING => Frame::Ping,
            SKIPPED => Frame::Skipped {
                id: rest.try_get_u64_le().ok()?,
            },
            GOODBYE => Frame::Goodbye {
                last: rest.try_get_u64_le().ok()?,
            },
            _ => return None,
        })
    }
}

/// Splits a parcel frame into the header of the parcel and its body.
pub(crate) fn split_parcel(bytes: &[u8]) -> Option<(ParcelHeader, &[u8])> {
    ParcelHeader::read_from_prefix(bytes).ok()
}

#[cfg(test)]
mod tests {
    use fipa_transport::{FailureReason, Incarnation};
    use proptest::prelude::*;

    use super::*;
    use crate::Identity;

    fn sample(listening: usize) -> Hello {
        Hello {
            identity: Identity {
                name: "n".repeat(Identity::MAX_TEXT),
                incarnation: Incarnation::from_u64(7),
                domain: "d".repeat(Identity::MAX_TEXT),
                host: "h".repeat(Identity::MAX_TEXT),
            },
            max_letter: 1000,
            max_in_flight: 10,
            serial: 1,
            dialed: "0123456789abcdef".into(),
            listening: vec!["[fe80::1234:5678:9abc:def0%12]:65535".into(); listening],
            load: Default::default(),
        }
    }

    #[test]
    fn the_longest_hello_fits_what_every_path_carries() {
        let longest = sample(16);
        let first = hello(3, &[9; 16], &longest);
        assert_eq!(first.len(), BASE);
        let Some(Datagram::Hello { hello, .. }) = Datagram::read(&first) else {
            panic!("not a hello");
        };
        let read = Hello::decode(hello).unwrap();
        assert_eq!(read.identity, longest.identity);
        assert!(!read.listening.is_empty());
        let second = welcome(3, 4, &longest);
        assert!(second.len() <= BASE);
        assert!(cookie_for(3, &[9; 16]).len() < BASE);
        assert!(matches!(
            Datagram::read(&second),
            Some(Datagram::Welcome {
                to: 3,
                acceptor: 4,
                ..
            })
        ));
    }

    #[test]
    fn a_hello_below_the_minimum_size_is_ignored() {
        let mut bytes = hello(3, &NO_COOKIE, &sample(0));
        bytes.pop();
        assert_eq!(Datagram::read(&bytes), None);
    }

    #[test]
    fn frames_round_trip() {
        let mut before = [0; BITMAP];
        before[4] = 0x81;
        let ack = Ack {
            largest: 70,
            delay_us: 5,
            before,
        };
        let answer = Answer::failed(FailureReason::QueueFull, "é".repeat(80));
        let mut body = bytes::BytesMut::new();
        wire::write_answer(&answer, &mut body);
        let mut out = Vec::new();
        put_ack(&mut out, &ack);
        put_answer(&mut out, 8, &body);
        put_ping(&mut out);
        put_skipped(&mut out, 9);
        put_goodbye(&mut out, 10);
        put_parcel(&mut out, 11);
        out.extend(b"rest");
        let read: Result<Vec<_>, ()> = Frames(&out).collect();
        assert_eq!(
            read.unwrap(),
            [
                Frame::Ack(ack),
                Frame::Answer { id: 8, answer },
                Frame::Ping,
                Frame::Skipped { id: 9 },
                Frame::Goodbye { last: 10 },
                Frame::Parcel {
                    id: 11,
                    bytes: b"rest"
                },
            ]
        );
        let covered: Vec<u64> = (0..80).filter(|number| ack.covers(*number)).collect();
        assert_eq!(covered, [30, 37, 70]);
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_decode_without_panic(mut bytes in prop::collection::vec(any::<u8>(), 0..1300), ours: bool) {
            if ours && bytes.len() > 5 {
                bytes[..4].copy_from_slice(&MAGIC);
                bytes[4] = VERSION;
                bytes[5] %= 8;
            }
            if let Some(Datagram::Data { frames, .. }) = Datagram::read(&bytes) {
                let _ = Frames(frames).count();
            }
            for frame in Frames(&bytes).flatten() {
                if let Frame::Parcel { bytes, .. } = frame {
                    let _ = split_parcel(bytes);
                }
            }
        }
    }
}
