//! Where room comes from: free space and capacity are checked, and pages taken, before anything
//! is written.
//!
//! Shared memory files are sparse. Writing to a page of one when the file system is full raises
//! SIGBUS, which ends the process. So pages are asked for with `MADV_POPULATE_WRITE` first, which
//! reports an error instead. `storage` does the same for what iceoryx2 writes by itself.

use std::fs::{File, Metadata, OpenOptions};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::time::{Duration, Instant};

use fipa_transport::{WayError, WayFault};
use rustix::fs::{FlockOperation, Mode, OFlags, flock, fstat, open, stat};
use rustix::io::Errno;
use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mmap, munmap};
use rustix::param::page_size;

use crate::presence::Names;
use crate::storage::{self, Shortage};
use crate::{ShmConfig, ShmError};

/// Where POSIX shared memory lies on Linux.
pub(crate) const SHM: &str = "/dev/shm";

/// Room that is left to others and to small files.
const MARGIN: u64 = 256 << 10;

/// What an endpoint needs to begin with.
const START: u64 = 1 << 20;

/// Length of the first part of every file of ours, in bytes: whole pages on most machines, a part of
/// one on those with larger pages.
pub(crate) const PAGE: usize = 4096;

/// How long to wait for others who are taking memory.
const PATIENCE: Duration = Duration::from_millis(200);

/// How long to wait before asking for a lock again: longer each time, because many who wait would
/// otherwise take more of the processor than whom they wait for.
const FIRST_PAUSE: Duration = Duration::from_micros(200);
const LAST_PAUSE: Duration = Duration::from_millis(4);

/// The share of one domain in this host's shared memory.
#[derive(Debug)]
pub(crate) struct Budget {
    prefix: String,
    capacity: u64,
    /// Locked by whoever takes memory.
    directory: PathBuf,
}

impl Budget {
    pub(crate) fn new(config: &ShmConfig) -> Self {
        Self {
            prefix: format!("{}_", config.prefix),
            capacity: config.capacity,
            directory: Names::new(&config.root, &config.prefix)
                .directory()
                .to_owned(),
        }
    }

    pub(crate) fn capacity(&self) -> u64 {
        self.capacity
    }

    /// Whether an endpoint can be opened at all. To be called under the domain's lock, so that no
    /// other process of the domain that starts takes the same room.
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

    /// Whether `need` more bytes can be taken now, and excludes others of the domain from taking
    /// any until the result is dropped: then the pages must be there ([`populate`]).
    ///
    /// Who has the domain's lock may ask for this one, but not the other way round.
    pub(crate) fn reserve(&self, need: u64) -> Result<OwnedFd, WayError> {
        let turn = self.turn().map_err(|e| {
            WayError::new(
                WayFault::Congested,
                format_args!(
                    "cannot lock {} to take memory: {e}",
                    self.directory.display()
                ),
            )
        })?;
        self.check(need)?;
        Ok(turn)
    }

    /// The lock, on the directory itself: no file is left behind by it.
    fn turn(&self) -> rustix::io::Result<OwnedFd> {
        lock(
            &self.directory,
            FlockOperation::NonBlockingLockExclusive,
            || PATIENCE,
        )
    }

    /// Whether `need` more bytes could be taken now.
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
            // Everybody may put files here; those of others are not this domain's.
            .filter(is_ours)
            .map(|metadata| metadata.blocks() * 512)
            .sum()
    }
}

/// Locks a directory until the result is dropped, in a way that does not block. Somebody who has the
/// lock and was stopped must not stop everybody else: he is waited for as long as `patience` says,
/// which is asked again and again.
///
/// It is the directory of that name that is locked: whoever had the lock before may have removed
/// it, and somebody else have made, and locked, a new one.
///
/// # Errors
/// `WOULDBLOCK` when somebody else still has it then, `NOENT` when it is gone.
pub(crate) fn lock(
    path: &Path,
    how: FlockOperation,
    patience: impl Fn() -> Duration,
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
            Err(Errno::WOULDBLOCK) if began.elapsed() < patience() => {
                std::thread::sleep(pause);
                pause = (pause * 2).min(LAST_PAUSE);
            }
            Err(e) => return Err(e),
        }
    }
}

fn is_ours(found: &Metadata) -> bool {
    found.uid() == rustix::process::geteuid().as_raw()
}

/// Opens a file of shared memory that another process of this user has made.
///
/// The directory is everybody's. What others put there under such a name, they could shorten while
/// it is mapped here; so nothing is followed, waited for or used but a file of this user.
pub(crate) fn open_ours(
    path: &Path,
    options: &mut OpenOptions,
) -> std::io::Result<(File, Metadata)> {
    let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits();
    let file = options.custom_flags(flags as i32).open(path)?;
    let found = file.metadata()?;
    if !found.is_file() || !is_ours(&found) {
        return Err(std::io::ErrorKind::InvalidData.into());
    }
    Ok((file, found))
}

pub(crate) fn no_room(need: u64, what: &str) -> WayError {
    WayError::new(
        WayFault::Congested,
        format_args!("{need} more bytes of shared memory are needed, and {SHM} {what}: enlarge it"),
    )
}

/// The error of an attempt for which pages could not be allocated.
pub(crate) fn lacking(shortage: Shortage) -> WayError {
    no_room(shortage.needed, &format!("is full ({})", shortage.error))
}

fn free_bytes() -> std::io::Result<u64> {
    let stat = rustix::fs::statvfs(SHM)?;
    Ok(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Takes the pages of `len` bytes at `start`, so that writing there cannot fail.
///
/// `start` must be in the memory of an outbox, which is mapped for writing and stays mapped during
/// the call; a range that is not merely gives an error.
pub(crate) fn populate(start: *const u8, len: usize) -> Result<(), WayError> {
    // The kernel's pages: it refuses what does not begin with one, which must not be taken for the
    // refusal of a kernel that cannot do it at all.
    let page = page_size();
    let first = (start as usize) & !(page - 1);
    let end = (start as usize).saturating_add(len);
    let len = end.saturating_sub(first).next_multiple_of(page);
    loop {
        // SAFETY: MADV_POPULATE_WRITE changes nothing that a program can see: it makes the kernel
        // provide pages as a write would, keeping their contents, and reports an error where a
        // write would fault. No reference is made from the pointer.
        let done = unsafe { madvise(first as *mut _, len, Advice::LinuxPopulateWrite) };
        return match done {
            Ok(()) => Ok(()),
            Err(Errno::INTR | Errno::AGAIN) => continue,
            // Before Linux 5.14.
            Err(Errno::INVAL) => storage::allocate(start as usize..end)
                .map_err(|e| no_room(len as u64, &format!("is full ({e})"))),
            Err(e) => Err(no_room(len as u64, &format!("is full ({e})"))),
        };
    }
}

/// Where something lies in memory that is mapped. Says nothing of who may read or write there, and
/// keeps nothing mapped: whoever makes a reference of it answers for both.
#[derive(Debug)]
pub(crate) struct Address<T: ?Sized>(pub(crate) NonNull<T>);

// SAFETY: a number, as far as this type goes. Mapped memory belongs to the process and not to a
// thread, and nothing can be done with the address without an `unsafe` block of its own. Beside it
// in a struct, what keeps the memory mapped has to be `Send` and `Sync` for itself, and the compiler
// sees to that.
unsafe impl<T: ?Sized> Send for Address<T> {}
// SAFETY: as above; a shared address can only be copied.
unsafe impl<T: ?Sized> Sync for Address<T> {}

/// A file of shared memory that this process has mapped, from its beginning.
#[derive(Debug)]
pub(crate) struct Mapping {
    start: Address<u8>,
    len: usize,
}

impl Mapping {
    pub(crate) fn new(file: impl AsFd, len: usize, protection: ProtFlags) -> std::io::Result<Self> {
        // SAFETY: the kernel chooses where to map, so no memory in use is touched.
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
            start: Address(start),
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
        // SAFETY: mapped by `new` with this length, and nothing refers to it any more: whoever
        // lends a part of it lends for no longer than it keeps the mapping.
        let _ = unsafe { munmap(self.start.0.as_ptr().cast(), self.len) };
    }
}
