//! Writes down what readers remark.

use crate::bitefficient::notes::Notes;
use crate::explain::{Explanation, Span};

/// The spans so far.
#[derive(Debug, Default)]
pub(super) struct Record {
    spans: Vec<Span>,
    /// Where the last span ends.
    end: usize,
    depth: usize,
    /// The length that the current envelope says it has.
    envelope_len: Option<EnvelopeLen>,
}

#[derive(Debug, Clone, Copy)]
struct EnvelopeLen {
    said: usize,
    /// Where the envelope begins.
    start: usize,
    /// Which span it is.
    span: usize,
}

impl Record {
    /// What the bytes up to `end` mean, which no reader looks at.
    pub(super) fn payload(&mut self, end: usize, meaning: impl FnOnce() -> String) {
        let mut notes = self;
        notes.note(end, meaning);
    }

    /// An error at this offset ended the reading.
    pub(super) fn broken_off(&mut self, offset: usize) {
        let mut notes = self;
        notes.note(offset, || "begun, and broken off by the error".to_owned());
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
                "and so on, not told apart".clone_into(&mut last.meaning);
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

    fn note_envelope_len(&mut self, end: usize, said: usize) {
        // In front of the length there is the one byte that begins the envelope.
        let start = self.end.saturating_sub(1);
        self.note(end, || format!("EnvLen: {said} bytes"));
        let span = self.spans.len().saturating_sub(1);
        self.envelope_len = Some(EnvelopeLen { said, start, span });
    }

    fn note_envelope_end(&mut self, end: usize, meaning: &'static str) {
        self.note(end, || meaning.to_owned());
        let Some(EnvelopeLen { said, start, span }) = self.envelope_len.take() else {
            return;
        };
        let found = end - start;
        // One that is not told apart any more is not the place for it.
        if span + 1 < Explanation::MAX_SPANS
            && found != said
            && let Some(span) = self.spans.get_mut(span)
        {
            span.meaning = format!("EnvLen says {said}; {found} found (ignored)");
        }
    }
}
