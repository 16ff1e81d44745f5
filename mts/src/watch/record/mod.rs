//! Records: data that a process sends to a watcher about a letter. Each is one datagram.
//!
//! ```text
//! record := header(96 bytes) name envelope message content outcome
//! ```
//! The header has a magic number, the version and the lengths of the parts, all integers
//! little-endian. `name` is that of the receiver (in a greeting: of the reporting message transport
//! service); `envelope` is as in the letter; `message` is the bit-efficient encoding (FIPA00069) of
//! the message without its content, in the encoding in which it was sent; `content` is its beginning,
//! if the watcher has requested that; `outcome` is encoded by [`wire::write_outcome`]. Absent parts
//! have length 0.
//!
//! In the other direction goes one datagram, the [`Wish`]: the request of the watcher.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use fipa_acl::{Letter, Message};
use fipa_transport::{Incarnation, Kind, Outcome, Parcel, Stream, wire};
use zerocopy::little_endian::{U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use super::envelope::SeenEnvelope;
use crate::core::{News, Notice};

/// Largest record, in bytes.
pub const MAX_LEN: usize = 64 * 1024;
/// Maximum length of the content in a record, in bytes.
pub const MAX_CONTENT: usize = 24 * 1024;
/// Maximum length of the envelope, and of the message without its content; longer parts are left
/// out.
const MAX_PART: usize = 16 * 1024;

const MAGIC: [u8; 4] = *b"fipw";
/// Version of the whole format: a watcher accepts only its own.
const VERSION: u8 = 1;

const REQUEST: u8 = 0;
const HELLO: u8 = 1;
const SENT: u8 = 2;
const TAKEN: u8 = 3;
const PASSED: u8 = 4;
const SETTLED: u8 = 5;
const LOST: u8 = 6;

const NO_TRANSPORT: u8 = u8::MAX;

/// The reporting process is a gateway.
const GATEWAY: u8 = 1;
/// The letter came from another host.
const REMOTE: u8 = 1 << 1;
/// The outcome is the one reported to the sender.
const SENDER: u8 = 1 << 2;
/// The message has content, of the length in the header.
const CONTENT: u8 = 1 << 3;

#[derive(Debug, Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout, Unaligned)]
#[repr(C)]
struct Header {
    magic: [u8; 4],
    version: u8,
    kind: u8,
    via: u8,
    flags: u8,
    sender: U64,
    receiver: U64,
    sequence: U64,
    submission: U64,
    /// Nanoseconds since 1970.
    at: U64,
    lost: U64,
    size: U64,
    content_len: U64,
    name_len: U32,
    envelope_len: U32,
    message_len: U32,
    content_given: U32,
    outcome_len: U32,
    reserved: U32,
}

const HEADER_LEN: usize = size_of::<Header>();

/// A record of a process.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Time of the event, by the clock of this host.
    pub at: SystemTime,
    /// Number of records that this process could not send to this watcher so far.
    pub lost: u64,
    /// The event.
    pub body: RecordBody,
}

/// The kinds of records.
#[derive(Debug, Clone, PartialEq)]
pub enum RecordBody {
    /// The first record of a process.
    Hello {
        /// The name of its message transport service.
        name: Arc<str>,
        /// Incarnation of the service.
        incarnation: Incarnation,
        /// Whether it is the gateway.
        gateway: bool,
    },
    /// A letter passes.
    Letter {
        /// The letter's identity.
        id: LetterId,
        /// Point of the route at which it is reported.
        place: Seen,
        /// Data of the letter.
        letter: SeenLetter,
    },
    /// A letter has an outcome.
    Settled {
        /// The letter's identity.
        id: LetterId,
        /// The outcome.
        outcome: Outcome,
        /// Whether the sender was told this outcome.
        sender: bool,
    },
    /// Only the number of lost records.
    Lost,
}

/// Identifies one letter to one receiver at all points of its route.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LetterId {
    /// Its stream.
    pub stream: Stream,
    /// Sequence number of the letter among all letters of the sender.
    pub sequence: u64,
}

/// Point of the route at which a letter is reported; see [`News`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seen {
    /// At its sender. Letters of one sender with the same number carry one message.
    Sent(Option<u64>),
    /// In the queue of its receiver, received by this transport.
    Taken(Option<Kind>),
    /// At a gateway, received by this transport.
    Passed(Kind, Origin),
}

/// Origin of a letter that passes a gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// This host.
    ThisHost,
    /// Another host.
    OtherHost,
}

/// Reported data of a letter. Several records report the same letter, so its parts are decoded by the receiver of the
/// first one only.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenLetter {
    /// Name of the receiver, envelope, message and content.
    parts: Bytes,
    name_len: usize,
    envelope_len: usize,
    message_len: usize,
    /// Length of the content in bytes, if the message has content.
    pub content_len: Option<u64>,
    /// Length of envelope and message in bytes, content included.
    pub size: u64,
}

/// A watcher's request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Wish {
    /// Maximum length of the reported content in bytes, up to [`MAX_CONTENT`]; zero for none.
    pub content: u32,
}

/// Error of [`Record::parse`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// The magic number is missing.
    #[error("not a record: {0} bytes without the magic number")]
    NotARecord(usize),
    /// The record has another version.
    #[error(
        "the record has version {0}, and this watcher reads version {VERSION}; use the fipa of the version \
         that the watched process was built with"
    )]
    Version(u8),
    /// The kind is unknown.
    #[error("unknown kind of record: {0}")]
    Kind(u8),
    /// The lengths in the header do not match the datagram.
    #[error("the header announces {announced} bytes, and there are {found}")]
    Length {
        /// Length according to the header.
        announced: u64,
        /// Actual length.
        found: usize,
    },
    /// A part is malformed.
    #[error("the {0} of a record is malformed")]
    Part(&'static str),
}

impl Header {
    fn new(kind: u8, at: SystemTime) -> Self {
        let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
        Self {
            magic: MAGIC,
            version: VERSION,
            kind,
            via: NO_TRANSPORT,
            at: U64::new(u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)),
            ..Self::new_zeroed()
        }
    }

    fn new_zeroed() -> Self {
        zerocopy::FromZeros::new_zeroed()
    }

    fn parts(&self) -> [u32; 5] {
        let lens = [
            self.name_len,
            self.envelope_len,
            self.message_len,
            self.content_given,
            self.outcome_len,
        ];
        lens.map(U32::get)
    }
}

/// Builds the greeting of a process.
#[must_use]
pub fn hello(name: &str, incarnation: Incarnation, gateway: bool, at: SystemTime) -> Vec<u8> {
    let mut header = Header::new(HELLO, at);
    header.sender = U64::new(incarnation.as_u64());
    header.flags = if gateway { GATEWAY } else { 0 };
    written(
        header,
        [
            wire::truncated(name, Parcel::MAX_NAME).as_bytes(),
            b"",
            b"",
            b"",
            b"",
        ],
    )
}

/// Builds a record without an event, to report the number of lost records.
#[must_use]
pub fn lost(at: SystemTime) -> Vec<u8> {
    written(Header::new(LOST, at), [b""; 5])
}

/// Builds the record of a notice, for a watcher with this request.
#[must_use]
pub fn of(notice: &Notice, request: Wish, at: SystemTime) -> Vec<u8> {
    let kind = match &notice.news {
        News::Sent { .. } => SENT,
        News::Taken { .. } => TAKEN,
        News::Passed { .. } => PASSED,
        News::Settled { .. } => SETTLED,
    };
    let mut header = Header::new(kind, at);
    header.sender = U64::new(notice.stream.sender.as_u64());
    header.receiver = U64::new(notice.stream.receiver.as_u64());
    header.sequence = U64::new(notice.sequence);
    let letter = match &notice.news {
        News::Sent { submission, letter } => {
            header.submission = U64::new(submission.map_or(0, |submission| submission.0));
            letter
        }
        News::Taken { via, letter } => {
            header.via = via.map_or(NO_TRANSPORT, wire::kind_code);
            letter
        }
        News::Passed {
            via,
            remote,
            letter,
        } => {
            header.via = wire::kind_code(*via);
            header.flags |= if *remote { REMOTE } else { 0 };
            letter
        }
        News::Settled { outcome, sender } => {
            header.flags |= if *sender { SENDER } else { 0 };
            let mut written_outcome = wire::write_outcome(outcome);
            if written_outcome.len() > MAX_PART {
                // Long reasons of many attempts are dropped; the outcome matters more.
                let brief = without_attempts(outcome);
                written_outcome = brief.map_or(written_outcome, |it| wire::write_outcome(&it));
            }
            let name = notice.receiver.as_bytes();
            return written(header, [name, b"", b"", b"", &written_outcome]);
        }
    };
    written_letter(header, &notice.receiver, letter, request)
}

fn without_attempts(outcome: &Outcome) -> Option<Outcome> {
    let attempts = Vec::new();
    Some(match outcome {
        Outcome::Delivered { via, .. } => Outcome::Delivered {
            via: *via,
            attempts,
        },
        Outcome::Sent { via, .. } => Outcome::Sent {
            via: *via,
            attempts,
        },
        Outcome::Failed { reason, .. } => Outcome::Failed {
            reason: *reason,
            attempts,
        },
        _ => return None,
    })
}

fn written_letter(mut header: Header, receiver: &str, letter: &Letter, request: Wish) -> Vec<u8> {
    header.size = U64::new(letter.len() as u64);
    let envelope = letter.envelope();
    let envelope: &[u8] = if envelope.len() <= MAX_PART {
        &envelope
    } else {
        b""
    };
    let mut content = None;
    let message = Message::decode(letter.payload()).ok().map(|mut message| {
        content = message.take_content();
        message.to_payload().to_bytes()
    });
    let message = message.filter(|message| message.len() <= MAX_PART);
    if let Some(content) = &content {
        header.flags |= CONTENT;
        header.content_len = U64::new(content.len() as u64);
    }
    let content = content.unwrap_or_default();
    let given = usize::try_from(request.content).unwrap_or(MAX_CONTENT);
    let given = content.len().min(given).min(MAX_CONTENT);
    let (given, _) = content.split_at(given);
    let message = message.unwrap_or_default();
    written(
        header,
        [receiver.as_bytes(), envelope, &message, given, b""],
    )
}

/// Callers keep all parts within their limits, so that no length is truncated.
fn written(mut header: Header, parts: [&[u8]; 5]) -> Vec<u8> {
    let [name, envelope, message, content, outcome] =
        parts.map(|part| U32::new(u32::try_from(part.len()).unwrap_or(u32::MAX)));
    header.name_len = name;
    header.envelope_len = envelope;
    header.message_len = message;
    header.content_given = content;
    header.outcome_len = outcome;
    let mut out =
        Vec::with_capacity(HEADER_LEN + parts.iter().map(|part| part.len()).sum::<usize>());
    out.extend_from_slice(header.as_bytes());
    for part in parts {
        out.extend_from_slice(part);
    }
    out
}

/// Sets the number of lost records in a built record.
pub fn set_lost(record: &mut [u8], lost: u64) {
    if let Ok((header, _)) = Header::mut_from_prefix(record) {
        header.lost = U64::new(lost);
    }
}

impl Record {
    /// Parses a record.
    ///
    /// # Errors
    /// Fails when the bytes are not a record of this version, or a part is malformed.
    pub fn parse(bytes: &[u8]) -> Result<Self, RecordError> {
        let (header, parts) =
            Header::read_from_prefix(bytes).map_err(|_| RecordError::NotARecord(bytes.len()))?;
        if header.magic != MAGIC {
            return Err(RecordError::NotARecord(bytes.len()));
        }
        if header.version != VERSION {
            return Err(RecordError::Version(header.version));
        }
        let announced = header.parts().map(u64::from).iter().sum::<u64>() + HEADER_LEN as u64;
        if announced != bytes.len() as u64 {
            let found = bytes.len();
            return Err(RecordError::Length { announced, found });
        }
        let name = || name_of(beginning(parts, header.name_len));
        let body = match header.kind {
            HELLO => RecordBody::Hello {
                name: name()?.into(),
                incarnation: Incarnation::from_u64(header.sender.get()),
                gateway: header.flags & GATEWAY != 0,
            },
            SENT | TAKEN | PASSED => {
                name()?;
                RecordBody::Letter {
                    id: header.id(),
                    place: header.place()?,
                    letter: header.letter(parts)?,
                }
            }
            SETTLED => {
                name()?;
                let before = parts.len() - beginning(parts, header.outcome_len).len();
                let (_, outcome) = parts.split_at(before);
                RecordBody::Settled {
                    id: header.id(),
                    outcome: wire::read_outcome(outcome).ok_or(RecordError::Part("outcome"))?,
                    sender: header.flags & SENDER != 0,
                }
            }
            LOST => RecordBody::Lost,
            other => return Err(RecordError::Kind(other)),
        };
        let since = Duration::from_nanos(header.at.get());
        Ok(Self {
            at: UNIX_EPOCH + since,
            lost: header.lost.get(),
            body,
        })
    }
}

/// The first bytes, at most all of them.
fn beginning(bytes: &[u8], len: U32) -> &[u8] {
    let len = usize::try_from(len.get()).unwrap_or(usize::MAX);
    bytes.get(..len).unwrap_or(bytes)
}

impl Header {
    fn id(&self) -> LetterId {
        LetterId {
            stream: Stream::between(
                Incarnation::from_u64(self.sender.get()),
                Incarnation::from_u64(self.receiver.get()),
            ),
            sequence: self.sequence.get(),
        }
    }

    fn place(&self) -> Result<Seen, RecordError> {
        let via = || wire::kind_of_code(self.via).ok_or(RecordError::Part("transport"));
        Ok(match self.kind {
            SENT => Seen::Sent(Some(self.submission.get()).filter(|submission| *submission != 0)),
            TAKEN if self.via == NO_TRANSPORT => Seen::Taken(None),
            TAKEN => Seen::Taken(Some(via()?)),
            _ if self.flags & REMOTE != 0 => Seen::Passed(via()?, Origin::OtherHost),
            _ => Seen::Passed(via()?, Origin::ThisHost),
        })
    }

    /// The letter with these parts, whose lengths add up.
    fn letter(&self, parts: &[u8]) -> Result<SeenLetter, RecordError> {
        let content_len = (self.flags & CONTENT != 0).then(|| self.content_len.get());
        let given = self.content_given.get();
        if u64::from(given) > content_len.unwrap_or(0) || given as usize > MAX_CONTENT {
            return Err(RecordError::Part("content"));
        }
        let [name_len, envelope_len, message_len, ..] = self.parts().map(|len| len as usize);
        let outcome_len = self.outcome_len.get() as usize;
        let letter = parts.get(..parts.len().saturating_sub(outcome_len));
        Ok(SeenLetter {
            parts: Bytes::copy_from_slice(letter.unwrap_or(parts)),
            name_len,
            envelope_len,
            message_len,
            content_len,
            size: self.size.get(),
        })
    }
}

impl SeenLetter {
    /// The bytes between two ends, which lie within the parts.
    fn part(&self, from: usize, len: usize) -> Bytes {
        let until = from.saturating_add(len).min(self.parts.len());
        self.parts.slice(from.min(until)..until)
    }

    /// The name of the receiver.
    #[must_use]
    pub fn receiver(&self) -> &str {
        let name = self.parts.get(..self.name_len).unwrap_or_default();
        // It was checked when the record was parsed.
        std::str::from_utf8(name).unwrap_or_default()
    }

    /// Its envelope; empty if it is too long.
    #[must_use]
    pub fn envelope(&self) -> SeenEnvelope {
        self.part(self.name_len, self.envelope_len).into()
    }

    /// Decodes the message without content; `None` if it is too long or malformed.
    #[must_use]
    pub fn decode_message(&self) -> Option<Message> {
        let message = self.part(self.name_len + self.envelope_len, self.message_len);
        Message::decode(&message.into()).ok()
    }

    /// The content or its beginning, up to the length that the watcher requested.
    #[must_use]
    pub fn content(&self) -> Bytes {
        let before = self.name_len + self.envelope_len + self.message_len;
        self.part(before, usize::MAX)
    }
}

fn name_of(name: &[u8]) -> Result<&str, RecordError> {
    if name.is_empty() || name.len() > Parcel::MAX_NAME {
        return Err(RecordError::Part("name"));
    }
    std::str::from_utf8(name).map_err(|_| RecordError::Part("name"))
}

impl Wish {
    /// Length of an encoded request, in bytes.
    pub const LEN: usize = 10;

    /// Encodes the request.
    #[must_use]
    pub fn to_bytes(self) -> [u8; Self::LEN] {
        let mut bytes = [0; Self::LEN];
        let (head, content) = bytes.split_at_mut(6);
        head.copy_from_slice(&[&MAGIC[..], &[VERSION, REQUEST]].concat());
        content.copy_from_slice(&self.content.to_le_bytes());
        bytes
    }

    /// Parses a request; `None` if the bytes are not one.
    #[must_use]
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let (head, content) = bytes.split_at_checked(6)?;
        let understood = head.strip_prefix(&MAGIC)? == [VERSION, REQUEST];
        let content = u32::from_le_bytes(content.try_into().ok()?);
        understood.then_some(Self { content })
    }
}

#[cfg(test)]
mod tests;
