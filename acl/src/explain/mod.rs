//! Explains every byte of a bit-efficient message, envelope or letter, for people.
//!
//! This module has no grammar of its own. The readers that decode take notes
//! ([`Notes`](crate::bitefficient::notes::Notes)), and this module collects them.

mod record;

use crate::bitefficient::{code, notes, view_noting};
use crate::explain::record::Record;
use crate::{DecodeError, EnvelopeView, Representation};

/// A span of bytes and its meaning.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Span {
    /// Offset of its first byte in the explained bytes.
    pub offset: usize,
    /// Number of bytes, at least 1.
    pub len: usize,
    /// Nesting depth. The parts of an agent identifier are deeper than the identifier.
    pub depth: usize,
    /// Meaning in the terms of the standards: one line without control characters. A long text is
    /// truncated.
    pub meaning: String,
}

/// The meaning of bytes: see [`explain`].
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Explanation {
    /// The spans in the order of their offsets, without gaps. The first one begins at offset 0. The
    /// last one ends with the bytes or, if there is an [`error`](Self::error), at its offset. There
    /// are at most [`MAX_SPANS`](Self::MAX_SPANS).
    pub spans: Vec<Span>,
    /// The error of decoding the bytes, if any. Its offset is relative to all explained bytes.
    pub error: Option<DecodeError>,
}

impl Explanation {
    /// Maximum number of spans. The last one covers all remaining bytes.
    pub const MAX_SPANS: usize = 1 << 16;
}

/// Explains a message (FIPA00069), or an envelope (FIPA00088) and the message behind it, byte by
/// byte. All dialects are accepted.
///
/// A message behind an envelope is explained if it is bit-efficient. Any other payload is one span.
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
        Some(&(code::envelope::EXTENSION | code::envelope::BASE)) => letter(bytes, &mut record),
        _ => message(bytes, 0, &mut record),
    };
    let error = read.err();
    if let Some(error) = &error {
        record.incomplete(error.offset().min(bytes.len()));
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
