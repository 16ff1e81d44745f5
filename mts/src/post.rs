//! Converts a message to a letter with an envelope.

use std::time::SystemTime;

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, EncodeError, Envelope, Letter, Message, Payload, Time, TimeError,
};

/// Error of [`letter_for`] and [`letter_around`].
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

/// Encodes a message as a letter around separate content, which is shared, not copied. The
/// message's own content is ignored.
///
/// # Errors
/// Fails when the message or its envelope cannot be encoded.
pub fn letter_around(
    message: &Message,
    content: Bytes,
    utc: SystemTime,
) -> Result<Letter, PostError> {
    let (head, tail) = message.around_content(content.len())?;
    let payload = Payload {
        head,
        content,
        tail,
    };
    let envelope = envelope_for(message, payload.len(), utc)?;
    Ok(Letter::new(envelope, payload))
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
