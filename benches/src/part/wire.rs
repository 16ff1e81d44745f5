//! Bare connections between the halves of a relay: TCP, rustls over TCP, or quinn.
//!
//! Each direction is used by a thread of its own. A rustls session cannot be split, so that each
//! direction has its own TCP connection with its own session. quinn has one connection with one
//! stream, and its runtime has a thread of its own.

use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;

use quinn::crypto::rustls::{QuicClientConfig, QuicServerConfig};
use quinn::{Endpoint, RecvStream, SendStream, TransportConfig, VarInt};
use rustls::crypto::ring::default_provider;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, ServerName};
use rustls::version::TLS13;
use rustls::{
    ClientConfig, ClientConnection, RootCertStore, ServerConfig, ServerConnection, StreamOwned,
};
use serde::{Deserialize, Serialize};
use tokio::runtime::{Builder, Handle, Runtime};

use super::orders::to_text;

/// The name in the certificate of the half that accepts.
const NAME: &str = "relay";

/// Maximum number of bytes that quinn sends without an acknowledgment, as in the transport.
const WINDOW: u32 = 8 << 20;

/// The protocol between the halves of a relay.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Wire {
    Tcp,
    /// rustls over TCP.
    Tls,
    /// quinn.
    Quic,
}

/// Both directions of a connection, for blocking calls.
pub(super) struct Connection {
    pub(super) send: Box<dyn Write + Send>,
    pub(super) receive: Box<dyn Read + Send>,
}

/// Connects to the address of a [`Listener`].
pub(super) fn connect(wire: Wire, to: &str) -> Result<Connection, String> {
    let (address, certificate) = match to.split_once(' ') {
        Some((address, certificate)) => (address, from_hex(certificate)?),
        None => (to, Vec::new()),
    };
    let address: SocketAddr = address.parse().map_err(to_text)?;
    match wire {
        Wire::Tcp => both(without_delay(TcpStream::connect(address))?),
        Wire::Tls => {
            let config = Arc::new(client(certificate)?);
            let connect = || {
                let name = ServerName::try_from(NAME).map_err(to_text)?;
                let session = ClientConnection::new(Arc::clone(&config), name);
                let socket = without_delay(TcpStream::connect(address))?;
                Ok::<_, String>(StreamOwned::new(session.map_err(to_text)?, socket))
            };
            // The order in which the other half accepts them.
            let (send, receive) = (connect()?, connect()?);
            Ok(Connection {
                send: Box::new(send),
                receive: Box::new(receive),
            })
        }
        Wire::Quic => {
            let crypto = QuicClientConfig::try_from(client(certificate)?).map_err(to_text)?;
            let mut config = quinn::ClientConfig::new(Arc::new(crypto));
            config.transport_config(windows());
            let runtime = runtime()?;
            let connected = runtime.block_on(async {
                let endpoint = Endpoint::client((Ipv4Addr::LOCALHOST, 0).into())?;
                let dialed = endpoint.connect_with(config, address, NAME);
                let connection = dialed.map_err(io::Error::other)?.await?;
                Ok::<_, io::Error>(connection.open_bi().await?)
            });
            Ok(streams(connected.map_err(to_text)?, runtime))
        }
    }
}

/// Accepts the connection of the other half.
pub(super) enum Listener {
    Tcp(TcpListener),
    Tls(TcpListener, Arc<ServerConfig>, CertificateDer<'static>),
    Quic(Endpoint, Runtime, CertificateDer<'static>),
}

impl Listener {
    /// Listens on a port of the loopback interface.
    pub(super) fn bind(wire: Wire) -> Result<Self, String> {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, 0));
        if wire == Wire::Tcp {
            return TcpListener::bind(address).map(Self::Tcp).map_err(to_text);
        }
        let (config, certificate) = server()?;
        if wire == Wire::Tls {
            let listener = TcpListener::bind(address).map_err(to_text)?;
            return Ok(Self::Tls(listener, Arc::new(config), certificate));
        }
        let crypto = QuicServerConfig::try_from(config).map_err(to_text)?;
        let mut config = quinn::ServerConfig::with_crypto(Arc::new(crypto));
        config.transport_config(windows());
        let runtime = runtime()?;
        let endpoint = {
            let _entered = runtime.enter();
            Endpoint::server(config, address).map_err(to_text)?
        };
        Ok(Self::Quic(endpoint, runtime, certificate))
    }

    /// Address and port, followed by the certificate in hexadecimal digits if there is one.
    pub(super) fn address(&self) -> Result<String, String> {
        let (address, certificate) = match self {
            Self::Tcp(listener) => (listener.local_addr(), None),
            Self::Tls(listener, _, certificate) => (listener.local_addr(), Some(certificate)),
            Self::Quic(endpoint, _, certificate) => (endpoint.local_addr(), Some(certificate)),
        };
        let mut text = address.map_err(to_text)?.to_string();
        if let Some(certificate) = certificate {
            text.push(' ');
            text.extend(certificate.iter().map(|byte| format!("{byte:02x}")));
        }
        Ok(text)
    }

    /// Waits for the other half.
    pub(super) fn accept(self) -> Result<Connection, String> {
        match self {
            Self::Tcp(listener) => both(accepted(&listener)?),
            Self::Tls(listener, config, _) => {
                let accept = || {
                    let session = ServerConnection::new(Arc::clone(&config)).map_err(to_text)?;
                    Ok::<_, String>(StreamOwned::new(session, accepted(&listener)?))
                };
                let (receive, send) = (accept()?, accept()?);
                Ok(Connection {
                    send: Box::new(send),
                    receive: Box::new(receive),
                })
            }
            Self::Quic(endpoint, runtime, _) => {
                let accepted = runtime.block_on(async {
                    let incoming = endpoint.accept().await;
                    let incoming = incoming.ok_or_else(|| io::Error::other("closed"))?;
                    Ok::<_, io::Error>(incoming.await?.accept_bi().await?)
                });
                Ok(streams(accepted.map_err(to_text)?, runtime))
            }
        }
    }
}

fn accepted(listener: &TcpListener) -> Result<TcpStream, String> {
    without_delay(listener.accept().map(|(socket, _)| socket))
}

fn without_delay(socket: io::Result<TcpStream>) -> Result<TcpStream, String> {
    let socket = socket.map_err(to_text)?;
    socket.set_nodelay(true).map_err(to_text)?;
    Ok(socket)
}

fn both(socket: TcpStream) -> Result<Connection, String> {
    let receive = socket.try_clone().map_err(to_text)?;
    Ok(Connection {
        send: Box::new(socket),
        receive: Box::new(receive),
    })
}

/// A session with a new certificate. Without session tickets, which no one would read.
fn server() -> Result<(ServerConfig, CertificateDer<'static>), String> {
    let made = rcgen::generate_simple_self_signed([NAME.to_owned()]).map_err(to_text)?;
    let certificate = CertificateDer::from(made.cert);
    let key = PrivatePkcs8KeyDer::from(made.signing_key.serialize_der());
    let config = ServerConfig::builder_with_provider(Arc::new(default_provider()))
        .with_protocol_versions(&[&TLS13])
        .map_err(to_text)?
        .with_no_client_auth()
        .with_single_cert(vec![certificate.clone()], PrivateKeyDer::Pkcs8(key));
    let mut config = config.map_err(to_text)?;
    config.send_tls13_tickets = 0;
    Ok((config, certificate))
}

fn client(certificate: Vec<u8>) -> Result<ClientConfig, String> {
    let mut roots = RootCertStore::empty();
    roots.add(certificate.into()).map_err(to_text)?;
    let builder = ClientConfig::builder_with_provider(Arc::new(default_provider()))
        .with_protocol_versions(&[&TLS13])
        .map_err(to_text)?;
    Ok(builder.with_root_certificates(roots).with_no_client_auth())
}

fn windows() -> Arc<TransportConfig> {
    let mut config = TransportConfig::default();
    config
        .stream_receive_window(VarInt::from_u32(WINDOW))
        .receive_window(VarInt::from_u32(WINDOW))
        .send_window(WINDOW.into());
    Arc::new(config)
}

/// A runtime with one thread, which sends and receives the packets.
fn runtime() -> Result<Runtime, String> {
    let mut builder = Builder::new_multi_thread();
    builder
        .worker_threads(1)
        .enable_all()
        .build()
        .map_err(to_text)
}

fn streams((send, receive): (SendStream, RecvStream), runtime: Runtime) -> Connection {
    let runtime = Arc::new(runtime);
    Connection {
        send: Box::new(QuicWriter(send, Arc::clone(&runtime))),
        receive: Box::new(QuicReader(receive, runtime)),
    }
}

struct QuicWriter(SendStream, Arc<Runtime>);

impl Write for QuicWriter {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let handle: &Handle = self.1.handle();
        Ok(handle.block_on(self.0.write(bytes))?)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

struct QuicReader(RecvStream, Arc<Runtime>);

impl Read for QuicReader {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        let handle: &Handle = self.1.handle();
        Ok(handle.block_on(self.0.read(into))?.unwrap_or(0))
    }
}

fn from_hex(text: &str) -> Result<Vec<u8>, String> {
    let digits = text.as_bytes().chunks(2);
    digits
        .map(|two| {
            let two = std::str::from_utf8(two).map_err(to_text)?;
            u8::from_str_radix(two, 16).map_err(to_text)
        })
        .collect()
}
