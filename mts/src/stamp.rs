//! Stamps, and what else a message transport service reads of an envelope.
//!
//! A stamp is an extension envelope with a `received` parameter (FIPA00067, FIPA00088): `by` is
//! the name of the service, `id` its incarnation. Two robots may give their gateways one name, so
//! a service recognises only a stamp with its own incarnation.

use std::time::SystemTime;

use fipa_acl::{
    DecodeError, EncodeError, Envelope, EnvelopeParams, EnvelopeView, Letter, Received, Time,
    TimeError,
};
use fipa_transport::Incarnation;

/// Why a letter could not be stamped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum StampError {
    /// The clock of this host is beyond what an envelope can say.
    #[error("cannot date the stamp: {0}")]
    Time(#[from] TimeError),
    /// The stamp cannot be encoded.
    #[error("cannot encode the stamp: {0}")]
    Encode(#[from] EncodeError),
}

/// Whether the letter carries the stamp of this service.
pub(crate) fn carries(
    letter: &Letter,
    name: &str,
    incarnation: Incarnation,
) -> Result<bool, DecodeError> {
    let envelope = letter.envelope();
    let view = EnvelopeView::parse(&envelope)?;
    let id = incarnation.to_string();
    let mut stamps = view.stamps();
    Ok(stamps
        .any(|stamp| stamp.by().as_str() == name && stamp.id().is_some_and(|it| it.as_str() == id)))
}

/// How many services have stamped the letter.
pub(crate) fn count(letter: &Letter) -> Result<usize, DecodeError> {
    let envelope = letter.envelope();
    Ok(EnvelopeView::parse(&envelope)?.stamps().count())
}

/// The letter with the stamp of this service in front.
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

/// Bytes that the stamp of a service with this name takes, at most.
pub(crate) fn room(name: &str) -> usize {
    // What stands around the name: marks, lengths, date and incarnation.
    name.len().saturating_add(64)
}

/// The names in the letter's effective intended-receiver parameter, or `to` when it has none.
pub(crate) fn receivers(letter: &Letter, most: usize) -> Result<Vec<String>, DecodeError> {
    let envelope = letter.envelope();
    let view = EnvelopeView::parse(&envelope)?;
    Ok(view
        .receivers()
        .take(most)
        .map(|name| name.as_str().into_owned())
        .collect())
}

/// The name in the letter's effective from parameter.
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
    fn a_stamp_has_the_room_that_is_said() {
        // Until the end of the four-digit years.
        let far = UNIX_EPOCH + Duration::from_secs(250_000_000_000);
        for name in ["m", "gateway-of-a-robot", &"long".repeat(200)] {
            for utc in [UNIX_EPOCH, far] {
                let incarnation = Incarnation::from_u64(u64::MAX);
                let stamped = put(Letter::default(), name, incarnation, utc).unwrap();
                assert!(
                    stamped.len() <= room(name),
                    "{} {}",
                    stamped.len(),
                    name.len()
                );
            }
        }
    }
}
