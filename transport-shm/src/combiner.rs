//! Work that one thread performs on behalf of all threads that request it meanwhile.
//!
//! `tests/interleavings.rs` compiles this file with the atomics and locks of loom.

use crate::sync::{AtomicBool, Mutex, MutexGuard, Ordering};

/// A value that one thread at a time works on, without waiting for other threads.
///
/// A thread that fails to take the lock sets `wanted`, retries once and returns. The holder of the
/// lock checks `wanted` after unlocking. Both access `wanted` with a swap, so the two swaps have an
/// order: either the holder finds `wanted` set, or the retry happens after the unlock. No request
/// is lost, and no thread waits.
#[derive(Debug)]
pub(crate) struct Combiner<T> {
    work: Mutex<T>,
    /// Whether a thread failed to take the lock and requests another pass.
    wanted: AtomicBool,
}

impl<T> Combiner<T> {
    pub(crate) fn new(work: T) -> Self {
        Self {
            work: Mutex::new(work),
            wanted: AtomicBool::new(false),
        }
    }

    /// Calls `once` until no other thread requests another pass. Returns whether a call returned
    /// true. If another thread holds the lock, nothing is called here and that thread makes another
    /// pass.
    pub(crate) fn work(&self, mut once: impl FnMut(&mut T) -> bool) -> bool {
        let mut found = false;
        while let Some(mut work) = self.begin() {
            found |= once(&mut work);
            if !self.end(work) {
                break;
            }
        }
        found
    }

    /// Whether there is work: `has_any` returned true, or another thread requested a pass
    /// meanwhile. If so, the caller must call [`work`](Self::work). If another thread holds the
    /// lock, the result is false and that thread makes another pass.
    pub(crate) fn has_any(&self, has_any: impl FnOnce(&T) -> bool) -> bool {
        self.begin().is_some_and(|work| {
            let found = has_any(&work);
            self.end(work) || found
        })
    }

    /// Waits for the lock. For work that must not be left to another thread.
    pub(crate) fn lock(&self) -> MutexGuard<'_, T> {
        self.work.lock()
    }

    /// Takes the lock if it is free; otherwise sets `wanted` and retries once.
    fn begin(&self) -> Option<MutexGuard<'_, T>> {
        self.work.try_lock().or_else(|| {
            self.wanted.swap(true, Ordering::AcqRel);
            self.work.try_lock()
        })
    }

    /// Releases the lock. Returns whether another thread requested a pass meanwhile.
    fn end(&self, work: MutexGuard<'_, T>) -> bool {
        drop(work);
        self.wanted.swap(false, Ordering::AcqRel)
    }
}
