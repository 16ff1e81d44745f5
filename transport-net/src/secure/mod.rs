//! Who may speak with this host: mutual TLS 1.3 (RFC 8446) between services that know each other's
//! certificates.
//!
//! There is no authority that vouches for others. A peer is trusted because its owner gave its
//! certificate to the owner of this host, who put it among those trusted; what a peer presents is
//! compared with it. So nothing is left to be decided about chains, and withdrawing trust is
//! taking a certificate out again, which ends the connections that were opened with it.
//!
//! * `certificate`: what a certificate says.
//! * `advice`: what to do when a peer is not let in.
//! * `verify`: whether whoever presents one is trusted.
//!
//! What must not live here: files, and what is done with letters.

pub(crate) mod advice;
mod certificate;
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

/// What a host is known by, and whom it knows.
#[derive(Debug)]
pub struct Credentials {
    /// This host's own certificate.
    pub own: Certificate,
    /// The private key that belongs to it, in PKCS #8.
    pub key: PrivateKeyDer<'static>,
    /// The certificates of trusted peers.
    pub trusted: Vec<Certificate>,
}

/// Credentials that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("this key and this certificate cannot be used together: {0}")]
#[non_exhaustive]
pub struct CredentialsError(#[from] rustls::Error);

/// The credentials of an endpoint. Clones are the same; [`replace`](Self::replace) changes all of
/// them.
#[derive(Clone)]
pub struct Security {
    now: Arc<RwLock<Arc<Prepared>>>,
    /// Counts replacements.
    replaced: watch::Sender<u64>,
    rules: Rules,
}

/// Who has to prove who it is.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Rules {
    /// Whether peers on loopback addresses have to, where this host usually speaks with itself.
    pub loopback: bool,
    /// Addresses of old peers, which cannot. Letters in their dialects are exchanged with them, and
    /// nothing else.
    pub old_peers: Vec<IpAddr>,
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
    /// Speaks with trusted peers only, but for what the rules leave out.
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

    /// Uses other credentials from now on. Connections with peers that are not trusted any more end.
    ///
    /// # Errors
    /// When they cannot be used; those before stay.
    pub fn replace(&self, credentials: Credentials) -> Result<(), CredentialsError> {
        let prepared = Arc::new(Prepared::new(credentials)?);
        *self.now.write() = prepared;
        self.replaced.send_modify(|count| *count += 1);
        Ok(())
    }

    /// Trusts these peers and no others from now on, with the key and certificate there were.
    ///
    /// # Errors
    /// When they cannot be used; those before stay.
    pub fn trust_only(&self, trusted: Vec<Certificate>) -> Result<(), CredentialsError> {
        let (own, key) = {
            let now = self.now.read();
            (now.own.clone(), now.key.clone_key())
        };
        self.replace(Credentials { own, key, trusted })
    }

    /// Whether whoever is at this address has to prove who it is.
    pub(crate) fn covers(&self, ip: IpAddr) -> bool {
        self.rules.loopback || !ip.to_canonical().is_loopback()
    }

    /// Whether an old peer may be at this address.
    pub(crate) fn excepts(&self, ip: IpAddr) -> bool {
        self.rules.old_peers.contains(&ip.to_canonical())
    }

    /// Counts up when trust has changed.
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

    /// What the certificate says that a peer has proved to be its own.
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
        let known = Arc::new(Known::new(trusted, &provider));
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
        // A session that is resumed would not ask whether the peer is still trusted.
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
