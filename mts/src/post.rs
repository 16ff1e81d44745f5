//! Converts a message to a letter with an envelope.

use std::time::SystemTime;

use bytes::Bytes;
use fipa_acl::{EncodeError, EnvelopeTemplate, Letter, Message, Time, TimeError};

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
    /// The envelope, and the parameters of the message other than its content, are longer than
    /// [`Letter::MAX_AROUND`] together. Lengths are in bytes.
    #[error(
        "the letter would have {len} bytes besides its content, and at most {limit} are allowed; put \
         long values into the content, or send the message to fewer receivers at once"
    )]
    TooLong {
        /// Length of the letter without its content.
        len: usize,
        /// Maximum length of a letter without its content.
        limit: usize,
    },
}

/// Encodes a message as a letter: a bit-efficient message in a bit-efficient envelope of the
/// standard dialect, dated `utc`. The content is shared, not copied.
///
/// # Errors
/// Fails when the message or its envelope cannot be encoded.
pub fn letter_for(message: &Message, utc: SystemTime) -> Result<Letter, PostError> {
    checked(message.to_letter(Time::from_system_time(utc)?)?)
}

/// Encodes a message as [`letter_for`] does, with the envelope of the sender's latest letter as a template.
///
/// # Errors
/// See [`letter_for`].
pub fn letter_by(
    template: &mut EnvelopeTemplate,
    message: &Message,
    utc: SystemTime,
) -> Result<Letter, PostError> {
    checked(template.to_letter(message, Time::from_system_time(utc)?)?)
}

/// Returns the letter if its parts other than the content are not too long.
fn checked(letter: Letter) -> Result<Letter, PostError> {
    let (len, limit) = (letter.around_len(), Letter::MAX_AROUND);
    match len <= limit {
        true => Ok(letter),
        false => Err(PostError::TooLong { len, limit }),
    }
}

/// A letter whose content is written later, into memory that is loaned for it. The message is
/// encoded once, before, and its envelope has that date.
#[derive(Debug)]
pub struct LetterDraft {
    message: Message,
    /// The letter without the content.
    frame: Letter,
    content_len: usize,
}

impl LetterDraft {
    /// Encodes the message around content of this length, in bytes, and an envelope dated `utc`. The
    /// message's own content is ignored. The envelope of the sender's latest letter is a template.
    ///
    /// # Errors
    /// Fails when the message or its envelope cannot be encoded.
    pub fn new(
        message: Message,
        content_len: usize,
        utc: SystemTime,
        template: &mut EnvelopeTemplate,
    ) -> Result<Self, PostError> {
        let date = Time::from_system_time(utc)?;
        let frame = checked(template.to_letter_around(&message, content_len, date)?)?;
        Ok(Self {
            message,
            frame,
            content_len,
        })
    }

    /// The message, without the content to come.
    pub fn message(&self) -> &Message {
        &self.message
    }

    /// Length of envelope and message before the content, in bytes.
    #[must_use]
    pub fn head_len(&self) -> usize {
        self.frame.envelope_len() + self.frame.payload().head.len()
    }

    /// Length of the message behind the content, in bytes.
    #[must_use]
    pub fn tail_len(&self) -> usize {
        self.frame.payload().tail.len()
    }

    /// Completes the letter. The content is shared, not copied; it has the length given before.
    ///
    /// # Panics
    /// Panics if the content has another length.
    #[must_use]
    pub fn complete(self, content: Bytes) -> (Message, Letter) {
        assert_eq!(content.len(), self.content_len, "the length of the content");
        (self.message, self.frame.with_content(content))
    }
}
