//! Where the processes of a domain meet on one host: a private directory.
//!
//! `$FIPA_RUNTIME_DIR/<domain>`, or `/tmp/fipa-<uid>/<domain>`: the same for a login shell and a
//! service of the same user. Both levels belong to the user, are closed to everybody else and are
//! removed by whoever leaves last.
//!
//! Cleaners of `/tmp` remove what is old. Every process holds a shared lock on both levels, which
//! systemd-tmpfiles respects, and renews the timestamps once a day for the others.

use std::fs::{self, DirBuilder};
use std::io;
use std::io::Write as _;
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use rustix::fs::{AtFlags, CWD, FlockOperation, Mode, OFlags, Timespec, Timestamps};
use rustix::io::Errno;

/// The environment variable that says where domains meet, instead of `/tmp/fipa-<uid>`.
pub(crate) const VARIABLE: &str = "FIPA_RUNTIME_DIR";

/// How often a place that somebody else is just leaving is made again.
pub(crate) const RETRIES: u32 = 20;

/// Time to wait for a cleaner that has locked a directory. It holds the lock while it looks through
/// the directory.
const LOCKING: Duration = Duration::from_secs(10);

/// Maximum number of files whose timestamps are renewed.
const MAX_RENEWED: usize = 100_000;

/// Maximum depth of directories that are looked through; there are four.
const MAX_DEPTH: usize = 8;

/// Age of timestamps that no other process has renewed.
const STALE: Duration = Duration::from_secs(12 * 60 * 60);

/// File with the identifier of the host that the directory had before it was removed.
const HOST: &str = "host";

/// Longest identifier of a host, in bytes.
const MAX_HOST: usize = 128;

/// The directory of a domain, made private.
#[derive(Debug, Clone)]
pub(crate) struct Place {
    base: PathBuf,
    domain: String,
    /// Set once the process has joined.
    held: Option<Arc<Held>>,
}

/// Shared locks on both levels of the directory, and what has to outlive it.
#[derive(Debug)]
struct Held {
    base: OwnedFd,
    domain: OwnedFd,
    host: Option<String>,
}

/// Why the domain's directory cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlaceError {
    /// The directory cannot be made or looked at.
    #[error("cannot use the directory {}: {source}", path.display())]
    Io {
        /// Which one.
        path: PathBuf,
        /// What the operating system said.
        source: io::Error,
    },
    /// Somebody else could read or change what lies there.
    #[error(
        "{} must be a directory of this user that nobody else may enter, and {problem}; \
         remove it, or name another place in FIPA_RUNTIME_DIR",
        path.display()
    )]
    NotPrivate {
        /// Which one.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
}

impl Place {
    /// The place of this domain; the directories of all domains are in `base`, or where the
    /// environment says.
    pub(crate) fn prepare(domain: &str) -> Result<Self, PlaceError> {
        let place = Self::of(domain);
        let made = || make_private(&place.base).and_then(|()| make_private(&place.path()));
        let mut result = made();
        for _ in 0..RETRIES {
            match &result {
                // Whoever left last has removed the one between the two.
                Err(PlaceError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                    result = made();
                }
                _ => break,
            }
        }
        result.map(|()| place)
    }

    /// The place of this domain, whether it is there or not.
    pub(crate) fn of(domain: &str) -> Self {
        let base = match std::env::var_os(VARIABLE).filter(|value| !value.is_empty()) {
            Some(base) => PathBuf::from(base),
            None => PathBuf::from(format!("/tmp/fipa-{}", rustix::process::geteuid().as_raw())),
        };
        Self {
            base,
            domain: domain.to_owned(),
            held: None,
        }
    }

    /// Locks both levels, so that systemd-tmpfiles passes them over. To be called when this process
    /// has files there, so that no other process removes the levels as empty.
    pub(crate) fn hold(&mut self) -> Result<(), PlaceError> {
        let held = Held {
            base: hold(&self.base)?,
            domain: hold(&self.path())?,
            host: self.host_id().ok(),
        };
        self.held = Some(Arc::new(held));
        Ok(())
    }

    /// Whether the levels that were locked are still those of these paths.
    pub(crate) fn is_there(&self) -> bool {
        self.held.as_ref().is_none_or(|held| {
            is_same(&held.base, &self.base) && is_same(&held.domain, &self.path())
        })
    }

    /// Makes and locks the levels again after they were removed.
    pub(crate) fn rejoin(&mut self) -> Result<(), PlaceError> {
        if self.is_there() {
            return Ok(());
        }
        make_private(&self.base)?;
        make_private(&self.path())?;
        let host = self.held.as_ref().and_then(|held| held.host.clone());
        if let Some(host) = &host {
            // Processes that start from now on must not count as another host.
            self.write_host(host).map_err(|source| PlaceError::Io {
                path: self.path().join(HOST),
                source,
            })?;
        }
        self.hold()
    }

    fn write_host(&self, host: &str) -> io::Result<()> {
        let mut options = fs::File::options();
        options.write(true).create_new(true).mode(0o600);
        match options.open(self.path().join(HOST)) {
            Ok(mut file) => file.write_all(host.as_bytes()),
            // By another process of the domain.
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// Renews the timestamps of all that is there, for cleaners that go by age alone; unless
    /// another process has done so lately.
    pub(crate) fn renew(&self) {
        let path = self.path();
        let renewed = fs::symlink_metadata(&path).and_then(|found| found.modified());
        let age = renewed.map(|renewed| SystemTime::now().duration_since(renewed));
        if matches!(age, Ok(Ok(age)) if age < STALE) {
            return;
        }
        let mut left = MAX_RENEWED;
        renew_below(&path, MAX_DEPTH, &mut left);
        touch(&self.base, true);
        // Last: says that it is done.
        touch(&path, true);
    }

    /// Whether it is there; as private as it has to be, as far as it is.
    pub(crate) fn look(&self) -> Result<bool, PlaceError> {
        for path in [&self.base, &self.path()] {
            match check_private(path) {
                Ok(()) => {}
                Err(PlaceError::Io { source, .. }) if source.kind() == io::ErrorKind::NotFound => {
                    return Ok(false);
                }
                Err(error) => return Err(error),
            }
        }
        Ok(true)
    }

    /// The domain's directory.
    pub(crate) fn path(&self) -> PathBuf {
        self.base.join(&self.domain)
    }

    /// The directory of one of the parts that keep files here.
    pub(crate) fn part(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    /// What the names of this domain's shared memory begin with: other users' domains, and those
    /// in other places, have other names.
    #[cfg_attr(
        not(feature = "shm"),
        expect(dead_code, reason = "there is no shared memory")
    )]
    pub(crate) fn prefix(&self) -> String {
        format!(
            "fipa_{}_{:08x}_",
            self.domain,
            fnv(self.path().as_os_str().as_encoded_bytes())
        )
    }

    /// What tells this host from others: the running kernel and the directory itself, so that
    /// containers and network namespaces with places of their own count as hosts.
    pub(crate) fn host_id(&self) -> io::Result<String> {
        if let Some(kept) = self.kept_host() {
            return Ok(kept);
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

    /// The identifier from before the directory was removed and joined again.
    fn kept_host(&self) -> Option<String> {
        let text = fs::read_to_string(self.path().join(HOST)).ok()?;
        let is_plain = text.bytes().all(|byte| byte.is_ascii_graphic());
        (is_plain && (1..=MAX_HOST).contains(&text.len())).then_some(text)
    }

    /// Whether nothing but the identifier of the host is left.
    fn is_empty_but_for_host(&self) -> bool {
        let mut names = fs::read_dir(self.path()).into_iter().flatten();
        names.all(|entry| entry.is_ok_and(|entry| entry.file_name() == HOST))
    }

    /// Removes what is empty. Not an error when somebody is still there.
    pub(crate) fn leave(&self) {
        // Fails when it is not empty or gone: then there is nothing to do here.
        let remove = |path: PathBuf| drop(fs::remove_dir(path));
        remove(self.part("directory"));
        remove(self.part("shm"));
        remove(self.part("unix"));
        if self.is_empty_but_for_host() {
            let _ = fs::remove_file(self.path().join(HOST));
        }
        remove(self.path());
        remove(self.base.clone());
    }
}

/// The 32-bit FNV-1a hash: short, and the same in every version of every program.
fn fnv(bytes: &[u8]) -> u32 {
    let step = |hash: u32, byte: &u8| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193);
    bytes.iter().fold(0x811c_9dc5, step)
}

/// Opens a directory and locks it, shared.
fn hold(path: &Path) -> Result<OwnedFd, PlaceError> {
    let io_error = |source| PlaceError::Io {
        path: path.to_owned(),
        source,
    };
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let directory =
        rustix::fs::open(path, flags, Mode::empty()).map_err(|error| io_error(error.into()))?;
    let began = Instant::now();
    loop {
        match rustix::fs::flock(&directory, FlockOperation::NonBlockingLockShared) {
            Ok(()) => break,
            Err(Errno::WOULDBLOCK) if began.elapsed() < LOCKING => {
                std::thread::sleep(Duration::from_millis(5));
            }
            // The process can do without: it joins again when the directory is removed.
            Err(error) => {
                tracing::warn!(
                    %error,
                    "cannot lock {}: cleaners of temporary files may remove it",
                    path.display()
                );
                break;
            }
        }
    }
    check_private(path)?;
    match is_same(&directory, path) {
        true => Ok(directory),
        false => Err(io_error(io::ErrorKind::NotFound.into())),
    }
}

/// Whether the path leads to this directory. What cannot be examined counts as the same.
fn is_same(directory: &OwnedFd, path: &Path) -> bool {
    let held = rustix::fs::fstat(directory);
    let found = rustix::fs::lstat(path);
    match (held, found) {
        (Ok(held), Ok(found)) => (held.st_dev, held.st_ino) == (found.st_dev, found.st_ino),
        (_, Err(Errno::NOENT | Errno::NOTDIR)) => false,
        _ => true,
    }
}

/// Renews timestamps of everything below a directory.
fn renew_below(directory: &Path, depth: usize, left: &mut usize) {
    let found = fs::read_dir(directory).into_iter().flatten().flatten();
    for entry in found {
        if *left == 0 {
            return;
        }
        *left -= 1;
        let path = entry.path();
        if depth > 0 && entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            renew_below(&path, depth - 1, left);
        }
        // Of a file with entries, the time of modification is its version.
        let is_versioned = path.extension().is_some_and(|end| end == "entries");
        touch(&path, !is_versioned);
    }
}

/// Sets the time of the last access, and that of the last modification if it may be changed.
fn touch(path: &Path, modification: bool) {
    let at = |tv_nsec| Timespec { tv_sec: 0, tv_nsec };
    let times = Timestamps {
        last_access: at(rustix::fs::UTIME_NOW),
        last_modification: at(match modification {
            true => rustix::fs::UTIME_NOW,
            false => rustix::fs::UTIME_OMIT,
        }),
    };
    // It may have gone meanwhile.
    let _ = rustix::fs::utimensat(CWD, path, &times, AtFlags::SYMLINK_NOFOLLOW);
}

fn make_private(path: &Path) -> Result<(), PlaceError> {
    let io_error = |source| PlaceError::Io {
        path: path.to_owned(),
        source,
    };
    match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(io_error(error)),
        _ => check_private(path),
    }
}

fn check_private(path: &Path) -> Result<(), PlaceError> {
    let io_error = |source| PlaceError::Io {
        path: path.to_owned(),
        source,
    };
    let metadata = fs::symlink_metadata(path).map_err(io_error)?;
    let problem = if metadata.is_symlink() {
        "it is a symbolic link".to_owned()
    } else if !metadata.is_dir() {
        "it is a file".to_owned()
    } else if metadata.uid() != rustix::process::geteuid().as_raw() {
        format!("it belongs to user {}", metadata.uid())
    } else if metadata.mode() & 0o077 != 0 {
        format!("its mode is {:03o}", metadata.mode() & 0o777)
    } else {
        return Ok(());
    };
    Err(PlaceError::NotPrivate {
        path: path.to_owned(),
        problem,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};

    #[test]
    fn what_others_could_enter_is_refused() {
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
            let error = make_private(path).unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
        let fresh = home.path().join("fresh");
        make_private(&fresh).unwrap();
        make_private(&fresh).unwrap();
        assert_eq!(fs::metadata(&fresh).unwrap().mode() & 0o777, 0o700);
    }

    #[test]
    fn prefixes_differ_by_domain_and_place() {
        let place = |base: &str, domain: &str| Place {
            base: base.into(),
            domain: domain.into(),
            held: None,
        };
        let all = [place("/a", "x"), place("/a", "y"), place("/b", "x")].map(|p| p.prefix());
        assert!(all[0] != all[1] && all[0] != all[2] && all[1] != all[2]);
        assert!(place("/a", &"d".repeat(32)).prefix().len() <= 64);
    }

    /// A place that is made, in a directory that goes away with the test.
    fn made() -> (tempfile::TempDir, Place) {
        let home = tempfile::tempdir().unwrap();
        let place = Place {
            base: home.path().join("base"),
            domain: "domain".to_owned(),
            held: None,
        };
        make_private(&place.base).unwrap();
        make_private(&place.path()).unwrap();
        (home, place)
    }

    fn is_locked(path: &Path) -> bool {
        let directory = fs::File::open(path).unwrap();
        let exclusive = FlockOperation::NonBlockingLockExclusive;
        rustix::fs::flock(&directory, exclusive) == Err(Errno::WOULDBLOCK)
    }

    #[test]
    fn both_levels_are_locked_and_made_again() {
        let (_home, mut place) = made();
        assert!(!is_locked(&place.base) && !is_locked(&place.path()));
        let host = place.host_id().unwrap();
        place.hold().unwrap();
        assert!(is_locked(&place.base) && is_locked(&place.path()));
        assert!(place.is_there());
        fs::remove_dir(place.path()).unwrap();
        // So that the file system does not give the same number to the next one.
        fs::create_dir(place.base.join("another")).unwrap();
        assert!(!place.is_there());
        place.rejoin().unwrap();
        assert!(place.is_there() && is_locked(&place.path()));
        // For processes that start now, too.
        assert_eq!(place.host_id().unwrap(), host);
        fs::remove_dir(place.base.join("another")).unwrap();
        place.leave();
        assert!(!place.base.exists());
    }

    #[test]
    fn a_directory_of_the_same_name_that_others_may_enter_is_not_joined() {
        let (_home, mut place) = made();
        place.hold().unwrap();
        fs::remove_dir(place.path()).unwrap();
        fs::create_dir(place.path()).unwrap();
        fs::set_permissions(place.path(), fs::Permissions::from_mode(0o755)).unwrap();
        let error = place.rejoin().unwrap_err();
        assert!(matches!(error, PlaceError::NotPrivate { .. }), "{error}");
    }

    #[test]
    fn timestamps_are_renewed_by_one_process_for_all() {
        let (_home, place) = made();
        let part = place.part("directory");
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
            for path in [&lock, &entries, &part, &place.path(), &place.base] {
                rustix::fs::utimensat(CWD, path, &times, AtFlags::empty()).unwrap();
            }
        };
        let is_old = |seconds: i64| seconds == 1000;
        old();
        place.renew();
        for path in [&lock, &part, &place.path(), &place.base] {
            let found = fs::metadata(path).unwrap();
            assert!(!is_old(found.atime()) && !is_old(found.mtime()), "{path:?}");
        }
        let found = fs::metadata(&entries).unwrap();
        assert!(!is_old(found.atime()), "a cleaner would remove it");
        assert!(is_old(found.mtime()), "its version has changed");
        // Another process that wakes later.
        old();
        touch(&place.path(), true);
        place.renew();
        assert!(is_old(fs::metadata(&lock).unwrap().mtime()));
    }
}
