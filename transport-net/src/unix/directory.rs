//! The socket files of a domain, in a directory that only its users may enter.
//!
//! Every process has one socket, named after its incarnation. Files are used relative to the
//! directory's descriptor, so that what was checked is what is used; `bind` and `connect` take them
//! by their names below `/proc/self/fd`, because the path of the directory may be longer than the
//! 108 bytes of a socket's address (unix(7)). Abstract addresses are not used: they have no
//! permissions.

use std::io;
use std::os::fd::{AsRawFd as _, OwnedFd};
use std::os::unix::net::{UnixListener, UnixStream as StdStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use fipa_transport::{DirectoryError, DomainUsers, Incarnation};
use rustix::fs::{AtFlags, Dir, FileType, FlockOperation, Mode, OFlags, Stat};
use rustix::io::Errno;
use rustix::net::{
    AddressFamily, SocketAddrUnix, SocketFlags, SocketType, bind, connect, listen, socket_with,
};
use tokio::net::UnixStream;
use tokio::time::sleep;

use crate::stream::source::Source;

/// Maximum number of connections that wait to be accepted.
const BACKLOG: i32 = 1024;

/// Time before a socket whose backlog is full is tried again.
const RETRY_AFTER: Duration = Duration::from_millis(2);

/// Time to wait for the lock of the directory, which is held for some milliseconds at most.
const LOCKING: Duration = Duration::from_secs(1);

/// The reason for which the sockets of a domain cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum UnixError {
    /// An operation of the operating system failed.
    #[error("cannot {what} {}", path.display())]
    Io {
        /// The operation, as a verb.
        what: &'static str,
        /// The directory of the sockets.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The directory cannot be used.
    #[error(transparent)]
    Directory(#[from] DirectoryError),
}

/// The identity of a file, independent of its name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FileId {
    device: u64,
    inode: u64,
}

impl FileId {
    fn of(stat: &Stat) -> Self {
        Self {
            device: stat.st_dev,
            inode: stat.st_ino,
        }
    }
}

/// The directory of a domain's sockets.
#[derive(Debug)]
pub(super) struct Directory {
    path: PathBuf,
    dir: OwnedFd,
    users: DomainUsers,
}

/// The lock of the directory. Dropping it unlocks the directory.
struct Locked(#[expect(dead_code, reason = "closing it unlocks")] OwnedFd);

impl Directory {
    /// Opens the directory, and creates it if it is missing.
    pub(super) fn open(path: &Path, users: DomainUsers) -> Result<Self, UnixError> {
        Ok(Self {
            dir: users.create_directory(path)?,
            path: path.to_owned(),
            users,
        })
    }

    /// Returns the error of an operation on this directory.
    pub(super) fn failed(&self, what: &'static str, source: io::Error) -> UnixError {
        UnixError::Io {
            what,
            path: self.path.clone(),
            source,
        }
    }

    /// Creates a listening, non-blocking socket with this name, to which only the users of the domain may connect.
    pub(super) fn bind(&self, name: &str) -> Result<(UnixListener, FileId), UnixError> {
        let make = || {
            // The file is there a moment before the kernel finds the socket by it; a sweep must not
            // come in between. Without the lock, because a sweeping process was stopped, the file
            // may at worst be removed, and is then created again.
            let _lock = self.lock(FlockOperation::NonBlockingLockShared, LOCKING);
            self.remove_file(name)?;
            let socket = new_socket(SocketType::STREAM)?;
            let path = format!("/proc/self/fd/{}/{name}", self.dir.as_raw_fd());
            bind(&socket, &SocketAddrUnix::new(path)?)?;
            let stat = rustix::fs::statat(&self.dir, name, AtFlags::SYMLINK_NOFOLLOW)?;
            self.users.share_socket(&self.dir, name)?;
            listen(&socket, BACKLOG)?;
            Ok((socket.into(), FileId::of(&stat)))
        };
        make().map_err(|error: io::Error| self.failed("create a socket in", error))
    }

    /// Connects to the socket with this name. Returns the connection and the process at its other end.
    pub(super) async fn connect(&self, name: &str) -> io::Result<(UnixStream, Source)> {
        if name.parse::<Incarnation>().is_err() {
            let what = "not the address of a Unix domain socket (16 hexadecimal digits expected)";
            return Err(io::Error::new(io::ErrorKind::InvalidInput, what));
        }
        // The descriptor guarantees that the examined file is the one connected to below, even if
        // the name is reassigned.
        let flags = OFlags::PATH | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let file = rustix::fs::openat(&self.dir, name, flags, Mode::empty())?;
        let stat = rustix::fs::fstat(&file)?;
        if FileType::from_raw_mode(stat.st_mode) != FileType::Socket || !self.users.own(&stat) {
            let what = "the file is not a socket of the users of this domain";
            return Err(io::Error::new(io::ErrorKind::PermissionDenied, what));
        }
        let address = SocketAddrUnix::new(format!("/proc/self/fd/{}", file.as_raw_fd()))?;
        let socket = new_socket(SocketType::STREAM)?;
        loop {
            match connect(&socket, &address) {
                Ok(()) => break,
                // The backlog is full.
                Err(Errno::AGAIN) => sleep(RETRY_AFTER).await,
                Err(Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
        }
        let stream = UnixStream::from_std(StdStream::from(socket))?;
        let from = peer(&stream, self.users)?;
        Ok((stream, from))
    }

    /// Removes the sockets of dead processes, unless another process sweeps or creates its own
    /// socket.
    pub(super) fn sweep(&self) {
        let exclusive = FlockOperation::NonBlockingLockExclusive;
        let Some(_lock) = self.lock(exclusive, Duration::ZERO) else {
            return;
        };
        let entries = Dir::read_from(&self.dir).into_iter().flatten().flatten();
        for entry in entries {
            let Ok(name) = entry.file_name().to_str() else {
                continue;
            };
            if name.parse::<Incarnation>().is_ok() && self.is_dead(name) {
                let removed = self.remove_file(name);
                tracing::debug!(name, ?removed, "removing the socket of a dead process");
            }
        }
    }

    /// Whether no process has the socket with this name open. Connecting with another type of
    /// socket tests this without reaching the process: the kernel compares the types when it has
    /// found the socket, and refuses the connection when there is none.
    fn is_dead(&self, name: &str) -> bool {
        let probe = || {
            let path = format!("/proc/self/fd/{}/{name}", self.dir.as_raw_fd());
            let probe = new_socket(SocketType::DGRAM)?;
            connect(&probe, &SocketAddrUnix::new(path)?)
        };
        probe() == Err(Errno::CONNREFUSED)
    }

    /// Whether the path still denotes this directory, and the directory has this socket. Entries
    /// that cannot be examined count as present.
    pub(super) fn is_there(&self, name: &str, file: FileId) -> bool {
        let is = |found: rustix::io::Result<Stat>, id: Option<FileId>| match found {
            Ok(found) => id.is_none_or(|id| FileId::of(&found) == id),
            Err(error) => !matches!(error, Errno::NOENT | Errno::NOTDIR),
        };
        let own = rustix::fs::fstat(&self.dir).ok().map(|it| FileId::of(&it));
        let socket = rustix::fs::statat(&self.dir, name, AtFlags::SYMLINK_NOFOLLOW);
        is(rustix::fs::lstat(&self.path), own) && is(socket, Some(file))
    }

    /// Removes the socket with this name, if it is this file.
    pub(super) fn remove(&self, name: &str, file: FileId) {
        let found = rustix::fs::statat(&self.dir, name, AtFlags::SYMLINK_NOFOLLOW);
        if found.is_ok_and(|found| FileId::of(&found) == file)
            && let Err(error) = self.remove_file(name)
        {
            tracing::debug!(name, %error, "cannot remove the socket of this process");
        }
    }

    fn remove_file(&self, name: &str) -> rustix::io::Result<()> {
        match rustix::fs::unlinkat(&self.dir, name, AtFlags::empty()) {
            Err(Errno::NOENT) => Ok(()),
            removed => removed,
        }
    }

    /// Locks the directory. Returns `None` when that is not possible within `timeout`.
    fn lock(&self, operation: FlockOperation, timeout: Duration) -> Option<Locked> {
        // Opened again: a lock belongs to the open file, which the threads of a process share.
        let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
        let dir = rustix::fs::openat(&self.dir, ".", flags, Mode::empty()).ok()?;
        let began = Instant::now();
        loop {
            match rustix::fs::flock(&dir, operation) {
                Ok(()) => return Some(Locked(dir)),
                Err(Errno::WOULDBLOCK) if began.elapsed() < timeout => {
                    std::thread::sleep(Duration::from_millis(1));
                }
                Err(Errno::INTR) => {}
                Err(_) => return None,
            }
        }
    }
}

/// Returns the process at the other end.
///
/// # Errors
/// When the peer belongs to a user that is not one of these, or the system does not report it.
pub(super) fn peer(stream: &UnixStream, users: DomainUsers) -> io::Result<Source> {
    let peer = stream.peer_cred()?;
    let number = peer.pid().unwrap_or_default();
    let own = rustix::process::geteuid().as_raw();
    let user = peer.uid();
    if !users.admit(user) {
        let what = format!(
            "process {number} belongs to user {user}, but this process belongs to user {own}"
        );
        return Err(io::Error::new(io::ErrorKind::PermissionDenied, what));
    }
    Ok(Source::Process {
        number,
        other_user: (user != own).then_some(user),
    })
}

fn new_socket(kind: SocketType) -> rustix::io::Result<OwnedFd> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    socket_with(AddressFamily::UNIX, kind, flags, None)
}
