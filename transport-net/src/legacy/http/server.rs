//! The server: letters from platforms.
//!
//! A connection carries requests one after the other. A letter has been handed on when its request
//! is answered.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant as Now};

use bytes::{BufMut, Bytes};
use fipa_transport::{
    LegacySource, Signature, TransportError, TransportErrorKind, log_limit, quota_address,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::oneshot;
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep_until, timeout_at};

use super::HttpEndpoint;
use super::connections::Slot;
use super::head::MAX_HEAD;
use super::letter::{self, LetterError};
use super::repeats::Arrived;
use super::request::{RequestError, RequestHead, RequestReader, Status};
use super::socket::Socket;
use crate::end;
use crate::sockets::prepare;
use crate::stream::budget::ReservedBytes;
use crate::stream::config::NetLimits;
use crate::stream::counters::count;
use crate::stream::proof::Proof;
use crate::stream::source::{Home, QuotaKey, Source};

/// Number of bytes that are read at a time, except for bodies.
const READ: usize = 4096;

/// Minimum length of a body whose memory is reserved in the budget of the endpoint.
const COUNTED_FROM: usize = 64 << 10;

/// Time that a client has to read the answer to a refused request, and the maximum number of bytes
/// that are read meanwhile: closing a connection with unread bytes would discard the answer.
const LAST_ANSWER: Duration = Duration::from_secs(1);
const LAST_BYTES: usize = 256 << 10;

/// The reason for which a connection is closed with an answer.
#[derive(Debug, thiserror::Error)]
enum Refusal {
    #[error(transparent)]
    Request(#[from] RequestError),
    #[error(transparent)]
    Letter(#[from] LetterError),
    #[error("the peer cannot prove its identity, and is not listed in security.legacy_peers")]
    Unproved,
    #[cfg(feature = "secure")]
    #[error("the certificate of the platform does not name the sender of the letter")]
    NotItsAgent,
    /// The proof of the platform no longer counts.
    #[error(transparent)]
    Withdrawn(TransportError),
    #[error("the head of the request arrived too slowly (handshake_timeout)")]
    SlowHead,
    #[error("the body arrived too slowly (stall_timeout)")]
    SlowBody,
    #[error("timed out waiting for memory for the letter (max_incoming)")]
    NoRoom,
}

/// The reason for which a connection ends.
#[derive(Debug)]
enum End {
    Refused(Refusal),
    /// The connection is over: idle, closed by the client, or broken.
    Over,
}

impl From<io::Error> for End {
    fn from(error: io::Error) -> Self {
        match end::of_io(error) {
            error if error.fault == TransportErrorKind::Refused => Refusal::Withdrawn(error).into(),
            error => {
                tracing::debug!("HTTP connection failed: {error}");
                Self::Over
            }
        }
    }
}

impl From<Refusal> for End {
    fn from(refusal: Refusal) -> Self {
        Self::Refused(refusal)
    }
}

impl From<RequestError> for End {
    fn from(error: RequestError) -> Self {
        Refusal::from(error).into()
    }
}

impl From<LetterError> for End {
    fn from(error: LetterError) -> Self {
        Refusal::from(error).into()
    }
}

impl Refusal {
    fn status(&self) -> Status {
        match self {
            Self::Request(error) => error.status(),
            Self::Letter(error) => error.status(),
            Self::Unproved => Status::Forbidden,
            #[cfg(feature = "secure")]
            Self::NotItsAgent => Status::Forbidden,
            Self::Withdrawn(_) => Status::Forbidden,
            Self::SlowHead | Self::SlowBody => Status::Timeout,
            Self::NoRoom => Status::Unavailable,
        }
    }
}

/// Accepts connections until it is aborted.
pub(super) async fn accept(endpoint: Arc<HttpEndpoint>, listener: TcpListener) {
    loop {
        match listener.accept().await {
            Ok((stream, from)) => admit(&endpoint, stream, from),
            Err(error) => endpoint.stream.accept_failed(&error).await,
        }
    }
}

/// Starts the task of an accepted connection, if there is a slot for it.
fn admit(endpoint: &Arc<HttpEndpoint>, stream: TcpStream, from: SocketAddr) {
    let (config, tally) = (&endpoint.stream.config, endpoint.stream.tally());
    let quota_key = QuotaKey::of(Source::Address(from), None);
    let each = config.max_connections_of(&quota_key);
    let all = config.limits.max_connections;
    let Some((slot, evicted)) = endpoint.connections.admit(from.ip(), each, all) else {
        count(&tally.refused_crowd);
        log_limit::warn!(
            of: quota_address(from.ip()),
            "{from}: HTTP connection closed: too many connections"
        );
        return;
    };
    if let Some(task) = evicted {
        count(&tally.refused_crowd);
        task.abort();
    }
    // Other connections can evict this one, so the task starts when its own handle is known.
    let (handle, own) = oneshot::channel();
    let serving = Serving {
        endpoint: endpoint.clone(),
        slot,
        stream: Socket::Plain(stream),
        proof: Proof::default(),
        from,
        quota_key,
        reader: RequestReader::default(),
        first: true,
    };
    let task = endpoint.stream.runtime.spawn(serving.run(own));
    let _ended = handle.send(task.abort_handle());
}

/// A connection.
struct Serving {
    endpoint: Arc<HttpEndpoint>,
    slot: Slot,
    stream: Socket,
    from: SocketAddr,
    quota_key: QuotaKey,
    reader: RequestReader,
    /// Whether no letter has arrived yet.
    first: bool,
    /// The proof of the platform by a trusted certificate.
    proof: Proof,
}

impl Serving {
    async fn run(mut self, own: oneshot::Receiver<AbortHandle>) {
        let Ok(task) = own.await else {
            return;
        };
        if !self.slot.started(task) {
            return;
        }
        #[cfg(feature = "secure")]
        if self.endpoint.tls.is_some() {
            self = match self.secured().await {
                Some(secured) => secured,
                None => return,
            };
        }
        let Err(End::Refused(refusal)) = self.serve().await else {
            return;
        };
        let tally = self.endpoint.stream.tally();
        let counter = match refusal {
            Refusal::Unproved => &tally.refused_unproved,
            #[cfg(feature = "secure")]
            Refusal::NotItsAgent => &tally.refused_unproved,
            Refusal::Withdrawn(_) => &tally.refused_unproved,
            _ => &tally.refused_nonsense,
        };
        count(counter);
        let from = self.from;
        log_limit::warn!(of: quota_address(from.ip()), "{from}: HTTP request refused: {refusal}");
        let refused = self.refuse(refusal.status());
        if let Ok(Err(error)) = tokio::time::timeout(LAST_ANSWER, refused).await {
            tracing::debug!(%from, "cannot answer a refused request: {error}");
        }
    }

    /// Performs the handshake of TLS.
    #[cfg(feature = "secure")]
    async fn secured(mut self) -> Option<Self> {
        let endpoint = Arc::clone(&self.endpoint);
        let security = endpoint.tls.as_ref()?;
        let timeout = self.limits().handshake_timeout;
        let Socket::Plain(stream) = self.stream else {
            return None;
        };
        match super::tls::accept(security, stream, timeout).await {
            Ok((stream, proof)) => {
                self.stream = Socket::Tls(Box::new(stream));
                self.proof = proof;
                Some(self)
            }
            Err(what) => {
                count(&endpoint.stream.tally().refused_unproved);
                let from = self.from;
                log_limit::warn!(
                    of: quota_address(from.ip()),
                    "{from}: HTTPS connection refused: {what}"
                );
                None
            }
        }
    }

    /// Answers a refused request, and reads what the client still sends.
    async fn refuse(&mut self, status: Status) -> io::Result<()> {
        self.stream.release();
        self.stream
            .write_all(status.answer(false).as_bytes())
            .await?;
        self.stream.shutdown().await?;
        let (mut ignored, mut read) = ([0; READ], 0);
        while read < LAST_BYTES {
            match self.stream.read(&mut ignored).await? {
                0 => break,
                more => read += more,
            }
        }
        Ok(())
    }

    /// Serves requests until the connection ends.
    async fn serve(&mut self) -> Result<(), End> {
        prepare(self.stream.tcp(), self.limits())?;
        let is_admitted = self.proof.principal().is_some()
            || self
                .endpoint
                .stream
                .config
                .gives_legacy_peers_at(self.from.ip());
        if !is_admitted {
            return Err(Refusal::Unproved.into());
        }
        loop {
            self.first_byte().await?;
            let timeout = self.limits().handshake_timeout;
            let head = tokio::time::timeout(timeout, self.head()).await;
            let head = head.map_err(|_| Refusal::SlowHead)??;
            let (body, room) = self.body(&head).await?;
            self.take(&head, body).await?;
            drop(room);
            let answer = Status::Ok.answer(head.keeps);
            let timeout = self.limits().stall_timeout;
            match tokio::time::timeout(timeout, self.stream.write_all(answer.as_bytes())).await {
                Ok(written) => written?,
                Err(_) => return Err(End::Over),
            }
            if !head.keeps {
                self.stream.shutdown().await?;
                return Ok(());
            }
            self.slot.set_idle(true);
        }
    }

    fn limits(&self) -> &NetLimits {
        self.endpoint.stream.limits()
    }

    /// Waits for the first byte of a request.
    async fn first_byte(&mut self) -> Result<(), End> {
        let limits = self.limits();
        let timeout = match self.first {
            true => limits.handshake_timeout,
            false => limits.idle_close,
        };
        let until = Instant::now() + timeout;
        while self.reader.is_idle()? {
            match timeout_at(until, self.read(READ)).await {
                Ok(read) => read?,
                Err(_) => return Err(End::Over),
            }
        }
        self.slot.set_idle(false);
        Ok(())
    }

    /// Reads at most this many bytes more. The buffer grows by no more than that.
    async fn read(&mut self, most: usize) -> Result<(), End> {
        let buffer = self.reader.buffer();
        buffer.reserve(most.min(READ));
        match self.stream.read_buf(&mut buffer.limit(most)).await? {
            0 => Err(End::Over),
            _ => Ok(()),
        }
    }

    /// Reads the head of a request.
    async fn head(&mut self) -> Result<RequestHead, End> {
        let max_body = self.limits().max_letter.saturating_add(MAX_HEAD);
        loop {
            match self.reader.head(max_body)? {
                Some(head) => return Ok(head),
                None => self.read(READ).await?,
            }
        }
    }

    /// Reads the body of a request, with the reservation of its memory.
    async fn body(&mut self, head: &RequestHead) -> Result<(Bytes, Option<ReservedBytes>), End> {
        let room = match head.length >= COUNTED_FROM {
            true => Some(self.room(head.length).await?),
            false => None,
        };
        if head.waits && self.reader.missing(head.length) > 0 {
            self.stream
                .write_all(b"HTTP/1.1 100 Continue\r\n\r\n")
                .await?;
        }
        let timeout = self.limits().stall_timeout;
        let mut missing = self.reader.missing(head.length);
        self.reader.buffer().reserve(missing);
        let mut window = (Instant::now() + timeout, missing);
        while missing > 0 {
            match timeout_at(window.0, self.read(missing)).await {
                Ok(read) => read?,
                Err(_) => {
                    let progress = (window.1 - missing) as u64;
                    let least = room.as_ref().map_or(0, ReservedBytes::least_progress);
                    if progress < least.max(NetLimits::MIN_PROGRESS) {
                        return Err(Refusal::SlowBody.into());
                    }
                    window = (Instant::now() + timeout, missing);
                }
            }
            missing = self.reader.missing(head.length);
        }
        Ok((self.reader.body(head.length), room))
    }

    /// Waits until memory for a body is reserved.
    async fn room(&self, len: usize) -> Result<ReservedBytes, Refusal> {
        let endpoint = &self.endpoint.stream;
        let mut meter = endpoint.meter(&self.quota_key);
        let until = Instant::now() + self.limits().stall_timeout.saturating_mul(2);
        loop {
            let freed = endpoint.byte_budget.freed();
            tokio::pin!(freed);
            freed.as_mut().enable();
            if let Some(room) = meter.take(len) {
                return Ok(room);
            }
            let in_time = timeout_at(until, freed).await;
            in_time.map_err(|_| Refusal::NoRoom)?;
        }
    }

    /// Hands on the letter of a request, unless it repeats another one.
    async fn take(&mut self, head: &RequestHead, body: Bytes) -> Result<(), End> {
        let endpoint = &self.endpoint.stream;
        let letter = letter::read(&body, &head.boundary)?;
        // The request may have been read together with an earlier one.
        let proof = self.proof.check();
        proof.map_err(|end| Refusal::Withdrawn(end.after()))?;
        #[cfg(feature = "secure")]
        if self.proof.restricts() && !letter.is_of(|name| self.proof.speaks_for(name)) {
            return Err(Refusal::NotItsAgent.into());
        }
        if let Some(rate_limit) = endpoint.rate_limit(Home::Address(self.from.ip()))
            && let Some(until) = rate_limit.spend(1, body.len(), Now::now())
        {
            count(&endpoint.tally().held_back);
            sleep_until(until.into()).await;
        }
        let Some(sink) = endpoint.sink() else {
            return Err(End::Over);
        };
        let arrived = Arrived {
            digest: letter.digest(self.endpoint.key),
            from: self.from.ip(),
            connection: self.slot.number,
            first: self.first,
        };
        self.first = false;
        // From here on to the end there is no wait, in which the task could be aborted.
        if self.endpoint.repeats.lock().is_repeat(Now::now(), arrived) {
            log_limit::info!(of: quota_address(self.from.ip()), from = %self.from, "ignored a letter that its platform has repeated on another connection");
            return Ok(());
        }
        count(&endpoint.tally().unframed_in);
        let source = LegacySource {
            address: self.from.ip().to_canonical(),
            signature: Signature::JadeProxy,
        };
        sink.arrived_unframed(letter.letter, self.endpoint.kind(), source);
        Ok(())
    }
}
