//! The other processes that an endpoint has open.

use std::collections::VecDeque;
use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use fipa_transport::{
    Abandoned, AttemptId, Body, Conclusion, Incarnation, Parcel, TransportError, TransportErrorKind,
};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::task::AbortHandle;

use crate::errors::{closed, opening, retired};
use crate::outbox::{AnswerLook, Concluded, MemoryLock, Outbox, Posted};
use crate::presence::{PeerProcess, SharedFd, StatusPage, has_ended};

/// A value that the count of polls does not reach.
const NEVER: u64 = u64::MAX;

/// Returns the error of a letter to a process that has ended.
pub(crate) fn gone(incarnation: Incarnation) -> TransportError {
    TransportError::new(
        TransportErrorKind::Unreachable,
        format_args!("process {incarnation} has ended"),
    )
}

/// Another process.
///
/// Its end is final. [`Peer::end`] first sets `ended`, then stops the outbox from accepting
/// letters; and an outbox is set and a parcel is queued, under the same lock, only while `ended` is
/// false. So once [`Peer::collect`] has found the outbox of an ended process empty, no letter is
/// lost with it.
pub(crate) struct Peer {
    incarnation: Incarnation,
    process: PeerProcess,
    line: Mutex<Line>,
    ended: AtomicBool,
    /// The count of polls of the process when a letter to it was last abandoned.
    abandoned_at: AtomicU64,
    used: AtomicU64,
    watcher: OnceLock<AbortHandle>,
}

impl Peer {
    pub(crate) fn new(incarnation: Incarnation, process: PeerProcess) -> Self {
        Self {
            incarnation,
            process,
            line: Mutex::default(),
            ended: AtomicBool::new(false),
            abandoned_at: AtomicU64::new(NEVER),
            used: AtomicU64::new(0),
            watcher: OnceLock::new(),
        }
    }

    pub(crate) fn incarnation(&self) -> Incarnation {
        self.incarnation
    }

    /// The status page of the process.
    pub(crate) fn page(&self) -> &Arc<StatusPage> {
        self.process.page()
    }

    /// Whether the process will poll without being rung at.
    pub(crate) fn is_awake(&self) -> bool {
        self.process.is_awake()
    }

    /// Whether the process was polling at the last check.
    pub(crate) fn was_polling(&self) -> bool {
        self.process.was_polling()
    }

    /// Rings the process's doorbell unless it is awake. Returns whether it rang.
    pub(crate) fn wake(&self) -> bool {
        self.process.wake()
    }

    /// Starts a task that calls `ended` when the process ends.
    pub(crate) fn watch(
        &self,
        runtime: &Handle,
        ended: impl FnOnce() + Send + 'static,
    ) -> std::io::Result<()> {
        let _runtime = runtime.enter();
        let live = SharedFd::readable(self.process.live().clone())?;
        let task = runtime.spawn(async move {
            while let Ok(mut ready) = live.readable().await {
                if has_ended(live.get_ref().get()) {
                    return ended();
                }
                ready.clear_ready();
            }
        });
        // Set once, right after the peer is created.
        let _ = self.watcher.set(task.abort_handle());
        Ok(())
    }

    /// Puts a parcel into the mailbox, or into the backlog if that would take a wait. Parcels leave
    /// in the order of the calls.
    pub(crate) fn post(
        &self,
        attempt: AttemptId,
        parcel: Parcel,
        limits: BacklogLimits,
    ) -> Result<Dispatched, TransportError> {
        let mut line = self.line.lock();
        if self.ended.load(Ordering::SeqCst) {
            return Err(gone(self.incarnation));
        }
        if !line.is_served
            && let Some(outbox) = &line.outbox
        {
            match outbox.post(attempt, &parcel, MemoryLock::Try)? {
                Posted::Sent => return Ok(Dispatched::Sent),
                Posted::Retired => {
                    if outbox.waiting() > 0 {
                        return Err(retired());
                    }
                    line.outbox = None;
                }
                Posted::Contended => {}
            }
        }
        line.backlog.push(attempt, parcel, limits)?;
        Ok(match std::mem::replace(&mut line.is_served, true) {
            true => Dispatched::Queued,
            false => Dispatched::QueuedFirst,
        })
    }

    /// Returns the outbox if it is open. Otherwise claims to open it, unless a thread is about to
    /// do that.
    pub(crate) fn outbox(&self) -> Result<OpenOutbox, TransportError> {
        let mut line = self.line.lock();
        if self.ended.load(Ordering::SeqCst) {
            return Err(gone(self.incarnation));
        }
        match &line.outbox {
            Some(outbox) => Ok(OpenOutbox::Open(Arc::clone(outbox))),
            None if line.is_served => Err(opening()),
            None => {
                line.is_served = true;
                Ok(OpenOutbox::Claimed)
            }
        }
    }

    pub(crate) fn is_open(&self) -> bool {
        self.line.lock().outbox.is_some()
    }

    /// Sets the opened outbox. Fails if the process has ended in the meantime.
    pub(crate) fn opened(&self, outbox: Outbox) -> Result<Arc<Outbox>, TransportError> {
        let mut line = self.line.lock();
        if self.ended.load(Ordering::SeqCst) {
            return Err(gone(self.incarnation));
        }
        Ok(Arc::clone(line.outbox.insert(Arc::new(outbox))))
    }

    /// Gives up the claim to serve the backlog if it is empty. Returns whether it was.
    pub(crate) fn leave_backlog(&self) -> bool {
        let mut line = self.line.lock();
        line.is_served = !line.backlog.parcels.is_empty();
        !line.is_served
    }

    /// Sends the first parcel of the backlog, for the thread that serves it.
    pub(crate) fn send_next(
        &self,
        lock: Option<OwnedFd>,
        concluded: &mut Concluded,
    ) -> BacklogStep {
        let mut guard = self.line.lock();
        let line = &mut *guard;
        let Some((attempt, parcel)) = line.backlog.parcels.front() else {
            line.is_served = false;
            return BacklogStep::Empty;
        };
        let Some(outbox) = &line.outbox else {
            return BacklogStep::NotOpen;
        };
        let lock = lock.map_or(MemoryLock::Try, MemoryLock::Held);
        let error = match outbox.post(*attempt, parcel, lock) {
            Ok(Posted::Sent) => {
                let sent = line.backlog.pop();
                drop(guard);
                // Dropped outside of the lock: this may be the last owner of a letter.
                drop(sent);
                return BacklogStep::Sent;
            }
            Ok(Posted::Contended) => return BacklogStep::NeedsMemory,
            Ok(Posted::Retired) if outbox.waiting() == 0 => {
                line.outbox = None;
                return BacklogStep::NotOpen;
            }
            Ok(Posted::Retired) => retired(),
            Err(error) => error,
        };
        let failed = line.backlog.pop();
        drop(guard);
        concluded.extend(failed.map(|(attempt, _)| (attempt, Conclusion::NotSent(error))));
        BacklogStep::Failed
    }

    /// Concludes the first parcel of the backlog as not sent.
    pub(crate) fn fail_next(&self, error: TransportError, concluded: &mut Concluded) {
        let failed = self.line.lock().backlog.pop();
        concluded.extend(failed.map(|(attempt, _)| (attempt, Conclusion::NotSent(error))));
    }

    /// Concludes all parcels of the backlog as not sent, and ends the claim to serve it.
    pub(crate) fn fail_backlog(&self, error: &TransportError, concluded: &mut Concluded) {
        let mut line = self.line.lock();
        line.is_served = false;
        let failed = line.backlog.take();
        drop(line);
        conclude_unsent(&failed, error, concluded);
    }

    /// Marks the process as ended.
    pub(crate) fn end(&self) {
        self.ended.store(true, Ordering::SeqCst);
        if let Some(outbox) = &self.line.lock().outbox {
            outbox.retire();
        }
    }

    /// Collects the available answers. Returns whether the process has ended and nothing is left.
    pub(crate) fn collect(&self, look: AnswerLook, concluded: &mut Concluded) -> bool {
        // Read first: an answer from before the end is then found below.
        let ended = self.ended.load(Ordering::SeqCst);
        let look = if ended { AnswerLook::Ended } else { look };
        let mut line = self.line.lock();
        let is_over = match &line.outbox {
            Some(outbox) => {
                outbox.collect(look, concluded);
                ended && outbox.is_retired() && outbox.waiting() == 0
            }
            None => ended,
        };
        if ended {
            let unsent = line.backlog.take();
            drop(line);
            conclude_unsent(&unsent, &gone(self.incarnation), concluded);
        }
        is_over
    }

    /// Whether an answer is probably available.
    pub(crate) fn has_answer(&self) -> bool {
        let line = self.line.lock();
        line.outbox.as_ref().is_some_and(|it| it.has_answer())
    }

    /// Concludes all unanswered letters, for a transport that closes.
    pub(crate) fn close(&self, concluded: &mut Concluded) {
        self.end();
        let mut line = self.line.lock();
        let (outbox, unsent) = (line.outbox.take(), line.backlog.take());
        drop(line);
        if let Some(outbox) = outbox {
            outbox.collect(AnswerLook::Ended, concluded);
        }
        conclude_unsent(&unsent, &closed(), concluded);
    }

    /// Abandons an attempt. `None` if it is not here.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> Option<Abandoned> {
        let mut line = self.line.lock();
        let unsent = line.backlog.remove(attempt);
        let outbox = line.outbox.clone();
        drop(line);
        if unsent.is_some() {
            return Some(Abandoned::NotSent);
        }
        let abandoned = outbox.is_some_and(|outbox| outbox.abandon(attempt));
        abandoned.then(|| {
            self.abandoned_at
                .store(self.process.page().words().polls(), Ordering::Relaxed);
            Abandoned::Unconfirmed
        })
    }

    /// Stops the outbox from accepting letters. Unanswered ones still get their answers.
    pub(crate) fn retire(&self) {
        if let Some(outbox) = &self.line.lock().outbox {
            outbox.retire();
        }
    }

    /// Returns the process if its mailbox may still contain letters of this outbox. The outbox must
    /// then stay open: iceoryx2 0.10 does not release memory of requests that a receiver finds
    /// after their sender has closed.
    pub(crate) fn untaken(&self) -> Option<&PeerProcess> {
        let line = self.line.lock();
        let waiting = line.outbox.as_ref().is_some_and(|it| it.waiting() > 0);
        drop(line);
        let abandoned_at = self.abandoned_at.load(Ordering::Relaxed);
        let polled_since = self
            .process
            .page()
            .words()
            .polls()
            .wrapping_sub(abandoned_at)
            >= 2;
        let abandoned = abandoned_at != NEVER && !polled_since;
        let ended = self.ended.load(Ordering::SeqCst);
        (!ended && (waiting || abandoned)).then_some(&self.process)
    }

    pub(crate) fn mark_used(&self, now: u64) {
        self.used.store(now, Ordering::Relaxed);
    }

    pub(crate) fn last_used(&self) -> u64 {
        self.used.load(Ordering::Relaxed)
    }

    /// Whether the peer can be dropped without losing anything.
    pub(crate) fn is_idle(&self) -> bool {
        let line = self.line.lock();
        let is_idle = !line.is_served && line.outbox.as_ref().is_none_or(|it| it.is_idle());
        drop(line);
        is_idle && self.untaken().is_none()
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        if let Some(watcher) = self.watcher.get() {
            watcher.abort();
        }
    }
}

/// The way of parcels to a process.
#[derive(Default)]
struct Line {
    outbox: Option<Arc<Outbox>>,
    backlog: Backlog,
    /// Whether a thread opens the outbox and sends the parcels of the backlog, or is about to.
    /// Further parcels are queued behind these.
    is_served: bool,
}

/// Parcels that a thread sends that may wait, in order.
#[derive(Default)]
struct Backlog {
    parcels: VecDeque<(AttemptId, Parcel)>,
    /// Total length of the letters.
    bytes: usize,
}

/// The limits of a backlog.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BacklogLimits {
    /// Maximum number of parcels at which another letter is queued, and another parcel.
    pub(crate) letters: usize,
    pub(crate) parcels: usize,
    /// Maximum total length of the letters.
    pub(crate) bytes: usize,
}

impl Backlog {
    fn push(
        &mut self,
        attempt: AttemptId,
        parcel: Parcel,
        limits: BacklogLimits,
    ) -> Result<(), TransportError> {
        let bytes = self.bytes.saturating_add(letter_len(&parcel));
        let most = match &parcel.body {
            Body::Letter(_) => limits.letters,
            _ => limits.parcels,
        };
        if self.parcels.len() >= most || bytes > limits.bytes {
            return Err(TransportError::new(
                TransportErrorKind::Congested,
                format_args!(
                    "{} parcels wait until the mailbox of the other process is open",
                    self.parcels.len()
                ),
            ));
        }
        self.bytes = bytes;
        self.parcels.push_back((attempt, parcel));
        Ok(())
    }

    fn pop(&mut self) -> Option<(AttemptId, Parcel)> {
        let popped = self.parcels.pop_front()?;
        self.bytes -= letter_len(&popped.1);
        Some(popped)
    }

    fn remove(&mut self, attempt: AttemptId) -> Option<(AttemptId, Parcel)> {
        let at = self.parcels.iter().position(|(one, _)| *one == attempt)?;
        let removed = self.parcels.remove(at)?;
        self.bytes -= letter_len(&removed.1);
        Some(removed)
    }

    fn take(&mut self) -> VecDeque<(AttemptId, Parcel)> {
        self.bytes = 0;
        std::mem::take(&mut self.parcels)
    }
}

/// The result of [`Peer::post`].
pub(crate) enum Dispatched {
    /// The parcel is in the mailbox.
    Sent,
    /// The parcel is in the backlog, which a thread serves.
    Queued,
    /// The parcel is in the backlog, and the caller must start a thread that serves it.
    QueuedFirst,
}

/// The result of [`Peer::outbox`].
pub(crate) enum OpenOutbox {
    Open(Arc<Outbox>),
    /// The caller must open the outbox and serve the backlog.
    Claimed,
}

/// The result of [`Peer::send_next`].
pub(crate) enum BacklogStep {
    /// The parcel is in the mailbox.
    Sent,
    /// The parcel was concluded.
    Failed,
    /// The parcel needs the lock under which memory is allocated.
    NeedsMemory,
    /// The outbox must be opened first.
    NotOpen,
    /// The backlog is empty, and the caller does not serve it any more.
    Empty,
}

fn letter_len(parcel: &Parcel) -> usize {
    match &parcel.body {
        Body::Letter(letter) => letter.len(),
        _ => 0,
    }
}

fn conclude_unsent(
    unsent: &VecDeque<(AttemptId, Parcel)>,
    error: &TransportError,
    concluded: &mut Concluded,
) {
    let unsent = unsent.iter();
    concluded.extend(unsent.map(|(attempt, _)| (*attempt, Conclusion::NotSent(error.clone()))));
}
