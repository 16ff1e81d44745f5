//! The place of one operation.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};

use fipa::blocking::Wait;
use futures_core::Stream;
use futures_core::stream::BoxStream;
use futures_util::StreamExt as _;
use futures_util::task::AtomicWaker;
use parking_lot::Mutex;

/// The events of an operation, until it ends or is abandoned.
pub(crate) struct Slot<E> {
    events: Mutex<Option<BoxStream<'static, E>>>,
    is_abandoned: AtomicBool,
    /// Has the queue forget the slot.
    waker: AtomicWaker,
}

impl<E> Slot<E> {
    pub(crate) fn new(events: BoxStream<'static, E>) -> Arc<Self> {
        Arc::new(Self {
            events: Mutex::new(Some(events)),
            is_abandoned: AtomicBool::new(false),
            waker: AtomicWaker::new(),
        })
    }
}

/// The side of an [`Operation`](crate::Operation).
pub(crate) trait Abandon: Send + Sync {
    fn abandon(&self);
}

impl<E: Send + 'static> Abandon for Slot<E> {
    fn abandon(&self) {
        self.is_abandoned.store(true, Ordering::SeqCst);
        // A thread that polls the operation now drops it itself.
        let events = self.events.try_lock().and_then(|mut events| events.take());
        if events.is_some() {
            // Dropping an operation may send a letter, which needs the runtime.
            async { drop(events) }.wait();
        }
        self.waker.wake();
    }
}

/// The side of the queue.
pub(crate) struct Polled<E>(pub(crate) Arc<Slot<E>>);

impl<E: Send + 'static> Stream for Polled<E> {
    type Item = E;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<E>> {
        let slot = &self.0;
        // Before the operation is polled, so that no abandonment stays unseen.
        slot.waker.register(context.waker());
        let mut events = slot.events.lock();
        if slot.is_abandoned.load(Ordering::SeqCst) {
            *events = None;
        }
        let Some(running) = &mut *events else {
            return Poll::Ready(None);
        };
        let polled = running.poll_next_unpin(context);
        if matches!(polled, Poll::Ready(None)) || slot.is_abandoned.load(Ordering::SeqCst) {
            *events = None;
        }
        polled
    }
}
