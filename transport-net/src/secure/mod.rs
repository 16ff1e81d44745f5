//! Mutual TLS 1.3 (RFC 8446) between services that trust each other's certificates.
//!
//! There is no certification authority. A peer is trusted because its owner gave its certificate to
//! the owner of this host, who added it to the trusted ones; the certificate that a peer presents
//! is compared with them. Withdrawing trust is removing a certificate, which ends the connections
//! that were opened with it. Only a platform that is dialed over `https` may instead present a chain
//! of certificates from a listed authority.
//!
//! * `certificate`: the contents of a certificate.
//! * `advice`: remedies when a peer is not trusted.
//! * `verify`: the verification of a presented certificate.
//! * `key_log`: the file that receives the secrets of connections, if the owner of the host asks for it.
//! * `platform`: the same for platforms that are reached over `https`, and their authorities.
//! * `trust`: the trust in the peer of a connection, for as long as the connection is open.
//!
//! Files and the handling of letters do not belong here.

pub(crate) mod advice;
mod certificate;
mod key_log;
#[cfg(feature = "http")]
mod platform;
mod trust;
mod verify;

use std::fmt;
use std::io;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use parking_lot::{Mutex, RwLock};
use rustls::client::Resumption;
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::server::NoClientAuth;
use rustls::server::danger::ClientCertVerifier;
use rustls::version::TLS13;
use rustls::{ClientConfig, ServerConfig};
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio_rustls::TlsAcceptor;

pub use self::certificate::{
    Certificate, CertificateError, Certified, Fingerprint, alternative_names,
};
pub use self::key_log::{KeyLog, KeyLogError};
#[cfg(feature = "http")]
pub use self::platform::{Authorities, AuthoritiesError};
use self::trust::Evidence;
pub(crate) use self::trust::Trust;
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
    /// Certificates that prove no peer, even if they are trusted or an authority has signed them.
    pub revoked: Vec<Fingerprint>,
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
    /// Held during a replacement.
    replacing: Arc<Mutex<()>>,
    /// Counts replacements.
    replaced: watch::Sender<u64>,
    rules: Rules,
}

/// The peers that must prove their identity.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Rules {
    /// Whether legacy peers at loopback addresses must prove their identity, too. Peers that send frames always
    /// must, unless processes of this host connect over loopback.
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
    key_log: Arc<dyn rustls::KeyLog>,
    server: Arc<ServerConfig>,
    /// For clients that prove nothing.
    client_server: Arc<ServerConfig>,
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
            replacing: Arc::default(),
            replaced: watch::Sender::new(0),
            rules,
        })
    }

    /// Replaces the credentials. Connections with peers that are no longer trusted end.
    ///
    /// # Errors
    /// When the credentials cannot be used; the previous ones stay in use.
    pub fn replace(&self, credentials: Credentials) -> Result<(), CredentialsError> {
        self.change(|now| Prepared::after(&now.known, credentials, &now.key_log))
    }

    /// Replaces the trusted peers, and keeps the key and certificate. These certificates are revoked in
    /// addition to those that already are.
    ///
    /// # Errors
    /// When the credentials cannot be used; the previous ones stay in use.
    pub fn trust_only(
        &self,
        trusted: Vec<Certificate>,
        mut revoked: Vec<Fingerprint>,
    ) -> Result<(), CredentialsError> {
        self.change(|now| {
            revoked.extend(now.known.revoked());
            let own = now.own.fingerprint();
            let known = now.known.with_certificates(own, trusted, revoked);
            Prepared::with(now.own.clone(), now.key.clone_key(), known, &now.key_log)
        })
    }

    /// Writes the secrets of all later connections to a key log.
    ///
    /// # Errors
    /// When the credentials cannot be used any more; the previous state stays.
    pub fn log_keys(&self, key_log: KeyLog) -> Result<(), CredentialsError> {
        let key_log: Arc<dyn rustls::KeyLog> = Arc::new(key_log);
        self.change(|now| {
            let known = Arc::clone(&now.known);
            Prepared::with_known(now.own.clone(), now.key.clone_key(), known, &key_log)
        })
    }

    /// Replaces the authorities that prove the host names of platforms over `https`.
    ///
    /// # Errors
    /// When the credentials cannot be used with them; the previous ones stay in use.
    #[cfg(feature = "http")]
    pub fn set_authorities(&self, authorities: Authorities) -> Result<(), CredentialsError> {
        self.change(|now| {
            let known = now.known.with_authorities(authorities);
            Prepared::with(now.own.clone(), now.key.clone_key(), known, &now.key_log)
        })
    }

    /// Replaces the credentials by changed ones. They are prepared without the lock that connections take.
    fn change(
        &self,
        change: impl FnOnce(&Prepared) -> Result<Prepared, CredentialsError>,
    ) -> Result<(), CredentialsError> {
        let _replacing = self.replacing.lock();
        let before = Arc::clone(&self.now.read());
        let after = Arc::new(change(&before)?);
        *self.now.write() = after;
        // Connections are judged by the new credentials from here on.
        self.replaced.send_modify(|count| *count += 1);
        Ok(())
    }

    /// Whether a peer at this address must prove its identity.
    pub(crate) fn covers(&self, ip: IpAddr) -> bool {
        self.rules.loopback || !ip.to_canonical().is_loopback()
    }

    /// Whether this is the address of a legacy peer.
    pub(crate) fn excepts(&self, ip: IpAddr) -> bool {
        self.rules.legacy_peers.contains(&ip.to_canonical())
    }

    /// Returns the number of replacements of the credentials so far.
    #[must_use]
    pub fn revision(&self) -> u64 {
        *self.replaced.borrow()
    }

    /// Returns a receiver that is notified when the credentials have been replaced.
    fn changes(&self) -> watch::Receiver<u64> {
        self.replaced.subscribe()
    }

    /// Returns the fingerprint of the certificate that this host presents now.
    #[must_use]
    pub fn own(&self) -> Fingerprint {
        self.now.read().own.fingerprint()
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
        let verifier = Arc::new(platform::AnyClient::new(&now.known));
        server(verifier, &now.own, &now.key, &now.key_log)
    }

    /// Returns the configuration of TLS with a platform that is dialed. It proves its identity with a
    /// trusted certificate, or with one of an authority for its name.
    #[cfg(feature = "http")]
    pub(crate) fn platform_client(&self) -> Result<Arc<ClientConfig>, rustls::Error> {
        let now = self.now.read().clone();
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let verifier = platform::Server::new(now.known.clone());
        let mut client = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS13])?
            .dangerous()
            .with_custom_certificate_verifier(Arc::new(verifier))
            .with_client_auth_cert(vec![now.own.der().clone()], now.key.clone_key())?;
        client.resumption = Resumption::disabled();
        client.key_log = Arc::clone(&now.key_log);
        Ok(Arc::new(client))
    }

    /// Performs the handshake with a client that proves nothing, such as a browser. This host proves its key.
    ///
    /// # Errors
    /// Fails if the handshake does.
    pub async fn accept_client(
        self,
        stream: TcpStream,
    ) -> io::Result<impl AsyncRead + AsyncWrite + Unpin + Send + 'static> {
        let server = Arc::clone(&self.now.read().client_server);
        TlsAcceptor::from(server).accept(stream).await
    }

    /// Returns the trust in a peer that has presented these certificates in a handshake. `None` if the
    /// first one is not trusted.
    pub(crate) fn trust(&self, presented: Option<&[CertificateDer<'_>]>) -> Option<Trust> {
        // Read before the certificates: a later change is judged again.
        let revision = self.revision();
        let presented = presented?.first()?;
        let certificate = self.now.read().known.find(presented).cloned()?;
        Some(Trust::new(self, revision, Evidence::Listed(certificate)))
    }

    /// Returns the trust in a platform that has dialed. `None` if its certificate is not trusted, or not
    /// valid now: the handshake requires neither.
    #[cfg(feature = "http")]
    pub(crate) fn trust_in_client(
        &self,
        presented: Option<&[CertificateDer<'_>]>,
    ) -> Option<Trust> {
        let trust = self.trust(presented)?;
        let now = rustls::pki_types::UnixTime::now();
        let holds = trust.certificate()?.holds(now);
        (holds == certificate::Holds::Now).then_some(trust)
    }

    /// Returns the trust in a platform that was dialed under this name.
    #[cfg(feature = "http")]
    pub(crate) fn trust_in_server(
        &self,
        presented: Option<&[CertificateDer<'_>]>,
        name: &rustls::pki_types::ServerName<'static>,
    ) -> Option<Trust> {
        if let Some(trust) = self.trust(presented) {
            return Some(trust);
        }
        let revision = self.revision();
        let chain = trust::Chain::new(presented?, name)?;
        let evidence = Evidence::Chain(chain);
        let is_trusted = self.still_trusts(&evidence);
        is_trusted.then(|| Trust::new(self, revision, evidence))
    }

    /// Whether the credentials still trust a peer that has presented this. The end of a trusted certificate
    /// does not count here, see [`time_left`](Self::time_left).
    fn still_trusts(&self, evidence: &Evidence) -> bool {
        let known = Arc::clone(&self.now.read().known);
        match evidence {
            Evidence::Listed(certificate) => known.trusts(certificate.fingerprint()),
            #[cfg(feature = "http")]
            Evidence::Chain(chain) => known.trusts_chain(chain, SystemTime::now()),
        }
    }

    /// Returns the time until what a peer has presented must be judged again; zero if it has expired.
    fn time_left(&self, evidence: &Evidence, now: SystemTime) -> Duration {
        match evidence {
            Evidence::Listed(certificate) => certificate.time_left(now),
            #[cfg(feature = "http")]
            Evidence::Chain(chain) => match self.still_trusts(evidence) {
                true => chain.next_end(now),
                false => Duration::ZERO,
            },
        }
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
        let nothing = Known::of(credentials.own.fingerprint());
        let no_log: Arc<dyn rustls::KeyLog> = Arc::new(rustls::NoKeyLog);
        Self::after(&nothing, credentials, &no_log)
    }

    /// Prepares credentials that take the place of earlier ones, whose authorities stay.
    fn after(
        before: &Known,
        credentials: Credentials,
        key_log: &Arc<dyn rustls::KeyLog>,
    ) -> Result<Self, CredentialsError> {
        let Credentials {
            own,
            key,
            trusted,
            revoked,
        } = credentials;
        let known = before.with_certificates(own.fingerprint(), trusted, revoked);
        Self::with(own, key, known, key_log)
    }

    fn with(
        own: Certificate,
        key: PrivateKeyDer<'static>,
        known: Known,
        key_log: &Arc<dyn rustls::KeyLog>,
    ) -> Result<Self, CredentialsError> {
        Self::with_known(own, key, Arc::new(known), key_log)
    }

    fn with_known(
        own: Certificate,
        key: PrivateKeyDer<'static>,
        known: Arc<Known>,
        key_log: &Arc<dyn rustls::KeyLog>,
    ) -> Result<Self, CredentialsError> {
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let chain = vec![own.der().clone()];
        let anyone = Arc::new(NoClientAuth);
        let mut client = ClientConfig::builder_with_provider(provider)
            .with_protocol_versions(&[&TLS13])?
            .dangerous()
            .with_custom_certificate_verifier(known.clone())
            .with_client_auth_cert(chain, key.clone_key())?;
        // A resumed session would skip the check whether the peer is still trusted.
        client.resumption = Resumption::disabled();
        client.enable_sni = false;
        client.key_log = Arc::clone(key_log);
        Ok(Self {
            server: server(known.clone(), &own, &key, key_log)?,
            client_server: server(anyone, &own, &key, key_log)?,
            own,
            key,
            known,
            key_log: Arc::clone(key_log),
            client: Arc::new(client),
        })
    }
}

/// The configuration of TLS with peers that dial, whose certificates this verifier judges.
fn server(
    verifier: Arc<dyn ClientCertVerifier>,
    own: &Certificate,
    key: &PrivateKeyDer<'static>,
    key_log: &Arc<dyn rustls::KeyLog>,
) -> Result<Arc<ServerConfig>, rustls::Error> {
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let mut server = ServerConfig::builder_with_provider(provider)
        .with_protocol_versions(&[&TLS13])?
        .with_client_cert_verifier(verifier)
        .with_single_cert(vec![own.der().clone()], key.clone_key())?;
    // A resumed session would skip the check whether the peer is still trusted.
    server.send_tls13_tickets = 0;
    server.key_log = Arc::clone(key_log);
    Ok(Arc::new(server))
}
