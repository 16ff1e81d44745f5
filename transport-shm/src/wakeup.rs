//! The words of a status page that processes share, and the rules for reading and writing them: when a peer must
//! ring the doorbell, and when a poll must look into the mailbox.
//!
//! `tests/interleavings.rs` compiles this file with the atomics of loom, which try all interleavings of a few
//! threads. Therefore the file takes everything that threads share from `crate::sync`.

use crate::sync::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};

/// The words of the status page. Peers write only the announcements, and the process writes all other words.
#[derive(Debug, Default)]
#[repr(C)]
pub(crate) struct StatusWords {
    /// Number of threads of the process that poll.
    pollers: AtomicU32,
    /// Not 0 if the process answers parcels in another order than it takes them. Set before the
    /// process listens.
    answers_late: AtomicU32,
    /// Number of times the process has cleared its doorbell before it polled.
    wakeups: AtomicU64,
    /// Tells this mailbox from earlier ones of the process. Set before the process listens.
    generation: AtomicU64,
    /// Keeps `polls`, which changes often, in a cache line of its own.
    _apart: [u64; 5],
    /// Number of times the process has found its mailbox empty, or emptied it.
    polls: AtomicU64,
    /// Keeps apart what the process and its peers write, also from processors that load two cache
    /// lines at once.
    _apart_from_announced: [u64; 23],
    /// Number of parcels that peers have announced.
    announced: AtomicU64,
    /// Keeps `announced`, which the process polls, in a cache line of its own.
    _apart_from_settled: [u64; 15],
    /// Number of announced parcels that are in the mailbox, were in it, or never will be.
    settled: AtomicU64,
}

impl StatusWords {
    /// Announces to other processes, until the guard is dropped, that this process polls and needs
    /// no wake-up. The caller must poll once more after dropping the guard.
    ///
    /// A peer that has put something into the mailbox reads the page afterwards, and rings if no
    /// thread polls ([`RingState::is_awake`]). A sequentially consistent fence stands between the
    /// peer's write and its read, and between the guard's write and the next poll here. So either
    /// the peer sees that no thread polls, and rings, or the poll after the drop finds the parcel.
    pub(crate) fn begin_polling(&self) -> PollGuard<'_> {
        self.pollers.fetch_add(1, Ordering::SeqCst);
        PollGuard(&self.pollers)
    }

    /// Whether a thread of the process polls. If so, that thread polls once more.
    pub(crate) fn is_polling(&self) -> bool {
        self.pollers.load(Ordering::SeqCst) != 0
    }

    /// Counts that the doorbell has been cleared. The caller polls afterwards.
    pub(crate) fn count_wakeup(&self) {
        self.wakeups.fetch_add(1, Ordering::SeqCst);
        // A peer that has read the previous count stored its parcel before that, so the poll that
        // follows finds it.
        fence(Ordering::SeqCst);
    }

    /// Counts a poll that found the mailbox empty at its end. One thread at a time calls this.
    pub(crate) fn count_poll(&self) {
        let before = self.polls.load(Ordering::Relaxed);
        self.polls.store(before.wrapping_add(1), Ordering::Release);
    }

    /// Number of completed polls; 0 if the process does not listen yet.
    pub(crate) fn polls(&self) -> u64 {
        self.polls.load(Ordering::Acquire)
    }

    /// States that the process may answer parcels in another order than it takes them.
    pub(crate) fn answer_late(&self) {
        self.answers_late.store(1, Ordering::Release);
    }

    /// Whether the process may answer parcels in another order than it takes them.
    pub(crate) fn answers_late(&self) -> bool {
        self.answers_late.load(Ordering::Acquire) != 0
    }

    /// States the generation of the mailbox: a part of its name.
    pub(crate) fn set_generation(&self, generation: u64) {
        self.generation.store(generation, Ordering::Release);
    }

    /// The generation of the mailbox: a part of its name.
    pub(crate) fn generation(&self) -> u64 {
        self.generation.load(Ordering::Acquire)
    }

    /// Announces a parcel, before it is put into the mailbox. The announcement is settled when the guard is
    /// dropped, after sending.
    pub(crate) fn announce(&self) -> Announcement<'_> {
        // Before the fence in `RingState::is_awake`: a peer that sees a polling process has
        // announced its parcel to that process's last check.
        self.announced.fetch_add(1, Ordering::SeqCst);
        Announcement(&self.settled)
    }
}

/// Marks that a thread of the process polls.
#[derive(Debug)]
pub(crate) struct PollGuard<'a>(&'a AtomicU32);

impl Drop for PollGuard<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
        fence(Ordering::SeqCst);
    }
}

/// An announcement of a parcel, which is settled when this is dropped.
#[derive(Debug)]
pub(crate) struct Announcement<'a>(&'a AtomicU64);

impl Drop for Announcement<'_> {
    fn drop(&mut self) {
        self.0.fetch_add(1, Ordering::Release);
    }
}

/// The account of the process over the parcels that peers have announced to it.
///
/// A peer announces a parcel *before* it puts it into the mailbox, and afterwards counts the
/// announcement as settled. So as long as the process has taken as many parcels as were
/// announced, its mailbox is empty, and the process need not visit the slots of all possible
/// connections to know that. An announced parcel may also never arrive, because sending failed or
/// the parcel was abandoned. Therefore the process corrects its account when all announcements are
/// settled and the mailbox is empty.
///
/// A peer that is killed between the two steps leaves an announcement that is never settled. Each poll then
/// visits all slots, until [`MAX_EMPTY_LOOKS`](Self::MAX_EMPTY_LOOKS) of them have found nothing. Then the account writes the
/// announcement off. If its peer was only slow, the parcel is found by the look without an announcement that
/// [`must_look`](Self::must_look) demands at the end of each polling, as long as something is written off.
#[derive(Debug, Default)]
pub(crate) struct Account {
    /// Number of announced parcels that were taken or never arrived.
    accounted: u64,
    /// Number of announcements that are not settled and count as settled.
    written_off: u64,
    /// The words `announced` and `settled` at the last look that found nothing, and the number of such looks
    /// since they changed.
    waited: (u64, u64, u32),
}

impl Account {
    /// Number of looks into an empty mailbox after which announcements that are not settled are written off.
    pub(crate) const MAX_EMPTY_LOOKS: u32 = if cfg!(test) { 3 } else { 4096 };

    /// Whether the mailbox may have a parcel that was announced.
    pub(crate) fn is_open(&self, words: &StatusWords) -> bool {
        words.announced.load(Ordering::Acquire) != self.accounted
    }

    /// Whether the process must look into the mailbox before it stops polling: a parcel was announced, or the
    /// announcement of a parcel was written off.
    pub(crate) fn must_look(&self, words: &StatusWords) -> bool {
        self.written_off > 0 || self.is_open(words)
    }

    /// Takes a parcel out of the mailbox with `take`, or finds that there is none.
    ///
    /// # Errors
    /// The errors of the function `take`.
    pub(crate) fn take<T, E>(
        &mut self,
        words: &StatusWords,
        mut take: impl FnMut() -> Result<Option<T>, E>,
    ) -> Result<Option<T>, E> {
        let mut taken = take()?;
        if taken.is_none()
            && let Some((announced, open)) = self.settled(words)
            && (announced, open) != (self.accounted, self.written_off)
        {
            // Parcels that were sent in between are found now. If there is none, the rest of the
            // announced parcels never arrive.
            taken = take()?;
            if taken.is_none() {
                (self.accounted, self.written_off) = (announced, open);
            }
        }
        if taken.is_some() {
            self.accounted = self.accounted.wrapping_add(1);
        }
        Ok(taken)
    }

    /// Number of announced parcels, and number of those that are not settled, if all of them are in the
    /// mailbox, were taken, or will probably never arrive. `None` if a peer may be about to put one there.
    fn settled(&mut self, words: &StatusWords) -> Option<(u64, u64)> {
        // This load comes first and acquires each counted step, so the other load includes the
        // announcements of these steps. If the counts are equal, there was no other announcement.
        let settled = words.settled.load(Ordering::Acquire);
        let announced = words.announced.load(Ordering::Acquire);
        let open = announced.wrapping_sub(settled);
        if open <= self.written_off {
            return Some((announced, open));
        }
        let (announced_before, settled_before, times) = self.waited;
        let times = match (announced_before, settled_before) == (announced, settled) {
            true => times.saturating_add(1),
            false => 1,
        };
        self.waited = (announced, settled, times);
        (times >= Self::MAX_EMPTY_LOOKS).then_some((announced, open))
    }
}

/// The wake-ups of a peer as far as a process knows them.
#[derive(Debug)]
pub(crate) struct RingState {
    /// Value of the page's `wakeups` when this process last rang; [`NO_WAKEUP_COUNT`] before that.
    wakeups_at_ring: AtomicU64,
    /// Whether the peer was polling at the last check.
    polled_at_last_check: AtomicBool,
}

/// A value that `wakeups` does not reach.
const NO_WAKEUP_COUNT: u64 = u64::MAX;

impl RingState {
    pub(crate) fn new() -> Self {
        Self {
            wakeups_at_ring: AtomicU64::new(NO_WAKEUP_COUNT),
            polled_at_last_check: AtomicBool::new(false),
        }
    }

    /// Whether the peer with this page will poll without being rung at: because it is polling, or because
    /// this process has rung and the wake-up is still pending.
    ///
    /// The latter holds while `wakeups` is the same as before this process rang. The peer
    /// increments it between clearing its doorbell and polling, so a poll is still to come. Rings
    /// of other processes do not count, so a process that is killed before it rings causes no
    /// missed wake-up.
    pub(crate) fn is_awake(&self, words: &StatusWords) -> bool {
        fence(Ordering::SeqCst);
        // The fence provides the order that `begin_polling` and `count_wakeup` rely on.
        if words.pollers.load(Ordering::Relaxed) != 0 {
            self.polled_at_last_check.store(true, Ordering::Relaxed);
            return true;
        }
        self.wakeups_at_ring.load(Ordering::Relaxed) == words.wakeups.load(Ordering::Relaxed)
    }

    /// Whether the peer was polling at the last check.
    pub(crate) fn was_polling(&self) -> bool {
        self.polled_at_last_check.load(Ordering::Relaxed)
    }

    /// Calls `ring` unless the peer is awake. `becomes_awake` gives a peer that polled at the last check a
    /// moment, and checks again. Returns whether it rang.
    pub(crate) fn wake(
        &self,
        words: &StatusWords,
        becomes_awake: impl FnOnce() -> bool,
        ring: impl FnOnce(),
    ) -> bool {
        if self.is_awake(words) {
            return false;
        }
        if self.polled_at_last_check.swap(false, Ordering::Relaxed) && becomes_awake() {
            return false;
        }
        let wakeups = words.wakeups.load(Ordering::Acquire);
        ring();
        self.wakeups_at_ring.store(wakeups, Ordering::Relaxed);
        true
    }
}
