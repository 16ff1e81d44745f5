//! Letters to legacy peers: one connection per letter, closed after it, without an answer.
//!
//! Each location has its own queue and at most one connection at a time, so that letters arrive in
//! order. The end of the stream ends a letter. This side cannot know whether the peer accepted it,
//! but a peer that closes the connection without an error has read it to its end.

use std::collections::{HashMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::Letter;
use fipa_transport::{
    Abandoned, AttemptId, Body, Conclusion, Location, Parcel, Signature, Sink, TransportError,
    TransportErrorKind,
};
use parking_lot::Mutex;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::timeout;

use super::accept::prepare;
use super::dial;
use super::endpoint::TcpEndpoint;
use crate::end::ConnectionEnd;
use crate::legacy::dialect::translate;
use crate::stream::counters::count;
use crate::stream::dialing::Unreachable;

/// Time that a peer has to close the connection after its letter, before the next letter is sent.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(50);

/// Maximum number of bytes per write; the stall timeout applies to each write.
const STEP: usize = 256 << 10;

/// The letters to legacy peers.
#[derive(Debug)]
pub(crate) struct LegacySenders {
    queues: Mutex<HashMap<Location, Queue>>,
    closed: watch::Sender<bool>,
}

/// The letters to one location. The queue exists as long as its task.
#[derive(Debug, Default)]
struct Queue {
    waiting: VecDeque<LegacyDelivery>,
    bytes: usize,
    /// The letter whose connection is open or being opened.
    current: Option<AttemptId>,
    /// Whether the first byte of the current letter has been or is about to be written.
    begun: bool,
}

#[derive(Debug)]
struct LegacyDelivery {
    attempt: AttemptId,
    receiver: Arc<str>,
    letter: Letter,
}

impl Default for LegacySenders {
    fn default() -> Self {
        Self {
            queues: Mutex::default(),
            closed: watch::Sender::new(false),
        }
    }
}

impl LegacySenders {
    /// Queues a parcel for a legacy peer. Returns whether a task must be [started](run) for its
    /// location.
    ///
    /// # Errors
    /// When the parcel cannot be queued.
    pub(crate) fn take(
        &self,
        endpoint: &TcpEndpoint,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<bool, TransportError> {
        let limits = endpoint.limits();
        let Body::Letter(letter) = parcel.body else {
            let detail = "a legacy peer accepts letters only";
            return Err(TransportError::new(
                TransportErrorKind::Incompatible,
                detail,
            ));
        };
        if *self.closed.borrow() {
            return Err(ConnectionEnd::Closed.after());
        }
        let mut queues = self.queues.lock();
        if !queues.contains_key(to) && queues.len() >= limits.max_connections {
            return Err(ConnectionEnd::TooManyConnections.after());
        }
        let fresh = !queues.contains_key(to);
        let queue = queues.entry(to.clone()).or_default();
        let (count, bytes) = (queue.waiting.len(), queue.bytes);
        let len = letter.len();
        if count >= limits.max_in_flight
            || (bytes > 0 && bytes.saturating_add(len) > limits.max_queued_bytes)
        {
            let detail = format!(
                "{count} letters of {bytes} bytes wait for this legacy peer (max_in_flight, max_queued_bytes)"
            );
            return Err(TransportError::new(TransportErrorKind::Congested, detail));
        }
        queue.bytes += len;
        queue.waiting.push_back(LegacyDelivery {
            attempt,
            receiver: parcel.receiver,
            letter,
        });
        Ok(fresh)
    }

    /// Ends an attempt. The letter is not sent if no byte of it has been written.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> Abandoned {
        for queue in self.queues.lock().values_mut() {
            if queue.current == Some(attempt) {
                queue.current = None;
                return match queue.begun {
                    true => Abandoned::Unconfirmed,
                    false => Abandoned::NotSent,
                };
            }
            let place = queue.waiting.iter().position(|e| e.attempt == attempt);
            if let Some(delivery) = place.and_then(|place| queue.waiting.remove(place)) {
                queue.bytes -= delivery.letter.len();
                return Abandoned::NotSent;
            }
        }
        Abandoned::Unconfirmed
    }

    /// Notes that the first byte of the current letter is about to be written. Returns false when
    /// the letter was abandoned and must not be sent.
    fn begin(&self, to: &Location) -> bool {
        let mut queues = self.queues.lock();
        let wanted = queues.get_mut(to).filter(|queue| queue.current.is_some());
        wanted.map(|queue| queue.begun = true).is_some()
    }

    /// Removes the queue of a location whose task has not begun. Returns whether the letter was
    /// still queued.
    pub(crate) fn take_back(&self, attempt: AttemptId, to: &Location) -> bool {
        let mut queues = self.queues.lock();
        let waits = queues.get(to).is_some_and(|queue| {
            queue
                .waiting
                .iter()
                .any(|delivery| delivery.attempt == attempt)
        });
        if waits {
            queues.remove(to);
        }
        waits
    }

    pub(crate) fn close(&self) {
        self.closed.send_replace(true);
    }

    /// Removes the next letter for a location. Removes the queue when it is empty.
    fn next(&self, to: &Location) -> Option<LegacyDelivery> {
        let mut queues = self.queues.lock();
        let queue = queues.get_mut(to)?;
        match queue.waiting.pop_front() {
            Some(delivery) => {
                queue.bytes -= delivery.letter.len();
                queue.current = Some(delivery.attempt);
                queue.begun = false;
                Some(delivery)
            }
            None => {
                queues.remove(to);
                None
            }
        }
    }

    /// Ends the current letter. Returns whether its attempt still needs a conclusion.
    fn ended(&self, to: &Location) -> bool {
        let mut queues = self.queues.lock();
        let current = queues.get_mut(to).and_then(|queue| queue.current.take());
        current.is_some()
    }

    /// Removes all waiting letters for a location.
    fn drain(&self, to: &Location) -> VecDeque<LegacyDelivery> {
        let mut queues = self.queues.lock();
        let queue = queues.get_mut(to);
        queue.map_or_else(VecDeque::new, |queue| {
            queue.bytes = 0;
            std::mem::take(&mut queue.waiting)
        })
    }

    fn forget(&self, to: &Location) -> Option<Queue> {
        self.queues.lock().remove(to)
    }
}

/// Sends the waiting letters of a location, one by one.
pub(crate) async fn run(endpoint: Arc<TcpEndpoint>, sink: Arc<dyn Sink>, to: Location) {
    let mut task = QueueTask {
        endpoint,
        sink,
        to,
        done: false,
    };
    let mut closed = task.endpoint.legacy.senders.closed.subscribe();
    while let Some(delivery) = task.endpoint.legacy.senders.next(&task.to) {
        let progress = Mutex::new(false);
        let conclusion = tokio::select! {
            conclusion = deliver(&task, &delivery, &progress) => conclusion,
            _ = closed.wait_for(|closed| *closed) => {
                // Dropping `task` concludes the remaining letters.
                task.conclude(delivery.attempt, broken(*progress.lock(), ConnectionEnd::Closed.after()));
                return;
            }
        };
        let unreachable = match &conclusion {
            Conclusion::NotSent(error) if error.fault == TransportErrorKind::Unreachable => {
                Some(error.clone())
            }
            _ => None,
        };
        task.conclude(delivery.attempt, conclusion);
        if let Some(error) = unreachable {
            // The other waiting letters fail with the same error, without an attempt each.
            for delivery in task.endpoint.legacy.senders.drain(&task.to) {
                let conclusion = Conclusion::NotSent(error.clone());
                task.sink.concluded(delivery.attempt, conclusion);
            }
        }
    }
    task.done = true;
}

/// The task of a queue. Dropping it concludes every remaining letter.
struct QueueTask {
    endpoint: Arc<TcpEndpoint>,
    sink: Arc<dyn Sink>,
    to: Location,
    /// Whether the queue was empty and has been removed.
    done: bool,
}

impl QueueTask {
    fn conclude(&self, attempt: AttemptId, conclusion: Conclusion) {
        if self.endpoint.legacy.senders.ended(&self.to) {
            self.sink.concluded(attempt, conclusion);
        }
    }
}

impl Drop for QueueTask {
    fn drop(&mut self) {
        if self.done {
            return;
        }
        let Some(queue) = self.endpoint.legacy.senders.forget(&self.to) else {
            return;
        };
        if let Some(attempt) = queue.current {
            let conclusion = Conclusion::Unconfirmed(ConnectionEnd::Closed.after());
            self.sink.concluded(attempt, conclusion);
        }
        for delivery in queue.waiting {
            let conclusion = Conclusion::NotSent(ConnectionEnd::Closed.after());
            self.sink.concluded(delivery.attempt, conclusion);
        }
    }
}

async fn deliver(task: &QueueTask, delivery: &LegacyDelivery, begun: &Mutex<bool>) -> Conclusion {
    let (endpoint, to) = (&task.endpoint, &task.to);
    let in_dialect = |here: Option<&str>| {
        translate(&delivery.letter, &delivery.receiver, to.signature(), here)
            .map_err(|error| Conclusion::NotSent(TransportError::new(error.fault(), error)))
    };
    // Translated before a connection is opened: a connection without a letter leaks a descriptor in
    // fipa_services.
    let mut letter = match in_dialect(None) {
        Ok(letter) => letter,
        Err(not_sent) => return not_sent,
    };
    let (mut stream, peer) =
        match dial::open(endpoint.limits(), vec![to.address().to_owned()]).await {
            Ok(opened) => opened,
            Err(Unreachable(what)) => {
                count(&endpoint.tally().dial_failures);
                let detail = format!("{}: {what}", to.address());
                return Conclusion::NotSent(TransportError::new(
                    TransportErrorKind::Unreachable,
                    detail,
                ));
            }
        };
    if !endpoint.config.gives_legacy_peers_at(peer.ip()) {
        let detail = format!(
            "{peer} is a legacy peer, which cannot prove its identity, and is not listed in security.legacy_peers"
        );
        return Conclusion::NotSent(TransportError::new(TransportErrorKind::Refused, detail));
    }
    if to.signature() == Signature::JadeProxy
        && let Some(here) = stream.local_addr().ok()
        && let Some(here) = listening_at(&endpoint.listening(), here)
    {
        letter = match in_dialect(Some(&here)) {
            Ok(letter) => letter,
            Err(not_sent) => return not_sent,
        };
    }
    if let Err(error) = prepare(&stream, endpoint.limits()) {
        return Conclusion::NotSent(TransportError::new(TransportErrorKind::Broken, error));
    }
    if !endpoint.legacy.senders.begin(to) {
        let detail = "the letter was abandoned";
        return Conclusion::NotSent(TransportError::new(TransportErrorKind::TimedOut, detail));
    }
    for piece in letter {
        let patience = endpoint.limits().stall_timeout;
        if let Err(error) = write(&mut stream, piece, patience, begun).await {
            return broken(*begun.lock(), error);
        }
    }
    match finish(&mut stream).await {
        Ok(()) => {
            count(&endpoint.tally().unframed_out);
            Conclusion::Handed
        }
        Err(error) => broken(true, TransportError::new(TransportErrorKind::Broken, error)),
    }
}

fn broken(begun: bool, error: TransportError) -> Conclusion {
    if begun {
        Conclusion::Unconfirmed(error)
    } else {
        Conclusion::NotSent(error)
    }
}

async fn write(
    stream: &mut TcpStream,
    mut piece: Bytes,
    patience: Duration,
    begun: &Mutex<bool>,
) -> Result<(), TransportError> {
    while !piece.is_empty() {
        let mut step = piece.split_to(piece.len().min(STEP));
        *begun.lock() = true;
        match timeout(patience, stream.write_all_buf(&mut step)).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return Err(TransportError::new(TransportErrorKind::Broken, error)),
            Err(_) => {
                let detail = "the peer stopped reading (stall_timeout)";
                return Err(TransportError::new(TransportErrorKind::TimedOut, detail));
            }
        }
    }
    Ok(())
}

/// Ends the letter, and waits a moment for the peer to close the connection.
async fn finish(stream: &mut TcpStream) -> std::io::Result<()> {
    stream.shutdown().await?;
    let mut ignored = [0; 256];
    let hangup = async {
        while stream.read(&mut ignored).await? > 0 {}
        Ok(())
    };
    timeout(CLOSE_TIMEOUT, hangup).await.unwrap_or(Ok(()))
}

/// Returns the listening address with the IP address `local` as a URL, if the endpoint listens
/// there.
fn listening_at(listening: &[String], local: SocketAddr) -> Option<String> {
    listening
        .iter()
        .filter_map(|text| text.parse::<SocketAddr>().ok())
        .find(|address| address.ip() == local.ip())
        .map(|address| format!("tcp://{address}"))
}
