//! The users whose processes share the files of a domain, and the directories of these files.

use std::fs::DirBuilder;
use std::io;
use std::os::fd::{AsFd, AsRawFd as _, OwnedFd};
use std::os::unix::fs::DirBuilderExt as _;
use std::path::{Path, PathBuf};

use rustix::fs::{AtFlags, CWD, FileType, Gid, Mode, OFlags, RenameFlags, Stat};
use rustix::io::Errno;

/// Mode of a file of this user.
const OWN_FILE: Mode = Mode::RUSR.union(Mode::WUSR);

/// Mode of a file of a group.
const SHARED_FILE: Mode = OWN_FILE.union(Mode::RGRP).union(Mode::WGRP);

/// Mode of a file of this user that a group can read.
const READABLE_FILE: Mode = OWN_FILE.union(Mode::RGRP);

/// Mode of a directory of a group. No sticky bit, because the processes that run remove the files of those that
/// were killed.
const SHARED_DIRECTORY: Mode = Mode::RWXU.union(Mode::RWXG);

/// The users whose processes share the files of a domain on one host.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum DomainUsers {
    /// The user of this process. Directories have mode 0700, files and sockets 0600.
    #[default]
    This,
    /// The members of the group with this number. Directories have mode 0770, files and sockets 0660, whatever the
    /// umask is, and all have this group.
    ///
    /// A directory of the group inside another one was created by a member, because only members enter the outer
    /// one. So the outermost directory needs a check of its owner, too.
    Group(u32),
}

/// The reason why other users could enter a directory, or change it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum Intrusion {
    /// It is no directory.
    #[error("it is a symbolic link or a file, not a directory")]
    NoDirectory,
    /// It belongs to another user.
    #[error("it belongs to user {0}")]
    Owner(u32),
    /// It belongs to another group.
    #[error("it belongs to group {found}, not to {expected}")]
    Group {
        /// The group of the directory.
        found: u32,
        /// The group of the domain.
        expected: u32,
    },
    /// The permissions of the directory, of which [`DomainUsers`] does not allow all.
    #[error("its mode is {0:03o}, with which other users can enter it")]
    Mode(u32),
}

/// The error if a directory cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DirectoryError {
    /// Other users could enter the directory, or change it.
    #[error("{} must not be open to other users: {intrusion}", path.display())]
    NotPrivate {
        /// The directory.
        path: PathBuf,
        /// The reason.
        intrusion: Intrusion,
    },
    /// An operation of the operating system failed.
    #[error("cannot {what} {}", path.display())]
    Io {
        /// The operation, as a verb.
        what: &'static str,
        /// The directory.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
}

impl DomainUsers {
    /// Opens a directory, and creates it if it is missing, in a directory that exists.
    ///
    /// # Errors
    /// If other users could enter or change the directory, or it cannot be created or opened.
    pub fn create_directory(self, path: &Path) -> Result<OwnedFd, DirectoryError> {
        let created = match self {
            Self::This => DirBuilder::new().mode(0o700).create(path),
            Self::Group(_) => self.create_shared(path),
        };
        match created {
            Err(error) if error.kind() != io::ErrorKind::AlreadyExists => {
                Err(io_error("create", path)(error))
            }
            // An existing entry is checked next.
            _ => self.open_directory(path),
        }
    }

    /// Opens a directory, relative to which its files are used afterwards: it stays the one that was examined.
    ///
    /// # Errors
    /// If other users could enter or change the directory, or it cannot be opened.
    pub fn open_directory(self, path: &Path) -> Result<OwnedFd, DirectoryError> {
        let not_private = |intrusion| DirectoryError::NotPrivate {
            path: path.to_owned(),
            intrusion,
        };
        let directory = match open(path) {
            Ok(directory) => directory,
            Err(Errno::LOOP | Errno::NOTDIR) => return Err(not_private(Intrusion::NoDirectory)),
            Err(error) => {
                // That the directory belongs to another user says more than that this user may not open it.
                if let (Errno::ACCESS, Ok(found)) = (error, rustix::fs::lstat(path)) {
                    self.check(&found).map_err(not_private)?;
                }
                return Err(io_error("open", path)(error.into()));
            }
        };
        let found = rustix::fs::fstat(&directory);
        let found = found.map_err(|error| io_error("examine", path)(error.into()))?;
        self.check(&found).map_err(not_private)?;
        Ok(directory)
    }

    /// Checks that only these users can enter or change a directory.
    fn check(self, found: &Stat) -> Result<(), Intrusion> {
        let others = match self {
            Self::This if found.st_uid != this_user() => {
                return Err(Intrusion::Owner(found.st_uid));
            }
            Self::Group(expected) if found.st_gid != expected => {
                let found = found.st_gid;
                return Err(Intrusion::Group { found, expected });
            }
            Self::This => Mode::RWXG | Mode::RWXO,
            Self::Group(_) => Mode::RWXO,
        };
        let mode = Mode::from_raw_mode(found.st_mode);
        match mode.intersects(others) {
            true => Err(Intrusion::Mode((mode & !Mode::SVTX).as_raw_mode())),
            false => Ok(()),
        }
    }

    /// Whether a file in a directory of these users belongs to them.
    #[must_use]
    pub fn own(self, found: &Stat) -> bool {
        match self {
            Self::This => found.st_uid == this_user(),
            Self::Group(group) => found.st_gid == group,
        }
    }

    /// Whether a process of this user may be the peer at a socket in a directory of these users, as the kernel names
    /// the user (`SO_PEERCRED`). Only members of a group reach its sockets.
    #[must_use]
    pub fn admit(self, user: u32) -> bool {
        match self {
            Self::This => user == this_user(),
            Self::Group(_) => true,
        }
    }

    /// Creates a file, relative to a directory. It must not exist.
    ///
    /// # Errors
    /// The error of the operating system.
    pub fn create_file(self, directory: impl AsFd, name: &str) -> io::Result<OwnedFd> {
        self.create(directory, name, SHARED_FILE)
    }

    /// Creates a file that only this user may write to, at any time. The other members of a group can read it.
    ///
    /// # Errors
    /// As for [`create_file`](Self::create_file).
    pub fn create_readable_file(self, directory: impl AsFd, name: &str) -> io::Result<OwnedFd> {
        self.create(directory, name, READABLE_FILE)
    }

    /// Creates a file, which has this mode if a group shares it.
    fn create(self, directory: impl AsFd, name: &str, shared: Mode) -> io::Result<OwnedFd> {
        let flags = OFlags::RDWR | OFlags::CREATE | OFlags::EXCL | OFlags::CLOEXEC;
        let file = rustix::fs::openat(&directory, name, flags, OWN_FILE)?;
        if let Err(error) = self.share(&file, shared) {
            // The first error is the one to return.
            let _ = rustix::fs::unlinkat(&directory, name, AtFlags::empty());
            return Err(error.into());
        }
        Ok(file)
    }

    /// Opens a socket that this process has just created to these users.
    ///
    /// # Errors
    /// The error of the operating system.
    pub fn share_socket(self, directory: impl AsFd, name: &str) -> io::Result<()> {
        // Another member of the group may put a link to any file of this user in the place of the socket.
        let flags = OFlags::PATH | OFlags::NOFOLLOW | OFlags::CLOEXEC;
        let socket = rustix::fs::openat(directory, name, flags, Mode::empty())?;
        let found = rustix::fs::fstat(&socket)?;
        let is_socket = FileType::from_raw_mode(found.st_mode) == FileType::Socket;
        if !is_socket || found.st_uid != this_user() {
            let what = "another process has replaced the socket";
            return Err(io::Error::new(io::ErrorKind::PermissionDenied, what));
        }
        let path = format!("/proc/self/fd/{}", socket.as_raw_fd());
        let mode = match self {
            Self::This => OWN_FILE,
            Self::Group(group) => {
                rustix::fs::chownat(
                    CWD,
                    &path,
                    None,
                    Some(Gid::from_raw(group)),
                    AtFlags::empty(),
                )?;
                SHARED_FILE
            }
        };
        Ok(rustix::fs::chmodat(CWD, &path, mode, AtFlags::empty())?)
    }

    /// Opens a private directory of this user to its group, if that is the group of the domain. Does nothing for any
    /// other directory.
    ///
    /// # Errors
    /// The error of the operating system.
    pub fn open_to_group(self, path: &Path) -> io::Result<()> {
        let directory = open(path)?;
        let found = rustix::fs::fstat(&directory)?;
        let is_private = Mode::from_raw_mode(found.st_mode) & !Mode::SGID == Mode::RWXU;
        if self == Self::Group(found.st_gid) && found.st_uid == this_user() && is_private {
            rustix::fs::fchmod(&directory, SHARED_DIRECTORY)?;
        }
        Ok(())
    }

    /// Gives a file or directory of this process to the group.
    fn share(self, file: impl AsFd, mode: Mode) -> rustix::io::Result<()> {
        let Self::Group(group) = self else {
            return Ok(());
        };
        let found = rustix::fs::fstat(&file)?;
        if found.st_gid != group {
            rustix::fs::fchown(&file, None, Some(Gid::from_raw(group)))?;
        }
        // An administrator may have set the bit by which new files get the group.
        if Mode::from_raw_mode(found.st_mode) & !Mode::SGID != mode {
            rustix::fs::fchmod(&file, mode)?;
        }
        Ok(())
    }

    /// Creates a directory that the members of the group can use from the moment at which it has its name.
    fn create_shared(self, path: &Path) -> io::Result<()> {
        match rustix::fs::lstat(path) {
            Err(Errno::NOENT) => {}
            Err(error) => return Err(error.into()),
            Ok(_) => return Err(io::ErrorKind::AlreadyExists.into()),
        }
        let number = getrandom::u64().map_err(io::Error::other)?;
        let unfinished = path.with_file_name(format!(".{number:016x}"));
        DirBuilder::new().mode(0o700).create(&unfinished)?;
        let created = open(&unfinished)
            .and_then(|directory| self.share(&directory, SHARED_DIRECTORY))
            .and_then(|()| {
                rustix::fs::renameat_with(CWD, &unfinished, CWD, path, RenameFlags::NOREPLACE)
            });
        if created.is_err() {
            // The first error is the one to return.
            let _ = std::fs::remove_dir(&unfinished);
        }
        Ok(created?)
    }
}

fn open(path: &Path) -> rustix::io::Result<OwnedFd> {
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    rustix::fs::open(path, flags, Mode::empty())
}

fn io_error(what: &'static str, path: &Path) -> impl FnOnce(io::Error) -> DirectoryError {
    let path = path.to_owned();
    move |source| DirectoryError::Io { what, path, source }
}

fn this_user() -> u32 {
    rustix::process::geteuid().as_raw()
}

#[cfg(test)]
mod tests {
    use std::fs::{self, Permissions};
    use std::os::unix::fs::{MetadataExt as _, PermissionsExt as _, symlink};
    use std::os::unix::net::UnixListener;

    use super::*;

    fn this_group() -> u32 {
        rustix::process::getegid().as_raw()
    }

    fn mode(path: &Path) -> u32 {
        fs::symlink_metadata(path).unwrap().mode() & 0o7777
    }

    #[test]
    fn directories_and_files_are_open_to_their_users_only() {
        let home = tempfile::tempdir().unwrap();
        for (users, name, modes, readable) in [
            (DomainUsers::This, "own", (0o700, 0o600), 0o600),
            (
                DomainUsers::Group(this_group()),
                "shared",
                (0o770, 0o660),
                0o640,
            ),
        ] {
            let path = home.path().join(name);
            let directory = users.create_directory(&path).unwrap();
            users.create_directory(&path).unwrap();
            users.create_file(&directory, "file").unwrap();
            let error = users.create_file(&directory, "file").unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::AlreadyExists);
            let _listener = UnixListener::bind(path.join("socket")).unwrap();
            users.share_socket(&directory, "socket").unwrap();
            assert_eq!((mode(&path), mode(&path.join("file"))), modes);
            assert_eq!(mode(&path.join("socket")), modes.1);
            users.create_readable_file(&directory, "readable").unwrap();
            assert_eq!(mode(&path.join("readable")), readable);
            let found = rustix::fs::statat(&directory, "file", AtFlags::empty()).unwrap();
            assert!(users.own(&found));
        }
        // Nothing unfinished is left.
        assert_eq!(fs::read_dir(home.path()).unwrap().count(), 2);
    }

    #[test]
    fn a_directory_that_others_could_enter_is_refused() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("directory");
        let link = home.path().join("link");
        symlink(home.path(), &link).unwrap();
        fs::write(home.path().join("file"), "").unwrap();
        fs::create_dir(&path).unwrap();
        let group = this_group();
        let shared = DomainUsers::Group(group);
        let refused = |users: DomainUsers, path: &Path| match users.create_directory(path) {
            Err(DirectoryError::NotPrivate { intrusion, .. }) => intrusion,
            other => panic!("{other:?}"),
        };
        for users in [DomainUsers::This, shared] {
            fs::set_permissions(&path, Permissions::from_mode(0o771)).unwrap();
            assert_eq!(refused(users, &path), Intrusion::Mode(0o771));
            assert_eq!(refused(users, &link), Intrusion::NoDirectory);
            assert_eq!(
                refused(users, &home.path().join("file")),
                Intrusion::NoDirectory
            );
        }
        fs::set_permissions(&path, Permissions::from_mode(0o770)).unwrap();
        assert_eq!(refused(DomainUsers::This, &path), Intrusion::Mode(0o770));
        let expected = group.wrapping_add(1);
        let other = DomainUsers::Group(expected);
        let found = group;
        assert_eq!(refused(other, &path), Intrusion::Group { found, expected });
        shared.create_directory(&path).unwrap();
    }

    #[test]
    fn a_private_directory_is_opened_to_the_group_that_it_has() {
        let home = tempfile::tempdir().unwrap();
        let opened = |before: u32, users: DomainUsers| {
            fs::set_permissions(home.path(), Permissions::from_mode(before)).unwrap();
            users.open_to_group(home.path()).unwrap();
            mode(home.path())
        };
        let group = this_group();
        assert_eq!(opened(0o700, DomainUsers::This), 0o700);
        assert_eq!(
            opened(0o700, DomainUsers::Group(group.wrapping_add(1))),
            0o700
        );
        assert_eq!(opened(0o755, DomainUsers::Group(group)), 0o755);
        assert_eq!(opened(0o700, DomainUsers::Group(group)), 0o770);
    }

    #[test]
    fn a_link_in_the_place_of_a_socket_opens_no_file() {
        let home = tempfile::tempdir().unwrap();
        let users = DomainUsers::Group(this_group());
        let directory = users.create_directory(&home.path().join("shared")).unwrap();
        let key = home.path().join("key");
        fs::write(&key, "").unwrap();
        fs::set_permissions(&key, Permissions::from_mode(0o600)).unwrap();
        symlink(&key, home.path().join("shared/socket")).unwrap();
        users.share_socket(&directory, "socket").unwrap_err();
        assert_eq!(mode(&key), 0o600);
    }
}
