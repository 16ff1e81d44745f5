//! The process's side: sees who watches, and tells them.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_mts::core::Notice;
use fipa_mts::watch::record;
use fipa_mts::{Mts, Tap};
use fipa_sds::{HostDirectory, HostError, SocketId};
use parking_lot::Mutex;
use rustix::net::sockopt::set_socket_send_buffer_size;
use tokio::task::JoinSet;

use super::line::Line;
use super::socket;

/// Watchers that are told at most.
const MAX_WATCHERS: usize = 16;
/// How often, and after which pauses, a watcher that does not get round to accepting is asked
/// again.
const TRIES: usize = 50;
const PAUSE: Duration = Duration::from_millis(20);
/// What the system may keep for a watcher, if it lets us.
const SEND_BUFFER: usize = 1 << 20;

/// All who watch this process.
pub(crate) struct Taps {
    mts: fipa_sds::Mts,
    gateway: bool,
    lines: Mutex<Vec<Arc<Line>>>,
    /// Held while somebody comes or goes, so that the service is watched just when there is a
    /// line. Not the lock above: that is taken with the service locked.
    changing: Mutex<()>,
}

impl Tap for Taps {
    fn notice(&self, notice: &Notice) {
        let at = SystemTime::now();
        for line in &*self.lines.lock() {
            line.tell(record::of(notice, line.wish(), at));
        }
    }
}

impl Taps {
    pub(crate) fn new(mts: &fipa_sds::Mts, gateway: bool) -> Self {
        Self {
            mts: mts.clone(),
            gateway,
            lines: Mutex::default(),
            changing: Mutex::default(),
        }
    }

    /// Tells those who watch already, from the first letter on: a process may live for one letter
    /// only. Waits for nobody. Must be called within a tokio runtime.
    pub(crate) fn begin(self: &Arc<Self>, host: &HostDirectory, service: &Mts) -> Vec<Tapped> {
        let there = host.sockets().borrow().clone();
        let begun = there.into_iter().take(MAX_WATCHERS).filter_map(|watcher| {
            // Who cannot be told now is tried again by the task.
            self.connect(host, watcher, service).ok()
        });
        begun.collect()
    }

    /// Connects to whoever watches, for as long as the process takes part in the domain.
    pub(crate) async fn run(
        self: Arc<Self>,
        host: Arc<HostDirectory>,
        service: Mts,
        begun: Vec<Tapped>,
    ) {
        let mut sockets = host.sockets();
        let mut known: BTreeSet<SocketId> = begun.iter().map(|tapped| tapped.watcher).collect();
        let mut watchers = JoinSet::new();
        for tapped in begun {
            watchers.spawn(tapped.serve());
        }
        loop {
            let there: BTreeSet<SocketId> = sockets.borrow_and_update().iter().copied().collect();
            for new in there.difference(&known) {
                if watchers.len() < MAX_WATCHERS {
                    let (taps, host) = (Arc::clone(&self), Arc::clone(&host));
                    watchers.spawn(taps.serve(host, service.clone(), *new));
                } else {
                    tracing::warn!("more than {MAX_WATCHERS} watch; one of them is told nothing");
                }
            }
            known = there;
            if sockets.changed().await.is_err() {
                return;
            }
            while watchers.try_join_next().is_some() {}
        }
    }

    async fn serve(self: Arc<Self>, host: Arc<HostDirectory>, service: Mts, watcher: SocketId) {
        for _ in 1..TRIES {
            match self.connect(&host, watcher, &service) {
                Ok(tapped) => return tapped.serve().await,
                Err(HostError::Io { source, .. })
                    if source.kind() == std::io::ErrorKind::WouldBlock => {}
                // It has gone already, or is none of ours.
                Err(error) => return tracing::debug!(%error, "a watcher cannot be told anything"),
            }
            tokio::time::sleep(PAUSE).await;
        }
        tracing::warn!("somebody who watches does not answer, and is told nothing");
    }

    fn connect(
        self: &Arc<Self>,
        host: &HostDirectory,
        watcher: SocketId,
        service: &Mts,
    ) -> Result<Tapped, HostError> {
        let socket = host.connect(watcher)?;
        // Less than was asked for is well, too.
        let _ = set_socket_send_buffer_size(&socket, SEND_BUFFER);
        let socket = socket::connected(socket).map_err(|source| HostError::Io {
            what: "wait for",
            path: "a watcher's socket".into(),
            source,
        })?;
        let line = Arc::new(Line::new(socket));
        let fipa_sds::Mts { name, incarnation } = &self.mts;
        let hello = record::hello(name, *incarnation, self.gateway, SystemTime::now());
        line.tell(hello);
        let tapped = Tapped {
            taps: Arc::clone(self),
            watcher,
            line: Arc::clone(&line),
            service: service.clone(),
        };
        tapped.change(|lines| lines.push(line));
        tracing::info!(mts = %name, "letters are watched");
        Ok(tapped)
    }
}

/// A watcher is told for as long as this exists.
pub(crate) struct Tapped {
    taps: Arc<Taps>,
    watcher: SocketId,
    line: Arc<Line>,
    service: Mts,
}

impl Tapped {
    async fn serve(self) {
        self.line.serve().await;
    }

    fn change(&self, change: impl FnOnce(&mut Vec<Arc<Line>>)) {
        let _changing = self.taps.changing.lock();
        let watched = {
            let mut lines = self.taps.lines.lock();
            change(&mut lines);
            !lines.is_empty()
        };
        self.service.watch(watched);
    }
}

impl Drop for Tapped {
    fn drop(&mut self) {
        let ours = Arc::clone(&self.line);
        self.change(|lines| lines.retain(|line| !Arc::ptr_eq(line, &ours)));
    }
}
