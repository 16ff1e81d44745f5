//! Watching the letters of a domain on this host: who writes what to whom, which way, and what
//! becomes of it. Agents are not asked, and notice nothing.
//!
//! A [`Watcher`] puts up a socket in the domain's private directory. Every process of the domain
//! sees it there, connects, and from then on tells of each letter that passes it: sender, gateway
//! and receiver each for themselves, which the watcher makes one [`Event`] of. A process never
//! waits for a watcher: what cannot be told is counted, and the count is told.
//!
//! What must not live here: the format of what is told, and how it is put together; that is
//! `fipa_mts::watch`.

mod line;
mod listening;
mod socket;
mod taps;

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_mts::watch::Joiner;
use fipa_mts::watch::record::{MAX_CONTENT, Wish};
pub use fipa_mts::watch::{Event, Fate, Passage, RecordError};
use fipa_sds::{Directory, HostDirectory, Reach};
use fipa_transport::Incarnation;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;

use self::listening::Told;
pub(crate) use self::taps::Taps;
use crate::Config;
use crate::error::OpenError;
use crate::host_directory;
use crate::keeper::Keeper;
use crate::owner::Owner;
use crate::place::Place;

/// What is to be seen.
#[derive(Debug, Clone, Copy, Default)]
pub struct WatchOptions {
    /// How many bytes of the content of each message, from its beginning; at most 24 KiB.
    pub content: usize,
}

/// Somebody who watches a domain. Ends when dropped.
pub struct Watcher {
    told: mpsc::Receiver<Told>,
    joiner: Joiner,
    host: Arc<HostDirectory>,
    place: Place,
    owner: Owner,
    listening: JoinHandle<()>,
    keeper: JoinHandle<()>,
}

/// What processes have told and nobody has looked at yet, in records; then they are not listened
/// to, and their own bounds hold.
const TOLD: usize = 4096;
/// How long processes have to say that they tell of their letters, before the watching begins.
const ANSWERING: Duration = Duration::from_secs(1);
/// How much is looked at before the next event is told.
const BATCH: usize = 2 * TOLD;

impl Watcher {
    /// Watches the domain that the configuration names: from the return of this on all processes
    /// that have agents and answer within a second, the others as soon as they do. Must be called
    /// within a tokio runtime.
    ///
    /// # Errors
    /// When the domain's directory cannot be used.
    pub async fn open(config: &Config, options: WatchOptions) -> Result<Self, OpenError> {
        config.check()?;
        tokio::runtime::Handle::try_current().map_err(|_| OpenError::NoRuntime)?;
        let name = format!("fipa-watch-{}", std::process::id());
        let own = fipa_sds::Mts::new(name, Incarnation::random());
        let (place, host) = host_directory::join(&config.domain, &own, false)?;
        let socket = host.listen().inspect_err(|_| leave(&host, &place))?;
        let listener = socket::listening(socket).map_err(|source| {
            leave(&host, &place);
            OpenError::Watch(source)
        })?;
        let content = u32::try_from(options.content.min(MAX_CONTENT)).unwrap_or(u32::MAX);
        let (sender, told) = mpsc::channel(TOLD);
        let listening = tokio::spawn(listening::run(listener, Wish { content }, sender));
        let keeper = Keeper::new(place.clone(), Arc::clone(&host));
        let mut watcher = Self {
            told,
            joiner: Joiner::new(),
            host,
            keeper: tokio::spawn(keeper.run()),
            place,
            owner: Owner::this(),
            listening,
        };
        // One that does not answer may be stopped; the others are watched all the same.
        let _ = tokio::time::timeout(ANSWERING, watcher.greeted()).await;
        Ok(watcher)
    }

    /// Waits until all processes that have agents tell of their letters.
    async fn greeted(&mut self) {
        while !self.all_tell() {
            match self.told.recv().await {
                Some(told) => self.hear(told),
                None => return,
            }
        }
    }

    fn all_tell(&self) -> bool {
        let entries = self.host.entries();
        let here = entries.iter().filter(|entry| entry.reach == Reach::Local);
        let telling: HashSet<Incarnation> = self.joiner.services().collect();
        here.map(|entry| entry.mts.incarnation)
            .all(|mts| telling.contains(&mts))
    }

    /// How many processes tell of their letters.
    #[must_use]
    pub fn processes(&self) -> usize {
        self.joiner.services().count()
    }

    /// The next event; waits until there is one. Dropping the future loses nothing.
    pub async fn next(&mut self) -> Event {
        loop {
            // Everything that is there first: it may have been before what is known already.
            for _ in 0..BATCH {
                match self.told.try_recv() {
                    Ok(told) => self.hear(told),
                    Err(_) => break,
                }
            }
            if let Some(event) = self.joiner.poll_event(Instant::now()) {
                return event;
            }
            let due = self.joiner.poll_timeout();
            let told = match due {
                Some(due) => tokio::time::timeout_at(due.into(), self.told.recv()).await,
                None => Ok(self.told.recv().await),
            };
            match told {
                Ok(Some(told)) => self.hear(told),
                // Nobody will be heard any more; and it is logged why.
                Ok(None) if due.is_none() => std::future::pending().await,
                Ok(None) | Err(_) => {}
            }
        }
    }

    /// What is known already and was held back, without waiting for anything: the watching ends.
    pub fn finish(&mut self) -> Option<Event> {
        while let Ok(told) = self.told.try_recv() {
            self.hear(told);
        }
        self.joiner.finish()
    }

    fn hear(&mut self, told: Told) {
        match told {
            Told::Begin(source, name) => self.joiner.handle_begin(source, name),
            Told::Record(source, record) => self.joiner.handle(Instant::now(), source, record),
            Told::Malformed(source, why) => self.joiner.handle_malformed(source, why),
            Told::End(source) => self.joiner.handle_end(source),
        }
    }

    /// Who is there: the agents of this host and, when a gateway is running, those it knows of.
    #[must_use]
    pub fn directory(&self) -> &dyn Directory {
        &*self.host
    }
}

impl Drop for Watcher {
    fn drop(&mut self) {
        // In a forked child everything stays the parent's.
        if !self.owner.is_this() {
            return;
        }
        self.listening.abort();
        self.keeper.abort();
        leave(&self.host, &self.place);
    }
}

fn leave(host: &HostDirectory, place: &Place) {
    if let Err(error) = host.close() {
        tracing::warn!(%error, "could not leave the directory of this host in order");
    }
    place.leave();
}
