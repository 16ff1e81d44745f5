//! Telling what changes in a directory.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use parking_lot::Mutex;
use tokio::sync::mpsc;

use crate::merged::MergedView;
use crate::{Entry, Role};

/// One change of a directory.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Change {
    /// An entry of a name that was free.
    Joined(Arc<Entry>),
    /// A name has another entry than before, perhaps of another incarnation.
    Changed {
        /// What it was.
        before: Arc<Entry>,
        /// What it is.
        after: Arc<Entry>,
    },
    /// An entry that is gone.
    Left(Arc<Entry>),
    /// Several that are one: nobody saw a state in between. At least two, none of them of this
    /// kind; all of them are of coalitions.
    Together(Vec<Change>),
    /// The watcher was too slow and has missed changes: it should read all entries again.
    Lagged,
}

impl Change {
    /// The change from one entry of a name to the other, if there is any.
    pub(crate) fn between(before: Option<Arc<Entry>>, after: Option<Arc<Entry>>) -> Option<Self> {
        match (before, after) {
            (None, Some(after)) => Some(Self::Joined(after)),
            (Some(before), None) => Some(Self::Left(before)),
            (Some(before), Some(after)) if before != after => Some(Self::Changed { before, after }),
            _ => None,
        }
    }

    /// Several changes as one, if there are any.
    pub(crate) fn together(mut changes: Vec<Self>) -> Option<Self> {
        if changes.len() < 2 {
            return changes.pop();
        }
        Some(Self::Together(changes))
    }

    /// The changes it is made of: itself, when it is one.
    #[must_use]
    pub fn single(&self) -> &[Self] {
        match self {
            Self::Together(changes) => changes,
            one => std::slice::from_ref(one),
        }
    }

    /// Whether it is about a coalition, now or before.
    pub(crate) fn of_coalition(&self) -> bool {
        let is = |entry: &Entry| matches!(entry.role, Role::Coalition(_));
        match self {
            Self::Joined(entry) | Self::Left(entry) => is(entry),
            Self::Changed { before, after } => is(before) || is(after),
            Self::Together(_) | Self::Lagged => false,
        }
    }

    /// The name it is about, if it is one.
    pub(crate) fn name(&self) -> Option<&Arc<str>> {
        match self {
            Self::Joined(entry) | Self::Left(entry) | Self::Changed { after: entry, .. } => {
                Some(&entry.name)
            }
            Self::Together(_) | Self::Lagged => None,
        }
    }
}

/// The changes of a directory from when it was asked for, in order.
///
/// Bounded: who does not read for more than [`Watch::CAPACITY`] changes gets
/// [`Change::Lagged`] in their place.
pub struct Watch {
    changes: mpsc::Receiver<Change>,
    lagged: Arc<AtomicBool>,
    merged: Option<MergedView>,
}

impl Watch {
    /// Most changes that wait for a watcher.
    pub const CAPACITY: usize = 1024;

    /// A watch, and the subscriber to be handed to directories.
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

    /// The same watch, telling only what changes in the merged view.
    pub(crate) fn merging(mut self, view: MergedView) -> Self {
        self.merged = Some(view);
        self
    }

    /// The next change; none when the directory is gone. Cancelling the future loses nothing.
    pub async fn next(&mut self) -> Option<Change> {
        loop {
            let raw = if self.lags() {
                Change::Lagged
            } else {
                self.changes.recv().await?
            };
            if let Some(change) = self.told(raw) {
                return Some(change);
            }
        }
    }

    /// The next change if there is one already.
    pub fn try_next(&mut self) -> Option<Change> {
        loop {
            let raw = if self.lags() {
                Change::Lagged
            } else {
                self.changes.try_recv().ok()?
            };
            if let Some(change) = self.told(raw) {
                return Some(change);
            }
        }
    }

    /// Whether changes were missed. What waits is then thrown away: the entries that will be read
    /// again are newer.
    fn lags(&mut self) -> bool {
        let lags = self.lagged.swap(false, Ordering::AcqRel);
        if lags {
            while self.changes.try_recv().is_ok() {}
        }
        lags
    }

    fn told(&mut self, raw: Change) -> Option<Change> {
        match &mut self.merged {
            Some(view) => view.told(raw),
            None => Some(raw),
        }
    }
}

impl std::fmt::Debug for Watch {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Watch").finish_non_exhaustive()
    }
}

/// Who is told of changes: the other end of a [`Watch`].
#[derive(Debug, Clone)]
pub struct Subscriber {
    changes: mpsc::Sender<Change>,
    lagged: Arc<AtomicBool>,
}

impl Subscriber {
    /// Tells a change, without ever waiting. False when nobody listens any more.
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

/// All subscribers of one directory.
#[derive(Debug, Default)]
pub(crate) struct Hub {
    subscribers: Mutex<Vec<Subscriber>>,
}

impl Hub {
    pub(crate) fn subscribe(&self, subscriber: &Subscriber) {
        let mut subscribers = self.subscribers.lock();
        // Watches that are gone are noticed at the next change, which may never come.
        subscribers.retain(|one| !one.changes.is_closed());
        subscribers.push(subscriber.clone());
    }

    pub(crate) fn tell(&self, change: &Change) {
        let mut subscribers = self.subscribers.lock();
        subscribers.retain(|subscriber| subscriber.tell(change.clone()));
    }
}
