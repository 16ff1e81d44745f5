//! Checks of free space and capacity, and allocation of pages before they are written.
//!
//! Shared memory files are sparse. Writing to a missing page when the file system is full raises
//! SIGBUS, which ends the process. So pages are first populated with `MADV_POPULATE_WRITE`, which
//! reports an error instead. `storage` does the same for the pages that iceoryx2 itself writes.

use std::fs::{File, Metadata, OpenOptions};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::time::{Duration, Instant};

use fipa_transport::{TransportError, TransportErrorKind};
use rustix::fs::{FlockOperation, Mode, OFlags, flock, fstat, open, stat};
use rustix::io::Errno;
use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mmap, munmap};
use rustix::param::page_size;

use crate::paths::ProcessPaths;
use crate::shared_files::{SHM, shared_files};
use crate::storage::{self, Shortage};
use crate::{ShmConfig, ShmError};

/// Free bytes that are left for other programs and small files.
const MARGIN: u64 = 256 << 10;

/// Free bytes that an endpoint needs to start.
const START: u64 = 1 << 20;

/// Length of the first part of every file of this crate, in bytes. With larger kernel pages, a part
/// of one page.
pub(crate) const PAGE: usize = 4096;

/// Timeout of the lock under which processes allocate memory.
const LOCK_TIMEOUT: Duration = Duration::from_millis(200);

/// Pause before a retry of a lock, doubled each time. Many waiters would otherwise use more of the
/// processor than the process they wait for.
const FIRST_PAUSE: Duration = Duration::from_micros(200);
const LAST_PAUSE: Duration = Duration::from_millis(4);

/// The share of one domain in the shared memory of this host.
#[derive(Debug)]
pub(crate) struct Budget {
    prefix: String,
    capacity: u64,
    /// Locked while a process allocates memory.
    directory: PathBuf,
}

impl Budget {
    pub(crate) fn new(config: &ShmConfig) -> Self {
        Self {
            prefix: format!("{}_", config.prefix),
            capacity: config.capacity,
            directory: ProcessPaths::new(&config.root, &config.prefix)
                .directory()
                .to_owned(),
        }
    }

    pub(crate) fn capacity(&self) -> u64 {
        self.capacity
    }

    /// Checks that there is room to open an endpoint. The caller must hold the domain's lock, so
    /// that no other starting process of the domain uses the same room.
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

    /// Locks out other processes of the domain that allocate memory, until the result is dropped.
    /// Waits for them at most [`LOCK_TIMEOUT`]. The caller checks that there is room
    /// ([`check`](Self::check)), and allocates the pages ([`populate`]) before the result is
    /// dropped.
    ///
    /// A holder of the domain's lock may take this lock, but not the other way round.
    pub(crate) fn lock(&self) -> Result<OwnedFd, TransportError> {
        self.lock_directory(LOCK_TIMEOUT)
            .map_err(|e| self.lock_error(e))
    }

    /// Takes the lock like [`lock`](Self::lock) without a wait. `None` if another process has it.
    pub(crate) fn try_lock(&self) -> Result<Option<OwnedFd>, TransportError> {
        match self.lock_directory(Duration::ZERO) {
            Ok(lock) => Ok(Some(lock)),
            Err(Errno::WOULDBLOCK) => Ok(None),
            Err(e) => Err(self.lock_error(e)),
        }
    }

    fn lock_error(&self, error: Errno) -> TransportError {
        let directory = self.directory.display();
        TransportError::new(
            TransportErrorKind::Congested,
            format_args!("cannot lock {directory} to allocate memory: {error}"),
        )
    }

    /// Locks the directory itself, so that no lock file remains.
    fn lock_directory(&self, timeout: Duration) -> rustix::io::Result<OwnedFd> {
        let how = FlockOperation::NonBlockingLockExclusive;
        lock(&self.directory, how, || timeout)
    }

    /// Checks that `need` more bytes can be allocated now.
    pub(crate) fn check(&self, need: u64) -> Result<(), TransportError> {
        if need > self.capacity {
            return Err(TransportError::new(
                TransportErrorKind::TooLarge,
                format_args!(
                    "{need} bytes of shared memory are needed, and the capacity of this domain is {}; \
                     raise transport.shm.capacity",
                    self.capacity
                ),
            ));
        }
        let used = self.used();
        if used.saturating_add(need) > self.capacity {
            return Err(TransportError::new(
                TransportErrorKind::NoRoom,
                format_args!(
                    "{need} more bytes of shared memory are needed, and {used} of this domain's {} \
                     are in use; raise transport.shm.capacity",
                    self.capacity
                ),
            ));
        }
        let free =
            free_bytes().map_err(|e| no_room_error(need, &format!("cannot be read ({e})")))?;
        if free < need.saturating_add(MARGIN) {
            return Err(no_room_error(need, &format!("has {free} free bytes")));
        }
        Ok(())
    }

    /// Memory that the files of this domain use, in bytes.
    pub(crate) fn used(&self) -> u64 {
        shared_files()
            .filter(|file| file.file_name().to_string_lossy().starts_with(&self.prefix))
            .filter_map(|file| file.metadata().ok())
            // Any user may create files here; those of other users do not count.
            .filter(is_owned)
            .map(|metadata| metadata.blocks() * 512)
            .sum()
    }
}

/// Locks a directory until the result is dropped, by polling. A stopped process may hold the lock,
/// so the wait ends after `timeout()`, which is evaluated on each retry.
///
/// The result is a lock of the directory that has this path now: the previous holder may have
/// removed the directory, and another process may have created and locked a new one.
///
/// # Errors
/// `WOULDBLOCK` if another process still holds the lock then, `NOENT` if the directory is missing.
pub(crate) fn lock(
    path: &Path,
    how: FlockOperation,
    timeout: impl Fn() -> Duration,
) -> rustix::io::Result<OwnedFd> {
    let flags = OFlags::DIRECTORY | OFlags::RDONLY | OFlags::CLOEXEC;
    let opened = || open(path, flags, Mode::empty());
    let began = Instant::now();
    let mut pause = FIRST_PAUSE;
    let mut directory = opened()?;
    loop {
        match flock(&directory, how) {
            Ok(()) => {
                let (locked, there) = (fstat(&directory)?, stat(path)?);
                if (locked.st_dev, locked.st_ino) == (there.st_dev, there.st_ino) {
                    return Ok(directory);
                }
                directory = opened()?;
            }
            Err(Errno::INTR) => {}
            Err(Errno::WOULDBLOCK) if began.elapsed() < timeout() => {
                std::thread::sleep(pause);
                pause = (pause * 2).min(LAST_PAUSE);
            }
            Err(e) => return Err(e),
        }
    }
}

/// Whether a file belongs to this user.
pub(crate) fn is_owned(found: &Metadata) -> bool {
    found.uid() == rustix::process::geteuid().as_raw()
}

/// Opens a shared memory file that another process of this user has created.
///
/// Any user may create files in the directory, and could shorten a file of their own while it is
/// mapped here. So symbolic links are not followed, FIFOs are not waited for, and files of other
/// users are refused.
pub(crate) fn open_owned(
    path: &Path,
    options: &mut OpenOptions,
) -> std::io::Result<(File, Metadata)> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits();
    let file = options.custom_flags(flags as i32).open(path)?;
    let found = file.metadata()?;
    if !found.is_file() || !is_owned(&found) {
        return Err(std::io::ErrorKind::InvalidData.into());
    }
    Ok((file, found))
}

pub(crate) fn no_room_error(need: u64, what: &str) -> TransportError {
    TransportError::new(
        TransportErrorKind::NoRoom,
        format_args!("{need} more bytes of shared memory are needed, and {SHM} {what}; enlarge it"),
    )
}

/// The transport error for pages that could not be allocated.
pub(crate) fn shortage_error(shortage: Shortage) -> TransportError {
    no_room_error(shortage.needed, &format!("is full ({})", shortage.error))
}

fn free_bytes() -> std::io::Result<u64> {
    let stat = rustix::fs::statvfs(SHM)?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Allocates the pages of `len` bytes at `start`, so that writing there cannot fail.
///
/// `start` must be in memory that is mapped for writing and stays mapped during the call; any other
/// range gives an error.
pub(crate) fn populate(start: *const u8, len: usize) -> Result<(), TransportError> {
    // Aligned to the kernel's pages: it refuses other ranges with `INVAL`, which is also the error
    // of a kernel without this advice.
    let page = page_size();
    let first = (start as usize) & !(page - 1);
    let end = (start as usize).saturating_add(len);
    let len = end.saturating_sub(first).next_multiple_of(page);
    loop {
        // SAFETY: MADV_POPULATE_WRITE makes the kernel provide pages as a write would. It keeps
        // their contents, and it reports an error where a write would fault and for a range that is
        // not mapped. No reference is created from the pointer.
        let done = unsafe { madvise(first as *mut _, len, Advice::LinuxPopulateWrite) };
        return match done {
            Ok(()) => Ok(()),
            Err(Errno::INTR | Errno::AGAIN) => continue,
            // The kernel is older than Linux 5.14.
            Err(Errno::INVAL) => storage::allocate(start as usize..end)
                .map_err(|e| no_room_error(len as u64, &format!("is full ({e})"))),
            Err(e) => Err(no_room_error(len as u64, &format!("is full ({e})"))),
        };
    }
}

/// An address in mapped memory. It neither keeps the memory mapped nor allows access to it: each
/// block that creates a reference from it must ensure both.
#[derive(Debug)]
pub(crate) struct MappedPtr<T: ?Sized>(pub(crate) NonNull<T>);

// SAFETY: the value is only an address. Mapped memory belongs to the process and not to a thread,
// and each access through the address needs an `unsafe` block of its own. The fields beside it in a
// struct, which keep the memory mapped, must be `Send` and `Sync` themselves, and the compiler
// checks that.
unsafe impl<T: ?Sized> Send for MappedPtr<T> {}
// SAFETY: as above; a shared address can only be copied.
unsafe impl<T: ?Sized> Sync for MappedPtr<T> {}

/// A shared mapping of a file from its beginning.
#[derive(Debug)]
pub(crate) struct Mapping {
    start: MappedPtr<u8>,
    len: usize,
}

impl Mapping {
    pub(crate) fn new(file: impl AsFd, len: usize, protection: ProtFlags) -> std::io::Result<Self> {
        // SAFETY: the kernel chooses the address of the mapping, so no memory in use is changed.
        let start = unsafe {
            mmap(
                std::ptr::null_mut(),
                len,
                protection,
                MapFlags::SHARED,
                file,
                0,
            )
        }?;
        let start = NonNull::new(start.cast()).ok_or(std::io::ErrorKind::OutOfMemory)?;
        Ok(Self {
            start: MappedPtr(start),
            len,
        })
    }

    pub(crate) fn start(&self) -> NonNull<u8> {
        self.start.0
    }

    pub(crate) fn len(&self) -> usize {
        self.len
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: `new` has mapped this range. No reference into it is left: each one borrows from
        // a value that owns this mapping.
        let _ = unsafe { munmap(self.start.0.as_ptr().cast(), self.len) };
    }
}
