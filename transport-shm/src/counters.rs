//! Counters of an endpoint.

use std::sync::atomic::{AtomicU64, Ordering};

/// Events at an endpoint since it was opened. `borrowed` is a current value, all others only grow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct ShmCounters {
    /// Parcels that arrived.
    pub arrived: u64,
    /// Contents handed out in place, without a copy, including content in segments.
    pub in_place: u64,
    /// Contents copied because they are shorter than `copy_below`.
    pub copied_small: u64,
    /// Contents copied because too many were already held in place.
    pub copied_full: u64,
    /// Contents currently held in place.
    pub borrowed: u64,
    /// Parcels sent.
    pub sent: u64,
    /// Parcels sent that refer to content stored once for several receivers.
    pub referring: u64,
    /// Loaned contents sent without a copy.
    pub loans_sent: u64,
    /// Loaned contents that had to be copied (other receiver, sent before, front too long).
    pub loans_copied: u64,
    /// Rings of other processes' doorbells: system calls that a polling receiver saves.
    pub rung: u64,
    /// Parcels whose answer came in a word of shared memory, without a response of iceoryx2.
    pub answered_in_words: u64,
    /// Parcels whose answer was deferred.
    pub deferred: u64,
    /// Parcels from other processes that were malformed or could not be answered.
    pub refused: u64,
    /// Other processes whose end was detected.
    pub peers_gone: u64,
}

macro_rules! tally {
    ($($name:ident)*) => {
        /// The live counters.
        #[derive(Debug, Default)]
        pub(crate) struct Tally { $(pub(crate) $name: AtomicU64,)* }

        impl Tally {
            pub(crate) fn read(&self) -> ShmCounters {
                ShmCounters { $($name: self.$name.load(Ordering::Relaxed),)* }
            }
        }
    };
}

tally!(arrived in_place copied_small copied_full borrowed sent referring loans_sent loans_copied rung answered_in_words deferred refused peers_gone);

/// Increments a counter by one.
pub(crate) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

/// Increments by one a counter that only the thread that works on the mailbox writes.
pub(crate) fn count_alone(counter: &AtomicU64) {
    let before = counter.load(Ordering::Relaxed);
    counter.store(before.wrapping_add(1), Ordering::Relaxed);
}
