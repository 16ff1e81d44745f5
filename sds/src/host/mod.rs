//! The directory of one host, without a broker: files in a private directory of the domain.
//!
//! * Each process holds an advisory lock on a file of its own for as long as it lives, and writes
//!   what it has registered into another, which it replaces as a whole.
//! * Names are given out under one more lock, which is held for as long as it takes to see that
//!   nobody who lives has the name, and to write. The name of a process that has died is free at
//!   once.
//! * Everybody watches the directory. A process that ends, even by SIGKILL, closes its lock file,
//!   and the kernel tells all others, who then forget its agents and remove its files.
//! * Reading takes no system call. Only for a name that is not known the generation is read (one
//!   call), and the files when it has changed.
//!
//! What must not live here: anything about the network. A gateway publishes here what it has
//! learnt elsewhere.

mod file;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod place;
mod shared;
mod socket;
mod watcher;

use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use fipa_transport::{Forked, Incarnation, OwnerProcess};
use parking_lot::Mutex;
use tokio::sync::watch;

use self::place::{Id, Place};
use self::shared::Shared;
use self::watcher::Watcher;
use crate::{
    DeregisterError, Directory, Entry, EntryError, Mts, Reach, RegisterError, Registration, Source,
    Subscriber,
};

/// Where the directory of a host is, and who joins it.
#[derive(Debug, Clone)]
pub struct HostConfig {
    /// The private directory of the domain: created with mode 0700 when it does not exist, and
    /// refused when it belongs to somebody else, others may enter it, or it is a symbolic link.
    pub dir: PathBuf,
    /// The message transport service of this process.
    pub mts: Mts,
    /// Whether this process may publish agents of other hosts.
    pub gateway: bool,
}

/// The agents of all processes of one domain on one host.
///
/// Leaves the directory when dropped.
#[derive(Debug)]
pub struct HostDirectory {
    shared: Arc<Shared>,
    config: HostConfig,
    owner: OwnerProcess,
    runtime: tokio::runtime::Handle,
    task: Mutex<tokio::task::JoinHandle<()>>,
}

impl HostDirectory {
    /// Joins the directory. A task of the current tokio runtime keeps the view up to date.
    ///
    /// # Errors
    /// When there is no runtime, or the directory is not private or cannot be used.
    pub fn open(config: HostConfig) -> Result<Self, HostError> {
        let runtime = tokio::runtime::Handle::try_current().map_err(|_| HostError::NoRuntime)?;
        // Not the service's incarnation: a process may open the directory more than once.
        let id = Id(Incarnation::random().as_u64());
        let place = Place::join(&config.dir, id)?;
        let shared = Arc::new(Shared::new(place, config.mts.clone()));
        // Watching before reading, so that nothing is missed in between.
        let watcher = Watcher::new(&shared.place());
        if let Err(error) = shared.refresh().and_then(|()| shared.find_sockets()) {
            // The first error is the one to be told.
            let _ = shared.close();
            return Err(error);
        }
        let task = runtime.spawn(watcher.run(Arc::clone(&shared), None));
        Ok(Self {
            shared,
            config,
            owner: OwnerProcess::this(),
            runtime,
            task: Mutex::new(task),
        })
    }

    /// Replaces the agents of other hosts that this gateway publishes to the processes of this
    /// one, who see them as [`Reach::Remote`] through this gateway; their locations are those at
    /// which the gateway takes letters for them. They are not in this directory's own view.
    ///
    /// # Errors
    /// When this is no gateway, an entry is not valid, there are too many, or they cannot be
    /// written. Nothing has changed then.
    pub fn publish_remote(&self, entries: Vec<Entry>) -> Result<(), HostError> {
        self.owner.check()?;
        if !self.config.gateway {
            return Err(HostError::NoGateway);
        }
        let mut published = std::collections::BTreeMap::new();
        for mut entry in entries {
            entry.reach = Reach::Remote {
                gateway: self.config.mts.incarnation,
            };
            let checked = entry.check();
            checked.map_err(|error| HostError::Entry {
                name: entry.name.clone(),
                error,
            })?;
            published.insert(entry.name.clone(), Arc::new(entry));
        }
        self.shared.publish(published.into_values().collect())
    }

    /// Registers or changes all of these and removes those, by name and incarnation, or does
    /// nothing at all. Those who watch see coalitions among them change in one go
    /// ([`Change::Together`](crate::Change::Together)).
    ///
    /// # Errors
    /// When somebody else has one of the names, a registration is not valid, one to be removed was
    /// not made here, or the directory cannot be written.
    pub fn replace(
        &self,
        registrations: Vec<Registration>,
        leaving: &[(&str, Incarnation)],
    ) -> Result<(), RegisterError> {
        self.owner.check()?;
        let entries = registrations.into_iter();
        let entries = entries.map(|one| one.into_entry(&self.config.mts, Source::Host));
        self.shared
            .replace(entries.collect::<Result<_, _>>()?, leaving)
    }

    /// Tells from now on when processes of this host have ended, in order or not.
    #[must_use]
    pub fn departures(&self) -> Departures {
        Departures(self.shared.departures())
    }

    /// A socket at which other processes of the domain can connect to this one: listening,
    /// non-blocking, of the type SOCK_SEQPACKET. They see it in [`sockets`](Self::sockets) for as
    /// long as this process lives. What is said there is not the directory's business.
    ///
    /// # Errors
    /// When the directory was closed, or the system refuses the socket.
    pub fn listen(&self) -> Result<OwnedFd, HostError> {
        self.owner.check()?;
        self.shared.place().lock()?.listen()
    }

    /// The other processes that can be connected to, as they come and go.
    #[must_use]
    pub fn sockets(&self) -> watch::Receiver<Vec<SocketId>> {
        self.shared.sockets()
    }

    /// Connects to another process of the domain and of this user; never waits.
    ///
    /// # Errors
    /// When it has ended, has too many connections that it has not accepted yet
    /// ([`io::ErrorKind::WouldBlock`]), or is not a socket of this user.
    pub fn connect(&self, socket: SocketId) -> Result<OwnedFd, HostError> {
        self.shared.place().connect(socket.0)
    }

    /// Waits until the directory may have been removed by another program, which
    /// [`rejoin`](Self::rejoin) finds out. Not every removal is reported: ask
    /// [`is_there`](Self::is_there) from time to time, too.
    pub async fn disturbed(&self) {
        self.shared.disturbed().await;
    }

    /// Whether other processes can find what this one has registered. False when another program
    /// has removed the directory, or files in it.
    ///
    /// # Errors
    /// When the directory cannot be examined.
    pub fn is_there(&self) -> Result<bool, HostError> {
        self.shared.is_there()
    }

    /// Joins the directory again if it was removed, with everything that is registered, and says
    /// whether that was necessary. A name that another process registered meanwhile is lost.
    /// Blocks for as long as others hold the lock of the directory. Sockets have to be made again
    /// with [`listen`](Self::listen).
    ///
    /// # Errors
    /// When the directory cannot be made or written; to be tried again.
    pub fn rejoin(&self) -> Result<bool, HostError> {
        self.owner.check()?;
        let mut task = self.task.lock();
        if !self.shared.rejoin()? {
            return Ok(false);
        }
        task.abort();
        let _context = self.runtime.enter();
        let watcher = Watcher::new(&self.shared.place());
        // What others wrote before the watcher was there.
        let read = self
            .shared
            .refresh()
            .and_then(|()| self.shared.find_sockets());
        let settled = tokio::time::Instant::now() + SETTLING;
        let run = watcher.run(Arc::clone(&self.shared), Some(settled));
        *task = self.runtime.spawn(run);
        read.map(|()| true)
    }

    /// Leaves the directory, with everything that was registered. The last process leaves it
    /// empty. Dropping does the same and can only log what goes wrong.
    ///
    /// # Errors
    /// When files cannot be removed.
    pub fn close(&self) -> Result<(), HostError> {
        self.owner.check()?;
        self.task.lock().abort();
        self.shared.close()
    }
}

/// Time that other processes have to join again after the directory was removed.
const SETTLING: Duration = Duration::from_secs(15);

/// The ends of processes of this host.
#[derive(Debug)]
pub struct Departures(watch::Receiver<u64>);

impl Departures {
    /// Waits until some process has ended since the last time. False when the directory itself
    /// has been left, and nothing more will be told.
    pub async fn next(&mut self) -> bool {
        self.0.changed().await.is_ok()
    }
}

impl Drop for HostDirectory {
    fn drop(&mut self) {
        // In a forked child everything stays the parent's.
        if !self.owner.is_this() {
            return;
        }
        if let Err(error) = self.close() {
            tracing::error!(%error, "the host's directory was not left in order");
        }
    }
}

impl Directory for HostDirectory {
    reads_its_table!(shared.table);

    fn refresh(&self) {
        if let Err(error) = self.shared.refresh() {
            tracing::error!(%error, "the view of the host's directory may be out of date");
        }
    }

    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        self.owner.check()?;
        let entry = registration.into_entry(&self.config.mts, Source::Host)?;
        self.shared.register(entry)
    }

    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        self.owner.check()?;
        let ours = |entry: &Entry| entry.incarnation == incarnation;
        self.shared.deregister(name, ours)
    }
}

/// A process that can be connected to; see [`HostDirectory::sockets`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SocketId(Id);

/// What goes wrong with the directory of a host.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HostError {
    /// Somebody else could read or change it.
    #[error("refusing to use {}: {why}; remove it, or configure another directory", path.display())]
    NotPrivate {
        /// What is refused.
        path: PathBuf,
        /// Why.
        why: String,
    },
    /// The lock of the domain was not to be had.
    #[error(
        "the lock {} was not to be had: another process holds it and does not let go (is one \
         stopped, state T in ps?), or too many change the directory all the time",
        path.display()
    )]
    Busy {
        /// The file that is locked.
        path: PathBuf,
    },
    /// Somebody has removed the files of living processes.
    #[error(
        "the files in {} were removed by another program; this process joins the directory again \
         within seconds: retry, and exempt the directory from cleaning",
        path.display()
    )]
    Removed {
        /// The directory.
        path: PathBuf,
    },
    /// There are more files than processes can make.
    #[error("too many files in {}; remove those that are no longer used", path.display())]
    TooManyFiles {
        /// The directory.
        path: PathBuf,
    },
    /// A file is larger than allowed.
    #[error("{} is too large to be an entries file", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
    },
    /// The system refused something.
    #[error("cannot {what} {}: {source}", path.display())]
    Io {
        /// What was tried.
        what: &'static str,
        /// On which file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The events of the directory cannot be read.
    #[error("cannot read inotify events of {}: {source}", path.display())]
    Watch {
        /// The directory.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// An entry to be published is not valid.
    #[error("cannot publish {name:?}: {error}")]
    Entry {
        /// Its name.
        name: Arc<str>,
        /// What is wrong.
        error: EntryError,
    },
    /// There is too much to be published.
    #[error("the directory is full: {0}")]
    Full(String),
    /// Only a gateway publishes agents of other hosts.
    #[error("this process is no gateway and cannot publish agents of other hosts")]
    NoGateway,
    /// The directory has been closed.
    #[error("the directory has been closed")]
    Closed,
    /// This process is a forked child of the one that opened the directory.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// A task is needed, and there is nobody to run it.
    #[error("the host's directory must be opened within a tokio runtime")]
    NoRuntime,
}
