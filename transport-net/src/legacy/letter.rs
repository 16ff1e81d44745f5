//! Letters of legacy peers as they arrive: an envelope, bit-efficient or XML, with the message behind
//! it.

use bytes::Bytes;
use fipa_acl::{DecodeError, EncodeError, Envelope, Letter};
use fipa_transport::Signature;

use super::envelope::{signature_of, with_stamped_extensions};

/// The reason for which the bytes are no letter.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum LetterError {
    #[error("its envelope cannot be decoded: {0}")]
    Envelope(#[from] DecodeError),
    #[error("its envelope cannot be encoded in the standard dialect: {0}")]
    Standard(#[from] EncodeError),
}

/// Divides a letter, and converts its envelope to the standard dialect; the message is unchanged.
/// Returns the letter with the dialect of its writer.
pub(crate) fn standard(whole: &Bytes) -> Result<(Letter, Signature), LetterError> {
    let (envelope, length) = Envelope::decode(whole)?;
    let length = length.min(whole.len());
    let signature = signature_of(whole.get(..length).unwrap_or_default());
    let message = whole.slice(length..);
    let envelope = with_stamped_extensions(envelope).encode_standard()?;
    Ok((Letter::new(envelope, message), signature))
}
