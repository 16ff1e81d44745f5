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
use fipa_transport::{Incarnation, PeerId};

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
pub(crate) fn read(view: &EnvelopeView, name: &str, incarnation: Incarnation) -> EnvelopeParts {
    let id = incarnation.to_string();
    let (mut is_loop, mut stamps) = (false, 0);
    for stamp in view.stamps() {
        stamps += 1;
        let is_own = stamp.by().as_str() == name;
        is_loop |= is_own && stamp.id().is_some_and(|it| it.as_str() == id);
    }
    let sender = view.from_name().map(|name| name.as_str().into_owned());
    EnvelopeParts {
        is_loop,
        stamps,
        sender,
    }
}

/// Adds the stamp of this service in front of the letter, which came from this peer.
pub(crate) fn put(
    letter: Letter,
    name: &str,
    incarnation: Incarnation,
    from: &PeerId,
    utc: SystemTime,
) -> Result<Letter, StampError> {
    let received = Received {
        by: name.to_owned(),
        date: Time::from_system_time(utc)?,
        from: (!from.is_this_host()).then(|| from.as_str().to_owned()),
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

/// Returns the peer from which the service with this incarnation received the letter, by the stamp that it added.
/// `None` without such a stamp.
#[must_use]
pub fn stamped_peer(letter: &Letter, service: Incarnation) -> Option<PeerId> {
    let envelope = letter.envelope();
    let id = service.to_string();
    let view = EnvelopeView::parse(&envelope).ok()?;
    let own = view
        .stamps()
        .find(|stamp| stamp.id().is_some_and(|it| it.as_str() == id))?;
    match own.from() {
        Some(from) => PeerId::from_text(&from.as_str()),
        None => Some(PeerId::THIS_HOST),
    }
}

/// Maximum length in bytes of the stamp of a service with this name.
pub(crate) fn max_len(name: &str) -> usize {
    // The other parts are markers, lengths, date and incarnation.
    name.len().saturating_add(64 + PeerId::MAX_LEN)
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

    use fipa_acl::{AgentId, Message, Performative};

    use super::*;

    #[test]
    fn the_peer_is_that_of_the_own_stamp() {
        let own = Incarnation::from_u64(7);
        let peer = |text| PeerId::from_text(text).unwrap();
        let message = Message::builder(Performative::Inform)
            .sender(AgentId::new("rover").unwrap())
            .receiver(AgentId::new("arm").unwrap());
        let letter = crate::letter_for(&message.build().unwrap(), UNIX_EPOCH).unwrap();
        let forged = put(letter.clone(), "other", own, &peer("192.0.2.1"), UNIX_EPOCH).unwrap();
        let arrived = put(forged.clone(), "own", own, &peer("192.0.2.66"), UNIX_EPOCH).unwrap();
        assert_eq!(stamped_peer(&arrived, own), Some(peer("192.0.2.66")));
        let of_this_host = put(forged, "own", own, &PeerId::THIS_HOST, UNIX_EPOCH).unwrap();
        assert_eq!(stamped_peer(&of_this_host, own), Some(PeerId::THIS_HOST));
        assert_eq!(stamped_peer(&arrived, Incarnation::from_u64(8)), None);
        assert_eq!(stamped_peer(&letter, own), None);
    }

    #[test]
    fn a_stamp_fits_the_predicted_length() {
        // The end of the four-digit years.
        let far = UNIX_EPOCH + Duration::from_secs(250_000_000_000);
        for name in ["m", "gateway-of-a-robot", &"long".repeat(200)] {
            for utc in [UNIX_EPOCH, far] {
                let incarnation = Incarnation::from_u64(u64::MAX);
                let from = PeerId::from_text(&"f".repeat(PeerId::MAX_LEN)).unwrap();
                let stamped = put(Letter::default(), name, incarnation, &from, utc).unwrap();
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
