//! A hostile TLS and QUIC peer with settings of its own, with or without a certificate.

use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::time::Duration;

use fipa_testbed::{AnyPeer, frame};
use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use rustls::client::ResolvesClientCert;
use rustls::crypto::ring;
use rustls::pki_types::ServerName;
use rustls::sign::CertifiedKey;
use rustls::version::TLS13;
use rustls::{
    ClientConfig, ClientConnection, ServerConfig, ServerConnection, SignatureScheme, StreamOwned,
    SupportedProtocolVersion,
};

use super::certificates::Host;
use super::{hello_of, parcel, runtime, written};

/// Name of the hostile peer, which its certificate must have.
pub(crate) const ROGUE: &str = "rogue";

/// The ALPN protocol of QUIC connections.
pub(crate) const PROTOCOL: &[u8] = b"fipa/1";

const HELLO: u8 = 1;
const PARCEL: u8 = 2;

/// Timeout of a hung operation.
const WATCHDOG: Duration = Duration::from_secs(30);

pub(crate) type Versions = &'static [&'static SupportedProtocolVersion];

/// Returns a client configuration with this certificate and key, and these versions of TLS.
pub(crate) fn client(own: Option<&Host>, versions: Versions) -> ClientConfig {
    let own = own.map(|host| {
        let credentials = host.credentials(&[]);
        let key = ring::sign::any_supported_type(&credentials.key).unwrap();
        CertifiedKey::new(vec![credentials.own.der().clone()], key)
    });
    ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(versions)
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(Arc::new(AnyPeer))
        .with_client_cert_resolver(Arc::new(Own(own.map(Arc::new))))
}

/// Returns a server configuration that requires no client certificate.
pub(crate) fn server(own: &Host, versions: Versions) -> ServerConfig {
    let credentials = own.credentials(&[]);
    ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_protocol_versions(versions)
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![credentials.own.der().clone()], credentials.key)
        .unwrap()
}

/// Returns the bytes that the peer sends after the handshake: a hello and a letter.
pub(crate) fn hello_and_letter() -> Vec<u8> {
    let mut said = frame(HELLO, 0, &hello_of(ROGUE, 77));
    said.extend(frame(PARCEL, 1, &written(&parcel(1, "let me in"))));
    said
}

/// Sends them over TLS, and returns the reply.
pub(crate) fn greet_tls(config: ClientConfig, at: &str) -> Result<Vec<u8>, String> {
    say_tls(config, at, &hello_and_letter())
}

/// Sends these bytes over TLS, and returns the reply.
pub(crate) fn say_tls(config: ClientConfig, at: &str, said: &[u8]) -> Result<Vec<u8>, String> {
    let stream = TcpStream::connect(at).unwrap();
    stream.set_read_timeout(Some(WATCHDOG)).unwrap();
    let name = ServerName::try_from("127.0.0.1").unwrap();
    let session = ClientConnection::new(Arc::new(config), name).unwrap();
    let mut stream = StreamOwned::new(session, stream);
    stream.write_all(said).map_err(|error| error.to_string())?;
    let mut answer = vec![0; 24];
    match stream.read_exact(&mut answer) {
        Ok(()) => Ok(answer),
        Err(error) => Err(error.to_string()),
    }
}

/// Accepts one TLS connection, and returns the bytes of the other side.
pub(crate) fn hear_tls(
    config: ServerConfig,
) -> (SocketAddr, std::thread::JoinHandle<Result<Vec<u8>, String>>) {
    answer_tls(config, Vec::new())
}

/// Accepts one TLS connection, and returns the bytes of the other side. Then answers with these bytes.
pub(crate) fn answer_tls(
    config: ServerConfig,
    answer: Vec<u8>,
) -> (SocketAddr, std::thread::JoinHandle<Result<Vec<u8>, String>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = listener.local_addr().unwrap();
    let received = std::thread::spawn(move || {
        let (stream, _) = listener.accept().unwrap();
        stream.set_read_timeout(Some(WATCHDOG)).unwrap();
        let session = ServerConnection::new(Arc::new(config)).unwrap();
        let mut received = vec![0; 24];
        let mut stream = StreamOwned::new(session, stream);
        let read = stream.read_exact(&mut received);
        read.and_then(|()| stream.write_all(&answer))
            .map_err(|error| error.to_string())?;
        Ok(received)
    });
    (at, received)
}

/// Returns a QUIC configuration with this TLS configuration, protocol and version.
pub(crate) fn quic(mut tls: ClientConfig, protocol: &[u8], version: u32) -> quinn::ClientConfig {
    tls.alpn_protocols = vec![protocol.to_vec()];
    let mut config = quinn::ClientConfig::new(Arc::new(QuicClientConfig::try_from(tls).unwrap()));
    config.version(version);
    config
}

/// Sends them over QUIC, and returns the reply.
pub(crate) fn greet_quic(config: quinn::ClientConfig, at: &str) -> Result<Vec<u8>, String> {
    say_quic(config, at, &hello_and_letter())
}

/// Sends these bytes over QUIC, and returns the reply.
pub(crate) fn say_quic(
    config: quinn::ClientConfig,
    at: &str,
    said: &[u8],
) -> Result<Vec<u8>, String> {
    runtime().block_on(async {
        let endpoint = quinn::Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
        let connecting = endpoint
            .connect_with(config, at.parse().unwrap(), "x")
            .unwrap();
        let greeting = async {
            let connection = connecting.await.map_err(|error| error.to_string())?;
            let opened = connection
                .open_bi()
                .await
                .map_err(|error| error.to_string());
            let (mut send, mut receive) = opened?;
            let sent = send.write_all(said).await;
            sent.map_err(|error| error.to_string())?;
            let mut answer = vec![0; 24];
            let read = receive.read_exact(&mut answer).await;
            read.map_err(|error| error.to_string())?;
            Ok(answer)
        };
        tokio::time::timeout(WATCHDOG, greeting).await.unwrap()
    })
}

/// Returns a QUIC listener for this protocol.
pub(crate) fn listen_quic(mut tls: ServerConfig, protocol: &[u8]) -> quinn::Endpoint {
    tls.alpn_protocols = vec![protocol.to_vec()];
    let config = QuicServerConfig::try_from(tls).unwrap();
    let config = quinn::ServerConfig::with_crypto(Arc::new(config));
    quinn::Endpoint::server(config, "127.0.0.1:0".parse().unwrap()).unwrap()
}

/// Presents this certificate even if the key does not belong to it.
#[derive(Debug)]
struct Own(Option<Arc<CertifiedKey>>);

impl ResolvesClientCert for Own {
    fn resolve(&self, _: &[&[u8]], _: &[SignatureScheme]) -> Option<Arc<CertifiedKey>> {
        self.0.clone()
    }

    fn has_certs(&self) -> bool {
        self.0.is_some()
    }
}

/// The versions of TLS that endpoints require.
pub(crate) const ONLY_13: Versions = &[&TLS13];
