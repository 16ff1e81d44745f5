//! Mutual TLS 1.3 (RFC 8446) between services that trust each other's certificates.
//!
//! There is no certification authority. A peer is trusted because its owner gave its certificate to
//! the owner of this host, who added it to the trusted ones; the certificate that a peer presents
//! is compared with them. There are no chains to verify, and withdrawing trust is removing a
//! certificate, which ends the connections that were opened with it.
//!
//! * `certificate`: the contents of a certificate.
//! * `advice`: remedies when a peer is not trusted.
//! * `verify`: the verification of a presented certificate.
//! * `platform`: the same for platforms that are reached over `https`.
//!
//! Files and the handling of letters do not belong here.

pub(crate) mod advice;
mod certificate;
#[cfg(feature = "http")]
mod platform;
mod verify;

use std::fmt;
use std::net::IpAddr;
use std::sync::Arc;

use parking_lot::RwLock;
use rustls::client::Resumption;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::version::TLS13;
use rustls::{ClientConfig, ServerConfig};
use tokio::sync::watch;

pub use self::certificate::{
    Certificate, CertificateError, Certified, Fingerprint, alternative_names,
};
use self::verify::Known;

#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub use self::certificate::certified;

/// The certificate and key of a host, and the certificates that it trusts.
#[derive(Debug)]
pub struct Credentials {
    /// This host's own certificate.
    pub own: Certificate,
    /// The private key that belongs to it, in PKCS #8.
    pub key: PrivateKeyDer<'static>,
    /// The certificates of trusted peers.
    pub trusted: Vec<Certificate>,
}

/// The reason for which credentials cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("cannot use this private key with this certificate")]
#[non_exhaustive]
pub struct CredentialsError(#[from] rustls::Error);

/// The credentials of an endpoint. Clones share them: [`replace`](Self::replace) changes all
/// clones.
#[derive(Clone)]
pub struct Security {
    now: Arc<RwLock<Arc<Prepared>>>,
    /// Counts replacements.
    replaced: watch::Sender<u64>,
    rules: Rules,
}

/// The peers that must prove their identity.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Rules {
    /// Whether peers at loopback addresses must prove their identity, too.
    pub loopback: bool,
    /// Addresses of legacy peers, which cannot prove their identity. Only letters in their dialects
    /// are exchanged with them.
    pub legacy_peers: Vec<IpAddr>,
}

/// Credentials in the form that TLS needs.
struct Prepared {
    own: Certificate,
    key: PrivateKeyDer<'static>,
    known: Arc<Known>,
    server: Arc<ServerConfig>,
    client: Arc<ClientConfig>,
}

impl Security {
    /// Creates credentials that only admit trusted peers, with the exceptions of the rules.
    ///
    /// # Errors
    /// When the key does not belong to the certificate.
    pub fn new(credentials: Credentials, rules: Rules) -> Result<Self, CredentialsError> {
        Ok(Self {
            now: Arc::new(RwLock::new(Arc::new(Prepared::new(credentials)?))),
            replaced: watch::Sender::new(0),
            rules,
        })
    }

    /// Replaces the credentials. Connections with peers that are no longer trusted end.
    ///
    /// # Errors
    /// When the credentials cannot be used; the previous ones stay in use.
    pub fn replace(&self, credentials: Credentials) -> Result<(), CredentialsError> {
        let prepared = Arc::new(Prepared::new(credentials)?);
        *self.now.write() = prepared;
        self.replaced.send_modify(|count| *count += 1);
        Ok(())
    }

    /// Replaces the trusted peers, and keeps the key and certificate.
    ///
    /// # Errors
    /// When the credentials cannot be used; the previous ones stay in use.
    pub fn trust_only(&self, trusted: Vec<Certificate>) -> Result<(), CredentialsError> {
        let (own, key) = {
            let now = self.now.read();
            (now.own.clone(), now.key.clone_key())
        };
        self.replace(Credentials { own, key, trusted })
    }

    /// Whether a peer at this address must prove its identity.
    pub(crate) fn covers(&self, ip: IpAddr) -> bool {
        self.rules.loopback || !ip.to_canonical().is_loopback()
    }

    /// Whether this is the address of a legacy peer.
    pub(crate) fn excepts(&self, ip: IpAddr) -> bool {
        self.rules.legacy_peers.contains(&ip.to_canonical())
    }

    /// Returns a receiver that is notified when the credentials have been replaced.
    pub(crate) fn changes(&self) -> watch::Receiver<u64> {
        self.replaced.subscribe()
    }

    /// Whether a peer with this certificate is trusted now.
    #[must_use]
    pub fn trusts(&self, fingerprint: Fingerprint) -> bool {
        self.now.read().known.trusts(fingerprint)
    }

    pub(crate) fn server(&self) -> Arc<ServerConfig> {
        self.now.read().server.clone()
    }

    pub(crate) fn client(&self) -> Arc<ClientConfig> {
        self.now.read().client.clone()
    }

    /// Returns the configuration of TLS with a platform that dials. Its certificate is not required.
    #[cfg(feature = "http")]
    pub(crate) fn platform_server(&self) -> Result<Arc<ServerConfig>, rustls::Error> {
        let now = self.now.read().clone();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let mut server = ServerConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS13])?
            .with_client_cert_verifier(Arc::new(platform::AnyClient::new(&now.known)))
            .with_single_cert(vec![now.own.der().clone()], now.key.clone_key())?;
        server.send_tls13_tickets = 0;
        Ok(Arc::new(server))
    }

    /// Returns the configuration of TLS with a platform that is dialed. It proves its identity with a
    /// trusted certificate, or with one of these authorities for its name.
    #[cfg(feature = "http")]
    pub(crate) fn platform_client(
        &self,
        authorities: Option<Arc<rustls::client::WebPkiServerVerifier>>,
    ) -> Result<Arc<ClientConfig>, rustls::Error> {
        let now = self.now.read().clone();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let verifier = platform::Server::new(now.known.clone(), authorities);
        let mut client = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS13])?
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(verifier))
            .with_client_auth_cert(vec![now.own.der().clone()], now.key.clone_key())?;
        client.resumption = Resumption::disabled();
        Ok(Arc::new(client))
    }

    /// Returns the trusted certificate that a platform has presented, if it is valid now.
    #[cfg(feature = "http")]
    pub(crate) fn proof(&self, presented: Option<&[CertificateDer<'_>]>) -> Option<Certificate> {
        let certificate = self.peer(presented)?;
        let now = rustls::pki_types::UnixTime::now();
        (certificate.holds(now) == certificate::Holds::Now).then_some(certificate)
    }

    /// Returns the trusted certificate that a peer has presented.
    pub(crate) fn peer(&self, presented: Option<&[CertificateDer<'_>]>) -> Option<Certificate> {
        let presented = presented?.first()?;
        self.now.read().known.find(presented).cloned()
    }
}

impl fmt::Debug for Security {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Security")
            .field("rules", &self.rules)
            .finish_non_exhaustive()
    }
}

impl Prepared {
    fn new(credentials: Credentials) -> Result<Self, CredentialsError> {
        let Credentials { own, key, trusted } = credentials;
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let known = Arc::new(Known::new(&own, trusted, &provider));
        let chain = vec![own.der().clone()];
        let mut server = ServerConfig::builder_with_provider(provider.clone())
            .with_protocol_versions(&[&TLS13])?
            .with_client_cert_verifier(known.clone())
            .with_single_cert(chain.clone(), key.clone_key())?;
        let mut client = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS13])?
            .dangerous()
            .with_custom_certificate_verifier(known.clone())
            .with_client_auth_cert(chain, key.clone_key())?;
        // A resumed session would skip the check whether the peer is still trusted.
        server.send_tls13_tickets = 0;
        client.resumption = Resumption::disabled();
        client.enable_sni = false;
        Ok(Self {
            own,
            key,
            known,
            server: Arc::new(server),
            client: Arc::new(client),
        })
    }
}
