//! The directory of all domains of a user below `/tmp`.
//!
//! It is `/tmp/fipa-<uid>`. Every user may create files in `/tmp`, so another user may hold that name. It may do so
//! with a file of this user: depending on the system, it can link a file of any user to a name in `/tmp`.
//! Then the directory is `/tmp/fipa-<uid>.<16 hexadecimal digits>`: any process of the user finds it by its name and
//! owner. Only root can remove the directory of another user from `/tmp`, and no process of a domain
//! removes it, so a user that has it keeps it until the host starts again.

use std::fmt;
use std::fs::{self, DirBuilder, Metadata};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use fipa_transport::log_limit;
use rustix::fs::{FlockOperation, Mode, OFlags};

use super::accounts::user_name;

/// Length of the end of another name, in hexadecimal digits.
const DIGITS: usize = 16;

/// Time to wait for another process that chooses the directory. Another user may hold the lock, too.
const LOCK_TIMEOUT: Duration = Duration::from_secs(1);

/// Maximum number of files in `/tmp` that are examined. Any user may create more; then no other name is chosen,
/// because processes could choose different ones.
const MAX_FILES: usize = 262_144;

/// The directory of all domains of a user.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct UserDir {
    /// The directory, which may not exist unless its first name is held.
    pub(crate) path: PathBuf,
    /// The holder of the name `fipa-<uid>`, unless it is a directory of this user.
    pub(crate) name_held_by: Option<Holder>,
}

/// The holder of a name.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Holder {
    /// Another user.
    User(u32),
    /// A file of this user, to which another user may have given the name.
    File,
}

impl fmt::Display for Holder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::User(user) => f.write_str(&user_name(*user)),
            Self::File => f.write_str("a file of this user that is not a directory"),
        }
    }
}

impl UserDir {
    /// Finds the directory. Creates it only if the name `fipa-<uid>` is held. If that fails, the result is
    /// the file with this name, which cannot be used.
    pub(crate) fn find(temporary: &Path, user: u32) -> Self {
        let first = temporary.join(format!("fipa-{user}"));
        let found = fs::symlink_metadata(&first);
        let name_held_by = match &found {
            Ok(found) if found.uid() != user => Some(Holder::User(found.uid())),
            Ok(found) if found.is_dir() => return Self::free(first),
            Ok(_) => Some(Holder::File),
            Err(_) => None,
        };
        let other = match (other(temporary, user, MAX_FILES), name_held_by) {
            (Ok(Some(other)), _) => Ok(other),
            (_, None) => return Self::free(first),
            (Ok(None), Some(_)) => create_other(temporary, user),
            (Err(error), Some(_)) => Err(error),
        };
        let path = other.unwrap_or_else(|error| {
            log_limit::error!(
                %error,
                "cannot find or create a directory for the domains of this user in {}",
                temporary.display()
            );
            first
        });
        Self { path, name_held_by }
    }

    fn free(path: PathBuf) -> Self {
        Self {
            path,
            name_held_by: None,
        }
    }
}

/// Returns the user in the name of a directory of domains.
pub(crate) fn user_in(name: &str) -> Option<u32> {
    let rest = name.strip_prefix("fipa-")?;
    let user = match rest.split_once('.') {
        None => rest,
        Some((user, digits)) => {
            let is_number = digits.bytes().all(|digit| digit.is_ascii_hexdigit());
            (digits.len() == DIGITS && is_number).then_some(user)?
        }
    };
    user.parse().ok()
}

/// Returns the directory with another name. Of several, which processes have created at the same time, all
/// choose the first in the order of names.
///
/// # Errors
/// Fails when the directory cannot be read, or has more than `most` files.
fn other(temporary: &Path, user: u32, most: usize) -> io::Result<Option<PathBuf>> {
    let is_private =
        |found: &Metadata| found.is_dir() && found.uid() == user && found.mode() & 0o077 == 0;
    let mut first: Option<PathBuf> = None;
    for (index, entry) in fs::read_dir(temporary)?.enumerate() {
        if index >= most {
            let text =
                format!("there are more than {most} files; remove files that are not needed");
            return Err(io::Error::other(text));
        }
        let Ok(entry) = entry else { continue };
        let name = entry.file_name();
        let is_named = |name: &str| user_in(name) == Some(user) && name.contains('.');
        if name.to_str().is_some_and(is_named)
            && entry.metadata().is_ok_and(|found| is_private(&found))
        {
            let path = entry.path();
            first = Some(first.map_or(path.clone(), |first| first.min(path)));
        }
    }
    Ok(first)
}

fn create_other(temporary: &Path, user: u32) -> io::Result<PathBuf> {
    // Two processes that start at the same time create one directory. Without the lock, they may use
    // different ones until the next start.
    let _lock = lock(temporary);
    if let Some(other) = other(temporary, user, MAX_FILES)? {
        return Ok(other);
    }
    let digits = getrandom::u64().map_err(io::Error::other)?;
    let path = temporary.join(format!("fipa-{user}.{digits:0DIGITS$x}"));
    DirBuilder::new().mode(0o700).create(&path)?;
    Ok(other(temporary, user, MAX_FILES)?.unwrap_or(path))
}

/// Locks a directory until the result is dropped. `None` after the timeout.
fn lock(directory: &Path) -> Option<rustix::fd::OwnedFd> {
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::CLOEXEC;
    let opened = rustix::fs::open(directory, flags, Mode::empty()).ok()?;
    let began = Instant::now();
    loop {
        match rustix::fs::flock(&opened, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => return Some(opened),
            Err(_) if began.elapsed() < LOCK_TIMEOUT => {
                std::thread::sleep(Duration::from_millis(5));
            }
            Err(_) => return None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::{PermissionsExt, symlink};

    fn this_user() -> u32 {
        rustix::process::geteuid().as_raw()
    }

    /// Creates a name of another user: for a user that this process is not, each file is one.
    fn hold(temporary: &Path, user: u32) {
        fs::create_dir(temporary.join(format!("fipa-{user}"))).unwrap();
    }

    #[test]
    fn the_name_is_that_of_the_user_unless_another_user_holds_it() {
        let temporary = tempfile::tempdir().unwrap();
        let temporary = temporary.path();
        let user = this_user();
        let own = temporary.join(format!("fipa-{user}"));
        assert_eq!(UserDir::find(temporary, user), UserDir::free(own.clone()));
        hold(temporary, user);
        assert_eq!(UserDir::find(temporary, user), UserDir::free(own));
        // To any other user, this user is another one.
        let another = user.wrapping_add(1);
        hold(temporary, another);
        let found = UserDir::find(temporary, another);
        assert_eq!(found.name_held_by, Some(Holder::User(user)));
        let name = found.path.file_name().unwrap().to_str().unwrap();
        assert_eq!(user_in(name), Some(another));
        assert!(found.path.is_dir());
    }

    #[test]
    fn a_file_of_the_user_that_another_user_linked_there_does_not_block_the_directory() {
        let user = this_user();
        for is_link in [false, true] {
            let temporary = tempfile::tempdir().unwrap();
            let temporary = temporary.path();
            let first = temporary.join(format!("fipa-{user}"));
            let file = temporary.join("notes");
            fs::write(&file, "").unwrap();
            match is_link {
                true => symlink(&file, &first).unwrap(),
                false => fs::hard_link(&file, &first).unwrap(),
            }
            let found = UserDir::find(temporary, user);
            assert_eq!(found.name_held_by, Some(Holder::File));
            assert!(found.path.is_dir() && found.path != first);
            assert_eq!(UserDir::find(temporary, user), found);
            // After the user has removed the file, processes meet those that run.
            fs::remove_file(&first).unwrap();
            assert_eq!(UserDir::find(temporary, user).path, found.path);
        }
    }

    #[test]
    fn a_directory_with_another_name_is_found_again() {
        let temporary = tempfile::tempdir().unwrap();
        let temporary = temporary.path();
        let user = this_user();
        let (first, second) = ("0000000000000001", "00000000000000ff");
        let named = |digits: &str| temporary.join(format!("fipa-{user}.{digits}"));
        for path in [named(second), named(first)] {
            DirBuilder::new().mode(0o700).create(path).unwrap();
        }
        // Also after the other user has removed its own.
        assert_eq!(UserDir::find(temporary, user).path, named(first));
        // A directory that other users could enter, or a link, is not used.
        fs::set_permissions(named(first), fs::Permissions::from_mode(0o755)).unwrap();
        assert_eq!(UserDir::find(temporary, user).path, named(second));
        fs::remove_dir(named(second)).unwrap();
        symlink("/", named(second)).unwrap();
        let own = temporary.join(format!("fipa-{user}"));
        assert_eq!(UserDir::find(temporary, user).path, own);
    }

    #[test]
    fn the_number_of_files_that_are_examined_is_bounded() {
        let temporary = tempfile::tempdir().unwrap();
        let temporary = temporary.path();
        let user = this_user();
        let own = temporary.join(format!("fipa-{user}.0000000000000001"));
        DirBuilder::new().mode(0o700).create(&own).unwrap();
        for name in 0..4 {
            fs::write(temporary.join(name.to_string()), "").unwrap();
        }
        assert_eq!(other(temporary, user, 5).unwrap(), Some(own));
        other(temporary, user, 4).unwrap_err();
    }

    #[test]
    fn processes_that_start_at_the_same_time_choose_one_directory() {
        let temporary = tempfile::tempdir().unwrap();
        let directory = temporary.path().to_owned();
        // As for a user whose name another user holds.
        let user = this_user();
        let create = || {
            let directory = directory.clone();
            std::thread::spawn(move || create_other(&directory, user).unwrap())
        };
        let threads: Vec<_> = std::iter::repeat_with(create).take(16).collect();
        let mut chosen = threads.into_iter().map(|it| it.join().unwrap());
        let first = chosen.next().unwrap();
        assert!(chosen.all(|path| path == first));
    }

    #[test]
    fn the_user_is_read_from_the_name() {
        for (name, user) in [
            ("fipa-1000", Some(1000)),
            ("fipa-0.0123456789abcdef", Some(0)),
            ("fipa-0.0123456789abcde", None),
            ("fipa-0.0123456789abcdex", None),
            ("fipa-demo-17", None),
            ("other-1000", None),
        ] {
            assert_eq!(user_in(name), user, "{name}");
        }
    }
}
