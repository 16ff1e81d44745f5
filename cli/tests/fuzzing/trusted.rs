//! TLS configurations of a peer with keys that accepts every server certificate.

use std::sync::Arc;

use fipa::admin::keys::Keys;
use fipa_testbed::AnyPeer;
use quinn::crypto::rustls::QuicClientConfig;
use rustls::ClientConfig;
use rustls::crypto::ring;
use rustls::version::TLS13;

/// Returns the configuration of the peer with this name and these keys, for TLS over TCP.
pub(crate) fn client(keys: &Keys, name: &str) -> Arc<ClientConfig> {
    let credentials = keys.credentials_of(name).unwrap();
    let builder = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()));
    let config = builder
        .with_protocol_versions(&[&TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AnyPeer))
        .with_client_auth_cert(vec![credentials.own.der().clone()], credentials.key)
        .unwrap();
    Arc::new(config)
}

/// Returns the same configuration for QUIC.
pub(crate) fn quic(tls: &Arc<ClientConfig>) -> quinn::ClientConfig {
    let mut tls = (**tls).clone();
    tls.alpn_protocols = vec![b"fipa/1".to_vec()];
    quinn::ClientConfig::new(Arc::new(QuicClientConfig::try_from(tls).unwrap()))
}
