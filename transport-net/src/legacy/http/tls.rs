//! TLS of `https`.
//!
//! A platform proves its identity with a certificate that is trusted like that of a gateway, or, when
//! this side dials it, with a certificate for its host name from a listed authority. A platform that
//! dials may also prove nothing; then the rules for `http` apply to it.

use std::net::IpAddr;
use std::time::Duration;

use fipa_transport::TransportErrorKind;
use rustls::CertificateError;
use rustls::pki_types::ServerName;
use tokio::net::TcpStream;
use tokio::time;
use tokio_rustls::{TlsAcceptor, TlsConnector, TlsStream};

use super::guarded::Guarded;
use super::url::Url;
use crate::secure::Security;
use crate::stream::proof::Proof;

/// A connection over TLS, which ends when what the platform has proved no longer counts.
pub(super) type Stream = Guarded<TlsStream<TcpStream>>;

/// Performs the handshake with a platform that has connected. Returns what the platform has proved,
/// too: nothing, unless its certificate is trusted.
pub(super) async fn accept(
    security: &Security,
    stream: TcpStream,
    timeout: Duration,
) -> Result<(Stream, Proof), String> {
    let config = security
        .platform_server()
        .map_err(|error| error.to_string())?;
    let handshake = time::timeout(timeout, TlsAcceptor::from(config).accept(stream)).await;
    let handshake = handshake.map_err(|_| overdue(timeout))?;
    let stream = handshake.map_err(|error| error.to_string())?;
    let trust = security.trust_in_client(stream.get_ref().1.peer_certificates());
    let proof = trust.map(Proof::from).unwrap_or_default();
    Ok((Guarded::new(stream.into(), proof.clone()), proof))
}

/// The error of a handshake with a platform that this side has dialed.
pub(super) struct HandshakeError {
    pub(super) fault: TransportErrorKind,
    pub(super) what: String,
}

/// Performs the handshake with the platform at this address, which must prove its identity.
pub(super) async fn connect(
    security: &Security,
    stream: TcpStream,
    url: &Url,
    timeout: Duration,
) -> Result<Stream, HandshakeError> {
    let refused = |what: String| HandshakeError {
        fault: TransportErrorKind::Refused,
        what,
    };
    let distrusted = |what: String| HandshakeError {
        fault: TransportErrorKind::Distrusted,
        what,
    };
    let config = security.platform_client();
    let config = config.map_err(|error| refused(error.to_string()))?;
    let name = server_name(url).map_err(distrusted)?;
    let connector = TlsConnector::from(config);
    let handshake = time::timeout(timeout, connector.connect(name.clone(), stream)).await;
    let handshake = handshake.map_err(|_| refused(overdue(timeout)))?;
    let stream = handshake.map_err(|error| match of_tls(&error) {
        Some(rustls::Error::InvalidCertificate(_)) => distrusted(advice(&error)),
        _ => refused(advice(&error)),
    })?;
    let presented = stream.get_ref().1.peer_certificates();
    let trust = security.trust_in_server(presented, &name);
    let trust =
        trust.ok_or_else(|| distrusted("its certificate is no longer trusted".to_owned()))?;
    Ok(Guarded::new(stream.into(), trust.into()))
}

/// The name that the certificate of an authority must prove.
fn server_name(url: &Url) -> Result<ServerName<'static>, String> {
    let host = url.name();
    match host.parse::<IpAddr>() {
        Ok(ip) => Ok(ServerName::from(ip)),
        Err(_) => ServerName::try_from(host.to_owned()).map_err(|error| format!("{host}: {error}")),
    }
}

fn overdue(timeout: Duration) -> String {
    format!("TLS handshake not complete within {timeout:?} (handshake_timeout)")
}

fn of_tls(error: &std::io::Error) -> Option<&rustls::Error> {
    error.get_ref().and_then(|it| it.downcast_ref())
}

fn advice(error: &std::io::Error) -> String {
    match of_tls(error) {
        Some(rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer)) => {
            "its certificate is neither trusted (`fipa keys trust`) nor from an authority in \
             transport.https.authorities"
                .to_owned()
        }
        _ => error.to_string(),
    }
}
