//! The receiving side of content for several receivers: segments of other processes that are read,
//! or kept open for the next content. See `segment`.

use std::io::{self, ErrorKind};
use std::sync::Arc;

use fipa_transport::Incarnation;
use parking_lot::Mutex;

use crate::domain_files::DomainFiles;
use crate::fork::OwnerMark;
use crate::segment::{ContentReference, SegmentFile};

/// Maximum number of segments kept open.
const MAX_OPEN: usize = 32;

/// The error of reading content in a segment.
#[derive(Debug)]
pub(crate) enum ReadError {
    /// The content no longer exists: the sender has abandoned the letter.
    Gone,
    /// This process has no memory or descriptors for it now.
    NoRoom,
}

/// The open segments of other processes.
pub(crate) struct PeerSegments {
    /// In the order of their last use.
    open: Mutex<Vec<Arc<PeerSegment>>>,
    domain: Arc<DomainFiles>,
}

/// A segment of another process.
struct PeerSegment {
    sender: Incarnation,
    number: u64,
    file: SegmentFile,
    reading: Mutex<ReadState>,
}

/// The content being read and its number of readers. While there are any, this process holds the
/// lock.
struct ReadState {
    readers: usize,
    /// `None` if the segment is no longer fully allocated.
    generation: Option<u64>,
}

impl PeerSegments {
    pub(crate) fn new(domain: Arc<DomainFiles>) -> Self {
        Self {
            open: Mutex::default(),
            domain,
        }
    }

    /// Opens content of this length in a sender's segment.
    pub(crate) fn read(
        self: &Arc<Self>,
        sender: Incarnation,
        reference: ContentReference,
        len: usize,
    ) -> Result<SegmentContent, ReadError> {
        let segment = self.segment(sender, reference.segment)?;
        if !segment.begin(reference.generation, len) {
            return Err(ReadError::Gone);
        }
        Ok(SegmentContent {
            segment,
            len,
            peer_segments: Arc::clone(self),
        })
    }

    fn segment(&self, sender: Incarnation, number: u64) -> Result<Arc<PeerSegment>, ReadError> {
        let mut open = self.open.lock();
        let is = |one: &Arc<PeerSegment>| one.sender == sender && one.number == number;
        let segment = match open.iter().position(is) {
            Some(place) => open.remove(place),
            None => {
                let path = self.domain.paths().segment(sender, number);
                let file = SegmentFile::open(&path).map_err(read_error)?;
                Arc::new(PeerSegment {
                    sender,
                    number,
                    file,
                    reading: Mutex::new(ReadState {
                        readers: 0,
                        generation: None,
                    }),
                })
            }
        };
        if open.len() >= MAX_OPEN {
            // The least recently used; its readers keep it mapped.
            open.remove(0);
        }
        open.push(Arc::clone(&segment));
        Ok(segment)
    }

    pub(crate) fn owner(&self) -> OwnerMark {
        self.domain.owner()
    }

    /// Closes the segments of a process that has ended. Their readers keep them mapped.
    pub(crate) fn forget(&self, sender: Incarnation) {
        self.open.lock().retain(|one| one.sender != sender);
    }

    fn forget_segment(&self, segment: &Arc<PeerSegment>) {
        self.open.lock().retain(|one| !Arc::ptr_eq(one, segment));
    }
}

fn read_error(error: io::Error) -> ReadError {
    match error.kind() {
        ErrorKind::NotFound | ErrorKind::InvalidData => ReadError::Gone,
        _ => ReadError::NoRoom,
    }
}

impl PeerSegment {
    /// Adds a reader if the segment contains this generation and has room for this length.
    fn begin(&self, generation: u64, len: usize) -> bool {
        let mut reading = self.reading.lock();
        if reading.readers == 0 {
            if self.file.share().is_err() {
                return false;
            }
            // Both values are constant while this process holds the lock.
            let whole = self.file.is_fully_allocated();
            reading.generation = whole.then(|| self.file.generation());
        }
        if reading.generation == Some(generation) && len <= self.file.room() {
            reading.readers += 1;
            return true;
        }
        if reading.readers == 0 {
            self.file.unlock();
        }
        false
    }

    /// Removes a reader. After the last one, returns whether the sender requested a notice.
    fn end(&self) -> Option<bool> {
        let mut reading = self.reading.lock();
        reading.readers -= 1;
        (reading.readers == 0).then(|| self.file.unlock())
    }
}

/// Content in a sender's segment.
pub(crate) struct SegmentContent {
    segment: Arc<PeerSegment>,
    len: usize,
    peer_segments: Arc<PeerSegments>,
}

impl AsRef<[u8]> for SegmentContent {
    fn as_ref(&self) -> &[u8] {
        // SAFETY: `PeerSegment::begin` has checked that the mapping has room for `len` bytes and
        // that the file has all pages of the mapping. The mapping exists as long as the segment.
        // The file is not shortened while this process holds the lock, which it does until this is
        // dropped. An honest sender does not write there meanwhile; see the crate's section on
        // trust.
        unsafe { std::slice::from_raw_parts(self.segment.file.content(), self.len) }
    }
}

impl Drop for SegmentContent {
    fn drop(&mut self) {
        if !self.peer_segments.owner().is_this() {
            // In a forked child the lock belongs to the parent.
            return;
        }
        let Self {
            segment,
            peer_segments,
            ..
        } = self;
        let Some(waited_for) = segment.end() else {
            return;
        };
        if waited_for {
            peer_segments.domain.paths().ring_once(segment.sender);
        }
        if !segment.file.is_linked() {
            // The sender has ended, or has removed the segment.
            peer_segments.forget_segment(segment);
        }
    }
}
