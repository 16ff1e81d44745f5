//! TLS of `https`.
//!
//! A platform proves its identity with a certificate that is trusted like that of a gateway, or, when
//! this side dials it, with a certificate for its host name from a listed authority. A platform that
//! dials may also prove nothing; then the rules for `http` apply to it.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use rustls::client::WebPkiServerVerifier;
use rustls::pki_types::{CertificateDer, ServerName};
use rustls::{CertificateError, RootCertStore};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::{TlsAcceptor, TlsConnector, TlsStream};

use super::url::Url;
use crate::secure::{Certificate, Security};

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
}

/// Performs the handshake with a platform that has connected. Returns its certificate if that is
/// trusted.
pub(super) async fn accept(
    security: &Security,
    stream: TcpStream,
    patience: Duration,
) -> Result<(TlsStream<TcpStream>, Option<Certificate>), String> {
    let config = security
        .platform_server()
        .map_err(|error| error.to_string())?;
    let handshake = timeout(patience, TlsAcceptor::from(config).accept(stream)).await;
    let handshake = handshake.map_err(|_| overdue(patience))?;
    let stream = handshake.map_err(|error| error.to_string())?;
    let certificate = security.proof(stream.get_ref().1.peer_certificates());
    Ok((stream.into(), certificate))
}

/// Performs the handshake with the platform at this address, which must prove its identity.
pub(super) async fn connect(
    security: &Security,
    authorities: &Authorities,
    stream: TcpStream,
    url: &Url,
    patience: Duration,
) -> Result<TlsStream<TcpStream>, String> {
    let config = security.platform_client(authorities.0.clone());
    let config = config.map_err(|error| error.to_string())?;
    let name = server_name(url)?;
    let handshake = timeout(patience, TlsConnector::from(config).connect(name, stream)).await;
    let handshake = handshake.map_err(|_| overdue(patience))?;
    Ok(handshake.map_err(|error| advice(&error))?.into())
}

/// The name that the certificate of an authority must prove.
fn server_name(url: &Url) -> Result<ServerName<'static>, String> {
    let host = url.name();
    match host.parse::<IpAddr>() {
        Ok(ip) => Ok(ServerName::from(ip)),
        Err(_) => ServerName::try_from(host.to_owned()).map_err(|error| format!("{host}: {error}")),
    }
}

fn overdue(patience: Duration) -> String {
    format!("TLS handshake not complete within {patience:?} (handshake_timeout)")
}

fn advice(error: &std::io::Error) -> String {
    let of_tls = error.get_ref().and_then(|it| it.downcast_ref());
    match of_tls {
        Some(rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer)) => {
            "its certificate is neither trusted (`fipa keys trust`) nor from an authority in \
             transport.https.authorities"
                .to_owned()
        }
        _ => error.to_string(),
    }
}
