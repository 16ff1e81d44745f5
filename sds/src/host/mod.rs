//! The directory of one host, without a broker: files in a private directory of the domain.
//!
//! * Each process holds an advisory lock on a file of its own while it runs, and writes its
//!   registrations to another file, which it always replaces as a whole.
//! * Names are assigned under one more lock, which is held while the process checks that no running
//!   process holds the name, and writes. The name of a process that died is free at once.
//! * All processes watch the directory. When a process ends, even by SIGKILL, its lock file is
//!   closed, and the kernel notifies the others, which drop its agents and remove its files.
//! * A gateway writes the agents of other hosts to a third file. The other processes keep an index of it and
//!   read an entry when it is used, so their memory does not depend on what other hosts announce.
//! * Reading agents of this host takes no system call. Only a miss reads the generation (one call), and the files if it
//!   changed.
//!
//! Nothing about the network belongs here. A gateway publishes the agents of other hosts here.

mod cancellation;
mod counts;
mod file;
#[cfg(feature = "fuzzing")]
pub(crate) mod fuzzing;
mod host_dir;
mod remote;
mod shared;
mod socket;
mod watcher;

use std::fs::File;
use std::io;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::ErrorChain;
use fipa_transport::counts::Totals;
use fipa_transport::{DirectoryError, DomainUsers, Forked, Incarnation, OwnerProcess, log_limit};
use inotify::{WatchMask, Watches};
use parking_lot::Mutex;
use tokio::sync::watch;

pub use self::cancellation::Cancellation;
pub use self::counts::HostCounts;
use self::host_dir::{HostDir, Id, Name};
use self::remote::RemoteAgents;
use self::shared::Shared;
use self::watcher::Watcher;
use crate::{
    DeregisterError, Directory, Entry, MtsId, RegisterError, Registration, Source, Subscriber,
    View as _,
};

/// Configuration of [`HostDirectory`].
#[derive(Debug, Clone)]
pub struct HostConfig {
    /// The directory of the domain. It is created if it does not exist, in a directory that exists. It is refused
    /// if other users may enter it, or if it is a symbolic link.
    pub dir: PathBuf,
    /// The users of the domain.
    pub users: DomainUsers,
    /// The message transport service of this process.
    pub mts: MtsId,
    /// Whether this process may publish agents of other hosts.
    pub gateway: bool,
    /// Whether this process is likely to end within a second. It then polls the directory: the kernel
    /// takes about 20 ms to end the watch of a directory.
    pub brief: bool,
}

/// The agents of all processes of one domain on one host.
///
/// Dropping it leaves the directory.
#[derive(Debug)]
pub struct HostDirectory {
    shared: Arc<Shared>,
    config: HostConfig,
    owner: OwnerProcess,
    runtime: tokio::runtime::Handle,
    task: Mutex<tokio::task::JoinHandle<()>>,
    /// Adds watches of files. `None` if the kernel reports no changes.
    watches: Mutex<Option<Watches>>,
}

impl HostDirectory {
    /// Joins the directory. A task of the current tokio runtime keeps the view up to date.
    ///
    /// # Errors
    /// Fails when no tokio runtime is running, or the directory is not private or cannot be used.
    pub fn open(config: HostConfig) -> Result<Self, HostError> {
        Self::open_unless(config, &Cancellation::new())
    }

    /// Joins the directory like [`open`](Self::open), unless the call is canceled while it waits for
    /// other processes. Nothing is left of a canceled call.
    ///
    /// # Errors
    /// Fails like [`open`](Self::open), and with [`HostError::Canceled`].
    pub fn open_unless(config: HostConfig, cancellation: &Cancellation) -> Result<Self, HostError> {
        let runtime = tokio::runtime::Handle::try_current().map_err(|_| HostError::NoRuntime)?;
        // Not the service's incarnation, because a process may open the directory more than once.
        let id = Id(Incarnation::random().as_u64());
        let host_dir = HostDir::join(&config.dir, config.users, id, cancellation)?;
        let shared = Arc::new(Shared::new(host_dir, config.mts.clone()));
        // Starts to watch before reading, so that no change is missed in between.
        let watcher = match config.brief {
            true => Watcher::polling(),
            false => Watcher::new(&shared.host_dir()),
        };
        if let Err(error) = shared.refresh().and_then(|()| shared.find_sockets()) {
            // The first error is the one to return.
            let _ = shared.close();
            return Err(error);
        }
        let watches = Mutex::new(watcher.watches());
        let task = runtime.spawn(watcher.run(Arc::clone(&shared), None));
        Ok(Self {
            watches,
            shared,
            config,
            owner: OwnerProcess::this(),
            runtime,
            task: Mutex::new(task),
        })
    }

    /// Reads the entries of the running processes of a domain once, without joining its directory:
    /// nothing is created, and no other process is waited for or notified. Files that cannot be read are
    /// skipped. The result is sorted by name and empty if there is no domain.
    ///
    /// # Errors
    /// Fails when the directory is not private, or cannot be read.
    pub fn peek(dir: &Path, users: DomainUsers) -> Result<Vec<Arc<Entry>>, HostError> {
        let Some(host_dir) = HostDir::look(dir, users)? else {
            return Ok(Vec::new());
        };
        let mut found: Vec<Arc<Entry>> = Vec::new();
        for name in host_dir.names()? {
            match name {
                Name::Entries(id)
                    if host_dir.is_running(id).unwrap_or(false)
                        && let Ok(Some(content)) = host_dir.read(name)
                        && let Ok(entries) = file::read(&content.bytes) =>
                {
                    found.extend(entries.into_values());
                }
                Name::Remote(id)
                    if host_dir.is_running(id).unwrap_or(false)
                        && let Ok(Some(file)) = host_dir.open(name)
                        && let Ok(agents) = RemoteAgents::open(file) =>
                {
                    found.extend(agents.all().iter().cloned());
                }
                _ => {}
            }
        }
        found.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(found)
    }

    /// Replaces the agents of other hosts that this gateway publishes to the processes of this
    /// host, in which they appear as [`Reach::Remote`](crate::Reach::Remote) through this gateway. Their locations are
    /// those at which the gateway accepts letters for them. This directory's own view does not
    /// contain them. Processes of this host see `lost` as their [lost
    /// agents](crate::View::lost_agents).
    ///
    /// Of several entries with one name or one incarnation, the last one holds that. Entries that are not valid
    /// are left out. So are those for which there is no room, from the gateways that have most.
    ///
    /// Returns the number of bytes that this takes. The processes of this host read them again after each change.
    ///
    /// # Errors
    /// Fails when this process is not a gateway, or the entries cannot be written; nothing has changed
    /// then.
    pub fn publish_remote(
        &self,
        entries: &[Arc<Entry>],
        lost: &[Arc<Entry>],
    ) -> Result<usize, HostError> {
        self.owner.check()?;
        if !self.config.gateway {
            return Err(HostError::NoGateway);
        }
        self.shared.publish(entries, lost)
    }

    /// Registers an agent like [`Directory::register`], unless the call is canceled before the
    /// registration is written. The name is then not visible to any process.
    ///
    /// # Errors
    /// Fails like [`Directory::register`], and with [`HostError::Canceled`] as the source.
    pub fn register_unless(
        &self,
        registration: Registration,
        cancellation: &Cancellation,
    ) -> Result<Arc<Entry>, RegisterError> {
        self.owner.check()?;
        let entry = registration.into_entry(&self.config.mts, Source::Host)?;
        self.shared.register(entry, cancellation)
    }

    /// Registers or updates all `registrations` and removes those in `leaving`, by name and
    /// incarnation, or changes nothing. Watchers see coalitions among them change at once
    /// ([`Change::Together`](crate::Change::Together)).
    ///
    /// # Errors
    /// Fails when another agent has one of the names, a registration is not valid, one in `leaving`
    /// was not made here, or the directory cannot be written.
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

    /// Returns the users of the domain.
    #[must_use]
    pub fn users(&self) -> DomainUsers {
        self.config.users
    }

    /// Returns the user whose process on this host has registered an agent of this name, as the owner of its file
    /// proves. `None` if there is none.
    #[must_use]
    pub fn user_of(&self, name: &str) -> Option<u32> {
        self.shared.user_of(name)
    }

    /// Returns notifications of processes of this host that end, gracefully or not.
    #[must_use]
    pub fn departures(&self) -> Departures {
        Departures(self.shared.departures())
    }

    /// Creates the file in which this process counts, with these values: [`Counts`](fipa_transport::counts::Counts), in memory that is a shared mapping
    /// of it. Call it again after [`rejoin`](Self::rejoin).
    ///
    /// # Errors
    /// Fails when the directory was closed, or the file cannot be written.
    pub fn create_counts(&self, values: &Totals) -> Result<File, HostError> {
        self.owner.check()?;
        self.shared.host_dir().lock()?.create_counts(values)
    }

    /// Returns the sums of the counters of the processes of the domain on this host. Takes system calls, but wakes no
    /// process.
    ///
    /// # Errors
    /// Fails when the files cannot be read.
    pub fn sum_counts(&self) -> Result<HostCounts, HostError> {
        self.shared.host_dir().sum_counts()
    }

    /// Opens a socket at which other processes of the domain can connect to this one: listening,
    /// non-blocking, of type SOCK_SEQPACKET. It is listed in their [`sockets`](Self::sockets) while
    /// this process runs. The protocol on it is up to the caller.
    ///
    /// # Errors
    /// Fails when the directory was closed, or the system refuses the socket.
    pub fn listen(&self) -> Result<OwnedFd, HostError> {
        self.owner.check()?;
        self.shared.host_dir().lock()?.listen()
    }

    /// Returns the list of other processes that accept connections, and its changes.
    #[must_use]
    pub fn sockets(&self) -> watch::Receiver<Vec<SocketId>> {
        self.shared.sockets()
    }

    /// Connects to another process of the domain without blocking.
    ///
    /// # Errors
    /// Fails when that process has ended, when too many of its connections are not accepted yet
    /// ([`io::ErrorKind::WouldBlock`]), or when the socket is not of a user of the domain.
    pub fn connect(&self, socket: SocketId) -> Result<OwnedFd, HostError> {
        self.shared.host_dir().connect(socket.0)
    }

    /// Waits until another program may have removed the directory, a file of this process in it, or
    /// a [watched](Self::watch_files) file. [`is_there`](Self::is_there) checks the directory. A
    /// removal of a level above is not always reported.
    pub async fn disturbed(&self) {
        self.shared.disturbed().await;
    }

    /// Makes [`disturbed`](Self::disturbed) also report when one of these files is removed or moved,
    /// or a file directly in one of these directories. [`rejoin`](Self::rejoin) may end that.
    ///
    /// The watches are part of the directory's inotify instance, of which a user has few.
    ///
    /// # Errors
    /// Fails when the system reports no changes, or a file does not exist.
    pub fn watch_files(&self, files: &[PathBuf]) -> io::Result<()> {
        let watches = self.watches.lock().clone();
        let mut watches = watches.ok_or(io::ErrorKind::Unsupported)?;
        // The removal of a name changes the attributes of a file that is still open.
        let mask = WatchMask::ATTRIB
            | WatchMask::DELETE_SELF
            | WatchMask::MOVE_SELF
            | WatchMask::DELETE
            | WatchMask::MOVED_FROM
            | WatchMask::DONT_FOLLOW;
        for file in files {
            watches.add(file, mask)?;
        }
        Ok(())
    }

    /// Whether other processes can find the registrations of this one. False when another program
    /// removed the directory, or files in it.
    ///
    /// # Errors
    /// Fails when the directory cannot be examined.
    pub fn is_there(&self) -> Result<bool, HostError> {
        self.shared.is_there()
    }

    /// Joins the directory again if it was removed, with all registrations; returns whether that
    /// was necessary. A name that another process registered in the meantime is lost. Blocks while
    /// other processes hold the lock of the directory. The caller must create its socket again with
    /// [`listen`](Self::listen).
    ///
    /// # Errors
    /// Fails when the directory cannot be created or written; the caller may retry.
    pub fn rejoin(&self) -> Result<bool, HostError> {
        self.owner.check()?;
        let mut task = self.task.lock();
        if !self.shared.rejoin()? {
            return Ok(false);
        }
        task.abort();
        let _context = self.runtime.enter();
        // A process that has to join again is not as brief as it was expected to be.
        let watcher = Watcher::new(&self.shared.host_dir());
        // Reads the changes that other processes made before the watcher started.
        let read = self
            .shared
            .refresh()
            .and_then(|()| self.shared.find_sockets());
        *self.watches.lock() = watcher.watches();
        let settled = tokio::time::Instant::now() + SETTLING;
        let run = watcher.run(Arc::clone(&self.shared), Some(settled));
        *task = self.runtime.spawn(run);
        read.map(|()| true)
    }

    /// Leaves the directory with all registrations. The last process leaves it empty. Dropping does
    /// the same, but can only log an error.
    ///
    /// # Errors
    /// Fails when files cannot be removed.
    pub fn close(&self) -> Result<(), HostError> {
        self.owner.check()?;
        self.task.lock().abort();
        self.shared.close()
    }
}

/// Time that other processes have to join again after the directory was removed.
const SETTLING: Duration = Duration::from_secs(15);

/// Notifications of processes of this host that ended.
#[derive(Debug)]
pub struct Departures(watch::Receiver<u64>);

impl Departures {
    /// Waits until a process has ended since the last call. Returns false when this directory was
    /// closed.
    pub async fn next(&mut self) -> bool {
        self.0.changed().await.is_ok()
    }
}

impl Drop for HostDirectory {
    fn drop(&mut self) {
        // In a forked child, everything remains the parent's.
        if !self.owner.is_this() {
            return;
        }
        if let Err(error) = self.close() {
            log_limit::error!(error = %ErrorChain(&error), "cannot remove this process's files from the host's directory");
        }
    }
}

impl Directory for HostDirectory {
    reads_its_table!(viewed shared.table);

    fn refresh(&self) {
        if let Err(error) = self.shared.refresh() {
            log_limit::error!(error = %ErrorChain(&error), "the view of the host's directory may be out of date");
        }
    }

    fn register(&self, registration: Registration) -> Result<Arc<Entry>, RegisterError> {
        self.register_unless(registration, &Cancellation::new())
    }

    fn deregister(&self, name: &str, incarnation: Incarnation) -> Result<(), DeregisterError> {
        self.owner.check()?;
        let ours = |entry: &Entry| entry.incarnation == incarnation;
        self.shared.deregister(name, ours)
    }
}

/// A process that accepts connections; see [`HostDirectory::sockets`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct SocketId(Id);

/// Error of the directory of a host.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum HostError {
    /// The directory cannot be used.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
    /// Another user could read or change the path.
    #[error("refusing to use {}: {why}; remove it, or configure another directory", path.display())]
    NotPrivate {
        /// The refused path.
        path: PathBuf,
        /// The reason.
        why: String,
    },
    /// The lock of the domain was not available in time.
    #[error(
        "timed out waiting for the lock {}: another process holds it (stopped, state T in ps?), \
         or too many processes change the directory; retry, or end the stopped process",
        path.display()
    )]
    Busy {
        /// The lock file.
        path: PathBuf,
    },
    /// The call was canceled before it changed anything.
    #[error("canceled while waiting for other processes of the domain")]
    Canceled,
    /// Another program removed files of running processes.
    #[error(
        "the files in {} were removed by another program; this process joins the directory again \
         within seconds; retry, and exclude the directory from cleanup of temporary files",
        path.display()
    )]
    Removed {
        /// The directory.
        path: PathBuf,
    },
    /// The directory has more files than any number of processes creates.
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
    /// A system call failed.
    #[error("cannot {what} {}", path.display())]
    Io {
        /// The operation, as a verb.
        what: &'static str,
        /// The path of the operation.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The events of the directory cannot be read.
    #[error("cannot read inotify events of {}", path.display())]
    Watch {
        /// The directory.
        path: PathBuf,
        /// Error of the system.
        source: io::Error,
    },
    /// The entries of this process exceed a limit.
    #[error("the directory is full: {0}")]
    Full(String),
    /// Only a gateway publishes agents of other hosts.
    #[error("this process is not a gateway; only a gateway can publish agents of other hosts")]
    NoGateway,
    /// The directory has been closed.
    #[error("the directory has been closed")]
    Closed,
    /// This process is a forked child of the one that opened the directory.
    #[error(transparent)]
    Forked(#[from] Forked),
    /// No tokio runtime is running.
    #[error("no tokio runtime is running; open the host's directory within one")]
    NoRuntime,
}
