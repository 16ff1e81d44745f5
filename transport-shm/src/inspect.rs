//! Looking at a domain without taking part.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::domain::{Domain, file_error, files_in};
use crate::memory::{Budget, SHM};
use crate::{ShmConfig, ShmError};

/// How many files that are open to others are named.
const MAX_EXPOSED: usize = 16;

/// What [`inspect`] found.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Inspection {
    /// Processes of the domain that are there.
    pub alive: usize,
    /// Processes that are not, whose traces are; at least.
    pub dead: usize,
    /// What the domain takes in shared memory, in bytes.
    pub used: u64,
    /// What is free there, in bytes.
    pub free: u64,
    /// How large it is, in bytes.
    pub total: u64,
    /// Files of the domain that other users may open; at most 16 are named.
    pub exposed: Vec<PathBuf>,
}

/// Looks at a domain without changing anything. For tools.
///
/// # Errors
/// When the configuration makes no sense, or there is no shared memory.
pub fn inspect(config: &ShmConfig) -> Result<Inspection, ShmError> {
    let domain = Domain::new(config)?;
    let shm = rustix::fs::statvfs(SHM)
        .map_err(|e| file_error("cannot ask for the size of", Path::new(SHM), e))?;
    let (alive, dead) = domain.count()?;
    let prefix = format!("{}_", config.prefix);
    let exposed = files_in(Path::new(SHM))
        .filter(|file| file.file_name().to_string_lossy().starts_with(&prefix))
        .filter(|file| file.metadata().is_ok_and(|found| found.mode() & 0o077 != 0))
        .map(|file| file.path());
    Ok(Inspection {
        alive,
        dead,
        used: Budget::new(config).used(),
        free: shm.f_bavail.saturating_mul(shm.f_frsize),
        total: shm.f_blocks.saturating_mul(shm.f_frsize),
        exposed: exposed.take(MAX_EXPOSED).collect(),
    })
}
