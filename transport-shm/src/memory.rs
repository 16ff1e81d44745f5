//! Where room comes from: free space and capacity are checked, and pages taken, before anything
//! is written.
//!
//! Shared memory files are sparse. Writing to a page of one when the file system is full raises
//! SIGBUS, which ends the process. So pages are asked for with `MADV_POPULATE_WRITE` first, which
//! reports an error instead.

use std::os::unix::fs::MetadataExt;

use fipa_transport::{WayError, WayFault};
use rustix::io::Errno;
use rustix::mm::{Advice, madvise};

use crate::ShmError;

/// Where POSIX shared memory lies on Linux.
pub(crate) const SHM: &str = "/dev/shm";

/// Room that is left to others and to small files.
const MARGIN: u64 = 256 << 10;

/// What an endpoint needs to begin with.
const START: u64 = 1 << 20;

const PAGE: usize = 4096;

/// The share of one domain in this host's shared memory.
#[derive(Debug)]
pub(crate) struct Budget {
    prefix: String,
    capacity: u64,
}

impl Budget {
    pub(crate) fn new(prefix: &str, capacity: u64) -> Self {
        Self {
            prefix: format!("{prefix}_"),
            capacity,
        }
    }

    /// Whether an endpoint can be opened at all.
    pub(crate) fn check_start(&self) -> Result<(), ShmError> {
        let free = free_bytes().unwrap_or(0);
        if free < START {
            return Err(ShmError::NoRoom {
                path: SHM,
                needed: START,
                free,
            });
        }
        Ok(())
    }

    /// Whether `need` more bytes can be taken now.
    pub(crate) fn check(&self, need: u64) -> Result<(), WayError> {
        if need > self.capacity {
            return Err(WayError::new(
                WayFault::TooLarge,
                format_args!(
                    "{need} bytes of shared memory are needed, and this domain has a capacity of {}: \
                     raise capacity of transport.shm",
                    self.capacity
                ),
            ));
        }
        let used = self.used();
        if used.saturating_add(need) > self.capacity {
            return Err(WayError::new(
                WayFault::Congested,
                format_args!(
                    "{need} more bytes of shared memory are needed, and {used} of this domain's {} \
                     are in use: raise capacity of transport.shm",
                    self.capacity
                ),
            ));
        }
        let free = free_bytes().map_err(|e| no_room(need, &format!("cannot be asked: {e}")))?;
        if free < need.saturating_add(MARGIN) {
            return Err(no_room(need, &format!("has {free} free")));
        }
        Ok(())
    }

    /// What the files of this domain take, in bytes.
    pub(crate) fn used(&self) -> u64 {
        let Ok(files) = std::fs::read_dir(SHM) else {
            return 0;
        };
        files
            .flatten()
            .filter(|file| file.file_name().to_string_lossy().starts_with(&self.prefix))
            .filter_map(|file| file.metadata().ok())
            .map(|metadata| metadata.blocks() * 512)
            .sum()
    }
}

fn no_room(need: u64, what: &str) -> WayError {
    WayError::new(
        WayFault::Congested,
        format_args!("{need} more bytes of shared memory are needed, and {SHM} {what}: enlarge it"),
    )
}

fn free_bytes() -> std::io::Result<u64> {
    let stat = rustix::fs::statvfs(SHM)?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Takes the pages of `len` bytes at `start`, so that writing there cannot fail.
///
/// `start` must be in shared memory that is mapped for writing and stays mapped during the call;
/// a range that is not merely gives an error.
pub(crate) fn populate(start: *const u8, len: usize) -> Result<(), WayError> {
    let first = (start as usize) & !(PAGE - 1);
    let end = (start as usize).saturating_add(len);
    let len = end.saturating_sub(first).next_multiple_of(PAGE);
    loop {
        // SAFETY: MADV_POPULATE_WRITE changes nothing that a program can see: it makes the kernel
        // provide pages as a write would, keeping their contents, and reports an error where a
        // write would fault. No reference is made from the pointer.
        let done = unsafe { madvise(first as *mut _, len, Advice::LinuxPopulateWrite) };
        return match done {
            Ok(()) => Ok(()),
            Err(Errno::INTR | Errno::AGAIN) => continue,
            // Before Linux 5.14. What is free was checked; between the check and the write
            // another program could still take it.
            Err(Errno::INVAL) => match free_bytes() {
                Ok(free) if free >= len as u64 + MARGIN => Ok(()),
                _ => Err(no_room(len as u64, "is full")),
            },
            Err(e) => Err(no_room(len as u64, &format!("is full ({e})"))),
        };
    }
}
