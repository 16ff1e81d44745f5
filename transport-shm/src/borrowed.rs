//! Content that is read in place, and the slots of its senders that it holds.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Weak};

use fipa_transport::log_limit;
use parking_lot::Mutex;

use crate::ShmConfig;
use crate::counters::{Tally, count_alone};
use crate::layout::{ANSWERS, Active, UninitAck};
use crate::memory::MappedPtr;
use crate::peer_segments::{PeerSegments, SegmentContent};
use crate::presence::{Doorbell, Presence};

/// Maximum number of late answers to all senders together. The others remain for parcels that are
/// answered at once.
const MAX_LATE_ANSWERS: usize = ANSWERS / 2;

/// Number of contents that are copied, without a release between them, before the program is told. A burst is no reason:
/// it waits in the queue of an agent, which releases its letters one after the other.
const COPIES_BEFORE_WARNING: u32 = 64;

/// The endpoints of this process: an address says nothing about the endpoint that has it.
static ENDPOINTS: Mutex<Vec<Weak<BorrowLimits>>> = Mutex::new(Vec::new());

/// Whether this process reads these bytes in place, in shared memory of the process that sent them. Such content takes
/// one of a bounded number of places; other content is a copy of its own.
#[must_use]
pub fn is_in_place(content: &[u8]) -> bool {
    // The last reference to an endpoint removes its files: not under this lock.
    let endpoints: Vec<_> = ENDPOINTS.lock().iter().filter_map(Weak::upgrade).collect();
    let address = content.as_ptr().addr();
    let has = |limits: &Arc<BorrowLimits>| limits.held.lock().contains(address);
    !content.is_empty() && endpoints.iter().any(has)
}

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
    /// The address of the content.
    pub(crate) content: usize,
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
        self.borrows.end(self.sender, self.content);
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
        let mut held = self.borrows.held.lock();
        held.forget(self.as_ref().as_ptr().addr());
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
    /// The addresses of the contents that are held. An address is there twice if two agents have its content.
    contents: Vec<Range<usize>>,
    /// Number of contents that were copied since the last release.
    copies: u32,
}

impl HeldSlots {
    fn contains(&self, address: usize) -> bool {
        let mut contents = self.contents.iter();
        contents.any(|content| content.contains(&address))
    }

    fn remember(&mut self, content: &[u8]) {
        let start = content.as_ptr().addr();
        self.contents.push(start..start + content.len());
    }

    /// Forgets a content that is released.
    fn forget(&mut self, start: usize) {
        // The newest is mostly the first to be released.
        if let Some(place) = self.contents.iter().rposition(|one| one.start == start) {
            self.contents.swap_remove(place);
        }
        self.copies = 0;
    }

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
    pub(crate) fn create(
        config: &ShmConfig,
        presence: &Presence,
        tally: Arc<Tally>,
        peer_segments: Arc<PeerSegments>,
    ) -> Arc<Self> {
        let limits = Arc::new(Self {
            per_sender: config.window - 1,
            late_per_sender: config.window / 2,
            total: config.max_borrowed,
            held: Mutex::default(),
            waiting: AtomicBool::new(false),
            doorbell: presence.doorbell().clone(),
            tally,
            peer_segments,
        });
        let mut endpoints = ENDPOINTS.lock();
        endpoints.retain(|endpoint| endpoint.strong_count() > 0);
        endpoints.push(Arc::downgrade(&limits));
        limits
    }

    /// Counts one more content in a segment, which takes no slot of its sender. False at the limit: the content is then
    /// copied.
    pub(crate) fn begin_segment(&self, content: &[u8]) -> bool {
        self.begin_if(content, |_| true)
    }

    /// Counts one more content of this sender, if a slot stays free for its next letter. If not, the content is copied.
    pub(crate) fn begin(&self, sender: u128, content: &[u8]) -> bool {
        self.begin_if(content, |held| held.begin(sender, self.per_sender))
    }

    fn begin_if(&self, content: &[u8], begin: impl FnOnce(&mut HeldSlots) -> bool) -> bool {
        let mut held = self.held.lock();
        // Changed only under the lock.
        let few = self.tally.borrowed.load(Ordering::Relaxed) < self.total as u64;
        if few && begin(&mut held) {
            self.tally.borrowed.fetch_add(1, Ordering::Relaxed);
            held.remember(content);
            return true;
        }
        held.copies = held.copies.saturating_add(1);
        let warn = held.copies == COPIES_BEFORE_WARNING;
        drop(held);
        count_alone(&self.tally.copied_full);
        if warn {
            let (each, all) = (self.per_sender, self.total);
            log_limit::warn!(
                "the program keeps the content of letters: {COPIES_BEFORE_WARNING} further contents were copied. A process reads at most {each} contents of one sender in place, and {all} of all; release a letter when it has been read, and copy what is kept"
            );
        }
        false
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

    fn end(&self, sender: u128, content: usize) {
        let mut held = self.held.lock();
        held.end(sender);
        held.forget(content);
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
