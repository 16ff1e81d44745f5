//! The other processes that an endpoint keeps in mind.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};

use fipa_transport::{AttemptId, Conclusion, Incarnation, WayError, WayFault};
use parking_lot::Mutex;
use tokio::runtime::Handle;
use tokio::task::AbortHandle;

use crate::outbox::Outbox;
use crate::presence::{Neighbour, Watched, has_ended};

/// No count of looks.
const NEVER: u64 = u64::MAX;

/// Another process.
///
/// Its end is final: [`Peer::end`] first says so, then stops its outbox from taking letters; and
/// an outbox is only opened, under the same lock, while it has not ended. So once
/// [`Peer::collect`] has found the outbox of an ended process empty, nothing is forgotten with it.
pub(crate) struct Peer {
    incarnation: Incarnation,
    neighbour: Neighbour,
    outbox: Mutex<Option<Arc<Outbox>>>,
    ended: AtomicBool,
    /// How often the process had looked when a letter to it was abandoned last.
    abandoned_at: AtomicU64,
    used: AtomicU64,
    watcher: OnceLock<AbortHandle>,
}

impl Peer {
    pub(crate) fn new(incarnation: Incarnation, neighbour: Neighbour) -> Self {
        Self {
            incarnation,
            neighbour,
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

    /// Whether it will look without being rung at.
    pub(crate) fn is_awake(&self) -> bool {
        self.neighbour.is_awake()
    }

    /// Whether it was looking when it was last asked.
    pub(crate) fn was_looking(&self) -> bool {
        self.neighbour.was_looking()
    }

    /// Makes it look, unless it is awake. Says whether the bell was rung.
    pub(crate) fn wake(&self) -> bool {
        self.neighbour.wake()
    }

    /// Calls `ended` when the process ends.
    pub(crate) fn watch(
        &self,
        runtime: &Handle,
        ended: impl FnOnce() + Send + 'static,
    ) -> std::io::Result<()> {
        let _runtime = runtime.enter();
        let live = Watched::readable(self.neighbour.live().clone())?;
        let task = runtime.spawn(async move {
            while let Ok(mut ready) = live.readable().await {
                if has_ended(live.get_ref().get()) {
                    return ended();
                }
                ready.clear_ready();
            }
        });
        // Set once, right after making the peer.
        let _ = self.watcher.set(task.abort_handle());
        Ok(())
    }

    /// The outbox, opened with `open` if necessary.
    pub(crate) fn outbox(
        &self,
        open: impl FnOnce() -> Result<Outbox, WayError>,
    ) -> Result<Arc<Outbox>, WayError> {
        let mut slot = self.outbox.lock();
        if self.ended.load(Ordering::SeqCst) {
            return Err(self.gone());
        }
        match &*slot {
            Some(outbox) => Ok(outbox.clone()),
            None => Ok(slot.insert(Arc::new(open()?)).clone()),
        }
    }

    fn gone(&self) -> WayError {
        WayError::new(
            WayFault::Unreachable,
            format_args!("the process {} has ended", self.incarnation),
        )
    }

    /// Forgets an outbox that takes nothing any more, when all its letters are concluded.
    pub(crate) fn renew(&self) {
        let mut slot = self.outbox.lock();
        if slot
            .as_ref()
            .is_some_and(|outbox| outbox.is_retired() && outbox.waiting() == 0)
        {
            *slot = None;
        }
    }

    /// The process has ended.
    pub(crate) fn end(&self) {
        self.ended.store(true, Ordering::SeqCst);
        if let Some(outbox) = &*self.outbox.lock() {
            outbox.retire();
        }
    }

    /// Takes the answers that are there, and says whether this peer can be forgotten.
    pub(crate) fn collect(&self, concluded: &mut Vec<(AttemptId, Conclusion)>) -> bool {
        // Asked before: an answer that came before the end is found then.
        let ended = self.ended.load(Ordering::SeqCst);
        match &*self.outbox.lock() {
            Some(outbox) => {
                outbox.collect(ended, concluded);
                ended && outbox.is_retired() && outbox.waiting() == 0
            }
            None => ended,
        }
    }

    /// Whether there is an answer to be collected, probably.
    pub(crate) fn has_answer(&self) -> bool {
        let outbox = self.outbox.lock();
        outbox.as_ref().is_some_and(|outbox| outbox.has_answer())
    }

    /// Gives every letter that waits its conclusion, for a transport that closes.
    pub(crate) fn close(&self, concluded: &mut Vec<(AttemptId, Conclusion)>) {
        self.end();
        if let Some(outbox) = self.outbox.lock().take() {
            outbox.collect(true, concluded);
        }
    }

    /// Forgets an attempt, and says whether it was here.
    pub(crate) fn abandon(&self, attempt: AttemptId) -> bool {
        let outbox = self.outbox.lock().clone();
        let abandoned = outbox.is_some_and(|outbox| outbox.abandon(attempt));
        if abandoned {
            self.abandoned_at
                .store(self.neighbour.looks(), Ordering::Relaxed);
        }
        abandoned
    }

    /// From now on it takes no letters. What waits still waits.
    pub(crate) fn retire(&self) {
        if let Some(outbox) = &*self.outbox.lock() {
            outbox.retire();
        }
    }

    /// The process, when letters may still lie in its mailbox. While they do, the outbox must not
    /// go: iceoryx2 0.10 never lets go of memory for requests that it finds when their sender has
    /// gone.
    pub(crate) fn untaken(&self) -> Option<&Neighbour> {
        let waiting = self
            .outbox
            .lock()
            .as_ref()
            .is_some_and(|it| it.waiting() > 0);
        let abandoned_at = self.abandoned_at.load(Ordering::Relaxed);
        let looked_since = self.neighbour.looks().wrapping_sub(abandoned_at) >= 2;
        let abandoned = abandoned_at != NEVER && !looked_since;
        let ended = self.ended.load(Ordering::SeqCst);
        (!ended && (waiting || abandoned)).then_some(&self.neighbour)
    }

    pub(crate) fn mark_used(&self, now: u64) {
        self.used.store(now, Ordering::Relaxed);
    }

    pub(crate) fn last_used(&self) -> u64 {
        self.used.load(Ordering::Relaxed)
    }

    /// Whether nothing would be lost by forgetting it.
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
