//! The state files of owners.
//!
//! The path is `<state directory>/locks/<domain>/<agent>/<resource>`, with names percent-encoded. A
//! file beside it with the suffix `.lock` is locked while the agent owns the resource.

use std::ffi::OsString;
use std::fmt::Write as _;
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use fipa_locking::{Millis, OwnerState, OwnerStateError};
use fipa_transport::log_limit;

use crate::durable;

/// Environment variable with the state directory.
const VARIABLE: &str = "FIPA_STATE_DIR";

/// Wait for the file of an owner of this process that is being closed.
const TIMEOUT: Duration = Duration::from_secs(2);
const PAUSE: Duration = Duration::from_millis(5);

/// The error of using the state file of an owner.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum StateFileError {
    /// There is no state directory.
    #[error(
        "no state directory: neither FIPA_STATE_DIR nor XDG_STATE_HOME nor HOME is set; set one, or \
         own the resource without a state file (volatile)"
    )]
    NoDirectory,
    /// The file cannot be read or written.
    #[error(
        "cannot use the state file {}; fences have to rise over restarts, so make it writable, set \
         FIPA_STATE_DIR, or own the resource without a state file (volatile)",
        path.display()
    )]
    Io {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// Another process uses the file.
    #[error("another owner uses the state file {}; stop it", path.display())]
    InUse {
        /// The file.
        path: PathBuf,
    },
    /// The file has other content.
    #[error("{}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The first mistake.
        source: OwnerStateError,
    },
}

/// The state file of one life of an owner. Other processes cannot use it until this value is dropped.
#[derive(Debug)]
pub(super) struct StateFile {
    path: PathBuf,
    state: OwnerState,
    _lock: File,
}

impl StateFile {
    /// Begins a life whose leases are at most `lease`: raises the epoch, and syncs the file. Blocks.
    ///
    /// Without a file, the life begins with `without_file`. If that life needs a report, the file is written
    /// when [`raise`](Self::raise) has an epoch: otherwise the next start would take it for a memory.
    pub(super) fn begin(
        directory: Option<&Path>,
        names: [&str; 3],
        lease: Millis,
        without_file: OwnerState,
        seconds: Option<u64>,
    ) -> Result<Self, StateFileError> {
        let directory = match directory {
            Some(directory) => directory.to_owned(),
            None => default_directory(|name| std::env::var_os(name))
                .ok_or(StateFileError::NoDirectory)?,
        };
        let mut path = directory.join("locks");
        path.extend(names.map(encoded));
        let failed = |source| StateFileError::Io {
            path: path.clone(),
            source,
        };
        let parent = path.parent().unwrap_or(&directory);
        durable::create_directories(parent, 0o700).map_err(failed)?;
        let lock = durable::lock_file(&with_suffix(&path, ".lock")).map_err(failed)?;
        let started = Instant::now();
        while let Err(error) = lock.try_lock() {
            match error {
                TryLockError::WouldBlock if started.elapsed() < TIMEOUT => {
                    std::thread::sleep(PAUSE);
                }
                TryLockError::WouldBlock => return Err(StateFileError::InUse { path }),
                TryLockError::Error(source) => return Err(failed(source)),
            }
        }
        let life = match fs::read_to_string(&path) {
            Ok(text) => {
                let before: OwnerState =
                    text.parse().map_err(|source| StateFileError::Content {
                        path: path.clone(),
                        source,
                    })?;
                before.next_life(lease)
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => without_file,
            Err(source) => return Err(failed(source)),
        };
        let state = life.with_clock(seconds);
        if !state.needs_report() {
            write(&path, &state).map_err(failed)?;
        }
        Ok(Self {
            state,
            path,
            _lock: lock,
        })
    }

    /// The state of this life.
    pub(super) fn state(&self) -> OwnerState {
        self.state
    }

    /// Raises the epoch of this life, and syncs the file. Blocks.
    pub(super) fn raise(&mut self, epoch: u64) -> io::Result<()> {
        let state = self.state.raised(epoch);
        write(&self.path, &state)?;
        self.state = state;
        Ok(())
    }

    /// Ends the life. The next life grants at once if no grant is live now. Blocks.
    pub(super) fn end(&mut self, none_is_live: bool) {
        if !none_is_live || self.state.needs_report() {
            return;
        }
        if let Err(error) = write(&self.path, &self.state.closed()) {
            log_limit::warn!(
                %error, path = %self.path.display(),
                "cannot write the state of an owner; its next start waits for the longest lease"
            );
        }
    }
}

/// Returns the state directory of this user.
fn default_directory(variable: impl Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let set = |name| variable(name).filter(|value| !value.is_empty());
    if let Some(directory) = set(VARIABLE) {
        return Some(directory.into());
    }
    if let Some(directory) = set("XDG_STATE_HOME") {
        return Some(PathBuf::from(directory).join("fipa"));
    }
    Some(PathBuf::from(set("HOME")?).join(".local/state/fipa"))
}

/// Replaces the file. After a loss of power it has the old or the new state.
fn write(path: &Path, state: &OwnerState) -> io::Result<()> {
    durable::replace(path, state.to_string().as_bytes(), 0o600)
}

fn with_suffix(path: &Path, suffix: &str) -> PathBuf {
    let mut path = OsString::from(path);
    path.push(suffix);
    path.into()
}

/// Encodes a name as one component of a path. No two names have the same code, and no code ends with
/// the suffix of another file.
fn encoded(name: &str) -> String {
    let mut code = String::with_capacity(name.len());
    for byte in name.bytes() {
        match byte {
            b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'_' => code.push(byte.into()),
            // Writing to a string cannot fail.
            _ => drop(write!(code, "%{byte:02x}")),
        }
    }
    code
}

#[cfg(test)]
mod tests {
    use super::*;

    const NAMES: [&str; 3] = ["default", "crane", "bay/../1"];

    fn begin(directory: &Path, lease: Millis) -> StateFile {
        let first = OwnerState::first().next_life(lease);
        StateFile::begin(Some(directory), NAMES, lease, first, None).unwrap()
    }

    #[test]
    fn a_file_is_written_when_the_epoch_is_known() {
        let directory = tempfile::tempdir().unwrap();
        let begin = |seconds| {
            let unknown = OwnerState::without_memory(100);
            StateFile::begin(Some(directory.path()), NAMES, 100, unknown, seconds).unwrap()
        };
        // Neither a clock nor a report: the next start has no memory either.
        for _ in 0..2 {
            let mut life = begin(None);
            assert!(life.state().needs_report() && !life.path.exists());
            life.end(true);
        }
        let mut life = begin(None);
        life.raise(8).unwrap();
        drop(life);
        let life = begin(None);
        assert_eq!((life.state().epoch(), life.state().silence()), (9, 15_000));
        drop(life);
        assert_eq!(begin(Some(1_800_000_000)).state().epoch(), 1_800_000_000);
        // The clock was set back.
        assert_eq!(begin(Some(7)).state().epoch(), 1_800_000_001);
    }

    #[test]
    fn the_epoch_rises_from_life_to_life() {
        let directory = tempfile::tempdir().unwrap();
        let first = begin(directory.path(), 100);
        assert_eq!((first.state().epoch(), first.state().silence()), (1, 0));
        // A crash: the file is not closed.
        drop(first);
        let mut second = begin(directory.path(), 50);
        assert_eq!((second.state().epoch(), second.state().silence()), (2, 100));
        second.end(true);
        drop(second);
        let mut third = begin(directory.path(), 50);
        assert_eq!((third.state().epoch(), third.state().silence()), (3, 0));
        third.end(false);
        drop(third);
        let fourth = begin(directory.path(), 50);
        assert_eq!((fourth.state().epoch(), fourth.state().silence()), (4, 50));
        let path = directory
            .path()
            .join("locks/default/crane/bay%2f%2e%2e%2f1");
        assert!(path.is_file());
    }

    #[test]
    fn no_cut_of_power_lowers_the_epoch() {
        let first = || OwnerState::first().next_life(100);
        let life = |root: &Path| StateFile::begin(Some(root), NAMES, 100, first(), None).unwrap();
        let epoch = |root: &Path| life(root).state().epoch();
        // The values are the highest epochs that were used.
        let mut cuts = durable::cuts::of(
            |_| {},
            epoch,
            |root, before| assert!(epoch(root) > before.copied().unwrap_or_default()),
        );
        cuts += durable::cuts::of(
            |root| drop(life(root)),
            |root| {
                let mut life = life(root);
                life.raise(1_000).unwrap();
                life.end(true);
                life.state().epoch()
            },
            |root, before| {
                let after = epoch(root);
                assert!(after > before.copied().unwrap_or(1), "{after}");
            },
        );
        assert!(cuts > 2_000, "{cuts}");
    }

    #[test]
    fn a_file_in_use_a_damaged_one_and_a_read_only_directory_are_errors() {
        let directory = tempfile::tempdir().unwrap();
        let first = begin(directory.path(), 100);
        let again = |directory: &Path| {
            let life = OwnerState::first().next_life(100);
            StateFile::begin(Some(directory), NAMES, 100, life, None)
        };
        let second = again(directory.path());
        assert!(matches!(second, Err(StateFileError::InUse { .. })));
        fs::write(&first.path, "epoch 7\n").unwrap();
        drop(first);
        let damaged = again(directory.path());
        assert!(matches!(damaged, Err(StateFileError::Content { .. })));
        let no_directory = directory.path().join("file");
        fs::write(&no_directory, "").unwrap();
        let refused = again(&no_directory);
        assert!(matches!(refused, Err(StateFileError::Io { .. })));
    }

    #[test]
    fn the_state_directory_follows_the_environment() {
        let of = |set: &[(&str, &str)]| {
            default_directory(|name| {
                let found = set.iter().find(|(known, _)| *known == name);
                found.map(|(_, value)| (*value).into())
            })
        };
        let all = [(VARIABLE, "/a"), ("XDG_STATE_HOME", "/b"), ("HOME", "/c")];
        assert_eq!(of(&all), Some("/a".into()));
        assert_eq!(of(&all[1..]), Some("/b/fipa".into()));
        assert_eq!(of(&all[2..]), Some("/c/.local/state/fipa".into()));
        assert_eq!(of(&[(VARIABLE, "")]), None);
    }
}
