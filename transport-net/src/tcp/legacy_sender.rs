//! Letters to old peers: one connection per letter, closed behind it, and no answer.
//!
//! Each location has a queue of its own and at most one connection at a time, so that letters arrive
//! in order. The end of the stream is what ends a letter there; whether the peer took it cannot be
//! known, but a peer that hangs up without an error has read it to its end.

use std::collections::{HashMap, VecDeque};
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::Letter;
use fipa_transport::{
    Abandoned, AttemptId, Body, Conclusion, Location, Parcel, Signature, Sink, WayError, WayFault,
};
use parking_lot::Mutex;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::watch;
use tokio::time::timeout;

use super::accept::prepare;
use super::dial;
use super::dialect::translate;
use super::endpoint::TcpEndpoint;
use crate::end::ConnectionEnd;
use crate::stream::counters::count;
use crate::stream::dialing::Unreachable;

/// How long a peer may take to hang up after it has got its letter, before the next one is begun.
const FAREWELL: Duration = Duration::from_millis(50);

/// Bytes written at a time: between two, progress is looked at.
const STEP: usize = 256 << 10;

/// The letters to old peers.
#[derive(Debug)]
pub(crate) struct LegacySenders {
    queues: Mutex<HashMap<Location, Queue>>,
    closed: watch::Sender<bool>,
}

/// Letters to one location. It is there as long as its task is.
#[derive(Debug, Default)]
struct Queue {
    waiting: VecDeque<LegacyDelivery>,
    bytes: usize,
    /// The letter whose connection is open or being opened.
    current: Option<AttemptId>,
    /// Whether the first byte of the current letter has been written, or is about to be.
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
    /// Takes a parcel for an old peer. Says whether a task is to be [run](run) for its location.
    ///
    /// # Errors
    /// When it does not go.
    pub(crate) fn take(
        &self,
        endpoint: &TcpEndpoint,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<bool, WayError> {
        let limits = endpoint.limits();
        let Body::Letter(letter) = parcel.body else {
            let detail = "an old peer takes letters only";
            return Err(WayError::new(WayFault::Incompatible, detail));
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
            let detail = format!("{count} letters wait for this peer (max_in_flight)");
            return Err(WayError::new(WayFault::Congested, detail));
        }
        queue.bytes += len;
        queue.waiting.push_back(LegacyDelivery {
            attempt,
            receiver: parcel.receiver,
            letter,
        });
        Ok(fresh)
    }

    /// Ends an attempt: the letter is not sent if nothing of it has been written.
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

    /// The first byte of the current letter is about to be written. Returns false when the letter
    /// was abandoned, and must not be sent.
    fn begin(&self, to: &Location) -> bool {
        let mut queues = self.queues.lock();
        let wanted = queues.get_mut(to).filter(|queue| queue.current.is_some());
        wanted.map(|queue| queue.begun = true).is_some()
    }

    /// Takes back the first letter for a location. Says whether its task had not begun.
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

    /// The next letter for a location; without one the queue is gone.
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

    /// The letter that was fetched last has come to its end. Says whether anybody wants to know.
    fn ended(&self, to: &Location) -> bool {
        let mut queues = self.queues.lock();
        let current = queues.get_mut(to).and_then(|queue| queue.current.take());
        current.is_some()
    }

    /// Everything that waits for a location.
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

/// Delivers what waits for a location, letter by letter.
pub(crate) async fn run(endpoint: Arc<TcpEndpoint>, sink: Arc<dyn Sink>, to: Location) {
    let mut round = Round {
        endpoint,
        sink,
        to,
        done: false,
    };
    let mut closed = round.endpoint.legacy.senders.closed.subscribe();
    while let Some(delivery) = round.endpoint.legacy.senders.next(&round.to) {
        let progress = Mutex::new(false);
        let conclusion = tokio::select! {
            conclusion = deliver(&round, &delivery, &progress) => conclusion,
            _ = closed.wait_for(|closed| *closed) => {
                // What remains is concluded by the end of the round.
                round.conclude(delivery.attempt, broken(*progress.lock(), ConnectionEnd::Closed.after()));
                return;
            }
        };
        let unreachable = match &conclusion {
            Conclusion::NotSent(error) if error.fault == WayFault::Unreachable => {
                Some(error.clone())
            }
            _ => None,
        };
        round.conclude(delivery.attempt, conclusion);
        if let Some(error) = unreachable {
            // They need not all find out by themselves.
            for delivery in round.endpoint.legacy.senders.drain(&round.to) {
                let conclusion = Conclusion::NotSent(error.clone());
                round.sink.concluded(delivery.attempt, conclusion);
            }
        }
    }
    round.done = true;
}

/// A task that delivers: whatever happens to it, every letter gets its conclusion.
struct Round {
    endpoint: Arc<TcpEndpoint>,
    sink: Arc<dyn Sink>,
    to: Location,
    /// Whether the queue has been found empty, and is no more.
    done: bool,
}

impl Round {
    fn conclude(&self, attempt: AttemptId, conclusion: Conclusion) {
        if self.endpoint.legacy.senders.ended(&self.to) {
            self.sink.concluded(attempt, conclusion);
        }
    }
}

impl Drop for Round {
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

async fn deliver(round: &Round, delivery: &LegacyDelivery, begun: &Mutex<bool>) -> Conclusion {
    let (endpoint, to) = (&round.endpoint, &round.to);
    let in_dialect = |here: Option<&str>| {
        translate(&delivery.letter, &delivery.receiver, to.signature(), here)
            .map_err(|error| Conclusion::NotSent(WayError::new(error.fault(), error)))
    };
    // Before anything is opened: a connection without a letter costs fipa_services a descriptor.
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
                return Conclusion::NotSent(WayError::new(WayFault::Unreachable, detail));
            }
        };
    if !endpoint.config.gives_old_peers_at(peer.ip()) {
        let detail = format!("{peer} cannot prove who it is, and is no exception");
        return Conclusion::NotSent(WayError::new(WayFault::Refused, detail));
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
        return Conclusion::NotSent(WayError::new(WayFault::Broken, error));
    }
    if !endpoint.legacy.senders.begin(to) {
        let detail = "the letter was abandoned";
        return Conclusion::NotSent(WayError::new(WayFault::TimedOut, detail));
    }
    for piece in letter {
        let patience = endpoint.limits().stall_timeout;
        if let Err(error) = write(&mut stream, piece, patience, begun).await {
            return broken(*begun.lock(), error);
        }
    }
    match farewell(&mut stream).await {
        Ok(()) => {
            count(&endpoint.tally().unframed_out);
            Conclusion::Handed
        }
        Err(error) => broken(true, WayError::new(WayFault::Broken, error)),
    }
}

fn broken(begun: bool, error: WayError) -> Conclusion {
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
) -> Result<(), WayError> {
    while !piece.is_empty() {
        let mut step = piece.split_to(piece.len().min(STEP));
        *begun.lock() = true;
        match timeout(patience, stream.write_all_buf(&mut step)).await {
            Ok(Ok(())) => {}
            Ok(Err(error)) => return Err(WayError::new(WayFault::Broken, error)),
            Err(_) => {
                let detail = "the peer stopped reading";
                return Err(WayError::new(WayFault::TimedOut, detail));
            }
        }
    }
    Ok(())
}

/// Ends the letter, and gives the peer a moment to hang up.
async fn farewell(stream: &mut TcpStream) -> std::io::Result<()> {
    stream.shutdown().await?;
    let mut ignored = [0; 256];
    let hangup = async {
        while stream.read(&mut ignored).await? > 0 {}
        Ok(())
    };
    timeout(FAREWELL, hangup).await.unwrap_or(Ok(()))
}

/// Where a socket with this address can be reached, when the endpoint listens there.
fn listening_at(listening: &[String], local: SocketAddr) -> Option<String> {
    listening
        .iter()
        .filter_map(|text| text.parse::<SocketAddr>().ok())
        .find(|address| address.ip() == local.ip())
        .map(|address| format!("tcp://{address}"))
}
