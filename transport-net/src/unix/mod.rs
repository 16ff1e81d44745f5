//! Letters over Unix domain sockets, between the processes of one domain on one host.
//!
//! Frames, hello, limits and the states of parcels are those of [`crate::stream`]. This module
//! contains the differences: the socket files, the opening of connections, and the proof of the
//! peer's user by the kernel.
//!
//! * [`directory`]: the socket files of a domain.
//! * [`accept`] and [`dial`] open connections.

mod accept;
mod dial;
mod directory;

use std::os::unix::net::UnixListener as StdListener;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fipa_acl::ErrorChain;
use fipa_transport::{
    Abandoned, Answer, AttemptId, DirectoryError, DomainUsers, Kind, ListenError, Location,
    OwnerProcess, Parcel, Sink, Ticket, Transport, TransportError, log_limit, threads,
};
use parking_lot::Mutex;
use tokio::net::UnixListener;
use tokio::runtime::Handle;
use tokio::time::sleep;

pub use self::directory::UnixError;
use self::directory::{Directory, FileId};
use crate::Identity;
use crate::stream::config::{NetLimits, StreamConfig};
use crate::stream::counters::Counters;
use crate::stream::endpoint::Endpoint;

/// Delay of the sweep after a process has ended, in which the kernel closes its socket and further
/// processes may end.
const TIDY_AFTER: Duration = Duration::from_millis(100);

/// Maximum number of times that the directory is opened again after an ending process has just
/// removed it.
const RETRIES: u32 = 20;

/// Configuration of a [`UnixTransport`].
#[derive(Debug, Clone)]
pub struct UnixConfig {
    /// The directory of the domain's sockets, which only the users of the domain may enter. Created when it is
    /// missing, in a directory that exists. Its path may be longer than the address of a socket.
    pub directory: PathBuf,
    /// The users of the domain.
    pub users: DomainUsers,
    /// Identity of this endpoint. Its socket is named after the incarnation.
    pub identity: Identity,
    /// NetLimits and timeouts.
    pub limits: NetLimits,
}

/// Carries parcels over Unix domain sockets between processes of one domain on one host.
///
/// An address is the incarnation of the service, 16 hexadecimal digits: the name of its socket in
/// the directory of the domain. Both sides check that the peer belongs to a user of the domain
/// (`SO_PEERCRED`). Connections are kept, shared and closed as those of TCP.
///
/// Dropping it closes it and removes the socket. After [`close`](Transport::close) the threads of
/// the runtime conclude the attempts, so the runtime must run a moment longer.
#[derive(Debug)]
pub struct UnixTransport {
    path: PathBuf,
    users: DomainUsers,
    endpoint: Arc<Endpoint>,
    /// The socket, while the endpoint listens.
    bound: Arc<Mutex<Option<Bound>>>,
    closed: AtomicBool,
    /// Whether a sweep for sockets of dead processes is scheduled.
    tidying: Arc<AtomicBool>,
    owner: OwnerProcess,
}

/// A socket in the directory.
#[derive(Debug)]
struct Bound {
    directory: Arc<Directory>,
    file: FileId,
}

impl UnixTransport {
    /// Creates an endpoint that runs its tasks on `runtime`, which must have I/O and time enabled.
    /// No socket is opened before `listen`.
    #[must_use]
    pub fn new(config: UnixConfig, runtime: Handle) -> Self {
        let UnixConfig {
            directory,
            users,
            identity,
            limits,
        } = config;
        let config = StreamConfig::new(identity, limits);
        Self {
            path: directory,
            users,
            endpoint: Endpoint::new(Kind::Unix, config, runtime),
            bound: Arc::default(),
            closed: AtomicBool::new(false),
            tidying: Arc::default(),
            owner: OwnerProcess::this(),
        }
    }

    /// Returns the counters of this endpoint.
    #[must_use]
    pub fn counters(&self) -> Counters {
        self.endpoint.tally().read()
    }

    /// Removes the sockets of dead processes of this domain in the background. Called when
    /// processes of the domain have ended.
    pub fn tidy(&self) {
        if self.tidying.swap(true, Ordering::AcqRel) {
            return;
        }
        let (tidying, bound) = (self.tidying.clone(), self.bound.clone());
        self.endpoint.runtime.spawn(async move {
            sleep(TIDY_AFTER).await;
            tidying.store(false, Ordering::Release);
            let directory = bound.lock().as_ref().map(|it| it.directory.clone());
            if let Some(directory) = directory
                && let Err(error) = threads::spawn(move || directory.sweep())
            {
                log_limit::warn!(%error, "cannot remove the sockets of ended processes now");
            }
        });
    }

    /// Whether other processes find the socket. False when another program has removed it or the
    /// directory. A socket that cannot be examined counts as present, and so does the socket of an
    /// endpoint that does not listen or closes.
    #[must_use]
    pub fn is_there(&self) -> bool {
        let bound = self.bound.lock();
        let is_there = bound
            .as_ref()
            .is_none_or(|bound| bound.directory.is_there(&self.name(), bound.file));
        // Read last: the socket of an endpoint that closes looks like that of a dead process, and another process may
        // remove it. Closing sets the flag before.
        is_there || self.closed.load(Ordering::SeqCst)
    }

    /// The path of the socket; see [`is_there`](Self::is_there). `None` while the endpoint does not
    /// listen.
    #[must_use]
    pub fn socket_path(&self) -> Option<PathBuf> {
        let is_bound = self.bound.lock().is_some();
        is_bound.then(|| self.path.join(self.name()))
    }

    /// Creates the socket again if it was removed. Returns whether that was necessary. Open
    /// connections stay open.
    ///
    /// # Errors
    /// When the directory or the socket cannot be created; the call may be repeated.
    pub fn rejoin(&self) -> Result<bool, UnixError> {
        let is_closed = self.closed.load(Ordering::SeqCst) || !self.owner.is_this();
        if is_closed || self.is_there() {
            return Ok(false);
        }
        let (listener, bound) = self.bind()?;
        let _inside = self.endpoint.runtime.enter();
        let listener = UnixListener::from_std(listener)
            .map_err(|source| bound.directory.failed("use a socket in", source))?;
        *self.bound.lock() = Some(bound);
        self.endpoint.replace_listener(|| {
            let accept = accept::accept(self.endpoint.clone(), listener, self.users);
            self.endpoint.runtime.spawn(accept)
        });
        Ok(true)
    }

    /// Returns the name of this endpoint's socket.
    fn name(&self) -> String {
        self.endpoint.config.identity.incarnation.to_string()
    }

    fn bind(&self) -> Result<(StdListener, Bound), UnixError> {
        let name = self.name();
        let bind = || {
            let directory = Directory::open(&self.path, self.users)?;
            let (listener, file) = directory.bind(&name)?;
            let directory = Arc::new(directory);
            Ok((listener, Bound { directory, file }))
        };
        let mut bound = bind();
        for _ in 0..RETRIES {
            match &bound {
                // The last process has ended meanwhile and removed the directory.
                Err(
                    UnixError::Io { source, .. }
                    | UnixError::Directory(DirectoryError::Io { source, .. }),
                ) if source.kind() == std::io::ErrorKind::NotFound => bound = bind(),
                _ => break,
            }
        }
        bound
    }
}

impl Transport for UnixTransport {
    fn kind(&self) -> Kind {
        Kind::Unix
    }

    fn max_letter(&self) -> usize {
        self.endpoint.limits().max_letter
    }

    fn listen(&self, sink: Arc<dyn Sink>) -> Result<Vec<Location>, ListenError> {
        let runtime = &self.endpoint.runtime;
        let open = || {
            let unavailable =
                |error: UnixError| ListenError::Unavailable(ErrorChain(&error).to_string());
            let (listener, bound) = self.bind().map_err(unavailable)?;
            let listener = UnixListener::from_std(listener).map_err(|source| {
                bound.directory.remove(&self.name(), bound.file);
                unavailable(bound.directory.failed("use a socket in", source))
            })?;
            // Removes the sockets of killed processes.
            bound.directory.sweep();
            *self.bound.lock() = Some(bound);
            Ok((listener, self.name()))
        };
        self.endpoint.listen_at(sink, open, |listener| {
            runtime.spawn(accept::accept(self.endpoint.clone(), listener, self.users))
        })
    }

    fn post(
        &self,
        attempt: AttemptId,
        to: &Location,
        parcel: Parcel,
    ) -> Result<(), TransportError> {
        self.endpoint.check(to, &parcel)?;
        self.endpoint.post(attempt, to, &parcel, |link, sink| {
            let bound = self.bound.lock();
            let directory = bound.as_ref().map(|it| it.directory.clone());
            let dialing = dial::dial(self.endpoint.clone(), directory, link, sink, to.clone());
            self.endpoint.runtime.spawn(dialing)
        })
    }

    fn abandon(&self, attempt: AttemptId, to: &Location) -> Abandoned {
        self.endpoint.abandon(attempt, to)
    }

    fn answer(&self, ticket: Ticket, answer: Answer) {
        self.endpoint.answer(ticket, &answer);
    }

    fn close(&self) {
        self.closed.store(true, Ordering::SeqCst);
        self.endpoint.close();
        if let Some(bound) = self.bound.lock().take() {
            bound.directory.remove(&self.name(), bound.file);
            bound.directory.sweep();
        }
    }
}

impl Drop for UnixTransport {
    fn drop(&mut self) {
        if self.owner.is_this() {
            self.close();
        } else {
            // In a forked child the socket and the connections belong to the parent.
            std::mem::forget(self.endpoint.clone());
        }
    }
}
