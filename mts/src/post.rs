//! Converts a message to a letter with an envelope.

use std::time::SystemTime;

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, EncodeError, Envelope, Letter, Message, Payload, Time, TimeError,
};

/// Error of [`letter_for`] and [`LetterDraft`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PostError {
    /// The time is beyond the range of an envelope.
    #[error("cannot date the envelope")]
    Time(#[from] TimeError),
    /// The message or its envelope cannot be encoded.
    #[error("cannot encode the letter")]
    Encode(#[from] EncodeError),
}

/// Encodes a message as a letter: a bit-efficient message in a bit-efficient envelope of the
/// standard dialect, dated `utc`. The content is shared, not copied.
///
/// # Errors
/// Fails when the message or its envelope cannot be encoded.
pub fn letter_for(message: &Message, utc: SystemTime) -> Result<Letter, PostError> {
    let payload = message.to_payload();
    let envelope = envelope_for(message, payload.len(), utc)?;
    Ok(Letter::new(envelope, payload))
}

/// A letter whose content is written later, into memory that is loaned for it. The message is
/// encoded once, before, and its envelope has that date.
#[derive(Debug)]
pub struct LetterDraft {
    message: Message,
    /// The encoded message before and after the content.
    head: Bytes,
    tail: Bytes,
    content_len: usize,
    envelope: Bytes,
}

impl LetterDraft {
    /// Encodes the message around content of this length, in bytes, and an envelope dated `utc`. The
    /// message's own content is ignored.
    ///
    /// # Errors
    /// Fails when the message or its envelope cannot be encoded.
    pub fn new(message: Message, content_len: usize, utc: SystemTime) -> Result<Self, PostError> {
        let (head, tail) = message.around_content(content_len)?;
        let payload_len = head.len() + content_len + tail.len();
        let envelope = envelope_for(&message, payload_len, utc)?;
        Ok(Self {
            message,
            head,
            tail,
            content_len,
            envelope,
        })
    }

    /// The message, without the content to come.
    pub fn message(&self) -> &Message {
        &self.message
    }

    /// Length of envelope and message before the content, in bytes.
    #[must_use]
    pub fn head_len(&self) -> usize {
        self.envelope.len() + self.head.len()
    }

    /// Length of the message behind the content, in bytes.
    #[must_use]
    pub fn tail_len(&self) -> usize {
        self.tail.len()
    }

    /// Completes the letter. The content is shared, not copied; it has the length given before.
    ///
    /// # Panics
    /// Panics if the content has another length.
    #[must_use]
    pub fn complete(self, content: Bytes) -> (Message, Letter) {
        assert_eq!(content.len(), self.content_len, "the length of the content");
        let payload = Payload {
            head: self.head,
            content,
            tail: self.tail,
        };
        (self.message, Letter::new(self.envelope, payload))
    }
}

fn envelope_for(
    message: &Message,
    payload_len: usize,
    utc: SystemTime,
) -> Result<Bytes, PostError> {
    Ok(Envelope::encode_around(
        message.receivers(),
        message.sender(),
        &AclRepresentation::BitEfficient,
        payload_len as u64,
        Time::from_system_time(utc)?,
    )?)
}
