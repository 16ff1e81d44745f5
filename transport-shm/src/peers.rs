//! The other processes that an endpoint has open.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use fipa_transport::{AttemptId, Conclusion, Incarnation, TransportError, TransportErrorKind};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::task::AbortHandle;

use crate::outbox::Outbox;
use crate::presence::{PeerProcess, SharedFd, has_ended};

/// A value that the count of polls does not reach.
const NEVER: u64 = u64::MAX;

/// Another process.
///
/// Its end is final. [`Peer::end`] first sets `ended`, then stops the outbox from accepting
/// letters; and an outbox is opened, under the same lock, only while `ended` is false. So once
/// [`Peer::collect`] has found the outbox of an ended process empty, no letter is lost with it.
pub(crate) struct Peer {
    incarnation: Incarnation,
    process: PeerProcess,
    outbox: Mutex<Option<Arc<Outbox>>>,
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
            outbox: Mutex::new(None),
            ended: AtomicBool::new(false),
            abandoned_at: AtomicU64::new(NEVER),
            used: AtomicU64::new(0),
            watcher: OnceLock::new(),
        }
    }

    pub(crate) fn incarnation(&self) -> Incarnation {
        self.incarnation
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

    /// Returns the outbox, opened with `open` if necessary.
    pub(crate) fn outbox(
        &self,
        open: impl FnOnce() -> Result<Outbox, TransportError>,
    ) -> Result<Arc<Outbox>, TransportError> {
        let mut slot = self.outbox.lock();
        if self.ended.load(Ordering::SeqCst) {
            return Err(self.gone());
        }
        match &*slot {
            Some(outbox) => Ok(outbox.clone()),
            None => Ok(slot.insert(Arc::new(open()?)).clone()),
        }
    }

    fn gone(&self) -> TransportError {
        TransportError::new(
            TransportErrorKind::Unreachable,
            format_args!("process {} has ended", self.incarnation),
        )
    }

    /// Drops a retired outbox whose letters are all concluded.
    pub(crate) fn renew(&self) {
        let mut slot = self.outbox.lock();
        if slot
            .as_ref()
            .is_some_and(|outbox| outbox.is_retired() && outbox.waiting() == 0)
        {
            *slot = None;
        }
    }

    /// Marks the process as ended.
    pub(crate) fn end(&self) {
        self.ended.store(true, Ordering::SeqCst);
        if let Some(outbox) = &*self.outbox.lock() {
            outbox.retire();
        }
    }

    /// Collects the available answers. Returns whether the process has ended and nothing is left.
    pub(crate) fn collect(&self, concluded: &mut Vec<(AttemptId, Conclusion)>) -> bool {
        // Read first: an answer from before the end is then found below.
        let ended = self.ended.load(Ordering::SeqCst);
        match &*self.outbox.lock() {
            Some(outbox) => {
                outbox.collect(ended, concluded);
                ended && outbox.is_retired() && outbox.waiting() == 0
            }
            None => ended,
        }
    }

    /// Whether an answer is probably available.
    pub(crate) fn has_answer(&self) -> bool {
        let outbox = self.outbox.lock();
        outbox.as_ref().is_some_and(|outbox| outbox.has_answer())
    }

    /// Concludes all unanswered letters, for a transport that closes.
    pub(crate) fn close(&self, concluded: &mut Vec<(AttemptId, Conclusion)>) {
        self.end();
        if let Some(outbox) = self.outbox.lock().take() {
            outbox.collect(true, concluded);
        }
    }

    /// Abandons an attempt. Returns whether the attempt was here.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> bool {
        let outbox = self.outbox.lock().clone();
        let abandoned = outbox.is_some_and(|outbox| outbox.abandon(attempt));
        if abandoned {
            self.abandoned_at
                .store(self.process.polls(), Ordering::Relaxed);
        }
        abandoned
    }

    /// Stops the outbox from accepting letters. Unanswered ones still get their answers.
    pub(crate) fn retire(&self) {
        if let Some(outbox) = &*self.outbox.lock() {
            outbox.retire();
        }
    }

    /// Returns the process if its mailbox may still contain letters of this outbox. The outbox must
    /// then stay open: iceoryx2 0.10 does not release memory of requests that a receiver finds
    /// after their sender has closed.
    pub(crate) fn untaken(&self) -> Option<&PeerProcess> {
        let waiting = self
            .outbox
            .lock()
            .as_ref()
            .is_some_and(|it| it.waiting() > 0);
        let abandoned_at = self.abandoned_at.load(Ordering::Relaxed);
        let polled_since = self.process.polls().wrapping_sub(abandoned_at) >= 2;
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
        let outbox = self.outbox.lock();
        let is_idle = outbox.as_ref().is_none_or(|outbox| outbox.is_idle());
        drop(outbox);
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
