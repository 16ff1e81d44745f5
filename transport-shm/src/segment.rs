//! Content that is stored once in shared memory for all its receivers: the file format and its
//! locking rules, used by both sides.
//!
//! A segment is a file of the sending process: one page with a [`SegmentHeader`], then room for one
//! content. Letters refer to it by [`ContentReference`]. They are ordinary letters otherwise, so
//! order and acknowledgment stay those of the mailbox. `pool` is the sending side, `peer_segments`
//! the receiving one.
//!
//! # Locking
//! Every reader holds a shared lock (flock) on the file. The sender holds one, too, while the
//! content is loaned, held or under way. Only the holder of the exclusive lock may begin another
//! content or shorten the file: the sender or, after its end, the process that cleans up. Locks end
//! with their process, so a killed process does not keep a segment from being reused.
//!
//! A letter that its sender has abandoned may still be in a mailbox. So every content has a
//! generation, which changes only under the exclusive lock, and a reader that has taken the shared
//! lock compares it with the reference. For the same reason a reader checks the file's length and
//! allocated blocks under the lock: it reads neither beyond the end nor pages that do not exist,
//! which the read would have to allocate.

use std::fs::File;
use std::io;
use std::mem::offset_of;
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::path::Path;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};

use rustix::fs::{FallocateFlags, FlockOperation, fallocate, flock};
use rustix::io::Errno;
use rustix::mm::ProtFlags;

use crate::memory::{Mapping, PAGE, open_owned};

/// The position of a content: the segment of its sender, and the generation in that segment.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ContentReference {
    /// The segment's number among those of its process, from 1.
    pub(crate) segment: u64,
    pub(crate) generation: u64,
}

/// The first page of a segment. Written by its process, read by others.
#[derive(Debug)]
#[repr(C)]
struct SegmentHeader {
    /// Generation of the current content.
    generation: AtomicU64,
    /// Whether a reader that stops must ring the sender's doorbell.
    notice_requested: AtomicU32,
}

/// A mapped segment file.
#[derive(Debug)]
pub(crate) struct SegmentFile {
    file: File,
    mapping: Mapping,
}

impl SegmentFile {
    /// Creates a segment with room for this many bytes of content and allocates all its pages.
    /// Otherwise a reader could fault on an unwritten page of a full file system.
    pub(crate) fn create(path: &Path, room: usize) -> io::Result<Self> {
        let file = File::options()
            .read(true)
            .write(true)
            .create_new(true)
            .mode(0o600)
            .open(path)?;
        let len = PAGE.checked_add(room).ok_or(io::ErrorKind::FileTooLarge)?;
        while let Err(e) = fallocate(&file, FallocateFlags::empty(), 0, len as u64) {
            if e != Errno::INTR {
                return Err(e.into());
            }
        }
        let mapping = Mapping::new(&file, len, ProtFlags::READ | ProtFlags::WRITE)?;
        Ok(Self { file, mapping })
    }

    /// Opens another process's segment for reading.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        let (file, found) = open_owned(path, File::options().read(true))?;
        let len = usize::try_from(found.len()).unwrap_or(0);
        if len <= PAGE {
            return Err(io::ErrorKind::InvalidData.into());
        }
        let mapping = Mapping::new(&file, len, ProtFlags::READ)?;
        Ok(Self { file, mapping })
    }

    /// Room for content in bytes.
    pub(crate) fn room(&self) -> usize {
        self.mapping.len() - PAGE
    }

    /// Start of the content, aligned to a page.
    pub(crate) fn content(&self) -> *mut u8 {
        self.mapping.start().as_ptr().wrapping_add(PAGE)
    }

    pub(crate) fn mapping(&self) -> &Mapping {
        &self.mapping
    }

    fn header(&self) -> &SegmentHeader {
        // SAFETY: the mapping exists as long as self, is aligned to a page and longer than a
        // `SegmentHeader`, of which every bit pattern is valid. Every process accesses these words
        // atomically. Processes that map the segment for reading only load them, relaxed, which
        // Rust allows on read-only memory for words of at most 8 bytes on 64-bit targets. The page
        // exists: the file is shortened only under the exclusive lock, by its sender, which does
        // not call this afterwards, or after the sender's end. All other callers hold the lock.
        // This assumes that the processes of this user follow the locking rules; one that does not
        // can also end this process with a signal.
        unsafe { self.mapping.start().cast::<SegmentHeader>().as_ref() }
    }

    /// Generation of the current content. The caller must hold the lock.
    pub(crate) fn generation(&self) -> u64 {
        let generation = self.header().generation.load(Ordering::Relaxed);
        // The lock orders the content after this load; the fence tells the compiler.
        fence(Ordering::Acquire);
        generation
    }

    /// Begins another content and returns its generation, unless a reader holds the lock. The
    /// caller holds the shared lock afterwards.
    pub(crate) fn begin(&self) -> Option<u64> {
        self.lock(FlockOperation::NonBlockingLockExclusive).ok()?;
        let header = self.header();
        header.notice_requested.store(0, Ordering::SeqCst);
        let generation = header.generation.fetch_add(1, Ordering::SeqCst) + 1;
        self.share().ok()?;
        Some(generation)
    }

    /// Takes the shared lock, unless another process holds the exclusive one.
    pub(crate) fn share(&self) -> io::Result<()> {
        self.lock(FlockOperation::NonBlockingLockShared)
    }

    /// Releases the lock. Returns whether the sender requested a notice.
    pub(crate) fn unlock(&self) -> bool {
        // Read after the unlock: the sender requests the notice before it tries to lock, so either
        // its lock succeeds or the request is seen here. Read from the file and not from the
        // mapping, because the page may not exist without the lock.
        let mut requested = [0; size_of::<AtomicU32>()];
        let at = offset_of!(SegmentHeader, notice_requested) as u64;
        self.lock(FlockOperation::Unlock).is_ok()
            && self.file.read_exact_at(&mut requested, at).is_ok()
            && requested != [0; size_of::<AtomicU32>()]
    }

    /// Requests that readers ring the doorbell when they stop. Only the sender calls this, and
    /// only before it releases the memory.
    pub(crate) fn request_notice(&self) {
        self.header().notice_requested.store(1, Ordering::SeqCst);
    }

    /// Shortens the file to nothing, unless a reader holds the lock. No process reads it
    /// afterwards.
    pub(crate) fn empty(&self) -> bool {
        self.lock(FlockOperation::NonBlockingLockExclusive).is_ok() && self.file.set_len(0).is_ok()
    }

    /// Whether every mapped page is allocated in the file, so that it can be read. The caller must
    /// hold the lock.
    pub(crate) fn is_fully_allocated(&self) -> bool {
        let mapped = self.mapping.len() as u64;
        self.file
            .metadata()
            .is_ok_and(|found| found.len() >= mapped && found.blocks() * 512 >= mapped)
    }

    /// Whether the file still has a name and content, so that other processes can open it.
    pub(crate) fn is_linked(&self) -> bool {
        self.file
            .metadata()
            .is_ok_and(|found| found.nlink() > 0 && found.len() > 0)
    }

    fn lock(&self, how: FlockOperation) -> io::Result<()> {
        loop {
            match flock(&self.file, how) {
                Err(Errno::INTR) => {}
                done => return done.map_err(Into::into),
            }
        }
    }
}

/// Removes a segment of a process that has ended. Processes that read it keep its memory.
pub(crate) fn remove(path: &Path) {
    // Emptied first: the memory of a file that is only unlinked stays allocated as long as a
    // process has it mapped, even if no process reads it.
    if let Ok((file, found)) = open_owned(path, File::options().write(true))
        // A hard link to another file of this user must not cause that file to be emptied.
        && found.nlink() == 1
        && flock(&file, FlockOperation::NonBlockingLockExclusive).is_ok()
    {
        let _ = file.set_len(0);
    }
    let _ = std::fs::remove_file(path);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_segment_is_reused_when_it_is_not_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("1.content");
        let sender = SegmentFile::create(&path, 5000).unwrap();
        assert_eq!(sender.begin(), Some(1));
        let reader = SegmentFile::open(&path).unwrap();
        assert!(reader.room() >= 5000);
        reader.share().unwrap();
        assert!(reader.is_fully_allocated());
        assert_eq!(reader.generation(), 1);
        assert!(!sender.unlock());
        // A segment that is read is not reused, and the reader learns that the sender waits.
        assert_eq!(sender.begin(), None);
        sender.request_notice();
        assert!(!sender.empty());
        assert!(reader.unlock());
        // A reference to the first content does not match the second one.
        assert_eq!(sender.begin(), Some(2));
        reader.share().unwrap();
        assert_eq!(reader.generation(), 2);
        assert!(!reader.unlock());
        sender.unlock();
        assert!(sender.empty());
        sender.unlock();
        reader.share().unwrap();
        assert!(!reader.is_fully_allocated());
        assert!(!reader.unlock());
        assert!(!reader.is_linked());
        let refused = SegmentFile::open(&path).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::InvalidData);
    }

    #[test]
    fn a_dead_senders_segment_is_emptied_unless_it_is_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("1.content");
        let sender = SegmentFile::create(&path, 5000).unwrap();
        sender.begin().unwrap();
        let reader = SegmentFile::open(&path).unwrap();
        reader.share().unwrap();
        // Dropping the sender releases its lock, as the end of its process does.
        drop(sender);
        remove(&path);
        assert!(!path.exists());
        assert!(reader.is_fully_allocated());
        assert!(!reader.is_linked());

        let sender = SegmentFile::create(&path, 5000).unwrap();
        let reader = SegmentFile::open(&path).unwrap();
        drop(sender);
        remove(&path);
        assert!(!reader.is_fully_allocated());
    }

    #[test]
    fn a_segment_with_missing_pages_is_not_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("1.content");
        let sparse = File::create_new(&path).unwrap();
        sparse.set_len(16 * PAGE as u64).unwrap();
        let reader = SegmentFile::open(&path).unwrap();
        reader.share().unwrap();
        assert!(!reader.is_fully_allocated());
    }

    #[test]
    fn a_file_with_another_hard_link_is_not_emptied() {
        let directory = tempfile::tempdir().unwrap();
        let [other, path] = ["other", "1.content"].map(|name| directory.path().join(name));
        std::fs::write(&other, "precious").unwrap();
        std::fs::hard_link(&other, &path).unwrap();
        remove(&path);
        assert!(!path.exists());
        assert_eq!(std::fs::read_to_string(&other).unwrap(), "precious");
    }

    #[test]
    fn short_files_links_and_directories_are_not_mapped() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("1.content");
        std::fs::write(&path, [0; PAGE]).unwrap();
        assert!(SegmentFile::open(&path).is_err());
        let link = directory.path().join("2.content");
        std::os::unix::fs::symlink(&path, &link).unwrap();
        std::fs::write(&path, [0; 3 * PAGE]).unwrap();
        assert!(SegmentFile::open(&path).is_ok());
        assert!(SegmentFile::open(&link).is_err());
        assert!(SegmentFile::open(directory.path()).is_err());
    }
}
