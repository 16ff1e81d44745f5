//! Inspection of a domain without joining it.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use crate::domain_files::{DomainFiles, file_error};
use crate::memory::Budget;
use crate::shared_files::SHM;
use crate::shared_files::shared_files;
use crate::{ShmConfig, ShmError};

/// Maximum number of exposed files in a report.
const MAX_EXPOSED: usize = 16;

/// The result of [`inspect`].
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Inspection {
    /// Number of processes of the domain that run.
    pub alive: usize,
    /// Lower bound of the number of dead processes whose files still exist.
    pub dead: usize,
    /// Shared memory that the domain uses, in bytes.
    pub used: u64,
    /// Free shared memory, in bytes.
    pub free: u64,
    /// Size of the shared memory file system, in bytes.
    pub total: u64,
    /// Files of the domain that other users may open, at most 16.
    pub exposed: Vec<PathBuf>,
}

/// Reports on a domain without changing it. For tools.
///
/// # Errors
/// Returns an error if the configuration is invalid or `/dev/shm` cannot be read.
pub fn inspect(config: &ShmConfig) -> Result<Inspection, ShmError> {
    let domain = DomainFiles::of(config)?;
    let shm = rustix::fs::statvfs(SHM)
        .map_err(|e| file_error("cannot read the size of", Path::new(SHM), e))?;
    let (alive, dead) = domain.count()?;
    let prefix = format!("{}_", config.prefix);
    let exposed = shared_files()
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
