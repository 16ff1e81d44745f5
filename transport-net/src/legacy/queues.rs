//! Letters to legacy peers: one after the other for each location, so that they arrive in order.
//!
//! Each location has its own queue and one task. The task ends when the queue is empty, or waits for
//! the next letter as long as its sender keeps a connection open.

use std::collections::{HashMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use fipa_acl::Letter;
use fipa_transport::{
    Abandoned, AttemptId, Body, Conclusion, Location, Parcel, Sink, TransportError,
    TransportErrorKind,
};
use parking_lot::Mutex;
use tokio::io::{AsyncWrite, AsyncWriteExt};
use tokio::runtime::Handle;
use tokio::sync::{Notify, watch};
use tokio::time;

use crate::end::{self, ConnectionEnd};
use crate::stream::config::NetLimits;

/// Maximum number of bytes per write; the stall timeout applies to each write.
const STEP: usize = 256 << 10;

/// The letters to legacy peers. Clones share the queues.
#[derive(Debug, Clone, Default)]
pub(crate) struct LegacySenders(Arc<Shared>);

#[derive(Debug)]
struct Shared {
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
    /// Wakes the task when it waits for a letter.
    wake: Arc<Notify>,
}

/// A letter to a legacy peer.
#[derive(Debug)]
pub(crate) struct LegacyDelivery {
    attempt: AttemptId,
    pub(crate) receiver: Arc<str>,
    pub(crate) letter: Letter,
}

/// Sends the letters of one location.
pub(crate) trait LegacySender: Send + 'static {
    /// Sends a letter. Calls [`Progress::begin`] before the first byte is written.
    fn deliver(
        &mut self,
        delivery: &LegacyDelivery,
        progress: &Progress<'_>,
    ) -> impl Future<Output = Conclusion> + Send;

    /// Completes when there is no reason to wait for another letter, in particular when no
    /// connection is open.
    fn idle(&mut self) -> impl Future<Output = ()> + Send;
}

/// The progress of the current letter.
pub(crate) struct Progress<'a> {
    senders: &'a LegacySenders,
    to: &'a Location,
    written: Mutex<bool>,
}

impl Progress<'_> {
    /// Notes that the first byte of the current letter is about to be written.
    ///
    /// # Errors
    /// When the letter was abandoned and must not be sent.
    pub(crate) fn begin(&self) -> Result<(), Conclusion> {
        let mut queues = self.senders.0.queues.lock();
        let wanted = queues
            .get_mut(self.to)
            .filter(|queue| queue.current.is_some());
        let Some(queue) = wanted else {
            let detail = "the letter was abandoned";
            let error = TransportError::new(TransportErrorKind::TimedOut, detail);
            return Err(Conclusion::NotSent(error));
        };
        queue.begun = true;
        Ok(())
    }

    /// Writes a piece of the letter. The peer must read each step within `timeout`.
    pub(crate) async fn write(
        &self,
        stream: &mut (impl AsyncWrite + Unpin),
        mut piece: Bytes,
        timeout: Duration,
    ) -> Result<(), TransportError> {
        while !piece.is_empty() {
            let mut step = piece.split_to(piece.len().min(STEP));
            *self.written.lock() = true;
            match time::timeout(timeout, stream.write_all_buf(&mut step)).await {
                Ok(Ok(())) => {}
                Ok(Err(error)) => return Err(end::of_io(error)),
                Err(_) => {
                    let detail = "the peer stopped reading (stall_timeout)";
                    return Err(TransportError::new(TransportErrorKind::TimedOut, detail));
                }
            }
        }
        Ok(())
    }

    /// Returns the conclusion of a letter that ends with this error.
    pub(crate) fn broken(&self, error: TransportError) -> Conclusion {
        match *self.written.lock() {
            true => Conclusion::Unconfirmed(error),
            false => Conclusion::NotSent(error),
        }
    }
}

impl Default for Shared {
    fn default() -> Self {
        Self {
            queues: Mutex::default(),
            closed: watch::Sender::new(false),
        }
    }
}

/// The surroundings of the tasks that send to legacy peers.
pub(crate) struct SenderContext<'a> {
    pub(crate) limits: &'a NetLimits,
    pub(crate) runtime: &'a Handle,
    pub(crate) sink: Arc<dyn Sink>,
}

impl LegacySenders {
    /// Queues a parcel for a legacy peer, and starts the task of its location with the sender that
    /// `sender` makes, if there is none.
    ///
    /// # Errors
    /// When the parcel cannot be queued.
    pub(crate) fn send<S: LegacySender>(
        &self,
        context: SenderContext<'_>,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
        sender: impl FnOnce() -> S,
    ) -> Result<(), TransportError> {
        let SenderContext {
            limits,
            runtime,
            sink,
        } = context;
        if self.take(limits, attempt, to, parcel)? {
            let (most, to_task) = (limits.max_connections, to.clone());
            let task = runtime.spawn(run(self.clone(), most, sink, to_task, sender()));
            if task.is_finished() && self.take_back(attempt, to) {
                let detail = "the runtime of this endpoint has been shut down";
                return Err(TransportError::new(TransportErrorKind::Closed, detail));
            }
        }
        Ok(())
    }

    /// Queues a parcel. Returns whether the task of its location must be started.
    fn take(
        &self,
        limits: &NetLimits,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<bool, TransportError> {
        let Body::Letter(letter) = parcel.body else {
            let detail = "a legacy peer accepts letters only";
            return Err(TransportError::new(
                TransportErrorKind::Incompatible,
                detail,
            ));
        };
        if *self.0.closed.borrow() {
            return Err(ConnectionEnd::Closed.after());
        }
        let mut queues = self.0.queues.lock();
        let fresh = !queues.contains_key(to);
        if fresh && queues.len() >= limits.max_connections {
            // Tasks without letters end.
            queues.values().for_each(|queue| queue.wake.notify_one());
            return Err(ConnectionEnd::TooManyConnections.after());
        }
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
        queue.wake.notify_one();
        Ok(fresh)
    }

    /// Ends an attempt. The letter is not sent if no byte of it has been written.
    pub(crate) fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        let mut queues = self.0.queues.lock();
        let Some(queue) = queues.get_mut(to) else {
            return Abandoned::Unconfirmed;
        };
        if queue.current == Some(attempt) {
            queue.current = None;
            return match queue.begun {
                true => Abandoned::Unconfirmed,
                false => Abandoned::NotSent,
            };
        }
        let place = queue.waiting.iter().position(|e| e.attempt == attempt);
        let Some(delivery) = place.and_then(|place| queue.waiting.remove(place)) else {
            return Abandoned::Unconfirmed;
        };
        queue.bytes -= delivery.letter.len();
        Abandoned::NotSent
    }

    /// Removes the queue of a location whose task has not begun. Returns whether the letter was
    /// still queued.
    fn take_back(&self, attempt: AttemptId, to: &Location) -> bool {
        let mut queues = self.0.queues.lock();
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
        self.0.closed.send_replace(true);
    }

    /// Removes the next letter for a location from its queue.
    fn next(&self, to: &Location) -> Option<LegacyDelivery> {
        let mut queues = self.0.queues.lock();
        let queue = queues.get_mut(to)?;
        let delivery = queue.waiting.pop_front()?;
        queue.bytes -= delivery.letter.len();
        queue.current = Some(delivery.attempt);
        queue.begun = false;
        Some(delivery)
    }

    /// Removes the queue of a location if it is empty. Returns whether it has been removed.
    fn remove_empty(&self, to: &Location) -> bool {
        let mut queues = self.0.queues.lock();
        let empty = queues.get(to).is_none_or(|queue| queue.waiting.is_empty());
        if empty {
            queues.remove(to);
        }
        empty
    }

    /// Returns the notification of new letters for a location. `None` if so many locations have
    /// tasks that none waits for letters.
    fn wake(&self, to: &Location, most: usize) -> Option<Arc<Notify>> {
        let queues = self.0.queues.lock();
        let few = queues.len() <= most / 2;
        queues
            .get(to)
            .filter(|_| few)
            .map(|queue| Arc::clone(&queue.wake))
    }

    /// Ends the current letter. Returns whether its attempt still needs a conclusion.
    fn ended(&self, to: &Location) -> bool {
        let mut queues = self.0.queues.lock();
        let current = queues.get_mut(to).and_then(|queue| queue.current.take());
        current.is_some()
    }

    /// Removes all waiting letters for a location.
    fn drain(&self, to: &Location) -> VecDeque<LegacyDelivery> {
        let mut queues = self.0.queues.lock();
        let queue = queues.get_mut(to);
        queue.map_or_else(VecDeque::new, |queue| {
            queue.bytes = 0;
            std::mem::take(&mut queue.waiting)
        })
    }

    fn forget(&self, to: &Location) -> Option<Queue> {
        self.0.queues.lock().remove(to)
    }
}

/// Sends the letters of a location, one by one. `most` is the maximum number of locations.
async fn run<S: LegacySender>(
    senders: LegacySenders,
    most: usize,
    sink: Arc<dyn Sink>,
    to: Location,
    mut sender: S,
) {
    let mut closed = senders.0.closed.subscribe();
    let mut task = QueueTask {
        senders,
        sink,
        to,
        done: false,
    };
    loop {
        while let Some(delivery) = task.senders.next(&task.to) {
            let progress = Progress {
                senders: &task.senders,
                to: &task.to,
                written: Mutex::new(false),
            };
            let conclusion = tokio::select! {
                conclusion = sender.deliver(&delivery, &progress) => conclusion,
                _ = closed.wait_for(|closed| *closed) => {
                    // Dropping `task` concludes the remaining letters.
                    task.conclude(delivery.attempt, progress.broken(ConnectionEnd::Closed.after()));
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
                for delivery in task.senders.drain(&task.to) {
                    let conclusion = Conclusion::NotSent(error.clone());
                    task.sink.concluded(delivery.attempt, conclusion);
                }
            }
        }
        if let Some(wake) = task.senders.wake(&task.to, most) {
            tokio::select! {
                // A sender without a connection does not wait.
                biased;
                () = sender.idle() => {}
                () = wake.notified() => continue,
                _ = closed.wait_for(|closed| *closed) => return,
            }
        }
        if task.senders.remove_empty(&task.to) {
            task.done = true;
            return;
        }
    }
}

/// The task of a queue. Dropping it concludes every remaining letter.
struct QueueTask {
    senders: LegacySenders,
    sink: Arc<dyn Sink>,
    to: Location,
    /// Whether the queue was empty and has been removed.
    done: bool,
}

impl QueueTask {
    fn conclude(&self, attempt: AttemptId, conclusion: Conclusion) {
        if self.senders.ended(&self.to) {
            self.sink.concluded(attempt, conclusion);
        }
    }
}

impl Drop for QueueTask {
    fn drop(&mut self) {
        if self.done {
            return;
        }
        let Some(queue) = self.senders.forget(&self.to) else {
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
