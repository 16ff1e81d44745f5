//! Content that lies in shared memory once for all its receivers: what both sides need.
//!
//! A segment is a file of the process that sends: one page with a [`Label`], then room for one
//! content. Letters refer to it by [`Reference`]; they are ordinary letters in all else, so that
//! order and acknowledgement stay those of the mailbox. `pool` is the sending side, `library` the
//! receiving one.
//!
//! # Who may write when
//! Whoever reads holds a shared lock (flock) on the file, the sender too as long as the content is
//! loaned, held or on its way. Only who holds the lock alone, the sender or, after its end, whoever
//! cleans up, may begin another content or shorten the file. Locks end with their process, so
//! nobody who was killed keeps a segment from being used again.
//!
//! A letter that its sender has given up may still be lying in a mailbox. So every content has a
//! generation, which moves while the lock is held alone; who has taken the shared lock compares
//! it with the reference. For the same reason the file's length is asked for under the lock, and
//! nothing is read beyond it; nor where the file has no pages, which reading would have to take.

use std::fs::File;
use std::io;
use std::mem::offset_of;
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::path::Path;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering, fence};

use rustix::fs::{FallocateFlags, FlockOperation, fallocate, flock};
use rustix::io::Errno;
use rustix::mm::ProtFlags;

use crate::memory::{Mapping, PAGE, open_ours};

/// Where a content lies: in which segment of its sender, and as which of its contents.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Reference {
    /// The segment's number among those of its process, from 1.
    pub(crate) segment: u64,
    pub(crate) generation: u64,
}

/// What stands in the first page of a segment. Written by its process, read by others.
#[derive(Debug)]
#[repr(C)]
struct Label {
    /// Which content lies here.
    generation: AtomicU64,
    /// Whether whoever stops reading should say so.
    wanted: AtomicU32,
}

/// A segment's file, mapped.
#[derive(Debug)]
pub(crate) struct SegmentFile {
    file: File,
    mapping: Mapping,
}

impl SegmentFile {
    /// A new segment with room for this much content, all of whose pages are there: those who read
    /// it could otherwise meet one that was never written, and a full file system.
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

    /// Another process's segment, for reading.
    pub(crate) fn open(path: &Path) -> io::Result<Self> {
        let (file, found) = open_ours(path, File::options().read(true))?;
        let len = usize::try_from(found.len()).unwrap_or(0);
        if len <= PAGE {
            return Err(io::ErrorKind::InvalidData.into());
        }
        let mapping = Mapping::new(&file, len, ProtFlags::READ)?;
        Ok(Self { file, mapping })
    }

    /// How much content has room.
    pub(crate) fn room(&self) -> usize {
        self.mapping.len() - PAGE
    }

    /// Where the content begins: aligned to a page.
    pub(crate) fn content(&self) -> *mut u8 {
        self.mapping.start().as_ptr().wrapping_add(PAGE)
    }

    pub(crate) fn mapping(&self) -> &Mapping {
        &self.mapping
    }

    fn label(&self) -> &Label {
        // SAFETY: the mapping lives as long as self, is aligned to a page and longer than a
        // `Label`, whose every value is valid. Every process accesses these words atomically
        // only; those that map the segment for reading only load, and relaxed, which is the load
        // that Rust allows on memory that cannot be written. The page is there: the file is
        // shortened only by its sender, who does not look here afterwards, or when that has ended,
        // and only while nobody has the lock, which all others who look here have. A process of
        // this user that keeps to no lock could end this one in simpler ways.
        unsafe { self.mapping.start().cast::<Label>().as_ref() }
    }

    /// The generation of the content that lies here. To be called under the lock.
    pub(crate) fn generation(&self) -> u64 {
        let generation = self.label().generation.load(Ordering::Relaxed);
        // The lock orders the content behind it; this says so to the compiler.
        fence(Ordering::Acquire);
        generation
    }

    /// Begins another content, unless the last one is still read. The lock is shared afterwards.
    pub(crate) fn begin(&self) -> Option<u64> {
        self.lock(FlockOperation::NonBlockingLockExclusive).ok()?;
        let label = self.label();
        label.wanted.store(0, Ordering::SeqCst);
        let generation = label.generation.fetch_add(1, Ordering::SeqCst) + 1;
        self.share().ok()?;
        Some(generation)
    }

    /// Takes the lock for reading, unless somebody has it alone.
    pub(crate) fn share(&self) -> io::Result<()> {
        self.lock(FlockOperation::NonBlockingLockShared)
    }

    /// Lets go of the lock. Says whether somebody waits for that.
    pub(crate) fn let_go(&self) -> bool {
        // Looked at afterwards: whoever waits has said so before trying to have the lock, so one
        // of the two is in time. And read, not looked up in memory, because without the lock the
        // page may not be there any more.
        let mut wanted = [0; size_of::<AtomicU32>()];
        let at = offset_of!(Label, wanted) as u64;
        self.lock(FlockOperation::Unlock).is_ok()
            && self.file.read_exact_at(&mut wanted, at).is_ok()
            && wanted != [0; size_of::<AtomicU32>()]
    }

    /// Asks those who read to say when they stop. For the sender, while it has its files.
    pub(crate) fn want(&self) {
        self.label().wanted.store(1, Ordering::SeqCst);
    }

    /// Gives the memory back, unless it is read. Nobody reads it afterwards.
    pub(crate) fn empty(&self) -> bool {
        self.lock(FlockOperation::NonBlockingLockExclusive).is_ok() && self.file.set_len(0).is_ok()
    }

    /// Whether all of what was mapped is there, so that it can be read. To be called under the
    /// lock.
    pub(crate) fn is_whole(&self) -> bool {
        let mapped = self.mapping.len() as u64;
        self.file
            .metadata()
            .is_ok_and(|found| found.len() >= mapped && found.blocks() * 512 >= mapped)
    }

    /// Whether the file has a name, by which others could find it.
    pub(crate) fn is_there(&self) -> bool {
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

/// Removes a segment of a process that has ended. Whoever still reads keeps its memory.
pub(crate) fn remove(path: &Path) {
    // Emptied first: a file that is only unlinked stays as long as somebody has it mapped,
    // whether it is read or not.
    if let Ok((file, found)) = open_ours(path, File::options().write(true))
        // Somebody else's link to another file of this user would have that emptied.
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
    fn contents_follow_each_other_when_nobody_reads() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("1.content");
        let sender = SegmentFile::create(&path, 5000).unwrap();
        assert_eq!(sender.begin(), Some(1));
        let reader = SegmentFile::open(&path).unwrap();
        assert!(reader.room() >= 5000);
        reader.share().unwrap();
        assert!(reader.is_whole());
        assert_eq!(reader.generation(), 1);
        assert!(!sender.let_go());
        // Being read, it is left alone; whoever waits is told.
        assert_eq!(sender.begin(), None);
        sender.want();
        assert!(!sender.empty());
        assert!(reader.let_go());
        // A letter of before does not mistake the next content for its own.
        assert_eq!(sender.begin(), Some(2));
        reader.share().unwrap();
        assert_eq!(reader.generation(), 2);
        assert!(!reader.let_go());
        sender.let_go();
        assert!(sender.empty());
        sender.let_go();
        reader.share().unwrap();
        assert!(!reader.is_whole());
        assert!(!reader.let_go());
        assert!(!reader.is_there());
        let refused = SegmentFile::open(&path).unwrap_err();
        assert_eq!(refused.kind(), io::ErrorKind::InvalidData);
    }

    #[test]
    fn what_the_dead_leave_is_emptied_unless_it_is_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("1.content");
        let sender = SegmentFile::create(&path, 5000).unwrap();
        sender.begin().unwrap();
        let reader = SegmentFile::open(&path).unwrap();
        reader.share().unwrap();
        // Its lock ends with it.
        drop(sender);
        remove(&path);
        assert!(!path.exists());
        assert!(reader.is_whole());
        assert!(!reader.is_there());

        let sender = SegmentFile::create(&path, 5000).unwrap();
        let reader = SegmentFile::open(&path).unwrap();
        drop(sender);
        remove(&path);
        assert!(!reader.is_whole());
    }

    #[test]
    fn what_reading_would_have_to_take_is_not_read() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("1.content");
        let sparse = File::create_new(&path).unwrap();
        sparse.set_len(16 * PAGE as u64).unwrap();
        let reader = SegmentFile::open(&path).unwrap();
        reader.share().unwrap();
        assert!(!reader.is_whole());
    }

    #[test]
    fn what_has_another_name_is_not_emptied() {
        let directory = tempfile::tempdir().unwrap();
        let [other, path] = ["other", "1.content"].map(|name| directory.path().join(name));
        std::fs::write(&other, "precious").unwrap();
        std::fs::hard_link(&other, &path).unwrap();
        remove(&path);
        assert!(!path.exists());
        assert_eq!(std::fs::read_to_string(&other).unwrap(), "precious");
    }

    #[test]
    fn files_of_others_are_not_mapped() {
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
