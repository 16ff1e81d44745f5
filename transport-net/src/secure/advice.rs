//! Remedies when two hosts do not trust each other.

use rustls::{CertificateError, Error};

/// The remedy when neither side reports a cause.
const DEFAULT_REMEDY: &str = "run `fipa keys list` on both hosts";

/// The remedy for a certificate that is not valid yet.
pub(crate) const NOT_YET: &str = "the peer's certificate is not valid yet by the clock of this host: set the clock \
                       of this host; if it is right, set the clock of the peer and run `fipa keys renew` there";

/// The error for a peer with the certificate of this host, and its remedy.
pub(crate) const OWN_CERTIFICATE: &str = "the certificate is that of this host";
pub(crate) const ITSELF: &str =
    "the address leads to this gateway itself, or another host uses a copy of its keys";

/// Alerts about certificates (RFC 8446 section 6.2).
const BAD_CERTIFICATE: u8 = 42;
const CERTIFICATE_EXPIRED: u8 = 45;
const CERTIFICATE_UNKNOWN: u8 = 46;
const UNKNOWN_CA: u8 = 48;
const ACCESS_DENIED: u8 = 49;

/// The side that rejected the other one's certificate.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Finder {
    Here,
    Peer,
}

/// Returns the remedy for an alert.
pub(crate) fn of_alert(alert: u8, finder: Finder) -> &'static str {
    match (alert, finder) {
        (CERTIFICATE_EXPIRED, Finder::Here) => {
            "the peer's certificate is not valid now: check both clocks, or run `fipa keys renew` there"
        }
        (CERTIFICATE_EXPIRED, Finder::Peer) => {
            "this host's certificate is not valid now by the clock of the peer: set the clocks of both \
             hosts, or run `fipa keys renew`"
        }
        (UNKNOWN_CA, Finder::Here) => {
            "this host does not trust the peer: run `fipa keys trust` with the peer's own.pem"
        }
        (BAD_CERTIFICATE | CERTIFICATE_UNKNOWN | UNKNOWN_CA | ACCESS_DENIED, Finder::Peer) => {
            "the peer does not trust this host: run `fipa keys trust` there with this host's own.pem"
        }
        _ => DEFAULT_REMEDY,
    }
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

/// Returns the remedy for an error of TLS.
pub(crate) fn of_error(error: &Error) -> &'static str {
    match error {
        Error::AlertReceived(alert) => of_alert(u8::from(*alert), Finder::Peer),
        Error::InvalidCertificate(CertificateError::UnknownIssuer) => {
            of_alert(UNKNOWN_CA, Finder::Here)
        }
        Error::InvalidCertificate(CertificateError::Expired) => {
            of_alert(CERTIFICATE_EXPIRED, Finder::Here)
        }
        Error::InvalidCertificate(CertificateError::NotValidYet) => NOT_YET,
        Error::General(what) if what == OWN_CERTIFICATE => ITSELF,
        _ => DEFAULT_REMEDY,
    }
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
