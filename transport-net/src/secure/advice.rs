//! Remedies when two hosts do not trust each other, or when TLS between them fails.

use std::borrow::Cow;
use std::time::SystemTime;
use std::{fmt, io};

use fipa_acl::Time;
use rustls::{AlertDescription, CertificateError, Error, InvalidMessage};

/// The remedy when neither side reports a cause.
const DEFAULT_REMEDY: &str = "run `fipa keys list` on both hosts";

/// The error for a peer with the certificate of this host, and its remedy.
pub(crate) const OWN_CERTIFICATE: &str = "the certificate is that of this host";
pub(crate) const ITSELF: &str =
    "the address leads to this gateway itself, or another host uses a copy of its keys";

/// The remedy if the two sides have no version of TLS, or of the protocol above, in common.
const SAME_RELEASE: &str = "install the same release of fipa on both hosts";

/// The side that rejected the other one's certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Finder {
    Here,
    Peer,
}

/// A failure of TLS after the handshake of this side. The text has the cause and the remedy.
#[derive(Debug)]
pub(crate) struct TlsFailure(String);

impl TlsFailure {
    /// Creates the error of a wire with this text.
    pub(crate) fn io(text: String) -> io::Error {
        io::Error::new(io::ErrorKind::InvalidData, Self(text))
    }

    /// Returns the failure of TLS in an error of a wire.
    pub(crate) fn in_error(error: &io::Error) -> Option<&Self> {
        error.get_ref()?.downcast_ref()
    }
}

impl fmt::Display for TlsFailure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for TlsFailure {}

/// Returns what the clock of this host shows, as the end of a sentence.
fn clock(now: SystemTime) -> String {
    let time = Time::from_system_time(now).ok().and_then(Time::to_rfc3339);
    match time {
        Some(time) => format!("the clock of this host, which shows {time}"),
        None => "the clock of this host, which shows no time that a calendar has".to_owned(),
    }
}

/// Returns the remedy for a certificate of the peer that is not valid yet.
pub(crate) fn not_yet() -> String {
    format!(
        "the peer's certificate is not valid yet by {}: set the clock of this host if it is wrong; if it is \
         right, set the clock of the peer, and run `fipa keys renew` there afterwards",
        clock(SystemTime::now())
    )
}

/// Returns the remedy for a certificate of the peer that has expired.
pub(crate) fn expired() -> String {
    format!(
        "the peer's certificate has expired by {}: set the clock of this host if it is wrong; if it is right, run \
         `fipa keys renew` there",
        clock(SystemTime::now())
    )
}

/// Returns the remedy for a certificate of this host that the peer has found not valid now.
fn invalid_at_peer() -> String {
    format!(
        "this host's certificate is not valid now by the clock of the peer; compare that clock with {}, and set \
         the one that is wrong; if both are right, run `fipa keys renew` here",
        clock(SystemTime::now())
    )
}

/// Returns the name of an alert as in RFC 8446 section 6, for example `unknown_ca`.
fn alert_name(alert: AlertDescription) -> String {
    match alert {
        AlertDescription::UnknownCA => "unknown_ca".to_owned(),
        AlertDescription::UnknownPSKIdentity => "unknown_psk_identity".to_owned(),
        AlertDescription::UnrecognisedName => "unrecognized_name".to_owned(),
        AlertDescription::Unknown(_) => "without a name".to_owned(),
        known => in_words(&format!("{known:?}")).replace(' ', "_"),
    }
}

/// Returns the text for an alert of the peer, with its remedy.
pub(crate) fn alert_of_peer(alert: AlertDescription, remedy: &str) -> String {
    let (name, code) = (alert_name(alert), u8::from(alert));
    format!("the peer sent the TLS alert {name} ({code}): {remedy}")
}

/// Returns the remedy for an alert (RFC 8446 section 6.2).
pub(crate) fn of_alert(alert: AlertDescription, finder: Finder) -> Cow<'static, str> {
    use AlertDescription as A;
    use Finder::{Here, Peer};
    let remedy = match (alert, finder) {
        (A::CertificateExpired, Here) => return expired().into(),
        // Of a certificate that is not valid yet, too: TLS has no alert for it.
        (A::CertificateExpired, Peer) => return invalid_at_peer().into(),
        (A::NoApplicationProtocol, _) => SAME_RELEASE,
        (A::UnknownCA, Here) => {
            "this host does not trust the peer: run `fipa keys trust` with the peer's own.pem"
        }
        (A::UnknownCA | A::CertificateUnknown | A::AccessDenied, Peer) => {
            "the peer does not trust this host: run `fipa keys trust` there with this host's own.pem"
        }
        (A::BadCertificate, Peer) => {
            "the peer does not trust this host, or cannot read its certificate: run `fipa keys trust` there with \
             this host's own.pem, and install the same release of fipa on both hosts"
        }
        (A::UnsupportedCertificate, Peer) => {
            "the peer does not support the type of this host's certificate: install the same release of fipa on \
             both hosts"
        }
        (A::CertificateRevoked, Peer) => {
            "the peer has revoked this host's certificate: run `fipa keys renew` here and `fipa keys trust` there \
             with the new certificate"
        }
        (A::CertificateRequired | A::NoCertificate, Peer) => {
            "the peer requires a certificate and this host sent none: set security.keys here (`fipa keys init`) \
             and trust each other's certificates"
        }
        (A::CertificateRequired | A::NoCertificate, Here) => {
            "the peer sent no certificate: set security.keys there (`fipa keys init`) and trust each other's \
             certificates"
        }
        (A::DecryptError, Peer) => {
            "the peer cannot verify the signature of this host: check with `fipa keys list` that key and \
             certificate of this host belong together"
        }
        (A::ProtocolVersion, Peer) => {
            "the peer does not support TLS 1.3: install the same release of fipa on both hosts, or use another \
             address if no fipa gateway listens there"
        }
        (A::InternalError | A::UserCanceled, Peer) => "see the log of the peer",
        (_, Peer) => {
            "the peer does not accept the TLS messages of this host: see its log, and install the same release of \
             fipa on both hosts"
        }
        (_, Here) => DEFAULT_REMEDY,
    };
    remedy.into()
}

/// Writes the names of variants in an error of rustls in words: `unknown issuer` for `UnknownIssuer`. Such
/// a name is a word with a capital letter after a small one.
pub(crate) fn in_words(text: &str) -> String {
    let is_end = |c: char| !c.is_ascii_alphanumeric();
    text.split_inclusive(is_end).map(word).collect()
}

fn word(word: &str) -> String {
    let mut pairs = word.as_bytes().windows(2);
    let is_name = word.starts_with(|c: char| c.is_ascii_uppercase())
        && pairs.any(|pair| matches!(pair, [b'a'..=b'z', b'A'..=b'Z']));
    if !is_name {
        return word.to_owned();
    }
    let mut words = String::with_capacity(word.len() + 4);
    for c in word.chars() {
        if c.is_ascii_uppercase() && !words.is_empty() {
            words.push(' ');
        }
        words.push(c.to_ascii_lowercase());
    }
    words
}

/// Returns the text for an error of TLS, with the remedy.
pub(crate) fn text_with_remedy(error: &Error) -> String {
    match error {
        Error::AlertReceived(alert) => alert_of_peer(*alert, &of_alert(*alert, Finder::Peer)),
        _ => format!("{} ({})", in_words(&error.to_string()), of_error(error)),
    }
}

/// Returns the remedy for an error that this side has found.
fn of_error(error: &Error) -> Cow<'static, str> {
    let remedy = match error {
        Error::InvalidCertificate(CertificateError::UnknownIssuer) => {
            return of_alert(AlertDescription::UnknownCA, Finder::Here);
        }
        Error::InvalidCertificate(CertificateError::Expired) => return expired().into(),
        Error::InvalidCertificate(CertificateError::NotValidYet) => return not_yet().into(),
        Error::NoCertificatesPresented => {
            return of_alert(AlertDescription::CertificateRequired, Finder::Here);
        }
        Error::General(what) if what == OWN_CERTIFICATE => ITSELF,
        Error::InvalidMessage(InvalidMessage::InvalidContentType) => {
            "the peer does not use TLS: set security.keys there (`fipa keys init`) and trust each other's \
             certificates, or use another address if no fipa gateway listens there"
        }
        Error::InvalidMessage(_)
        | Error::InappropriateMessage { .. }
        | Error::InappropriateHandshakeMessage { .. }
        | Error::PeerIncompatible(_)
        | Error::PeerMisbehaved(_)
        | Error::NoApplicationProtocol => SAME_RELEASE,
        _ => DEFAULT_REMEDY,
    };
    remedy.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_variants_become_words() {
        for (text, expected) in [
            (
                "invalid peer certificate: UnknownIssuer",
                "invalid peer certificate: unknown issuer",
            ),
            (
                "received fatal alert: CertificateUnknown (46)",
                "received fatal alert: certificate unknown (46)",
            ),
            (
                "the peer is at TLS 1.2, not TLS 1.3",
                "the peer is at TLS 1.2, not TLS 1.3",
            ),
            (
                "invalid peer certificate: Expired",
                "invalid peer certificate: Expired",
            ),
        ] {
            assert_eq!(in_words(text), expected);
        }
    }
}
