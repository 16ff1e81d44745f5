//! From a message to a letter: the envelope that a sender puts around it.

use std::time::SystemTime;

use bytes::Bytes;
use fipa_acl::{
    AclRepresentation, EncodeError, Envelope, Letter, Message, Payload, Time, TimeError,
};

/// Why a message could not be made into a letter.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PostError {
    /// The clock of this host is beyond what an envelope can say.
    #[error("cannot date the envelope: {0}")]
    Time(#[from] TimeError),
    /// The message or its envelope cannot be encoded.
    #[error("cannot encode the letter: {0}")]
    Encode(#[from] EncodeError),
}

/// The letter with this message: bit-efficient message in a bit-efficient envelope of the
/// standard dialect, dated `utc`. The content is shared, not copied.
///
/// # Errors
/// When the message or its envelope cannot be encoded.
pub fn letter_for(message: &Message, utc: SystemTime) -> Result<Letter, PostError> {
    let payload = message.to_payload();
    let envelope = envelope_for(message, payload.len(), utc)?;
    Ok(Letter::new(envelope, payload))
}

/// The letter with this message around content that was filled in before, in memory of its own;
/// a content of the message itself is not looked at.
///
/// # Errors
/// When the message or its envelope cannot be encoded.
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
