//! Records: what a process tells a watcher of a letter. Each is one datagram.
//!
//! ```text
//! record := header(96 bytes) name envelope message content outcome
//! ```
//! The header has a magic number, the version and the lengths of the parts, all integers
//! little-endian. `name` is that of the receiver (in a greeting: of the message transport service
//! that tells); `envelope` is as it was in the letter; `message` is the bit-efficient encoding
//! (FIPA00069) of the message without its content, whatever it was encoded as; `content` is the
//! beginning of it, if the watcher has asked for that; `outcome` is that of
//! [`wire::write_outcome`]. What is absent has no length.
//!
//! The other way goes one datagram, the [`Wish`]: what the watcher wants to be told.

use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use fipa_acl::{Envelope, Letter, Message};
use fipa_transport::{Incarnation, Kind, Outcome, Parcel, Stream, wire};
use zerocopy::little_endian::{U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::core::{News, Notice};

/// Largest record, in bytes.
pub const MAX_LEN: usize = 64 * 1024;
/// Most bytes of content in a record.
pub const MAX_CONTENT: usize = 24 * 1024;
/// Longest envelope, and longest message without its content: what is longer is left out.
const MAX_PART: usize = 16 * 1024;

const MAGIC: [u8; 4] = *b"fipw";
/// Of the whole format: a watcher understands its own only.
const VERSION: u8 = 1;

const WISH: u8 = 0;
const HELLO: u8 = 1;
const SENT: u8 = 2;
const TAKEN: u8 = 3;
const PASSED: u8 = 4;
const SETTLED: u8 = 5;
const LOST: u8 = 6;

const NO_WAY: u8 = u8::MAX;

/// The one who tells is a gateway.
const GATEWAY: u8 = 1;
/// The letter came from another host.
const REMOTE: u8 = 1 << 1;
/// The outcome is what the sender is told.
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
    send: U64,
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

/// What a process tells.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// When it happened, by the clock of this host.
    pub at: SystemTime,
    /// How many records this process could not hand to this watcher so far.
    pub lost: u64,
    /// What happened.
    pub body: RecordBody,
}

/// The kinds of records.
#[derive(Debug, Clone, PartialEq)]
pub enum RecordBody {
    /// The first record of a process.
    Hello {
        /// The name of its message transport service.
        name: Arc<str>,
        /// This life of it.
        incarnation: Incarnation,
        /// Whether it is the gateway.
        gateway: bool,
    },
    /// A letter passes.
    Letter {
        /// Which letter.
        id: LetterId,
        /// Where it is seen.
        place: Seen,
        /// The letter.
        letter: Box<SeenLetter>,
    },
    /// A letter has an outcome.
    Settled {
        /// Which letter.
        id: LetterId,
        /// What became of it.
        outcome: Outcome,
        /// Whether that is what the sender is told.
        sender: bool,
    },
    /// Nothing else than how many records were lost.
    Lost,
}

/// One letter on its way to one receiver, wherever it passes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LetterId {
    /// Its stream.
    pub stream: Stream,
    /// Its position among all that the sender sends.
    pub sequence: u64,
    /// The name of the receiver.
    pub receiver: Arc<str>,
}

/// Where a letter is seen; see [`News`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seen {
    /// Where it begins its way. Letters of one sender with the same number are one message.
    Sent(Option<u64>),
    /// In the queue of its receiver, to which it came this way.
    Taken(Option<Kind>),
    /// At a gateway, to which it came this way.
    Passed(Kind, Origin),
}

/// Where a letter that passes a gateway comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Origin {
    /// This host.
    Here,
    /// Another host.
    Elsewhere,
}

/// What is told of a letter.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenLetter {
    /// Its envelope, unless that is very long or malformed.
    pub envelope: Option<Envelope>,
    /// Its message without content, unless that is very long or malformed.
    pub message: Option<Message>,
    /// Length of the content in bytes, if the message has any.
    pub content_len: Option<u64>,
    /// The content or, where it is longer, its beginning: as much as the watcher has asked for.
    pub content: Bytes,
    /// Length of envelope and message in bytes, content included.
    pub size: u64,
}

/// What a watcher wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Wish {
    /// Most bytes of content to be told, up to [`MAX_CONTENT`]; zero for none.
    pub content: u32,
}

/// Bytes that are no record.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// It does not begin as records do.
    #[error("not a record: {0} bytes that begin with something else")]
    NotARecord(usize),
    /// Written by another version.
    #[error(
        "a record of version {0}, and version {VERSION} is understood; use the fipa of the version \
         that the watched process was built with"
    )]
    Version(u8),
    /// The kind is none that we know.
    #[error("unknown kind of record: {0}")]
    Kind(u8),
    /// The lengths in the header do not add up.
    #[error("the header announces {announced} bytes, and there are {found}")]
    Length {
        /// What the header says.
        announced: u64,
        /// What is there.
        found: usize,
    },
    /// A part makes no sense.
    #[error("the {0} of a record cannot be read")]
    Part(&'static str),
}

impl Header {
    fn new(kind: u8, at: SystemTime) -> Self {
        let since = at.duration_since(UNIX_EPOCH).unwrap_or_default();
        Self {
            magic: MAGIC,
            version: VERSION,
            kind,
            via: NO_WAY,
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

/// The greeting of a process.
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

/// A record of nothing, to tell how many were lost.
#[must_use]
pub fn lost(at: SystemTime) -> Vec<u8> {
    written(Header::new(LOST, at), [b""; 5])
}

/// What has happened to a letter, for a watcher with this wish.
#[must_use]
pub fn of(notice: &Notice, wish: Wish, at: SystemTime) -> Vec<u8> {
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
        News::Sent { send, letter } => {
            header.send = U64::new(send.map_or(0, |send| send.0));
            letter
        }
        News::Taken { via, letter } => {
            header.via = via.map_or(NO_WAY, wire::kind_code);
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
                // Very long reasons for very many attempts; what became of the letter counts.
                let brief = without_attempts(outcome);
                written_outcome = brief.map_or(written_outcome, |it| wire::write_outcome(&it));
            }
            let name = notice.receiver.as_bytes();
            return written(header, [name, b"", b"", b"", &written_outcome]);
        }
    };
    written_letter(header, &notice.receiver, letter, wish)
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

fn written_letter(mut header: Header, receiver: &str, letter: &Letter, wish: Wish) -> Vec<u8> {
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
    let given = usize::try_from(wish.content).unwrap_or(MAX_CONTENT);
    let given = content.len().min(given).min(MAX_CONTENT);
    let (given, _) = content.split_at(given);
    let message = message.unwrap_or_default();
    written(
        header,
        [receiver.as_bytes(), envelope, &message, given, b""],
    )
}

/// All parts are within their limits here, so that no length is cut.
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

/// Writes into a record how many were lost before it.
pub fn set_lost(record: &mut [u8], lost: u64) {
    if let Ok((header, _)) = Header::mut_from_prefix(record) {
        header.lost = U64::new(lost);
    }
}

impl Record {
    /// The record in these bytes.
    ///
    /// # Errors
    /// When they are no record of this version, or a part of it makes no sense.
    pub fn parse(bytes: &Bytes) -> Result<Self, RecordError> {
        let (header, _) =
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
        let mut rest = bytes.slice(HEADER_LEN..);
        // Adds up, as was seen above.
        let [name, envelope, message, content, outcome] = header
            .parts()
            .map(|len| rest.split_to(rest.len().min(usize::try_from(len).unwrap_or(usize::MAX))));
        let body = match header.kind {
            HELLO => RecordBody::Hello {
                name: name_of(&name)?,
                incarnation: Incarnation::from_u64(header.sender.get()),
                gateway: header.flags & GATEWAY != 0,
            },
            SENT | TAKEN | PASSED => RecordBody::Letter {
                id: header.id(&name)?,
                place: header.place()?,
                letter: Box::new(header.letter(&envelope, message, content)?),
            },
            SETTLED => RecordBody::Settled {
                id: header.id(&name)?,
                outcome: wire::read_outcome(&outcome).ok_or(RecordError::Part("outcome"))?,
                sender: header.flags & SENDER != 0,
            },
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

impl Header {
    fn id(&self, name: &[u8]) -> Result<LetterId, RecordError> {
        Ok(LetterId {
            stream: Stream {
                sender: Incarnation::from_u64(self.sender.get()),
                receiver: Incarnation::from_u64(self.receiver.get()),
            },
            sequence: self.sequence.get(),
            receiver: name_of(name)?,
        })
    }

    fn place(&self) -> Result<Seen, RecordError> {
        let via = || wire::kind_of_code(self.via).ok_or(RecordError::Part("transport"));
        Ok(match self.kind {
            SENT => Seen::Sent(Some(self.send.get()).filter(|send| *send != 0)),
            TAKEN if self.via == NO_WAY => Seen::Taken(None),
            TAKEN => Seen::Taken(Some(via()?)),
            _ if self.flags & REMOTE != 0 => Seen::Passed(via()?, Origin::Elsewhere),
            _ => Seen::Passed(via()?, Origin::Here),
        })
    }

    fn letter(
        &self,
        envelope: &Bytes,
        message: Bytes,
        content: Bytes,
    ) -> Result<SeenLetter, RecordError> {
        // As it was in the letter, of which nobody has read more than was needed.
        let whole = |(decoded, len): (Envelope, usize)| (len == envelope.len()).then_some(decoded);
        let envelope = Envelope::decode(envelope).ok().and_then(whole);
        let message = match message.is_empty() {
            true => None,
            // Written by the process itself.
            false => {
                Some(Message::decode(&message.into()).map_err(|_| RecordError::Part("message"))?)
            }
        };
        let content_len = (self.flags & CONTENT != 0).then(|| self.content_len.get());
        if content.len() as u64 > content_len.unwrap_or(0) || content.len() > MAX_CONTENT {
            return Err(RecordError::Part("content"));
        }
        Ok(SeenLetter {
            envelope,
            message,
            content_len,
            content,
            size: self.size.get(),
        })
    }
}

fn name_of(name: &[u8]) -> Result<Arc<str>, RecordError> {
    if name.is_empty() || name.len() > Parcel::MAX_NAME {
        return Err(RecordError::Part("name"));
    }
    let name = std::str::from_utf8(name).map_err(|_| RecordError::Part("name"))?;
    Ok(name.into())
}

impl Wish {
    /// Length of a wish, in bytes.
    pub const LEN: usize = 10;

    /// The wish as a watcher sends it.
    #[must_use]
    pub fn to_bytes(self) -> [u8; Self::LEN] {
        let mut bytes = [0; Self::LEN];
        let (head, content) = bytes.split_at_mut(6);
        head.copy_from_slice(&[&MAGIC[..], &[VERSION, WISH]].concat());
        content.copy_from_slice(&self.content.to_le_bytes());
        bytes
    }

    /// The wish in these bytes; none when they are something else.
    #[must_use]
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let (head, content) = bytes.split_at_checked(6)?;
        let understood = head.strip_prefix(&MAGIC)? == [VERSION, WISH];
        let content = u32::from_le_bytes(content.try_into().ok()?);
        understood.then_some(Self { content })
    }
}

#[cfg(test)]
mod tests;
