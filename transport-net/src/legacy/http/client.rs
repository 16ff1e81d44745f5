//! The client: letters to platforms.
//!
//! Each platform has one connection at a time, which stays open between letters. A letter whose
//! first byte was written is never repeated: the platform may have taken it, and would take a
//! repetition for another letter.

use std::io::{self, Read as _};
#[cfg(feature = "secure")]
use std::mem::MaybeUninit;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::escape;
#[cfg(feature = "secure")]
use fipa_transport::{Answer, FailureReason};
use fipa_transport::{Conclusion, Kind, Location, Signature, TransportError, TransportErrorKind};
use socket2::SockRef;
use tokio::io::AsyncReadExt;
use tokio::net::TcpStream;
use tokio::time::{Instant, timeout_at};

use super::HttpEndpoint;
use super::request;
use super::response::{Response, ResponseReader};
use super::socket::Socket;
#[cfg(feature = "secure")]
use super::tls::HandshakeError;
use super::url::{PATH, Url};
use crate::end;
use crate::legacy::dialect::{ReplyAddress, translate};
use crate::legacy::queues::{LegacyDelivery, LegacySender, Progress};
use crate::sockets::{self, prepare};
use crate::stream::counters::count;
use crate::stream::dialing::{Unreachable, first};

/// Time for which a connection stays open without a letter: less than the 60 s after which JADE
/// closes it, because a letter on a connection that the platform closes is unconfirmed.
const IDLE: Duration = Duration::from_secs(20);

/// Time in which the rest of a record of TLS must arrive between two letters; else another connection is
/// opened.
#[cfg(feature = "secure")]
const RECORD: Duration = Duration::from_millis(200);

/// Number of bytes that are read at a time.
const READ: usize = 4096;

/// Maximum length of a request that is written in one piece.
const ONE_PIECE: usize = 64 << 10;

/// Sends letters to one platform.
pub(super) struct HttpSender {
    endpoint: Arc<HttpEndpoint>,
    to: Location,
    connection: Option<Connection>,
}

/// An open connection to a platform.
struct Connection {
    stream: Socket,
    reader: ResponseReader,
    /// The address of this endpoint for the answers of the platform, if it listens where the
    /// platform can reach it.
    own_url: Option<String>,
    used: Instant,
}

impl HttpSender {
    pub(super) fn new(endpoint: Arc<HttpEndpoint>, to: Location) -> Self {
        Self {
            endpoint,
            to,
            connection: None,
        }
    }

    async fn send(
        &mut self,
        delivery: &LegacyDelivery,
        progress: &Progress<'_>,
    ) -> Result<Conclusion, Conclusion> {
        let endpoint = self.endpoint.clone();
        let not_sent = |fault, detail: &dyn std::fmt::Display| {
            Conclusion::NotSent(TransportError::new(fault, detail))
        };
        let url = Url::parse(self.to.kind(), self.to.address())
            .map_err(|error| not_sent(TransportErrorKind::Unreachable, &error))?;
        let signature = self.to.signature();
        let sink = endpoint.stream.sink();
        let has = |name: &str| sink.as_ref().is_some_and(|sink| sink.is_here(name));
        let in_dialect = |url: Option<&str>| {
            let reply_address = url.map(|url| ReplyAddress { url, has: &has });
            translate(
                &delivery.letter,
                &delivery.receiver,
                &self.to,
                reply_address,
            )
            .map_err(|error| not_sent(error.fault(), &error))
        };
        let reusable = match self.connection.take() {
            Some(connection) => connection.usable().await,
            None => None,
        };
        let mut connection = match reusable {
            Some(connection) => connection,
            None => {
                // No connection is opened for a letter that is not sent.
                in_dialect(None)?;
                let opened = self.open(&url).await;
                opened.map_err(|error| self.not_opened(error))?
            }
        };
        let [envelope, message] = in_dialect(connection.own_url.as_deref())?;
        let Some(boundary) = endpoint.boundary(&[&envelope, &message]) else {
            let detail = "no boundary is absent from the letter";
            return Err(not_sent(TransportErrorKind::Inexpressible, &detail));
        };
        let is_text = signature != Signature::JadeBitEfficient;
        let charset = (is_text && !message.is_ascii()).then_some("UTF-8");
        let payload = (message.len(), charset);
        let (head, end) = request::write(&url, &boundary, &envelope, payload, true);
        if let Err(abandoned) = progress.begin() {
            self.connection = Some(connection);
            return Err(abandoned);
        }
        let pieces = match head.len() + message.len() <= ONE_PIECE {
            true => vec![[&head[..], &message, end.as_bytes()].concat().into()],
            false => vec![Bytes::from(head), message, Bytes::from(end)],
        };
        let timeout = endpoint.stream.limits().stall_timeout;
        for piece in pieces {
            let written = progress.write(&mut connection.stream, piece, timeout).await;
            written.map_err(|error| progress.broken(error))?;
        }
        let answer = connection.answer(timeout).await;
        let answer = answer.map_err(Conclusion::Unconfirmed)?;
        connection.used = Instant::now();
        self.connection = answer.keeps.then_some(connection);
        if answer.status != 200 {
            let reason = escape(&answer.reason);
            let detail = format!("the platform answered {} {reason}", answer.status);
            return Err(not_sent(TransportErrorKind::Refused, &detail));
        }
        count(&endpoint.stream.tally().unframed_out);
        Ok(Conclusion::Handed)
    }

    /// Returns the conclusion of a letter for which no connection was opened. It is final if the platform has
    /// proved an identity before that is no longer trusted, and proves no other one.
    fn not_opened(&self, error: TransportError) -> Conclusion {
        #[cfg(feature = "secure")]
        if error.fault == TransportErrorKind::Distrusted
            && self.endpoint.proved.is_withdrawn(&self.to)
        {
            let detail = format!(
                "the trust in the certificate of the platform was withdrawn: {}",
                error.detail
            );
            return Conclusion::Answered(Answer::failed(FailureReason::Refused, detail));
        }
        Conclusion::NotSent(error)
    }

    /// Opens a connection to the platform.
    async fn open(&self, url: &Url) -> Result<Connection, TransportError> {
        let endpoint = &self.endpoint.stream;
        let addresses = vec![url.target().to_owned()];
        let opened = first(endpoint, "tcp", addresses, sockets::connect).await;
        let (stream, peer) = opened.map_err(|Unreachable { what, .. }| {
            count(&endpoint.tally().dial_failures);
            let detail = format!("{}: {what}", url.target());
            TransportError::new(TransportErrorKind::Unreachable, detail)
        })?;
        let broken = |error| TransportError::new(TransportErrorKind::Broken, error);
        prepare(&stream, endpoint.limits()).map_err(broken)?;
        let local = stream.local_addr().map_err(broken)?;
        let stream = self.secured(url, stream, peer).await?;
        Ok(Connection {
            stream,
            reader: ResponseReader::default(),
            own_url: own_url(self.to.kind(), &endpoint.listening(), local),
            used: Instant::now(),
        })
    }

    /// Performs the handshake of TLS over a connection of `https`, in which the platform proves its
    /// identity. Without TLS, only listed platforms are excepted from the proof.
    async fn secured(
        &self,
        _url: &Url,
        stream: TcpStream,
        peer: SocketAddr,
    ) -> Result<Socket, TransportError> {
        let endpoint = &self.endpoint.stream;
        #[cfg(feature = "secure")]
        if let Some(security) = &self.endpoint.tls {
            let timeout = endpoint.limits().handshake_timeout;
            let secured = super::tls::connect(security, stream, _url, timeout).await;
            let stream = secured.map_err(|HandshakeError { fault, what }| {
                count(&endpoint.tally().dial_failures);
                TransportError::new(fault, format_args!("{peer}: {what}"))
            })?;
            self.endpoint.proved.add(&self.to, stream.proof().clone());
            return Ok(Socket::Tls(Box::new(stream)));
        }
        endpoint.config.check_legacy_peer(peer)?;
        Ok(Socket::Plain(stream))
    }
}

impl LegacySender for HttpSender {
    async fn deliver(&mut self, delivery: &LegacyDelivery, progress: &Progress<'_>) -> Conclusion {
        let sent = self.send(delivery, progress).await;
        sent.unwrap_or_else(|conclusion| conclusion)
    }

    async fn idle(&mut self) {
        let idle = IDLE.min(self.endpoint.stream.limits().idle_close);
        let Some(connection) = &mut self.connection else {
            return;
        };
        let until = connection.used + idle;
        if timeout_at(until, connection.closed()).await.is_err() {
            tracing::debug!(to = %self.to, "closing an idle connection");
        }
        self.connection = None;
    }
}

impl Connection {
    /// Reads the answer to a request.
    async fn answer(&mut self, timeout: Duration) -> Result<Response, TransportError> {
        let until = Instant::now() + timeout;
        loop {
            let answer = self.reader.next();
            let incompatible = |error| TransportError::new(TransportErrorKind::Incompatible, error);
            if let Some(answer) = answer.map_err(incompatible)? {
                return Ok(answer);
            }
            let buffer = self.reader.buffer();
            buffer.reserve(READ);
            match timeout_at(until, self.stream.read_buf(buffer)).await {
                Ok(Ok(0)) => {
                    let detail = "the platform closed the connection without an answer";
                    return Err(TransportError::new(TransportErrorKind::Broken, detail));
                }
                Ok(Ok(_)) => {}
                Ok(Err(error)) => return Err(end::of_io(error)),
                Err(_) => {
                    let detail = "the platform did not answer in time (stall_timeout)";
                    return Err(TransportError::new(TransportErrorKind::TimedOut, detail));
                }
            }
        }
    }

    /// Returns the connection if the platform has not closed it. The rest of an earlier answer may
    /// have arrived. The socket itself is queried, because the runtime learns of bytes later.
    async fn usable(mut self) -> Option<Self> {
        let mut bytes = [0; READ];
        loop {
            let read = match &self.stream {
                Socket::Plain(stream) => (&*SockRef::from(stream)).read(&mut bytes),
                #[cfg(feature = "secure")]
                Socket::Tls(_) => self.read_decrypted(&mut bytes).await,
            };
            match read {
                Ok(len @ 1..) => self.absorb(bytes.get(..len)?).then_some(())?,
                Ok(0) => return None,
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => return Some(self),
                Err(_) => return None,
            }
        }
    }

    /// Reads decrypted bytes if the runtime has some.
    #[cfg(feature = "secure")]
    fn poll_decrypted(&mut self, bytes: &mut [u8]) -> Option<io::Result<usize>> {
        use std::task::{Context, Poll, Waker};
        let mut decrypted = tokio::io::ReadBuf::new(bytes);
        let mut context = Context::from_waker(Waker::noop());
        let stream = std::pin::Pin::new(&mut self.stream);
        match tokio::io::AsyncRead::poll_read(stream, &mut context, &mut decrypted) {
            Poll::Ready(read) => Some(read.map(|()| decrypted.filled().len())),
            Poll::Pending => None,
        }
    }

    /// Reads bytes that have arrived over TLS.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] if none have, [`io::ErrorKind::TimedOut`] if a record is
    /// incomplete.
    #[cfg(feature = "secure")]
    async fn read_decrypted(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        if let Some(read) = self.poll_decrypted(bytes) {
            return read;
        }
        let socket = SockRef::from(self.stream.tcp());
        // At the end of the stream this is `Ok(0)`, as for a read.
        if socket.peek(&mut [MaybeUninit::uninit()])? == 0 {
            return Ok(0);
        }
        match timeout_at(Instant::now() + RECORD, self.stream.read(bytes)).await {
            Ok(read) => read,
            Err(_) => Err(io::ErrorKind::TimedOut.into()),
        }
    }

    /// Skips bytes that arrive between two requests. Returns whether the connection is usable.
    fn absorb(&mut self, bytes: &[u8]) -> bool {
        self.reader.buffer().extend_from_slice(bytes);
        matches!(self.reader.next(), Ok(None))
    }

    /// Completes when the platform has closed the connection.
    async fn closed(&mut self) {
        let mut bytes = [0; READ];
        loop {
            match self.stream.read(&mut bytes).await {
                Ok(len @ 1..) if self.absorb(bytes.get(..len).unwrap_or_default()) => {}
                _ => return,
            }
        }
    }
}

/// Returns the URL of this endpoint at the local address of a connection, if it listens there.
fn own_url(scheme: Kind, listening: &[String], local: SocketAddr) -> Option<String> {
    let address = sockets::listening_at(listening, local)?;
    Some(format!("{scheme}://{address}{PATH}"))
}
