//! The queue of a domain handle. A program begins operations with a tag of its own. What it waits for comes out of one
//! queue, as items with that tag, and a descriptor is readable while the queue may have an item.
//!
//! The queue has no thread and stores no item: the thread that asks for the next item polls the operations. So no foreign
//! code runs on a thread of the library, and letters wait in the queue of their agent until the program takes them.

pub(crate) mod bell;
mod slot;

use std::fmt;
use std::future::poll_fn;
use std::io;
use std::os::fd::BorrowedFd;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};

use fipa::blocking::Wait;
use futures_core::Stream;
use futures_core::stream::BoxStream;
use futures_util::StreamExt as _;
use futures_util::stream::{SelectAll, once};
use parking_lot::Mutex;

use crate::queue::bell::Bell;
use crate::queue::slot::{Abandon, Polled, Slot};

/// A queue of items. A clone is a further handle of the same queue.
///
/// Items of one operation come in their order. Operations that have an item take turns.
pub struct Queue<E> {
    shared: Arc<Shared<E>>,
}

struct Shared<E> {
    /// Polled by one thread at a time.
    running: Mutex<Running<E>>,
    /// Operations that no thread has polled yet.
    begun: Mutex<Vec<BoxStream<'static, Item<E>>>>,
    bell: Arc<Bell>,
}

/// An event of an operation, with its tag.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(clippy::exhaustive_structs, reason = "callers build items in tests")]
pub struct Item<E> {
    /// The tag with which the operation was begun.
    pub tag: u64,
    /// The event.
    pub event: E,
}

/// An operation that was begun. Dropping the value does not end the operation.
#[derive(Clone)]
pub struct Operation(Arc<dyn Abandon>);

impl Operation {
    /// Ends the operation: its future is dropped, and no further item comes, except one that another thread is
    /// taking at this moment.
    pub fn abandon(&self) {
        self.0.abandon();
    }
}

impl fmt::Debug for Operation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Operation").finish_non_exhaustive()
    }
}

impl<E: Send + 'static> Queue<E> {
    /// Creates a queue without operations.
    #[must_use]
    pub fn new() -> Self {
        let shared = Shared {
            running: Mutex::new(SelectAll::new()),
            begun: Mutex::default(),
            bell: Arc::new(Bell::new()),
        };
        Self {
            shared: Arc::new(shared),
        }
    }

    /// Begins an operation that has one item. The operation makes progress only while a thread asks for the next item.
    pub fn begin(
        &self,
        tag: u64,
        operation: impl Future<Output = E> + Send + 'static,
    ) -> Operation {
        self.follow(tag, once(operation))
    }

    /// Begins an operation that has several items, one for each event of the stream.
    pub fn follow(&self, tag: u64, events: impl Stream<Item = E> + Send + 'static) -> Operation {
        let slot = Slot::new(events.boxed());
        let items = Polled(Arc::clone(&slot)).map(move |event| Item { tag, event });
        self.shared.begun.lock().push(items.boxed());
        Waker::from(Arc::clone(&self.shared.bell)).wake();
        Operation(slot)
    }

    /// Waits for the next item, at most for `timeout`, or without a limit if there is none. Of several threads that
    /// wait, each item goes to one.
    ///
    /// With a timeout of zero, an empty answer makes the [descriptor](Self::descriptor) unreadable.
    pub fn next(&self, timeout: Option<Duration>) -> Option<Item<E>> {
        if timeout == Some(Duration::ZERO) {
            let mut running = self.shared.running.try_lock()?;
            return poll_fn(|context| Poll::Ready(self.shared.now(&mut running, context))).wait();
        }
        let due = timeout.and_then(|timeout| Instant::now().checked_add(timeout));
        let mut running = match due {
            Some(due) => self.shared.running.try_lock_until(due)?,
            None => self.shared.running.lock(),
        };
        let next = poll_fn(|context| self.shared.poll(&mut running, context));
        match due {
            Some(due) => next.wait_within(due.saturating_duration_since(Instant::now())),
            None => Some(next.wait()),
        }
    }

    /// Returns a descriptor that is readable from before an item can be taken until [`next`](Self::next) with a
    /// timeout of zero has returned none. It may be readable without an item. The program only polls it.
    ///
    /// # Errors
    /// If the process has no descriptor left.
    pub fn descriptor(&self) -> io::Result<BorrowedFd<'_>> {
        self.shared.bell.descriptor()
    }
}

type Running<E> = SelectAll<BoxStream<'static, Item<E>>>;

impl<E: Send + 'static> Shared<E> {
    /// Takes the next item, or registers the waiting thread.
    fn poll(&self, running: &mut Running<E>, context: &Context<'_>) -> Poll<Item<E>> {
        // Before the operations are looked at, so that none begins unseen.
        self.bell.wait(context.waker());
        running.extend(self.begun.lock().drain(..));
        let bell = Waker::from(Arc::clone(&self.bell));
        match running.poll_next_unpin(&mut Context::from_waker(&bell)) {
            Poll::Ready(Some(item)) => {
                // More may be ready, and no operation wakes the program twice.
                self.bell.ring();
                Poll::Ready(item)
            }
            // Without an operation, the next one that begins wakes the thread.
            Poll::Ready(None) | Poll::Pending => Poll::Pending,
        }
    }

    /// Takes the next item if there is one; else makes the descriptor unreadable.
    fn now(&self, running: &mut Running<E>, context: &Context<'_>) -> Option<Item<E>> {
        let mut polled = self.poll(running, context);
        if polled.is_pending() && self.bell.quiet() {
            polled = self.poll(running, context);
        }
        match polled {
            Poll::Ready(item) => Some(item),
            Poll::Pending => None,
        }
    }
}

impl<E: Send + 'static> Default for Queue<E> {
    fn default() -> Self {
        Self::new()
    }
}

impl<E> Clone for Queue<E> {
    fn clone(&self) -> Self {
        Self {
            shared: Arc::clone(&self.shared),
        }
    }
}

impl<E> fmt::Debug for Queue<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Queue").finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests;
