//! The process's side: finds the watchers of the domain and sends records to them.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_mts::core::Notice;
use fipa_mts::watch::record;
use fipa_mts::{Mts, Tap};
use fipa_sds::{HostDirectory, HostError, SocketId};
use fipa_transport::log_limit;
use parking_lot::Mutex;
use rustix::net::sockopt::set_socket_send_buffer_size;
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use super::connection::Connection;
use super::reloading::{ReloadRequest, ReloadRequests};
use super::socket;

/// Maximum number of watchers that get records.
const MAX_WATCHERS: usize = 16;
/// Maximum number of attempts to connect to a watcher that does not accept.
const TRIES: usize = 50;
/// Time between two attempts to connect to a watcher.
const PAUSE: Duration = Duration::from_millis(20);
/// Requested size of the socket's send buffer, in bytes.
const SEND_BUFFER: usize = 1 << 20;

/// The watchers of this process.
pub(crate) struct Watchers {
    mts: fipa_sds::MtsId,
    gateway: bool,
    connections: Mutex<Vec<Arc<Connection>>>,
    /// Serializes changes of `connections`, so that the service is watched exactly while there is a
    /// connection. A separate lock, because `connections` is locked while the service is locked.
    changing: Mutex<()>,
    /// Receives the requests to read the configuration again.
    reloads: Mutex<Option<mpsc::Sender<ReloadRequest>>>,
}

impl Tap for Watchers {
    fn notice(&self, notice: &Notice) {
        let at = SystemTime::now();
        for connection in &*self.connections.lock() {
            connection.send(record::of(notice, connection.wish(), at));
        }
    }
}

impl Watchers {
    pub(crate) fn new(mts: &fipa_sds::MtsId, gateway: bool) -> Self {
        Self {
            mts: mts.clone(),
            gateway,
            connections: Mutex::default(),
            changing: Mutex::default(),
            reloads: Mutex::default(),
        }
    }

    /// Returns the requests to read the configuration again, from now on.
    pub(crate) fn reload_requests(&self) -> ReloadRequests {
        let (sender, requests) = ReloadRequests::new();
        *self.reloads.lock() = Some(sender);
        requests
    }

    /// Connects to the running watchers, so that they get a record of the first letter: a process may
    /// send only one. Does not wait. Must be called within a tokio runtime.
    pub(crate) fn connect_all(
        self: &Arc<Self>,
        host: &HostDirectory,
        service: &Mts,
    ) -> Vec<Connected> {
        let there = host.sockets().borrow().clone();
        let initial = there.into_iter().take(MAX_WATCHERS).filter_map(|watcher| {
            // `run` retries watchers that cannot be reached now.
            self.connect(host, watcher, service).ok()
        });
        initial.collect()
    }

    /// Connects to new watchers as long as the process takes part in the domain.
    pub(crate) async fn run(
        self: Arc<Self>,
        host: Arc<HostDirectory>,
        service: Mts,
        initial: Vec<Connected>,
    ) {
        let mut sockets = host.sockets();
        let mut known: BTreeSet<SocketId> =
            initial.iter().map(|connected| connected.watcher).collect();
        let mut tasks = JoinSet::new();
        for connected in initial {
            tasks.spawn(connected.serve());
        }
        loop {
            let there: BTreeSet<SocketId> = sockets.borrow_and_update().iter().copied().collect();
            for new in there.difference(&known) {
                if tasks.len() < MAX_WATCHERS {
                    let (watchers, host) = (Arc::clone(&self), Arc::clone(&host));
                    tasks.spawn(watchers.serve(host, service.clone(), *new));
                } else {
                    log_limit::warn!(
                        "ignoring a watcher: {MAX_WATCHERS} watchers, the maximum, are connected already"
                    );
                }
            }
            known = there;
            if sockets.changed().await.is_err() {
                return;
            }
            while tasks.try_join_next().is_some() {}
        }
    }

    async fn serve(self: Arc<Self>, host: Arc<HostDirectory>, service: Mts, watcher: SocketId) {
        for _ in 1..TRIES {
            match self.connect(&host, watcher, &service) {
                Ok(connected) => return connected.serve().await,
                Err(HostError::Io { source, .. })
                    if source.kind() == std::io::ErrorKind::WouldBlock => {}
                // The watcher has ended, or belongs to another user.
                Err(error) => return tracing::debug!(%error, "cannot connect to a watcher"),
            }
            tokio::time::sleep(PAUSE).await;
        }
        log_limit::warn!("a watcher did not accept the connection within 1 s; it gets no records");
    }

    fn connect(
        self: &Arc<Self>,
        host: &HostDirectory,
        watcher: SocketId,
        service: &Mts,
    ) -> Result<Connected, HostError> {
        let socket = host.connect(watcher)?;
        // A smaller buffer than requested suffices, too.
        let _ = set_socket_send_buffer_size(&socket, SEND_BUFFER);
        let socket = socket::connected(socket).map_err(|source| HostError::Io {
            what: "wait for",
            path: "a watcher's socket".into(),
            source,
        })?;
        let connection = Arc::new(Connection::new(socket));
        let name = self.mts.shown();
        let hello = record::hello(name, self.mts.incarnation, self.gateway, SystemTime::now());
        connection.send(hello);
        let connected = Connected {
            watchers: Arc::clone(self),
            watcher,
            connection: Arc::clone(&connection),
            service: service.clone(),
        };
        connected.change(|connections| connections.push(connection));
        log_limit::info!(
            mts = name,
            "a watcher connected; it gets records of the letters"
        );
        Ok(connected)
    }
}

/// A connected watcher. Dropping it ends the connection.
pub(crate) struct Connected {
    watchers: Arc<Watchers>,
    watcher: SocketId,
    connection: Arc<Connection>,
    service: Mts,
}

impl Connected {
    async fn serve(self) {
        let reload = || {
            let request = ReloadRequest::new(Arc::clone(&self.connection));
            if let Some(reloads) = &*self.watchers.reloads.lock() {
                // A request that is not taken is dropped, which answers it.
                let _ = reloads.try_send(request);
            }
        };
        self.connection.serve(reload).await;
    }

    fn change(&self, change: impl FnOnce(&mut Vec<Arc<Connection>>)) {
        let _changing = self.watchers.changing.lock();
        let watched = {
            let mut connections = self.watchers.connections.lock();
            change(&mut connections);
            !connections.is_empty()
        };
        self.service.watch(watched);
    }
}

impl Drop for Connected {
    fn drop(&mut self) {
        let ours = Arc::clone(&self.connection);
        self.change(|connections| connections.retain(|connection| !Arc::ptr_eq(connection, &ours)));
    }
}
