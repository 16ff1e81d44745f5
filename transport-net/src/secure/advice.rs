//! Remedies when two hosts do not trust each other.

use rustls::{CertificateError, Error};

/// The remedy when neither side reports a cause.
const DEFAULT_REMEDY: &str = "run `fipa keys list` on both hosts";

/// The remedy for a certificate that is not valid yet.
pub(crate) const NOT_YET: &str = "the peer's certificate is not valid yet by the clock of this host: set the clock \
                       of this host; if it is right, set the clock of the peer and run `fipa keys renew` there";

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
        _ => DEFAULT_REMEDY,
    }
}
