//! Collects the notes of a reader as spans.

use crate::bitefficient::notes::Notes;
use crate::explain::{Explanation, Span};

/// The spans so far.
#[derive(Debug, Default)]
pub(super) struct Record {
    spans: Vec<Span>,
    /// Offset of the end of the last span.
    end: usize,
    depth: usize,
    /// The length field of the current envelope.
    envelope_len: Option<EnvelopeLen>,
}

#[derive(Debug, Clone, Copy)]
struct EnvelopeLen {
    announced: usize,
    /// Offset of the envelope.
    start: usize,
    /// Index of the span of the length field.
    span: usize,
}

impl Record {
    /// Notes the meaning of a payload, which no reader reads and which ends at `end`.
    pub(super) fn payload(&mut self, end: usize, meaning: impl FnOnce() -> String) {
        let mut notes = self;
        notes.note(end, meaning);
    }

    /// Notes that an error at this offset ended the reading.
    pub(super) fn incomplete(&mut self, offset: usize) {
        let mut notes = self;
        notes.note(offset, || "incomplete, ended by the error".to_owned());
    }

    pub(super) fn into_spans(self) -> Vec<Span> {
        self.spans
    }
}

impl Notes for &mut Record {
    fn note(&mut self, end: usize, meaning: impl FnOnce() -> String) {
        let Some(len) = end.checked_sub(self.end).filter(|len| *len > 0) else {
            return;
        };
        let offset = std::mem::replace(&mut self.end, end);
        let full = self.spans.len() >= Explanation::MAX_SPANS;
        match self.spans.last_mut() {
            Some(last) if full => {
                last.len += len;
                "the remaining bytes, not explained".clone_into(&mut last.meaning);
            }
            _ => self.spans.push(Span {
                offset,
                len,
                depth: self.depth,
                meaning: meaning(),
            }),
        }
    }

    fn deeper(&mut self) {
        self.depth += 1;
    }

    fn shallower(&mut self) {
        self.depth = self.depth.saturating_sub(1);
    }

    fn note_envelope_len(&mut self, end: usize, announced: usize) {
        // The byte in front of the length begins the envelope.
        let start = self.end.saturating_sub(1);
        self.note(end, || format!("EnvLen: {announced} bytes"));
        let span = self.spans.len().saturating_sub(1);
        self.envelope_len = Some(EnvelopeLen {
            announced,
            start,
            span,
        });
    }

    fn note_envelope_end(&mut self, end: usize, meaning: &'static str) {
        self.note(end, || meaning.to_owned());
        let Some(length) = self.envelope_len.take() else {
            return;
        };
        let (announced, found) = (length.announced, end - length.start);
        // The last possible span stands for several items.
        if length.span + 1 < Explanation::MAX_SPANS
            && found != announced
            && let Some(span) = self.spans.get_mut(length.span)
        {
            span.meaning = format!("EnvLen: {announced} bytes, but {found} found (ignored)");
        }
    }
}
