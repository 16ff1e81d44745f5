//! Watching the letters of a domain on this host: sender, receivers, content, route and outcome.
//! Agents do not take part in it.
//!
//! A [`Watcher`] creates a socket in the private directory of the domain. Every process of the domain
//! finds it there, connects, and sends a record of each letter that passes through it. The process of
//! the sender, the gateway and the process of the receiver each send records of their own; the watcher
//! joins them into one [`Event`]. A process never waits for a watcher: it counts lost records and
//! sends the count.
//!
//! Not in this module: the format of the records and how they are joined (`fipa_mts::watch`).

pub(crate) mod connection;
mod listener;
pub(crate) mod reloading;
pub(crate) mod socket;
mod watchers;

use std::collections::HashSet;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_mts::watch::Joiner;
use fipa_mts::watch::record::{MAX_CONTENT, Wish};
pub use fipa_mts::watch::{Event, Fate, Passage, RecordError, SeenEnvelope};
use fipa_sds::{Directory, Reach};
use fipa_transport::Incarnation;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use self::listener::ProcessEvent;
pub(crate) use self::watchers::Watchers;
use crate::Config;
use crate::admin::member::Member;
use crate::domain::directory_view::DirectoryView;
use crate::domain::maintenance::DirMaintenance;
use crate::error::OpenError;

/// The options of a [`Watcher`].
#[derive(Debug, Clone, Copy, Default)]
pub struct WatchOptions {
    /// Number of bytes from the beginning of each message's content to include; at most 24 KiB.
    pub content: usize,
}

/// Watches the letters of a domain. Dropping it ends the watching.
pub struct Watcher {
    events: mpsc::Receiver<ProcessEvent>,
    joiner: Joiner,
    accepting: JoinHandle<()>,
    maintenance: JoinHandle<()>,
    member: Member,
}

/// Maximum number of received batches of records that wait to be joined. Beyond it the watcher stops reading,
/// and the queues of the processes fill.
const MAX_WAITING: usize = 16;
/// Time for the processes of the domain to connect before [`Watcher::open`] returns.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(1);
/// Maximum number of batches that are joined before the next event is returned.
const BATCH: usize = 2 * MAX_WAITING;

impl Watcher {
    /// Watches the domain that the configuration names. When it returns, all processes with agents
    /// that connected within a second are watched; the others are watched as soon as they connect.
    /// Must be called within a tokio runtime.
    ///
    /// # Errors
    /// If the configuration is invalid, or the directory of the domain cannot be used.
    pub async fn open(config: &Config, options: WatchOptions) -> Result<Self, OpenError> {
        let member = Member::join(config, "watch").await?;
        let socket = member.host.listen()?;
        let socket = socket::listening(socket).map_err(OpenError::Watch)?;
        let content = u32::try_from(options.content.min(MAX_CONTENT)).unwrap_or(u32::MAX);
        let (sender, events) = mpsc::channel(MAX_WAITING);
        let accepting = tokio::spawn(listener::run(
            socket,
            member.host.users(),
            Wish { content },
            sender,
        ));
        let maintenance = DirMaintenance::new(member.dir.clone(), Arc::clone(&member.host), None);
        let mut watcher = Self {
            events,
            joiner: Joiner::new(),
            maintenance: tokio::spawn(maintenance.run()),
            accepting,
            member,
        };
        // A process that does not connect may be stopped; the others are watched in any case.
        let _ = tokio::time::timeout(CONNECT_TIMEOUT, watcher.all_connected()).await;
        Ok(watcher)
    }

    /// Waits until all processes with agents have connected.
    async fn all_connected(&mut self) {
        while !self.is_connected_to_all() {
            match self.events.recv().await {
                Some(event) => self.handle(event),
                None => return,
            }
        }
    }

    fn is_connected_to_all(&self) -> bool {
        let entries = self.member.host.entries();
        let local = entries.iter().filter(|entry| entry.reach == Reach::Local);
        let connected: HashSet<Incarnation> = self.joiner.services().collect();
        local
            .map(|entry| entry.mts.incarnation)
            .all(|mts| connected.contains(&mts))
    }

    /// Returns the number of connected processes.
    #[must_use]
    pub fn processes(&self) -> usize {
        self.joiner.services().count()
    }

    /// Waits for the next event. Never returns once the listener has ended, which it logs. Dropping the
    /// future loses no event.
    pub async fn next(&mut self) -> Event {
        loop {
            // Joins all waiting records first: they may precede events that are ready.
            for _ in 0..BATCH {
                match self.events.try_recv() {
                    Ok(event) => self.handle(event),
                    Err(_) => break,
                }
            }
            if let Some(event) = self.joiner.poll_event(Instant::now()) {
                return event;
            }
            let due = self.joiner.poll_timeout();
            let event = match due {
                Some(due) => tokio::time::timeout_at(due.into(), self.events.recv()).await,
                None => Ok(self.events.recv().await),
            };
            match event {
                Ok(Some(event)) => self.handle(event),
                // The accepting task has ended, so no further event can come.
                Ok(None) if due.is_none() => std::future::pending().await,
                Ok(None) | Err(_) => {}
            }
        }
    }

    /// Returns an event that is held back for further records, without waiting. For the end of the
    /// watching: call it until it returns `None`.
    pub fn finish(&mut self) -> Option<Event> {
        while let Ok(event) = self.events.try_recv() {
            self.handle(event);
        }
        self.joiner.finish()
    }

    fn handle(&mut self, event: ProcessEvent) {
        match event {
            ProcessEvent::Begin(source, name) => self.joiner.handle_begin(source, name),
            ProcessEvent::Records(source, records) => {
                let now = Instant::now();
                for record in records {
                    self.joiner.handle(now, source, record);
                }
            }
            ProcessEvent::Malformed(source, why) => self.joiner.handle_malformed(source, why),
            ProcessEvent::End(source) => self.joiner.handle_end(source),
        }
    }

    /// Returns the directory: the agents of this host and, if a gateway is running, the agents that it
    /// has discovered on other hosts.
    #[must_use]
    pub fn directory(&self) -> DirectoryView<'_> {
        DirectoryView::of(&*self.member.host)
    }
}

impl fmt::Debug for Watcher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Watcher")
            .field("dir", &self.member.dir.path())
            .finish_non_exhaustive()
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        if self.member.is_own() {
            self.accepting.abort();
            self.maintenance.abort();
        }
    }
}
