//! The letter: an encoded envelope followed by an encoded message, held as a few [`Bytes`].
//!
//! Letters are what everything else in this project passes around. This module knows how the
//! pieces lie behind each other; what is inside the envelope and the message is the business of
//! the encodings.

use bytes::{BufMut, Bytes, BytesMut};

/// An encoded message, in up to three pieces that follow each other on the wire.
///
/// A message that was written around loaned memory consists of `head` (everything up to and
/// including the length field of the content), `content` and `tail` (what follows the content;
/// one byte, `01`, in FIPA00069). A message that came as one piece is all `head`.
///
/// `content` may lie in memory that another process of the same user can still write to; the
/// other two pieces are always private to this process.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Payload {
    /// The message up to where its content begins, or the whole message.
    pub head: Bytes,
    /// The bytes of the content parameter, or empty when `head` is the whole message.
    pub content: Bytes,
    /// What follows the content, or empty when `head` is the whole message.
    pub tail: Bytes,
}

impl Payload {
    /// Total length in bytes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.head.len() + self.content.len() + self.tail.len()
    }

    /// Whether there are no bytes at all (an envelope may travel alone).
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether the message is split around its content (see the type's documentation).
    #[must_use]
    pub fn is_split(&self) -> bool {
        !(self.content.is_empty() && self.tail.is_empty())
    }

    /// The message as one piece: without a copy when it is one already.
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
/// Cloning shares the memory. A letter never changes, except that a message transport service may
/// put its stamp in front ([`Letter::stamped`]).
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Letter {
    /// Extension envelopes added since the letter was made, newest first (FIPA00088: the newest
    /// stands in front).
    stamps: Vec<Bytes>,
    envelope: Bytes,
    payload: Payload,
}

impl Letter {
    /// A letter from an encoded envelope (the base envelope with the extension envelopes in front
    /// of it, if any) and an encoded message.
    #[must_use]
    pub fn new(envelope: Bytes, payload: impl Into<Payload>) -> Self {
        Self {
            stamps: Vec::new(),
            envelope,
            payload: payload.into(),
        }
    }

    /// The same letter with one more encoded extension envelope in front. Nothing is copied.
    #[must_use]
    pub fn stamped(mut self, extension: Bytes) -> Self {
        self.stamps.insert(0, extension);
        self
    }

    /// The encoded envelope with all stamps: without a copy unless a stamp was added since the
    /// letter was made.
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

    /// The encoded message, by value.
    #[must_use]
    pub fn into_payload(self) -> Payload {
        self.payload
    }

    /// Total length in bytes, envelope and message.
    #[must_use]
    pub fn len(&self) -> usize {
        self.envelope_len() + self.payload.len()
    }

    /// Whether the letter has no bytes at all.
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

    /// The whole letter as one piece of memory (one copy).
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
    fn a_stamp_goes_in_front_and_nothing_moves() {
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
    fn a_split_message_is_its_pieces_in_order() {
        let payload = Payload {
            head: Bytes::from_static(b"head"),
            content: Bytes::from_static(b"content"),
            tail: Bytes::from_static(b"\x01"),
        };
        assert!(payload.is_split());
        assert_eq!(payload.to_bytes(), "headcontent\x01");
        let letter = Letter::new(Bytes::from_static(b"e"), payload);
        assert_eq!(letter.pieces().count(), 4);
        assert_eq!(letter.len(), 13);
    }
}
