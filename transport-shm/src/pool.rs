//! The sending side of content for many: segments, and what they are used for. See `segment`.

use std::cmp::Reverse;
use std::io::ErrorKind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};

use bytes::Bytes;
use fipa_transport::{Incarnation, LoanedContent, WayError, WayFault};
use parking_lot::Mutex;

use crate::domain::Domain;
use crate::memory::{Budget, PAGE, no_room, populate};
use crate::segment::{Reference, SegmentFile};

/// How many segments a process has at most.
const MAX_SEGMENTS: usize = 8;

/// Which part of the domain's capacity may lie idle in a process's segments, so that the next
/// content finds its pages.
const IDLE_PART: u64 = 16;

/// The segments of this process.
#[derive(Debug)]
pub(crate) struct Pool {
    own: Incarnation,
    /// From which length on content is worth a segment.
    from: usize,
    /// How many contents letters can refer to. When there are none, nobody need look.
    known: AtomicUsize,
    /// Something is to be given back that somebody still reads.
    waiting: AtomicBool,
    state: Mutex<State>,
    budget: Arc<Budget>,
    // Last: whoever holds content longest removes the domain's traces.
    domain: Arc<Domain>,
}

#[derive(Debug, Default)]
struct State {
    slots: Vec<Slot>,
    closed: bool,
}

#[derive(Debug)]
struct Slot {
    segment: Arc<Segment>,
    purpose: Purpose,
}

#[derive(Debug)]
enum Purpose {
    /// Nobody in this process holds its content. Others may be reading it.
    Idle,
    /// It is being filled.
    Loaned,
    /// Letters can refer to it.
    Known { len: usize, generation: u64 },
}

#[derive(Debug)]
struct Segment {
    number: u64,
    file: SegmentFile,
}

impl Pool {
    pub(crate) fn new(
        own: Incarnation,
        from: usize,
        budget: Arc<Budget>,
        domain: Arc<Domain>,
    ) -> Self {
        Self {
            own,
            from,
            known: AtomicUsize::new(0),
            waiting: AtomicBool::new(false),
            state: Mutex::default(),
            budget,
            domain,
        }
    }

    /// Memory for content of this length, unless it is too short to be worth it.
    pub(crate) fn loan(self: &Arc<Self>, len: usize) -> Result<Option<ManyLoan>, WayError> {
        if len < self.from {
            return Ok(None);
        }
        let mut state = self.state.lock();
        if state.closed {
            return Err(WayError::new(WayFault::Closed, ""));
        }
        let (segment, generation) = match state.begin_idle(len) {
            Some(begun) => begun,
            None => self.make(&mut state, len)?,
        };
        Ok(Some(ManyLoan(Taken {
            segment,
            generation,
            len,
            pool: Arc::clone(self),
        })))
    }

    /// A new segment, in place of idle ones where there are too many or too little memory.
    fn make(&self, state: &mut State, len: usize) -> Result<(Arc<Segment>, u64), WayError> {
        if state.slots.len() >= MAX_SEGMENTS && !self.drop_idle(state) {
            return Err(WayError::new(
                WayFault::Congested,
                format_args!(
                    "{MAX_SEGMENTS} contents for several receivers are held or still being read"
                ),
            ));
        }
        let room = room_for(len);
        let need = room.saturating_add(PAGE) as u64;
        let turn = loop {
            match self.budget.reserve(need) {
                Ok(turn) => break turn,
                Err(error) => {
                    if error.fault == WayFault::TooLarge || !self.drop_idle(state) {
                        return Err(error);
                    }
                }
            }
        };
        // Of the process, because others may still know the segments of an endpoint before.
        static LAST_NUMBER: AtomicU64 = AtomicU64::new(0);
        let number = LAST_NUMBER.fetch_add(1, Ordering::Relaxed) + 1;
        let made = self.make_file(number, room);
        drop(turn);
        let (file, generation) = made.inspect_err(|_| self.remove(number))?;
        let segment = Arc::new(Segment { number, file });
        state.slots.push(Slot {
            segment: Arc::clone(&segment),
            purpose: Purpose::Loaned,
        });
        Ok((segment, generation))
    }

    fn make_file(&self, number: u64, room: usize) -> Result<(SegmentFile, u64), WayError> {
        let path = self.domain.names().content(self.own, number);
        let cannot = |e: std::io::Error| match e.kind() {
            ErrorKind::StorageFull => no_room(room as u64, "is full"),
            _ => {
                let text = format_args!("cannot make {}: {e}", path.display());
                WayError::new(WayFault::Exhausted, text)
            }
        };
        let file = SegmentFile::create(&path, room).map_err(cannot)?;
        // The pages are there; this makes them ones that the sender need not fault in. Before Linux
        // 5.14 that is not possible, and the sender faults them in.
        let _ = populate(file.mapping().start().as_ptr(), file.mapping().len());
        let begun = file.begin();
        let generation = begun.ok_or_else(|| cannot(ErrorKind::ResourceBusy.into()))?;
        Ok((file, generation))
    }

    /// The reference to this content, if letters can refer to it.
    pub(crate) fn find(&self, content: &Bytes) -> Option<Reference> {
        if content.len() < self.from || self.known.load(Ordering::Acquire) == 0 {
            return None;
        }
        let address = content.as_ptr() as usize;
        let state = self.state.lock();
        state.slots.iter().find_map(|slot| match slot.purpose {
            Purpose::Known { len, generation }
                if slot.segment.address() == address && len == content.len() =>
            {
                Some(Reference {
                    segment: slot.segment.number,
                    generation,
                })
            }
            _ => None,
        })
    }

    /// Whether this content would be copied for each of several receivers, and should not be.
    pub(crate) fn copies(&self, content: &Bytes) -> bool {
        content.len() >= self.from && self.find(content).is_none()
    }

    /// Somebody rang, perhaps because it has stopped reading what is to be given back.
    pub(crate) fn trim_if_waiting(&self) {
        if self.waiting.swap(false, Ordering::SeqCst) {
            self.trim(&mut self.state.lock());
        }
    }

    /// Gives back what lies idle beyond measure, the largest first.
    fn trim(&self, state: &mut State) {
        if state.closed {
            return;
        }
        let idle = state.slots.iter().filter(|slot| slot.is_idle());
        let idle: u64 = idle.map(Slot::size).sum();
        let mut beyond = idle.saturating_sub(self.budget.capacity() / IDLE_PART);
        let mut waiting = false;
        state.slots.sort_by_key(|slot| Reverse(slot.size()));
        state.slots.retain(|slot| {
            if beyond == 0 || !slot.is_idle() {
                return true;
            }
            // First this, so that whoever reads either has stopped or will say so.
            slot.segment.file.want();
            let empty = self.emptied(slot);
            waiting |= !empty;
            if empty {
                beyond = beyond.saturating_sub(slot.size());
            }
            !empty
        });
        self.waiting.store(waiting, Ordering::SeqCst);
    }

    /// Gives back one idle segment that nobody reads. Says whether there was one.
    fn drop_idle(&self, state: &mut State) -> bool {
        let mut slots = state.slots.iter();
        let place = slots.position(|slot| slot.is_idle() && self.emptied(slot));
        place.map(|place| state.slots.swap_remove(place)).is_some()
    }

    /// Gives back the memory of a segment, unless somebody reads it.
    fn emptied(&self, slot: &Slot) -> bool {
        let empty = slot.segment.file.empty();
        if empty {
            self.remove(slot.segment.number);
        }
        empty
    }

    fn remove(&self, number: u64) {
        // What cannot be removed now is removed after this process.
        let _ = std::fs::remove_file(self.domain.names().content(self.own, number));
    }

    /// Gives back all that is not held in this process; the rest goes when it is dropped. To be
    /// called before others can take this process for dead.
    pub(crate) fn close(&self) {
        let mut state = self.state.lock();
        state.closed = true;
        state.slots.retain(|slot| {
            if slot.is_idle() && !self.emptied(slot) {
                // Those who read it keep its memory.
                self.remove(slot.segment.number);
            }
            !slot.is_idle()
        });
    }

    /// From now on letters can refer to this content.
    fn register(&self, taken: &Taken) {
        let (len, generation) = (taken.len, taken.generation);
        drop(self.change(taken, Purpose::Known { len, generation }));
    }

    /// Nobody in this process has this content any more.
    fn give_back(&self, taken: &Taken) {
        let segment = &taken.segment;
        // Nobody else waits for this process.
        segment.file.let_go();
        let mut state = self.change(taken, Purpose::Idle);
        if state.closed {
            segment.file.empty();
            self.remove(segment.number);
            state
                .slots
                .retain(|slot| slot.segment.number != segment.number);
        }
        self.trim(&mut state);
    }

    fn change(&self, taken: &Taken, purpose: Purpose) -> parking_lot::MutexGuard<'_, State> {
        let mut state = self.state.lock();
        let mut slots = state.slots.iter_mut();
        if let Some(slot) = slots.find(|slot| slot.segment.number == taken.segment.number) {
            slot.purpose = purpose;
        }
        let known = |slot: &&Slot| matches!(slot.purpose, Purpose::Known { .. });
        let known = state.slots.iter().filter(known).count();
        self.known.store(known, Ordering::Release);
        state
    }
}

impl State {
    /// The smallest idle segment that has room and that nobody reads, and the generation of the
    /// content that begins in it.
    fn begin_idle(&mut self, len: usize) -> Option<(Arc<Segment>, u64)> {
        self.slots.sort_by_key(Slot::size);
        let fits = |slot: &&mut Slot| slot.is_idle() && slot.segment.file.room() >= len;
        self.slots.iter_mut().filter(fits).find_map(|slot| {
            let generation = slot.segment.file.begin()?;
            slot.purpose = Purpose::Loaned;
            Some((Arc::clone(&slot.segment), generation))
        })
    }
}

impl Slot {
    fn is_idle(&self) -> bool {
        matches!(self.purpose, Purpose::Idle)
    }

    /// What it takes, in bytes.
    fn size(&self) -> u64 {
        self.segment.file.mapping().len() as u64
    }
}

impl Segment {
    fn address(&self) -> usize {
        self.file.content() as usize
    }
}

/// How large a segment for content of this length is: at most a quarter larger, so that contents
/// of about the same length can follow each other in it.
fn room_for(len: usize) -> usize {
    let step = (len / 8).next_power_of_two().max(PAGE);
    len.checked_next_multiple_of(step).unwrap_or(len)
}

/// A content of this process, from when its memory is loaned until nobody here holds it.
struct Taken {
    segment: Arc<Segment>,
    generation: u64,
    /// At most the segment's room.
    len: usize,
    pool: Arc<Pool>,
}

impl Drop for Taken {
    fn drop(&mut self) {
        // In a forked child it stays the parent's.
        if self.pool.domain.owner().is_this() {
            self.pool.give_back(self);
        }
    }
}

/// What the application fills in.
pub(crate) struct ManyLoan(Taken);

impl LoanedContent for ManyLoan {
    fn content_mut(&mut self) -> &mut [u8] {
        let Taken { segment, len, .. } = &self.0;
        // SAFETY: the range lies in the segment's mapping, which has room for `len` bytes (the
        // pool gives out no other) and lives as long as the segment. Nothing else refers to it:
        // the segment was idle, this is the only `ManyLoan` of it, borrowed mutably, and no letter
        // refers to this generation before `freeze`. Other processes have it mapped for reading, but
        // make references into it only under the lock and for the generation that is there, and
        // this process had the lock alone when it began this one. The pages are there
        // (`SegmentFile::create`), filled by the kernel or by earlier contents, and the file is not
        // shortened while this process holds the lock.
        unsafe { std::slice::from_raw_parts_mut(segment.file.content(), *len) }
    }

    fn freeze(self: Box<Self>) -> Bytes {
        self.0.pool.register(&self.0);
        Bytes::from_owner(Frozen(self.0))
    }
}

/// The content, readable.
struct Frozen(Taken);

impl AsRef<[u8]> for Frozen {
    fn as_ref(&self) -> &[u8] {
        let Taken { segment, len, .. } = &self.0;
        // SAFETY: in the mapping, as above. Nobody writes there: `ManyLoan` is consumed, and the
        // segment is idle again, and can be loaned, only when this is dropped. The file is not
        // shortened either, because this process holds the lock until then, also when its
        // transport is closed.
        unsafe { std::slice::from_raw_parts(segment.file.content(), *len) }
    }
}
