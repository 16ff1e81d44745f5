//! Verification of presented certificates.

use std::collections::{HashMap, HashSet};
#[cfg(feature = "http")]
use std::time::{SystemTime, UNIX_EPOCH};

#[cfg(feature = "http")]
use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::WebPkiSupportedAlgorithms;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{CertificateError, DigitallySignedStruct, DistinguishedName, Error, SignatureScheme};

use super::advice;
use super::certificate::{Certificate, Fingerprint, Holds};
#[cfg(feature = "http")]
use super::platform::Authorities;
#[cfg(feature = "http")]
use super::trust::Chain;

/// The methods of a verifier that check the signature over a handshake, with its `algorithms()`.
///
/// TLS 1.2 is not offered, so its method is only reached through a protocol error.
macro_rules! tls13_signatures {
    () => {
        fn verify_tls12_signature(
            &self,
            _message: &[u8],
            _certificate: &CertificateDer<'_>,
            _signed: &DigitallySignedStruct,
        ) -> Result<HandshakeSignatureValid, Error> {
            Err(rustls::PeerIncompatible::Tls12NotOfferedOrEnabled.into())
        }

        fn verify_tls13_signature(
            &self,
            message: &[u8],
            certificate: &CertificateDer<'_>,
            signed: &DigitallySignedStruct,
        ) -> Result<HandshakeSignatureValid, Error> {
            let algorithms = self.algorithms();
            rustls::crypto::verify_tls13_signature(message, certificate, signed, &algorithms)
        }

        fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
            self.algorithms().supported_schemes()
        }
    };
}
#[cfg(feature = "http")]
pub(super) use tls13_signatures;

/// The certificates that prove peers.
#[derive(Debug)]
pub(super) struct Known {
    own: Fingerprint,
    /// The certificates of trusted peers, without revoked ones.
    trusted: HashMap<Fingerprint, Certificate>,
    revoked: HashSet<Fingerprint>,
    #[cfg(feature = "http")]
    authorities: Authorities,
    algorithms: WebPkiSupportedAlgorithms,
}

impl Known {
    /// Returns what a service with this certificate knows before it trusts any peer.
    pub(super) fn of(own: Fingerprint) -> Self {
        let provider = rustls::crypto::ring::default_provider();
        Self {
            own,
            trusted: HashMap::new(),
            revoked: HashSet::new(),
            #[cfg(feature = "http")]
            authorities: Authorities::default(),
            algorithms: provider.signature_verification_algorithms,
        }
    }

    /// Returns the same authorities with these certificates.
    pub(super) fn with_certificates(
        &self,
        own: Fingerprint,
        trusted: Vec<Certificate>,
        revoked: Vec<Fingerprint>,
    ) -> Self {
        let revoked: HashSet<Fingerprint> = revoked.into_iter().collect();
        let trusted = trusted.into_iter();
        let trusted = trusted.map(|certificate| (certificate.fingerprint(), certificate));
        Self {
            own,
            trusted: trusted.filter(|(it, _)| !revoked.contains(it)).collect(),
            revoked,
            #[cfg(feature = "http")]
            authorities: self.authorities.clone(),
            algorithms: self.algorithms,
        }
    }

    /// Returns the same certificates with these authorities.
    #[cfg(feature = "http")]
    pub(super) fn with_authorities(&self, authorities: Authorities) -> Self {
        Self {
            own: self.own,
            trusted: self.trusted.clone(),
            revoked: self.revoked.clone(),
            authorities,
            algorithms: self.algorithms,
        }
    }

    /// Returns the revoked certificates.
    pub(super) fn revoked(&self) -> impl Iterator<Item = Fingerprint> {
        self.revoked.iter().copied()
    }

    /// Returns the authorities of platforms, unless one of these certificates is revoked.
    #[cfg(feature = "http")]
    pub(super) fn authorities_for<'a>(
        &self,
        mut presented: impl Iterator<Item = &'a CertificateDer<'a>>,
    ) -> Option<&WebPkiServerVerifier> {
        let is_revoked = |it: &CertificateDer<'_>| self.revoked.contains(&Fingerprint::of(it));
        match presented.any(is_revoked) {
            true => None,
            false => self.authorities.verifier(),
        }
    }

    /// Whether the authorities prove the name of a platform with this chain at this time.
    #[cfg(feature = "http")]
    pub(super) fn trusts_chain(&self, chain: &Chain, now: SystemTime) -> bool {
        let Some((own, others)) = chain.presented.split_first() else {
            return false;
        };
        let Some(authorities) = self.authorities_for(chain.presented.iter()) else {
            return false;
        };
        let now = UnixTime::since_unix_epoch(now.duration_since(UNIX_EPOCH).unwrap_or_default());
        let verified = authorities.verify_server_cert(own, others, &chain.name, &[], now);
        verified.is_ok()
    }

    pub(super) fn find(&self, presented: &CertificateDer<'_>) -> Option<&Certificate> {
        self.trusted.get(&Fingerprint::of(presented))
    }

    /// The algorithms of signatures that are supported.
    pub(super) fn algorithms(&self) -> WebPkiSupportedAlgorithms {
        self.algorithms
    }

    pub(super) fn trusts(&self, fingerprint: Fingerprint) -> bool {
        self.trusted.contains_key(&fingerprint)
    }

    /// Checks that a certificate is that of a trusted peer and valid now. The signature over the
    /// handshake proves that the peer has its key.
    fn check(&self, presented: &CertificateDer<'_>, now: UnixTime) -> Result<(), Error> {
        let Some(certificate) = self.find(presented) else {
            return Err(match Fingerprint::of(presented) == self.own {
                true => Error::General(advice::OWN_CERTIFICATE.into()),
                false => CertificateError::UnknownIssuer.into(),
            });
        };
        match certificate.holds(now) {
            Holds::Now => Ok(()),
            Holds::NotYet => Err(CertificateError::NotValidYet.into()),
            Holds::NoMore => Err(CertificateError::Expired.into()),
        }
    }
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

    tls13_signatures!();
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

    tls13_signatures!();
}
