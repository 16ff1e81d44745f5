//! The fixed layout of a parcel in a mailbox and in a network frame.
//!
//! A parcel is a [`ParcelHeader`] followed by a body: the receiver's name, then the content of the
//! [`Body`]. All integers are little-endian. A letter is its envelope, then the message in its
//! three pieces ([`Payload`]). [`write_report`] defines the bytes of a report, [`write_answer`] those of an answer. Credits and
//! predecessors have only the name.
//!
//! All input may come from a hostile peer: lengths are checked against the available bytes before
//! they are used, and no memory is allocated according to them.

mod answer;

use std::sync::Arc;
use std::time::Duration;

use bytes::{BufMut, Bytes, BytesMut};
use fipa_acl::{Letter, Payload};
use zerocopy::little_endian::{U16, U32, U64};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::{
    Arriving, Attempt, Body, FailureReason, Incarnation, Kind, Location, Outcome, Parcel, Realm,
    Report, Stream, TransportError, TransportErrorKind,
};

pub use self::answer::{MAX_ANSWER_LEN, answer_len, read_answer, write_answer};

/// The header of a parcel: [`HEADER_LEN`] bytes, little-endian.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, FromBytes, IntoBytes, Immutable, KnownLayout, Unaligned,
)]
#[repr(C)]
pub struct ParcelHeader {
    kind: u8,
    reserved: u8,
    name_len: U16,
    envelope_len: U32,
    head_len: U32,
    tail_len: U32,
    content_len: U64,
    realm: U64,
    sender: U64,
    receiver: U64,
    sequence: U64,
    after: U64,
    transfer: U64,
    remaining_us: U64,
}

/// Length of a [`ParcelHeader`] in bytes.
pub const HEADER_LEN: usize = size_of::<ParcelHeader>();

const LETTER: u8 = 1;
const REPORT: u8 = 2;
const CREDIT: u8 = 3;
const PREDECESSOR: u8 = 4;

/// Longest deadline on the wire: one hour. Longer ones are reduced to it.
pub const MAX_REMAINING: Duration = Duration::from_secs(60 * 60);

/// Bytes that are not a parcel.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum WireError {
    /// The kind of parcel is unknown.
    #[error("unknown kind of parcel: {0}")]
    UnknownKind(u8),
    /// The lengths in the header contradict the length of the body.
    #[error("the header announces a body of {announced} bytes, and there are {found}")]
    BodyLength {
        /// Length according to the header, in bytes.
        announced: u64,
        /// Actual length, in bytes.
        found: u64,
    },
    /// The name is empty, longer than [`Parcel::MAX_NAME`], or not UTF-8.
    #[error("the receiver's name is empty, too long, or not UTF-8")]
    Name,
    /// The body of a report is malformed.
    #[error("malformed report")]
    Report,
}

/// The body of a parcel, borrowed from it.
#[derive(Debug)]
pub struct Pieces<'a> {
    name: &'a str,
    letter: Option<&'a Letter>,
    report: Option<Bytes>,
}

impl Pieces<'_> {
    /// The pieces to be written after the header, in order, without empty ones.
    pub fn iter(&self) -> impl Iterator<Item = &[u8]> {
        std::iter::once(self.name.as_bytes()).chain(self.rest().map(|piece| &piece[..]))
    }

    fn rest(&self) -> impl Iterator<Item = &Bytes> {
        let letter = self.letter.into_iter().flat_map(Letter::pieces);
        letter.chain(&self.report)
    }
}

impl ParcelHeader {
    /// Returns the header of a parcel, and its body as pieces to be written after the header, in
    /// order and without empty ones. The memory of a letter is shared, not copied.
    ///
    /// # Errors
    /// Returns an error if the name, or a piece other than the content, is longer than the header
    /// can express.
    pub fn of(parcel: &Parcel) -> Result<(Self, Vec<Bytes>), WireError> {
        let (header, body) = Self::borrowing(parcel)?;
        let name = Bytes::copy_from_slice(body.name.as_bytes());
        let pieces = std::iter::once(name).chain(body.rest().cloned());
        Ok((header, pieces.collect()))
    }

    /// Returns the header of a parcel, and its body borrowed from it.
    ///
    /// # Errors
    /// Returns an error if the name, or a piece other than the content, is longer than the header
    /// can express.
    pub fn borrowing(parcel: &Parcel) -> Result<(Self, Pieces<'_>), WireError> {
        if parcel.receiver.is_empty() || parcel.receiver.len() > Parcel::MAX_NAME {
            return Err(WireError::Name);
        }
        let too_long = |len: usize| WireError::BodyLength {
            announced: len as u64,
            found: u64::from(u32::MAX),
        };
        let u32_of = |len: usize| u32::try_from(len).map(U32::new).map_err(|_| too_long(len));
        let mut header = Self {
            kind: CREDIT,
            reserved: 0,
            name_len: U16::new(parcel.receiver.len() as u16),
            envelope_len: U32::ZERO,
            head_len: U32::ZERO,
            tail_len: U32::ZERO,
            content_len: U64::ZERO,
            realm: U64::new(parcel.stream.realm.as_u64()),
            sender: U64::new(parcel.stream.sender.as_u64()),
            receiver: U64::new(parcel.stream.receiver.as_u64()),
            sequence: U64::new(parcel.sequence),
            after: U64::new(parcel.after),
            transfer: U64::new(parcel.transfer),
            remaining_us: U64::new(parcel.remaining.min(MAX_REMAINING).as_micros() as u64),
        };
        let mut pieces = Pieces {
            name: &parcel.receiver,
            letter: None,
            report: None,
        };
        match &parcel.body {
            Body::Letter(letter) => {
                header.kind = LETTER;
                header.envelope_len = u32_of(letter.envelope_len())?;
                header.head_len = u32_of(letter.payload().head.len())?;
                header.tail_len = u32_of(letter.payload().tail.len())?;
                header.content_len = U64::new(letter.payload().content.len() as u64);
                pieces.letter = Some(letter);
            }
            Body::Report(report) => {
                let body = write_report(report);
                header.kind = REPORT;
                header.head_len = u32_of(body.len())?;
                pieces.report = Some(body);
            }
            Body::Credit => {}
            Body::Predecessor => header.kind = PREDECESSOR,
        }
        Ok((header, pieces))
    }

    /// Length of the body after this header, in bytes. Untrusted until it has been compared with a
    /// limit.
    #[must_use]
    pub fn body_len(&self) -> u64 {
        // Cannot overflow for honest peers; saturates for others, so that the comparison fails.
        (u64::from(self.name_len.get()) + u64::from(self.envelope_len.get()))
            .saturating_add(u64::from(self.head_len.get()))
            .saturating_add(u64::from(self.tail_len.get()))
            .saturating_add(self.content_len.get())
    }

    /// Length of the pieces before the content, in bytes: name, envelope and head of the message.
    /// A receiver copies them out of shared memory before it reads them.
    #[must_use]
    pub fn front_len(&self) -> u64 {
        u64::from(self.name_len.get())
            + u64::from(self.envelope_len.get())
            + u64::from(self.head_len.get())
    }

    /// Length of the content, in bytes.
    #[must_use]
    pub fn content_len(&self) -> u64 {
        self.content_len.get()
    }

    /// Describes the arriving letter, if this is the header of a letter and `front` contains the
    /// pieces before its content. `None` also if they are malformed, which [`parcel`](Self::parcel)
    /// reports later.
    #[must_use]
    pub fn arriving<'a>(&self, front: &'a [u8]) -> Option<Arriving<'a>> {
        if self.kind != LETTER || front.len() as u64 != self.front_len() {
            return None;
        }
        let name = front.get(..usize::from(self.name_len.get()))?;
        Some(Arriving {
            receiver: std::str::from_utf8(name).ok()?,
            stream: self.stream(),
            front: front.len(),
            len: usize::try_from(self.content_len.get()).ok()?,
            tail: usize::try_from(self.tail_len.get()).ok()?,
        })
    }

    fn stream(&self) -> Stream {
        Stream {
            realm: Realm::from_u64(self.realm.get()),
            sender: Incarnation::from_u64(self.sender.get()),
            receiver: Incarnation::from_u64(self.receiver.get()),
        }
    }

    /// Returns the parcel with this header and a body in one piece. Copies only the name.
    ///
    /// # Errors
    /// Returns an error if the body does not match the header, or is malformed.
    pub fn parcel(&self, body: Bytes) -> Result<Parcel, WireError> {
        let (front, content, tail) = self.split(body)?;
        self.parcel_of_pieces(front, content, tail)
    }

    fn split(&self, mut body: Bytes) -> Result<(Bytes, Bytes, Bytes), WireError> {
        if self.body_len() != body.len() as u64 {
            return Err(WireError::BodyLength {
                announced: self.body_len(),
                found: body.len() as u64,
            });
        }
        let front = body.split_to(self.front_len() as usize);
        let content = body.split_to(self.content_len.get() as usize);
        Ok((front, content, body))
    }

    /// Returns the parcel with this header and a body in three pieces: the bytes before the content
    /// ([`front_len`](Self::front_len)), the content, and the bytes after it. Copies only the name.
    ///
    /// # Errors
    /// Returns an error if the body does not match the header, or is malformed.
    pub fn parcel_of_pieces(
        &self,
        mut front: Bytes,
        content: Bytes,
        tail: Bytes,
    ) -> Result<Parcel, WireError> {
        let fits = front.len() as u64 == self.front_len()
            && content.len() as u64 == self.content_len.get()
            && tail.len() as u64 == u64::from(self.tail_len.get());
        if !fits {
            let found = (front.len() + content.len() + tail.len()) as u64;
            return Err(WireError::BodyLength {
                announced: self.body_len(),
                found,
            });
        }
        let name = front.split_to(usize::from(self.name_len.get()));
        if name.is_empty() || name.len() > Parcel::MAX_NAME {
            return Err(WireError::Name);
        }
        let receiver: Arc<str> = std::str::from_utf8(&name)
            .map_err(|_| WireError::Name)?
            .into();
        let body = match self.kind {
            LETTER => {
                let envelope = front.split_to(self.envelope_len.get() as usize);
                Body::Letter(Letter::new(
                    envelope,
                    Payload {
                        head: front,
                        content,
                        tail,
                    },
                ))
            }
            REPORT => Body::Report(read_report(&front).ok_or(WireError::Report)?),
            CREDIT => Body::Credit,
            PREDECESSOR => Body::Predecessor,
            other => return Err(WireError::UnknownKind(other)),
        };
        Ok(Parcel {
            receiver,
            stream: self.stream(),
            sequence: self.sequence.get(),
            after: self.after.get(),
            transfer: self.transfer.get(),
            remaining: Duration::from_micros(self.remaining_us.get()).min(MAX_REMAINING),
            body,
        })
    }
}

/// Maximum number of attempts in a report. Older ones are omitted.
const MAX_ATTEMPTS: usize = 32;

/// The code of a failure reason in answers and reports: one byte, stable.
#[must_use]
pub fn reason_code(reason: FailureReason) -> u8 {
    position(&FailureReason::CODES, &reason)
}

/// The failure reason with this code.
#[must_use]
pub fn reason_of_code(code: u8) -> Option<FailureReason> {
    FailureReason::CODES.get(usize::from(code)).copied()
}

fn position<T: PartialEq>(all: &[T], item: &T) -> u8 {
    all.iter()
        .position(|other| other == item)
        .map_or(u8::MAX, |index| index as u8)
}

/// The tags of letters that are handed back; outcomes have lower tags.
const RETURNED: u8 = 3;
const MOVED: u8 = 4;

/// Writes the body of a report.
///
/// ```text
/// report   := outcome | returned | moved
/// outcome  := tag(0 delivered, 1 sent, 2 failed) code(kind or reason) n(attempts) attempt*
/// attempt  := kind fault location(u16 length, text) detail(u16 length, text)
/// returned := tag(3) uncertain(0 or 1)
/// moved    := tag(4) 0
/// ```
#[must_use]
pub fn write_report(report: &Report) -> Bytes {
    match report {
        Report::Settled(outcome) => write_outcome(outcome),
        Report::Returned { uncertain } => Bytes::copy_from_slice(&[RETURNED, u8::from(*uncertain)]),
        Report::Moved => Bytes::from_static(&[MOVED, 0]),
    }
}

/// Reads the body of a report. `None` if the bytes are malformed.
#[must_use]
pub fn read_report(bytes: &[u8]) -> Option<Report> {
    match bytes {
        [RETURNED, uncertain @ (0 | 1)] => Some(Report::Returned {
            uncertain: *uncertain == 1,
        }),
        [MOVED, 0] => Some(Report::Moved),
        [RETURNED | MOVED, ..] => None,
        outcome => read_outcome(outcome).map(Report::Settled),
    }
}

/// Writes an outcome in the format of [`write_report`].
#[must_use]
pub fn write_outcome(outcome: &Outcome) -> Bytes {
    let mut out = BytesMut::new();
    let (tag, code) = match outcome {
        Outcome::Delivered { via, .. } => (0, kind_code(*via)),
        Outcome::Sent { via, .. } => (1, kind_code(*via)),
        Outcome::Failed { reason, .. } => (2, reason_code(*reason)),
    };
    let attempts = outcome.attempts();
    let included = &attempts[attempts.len().saturating_sub(MAX_ATTEMPTS)..];
    out.put_slice(&[tag, code, included.len() as u8]);
    for Attempt {
        via,
        location,
        error,
    } in included
    {
        out.put_u8(kind_code(*via));
        let fault = match error.fault {
            // Earlier releases refuse a report with an unknown code.
            TransportErrorKind::Distrusted => TransportErrorKind::Refused,
            fault => fault,
        };
        out.put_u8(position(&TransportErrorKind::CODES, &fault));
        for text in [
            location.to_string().as_str(),
            truncated(&error.detail, 1024),
        ] {
            out.put_u16_le(text.len() as u16);
            out.put_slice(text.as_bytes());
        }
    }
    out.freeze()
}

/// Reads an outcome from untrusted bytes. `None` if they are malformed.
#[must_use]
pub fn read_outcome(bytes: &[u8]) -> Option<Outcome> {
    let (&[tag, code, count], mut rest) = bytes.split_first_chunk()?;
    if usize::from(count) > MAX_ATTEMPTS {
        return None;
    }
    let mut attempts = Vec::new();
    for _ in 0..count {
        let (&[kind, fault], after) = rest.split_first_chunk()?;
        rest = after;
        let location: Location = text(&mut rest)?.parse().ok()?;
        let detail = text(&mut rest)?.to_owned();
        let fault = *TransportErrorKind::CODES.get(usize::from(fault))?;
        attempts.push(Attempt {
            via: kind_of_code(kind)?,
            location,
            error: TransportError { fault, detail },
        });
    }
    if !rest.is_empty() {
        return None;
    }
    let outcome = match tag {
        0 => Outcome::Delivered {
            via: kind_of_code(code)?,
            attempts,
        },
        1 => Outcome::Sent {
            via: kind_of_code(code)?,
            attempts,
        },
        2 => Outcome::Failed {
            reason: reason_of_code(code)?,
            attempts,
        },
        _ => return None,
    };
    Some(outcome)
}

/// The code of a kind of transport: one byte, stable.
#[must_use]
pub fn kind_code(kind: Kind) -> u8 {
    position(&Kind::ALL, &kind)
}

/// The kind of transport with this code.
#[must_use]
pub fn kind_of_code(code: u8) -> Option<Kind> {
    Kind::ALL.get(usize::from(code)).copied()
}

fn text<'a>(rest: &mut &'a [u8]) -> Option<&'a str> {
    let (len, after) = rest.split_first_chunk()?;
    let (text, after) = after.split_at_checked(usize::from(u16::from_le_bytes(*len)))?;
    *rest = after;
    std::str::from_utf8(text).ok()
}

/// The text, truncated to at most `max` bytes at a character boundary.
#[must_use]
pub fn truncated(text: &str, max: usize) -> &str {
    &text[..text.floor_char_boundary(max)]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parcel(body: Body) -> Parcel {
        Parcel {
            receiver: "béla@home".into(),
            stream: Stream::between(Incarnation::from_u64(7), Incarnation::from_u64(u64::MAX)),
            sequence: 3,
            after: 2,
            transfer: 5,
            remaining: Duration::from_millis(1500),
            body,
        }
    }

    fn split_letter() -> Letter {
        Letter::new(
            Bytes::from_static(b"envelope"),
            Payload {
                head: Bytes::from_static(b"head"),
                content: Bytes::from_static(b"content"),
                tail: Bytes::from_static(b"\x01"),
            },
        )
        .stamped(Bytes::from_static(b"stamp"))
    }

    fn failed() -> Outcome {
        let attempts = vec![Attempt {
            via: Kind::Shm,
            location: "shm://1#0000000000000001".parse().unwrap(),
            error: TransportError::new(TransportErrorKind::Broken, "gone"),
        }];
        Outcome::Failed {
            reason: FailureReason::Loop,
            attempts,
        }
    }

    fn written(parcel: &Parcel) -> (ParcelHeader, Bytes) {
        let (header, pieces) = ParcelHeader::of(parcel).unwrap();
        (header, pieces.concat().into())
    }

    #[test]
    fn the_header_has_no_padding() {
        assert_eq!(HEADER_LEN, 80);
    }

    #[test]
    fn every_kind_of_body_round_trips() {
        for body in [
            Body::Letter(split_letter()),
            Body::Report(Report::Settled(failed())),
            Body::Report(Report::Returned { uncertain: false }),
            Body::Report(Report::Returned { uncertain: true }),
            Body::Report(Report::Moved),
            Body::Credit,
            Body::Predecessor,
        ] {
            let parcel = parcel(body);
            let (header, body) = written(&parcel);
            let read = header.parcel(body).unwrap();
            match (&read.body, &parcel.body) {
                (Body::Letter(read), Body::Letter(sent)) => {
                    assert_eq!(read.to_bytes(), sent.to_bytes());
                    assert_eq!(read.payload(), sent.payload());
                }
                (read, sent) => assert_eq!(read, sent),
            }
            let read = Parcel {
                body: parcel.body.clone(),
                ..read
            };
            assert_eq!(read, parcel);
        }
    }

    #[test]
    fn contradicting_lengths_are_refused() {
        let (header, body) = written(&parcel(Body::Letter(split_letter())));
        assert!(matches!(
            header.parcel(body.slice(..body.len() - 1)),
            Err(WireError::BodyLength { .. })
        ));
        let huge = ParcelHeader {
            content_len: U64::new(u64::MAX),
            ..header
        };
        assert_eq!(huge.body_len(), u64::MAX);
        assert!(matches!(
            huge.parcel(body),
            Err(WireError::BodyLength { .. })
        ));
    }

    #[test]
    fn names_and_kinds_are_checked() {
        let (header, body) = written(&parcel(Body::Credit));
        let unnamed = ParcelHeader {
            name_len: U16::ZERO,
            ..header
        };
        assert_eq!(unnamed.parcel(Bytes::new()), Err(WireError::Name));
        let unknown = ParcelHeader { kind: 9, ..header };
        assert_eq!(unknown.parcel(body), Err(WireError::UnknownKind(9)));
    }

    #[test]
    fn every_truncation_of_a_report_is_refused() {
        for report in [
            Report::Settled(failed()),
            Report::Returned { uncertain: true },
            Report::Moved,
        ] {
            let whole = write_report(&report);
            for len in 0..whole.len() {
                assert_eq!(read_report(&whole[..len]), None, "{len}");
            }
            assert_eq!(read_report(&whole), Some(report));
        }
        assert_eq!(read_report(&[RETURNED, 2]), None);
        assert_eq!(read_report(&[RETURNED, 0, 0]), None);
    }
}
