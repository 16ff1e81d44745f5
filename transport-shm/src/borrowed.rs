//! Content that is read in place, and the slots of its senders that it holds.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use parking_lot::Mutex;

use crate::ShmConfig;
use crate::counters::Tally;
use crate::layout::{ANSWERS, Active, UninitAck};
use crate::memory::MappedPtr;
use crate::peer_segments::{PeerSegments, SegmentContent};
use crate::presence::Doorbell;

/// Maximum number of late answers to all senders together. The others remain for parcels that are
/// answered at once.
const MAX_LATE_ANSWERS: usize = ANSWERS / 2;

/// The owner of a request: this value alone, or the handed-out content.
pub(crate) enum RequestOwner {
    Unshared(Active),
    /// The content owns the request, too.
    Content(Arc<HeldRequest>),
}

impl RequestOwner {
    /// Loans memory for a response.
    pub(crate) fn loan_response(&self) -> Option<UninitAck> {
        match self {
            Self::Unshared(active) => active.loan_uninit().ok(),
            Self::Content(request) => request.active.lock().as_ref()?.loan_uninit().ok(),
        }
    }
}

/// A request whose content is read in place, and whose slot is counted as held by its sender.
pub(crate) struct HeldRequest {
    /// `Some` until this is dropped.
    pub(crate) active: Mutex<Option<Active>>,
    pub(crate) sender: u128,
    pub(crate) borrows: Arc<BorrowLimits>,
}

impl HeldRequest {
    pub(crate) fn sender(&self) -> u128 {
        self.sender
    }
}

impl Drop for HeldRequest {
    fn drop(&mut self) {
        let active = self.active.get_mut().take();
        if !self.borrows.peer_segments.owner().is_this() {
            // In a forked child, a release would take the memory from the parent.
            std::mem::forget(active);
            return;
        }
        // The memory first, then the count: a slot that counts as free must be free.
        drop(active);
        self.borrows.end(self.sender);
    }
}

/// Content in the payload of a sender's request, which is read in place.
pub(crate) struct BorrowedContent {
    pub(crate) bytes: MappedPtr<[u8]>,
    pub(crate) _request: Arc<HeldRequest>,
}

impl AsRef<[u8]> for BorrowedContent {
    fn as_ref(&self) -> &[u8] {
        // SAFETY: the range is in the payload of the held request, which stays mapped as long
        // as that exists: the server keeps the connection of an ended sender while content is held
        // there, and `BorrowLimits::begin` bounds the number of such connections below the number
        // that it keeps. An honest sender does not write there after sending; see the crate's
        // section on trust.
        unsafe { self.bytes.0.as_ref() }
    }
}

/// Content in a sender's segment, counted as held.
pub(crate) struct BorrowedSegmentContent {
    pub(crate) content: SegmentContent,
    pub(crate) borrows: Arc<BorrowLimits>,
}

impl AsRef<[u8]> for BorrowedSegmentContent {
    fn as_ref(&self) -> &[u8] {
        self.content.as_ref()
    }
}

impl Drop for BorrowedSegmentContent {
    fn drop(&mut self) {
        let _held = self.borrows.held.lock();
        self.borrows.tally.borrowed.fetch_sub(1, Ordering::Relaxed);
    }
}

/// Limits on the content that is held in place, and on late answers.
pub(crate) struct BorrowLimits {
    pub(crate) per_sender: usize,
    /// Number of held slots of a sender at which its parcels are answered at once.
    pub(crate) late_per_sender: usize,
    pub(crate) total: usize,
    pub(crate) held: Mutex<HeldSlots>,
    /// Whether the mailbox cannot be drained until content is released.
    pub(crate) waiting: AtomicBool,
    pub(crate) doorbell: Arc<Doorbell>,
    pub(crate) tally: Arc<Tally>,
    // Last: the last owner of content removes the domain's files, which the segments' owner does.
    pub(crate) peer_segments: Arc<PeerSegments>,
}

/// The slots of senders that are held.
#[derive(Default)]
pub(crate) struct HeldSlots {
    /// Number of held slots of each sender. The list is short enough for a linear search.
    of: Vec<(u128, usize)>,
    /// Number of late answers to all senders.
    late: usize,
}

impl HeldSlots {
    fn count(&self, sender: u128) -> usize {
        let mut of = self.of.iter();
        of.find(|(one, _)| *one == sender)
            .map_or(0, |(_, count)| *count)
    }

    /// Counts one more slot of this sender, up to `most`.
    fn begin(&mut self, sender: u128, most: usize) -> bool {
        match self.of.iter().position(|(one, _)| *one == sender) {
            Some(place) if self.of[place].1 < most => self.of[place].1 += 1,
            None if self.of.len() < ShmConfig::MAX_LENDERS => self.of.push((sender, 1)),
            _ => return false,
        }
        true
    }

    fn end(&mut self, sender: u128) {
        if let Some(place) = self.of.iter().position(|(one, _)| *one == sender) {
            self.of[place].1 -= 1;
            if self.of[place].1 == 0 {
                self.of.swap_remove(place);
            }
        }
    }
}

impl BorrowLimits {
    /// Counts one more content in a segment, which takes no slot of its sender. False at the limit.
    pub(crate) fn begin_segment(&self) -> bool {
        let _held = self.held.lock();
        let few = self.tally.borrowed.load(Ordering::Relaxed) < self.total as u64;
        if few {
            self.tally.borrowed.fetch_add(1, Ordering::Relaxed);
        }
        few
    }

    /// Counts one more content of this sender, if a slot stays free for its next letter.
    pub(crate) fn begin(&self, sender: u128) -> bool {
        let mut held = self.held.lock();
        // Changed only under the lock.
        if self.tally.borrowed.load(Ordering::Relaxed) >= self.total as u64 {
            return false;
        }
        let begun = held.begin(sender, self.per_sender);
        if begun {
            self.tally.borrowed.fetch_add(1, Ordering::Relaxed);
        }
        begun
    }

    /// Counts one more late answer to this sender, if fewer than half of its slots are held without
    /// it. `counted` is whether the slot is held by content already.
    pub(crate) fn begin_late_answer(&self, sender: u128, counted: bool) -> bool {
        let mut held = self.held.lock();
        let others = held.count(sender) - usize::from(counted);
        let begun = held.late < MAX_LATE_ANSWERS
            && others < self.late_per_sender
            && (counted || held.begin(sender, self.late_per_sender));
        held.late += usize::from(begun);
        begun
    }

    pub(crate) fn end_late_answer(&self, sender: u128, counted: bool) {
        let mut held = self.held.lock();
        held.late -= 1;
        if !counted {
            held.end(sender);
        }
        drop(held);
        self.drain_again();
    }

    fn end(&self, sender: u128) {
        let mut held = self.held.lock();
        held.end(sender);
        self.tally.borrowed.fetch_sub(1, Ordering::Relaxed);
        drop(held);
        self.drain_again();
    }

    /// Rings the doorbell if the mailbox waits for a slot.
    fn drain_again(&self) {
        if self.waiting.swap(false, Ordering::SeqCst) {
            self.doorbell.ring();
        }
    }
}
