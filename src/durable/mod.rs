//! Changes of files that survive a loss of power.
//!
//! A file system may lose what was not synced, and may keep later changes without earlier ones. So a file is written
//! under another name and synced before it gets its own, and its directory is synced before the call returns. A cut
//! within a call leaves the state before or after it. It may also leave a file with the suffix `.new`, which is never
//! read.
//!
//! This assumes that a rename is atomic, as on the journaling and copy-on-write file systems of Linux.

#[cfg(test)]
pub(crate) mod cuts;

use std::ffi::OsString;
use std::fs::{self, DirBuilder, File};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};

#[cfg(test)]
use cuts::{Step, record};

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
#[cfg(feature = "secure")]
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

/// Creates a directory and those above it, unless they exist.
pub(crate) fn create_directories(path: &Path, mode: u32) -> io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    if let Some(parent) = parent(path) {
        create_directories(parent, mode)?;
    }
    match DirBuilder::new().mode(mode).create(path) {
        Ok(()) => {}
        // Another process was faster.
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && path.is_dir() => {}
        Err(error) => return Err(error),
    }
    #[cfg(test)]
    record(Step::Directory(path.to_owned()));
    sync_parent(path)
}

/// Writes and syncs a file beside this one, and returns its path.
fn write_beside(path: &Path, bytes: &[u8], mode: u32) -> io::Result<PathBuf> {
    // A name of its own, because another process may write the same file.
    let number = getrandom::u64().map_err(io::Error::other)?;
    let mut new = OsString::from(path);
    new.push(format!(".{number:016x}.new"));
    let new = PathBuf::from(new);
    let mut options = File::options();
    let mut file = options.write(true).create_new(true).mode(mode).open(&new)?;
    #[cfg(test)]
    record(Step::Write(new.clone(), bytes.to_owned()));
    or_remove(&new, file.write_all(bytes).and_then(|()| file.sync_all()))?;
    #[cfg(test)]
    record(Step::Sync(new.clone()));
    Ok(new)
}

/// Removes an unfinished file after an error.
fn or_remove<T>(new: &Path, result: io::Result<T>) -> io::Result<T> {
    if result.is_err() {
        // The error is that of the result.
        let _ = fs::remove_file(new);
    }
    result
}

fn rename_only(from: &Path, to: &Path) -> io::Result<()> {
    fs::rename(from, to)?;
    #[cfg(test)]
    record(Step::Rename(from.to_owned(), to.to_owned()));
    Ok(())
}

#[cfg(feature = "secure")]
fn link(from: &Path, to: &Path) -> io::Result<()> {
    fs::hard_link(from, to)?;
    #[cfg(test)]
    record(Step::Link(from.to_owned(), to.to_owned()));
    Ok(())
}

#[cfg(feature = "secure")]
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
