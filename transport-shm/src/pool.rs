//! The sending side of content for several receivers: segments and their use. See `segment`.

use std::cmp::Reverse;
use std::io::ErrorKind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};

use bytes::Bytes;
use fipa_transport::{Incarnation, LoanedContent, TransportError, TransportErrorKind};
use parking_lot::Mutex;

use crate::domain_files::DomainFiles;
use crate::errors::allocating;
use crate::memory::{Budget, PAGE, no_room_error, populate};
use crate::segment::{ContentReference, SegmentFile};

/// Maximum number of segments of a process. Each receiver that is stopped may hold one.
const MAX_SEGMENTS: usize = 64;

/// Maximum number of idle segments of a process.
const MAX_IDLE: usize = 8;

/// Fraction of the domain's capacity, as a divisor, that idle segments of a process may use. The
/// next content then finds its pages allocated.
const IDLE_PART: u64 = 16;

/// The segments of this process.
#[derive(Debug)]
pub(crate) struct Pool {
    own: Incarnation,
    /// Minimum length in bytes of content for a segment.
    share_from: usize,
    /// Number of contents that letters can refer to. If it is 0, no lookup is needed.
    registered: AtomicUsize,
    /// Whether memory is to be released that another process still reads.
    waiting: AtomicBool,
    state: Mutex<State>,
    budget: Arc<Budget>,
    // Last: the last owner of content removes the domain's files.
    domain: Arc<DomainFiles>,
}

#[derive(Debug, Default)]
struct State {
    slots: Vec<Slot>,
    closed: bool,
}

#[derive(Debug)]
struct Slot {
    segment: Arc<Segment>,
    usage: Usage,
}

#[derive(Debug)]
enum Usage {
    /// This process does not hold the content. Other processes may be reading it.
    Idle,
    /// The application is writing the content.
    Loaned,
    /// Letters can refer to the content.
    Registered { len: usize, generation: u64 },
}

#[derive(Debug)]
struct Segment {
    number: u64,
    file: SegmentFile,
}

impl Pool {
    pub(crate) fn new(
        own: Incarnation,
        share_from: usize,
        budget: Arc<Budget>,
        domain: Arc<DomainFiles>,
    ) -> Self {
        Self {
            own,
            share_from,
            registered: AtomicUsize::new(0),
            waiting: AtomicBool::new(false),
            state: Mutex::default(),
            budget,
            domain,
        }
    }

    /// Loans memory for content of this length. `None` if the content is too short for a segment.
    pub(crate) fn loan(
        self: &Arc<Self>,
        len: usize,
    ) -> Result<Option<SharedContentLoan>, TransportError> {
        if len < self.share_from {
            return Ok(None);
        }
        let mut state = self.state.lock();
        if state.closed {
            return Err(TransportError::new(TransportErrorKind::Closed, ""));
        }
        let (segment, generation) = match state.begin_idle(len) {
            Some(begun) => begun,
            None => self.create(&mut state, len)?,
        };
        Ok(Some(SharedContentLoan(LoanedSegment {
            segment,
            generation,
            len,
            pool: Arc::clone(self),
        })))
    }

    /// Creates a segment. Replaces idle ones if there are too many or memory is short.
    fn create(&self, state: &mut State, len: usize) -> Result<(Arc<Segment>, u64), TransportError> {
        if state.slots.len() >= MAX_SEGMENTS && !self.drop_idle(state) {
            return Err(TransportError::new(
                TransportErrorKind::Congested,
                format_args!(
                    "{MAX_SEGMENTS} contents for several receivers are already held or being read"
                ),
            ));
        }
        let room = room_for(len);
        let need = room.saturating_add(PAGE) as u64;
        // Without a wait: senders need the state that is locked here.
        let lock = self.budget.try_lock()?.ok_or_else(allocating)?;
        while let Err(error) = self.budget.check(need) {
            if error.fault == TransportErrorKind::TooLarge || !self.drop_idle(state) {
                return Err(error);
            }
        }
        // Numbers are unique in the process: peers may still have segments of an earlier endpoint
        // open.
        static LAST_NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = LAST_NUMBER.fetch_add(1, Ordering::Relaxed) + 1;
        let created = self.make_file(number, room);
        drop(lock);
        let (file, generation) = created.inspect_err(|_| self.remove(number))?;
        let segment = Arc::new(Segment { number, file });
        state.slots.push(Slot {
            segment: Arc::clone(&segment),
            usage: Usage::Loaned,
        });
        Ok((segment, generation))
    }

    fn make_file(&self, number: u64, room: usize) -> Result<(SegmentFile, u64), TransportError> {
        let path = self.domain.paths().segment(self.own, number);
        let cannot = |e: std::io::Error| match e.kind() {
            ErrorKind::StorageFull => no_room_error(room as u64, "is full"),
            _ => {
                let text = format_args!("cannot create {}: {e}", path.display());
                TransportError::new(TransportErrorKind::Exhausted, text)
            }
        };
        let file = SegmentFile::create(&path, room).map_err(cannot)?;
        // The pages are allocated; this maps them, which saves page faults of the sender. Before
        // Linux 5.14 that is not possible, and the sender takes the faults.
        let _ = populate(file.mapping().start().as_ptr(), file.mapping().len());
        let begun = file.begin();
        let generation = begun.ok_or_else(|| cannot(ErrorKind::ResourceBusy.into()))?;
        Ok((file, generation))
    }

    /// The reference to this content, if letters can refer to it.
    pub(crate) fn find(&self, content: &Bytes) -> Option<ContentReference> {
        if content.len() < self.share_from || self.registered.load(Ordering::Acquire) == 0 {
            return None;
        }
        let address = content.as_ptr() as usize;
        let state = self.state.lock();
        state.slots.iter().find_map(|slot| match slot.usage {
            Usage::Registered { len, generation }
                if slot.segment.address() == address && len == content.len() =>
            {
                Some(ContentReference {
                    segment: slot.segment.number,
                    generation,
                })
            }
            _ => None,
        })
    }

    /// Whether this content is long enough for a segment but not in one.
    pub(crate) fn copies(&self, content: &Bytes) -> bool {
        content.len() >= self.share_from && self.find(content).is_none()
    }

    /// Retries a pending release. Called when a doorbell rang: a reader may have stopped.
    pub(crate) fn trim_if_waiting(&self) {
        if self.waiting.swap(false, Ordering::SeqCst) {
            self.trim(&mut self.state.lock());
        }
    }

    /// Releases idle segments beyond the limit, the largest first.
    fn trim(&self, state: &mut State) {
        if state.closed {
            return;
        }
        let idle = || state.slots.iter().filter(|slot| slot.is_idle());
        let size: u64 = idle().map(Slot::size).sum();
        let mut beyond = size.saturating_sub(self.budget.capacity() / IDLE_PART);
        let mut too_many = idle().count().saturating_sub(MAX_IDLE);
        let mut waiting = false;
        state.slots.sort_by_key(|slot| Reverse(slot.size()));
        state.slots.retain(|slot| {
            if (beyond == 0 && too_many == 0) || !slot.is_idle() {
                return true;
            }
            // Requested first, so that a reader either has stopped or will ring.
            slot.segment.file.request_notice();
            let empty = self.release_memory(slot);
            waiting |= !empty;
            if empty {
                beyond = beyond.saturating_sub(slot.size());
                too_many = too_many.saturating_sub(1);
            }
            !empty
        });
        self.waiting.store(waiting, Ordering::SeqCst);
    }

    /// Releases one idle segment that is not read. Returns whether there was one.
    fn drop_idle(&self, state: &mut State) -> bool {
        let mut slots = state.slots.iter();
        let place = slots.position(|slot| slot.is_idle() && self.release_memory(slot));
        place.map(|place| state.slots.swap_remove(place)).is_some()
    }

    /// Releases the memory of a segment, unless it is read.
    fn release_memory(&self, slot: &Slot) -> bool {
        let empty = slot.segment.file.empty();
        if empty {
            self.remove(slot.segment.number);
        }
        empty
    }

    fn remove(&self, number: u64) {
        // A file that cannot be removed now is removed after the end of this process.
        let _ = std::fs::remove_file(self.domain.paths().segment(self.own, number));
    }

    /// Releases all segments that this process does not hold; the others follow when they are
    /// dropped. Must run before other processes can consider this process dead.
    pub(crate) fn close(&self) {
        let mut state = self.state.lock();
        state.closed = true;
        state.slots.retain(|slot| {
            if slot.is_idle() && !self.release_memory(slot) {
                // Processes that read it keep its memory.
                self.remove(slot.segment.number);
            }
            !slot.is_idle()
        });
    }

    /// Makes the content available to letters.
    fn register(&self, taken: &LoanedSegment) {
        let (len, generation) = (taken.len, taken.generation);
        drop(self.change(taken, Usage::Registered { len, generation }));
    }

    /// Releases a content that this process no longer holds.
    fn release(&self, taken: &LoanedSegment) {
        let segment = &taken.segment;
        // The result is not needed: only the process's own pool waits for this segment.
        segment.file.unlock();
        let mut state = self.change(taken, Usage::Idle);
        if state.closed {
            segment.file.empty();
            self.remove(segment.number);
            state
                .slots
                .retain(|slot| slot.segment.number != segment.number);
        }
        self.trim(&mut state);
    }

    fn change(&self, taken: &LoanedSegment, usage: Usage) -> parking_lot::MutexGuard<'_, State> {
        let mut state = self.state.lock();
        let mut slots = state.slots.iter_mut();
        if let Some(slot) = slots.find(|slot| slot.segment.number == taken.segment.number) {
            slot.usage = usage;
        }
        let registered = |slot: &&Slot| matches!(slot.usage, Usage::Registered { .. });
        let registered = state.slots.iter().filter(registered).count();
        self.registered.store(registered, Ordering::Release);
        state
    }
}

impl State {
    /// Begins content in the smallest idle segment that has room and is not read. Returns the
    /// segment and the generation of the content.
    fn begin_idle(&mut self, len: usize) -> Option<(Arc<Segment>, u64)> {
        self.slots.sort_by_key(Slot::size);
        let fits = |slot: &&mut Slot| slot.is_idle() && slot.segment.file.room() >= len;
        self.slots.iter_mut().filter(fits).find_map(|slot| {
            let generation = slot.segment.file.begin()?;
            slot.usage = Usage::Loaned;
            Some((Arc::clone(&slot.segment), generation))
        })
    }
}

impl Slot {
    fn is_idle(&self) -> bool {
        matches!(self.usage, Usage::Idle)
    }

    /// Size in bytes.
    fn size(&self) -> u64 {
        self.segment.file.mapping().len() as u64
    }
}

impl Segment {
    fn address(&self) -> usize {
        self.file.content() as usize
    }
}

/// Room of a segment for content of this length. At most a quarter larger, so that contents of
/// similar length can reuse it.
fn room_for(len: usize) -> usize {
    let step = (len / 8).next_power_of_two().max(PAGE);
    len.checked_next_multiple_of(step).unwrap_or(len)
}

/// A content of this process, from the loan of its memory until its last owner here drops it.
struct LoanedSegment {
    segment: Arc<Segment>,
    generation: u64,
    /// At most the segment's room.
    len: usize,
    pool: Arc<Pool>,
}

impl Drop for LoanedSegment {
    fn drop(&mut self) {
        // In a forked child the content belongs to the parent.
        if self.pool.domain.owner().is_this() {
            self.pool.release(self);
        }
    }
}

/// The writable content.
pub(crate) struct SharedContentLoan(LoanedSegment);

impl LoanedContent for SharedContentLoan {
    fn content_mut(&mut self) -> &mut [u8] {
        let LoanedSegment { segment, len, .. } = &self.0;
        // SAFETY: the range is in the segment's mapping, which has room for `len` bytes (the pool
        // loans no other segment) and exists as long as the segment. Nothing else refers to it: the
        // segment was idle, this is its only `SharedContentLoan`, borrowed mutably, and no letter
        // refers to this generation before `freeze`. Other processes map the segment for reading.
        // They create references into it only under the lock and for the current generation, and
        // this process held the exclusive lock when it began this one. The pages are allocated
        // (`SegmentFile::create`) and initialized by the kernel or by earlier contents. The file is
        // not shortened while this process holds the lock.
        unsafe { std::slice::from_raw_parts_mut(segment.file.content(), *len) }
    }

    fn freeze(self: Box<Self>) -> Bytes {
        self.0.pool.register(&self.0);
        Bytes::from_owner(Frozen(self.0))
    }
}

/// The readable content.
struct Frozen(LoanedSegment);

impl AsRef<[u8]> for Frozen {
    fn as_ref(&self) -> &[u8] {
        let LoanedSegment { segment, len, .. } = &self.0;
        // SAFETY: the range is in the segment's mapping, which has room for `len` bytes and exists
        // as long as the segment. No process writes there: the `SharedContentLoan` is consumed, and
        // the segment becomes idle, and can be loaned again, only when this is dropped. Until then
        // this process holds the lock, also after its transport is closed, so the file is not
        // shortened.
        unsafe { std::slice::from_raw_parts(segment.file.content(), *len) }
    }
}
