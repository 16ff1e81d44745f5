//! The receiving side of content for many: segments of other processes, being read or kept open
//! because the next content may lie there. See `segment`.

use std::io::{self, ErrorKind};
use std::sync::Arc;

use fipa_transport::Incarnation;
use parking_lot::Mutex;

use crate::domain::Domain;
use crate::fork::Owner;
use crate::segment::{Reference, SegmentFile};

/// How many segments are kept open.
const MAX_OPEN: usize = 32;

/// Why content cannot be read where it is.
#[derive(Debug)]
pub(crate) enum NotRead {
    /// It is not there, or not any more: the letter is not one that its sender waits for.
    Gone,
    /// This process has no memory or descriptors for it now.
    NoRoom,
}

/// The segments of others that this process has open.
pub(crate) struct Library {
    /// In the order in which they were used.
    open: Mutex<Vec<Arc<Volume>>>,
    domain: Arc<Domain>,
}

/// Another process's segment.
struct Volume {
    sender: Incarnation,
    number: u64,
    file: SegmentFile,
    reading: Mutex<Reading>,
}

/// Which content is being read, and by how many. While there are any, this process has the lock.
struct Reading {
    readers: usize,
    /// None when the segment is not whole any more.
    generation: Option<u64>,
}

impl Library {
    pub(crate) fn new(domain: Arc<Domain>) -> Self {
        Self {
            open: Mutex::default(),
            domain,
        }
    }

    /// Content of this length in a sender's segment.
    pub(crate) fn read(
        self: &Arc<Self>,
        sender: Incarnation,
        reference: Reference,
        len: usize,
    ) -> Result<Borrowed, NotRead> {
        let volume = self.volume(sender, reference.segment)?;
        if !volume.begin(reference.generation, len) {
            return Err(NotRead::Gone);
        }
        Ok(Borrowed {
            volume,
            len,
            library: Arc::clone(self),
        })
    }

    fn volume(&self, sender: Incarnation, number: u64) -> Result<Arc<Volume>, NotRead> {
        let mut open = self.open.lock();
        let is = |one: &Arc<Volume>| one.sender == sender && one.number == number;
        let volume = match open.iter().position(is) {
            Some(place) => open.remove(place),
            None => {
                let path = self.domain.names().content(sender, number);
                let file = SegmentFile::open(&path).map_err(not_read)?;
                Arc::new(Volume {
                    sender,
                    number,
                    file,
                    reading: Mutex::new(Reading {
                        readers: 0,
                        generation: None,
                    }),
                })
            }
        };
        if open.len() >= MAX_OPEN {
            // The one not used for longest; whoever reads it keeps it.
            open.remove(0);
        }
        open.push(Arc::clone(&volume));
        Ok(volume)
    }

    pub(crate) fn owner(&self) -> Owner {
        self.domain.owner()
    }

    /// A process has ended: what it had is kept only by those who read it.
    pub(crate) fn forget(&self, sender: Incarnation) {
        self.open.lock().retain(|one| one.sender != sender);
    }

    fn forget_volume(&self, volume: &Arc<Volume>) {
        self.open.lock().retain(|one| !Arc::ptr_eq(one, volume));
    }
}

fn not_read(error: io::Error) -> NotRead {
    match error.kind() {
        ErrorKind::NotFound | ErrorKind::InvalidData => NotRead::Gone,
        _ => NotRead::NoRoom,
    }
}

impl Volume {
    /// One reader more, if this content of this length is there.
    fn begin(&self, generation: u64, len: usize) -> bool {
        let mut reading = self.reading.lock();
        if reading.readers == 0 {
            if self.file.share().is_err() {
                return false;
            }
            // Neither changes as long as this process has the lock.
            let whole = self.file.is_whole();
            reading.generation = whole.then(|| self.file.generation());
        }
        if reading.generation == Some(generation) && len <= self.file.room() {
            reading.readers += 1;
            return true;
        }
        if reading.readers == 0 {
            self.file.let_go();
        }
        false
    }

    /// One reader less. After the last one, says whether the sender waits for that.
    fn end(&self) -> Option<bool> {
        let mut reading = self.reading.lock();
        reading.readers -= 1;
        (reading.readers == 0).then(|| self.file.let_go())
    }
}

/// Content in a sender's segment.
pub(crate) struct Borrowed {
    volume: Arc<Volume>,
    len: usize,
    library: Arc<Library>,
}

impl AsRef<[u8]> for Borrowed {
    fn as_ref(&self) -> &[u8] {
        // SAFETY: `Volume::begin` has found `len` bytes of room in the mapping, which lives as
        // long as the volume, and all pages of the mapping in the file, which is not shortened
        // while this process has the lock: until this is dropped. An honest sender does not write
        // there meanwhile; see the crate's documentation on trust.
        unsafe { std::slice::from_raw_parts(self.volume.file.content(), self.len) }
    }
}

impl Drop for Borrowed {
    fn drop(&mut self) {
        if !self.library.owner().is_this() {
            // In a forked child, whose lock is the parent's.
            return;
        }
        let Self {
            volume, library, ..
        } = self;
        let Some(waited_for) = volume.end() else {
            return;
        };
        if waited_for {
            library.domain.names().ring_once(volume.sender);
        }
        if !volume.file.is_there() {
            // Its sender has ended, or wants the memory back.
            library.forget_volume(volume);
        }
    }
}
