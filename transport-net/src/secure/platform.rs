//! Verification of the certificates of platforms over `https`, and the authorities that prove their names.

use std::sync::Arc;

use rustls::client::WebPkiServerVerifier;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::WebPkiSupportedAlgorithms;
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{DigitallySignedStruct, DistinguishedName, Error, RootCertStore, SignatureScheme};

use super::verify::{Known, tls13_signatures};

/// The authorities whose certificates prove the host names of platforms (RFC 5280). Without any, only
/// trusted certificates prove a platform.
#[derive(Debug, Clone, Default)]
pub struct Authorities(Option<Arc<WebPkiServerVerifier>>);

/// The reason for which certificates of authorities cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AuthoritiesError {
    /// None of the certificates is one of an authority.
    #[error("none of the {0} certificates is one of an authority")]
    None(usize),
    /// The certificates cannot be used together.
    #[error("the certificates of authorities cannot be used: {0}")]
    Unusable(String),
}

impl Authorities {
    /// Creates the authorities with these certificates, in DER form. Certificates that are not of an authority
    /// are ignored, as long as one is.
    ///
    /// # Errors
    /// When none of the certificates is one of an authority.
    pub fn new(certificates: Vec<CertificateDer<'static>>) -> Result<Self, AuthoritiesError> {
        let count = certificates.len();
        let mut roots = RootCertStore::empty();
        let (added, _ignored) = roots.add_parsable_certificates(certificates);
        if added == 0 {
            return Err(AuthoritiesError::None(count));
        }
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let verifier = WebPkiServerVerifier::builder_with_provider(Arc::new(roots), provider);
        let verifier = verifier
            .build()
            .map_err(|error| AuthoritiesError::Unusable(error.to_string()))?;
        Ok(Self(Some(verifier)))
    }

    /// Returns the verifier of chains. `None` without authorities.
    pub(super) fn verifier(&self) -> Option<&WebPkiServerVerifier> {
        self.0.as_deref()
    }
}

/// Verifies the certificate of a platform that is dialed: a trusted one, whose name is not compared, or
/// one of an authority for the name.
#[derive(Debug)]
pub(super) struct Server(Arc<Known>);

impl Server {
    pub(super) fn new(known: Arc<Known>) -> Self {
        Self(known)
    }

    fn algorithms(&self) -> WebPkiSupportedAlgorithms {
        self.0.algorithms()
    }
}

impl ServerCertVerifier for Server {
    fn verify_server_cert(
        &self,
        presented: &CertificateDer<'_>,
        intermediates: &[CertificateDer<'_>],
        name: &ServerName<'_>,
        ocsp: &[u8],
        now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let known = &self.0;
        if known.find(presented).is_none() {
            let all = std::iter::once(presented).chain(intermediates);
            if let Some(authorities) = known.authorities_for(all) {
                return authorities.verify_server_cert(presented, intermediates, name, ocsp, now);
            }
        }
        known.verify_server_cert(presented, intermediates, name, ocsp, now)
    }

    tls13_signatures!();
}

/// Lets a platform present any certificate or none. The handshake proves that the platform has the key of the
/// certificate; [`Security::proof`](super::Security) decides whether the certificate is trusted.
#[derive(Debug)]
pub(super) struct AnyClient {
    algorithms: WebPkiSupportedAlgorithms,
}

impl AnyClient {
    pub(super) fn new(known: &Known) -> Self {
        Self {
            algorithms: known.algorithms(),
        }
    }

    fn algorithms(&self) -> WebPkiSupportedAlgorithms {
        self.algorithms
    }
}

impl ClientCertVerifier for AnyClient {
    fn client_auth_mandatory(&self) -> bool {
        false
    }

    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        _presented: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        Ok(ClientCertVerified::assertion())
    }

    tls13_signatures!();
}
