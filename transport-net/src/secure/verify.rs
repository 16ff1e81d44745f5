//! Verification of presented certificates.

use std::collections::HashMap;

use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, WebPkiSupportedAlgorithms, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{
    CertificateError, DigitallySignedStruct, DistinguishedName, Error, PeerIncompatible,
    SignatureScheme,
};

use super::advice;
use super::certificate::{Certificate, Fingerprint, Holds};

/// The certificates of trusted peers.
#[derive(Debug)]
pub(super) struct Known {
    own: Fingerprint,
    trusted: HashMap<Fingerprint, Certificate>,
    algorithms: WebPkiSupportedAlgorithms,
}

impl Known {
    pub(super) fn new(
        own: &Certificate,
        trusted: Vec<Certificate>,
        provider: &CryptoProvider,
    ) -> Self {
        Self {
            own: own.fingerprint(),
            trusted: trusted
                .into_iter()
                .map(|certificate| (certificate.fingerprint(), certificate))
                .collect(),
            algorithms: provider.signature_verification_algorithms,
        }
    }

    pub(super) fn find(&self, presented: &CertificateDer<'_>) -> Option<&Certificate> {
        self.trusted.get(&Fingerprint::of(presented))
    }

    /// The algorithms of signatures that are supported.
    #[cfg(feature = "http")]
    pub(super) fn algorithms(&self) -> WebPkiSupportedAlgorithms {
        self.algorithms
    }

    pub(super) fn trusts(&self, fingerprint: Fingerprint) -> bool {
        self.trusted.contains_key(&fingerprint)
    }

    /// Checks that a certificate is that of a trusted peer and valid now. The signature over the
    /// handshake proves that the peer has its key.
    fn check(&self, presented: &CertificateDer<'_>, now: UnixTime) -> Result<(), Error> {
        if Fingerprint::of(presented) == self.own {
            return Err(Error::General(advice::OWN_CERTIFICATE.into()));
        }
        let certificate = self.find(presented);
        let certificate = certificate.ok_or(CertificateError::UnknownIssuer)?;
        match certificate.holds(now) {
            Holds::Now => Ok(()),
            Holds::NotYet => Err(CertificateError::NotValidYet.into()),
            Holds::NoMore => Err(CertificateError::Expired.into()),
        }
    }

    fn check_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, certificate, signed, &self.algorithms)
    }
}

/// TLS 1.2 is not offered, so this is only reached through a protocol error.
pub(super) fn only_tls13() -> Result<HandshakeSignatureValid, Error> {
    Err(PeerIncompatible::Tls12NotOfferedOrEnabled.into())
}

impl ServerCertVerifier for Known {
    fn verify_server_cert(
        &self,
        presented: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        // The name is not compared: addresses change, and the certificate identifies the peer.
        _address: &ServerName<'_>,
        _ocsp: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        self.check(presented, now)?;
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _certificate: &CertificateDer<'_>,
        _signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        only_tls13()
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.check_signature(message, certificate, signed)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}

impl ClientCertVerifier for Known {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        // The list of trusted peers is not disclosed.
        &[]
    }

    fn verify_client_cert(
        &self,
        presented: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        self.check(presented, now)?;
        Ok(ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _certificate: &CertificateDer<'_>,
        _signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        only_tls13()
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        self.check_signature(message, certificate, signed)
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        self.algorithms.supported_schemes()
    }
}
