//! Letters of bodies, and their digests.

use std::hash::Hasher;

use bytes::Bytes;
use fipa_acl::{DecodeError, EncodeError, Envelope, Letter, Representation};
use siphasher::sip128::{Hasher128, SipHasher24};

use super::multipart::{self, MultipartError};
use super::request::Status;
use crate::legacy::envelope::with_stamped_extensions;

/// The reason for which a body is no letter.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum LetterError {
    #[error(transparent)]
    Multipart(#[from] MultipartError),
    #[error("its envelope cannot be decoded: {0}")]
    Envelope(#[from] DecodeError),
    #[error("bytes follow its envelope")]
    Trailing,
    #[error("its envelope names no receiver")]
    NoReceiver,
    #[error("its envelope cannot be encoded in the standard dialect: {0}")]
    Standard(#[from] EncodeError),
}

impl LetterError {
    pub(super) fn status(&self) -> Status {
        match self {
            Self::Multipart(_)
            | Self::Envelope(_)
            | Self::Trailing
            | Self::NoReceiver
            | Self::Standard(_) => Status::BadRequest,
        }
    }
}

/// A letter with the parts that it was read from.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct BodyLetter {
    /// The letter with its envelope in the standard dialect.
    pub(super) letter: Letter,
    /// The name of the sender in the envelope.
    from: Option<String>,
    envelope: Bytes,
    payload: Bytes,
}

/// Reads the letter of a body.
///
/// # Errors
/// When the body has not two parts, or the first is no envelope with a receiver.
pub(crate) fn read(body: &Bytes, boundary: &[u8]) -> Result<BodyLetter, LetterError> {
    let parts = multipart::parse(body, boundary)?;
    let (first, payload) = (body.slice(parts.envelope), body.slice(parts.payload));
    let (envelope, length) = Envelope::decode(&first)?;
    let behind = first.get(length..).unwrap_or_default();
    if !behind.trim_ascii().is_empty() {
        return Err(LetterError::Trailing);
    }
    let effective = envelope.effective();
    if effective.to.is_empty() && effective.intended_receivers.is_empty() {
        return Err(LetterError::NoReceiver);
    }
    let from = effective.from.map(|from| from.name().to_owned());
    let charset = effective.payload_encoding.or(parts.charset);
    let message = in_utf8(payload.clone(), charset.as_deref());
    let envelope = with_stamped_extensions(envelope).encode_standard()?;
    Ok(BodyLetter {
        letter: Letter::new(envelope, message),
        from,
        envelope: first,
        payload,
    })
}

/// Returns a text payload in UTF-8. Of the character sets that are not a part of UTF-8, only
/// ISO-8859-1 is converted.
fn in_utf8(payload: Bytes, charset: Option<&str>) -> Bytes {
    let is_latin = charset.is_some_and(|charset| {
        ["ISO-8859-1", "ISO8859_1", "latin1"]
            .iter()
            .any(|name| charset.eq_ignore_ascii_case(name))
    });
    if !is_latin
        || payload.is_ascii()
        || Representation::detect(&payload) == Some(Representation::BitEfficient)
    {
        return payload;
    }
    let text: String = payload.iter().map(|byte| char::from(*byte)).collect();
    text.into()
}

impl BodyLetter {
    /// Whether the senders in the envelope and in the message have this property. An envelope without a
    /// sender has it; a message must have a sender.
    #[cfg(feature = "secure")]
    pub(super) fn is_of(&self, property: impl Fn(&str) -> bool) -> bool {
        let message = fipa_acl::Message::decode(self.letter.payload());
        let sender = message
            .ok()
            .and_then(|it| Some(it.sender()?.name().to_owned()));
        self.from.as_deref().is_none_or(&property) && sender.is_some_and(|name| property(&name))
    }

    /// Returns the digest by which a repetition of this letter is recognized: of its envelope, with
    /// sender, date and identifiers, and of its payload.
    pub(super) fn digest(&self, key: (u64, u64)) -> u128 {
        let mut hasher = SipHasher24::new_with_keys(key.0, key.1);
        hasher.write_usize(self.envelope.len());
        hasher.write(&self.envelope);
        hasher.write(&self.payload);
        hasher.finish128().as_u128()
    }
}
