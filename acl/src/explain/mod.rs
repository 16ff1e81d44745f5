//! What every byte of a bit-efficient message, envelope or letter means, for people.
//!
//! There is no second grammar here: the readers that decode say in passing what they read
//! ([`Notes`](crate::bitefficient::notes::Notes)), and this module writes it down.

mod record;

use crate::bitefficient::{notes, view_noting};
use crate::explain::record::Record;
use crate::{DecodeError, EnvelopeView, Representation};

/// A stretch of bytes and what it means.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Span {
    /// Where it begins, counted from the start of what is explained.
    pub offset: usize,
    /// How many bytes it has; at least one.
    pub len: usize,
    /// How deep it is nested: the parts of an agent identifier lie deeper than the identifier.
    pub depth: usize,
    /// What it means, in the words of the standards; on one line and without control characters.
    /// Of long texts only the beginning is repeated.
    pub meaning: String,
}

/// Bytes and their meaning: see [`explain`].
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Explanation {
    /// The spans in order. The first one begins at offset 0 and each where the one in front of it
    /// ends; together they are all bytes, or with an [`error`](Self::error) those up to it. There
    /// are at most [`MAX_SPANS`](Self::MAX_SPANS).
    pub spans: Vec<Span>,
    /// Why the bytes that follow the last span have no meaning: the error that decoding gives,
    /// with its offset in all of the bytes.
    pub error: Option<DecodeError>,
}

impl Explanation {
    /// Most spans that are told apart; the last of that many stands for all that follow.
    pub const MAX_SPANS: usize = 1 << 16;
}

/// Explains a message (FIPA00069), or an envelope (FIPA00088) and the message behind it, byte by
/// byte, in whatever dialect it is written.
///
/// A message behind an envelope is explained if it is bit-efficient; any other payload is one span.
///
/// ```
/// let explanation = fipa_acl::explain(b"\xfa\x10\x08\x01");
/// let meanings: Vec<_> = explanation.spans.iter().map(|span| &*span.meaning).collect();
/// assert_eq!(
///     meanings,
///     [
///         "message, bit-efficient, without code tables",
///         "version 1.0",
///         "performative: inform",
///         "end of message",
///     ]
/// );
/// assert_eq!(explanation.error, None);
/// ```
#[must_use]
pub fn explain(bytes: &[u8]) -> Explanation {
    let mut record = Record::default();
    let read = match bytes.first() {
        Some(0xfd | 0xfe) => letter(bytes, &mut record),
        _ => message(bytes, 0, &mut record),
    };
    let error = read.err();
    if let Some(error) = &error {
        record.broken_off(error.offset().min(bytes.len()));
    }
    Explanation {
        spans: record.into_spans(),
        error,
    }
}

fn message(bytes: &[u8], base: usize, record: &mut Record) -> Result<(), DecodeError> {
    view_noting(bytes, base, record).map(|_| ())
}

fn letter(bytes: &[u8], record: &mut Record) -> Result<(), DecodeError> {
    let envelope_len = EnvelopeView::parse_noting(bytes, &mut *record)?.len();
    let payload = bytes.get(envelope_len..).unwrap_or_default();
    match Representation::detect(payload) {
        Some(Representation::BitEfficient) => message(payload, envelope_len, record),
        other => {
            record.payload(bytes.len(), || {
                let begins = notes::content(payload);
                match other {
                    Some(representation) => {
                        format!(
                            "payload: a message in the {representation} representation: {begins}"
                        )
                    }
                    None => format!("payload in an unknown representation: {begins}"),
                }
            });
            Ok(())
        }
    }
}
