//! The private directory of a domain: its files and its lock.
//!
//! All operations are relative to the directory's descriptor and do not follow symbolic links, so
//! that the directory that was checked is the one that is used.

use std::collections::BTreeSet;
use std::fs::{File, TryLockError};
use std::io::{self, Read as _, Write as _};
use std::os::fd::OwnedFd;
use std::os::unix::fs::FileExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use fipa_transport::{DirectoryError, DomainUsers, log_limit};
use parking_lot::{Mutex, MutexGuard};
use rustix::fs::{AtFlags, FileType, FlockOperation, Mode, OFlags, Stat, Timespec, Timestamps};
use rustix::io::Errno;

use super::file::MAX_SIZE;
use super::{Cancellation, HostError};

/// Identifies the files of one process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct Id(pub(super) u64);

/// The files of the directory, by their names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Name {
    /// `lock`: held while the directory is changed. Its first eight bytes are the generation; a ring of the
    /// files that the latest changes replaced follows.
    Domain,
    /// `<id>.lock`: locked by its process while that runs.
    Process(Id),
    /// `<id>.entries`: the registrations of the process.
    Entries(Id),
    /// `<id>.remote`: the agents of other hosts that the process publishes, if it is a gateway.
    Remote(Id),
    /// `<id>.socket`: the socket of the process, if it accepts connections.
    Socket(Id),
    /// `<id>.counts`: the page in which the process counts, see [`fipa_transport::counts`].
    Counts(Id),
    /// `ended.counts`: the sum of the counters of processes that have ended.
    Ended,
    /// `<id>.tmp`: a file that will be renamed to one of the others.
    Temporary(Id),
}

impl Name {
    pub(super) fn parse(name: &str) -> Option<Self> {
        match name {
            "lock" => return Some(Self::Domain),
            "ended.counts" => return Some(Self::Ended),
            _ => {}
        }
        let (id, kind) = name.split_once('.')?;
        if id.len() != 16 || !id.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f')) {
            return None;
        }
        let id = Id(u64::from_str_radix(id, 16).ok()?);
        match kind {
            "lock" => Some(Self::Process(id)),
            "entries" => Some(Self::Entries(id)),
            "remote" => Some(Self::Remote(id)),
            "socket" => Some(Self::Socket(id)),
            "counts" => Some(Self::Counts(id)),
            "tmp" => Some(Self::Temporary(id)),
            _ => None,
        }
    }
}

impl std::fmt::Display for Name {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Domain => f.write_str("lock"),
            Self::Process(Id(id)) => write!(f, "{id:016x}.lock"),
            Self::Entries(Id(id)) => write!(f, "{id:016x}.entries"),
            Self::Remote(Id(id)) => write!(f, "{id:016x}.remote"),
            Self::Socket(Id(id)) => write!(f, "{id:016x}.socket"),
            Self::Counts(Id(id)) => write!(f, "{id:016x}.counts"),
            Self::Ended => f.write_str("ended.counts"),
            Self::Temporary(Id(id)) => write!(f, "{id:016x}.tmp"),
        }
    }
}

/// The directory after this process has joined.
#[derive(Debug)]
pub(super) struct HostDir {
    path: PathBuf,
    dir: OwnedFd,
    users: DomainUsers,
    domain: File,
    /// An advisory lock belongs to the open file, which the threads of this process share; this
    /// mutex excludes them from each other. It holds the start of this process's turn.
    threads: Mutex<Option<Instant>>,
    id: Id,
    /// Never read: the lock on it, open for writing, shows that this process is running.
    process: Mutex<Option<File>>,
    /// Whether the process has a page of counters.
    counts: AtomicBool,
}

/// Timeout for the lock of the domain while nothing changes in the directory. A process holds the
/// lock for milliseconds unless it was stopped or waits for the disk: a file system that frees much
/// space at once, or a worn SD card, can delay a rename for more than ten seconds.
const TIMEOUT: Duration = Duration::from_secs(30);

/// Timeout for the lock while other processes take turns: on a busy robot many processes may start
/// at the same time.
const LONGEST: Duration = Duration::from_secs(60);

/// Time after which waiting processes bypass a process that does not use its turn.
const SKIPPED: Duration = Duration::from_secs(1);

/// Pause of the process that has the turn, between attempts to lock.
const FIRST_PAUSE: Duration = Duration::from_micros(200);

/// Maximum pause of the others, which poll at a decreasing rate: a hundred of them would otherwise use
/// more CPU time than the processes they wait for.
const LAST_PAUSE: Duration = Duration::from_millis(20);

/// Maximum time between two checks of whether a waiting call was canceled.
const LONGEST_CHECK: Duration = Duration::from_millis(20);

/// Duration of a turn, in which a process may lock several times: after another process's turn it
/// must read that one's changes, which takes longer than a registration.
const TURN: Duration = Duration::from_millis(20);

impl HostDir {
    /// Opens the directory, creates it if necessary, checks it, and joins as the process with this
    /// ID.
    pub(super) fn join(
        path: &Path,
        users: DomainUsers,
        id: Id,
        cancellation: &Cancellation,
    ) -> Result<Self, HostError> {
        // With a trailing slash, the kernel would follow a symbolic link.
        let path: PathBuf = path.components().collect();
        let dir = users.create_directory(&path)?;
        let mut host_dir = Self {
            domain: open_domain(&dir, &path, users, id)?,
            path,
            dir,
            users,
            threads: Mutex::default(),
            id,
            process: Mutex::new(None),
            counts: AtomicBool::new(false),
        };
        let deadline = Instant::now() + LONGEST;
        while !host_dir.try_join(cancellation)? {
            // The last process left in between and removed the lock file.
            host_dir.domain = open_domain(&host_dir.dir, &host_dir.path, users, id)?;
            if Instant::now() > deadline {
                return Err(HostError::Busy {
                    path: host_dir.path,
                });
            }
        }
        Ok(host_dir)
    }

    /// Opens an existing directory for reading, without joining it. Returns `None` if there is none.
    pub(super) fn look(path: &Path, users: DomainUsers) -> Result<Option<Self>, HostError> {
        let path: PathBuf = path.components().collect();
        let dir = match users.open_directory(&path) {
            Ok(dir) => dir,
            Err(DirectoryError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                return Ok(None);
            }
            Err(error) => return Err(error.into()),
        };
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let name = Name::Domain;
        let domain = match rustix::fs::openat(&dir, name.to_string(), flags, Mode::empty()) {
            Ok(file) => check_file(file, &path, name, users)?,
            Err(Errno::NOENT) => return Ok(None),
            Err(error) => {
                return Err(HostError::Io {
                    what: "open",
                    path: path.join(name.to_string()),
                    source: error.into(),
                });
            }
        };
        Ok(Some(Self {
            path,
            dir,
            users,
            domain,
            threads: Mutex::default(),
            id: Id(0),
            process: Mutex::new(None),
            counts: AtomicBool::new(false),
        }))
    }

    fn try_join(&self, cancellation: &Cancellation) -> Result<bool, HostError> {
        let guard = self.lock_any(cancellation)?;
        if !guard.is_current()? {
            return Ok(false);
        }
        guard.sweep()?;
        let temporary = Name::Temporary(self.id);
        let file = self.create(temporary, Writers::All)?;
        // Locked before it appears under its name, because an unlocked lock file indicates a dead
        // process.
        file.try_lock().map_err(|error| match error {
            TryLockError::Error(source) => self.io("lock", temporary)(source),
            TryLockError::WouldBlock => HostError::Busy {
                path: self.path.join(temporary.to_string()),
            },
        })?;
        self.rename(temporary, Name::Process(self.id))?;
        *self.process.lock() = Some(file);
        Ok(true)
    }

    pub(super) fn id(&self) -> Id {
        self.id
    }

    pub(super) fn users(&self) -> DomainUsers {
        self.users
    }

    /// Whether other processes can still find the directory and the files of this process.
    pub(super) fn is_there(&self) -> Result<bool, HostError> {
        let examined = |found: Result<Stat, Errno>| match found {
            Ok(stat) => Ok(Some((stat.st_dev, stat.st_ino))),
            Err(Errno::NOENT | Errno::NOTDIR) => Ok(None),
            Err(error) => Err(HostError::Io {
                what: "examine",
                path: self.path.clone(),
                source: error.into(),
            }),
        };
        let named = |name: Name| {
            let flags = AtFlags::SYMLINK_NOFOLLOW;
            examined(rustix::fs::statat(&self.dir, name.to_string(), flags))
        };
        let process = self.process.lock();
        let Some(process) = process.as_ref() else {
            // Closed.
            return Ok(true);
        };
        let dir = examined(rustix::fs::fstat(&self.dir))?;
        Ok(dir == examined(rustix::fs::lstat(&self.path))?
            && examined(rustix::fs::fstat(&self.domain))? == named(Name::Domain)?
            && examined(rustix::fs::fstat(process))? == named(Name::Process(self.id))?
            && (!self.counts.load(Ordering::Relaxed) || named(Name::Counts(self.id))?.is_some()))
    }

    /// Notes that the process has a page of counters from now on.
    pub(super) fn has_counts(&self) {
        self.counts.store(true, Ordering::Relaxed);
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// The directory.
    pub(super) fn dir(&self) -> &OwnedFd {
        &self.dir
    }

    /// A path to the directory that is valid even after a rename.
    pub(super) fn pinned_path(&self) -> PathBuf {
        use std::os::fd::AsRawFd as _;
        PathBuf::from(format!("/proc/self/fd/{}", self.dir.as_raw_fd()))
    }

    /// The number that grows with every change; 0 before the first.
    pub(super) fn generation(&self) -> Result<u64, HostError> {
        let mut number = [0; 8];
        match self.domain.read_exact_at(&mut number, 0) {
            Ok(()) => Ok(u64::from_le_bytes(number)),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Ok(0),
            Err(error) => Err(self.io("read", Name::Domain)(error)),
        }
    }

    /// Returns the files that were replaced between two generations. `None` if they are not known, because there
    /// were too many changes.
    pub(super) fn replaced_between(
        &self,
        known: u64,
        generation: u64,
    ) -> Result<Option<BTreeSet<Name>>, HostError> {
        let behind = generation.wrapping_sub(known);
        if known == 0 || behind > RING as u64 {
            return Ok(None);
        }
        let mut ring = [0; RING * SLOT];
        let mut filled = 0;
        while let Some(rest) = ring.get_mut(filled..).filter(|rest| !rest.is_empty()) {
            match self.domain.read_at(rest, RING_START + filled as u64) {
                Ok(0) => break,
                Ok(read) => filled += read,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => return Err(self.io("read", Name::Domain)(error)),
            }
        }
        // Writers that were faster than this read have replaced some of the slots in question.
        if self.generation()?.wrapping_sub(known) > RING as u64 {
            return Ok(None);
        }
        let (slots, _) = ring.as_chunks();
        let changes = (1..=behind).map(|change| known.wrapping_add(change));
        let names = changes.filter_map(|change| name_in(slots.get(index_of(change))?));
        Ok(Some(names.collect()))
    }

    /// Waits for the lock of the domain.
    pub(super) fn lock(&self) -> Result<Guard<'_>, HostError> {
        self.lock_unless(&Cancellation::new())
    }

    /// Waits for the lock of the domain, unless the call is canceled.
    pub(super) fn lock_unless(&self, cancellation: &Cancellation) -> Result<Guard<'_>, HostError> {
        let guard = self.lock_any(cancellation)?;
        if guard.is_current()? {
            Ok(guard)
        } else {
            Err(HostError::Removed {
                path: self.path.clone(),
            })
        }
    }

    /// Takes the lock of the domain if it is free.
    pub(super) fn try_lock(&self) -> Result<Option<Guard<'_>>, HostError> {
        let Some(threads) = self.threads.try_lock() else {
            return Ok(None);
        };
        Ok(self.try_domain()?.then(|| Guard {
            host_dir: self,
            _threads: threads,
        }))
    }

    /// Waits for the lock of the domain, in turn.
    ///
    /// An advisory lock is not fair: a process that has just unlocked it is the likeliest to lock
    /// it again. A second lock, on the directory itself, therefore grants turns: its holder waits
    /// for the domain's lock, and the other processes compete for the next turn with equal chances.
    fn lock_any(&self, cancellation: &Cancellation) -> Result<Guard<'_>, HostError> {
        let busy = || HostError::Busy {
            path: self.path.join(Name::Domain.to_string()),
        };
        let began = Instant::now();
        let mut threads = loop {
            cancellation.check()?;
            match self.threads.try_lock_for(LONGEST_CHECK) {
                Some(threads) => break threads,
                None if began.elapsed() > LONGEST => return Err(busy()),
                None => {}
            }
        };
        let in_turn = threads.is_some_and(|began| began.elapsed() < TURN);
        if in_turn && self.try_domain()? {
            return Ok(Guard {
                host_dir: self,
                _threads: threads,
            });
        }
        let mut turn = None;
        let mut pause = FIRST_PAUSE;
        let (mut seen, mut moved) = (None, Instant::now());
        loop {
            cancellation.check()?;
            if turn.is_none() {
                turn = self.try_turn()?;
            }
            // The holder of the turn may have been stopped, so bypass it after a while.
            let waited = moved.elapsed();
            if (turn.is_some() || waited > SKIPPED) && self.try_domain()? {
                *threads = Some(Instant::now());
                return Ok(Guard {
                    host_dir: self,
                    _threads: threads,
                });
            }
            let now = Some((self.generation()?, self.changed()?));
            if seen != now {
                (seen, moved) = (now, Instant::now());
            } else if waited > TIMEOUT {
                return Err(busy());
            }
            if began.elapsed() > LONGEST {
                return Err(busy());
            }
            match turn {
                Some(_) => std::thread::sleep(FIRST_PAUSE),
                None => {
                    std::thread::sleep(pause);
                    pause = (pause * 2).min(LAST_PAUSE);
                }
            }
        }
    }

    fn try_domain(&self) -> Result<bool, HostError> {
        match self.domain.try_lock() {
            Ok(()) => Ok(true),
            Err(TryLockError::WouldBlock) => Ok(false),
            Err(TryLockError::Error(source)) => Err(self.io("lock", Name::Domain)(source)),
        }
    }

    fn try_turn(&self) -> Result<Option<Turn<'_>>, HostError> {
        match rustix::fs::flock(&self.dir, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(Some(Turn(self))),
            Err(Errno::WOULDBLOCK) => Ok(None),
            Err(error) => Err(HostError::Io {
                what: "lock",
                path: self.path.clone(),
                source: error.into(),
            }),
        }
    }

    /// Time of the last creation, removal or replacement of a file.
    pub(super) fn changed(&self) -> Result<(i64, u64), HostError> {
        match rustix::fs::fstat(&self.dir) {
            Ok(stat) => Ok(modified(&stat)),
            Err(error) => Err(HostError::Io {
                what: "examine",
                path: self.path.clone(),
                source: error.into(),
            }),
        }
    }

    /// Whether the process is running, that is, holds its lock file.
    pub(super) fn is_running(&self, id: Id) -> Result<bool, HostError> {
        let name = Name::Process(id);
        // Opened for reading only: closing a writable descriptor would look like the end of that
        // process.
        let Some(file) = self.open(name)? else {
            return Ok(false);
        };
        match file.try_lock_shared() {
            Ok(()) => Ok(false),
            Err(TryLockError::WouldBlock) => Ok(true),
            Err(TryLockError::Error(source)) => Err(self.io("lock", name)(source)),
        }
    }

    /// Lists the known files, in no particular order. Other files are ignored.
    pub(super) fn names(&self) -> Result<Vec<Name>, HostError> {
        let io = |error: Errno| self.io("list", Name::Domain)(error.into());
        let mut names = Vec::new();
        for found in rustix::fs::Dir::read_from(&self.dir).map_err(io)? {
            let found = found.map_err(io)?;
            let name = found.file_name().to_str().ok().and_then(Name::parse);
            names.extend(name);
            if names.len() > MAX_FILES {
                return Err(HostError::TooManyFiles {
                    path: self.path.clone(),
                });
            }
        }
        Ok(names)
    }

    /// Version of a file; `None` if it does not exist.
    pub(super) fn version(&self, name: Name) -> Result<Option<Version>, HostError> {
        match rustix::fs::statat(&self.dir, name.to_string(), AtFlags::SYMLINK_NOFOLLOW) {
            Ok(stat) => Ok(Some(Version {
                modified: modified(&stat),
                inode: stat.st_ino,
                len: stat.st_size,
            })),
            Err(Errno::NOENT) => Ok(None),
            Err(error) => Err(self.io("examine", name)(error.into())),
        }
    }

    /// Content of an entries file; `None` if it does not exist.
    pub(super) fn read(&self, name: Name) -> Result<Option<Content>, HostError> {
        let Some(file) = self.open(name)? else {
            return Ok(None);
        };
        let found = rustix::fs::fstat(&file);
        let found = found.map_err(|error| self.io("examine", name)(error.into()))?;
        let mut bytes = Vec::new();
        let limit = MAX_SIZE as u64;
        // The size may change before the read, so the read is limited too.
        file.take(limit + 1)
            .read_to_end(&mut bytes)
            .map_err(self.io("read", name))?;
        if bytes.len() > MAX_SIZE {
            return Err(HostError::TooLarge {
                path: self.path.join(name.to_string()),
            });
        }
        Ok(Some(Content {
            bytes,
            user: found.st_uid,
        }))
    }

    /// Opens a file for reading; `None` if it does not exist. Fails when it is not a regular file
    /// of the users of the domain.
    pub(super) fn open(&self, name: Name) -> Result<Option<File>, HostError> {
        // Non-blocking, in case the name refers to a pipe.
        let flags = OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
        match rustix::fs::openat(&self.dir, name.to_string(), flags, Mode::empty()) {
            Ok(file) => check_file(file, &self.path, name, self.users).map(Some),
            Err(Errno::NOENT) => Ok(None),
            // A symbolic link.
            Err(Errno::LOOP) => Err(not_private(&self.path, name)),
            Err(error) => Err(self.io("open", name)(error.into())),
        }
    }

    fn create(&self, name: Name, writers: Writers) -> Result<File, HostError> {
        let (dir, path) = (&self.dir, name.to_string());
        let file = match writers {
            Writers::All => self.users.create_file(dir, &path),
            Writers::This => self.users.create_readable_file(dir, &path),
        };
        file.map(File::from).map_err(self.io("create", name))
    }

    pub(super) fn rename(&self, from: Name, to: Name) -> Result<(), HostError> {
        rustix::fs::renameat(&self.dir, from.to_string(), &self.dir, to.to_string())
            .map_err(|error| self.io("rename", from)(error.into()))
    }

    pub(super) fn remove(&self, name: Name) -> Result<(), HostError> {
        match rustix::fs::unlinkat(&self.dir, name.to_string(), AtFlags::empty()) {
            Ok(()) | Err(Errno::NOENT) => Ok(()),
            Err(error) => Err(self.io("remove", name)(error.into())),
        }
    }

    pub(super) fn io(&self, what: &'static str, name: Name) -> impl FnOnce(io::Error) -> HostError {
        let path = self.path.join(name.to_string());
        move |source| HostError::Io { what, path, source }
    }
}

/// The users of the domain who may write to a file.
#[derive(Debug, Clone, Copy)]
pub(super) enum Writers {
    /// All users of the domain.
    All,
    /// The user of this process.
    This,
}

/// The content of a file.
pub(super) struct Content {
    pub(super) bytes: Vec<u8>,
    /// The user whose process has written it.
    pub(super) user: u32,
}

/// Number of changes whose files are remembered, and the bytes of each: its process, and the kind of the file.
const RING: usize = 512;
const SLOT: usize = 16;
/// Offset of the ring, which follows the generation.
const RING_START: u64 = 8;

/// Index of a change in the ring.
const fn index_of(generation: u64) -> usize {
    (generation % RING as u64) as usize
}

fn slot_of(name: Name) -> [u8; SLOT] {
    let (Id(id), kind) = match name {
        Name::Remote(id) => (id, 1_u64),
        Name::Entries(id)
        | Name::Process(id)
        | Name::Socket(id)
        | Name::Counts(id)
        | Name::Temporary(id) => (id, 0),
        Name::Domain | Name::Ended => (Id(0), 0),
    };
    (u128::from(id) | u128::from(kind) << 64).to_le_bytes()
}

fn name_in(slot: &[u8; SLOT]) -> Option<Name> {
    let slot = u128::from_le_bytes(*slot);
    let id = Id((slot & u128::from(u64::MAX)) as u64);
    match slot >> 64 {
        0 => Some(Name::Entries(id)),
        1 => Some(Name::Remote(id)),
        _ => None,
    }
}

/// Distinguishes an entries file from its predecessor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Version {
    /// Not a time: see [`Guard::write`].
    modified: (i64, u64),
    inode: u64,
    len: i64,
}

#[allow(
    clippy::useless_conversion,
    reason = "the nanoseconds of 32-bit systems are a u32"
)]
fn modified(stat: &Stat) -> (i64, u64) {
    (stat.st_mtime, stat.st_mtime_nsec.into())
}

/// Maximum number of files in a directory: six per process, for more processes than a host runs.
const MAX_FILES: usize = 100_000;

/// The turn to wait for the lock of the domain; dropping it releases the turn.
struct Turn<'a>(&'a HostDir);

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        if let Err(error) = rustix::fs::flock(&self.0.dir, FlockOperation::Unlock) {
            log_limit::error!(%error, path = %self.0.path.display(), "cannot unlock the turn lock");
        }
    }
}

/// The locked domain.
pub(super) struct Guard<'a> {
    pub(super) host_dir: &'a HostDir,
    _threads: MutexGuard<'a, Option<Instant>>,
}

impl Drop for Guard<'_> {
    fn drop(&mut self) {
        if let Err(error) = self.host_dir.domain.unlock() {
            log_limit::error!(%error, path = %self.host_dir.path.display(), "cannot unlock the directory");
        }
    }
}

impl Guard<'_> {
    /// Whether the locked file is still the one that a joining process locks.
    fn is_current(&self) -> Result<bool, HostError> {
        let host_dir = self.host_dir;
        let io = |error: Errno| host_dir.io("examine", Name::Domain)(error.into());
        let held = rustix::fs::fstat(&host_dir.domain).map_err(io)?;
        let name = Name::Domain.to_string();
        match rustix::fs::statat(&host_dir.dir, name, AtFlags::SYMLINK_NOFOLLOW) {
            Ok(found) => Ok((held.st_dev, held.st_ino) == (found.st_dev, found.st_ino)),
            Err(Errno::NOENT) => Ok(false),
            Err(error) => Err(io(error)),
        }
    }

    pub(super) fn id(&self) -> Id {
        self.host_dir.id
    }

    /// Replaces a file of this process and increments the generation.
    pub(super) fn write(&self, name: Name, bytes: &[u8]) -> Result<(), HostError> {
        let host_dir = self.host_dir;
        let generation = host_dir.generation()?.wrapping_add(1);
        self.replace(name, bytes, Writers::All, |file| {
            // The modification time is the version: clocks are too coarse and inodes are reused, so
            // neither distinguishes two files of one process.
            let version = Timespec {
                tv_sec: i64::try_from(generation & 0x7fff_ffff).unwrap_or(0),
                tv_nsec: 0,
            };
            let times = Timestamps {
                // Cleaners of temporary files check the access time.
                last_access: Timespec {
                    tv_sec: 0,
                    tv_nsec: rustix::fs::UTIME_NOW,
                },
                last_modification: version,
            };
            let set = rustix::fs::futimens(file, &times);
            set.map_err(|error| host_dir.io("write", name)(error.into()))
        })?;
        let at = RING_START + (SLOT * index_of(generation)) as u64;
        host_dir
            .domain
            .write_all_at(&slot_of(name), at)
            .and_then(|()| host_dir.domain.write_all_at(&generation.to_le_bytes(), 0))
            .map_err(host_dir.io("write", Name::Domain))
    }

    /// Replaces a file as a whole. `finish` is called before the file appears under its name.
    pub(super) fn replace(
        &self,
        name: Name,
        bytes: &[u8],
        writers: Writers,
        finish: impl FnOnce(&File) -> Result<(), HostError>,
    ) -> Result<File, HostError> {
        let host_dir = self.host_dir;
        let temporary = Name::Temporary(host_dir.id);
        host_dir.remove(temporary)?;
        let mut file = host_dir.create(temporary, writers)?;
        let written = file.write_all(bytes);
        let renamed = written
            .map_err(host_dir.io("write", temporary))
            .and_then(|()| finish(&file))
            .and_then(|()| host_dir.rename(temporary, name));
        if let Err(error) = renamed {
            // The first error is returned; the next sweep removes the temporary file.
            let _ = host_dir.remove(temporary);
            return Err(error);
        }
        Ok(file)
    }

    /// Removes the files of dead processes. Returns the number of running processes, including this
    /// one after it has joined.
    pub(super) fn sweep(&self) -> Result<usize, HostError> {
        let mut living = std::collections::HashMap::new();
        for name in self.host_dir.names()? {
            let id = match name {
                Name::Domain | Name::Ended => continue,
                // No process is about to rename it: that happens under this lock only. A process that creates the
                // lock file tolerates the removal.
                Name::Temporary(_) => {
                    self.host_dir.remove(name)?;
                    continue;
                }
                Name::Process(id)
                | Name::Entries(id)
                | Name::Remote(id)
                | Name::Socket(id)
                | Name::Counts(id) => id,
            };
            let lives = match living.get(&id) {
                Some(lives) => *lives,
                None => self.host_dir.is_running(id)?,
            };
            living.insert(id, lives);
            match name {
                _ if lives => {}
                Name::Counts(id) => self.keep_counts(id),
                name => self.host_dir.remove(name)?,
            }
        }
        Ok(living.values().filter(|lives| **lives).count())
    }

    /// Removes the files of a dead process.
    pub(super) fn remove_files(&self, id: Id) -> Result<(), HostError> {
        self.host_dir.remove(Name::Entries(id))?;
        self.host_dir.remove(Name::Remote(id))?;
        self.host_dir.remove(Name::Socket(id))?;
        self.keep_counts(id);
        self.host_dir.remove(Name::Temporary(id))?;
        self.host_dir.remove(Name::Process(id))
    }

    /// Leaves the directory, and leaves it empty if this is the last process.
    pub(super) fn leave(self) -> Result<(), HostError> {
        self.remove_files(self.host_dir.id)?;
        // Last, because the lock shows that this process is running.
        drop(self.host_dir.process.lock().take());
        if self.sweep()? == 0 && self.is_current()? {
            // Those of which the values were not kept.
            for name in self.host_dir.names()? {
                if matches!(name, Name::Counts(_)) {
                    self.host_dir.remove(name)?;
                }
            }
            self.host_dir.remove(Name::Ended)?;
            self.host_dir.remove(Name::Domain)?;
        }
        Ok(())
    }
}

/// Opens the lock file of the domain, and creates it if it is missing.
fn open_domain(dir: &OwnedFd, path: &Path, users: DomainUsers, id: Id) -> Result<File, HostError> {
    let name = Name::Domain;
    let io = |what| {
        let path = path.join(name.to_string());
        move |source| HostError::Io { what, path, source }
    };
    let flags = OFlags::RDWR | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let open = || match rustix::fs::openat(dir, name.to_string(), flags, Mode::empty()) {
        Ok(file) => check_file(file, path, name, users).map(Some),
        Err(Errno::NOENT) => Ok(None),
        Err(error) => Err(io("open")(error.into())),
    };
    loop {
        if let Some(file) = open()? {
            return Ok(file);
        }
        // Appears under its name only when all users of the domain can open it.
        let temporary = Name::Temporary(id).to_string();
        let file = users.create_file(dir, &temporary).map_err(io("create"))?;
        let linked = rustix::fs::linkat(dir, &temporary, dir, name.to_string(), AtFlags::empty());
        let removed = rustix::fs::unlinkat(dir, &temporary, AtFlags::empty());
        match linked.and(removed) {
            Ok(()) => return Ok(File::from(file)),
            // Another process has created it, or has swept the temporary file away.
            Err(Errno::EXIST | Errno::NOENT) => {}
            Err(error) => return Err(io("create")(error.into())),
        }
    }
}

fn check_file(
    file: OwnedFd,
    dir: &Path,
    name: Name,
    users: DomainUsers,
) -> Result<File, HostError> {
    let path = dir.join(name.to_string());
    let stat = match rustix::fs::fstat(&file) {
        Ok(stat) => stat,
        Err(error) => {
            let (what, source) = ("examine", error.into());
            return Err(HostError::Io { what, path, source });
        }
    };
    let is_file = FileType::from_raw_mode(stat.st_mode) == FileType::RegularFile;
    if is_file && users.own(&stat) {
        return Ok(File::from(file));
    }
    Err(not_private(dir, name))
}

fn not_private(dir: &Path, name: Name) -> HostError {
    HostError::NotPrivate {
        path: dir.join(name.to_string()),
        why: "it is not a regular file of the users of this domain".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_known_file_names_are_parsed() {
        let id = Id(0x0123_4567_89ab_cdef);
        for name in [
            Name::Domain,
            Name::Process(id),
            Name::Entries(id),
            Name::Remote(id),
            Name::Socket(id),
            Name::Counts(id),
            Name::Ended,
            Name::Temporary(id),
        ] {
            assert_eq!(Name::parse(&name.to_string()), Some(name));
        }
        for other in [
            "",
            "lock2",
            "x.lock",
            "0123456789ABCDEF.lock",
            "+123456789abcdef.lock",
        ] {
            assert_eq!(Name::parse(other), None, "{other}");
        }
    }
}
