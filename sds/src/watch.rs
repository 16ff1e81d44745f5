//! Notifications of changes in a directory.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll, ready};

use futures_core::Stream;
use parking_lot::Mutex;
use tokio::sync::mpsc;

use crate::merged::MergedView;
use crate::{Entry, Role};

/// One change of a directory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// A name that was free has an entry.
    Joined(Arc<Entry>),
    /// The entry of a name was replaced, perhaps by one of another incarnation.
    Changed {
        /// The previous entry.
        before: Arc<Entry>,
        /// The current entry.
        after: Arc<Entry>,
    },
    /// An entry was removed.
    Left(Arc<Entry>),
    /// Several changes that took effect at once, without an intermediate state. Has at least two
    /// changes, all of coalitions and none of this kind.
    Together(Vec<Change>),
    /// The watcher was too slow and missed changes; it must read all entries again.
    Lagged,
}

impl Change {
    /// Returns the change from one entry of a name to another, if they differ.
    pub(crate) fn between(before: Option<Arc<Entry>>, after: Option<Arc<Entry>>) -> Option<Self> {
        match (before, after) {
            (None, Some(after)) => Some(Self::Joined(after)),
            (Some(before), None) => Some(Self::Left(before)),
            (Some(before), Some(after)) if before != after => Some(Self::Changed { before, after }),
            _ => None,
        }
    }

    /// Combines several changes into one; `None` if there are none.
    pub(crate) fn together(mut changes: Vec<Self>) -> Option<Self> {
        if changes.len() < 2 {
            return changes.pop();
        }
        Some(Self::Together(changes))
    }

    /// Returns the parts of a combined change, or the change itself.
    #[must_use]
    pub fn single(&self) -> &[Self] {
        match self {
            Self::Together(changes) => changes,
            one => std::slice::from_ref(one),
        }
    }

    /// Whether the change concerns a coalition, before or after it.
    pub(crate) fn of_coalition(&self) -> bool {
        let is = |entry: &Entry| matches!(entry.role, Role::Coalition(_));
        match self {
            Self::Joined(entry) | Self::Left(entry) => is(entry),
            Self::Changed { before, after } => is(before) || is(after),
            Self::Together(_) | Self::Lagged => false,
        }
    }

    /// Returns the name that the change concerns, if there is exactly one.
    pub(crate) fn name(&self) -> Option<&Arc<str>> {
        match self {
            Self::Joined(entry) | Self::Left(entry) | Self::Changed { after: entry, .. } => {
                Some(&entry.name)
            }
            Self::Together(_) | Self::Lagged => None,
        }
    }
}

/// The changes of a directory since the watch was created, in order.
///
/// Bounded: when more than [`Watch::CAPACITY`] changes are unread, they are replaced by one
/// [`Change::Lagged`].
///
/// Also a [`Stream`], which ends when the directory is gone.
pub struct Watch {
    changes: mpsc::Receiver<Change>,
    lagged: Arc<AtomicBool>,
    merged: Option<MergedView>,
}

impl Watch {
    /// Maximum number of unread changes.
    pub const CAPACITY: usize = 1024;

    /// Creates a watch and the subscriber to pass to directories.
    #[must_use]
    pub fn new() -> (Subscriber, Self) {
        let (sender, changes) = mpsc::channel(Self::CAPACITY);
        let lagged = Arc::new(AtomicBool::new(false));
        let subscriber = Subscriber {
            changes: sender,
            lagged: Arc::clone(&lagged),
        };
        let watch = Self {
            changes,
            lagged,
            merged: None,
        };
        (subscriber, watch)
    }

    /// Converts the watch to one that reports only changes of the merged view.
    pub(crate) fn merging(mut self, view: MergedView) -> Self {
        self.merged = Some(view);
        self
    }

    /// Waits for the next change; `None` when the directory is gone. This method is cancel-safe.
    pub async fn next(&mut self) -> Option<Change> {
        loop {
            let raw = if self.lags() {
                Change::Lagged
            } else {
                self.changes.recv().await?
            };
            if let Some(change) = self.translate(raw) {
                return Some(change);
            }
        }
    }

    /// Returns the next change if one is ready.
    pub fn try_next(&mut self) -> Option<Change> {
        loop {
            let raw = if self.lags() {
                Change::Lagged
            } else {
                self.changes.try_recv().ok()?
            };
            if let Some(change) = self.translate(raw) {
                return Some(change);
            }
        }
    }

    /// Returns whether changes were missed. If so, discards unread changes: the entries that the
    /// watcher reads next are newer.
    fn lags(&mut self) -> bool {
        let lags = self.lagged.swap(false, Ordering::AcqRel);
        if lags {
            while self.changes.try_recv().is_ok() {}
        }
        lags
    }

    fn translate(&mut self, raw: Change) -> Option<Change> {
        match &mut self.merged {
            Some(view) => view.translate(raw),
            None => Some(raw),
        }
    }
}

impl Stream for Watch {
    type Item = Change;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Change>> {
        let this = self.get_mut();
        loop {
            let raw = match this.lags() {
                true => Some(Change::Lagged),
                false => ready!(this.changes.poll_recv(context)),
            };
            let Some(raw) = raw else {
                return Poll::Ready(None);
            };
            if let Some(change) = this.translate(raw) {
                return Poll::Ready(Some(change));
            }
        }
    }
}

impl std::fmt::Debug for Watch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Watch").finish_non_exhaustive()
    }
}

/// The sending end of a [`Watch`].
#[derive(Debug, Clone)]
pub struct Subscriber {
    changes: mpsc::Sender<Change>,
    lagged: Arc<AtomicBool>,
}

impl Subscriber {
    /// Sends a change without blocking. Returns false when the watch was dropped.
    pub fn tell(&self, change: Change) -> bool {
        match self.changes.try_send(change) {
            Ok(()) => true,
            Err(mpsc::error::TrySendError::Full(_)) => {
                self.lagged.store(true, Ordering::Release);
                true
            }
            Err(mpsc::error::TrySendError::Closed(_)) => false,
        }
    }
}

/// All subscribers of a directory.
#[derive(Debug, Default)]
pub(crate) struct Subscribers {
    subscribers: Mutex<Vec<Subscriber>>,
}

impl Subscribers {
    pub(crate) fn subscribe(&self, subscriber: &Subscriber) {
        let mut subscribers = self.subscribers.lock();
        // Dropped watches are otherwise removed only at the next change, which may never come.
        subscribers.retain(|one| !one.changes.is_closed());
        subscribers.push(subscriber.clone());
    }

    pub(crate) fn any(&self) -> bool {
        let subscribers = self.subscribers.lock();
        subscribers.iter().any(|one| !one.changes.is_closed())
    }

    pub(crate) fn tell(&self, change: &Change) {
        let mut subscribers = self.subscribers.lock();
        subscribers.retain(|subscriber| subscriber.tell(change.clone()));
    }
}
