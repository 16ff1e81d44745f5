//! The directory that the processes of a domain share on one host.
//!
//! Its path is `$FIPA_RUNTIME_DIR/<domain>`, or `<runtime_dir>/<domain>` with the key of the configuration, or
//! `/tmp/fipa-<uid>/<domain>`, which is the same for a login shell and a service of the same user. Both levels belong
//! to the user and have mode 0700. With a `group`, both belong to the group and have mode 0770. The last process that
//! leaves removes the lower level. The upper level stays: a configured one belongs to its owner, and in `/tmp` another
//! user could take the name (see `user_dir`).
//!
//! A member of the group can replace each name in the directory. So files are used relative to a descriptor that was
//! examined, or belong to this user, or are read as claims. Shared memory is below `/dev/shm/fipa-<uid>` instead, where
//! only this user can replace a name.
//!
//! Cleaners of `/tmp` remove old files. Every process holds a shared lock on both levels, which
//! systemd-tmpfiles respects, and renews the timestamps once a day for other cleaners.

use std::ffi::{OsStr, OsString};
use std::fs;
use std::io;
use std::io::{Read as _, Write as _};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use bytesize::ByteSize;
use fipa_acl::escape;
use fipa_transport::{DirectoryError, DomainUsers, Intrusion, fnv1a, log_limit};
use rustix::fs::{AtFlags, CWD, FlockOperation, Mode, OFlags, Timespec, Timestamps};
use rustix::io::Errno;

use crate::Config;
use crate::domain::accounts::{group_name, group_number, is_member, user_name};
use crate::domain::user_dir::{Holder, UserDir};

/// The environment variable with the directory of all domains, instead of that in `/tmp`.
pub(crate) const VARIABLE: &str = "FIPA_RUNTIME_DIR";

/// Maximum number of attempts to join a directory that another process removes as it leaves.
pub(crate) const RETRIES: u32 = 20;

/// Time to wait for a cleaner that has locked a directory. It holds the lock while it examines the
/// directory.
const LOCK_TIMEOUT: Duration = Duration::from_secs(10);

/// Maximum number of files whose timestamps are renewed.
const MAX_RENEWED: usize = 100_000;

/// Maximum depth of the directories whose timestamps are renewed; there are four levels.
const MAX_DEPTH: usize = 8;

/// Age from which timestamps count as not renewed by another process.
const STALE: Duration = Duration::from_secs(12 * 60 * 60);

/// File with the host identifier from before the directory was removed and created again.
const HOST: &str = "host";

/// Files that end with the last process of the domain: that with the host identifier, the state of the gateway with its
/// next version, and the token of its clients.
const FILES: [&str; 4] = [
    HOST,
    DomainDir::STATE,
    DomainDir::NEXT_STATE,
    DomainDir::TOKEN,
];

/// Length of the file that is written to test a directory: about that of the files of one process.
const PROBE: usize = 16 << 10;

/// Maximum length of a host identifier, in bytes.
const MAX_HOST: usize = 128;

/// The directory of a domain.
#[derive(Debug, Clone)]
pub(crate) struct DomainDir {
    base: PathBuf,
    /// The key `group`; empty if the domain belongs to one user.
    group: String,
    /// The users of the domain. `None` if the group does not exist.
    users: Option<DomainUsers>,
    /// Whether the user has named the directory.
    is_named: bool,
    /// The holder of the name `/tmp/fipa-<uid>`, if the base has another name.
    name_held_by: Option<Holder>,
    domain: String,
    /// The locks; set when the process has joined.
    locks: Option<Arc<DirLocks>>,
}

/// Shared locks on both levels of the directory.
#[derive(Debug)]
struct DirLocks {
    base: OwnedFd,
    domain: OwnedFd,
    /// The host identifier at the time of locking, which outlives the directory.
    host: Option<String>,
}

/// The error if the directory of a domain cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DomainDirError {
    /// The directory cannot be created or examined.
    #[error("cannot use the directory {}", path.display())]
    Io {
        /// The directory.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// No file can be written in the directory.
    #[error("{} cannot be used: {problem}; {remedy}", path.display())]
    NotWritable {
        /// The directory.
        path: PathBuf,
        /// The cause, for example `its file system is full: 0 B free of 1.0 MiB`.
        problem: String,
        /// The remedy, for example to delete files.
        remedy: String,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The group of the configuration does not exist, or has no directory.
    #[error("cannot share a domain with the group {group:?}: {problem}; {remedy}")]
    Group {
        /// The group of the configuration.
        group: String,
        /// The violated requirement.
        problem: &'static str,
        /// The remedy.
        remedy: String,
    },
    /// Other users could read or change the contents of the directory.
    #[error("{} cannot be used: {problem}; {remedy}", path.display())]
    NotPrivate {
        /// The directory.
        path: PathBuf,
        /// The violated requirement, for example `its mode is 755`.
        problem: String,
        /// The remedy, for example `run: chmod 700 /run/fipa`.
        remedy: String,
    },
}

impl DomainDir {
    /// File with what a gateway keeps for its successor.
    pub(crate) const STATE: &str = "gateway.state";
    /// The file that replaces it.
    pub(crate) const NEXT_STATE: &str = "gateway.state.new";
    /// File with the token of the clients of `http.listen`.
    pub(crate) const TOKEN: &str = "http.token";

    /// Creates the directory of a domain, and checks that it is private.
    pub(crate) fn prepare(config: &Config) -> Result<Self, DomainDirError> {
        let mut dir = Self::of(config);
        if dir.create().is_err() {
            // Another user may have taken the name in between.
            dir = Self::of(config);
            dir.create()?;
        }
        if let Some(holder) = dir.name_held_by {
            log_limit::warn!(
                "{holder} holds the name of the directory in which the domains of this user are, so they are \
                 in {}; to reserve the name at boot, see fipa doctor",
                dir.base.display()
            );
        }
        Ok(dir)
    }

    /// Returns the directory of a domain without creating or examining it.
    pub(crate) fn of(config: &Config) -> Self {
        let variable = std::env::var_os(VARIABLE);
        let named = [variable, Some(OsString::from(&config.runtime_dir))];
        let named = named.into_iter().flatten().find(|it| !it.is_empty());
        let is_named = named.is_some();
        let (base, name_held_by) = match named {
            // A relative path would name another directory in each working directory.
            Some(base) => {
                let base = std::path::absolute(&base).unwrap_or_else(|_| PathBuf::from(base));
                (base, None)
            }
            None => {
                let user = rustix::process::geteuid().as_raw();
                let found = UserDir::find(Path::new("/tmp"), user);
                (found.path, found.name_held_by)
            }
        };
        Self {
            base,
            group: config.group.clone(),
            users: match config.group.is_empty() {
                true => Some(DomainUsers::This),
                false => group_number(&config.group).map(DomainUsers::Group),
            },
            is_named,
            name_held_by,
            domain: config.domain.clone(),
            locks: None,
        }
    }

    /// Returns the users of the domain.
    ///
    /// # Errors
    /// If the configuration names a group that does not exist, or no directory that its members can enter.
    pub(crate) fn users(&self) -> Result<DomainUsers, DomainDirError> {
        let wrong = |problem, remedy| DomainDirError::Group {
            group: self.group.clone(),
            problem,
            remedy,
        };
        let group = escape(&self.group);
        let users = self.users.ok_or_else(|| {
            wrong(
                "/etc/group does not list it",
                format!("create it (`addgroup --system {group}`), or write its number"),
            )
        })?;
        if matches!(users, DomainUsers::Group(_)) && !self.is_named {
            return Err(wrong(
                "no directory is configured that its members can enter",
                format!(
                    "set runtime_dir = \"/run/fipa\", and create the directory: `install -d -g {group} -m 770 \
                     /run/fipa`"
                ),
            ));
        }
        Ok(users)
    }

    /// Creates both levels if they are missing, and checks that only the users of the domain can enter them.
    fn create(&self) -> Result<(), DomainDirError> {
        let users = self.users()?;
        for path in self.levels() {
            let created = users.create_directory(&path);
            drop(created.map_err(|error| self.unusable(error))?);
            users.open_to_group(&path).map_err(io_error(&path))?;
            self.check_owner(users)?;
        }
        self.create_memory_of_user();
        Ok(())
    }

    /// Checks that only the users of the domain can enter a level.
    fn check(&self, path: &Path) -> Result<OwnedFd, DomainDirError> {
        let opened = self.users()?.open_directory(path);
        opened.map_err(|error| self.unusable(error))
    }

    /// Checks that the upper level belongs to a member of the group, or to root. Otherwise its owner could open it to
    /// other users: in a directory with the set-group-ID bit, a stranger creates directories of its group, too.
    fn check_owner(&self, users: DomainUsers) -> Result<(), DomainDirError> {
        let DomainUsers::Group(group) = users else {
            return Ok(());
        };
        let path = &self.base;
        let owner = fs::symlink_metadata(path).map_err(io_error(path))?.uid();
        let is_this = owner == rustix::process::geteuid().as_raw();
        if owner == 0 || is_this || is_member(owner, group) {
            return Ok(());
        }
        let at = path.display();
        Err(DomainDirError::NotPrivate {
            path: path.clone(),
            problem: format!(
                "it belongs to {}, which is not a member of {} (/etc/group)",
                user_name(owner),
                group_name(group)
            ),
            remedy: format!("give it to root: `chown root {at}`"),
        })
    }

    /// Returns the holder of the name `/tmp/fipa-<uid>`, if the directory has another name.
    pub(crate) fn name_held_by(&self) -> Option<Holder> {
        self.name_held_by
    }

    /// Locks both levels, so that systemd-tmpfiles skips them. Must be called after this process has
    /// created files in the directory, so that no other process removes the levels as empty.
    pub(crate) fn lock(&mut self) -> Result<(), DomainDirError> {
        let locks = DirLocks {
            base: self.lock_shared(&self.base)?,
            domain: self.lock_shared(&self.path())?,
            host: self.host_id().ok(),
        };
        self.locks = Some(Arc::new(locks));
        Ok(())
    }

    /// The levels of the directory.
    pub(crate) fn levels(&self) -> [PathBuf; 2] {
        [self.base.clone(), self.path()]
    }

    /// Whether the paths still lead to the levels that were locked.
    pub(crate) fn is_there(&self) -> bool {
        self.locks.as_ref().is_none_or(|locks| {
            is_same(&locks.base, &self.base) && is_same(&locks.domain, &self.path())
        })
    }

    /// Creates and locks the levels again after another program removed them.
    pub(crate) fn rejoin(&mut self) -> Result<(), DomainDirError> {
        self.create_memory_of_user();
        if self.is_there() {
            return Ok(());
        }
        self.create()?;
        let host = self.locks.as_ref().and_then(|locks| locks.host.clone());
        if let Some(host) = &host {
            // Processes that start from now on must get the same host identifier.
            self.write_host(host).map_err(|source| DomainDirError::Io {
                path: self.path().join(HOST),
                source,
            })?;
        }
        self.lock()
    }

    fn write_host(&self, host: &str) -> io::Result<()> {
        let users = self.users().map_err(io::Error::other)?;
        let directory = self.check(&self.path()).map_err(io::Error::other)?;
        match users.create_file(directory, HOST) {
            Ok(file) => fs::File::from(file).write_all(host.as_bytes()),
            // Another process of the domain has written it.
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// Renews the timestamps of all files in the directory, for cleaners that check only the age.
    /// Does nothing if another process has renewed them within the last 12 hours.
    pub(crate) fn renew(&self) {
        let path = self.path();
        let renewed = fs::symlink_metadata(&path).and_then(|found| found.modified());
        let age = renewed.map(|renewed| SystemTime::now().duration_since(renewed));
        if matches!(age, Ok(Ok(age)) if age < STALE) {
            return;
        }
        let mut budget = MAX_RENEWED;
        renew_below(&path, MAX_DEPTH, &mut budget);
        touch(&self.base, true);
        // Last, because this timestamp tells other processes that the renewal is complete.
        touch(&path, true);
    }

    /// Checks that the existing levels are private. Returns whether both exist.
    pub(crate) fn exists(&self) -> Result<bool, DomainDirError> {
        for path in [&self.base, &self.path()] {
            match self.check(path) {
                Ok(_) => {}
                Err(DomainDirError::Io { source, .. })
                    if source.kind() == io::ErrorKind::NotFound =>
                {
                    return Ok(false);
                }
                Err(error) => return Err(error),
            }
        }
        self.check_owner(self.users()?)?;
        Ok(true)
    }

    /// Checks that files can be written in both levels, and in the directory above if the upper level does
    /// not exist. Writes a file without a name, which the kernel removes.
    ///
    /// # Errors
    /// [`DomainDirError::NotWritable`] with the cause.
    pub(crate) fn check_writable(&self) -> Result<(), DomainDirError> {
        let [base, domain] = self.levels();
        let base = base.ancestors().find(|path| path.is_dir());
        let base = base.unwrap_or(Path::new("/"));
        for path in [base, &domain] {
            match write_in(path) {
                Ok(()) => {}
                // The first process of the domain creates it.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(self.not_writable(path, error)),
            }
        }
        Ok(())
    }

    /// Returns the name of the domain.
    #[cfg(feature = "protocols")]
    pub(crate) fn name(&self) -> &str {
        &self.domain
    }

    /// Returns the path of the directory.
    pub(crate) fn path(&self) -> PathBuf {
        self.base.join(&self.domain)
    }

    /// Returns the directory of this user's shared memory.
    pub(crate) fn memory(&self) -> PathBuf {
        match self.group.is_empty() {
            true => self.part("shm"),
            false => Self::memory_of_user().join(self.prefix()),
        }
    }

    /// Returns the directory of the memory that this user has in the domains of groups.
    fn memory_of_user() -> PathBuf {
        let user = rustix::process::geteuid().as_raw();
        UserDir::find(Path::new("/dev/shm"), user).path
    }

    /// Creates the directory above that of the shared memory.
    fn create_memory_of_user(&self) {
        if !self.group.is_empty() {
            // Without it, shared memory cannot be opened, and reports that.
            drop(DomainUsers::This.create_directory(&Self::memory_of_user()));
        }
    }

    /// Returns the path of a subdirectory, for example `directory` or `unix`.
    pub(crate) fn part(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    /// Returns the prefix of the names of this domain's shared memory. It differs for domains of
    /// other users and in other directories.
    pub(crate) fn prefix(&self) -> String {
        let path = self.path();
        let path = path.as_os_str().as_encoded_bytes();
        // The users of a group share no memory.
        let user = match self.group.is_empty() {
            true => 0,
            false => rustix::process::geteuid().as_raw(),
        };
        // Half of the hash, since names of files in shared memory are short.
        let hash = fnv1a(path.iter().copied().chain(user.to_le_bytes())) as u32;
        format!("fipa_{}_{hash:08x}", self.domain)
    }

    /// Returns the identifier of this host: the boot identifier of the kernel, and device and inode
    /// of the directory. Containers with a directory of their own thus count as hosts of their own.
    pub(crate) fn host_id(&self) -> io::Result<String> {
        if let Some(saved) = self.saved_host_id() {
            return Ok(saved);
        }
        let boot = fs::read_to_string("/proc/sys/kernel/random/boot_id")?;
        let directory = fs::metadata(self.path())?;
        Ok(format!(
            "{}:{:x}:{:x}",
            boot.trim(),
            directory.dev(),
            directory.ino()
        ))
    }

    /// Returns the host identifier from before the directory was removed and created again.
    fn saved_host_id(&self) -> Option<String> {
        // In a domain of a group, another member can put anything there.
        let mut options = fs::File::options();
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits();
        let file = options.read(true).custom_flags(flags as i32);
        let file = file.open(self.path().join(HOST)).ok()?;
        let mut text = String::new();
        let limit = MAX_HOST as u64 + 1;
        file.take(limit).read_to_string(&mut text).ok()?;
        let is_plain = text.bytes().all(|byte| byte.is_ascii_graphic());
        (is_plain && (1..=MAX_HOST).contains(&text.len())).then_some(text)
    }

    /// Whether the directory contains at most the files that end with the last process.
    fn is_empty_but_for_files(&self) -> bool {
        let mut names = fs::read_dir(self.path()).into_iter().flatten();
        let is_file = |name: &OsStr| FILES.iter().any(|file| name == *file);
        names.all(|entry| entry.is_ok_and(|entry| is_file(&entry.file_name())))
    }

    /// Returns the error for a directory that cannot be used, with its remedy.
    fn unusable(&self, error: DirectoryError) -> DomainDirError {
        let (path, intrusion) = match error {
            DirectoryError::NotPrivate { path, intrusion } => (path, intrusion),
            DirectoryError::Io { path, source, .. }
                if source.kind() == io::ErrorKind::PermissionDenied =>
            {
                return self.not_writable(&path, source);
            }
            DirectoryError::Io { path, source, .. } => return DomainDirError::Io { path, source },
            // The enum may grow.
            other => return io_error(&self.path())(io::Error::other(other)),
        };
        let at = path.display();
        let (problem, remedy) = match intrusion {
            Intrusion::Owner(owner) => {
                let owner = user_name(owner);
                (
                    format!("it belongs to {owner}, and a domain belongs to one user"),
                    format!(
                        "run all processes of the domain as {owner}, share the domain with a group (key group), or \
                         {ANOTHER}"
                    ),
                )
            }
            Intrusion::Group { found, expected } => (
                format!(
                    "it belongs to {}, not to {}",
                    group_name(found),
                    group_name(expected)
                ),
                format!("run: chgrp {} {at} && chmod 770 {at}", escape(&self.group)),
            ),
            Intrusion::Mode(_) => (
                intrusion.to_string(),
                match self.group.is_empty() {
                    true => format!("run: chmod 700 {at} (systemd: RuntimeDirectoryMode=0700)"),
                    false => format!("run: chmod 770 {at} (systemd: RuntimeDirectoryMode=0770)"),
                },
            ),
            other => (other.to_string(), ANOTHER.to_owned()),
        };
        DomainDirError::NotPrivate {
            path,
            problem,
            remedy,
        }
    }

    /// Returns the error for a directory in which no file can be written, with the cause and the remedy.
    fn not_writable(&self, path: &Path, source: io::Error) -> DomainDirError {
        let user = || user_name(rustix::process::geteuid().as_raw());
        let at = path.display();
        let (problem, remedy) = match Errno::from_io_error(&source) {
            Some(Errno::NOSPC) => match rustix::fs::statvfs(path) {
                Ok(found) if found.f_files > 0 && found.f_favail == 0 => (
                    format!(
                        "its file system has no inodes left: 0 of {} are free",
                        found.f_files
                    ),
                    format!("delete files there (`df -i {at}`), or {ANOTHER}"),
                ),
                Ok(found) => {
                    let size = |blocks: u64| ByteSize::b(blocks.saturating_mul(found.f_frsize));
                    let (free, total) = (size(found.f_bavail), size(found.f_blocks));
                    (
                        format!("its file system is full: {free} free of {total}"),
                        format!("delete files on it or enlarge it (`df -h {at}`), or {ANOTHER}"),
                    )
                }
                Err(_) => (
                    "its file system is full".to_owned(),
                    format!("delete files on it, or {ANOTHER}"),
                ),
            },
            Some(Errno::DQUOT) => (
                format!("the disk quota of {} is used up", user()),
                format!("delete files of this user, raise its quota, or {ANOTHER}"),
            ),
            Some(Errno::ROFS) => (
                "its file system is read-only".to_owned(),
                format!(
                    "mount it writable (`findmnt -T {at}` shows the mount, `dmesg` an error of the disk), or {ANOTHER}"
                ),
            ),
            Some(Errno::ACCESS | Errno::PERM) if !self.group.is_empty() => (
                format!("{} may not create files in it", user()),
                format!(
                    "add the user to the group (`adduser USER {}`), log in again, and see that the group may write \
                     there (`ls -ld {at}`)",
                    escape(&self.group)
                ),
            ),
            Some(Errno::ACCESS | Errno::PERM) => (
                format!("{} may not write in it", user()),
                format!("give the directory to this user (`ls -ld {at}`), or {ANOTHER}"),
            ),
            _ => (
                "no file can be written in it".to_owned(),
                format!("repair it, or {ANOTHER}"),
            ),
        };
        DomainDirError::NotWritable {
            path: path.to_owned(),
            problem,
            remedy,
            source,
        }
    }

    /// Opens a level and takes a shared lock on it.
    fn lock_shared(&self, path: &Path) -> Result<OwnedFd, DomainDirError> {
        let directory = self.check(path)?;
        let began = Instant::now();
        loop {
            match rustix::fs::flock(&directory, FlockOperation::NonBlockingLockShared) {
                Ok(()) => break,
                Err(Errno::WOULDBLOCK) if began.elapsed() < LOCK_TIMEOUT => {
                    std::thread::sleep(Duration::from_millis(5));
                }
                // The lock is optional: the process joins again if the directory is removed.
                Err(error) => {
                    log_limit::warn!(
                        %error,
                        "cannot lock {}, so cleaners of temporary files may remove it; exempt it from \
                         cleaning, or set FIPA_RUNTIME_DIR to another directory",
                        path.display()
                    );
                    break;
                }
            }
        }
        match is_same(&directory, path) {
            true => Ok(directory),
            false => Err(io_error(path)(io::ErrorKind::NotFound.into())),
        }
    }

    /// Removes the empty directories of the domain. Those that other processes use are not empty and stay.
    pub(crate) fn leave(&self) {
        // Fails if the directory is not empty or does not exist, and then nothing is to be done.
        let remove = |path: PathBuf| drop(fs::remove_dir(path));
        remove(self.part("directory"));
        remove(self.memory());
        remove(self.part("unix"));
        if self.is_empty_but_for_files() {
            for file in FILES {
                let _ = fs::remove_file(self.path().join(file));
            }
        }
        remove(self.path());
    }
}

/// Whether the path leads to this directory. A path that cannot be examined counts as the same.
fn is_same(directory: &OwnedFd, path: &Path) -> bool {
    let held = rustix::fs::fstat(directory);
    let found = rustix::fs::lstat(path);
    match (held, found) {
        (Ok(held), Ok(found)) => (held.st_dev, held.st_ino) == (found.st_dev, found.st_ino),
        (_, Err(Errno::NOENT | Errno::NOTDIR)) => false,
        _ => true,
    }
}

/// Writes a file in a directory, and removes it.
fn write_in(directory: &Path) -> io::Result<()> {
    let (flags, mode) = (OFlags::WRONLY | OFlags::CLOEXEC, Mode::RUSR | Mode::WUSR);
    let mut named = None;
    let opened = match rustix::fs::open(directory, flags | OFlags::TMPFILE, mode) {
        // The file system has no files without a name.
        Err(Errno::OPNOTSUPP | Errno::ISDIR | Errno::INVAL) => {
            let number = getrandom::u64().map_err(io::Error::other)?;
            let path = named.insert(directory.join(format!(".fipa-doctor-{number:016x}")));
            rustix::fs::open(&*path, flags | OFlags::CREATE | OFlags::EXCL, mode)
        }
        opened => opened,
    };
    let mut file = fs::File::from(opened?);
    // Some file systems report a lack of room only when the bytes reach the disk.
    let written = file.write_all(&[0; PROBE]).and_then(|()| file.sync_data());
    if let Some(path) = named {
        fs::remove_file(path)?;
    }
    written
}

/// Renews the timestamps of all files below a directory.
fn renew_below(directory: &Path, depth: usize, budget: &mut usize) {
    let found = fs::read_dir(directory).into_iter().flatten().flatten();
    for entry in found {
        if *budget == 0 {
            return;
        }
        *budget -= 1;
        let path = entry.path();
        if depth > 0 && entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            renew_below(&path, depth - 1, budget);
        }
        // The modification time of a file with entries is its version.
        let is_versioned = path.extension().is_some_and(|end| end == "entries");
        touch(&path, !is_versioned);
    }
}

/// Sets the access time to now, and also the modification time if `modification` is true.
fn touch(path: &Path, modification: bool) {
    let at = |tv_nsec| Timespec { tv_sec: 0, tv_nsec };
    let times = Timestamps {
        last_access: at(rustix::fs::UTIME_NOW),
        last_modification: at(match modification {
            true => rustix::fs::UTIME_NOW,
            false => rustix::fs::UTIME_OMIT,
        }),
    };
    // The file may have been removed in the meantime.
    let _ = rustix::fs::utimensat(CWD, path, &times, AtFlags::SYMLINK_NOFOLLOW);
}

fn io_error(path: &Path) -> impl FnOnce(io::Error) -> DomainDirError {
    let path = path.to_owned();
    move |source| DomainDirError::Io { path, source }
}

/// The remedy for a directory that this user cannot repair.
const ANOTHER: &str = "set FIPA_RUNTIME_DIR to another directory of this user";

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};

    #[test]
    fn a_directory_that_other_users_could_enter_is_refused() {
        let home = tempfile::tempdir().unwrap();
        let open = home.path().join("open");
        fs::create_dir(&open).unwrap();
        fs::set_permissions(&open, fs::Permissions::from_mode(0o755)).unwrap();
        let link = home.path().join("link");
        symlink(home.path(), &link).unwrap();
        let file = home.path().join("file");
        fs::write(&file, "").unwrap();
        for (path, problem) in [
            (&open, "its mode is 755"),
            (&link, "a symbolic link"),
            (&file, "a file"),
        ] {
            let error = at(path.clone()).create().unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
        let fresh = at(home.path().join("fresh"));
        fresh.create().unwrap();
        fresh.create().unwrap();
        for level in fresh.levels() {
            assert_eq!(fs::metadata(level).unwrap().mode() & 0o777, 0o700);
        }
    }

    #[test]
    fn prefixes_differ_by_domain_and_base() {
        let dir = |base: &str, domain: &str| DomainDir {
            domain: domain.to_owned(),
            ..at(base.into())
        };
        let all = [dir("/a", "x"), dir("/a", "y"), dir("/b", "x")].map(|p| p.prefix());
        assert!(all[0] != all[1] && all[0] != all[2] && all[1] != all[2]);
        assert!(dir("/a", &"d".repeat(32)).prefix().len() <= 47);
    }

    /// The directory of a domain with this upper level.
    fn at(base: PathBuf) -> DomainDir {
        DomainDir {
            base,
            group: String::new(),
            users: Some(DomainUsers::This),
            is_named: true,
            name_held_by: None,
            domain: "domain".to_owned(),
            locks: None,
        }
    }

    /// Creates a domain directory in a temporary directory.
    fn created() -> (tempfile::TempDir, DomainDir) {
        let home = tempfile::tempdir().unwrap();
        let dir = at(home.path().join("base"));
        dir.create().unwrap();
        (home, dir)
    }

    #[test]
    fn a_group_needs_to_exist_and_a_directory() {
        let config = |group: &str, runtime_dir: &str| Config {
            group: group.to_owned(),
            runtime_dir: runtime_dir.to_owned(),
            ..Config::default()
        };
        let error = |config| DomainDir::of(&config).users().unwrap_err().to_string();
        let unknown = error(config("no such group", "/run/fipa"));
        assert!(unknown.contains("/etc/group does not list it"), "{unknown}");
        let homeless = error(config("4711", ""));
        assert!(homeless.contains("install -d -g 4711 -m 770"), "{homeless}");
        let users = DomainDir::of(&config("4711", "/run/fipa")).users();
        assert_eq!(users.unwrap(), DomainUsers::Group(4711));
    }

    #[test]
    fn a_private_upper_level_is_opened_to_its_own_group_only() {
        let group = rustix::process::getegid().as_raw();
        let home = tempfile::tempdir().unwrap();
        let shared = |group: u32| DomainDir {
            group: group.to_string(),
            users: Some(DomainUsers::Group(group)),
            ..at(home.path().join("base"))
        };
        fs::create_dir(home.path().join("base")).unwrap();
        fs::set_permissions(home.path().join("base"), fs::Permissions::from_mode(0o700)).unwrap();
        let error = shared(group.wrapping_add(1))
            .create()
            .unwrap_err()
            .to_string();
        assert!(error.contains("chmod 770"), "{error}");
        let dir = shared(group);
        dir.create().unwrap();
        for level in dir.levels() {
            let found = fs::metadata(level).unwrap();
            assert_eq!((found.mode() & 0o777, found.gid()), (0o770, group));
        }
        assert!(dir.exists().unwrap());
        fs::set_permissions(&dir.base, fs::Permissions::from_mode(0o775)).unwrap();
        let error = dir.exists().unwrap_err().to_string();
        assert!(error.contains("its mode is 775"), "{error}");
    }

    fn is_locked(path: &Path) -> bool {
        let directory = fs::File::open(path).unwrap();
        let exclusive = FlockOperation::NonBlockingLockExclusive;
        rustix::fs::flock(&directory, exclusive) == Err(Errno::WOULDBLOCK)
    }

    #[test]
    fn both_levels_are_locked_and_created_again() {
        let (_home, mut dir) = created();
        assert!(!is_locked(&dir.base) && !is_locked(&dir.path()));
        let host = dir.host_id().unwrap();
        dir.lock().unwrap();
        assert!(is_locked(&dir.base) && is_locked(&dir.path()));
        assert!(dir.is_there());
        fs::remove_dir(dir.path()).unwrap();
        // Keeps the file system from reusing the inode number.
        fs::create_dir(dir.base.join("another")).unwrap();
        assert!(!dir.is_there());
        dir.rejoin().unwrap();
        assert!(dir.is_there() && is_locked(&dir.path()));
        // Processes that start now get the same identifier.
        assert_eq!(dir.host_id().unwrap(), host);
        fs::remove_dir(dir.base.join("another")).unwrap();
        dir.leave();
        assert!(!dir.path().exists());
        // In /tmp, another user could take the name.
        assert!(dir.base.exists());
    }

    #[test]
    fn the_remedy_names_the_mode_or_the_user() {
        let home = tempfile::tempdir().unwrap();
        fs::set_permissions(home.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let dir = at(home.path().to_owned());
        let error = dir.check(home.path()).unwrap_err().to_string();
        let remedy = format!("chmod 700 {}", home.path().display());
        assert!(error.contains(&remedy), "{error}");
        assert!(error.contains("RuntimeDirectoryMode=0700"), "{error}");
    }

    #[test]
    fn a_replaced_directory_that_other_users_could_enter_is_not_joined() {
        let (_home, mut dir) = created();
        dir.lock().unwrap();
        fs::remove_dir(dir.path()).unwrap();
        fs::create_dir(dir.path()).unwrap();
        fs::set_permissions(dir.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let error = dir.rejoin().unwrap_err();
        assert!(
            matches!(error, DomainDirError::NotPrivate { .. }),
            "{error}"
        );
    }

    #[test]
    fn timestamps_are_renewed_by_one_process_for_all() {
        let (_home, dir) = created();
        let part = dir.part("directory");
        fs::create_dir(&part).unwrap();
        let (lock, entries) = (part.join("lock"), part.join("1.entries"));
        for file in [&lock, &entries] {
            fs::write(file, "").unwrap();
        }
        let old = || {
            let age = Timespec {
                tv_sec: 1000,
                tv_nsec: 0,
            };
            let times = Timestamps {
                last_access: age,
                last_modification: age,
            };
            for path in [&lock, &entries, &part, &dir.path(), &dir.base] {
                rustix::fs::utimensat(CWD, path, &times, AtFlags::empty()).unwrap();
            }
        };
        let is_old = |seconds: i64| seconds == 1000;
        old();
        dir.renew();
        for path in [&lock, &part, &dir.path(), &dir.base] {
            let found = fs::metadata(path).unwrap();
            assert!(!is_old(found.atime()) && !is_old(found.mtime()), "{path:?}");
        }
        let found = fs::metadata(&entries).unwrap();
        assert!(!is_old(found.atime()), "a cleaner would remove it");
        assert!(is_old(found.mtime()), "its version must not change");
        // Another process renews nothing after the first has.
        old();
        touch(&dir.path(), true);
        dir.renew();
        assert!(is_old(fs::metadata(&lock).unwrap().mtime()));
    }
}
