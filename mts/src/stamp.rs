//! Stamps, and other parts of an envelope that a message transport service reads.
//!
//! A stamp is an extension envelope with a `received` parameter (FIPA00067, FIPA00088): `by` is the
//! name of the service, `id` its incarnation. The gateways of two robots may have the same name, so
//! a service recognizes only a stamp with its own incarnation.

use std::time::SystemTime;

use fipa_acl::{
    DecodeError, EncodeError, Envelope, EnvelopeParams, EnvelopeView, Letter, Received, Time,
    TimeError,
};
use fipa_transport::Incarnation;

/// Error of [`put`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum StampError {
    /// The time is beyond the range of an envelope.
    #[error("cannot date the stamp: {0}")]
    Time(#[from] TimeError),
    /// The stamp cannot be encoded.
    #[error("cannot encode the stamp: {0}")]
    Encode(#[from] EncodeError),
}

/// The parts of an envelope that a service reads before it forwards the letter.
#[derive(Debug)]
pub(crate) struct EnvelopeParts {
    /// Whether the letter has the stamp of the service already.
    pub(crate) is_loop: bool,
    /// Number of stamps.
    pub(crate) stamps: usize,
    /// The name in the effective from parameter.
    pub(crate) sender: Option<String>,
}

/// Reads the envelope for the service with this name and incarnation.
pub(crate) fn read(
    letter: &Letter,
    name: &str,
    incarnation: Incarnation,
) -> Result<EnvelopeParts, DecodeError> {
    let envelope = letter.envelope();
    let view = EnvelopeView::parse(&envelope)?;
    let id = incarnation.to_string();
    let (mut is_loop, mut stamps) = (false, 0);
    for stamp in view.stamps() {
        stamps += 1;
        let is_own = stamp.by().as_str() == name;
        is_loop |= is_own && stamp.id().is_some_and(|it| it.as_str() == id);
    }
    let sender = view.from_name().map(|name| name.as_str().into_owned());
    Ok(EnvelopeParts {
        is_loop,
        stamps,
        sender,
    })
}

/// Adds the stamp of this service in front of the letter.
pub(crate) fn put(
    letter: Letter,
    name: &str,
    incarnation: Incarnation,
    utc: SystemTime,
) -> Result<Letter, StampError> {
    let received = Received {
        by: name.to_owned(),
        date: Time::from_system_time(utc)?,
        from: None,
        id: Some(incarnation.to_string()),
        via: None,
        user_defined: Vec::new(),
    };
    let params = EnvelopeParams {
        received: Some(received),
        ..EnvelopeParams::default()
    };
    let stamp = Envelope::encode_extension(&params)?;
    Ok(letter.stamped(stamp))
}

/// Maximum length in bytes of the stamp of a service with this name.
pub(crate) fn max_len(name: &str) -> usize {
    // The other parts are markers, lengths, date and incarnation.
    name.len().saturating_add(64)
}

/// Returns the names in the letter's effective intended-receiver parameter, or in `to` without one.
pub(crate) fn receivers(letter: &Letter, most: usize) -> Result<Vec<String>, DecodeError> {
    let envelope = letter.envelope();
    let view = EnvelopeView::parse(&envelope)?;
    Ok(view
        .receivers()
        .take(most)
        .map(|name| name.as_str().into_owned())
        .collect())
}

/// Returns the name in the letter's effective from parameter.
pub(crate) fn sender(letter: &Letter) -> Option<String> {
    let envelope = letter.envelope();
    let view = EnvelopeView::parse(&envelope).ok()?;
    view.from_name().map(|name| name.as_str().into_owned())
}

#[cfg(test)]
mod tests {
    use std::time::{Duration, UNIX_EPOCH};

    use super::*;

    #[test]
    fn a_stamp_fits_the_predicted_length() {
        // The end of the four-digit years.
        let far = UNIX_EPOCH + Duration::from_secs(250_000_000_000);
        for name in ["m", "gateway-of-a-robot", &"long".repeat(200)] {
            for utc in [UNIX_EPOCH, far] {
                let incarnation = Incarnation::from_u64(u64::MAX);
                let stamped = put(Letter::default(), name, incarnation, utc).unwrap();
                assert!(
                    stamped.len() <= max_len(name),
                    "{} {}",
                    stamped.len(),
                    name.len()
                );
            }
        }
    }
}
