//! Counting what happened.

use std::sync::atomic::{AtomicU64, Ordering};

/// What happened at an endpoint since it was opened.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub struct ShmCounters {
    /// Parcels that arrived.
    pub arrived: u64,
    /// Contents handed out in place, without a copy; those that lie there for many too.
    pub in_place: u64,
    /// Contents copied because they are small.
    pub copied_small: u64,
    /// Contents copied because too many were held in place already.
    pub copied_full: u64,
    /// Contents held in place now.
    pub borrowed: u64,
    /// Parcels sent.
    pub sent: u64,
    /// Parcels sent that refer to content which lies in memory once for many.
    pub referring: u64,
    /// Loaned contents sent without a copy.
    pub loans_sent: u64,
    /// Loaned contents that had to be copied (other receiver, sent before, front too long).
    pub loans_copied: u64,
    /// Bells rung at other processes: system calls that a polling receiver saves.
    pub rung: u64,
    /// Parcels from other processes that made no sense or could not be answered.
    pub refused: u64,
    /// Other processes whose end was noticed.
    pub peers_gone: u64,
}

macro_rules! tally {
    ($($name:ident)*) => {
        /// The running counters.
        #[derive(Debug, Default)]
        pub(crate) struct Tally { $(pub(crate) $name: AtomicU64,)* }

        impl Tally {
            pub(crate) fn read(&self) -> ShmCounters {
                ShmCounters { $($name: self.$name.load(Ordering::Relaxed),)* }
            }
        }
    };
}

tally!(arrived in_place copied_small copied_full borrowed sent referring loans_sent loans_copied rung refused peers_gone);

/// Adds one.
pub(crate) fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}
