//! TLS over the socket of a link: the handshake, and records in both directions.
//!
//! tokio-rustls performs the handshake. Afterwards the session is separated from its stream,
//! because sending threads write to a link directly, and its task reads.

use std::io::{self, BufRead as _, IoSlice, Write as _};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::{Buf as _, BytesMut};
use parking_lot::Mutex;
use rustls::Connection;
use rustls::pki_types::ServerName;
use tokio::net::TcpStream;
use tokio::net::tcp::{OwnedReadHalf, OwnedWriteHalf};
use tokio::time;
use tokio_rustls::{TlsAcceptor, TlsConnector};

use super::frame::Space;
use super::proof::Proof;
use super::wire::{Reading, Writing};
use crate::secure::advice::TlsFailure;
use crate::secure::{Security, advice};

/// First byte of a TLS connection: a record with a handshake (RFC 8446 section 5.1).
pub(crate) const FIRST_BYTE: u8 = 22;

/// Length of the longest record (RFC 8446 section 5.2), in bytes.
const RECORD: usize = 5 + (1 << 14) + 256;

/// Number of records that are read from the socket at once after a read that filled its buffer.
const RECORDS_AT_ONCE: usize = 4;

/// Maximum number of bytes that are encrypted and wait for the kernel. The peer decrypts the first
/// records of a large letter while this side encrypts the next ones, and the memory of so few records
/// is reused without going back to the system.
const MAX_WAITING: usize = 1 << 16;

/// A connection whose peer has proved its identity.
pub(crate) struct Secured {
    pub(crate) ends: (Reading, Writing),
    /// The proof of the peer.
    pub(crate) proof: Proof,
}

/// Performs the handshake with a peer that begins TLS.
pub(crate) async fn accept(
    security: &Security,
    stream: TcpStream,
    timeout: Duration,
) -> Result<Secured, String> {
    let acceptor = TlsAcceptor::from(security.server());
    let handshake = time::timeout(timeout, acceptor.accept(stream)).await;
    let handshake = handshake.map_err(|_| handshake_timeout(timeout))?;
    let (stream, session) = handshake
        .map_err(|error| handshake_error(&error, ACCEPT_CAUSES))?
        .into_inner();
    secured(security, stream, session.into())
}

/// Performs the handshake with the peer at this address.
pub(crate) async fn connect(
    security: &Security,
    stream: TcpStream,
    peer: SocketAddr,
    timeout: Duration,
) -> Result<Secured, String> {
    let connector = TlsConnector::from(security.client());
    // The name is neither sent nor verified: the certificate identifies the peer.
    let name = ServerName::from(peer.ip());
    let handshake = time::timeout(timeout, connector.connect(name, stream)).await;
    let handshake = handshake.map_err(|_| handshake_timeout(timeout))?;
    let (stream, session) = handshake
        .map_err(|error| handshake_error(&error, CONNECT_CAUSES))?
        .into_inner();
    secured(security, stream, session.into())
}

fn handshake_timeout(timeout: Duration) -> String {
    format!("TLS handshake not complete within {timeout:?} (handshake_timeout)")
}

/// Whether the peer ended the connection without an alert, as a peer without TLS does.
fn is_end(error: &io::Error) -> bool {
    use io::ErrorKind as E;
    matches!(
        error.kind(),
        E::UnexpectedEof | E::ConnectionReset | E::ConnectionAborted | E::BrokenPipe
    )
}

/// The possible causes if a peer that this side dialed closes the connection without an alert.
const CONNECT_CAUSES: &str = "possible causes: this host has keys and the peer has none (set security.keys there \
                              (`fipa keys init`) and trust each other's certificates, or remove \
                              security.keys here), the peer is ending or has too many connections, or no fipa \
                              gateway listens there";

/// The possible causes if a peer that began TLS, and therefore has keys, closes the connection without an alert.
const ACCEPT_CAUSES: &str = "the peer may have ended or given up; see its log";

/// Returns the error text for a failed handshake. `causes` are those of an end without an alert.
fn handshake_error(error: &io::Error, causes: &str) -> String {
    let inner = error.get_ref().and_then(|it| it.downcast_ref());
    match inner {
        Some(inner) => format!("TLS handshake failed: {}", advice::text_with_remedy(inner)),
        None if is_end(error) => format!(
            "the peer closed the connection during the TLS handshake and sent no alert ({error}); {causes}"
        ),
        None => format!("TLS handshake failed: {error}"),
    }
}

fn secured(
    security: &Security,
    stream: TcpStream,
    mut session: Connection,
) -> Result<Secured, String> {
    let trust = security.trust(session.peer_certificates());
    let trust = trust.ok_or("the peer's certificate is no longer trusted")?;
    session.set_buffer_limit(Some(MAX_WAITING));
    let (read, write) = stream.into_split();
    let session = Arc::new(Session(Mutex::new(session)));
    let incoming = Incoming {
        session: session.clone(),
        records: BytesMut::new(),
        at_once: 1,
    };
    Ok(Secured {
        ends: (Reading::Tls(read, incoming), Writing::Tls(write, session)),
        proof: trust.into(),
    })
}

/// The keys and buffers of a connection.
#[derive(Debug)]
pub(crate) struct Session(Mutex<Connection>);

impl Session {
    /// Encrypts as many bytes as there is room for, and hands them to the kernel.
    pub(crate) fn write(
        &self,
        socket: &OwnedWriteHalf,
        slices: &[IoSlice<'_>],
    ) -> io::Result<usize> {
        let mut session = self.0.lock();
        let pushed = push(&mut session, socket);
        let taken = session.writer().write_vectored(slices)?;
        if taken == 0 {
            // No room: the result of the kernel counts.
            return pushed.and(Err(io::ErrorKind::WouldBlock.into()));
        }
        match push(&mut session, socket) {
            Err(error) if error.kind() != io::ErrorKind::WouldBlock => Err(error),
            _ => Ok(taken),
        }
    }

    /// Hands encrypted bytes to the kernel.
    pub(crate) fn push(&self, socket: &OwnedWriteHalf) -> io::Result<()> {
        push(&mut self.0.lock(), socket)
    }
}

fn push(session: &mut Connection, socket: &OwnedWriteHalf) -> io::Result<()> {
    while session.wants_write() {
        session.write_tls(&mut Kernel(socket))?;
    }
    Ok(())
}

/// The socket as a writer for rustls.
struct Kernel<'a>(&'a OwnedWriteHalf);

impl io::Write for Kernel<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.try_write(bytes)
    }

    fn write_vectored(&mut self, slices: &[IoSlice<'_>]) -> io::Result<usize> {
        self.0.try_write_vectored(slices)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The reading side of a session.
pub(crate) struct Incoming {
    session: Arc<Session>,
    /// Bytes from the socket that have not been decrypted.
    records: BytesMut,
    /// Number of records that the next read has room for.
    at_once: usize,
}

impl Incoming {
    pub(crate) async fn read(
        &mut self,
        socket: &OwnedReadHalf,
        space: &mut Space<'_>,
    ) -> io::Result<usize> {
        loop {
            if let Some(taken) = self.decrypt(space)? {
                return Ok(taken);
            }
            socket.readable().await?;
            // All of its bytes are in the session.
            self.records.reserve(self.at_once * RECORD);
            match socket.try_read_buf(&mut self.records) {
                Ok(0) => return Ok(0),
                Ok(_) => {
                    let is_full = self.records.len() == self.records.capacity();
                    self.at_once = if is_full { RECORDS_AT_ONCE } else { 1 };
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error),
            }
        }
    }

    /// Copies decrypted bytes into `space`. Returns `None` when more records are needed, and 0 when
    /// the peer has closed its direction.
    fn decrypt(&mut self, space: &mut Space<'_>) -> io::Result<Option<usize>> {
        let mut session = self.session.0.lock();
        loop {
            let mut reader = session.reader();
            match reader.fill_buf() {
                Ok(chunk) => {
                    let len = space.fill(chunk);
                    reader.consume(len);
                    return Ok(Some(len));
                }
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error),
            }
            if self.records.is_empty() {
                return Ok(None);
            }
            session.read_tls(&mut (&mut self.records).reader())?;
            let processed = session.process_new_packets();
            // In TLS 1.3 a client completes the handshake before the server has accepted its
            // certificate.
            processed.map_err(|error| TlsFailure::io(advice::text_with_remedy(&error)))?;
        }
    }
}
