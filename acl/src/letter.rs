//! The letter: an encoded envelope followed by an encoded message, as a few [`Bytes`].
//!
//! This module handles the order of the pieces. The modules of the encodings handle the bytes of
//! envelope and message.

use bytes::{BufMut, Bytes, BytesMut};

/// An encoded message, in up to three consecutive pieces.
///
/// A message with content in loaned memory consists of `head` (all bytes up to the content,
/// including its length field), `content` and `tail` (the bytes behind the content; in FIPA00069 one
/// byte, `01`). A message in one piece has only a `head`.
///
/// `content` may be in memory that another process of the same user can still write to. The other
/// two pieces are always private to this process.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Payload {
    /// The message up to its content, or the whole message.
    pub head: Bytes,
    /// The bytes of the content, or empty if `head` is the whole message.
    pub content: Bytes,
    /// The bytes behind the content, or empty if `head` is the whole message.
    pub tail: Bytes,
}

impl Payload {
    /// Total length in bytes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.head.len() + self.content.len() + self.tail.len()
    }

    /// Whether the payload has no bytes. An envelope may be sent alone.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether the message is split around its content: see [`Payload`].
    #[must_use]
    pub fn is_split(&self) -> bool {
        !(self.content.is_empty() && self.tail.is_empty())
    }

    /// Returns the message in one piece. A split message is copied.
    #[must_use]
    pub fn to_bytes(&self) -> Bytes {
        if self.is_split() {
            concat(&[&self.head, &self.content, &self.tail])
        } else {
            self.head.clone()
        }
    }
}

impl From<Bytes> for Payload {
    fn from(head: Bytes) -> Self {
        Self {
            head,
            content: Bytes::new(),
            tail: Bytes::new(),
        }
    }
}

/// An encoded envelope and the encoded message behind it.
///
/// Cloning shares the memory. A letter is immutable, except that a message transport service may
/// add its stamp ([`Letter::stamped`]).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Letter {
    /// Extension envelopes added since the letter was made, newest first. FIPA00088 2.2: "by adding a
    /// new ExtEnvelope element at the beginning of the messageEnvelopes sequence."
    stamps: Vec<Bytes>,
    envelope: Bytes,
    payload: Payload,
}

impl Letter {
    /// Creates a letter of an encoded envelope (any extension envelopes and the base envelope) and
    /// an encoded message.
    #[must_use]
    pub fn new(envelope: Bytes, payload: impl Into<Payload>) -> Self {
        Self {
            stamps: Vec::new(),
            envelope,
            payload: payload.into(),
        }
    }

    /// Maximum [length around the content](Self::around_len) of a letter that is sent, in bytes.
    pub const MAX_AROUND: usize = 1 << 20;

    /// Adds an encoded extension envelope in front of the letter. Nothing is copied.
    #[must_use]
    pub fn stamped(mut self, extension: Bytes) -> Self {
        self.stamps.insert(0, extension);
        self
    }

    /// Returns the letter with other content: bytes of the length that the payload announces. Nothing
    /// is copied.
    #[must_use]
    pub fn with_content(mut self, content: Bytes) -> Self {
        self.payload.content = content;
        self
    }

    /// The encoded envelope with all stamps. It is copied if a stamp was added to the letter.
    #[must_use]
    pub fn envelope(&self) -> Bytes {
        if self.stamps.is_empty() {
            return self.envelope.clone();
        }
        let pieces: Vec<&Bytes> = self.stamps.iter().chain([&self.envelope]).collect();
        concat(&pieces)
    }

    /// Length of the encoded envelope with all stamps, in bytes.
    #[must_use]
    pub fn envelope_len(&self) -> usize {
        self.stamps.iter().map(Bytes::len).sum::<usize>() + self.envelope.len()
    }

    /// The encoded message.
    #[must_use]
    pub fn payload(&self) -> &Payload {
        &self.payload
    }

    /// Returns the encoded message by value.
    #[must_use]
    pub fn into_payload(self) -> Payload {
        self.payload
    }

    /// Total length in bytes, envelope and message.
    #[must_use]
    pub fn len(&self) -> usize {
        self.envelope_len() + self.payload.len()
    }

    /// Length in bytes without the content: the envelope with all stamps, and the message before and
    /// behind its content. A message in one piece counts as a whole.
    #[must_use]
    pub fn around_len(&self) -> usize {
        self.envelope_len() + self.payload.head.len() + self.payload.tail.len()
    }

    /// Whether the letter has no bytes.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The non-empty pieces in wire order, for vectored writes.
    pub fn pieces(&self) -> impl Iterator<Item = &Bytes> {
        let Payload {
            head,
            content,
            tail,
        } = &self.payload;
        self.stamps
            .iter()
            .chain([&self.envelope, head, content, tail])
            .filter(|piece| !piece.is_empty())
    }

    /// Copies the whole letter into one piece of memory.
    #[must_use]
    pub fn to_bytes(&self) -> Bytes {
        let pieces: Vec<&Bytes> = self.pieces().collect();
        concat(&pieces)
    }
}

fn concat(pieces: &[&Bytes]) -> Bytes {
    let mut all = BytesMut::with_capacity(pieces.iter().map(|piece| piece.len()).sum());
    for piece in pieces {
        all.put_slice(piece);
    }
    all.freeze()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stamp_is_added_in_front_without_a_copy() {
        let payload = Bytes::from_static(b"message");
        let letter = Letter::new(Bytes::from_static(b"base"), payload.clone())
            .stamped(Bytes::from_static(b"old"))
            .stamped(Bytes::from_static(b"new"));
        assert_eq!(letter.envelope(), "newoldbase");
        assert_eq!(letter.envelope_len(), 10);
        assert_eq!(letter.to_bytes(), "newoldbasemessage");
        assert_eq!(letter.payload().head.as_ptr(), payload.as_ptr());
    }

    #[test]
    fn the_pieces_of_a_split_message_are_in_order() {
        let payload = Payload {
            head: Bytes::from_static(b"head"),
            content: Bytes::from_static(b"content"),
            tail: Bytes::from_static(b"\x01"),
        };
        assert!(payload.is_split());
        assert_eq!(payload.to_bytes(), "headcontent\x01");
        let letter = Letter::new(Bytes::from_static(b"e"), payload);
        assert_eq!(letter.pieces().count(), 4);
        assert_eq!((letter.len(), letter.around_len()), (13, 6));
    }
}
