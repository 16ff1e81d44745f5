//! Changes of files that survive a loss of power.
//!
//! A file system may lose what was not synced, and may keep later changes without earlier ones. So a file is written
//! under another name and synced before it gets its own, and its directory is synced before the call returns. A cut
//! within a call leaves the state before or after it. It may also leave a file with the suffix `.new`, which is never
//! read.
//!
//! This assumes that a rename is atomic, as on the journaling and copy-on-write file systems of Linux.
//!
//! Files and directories that root creates in a directory of another user get the owner and the group of that
//! directory: the user of a service can read the files that an operator writes with `sudo`.

#[cfg(test)]
pub(crate) mod cuts;

use std::ffi::OsString;
use std::fs::{self, File};
use std::io::{self, Write as _};
use std::os::unix::fs::{MetadataExt as _, fchown};
use std::path::{Path, PathBuf};

#[cfg(test)]
use cuts::{Step, record};
use rustix::fs::{Mode, OFlags, openat};
use rustix::process::geteuid;

/// Replaces a file, or creates it.
#[cfg(feature = "protocols")]
pub(crate) fn replace(path: &Path, bytes: &[u8], mode: u32) -> io::Result<()> {
    let new = write_beside(path, bytes, mode)?;
    or_remove(&new, rename_only(&new, path))?;
    sync_parent(path)
}

/// Creates a file.
///
/// # Errors
/// [`io::ErrorKind::AlreadyExists`] if the file exists.
#[cfg(any(feature = "secure", feature = "web"))]
pub(crate) fn create(path: &Path, bytes: &[u8], mode: u32) -> io::Result<()> {
    let new = write_beside(path, bytes, mode)?;
    or_remove(&new, link(&new, path))?;
    remove_only(&new)?;
    sync_parent(path)
}

/// Renames a file, and replaces another one of this name.
#[cfg(feature = "secure")]
pub(crate) fn rename(from: &Path, to: &Path) -> io::Result<()> {
    rename_only(from, to)?;
    sync_parent(to)?;
    match from.parent() == to.parent() {
        true => Ok(()),
        false => sync_parent(from),
    }
}

/// Removes a file.
#[cfg(feature = "secure")]
pub(crate) fn remove(path: &Path) -> io::Result<()> {
    remove_only(path)?;
    sync_parent(path)
}

/// Returns the user to whom a file belongs that this process creates with this path.
#[cfg(feature = "web")]
pub(crate) fn owner_of_new(path: &Path) -> io::Result<u32> {
    let directory = File::open(parent(path).unwrap_or(Path::new("/")))?;
    let owner = Owner::of_new_in(&directory)?;
    Ok(owner.map_or_else(|| geteuid().as_raw(), |owner| owner.user))
}

/// Creates a directory and those above it, unless they exist.
#[cfg(any(feature = "protocols", feature = "secure"))]
pub(crate) fn create_directories(path: &Path, mode: u32) -> io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    if let Some(parent) = parent(path) {
        create_directories(parent, mode)?;
    }
    match create_directory(path, mode) {
        Ok(()) => {}
        // Another process was faster.
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && path.is_dir() => {}
        Err(error) => return Err(error),
    }
    #[cfg(test)]
    record(Step::Directory(path.to_owned()));
    sync_parent(path)
}

/// Opens an empty file that processes lock, and creates it unless it exists. It is not synced.
#[cfg(feature = "protocols")]
pub(crate) fn lock_file(path: &Path) -> io::Result<File> {
    loop {
        match create_new(path, 0o666) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            created => return created,
        }
        match File::options().write(true).open(path) {
            // Another process has removed it.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            opened => return opened,
        }
    }
}

#[cfg(any(feature = "protocols", feature = "secure"))]
fn create_directory(path: &Path, mode: u32) -> io::Result<()> {
    use std::fs::DirBuilder;
    use std::os::unix::fs::DirBuilderExt as _;

    use rustix::fs::{RenameFlags, mkdirat, renameat_with};

    let parent = File::open(parent(path).unwrap_or(Path::new("/")))?;
    let (Some(owner), Some(name)) = (Owner::of_new_in(&parent)?, path.file_name()) else {
        return DirBuilder::new().mode(mode).create(path);
    };
    // A cut leaves no directory of root, which a repetition of the call would use.
    let new = unique(Path::new(name))?;
    mkdirat(&parent, &new, Mode::from_raw_mode(mode))?;
    let flags = OFlags::RDONLY | OFlags::DIRECTORY | OFlags::NOFOLLOW | OFlags::CLOEXEC;
    let directory = File::from(openat(&parent, &new, flags, Mode::empty())?);
    owner.give(&directory)?;
    directory.sync_all()?;
    let renamed = renameat_with(&parent, &new, &parent, name, RenameFlags::NOREPLACE);
    renamed.map_err(|error| {
        // The error is that of the rename.
        let _ = rustix::fs::unlinkat(&parent, &new, rustix::fs::AtFlags::REMOVEDIR);
        error.into()
    })
}

/// Writes and syncs a file beside this one, and returns its path.
fn write_beside(path: &Path, bytes: &[u8], mode: u32) -> io::Result<PathBuf> {
    let new = unique(path)?;
    let mut file = create_new(&new, mode)?;
    #[cfg(test)]
    record(Step::Write(new.clone(), bytes.to_owned()));
    or_remove(&new, file.write_all(bytes).and_then(|()| file.sync_all()))?;
    #[cfg(test)]
    record(Step::Sync(new.clone()));
    Ok(new)
}

/// A name that no other process uses, because another process may write the same file.
fn unique(path: &Path) -> io::Result<PathBuf> {
    let number = getrandom::u64().map_err(io::Error::other)?;
    let mut new = OsString::from(path);
    new.push(format!(".{number:016x}.new"));
    Ok(new.into())
}

/// Creates an empty file.
///
/// # Errors
/// [`io::ErrorKind::AlreadyExists`] if there is a file or a link of this name.
fn create_new(path: &Path, mode: u32) -> io::Result<File> {
    let name = path.file_name().ok_or(io::ErrorKind::InvalidInput)?;
    // The owner of the directory can replace it meanwhile: the file is created in the one that was examined.
    let directory = File::open(parent(path).unwrap_or(Path::new("/")))?;
    let flags = OFlags::WRONLY | OFlags::CREATE | OFlags::EXCL | OFlags::CLOEXEC;
    let file = File::from(openat(&directory, name, flags, Mode::from_raw_mode(mode))?);
    if let Some(owner) = Owner::of_new_in(&directory)? {
        or_remove(path, owner.give(&file))?;
    }
    Ok(file)
}

/// A user other than root, and a group.
struct Owner {
    user: u32,
    group: u32,
}

impl Owner {
    /// Returns the owner of new files in this directory, unless the kernel sets it: if this process is root, the
    /// owner of the directory.
    fn of_new_in(directory: &File) -> io::Result<Option<Self>> {
        if !geteuid().is_root() {
            return Ok(None);
        }
        let meta = directory.metadata()?;
        let (user, group) = (meta.uid(), meta.gid());
        Ok((user != 0).then_some(Self { user, group }))
    }

    fn give(&self, file: &File) -> io::Result<()> {
        fchown(file, Some(self.user), Some(self.group))
    }
}

/// Removes an unfinished file after an error.
fn or_remove<T>(new: &Path, result: io::Result<T>) -> io::Result<T> {
    if result.is_err() {
        // The error is that of the result.
        let _ = fs::remove_file(new);
    }
    result
}

#[cfg(any(feature = "protocols", feature = "secure"))]
fn rename_only(from: &Path, to: &Path) -> io::Result<()> {
    fs::rename(from, to)?;
    #[cfg(test)]
    record(Step::Rename(from.to_owned(), to.to_owned()));
    Ok(())
}

#[cfg(any(feature = "secure", feature = "web"))]
fn link(from: &Path, to: &Path) -> io::Result<()> {
    fs::hard_link(from, to)?;
    #[cfg(test)]
    record(Step::Link(from.to_owned(), to.to_owned()));
    Ok(())
}

#[cfg(any(feature = "secure", feature = "web"))]
fn remove_only(path: &Path) -> io::Result<()> {
    fs::remove_file(path)?;
    #[cfg(test)]
    record(Step::Remove(path.to_owned()));
    Ok(())
}

fn sync_parent(path: &Path) -> io::Result<()> {
    let Some(parent) = parent(path) else {
        return Ok(());
    };
    File::open(parent)?.sync_all()?;
    #[cfg(test)]
    record(Step::SyncDirectory(parent.to_owned()));
    Ok(())
}

/// The directory of a path. That of a relative path with one component is the working directory.
fn parent(path: &Path) -> Option<&Path> {
    let parent = path.parent()?;
    Some(match parent.as_os_str().is_empty() {
        true => Path::new("."),
        false => parent,
    })
}
