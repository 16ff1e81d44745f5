//! Work that one thread performs on behalf of all threads that request it meanwhile.

use std::sync::atomic::{AtomicBool, Ordering};

use parking_lot::{Mutex, MutexGuard};

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

#[cfg(test)]
mod tests {
    use super::*;

    /// Lets another thread call `work` at this moment.
    fn request_from_another_thread(combiner: &Combiner<u32>) {
        std::thread::scope(|scope| {
            let other = scope.spawn(|| combiner.work(|_| panic!("two threads at a time")));
            assert!(!other.join().unwrap());
        });
    }

    #[test]
    fn a_request_during_work_causes_another_pass() {
        let combiner = Combiner::new(0);
        combiner.work(|times| {
            *times += 1;
            if *times == 1 {
                request_from_another_thread(&combiner);
            }
            false
        });
        assert_eq!(*combiner.lock(), 2);
    }

    #[test]
    fn a_request_during_a_check_is_reported() {
        let combiner = Combiner::new(0);
        let found = combiner.has_any(|_| {
            request_from_another_thread(&combiner);
            // This check came before the request.
            false
        });
        assert!(found, "another thread has requested a pass since");
        assert!(!combiner.has_any(|_| false));
        assert!(combiner.has_any(|_| true));
    }

    #[test]
    fn a_check_during_work_causes_another_pass() {
        let combiner = Combiner::new(0);
        combiner.work(|times| {
            *times += 1;
            if *times == 1 {
                let check = || combiner.has_any(|_| panic!("two threads at a time"));
                std::thread::scope(|scope| assert!(!scope.spawn(check).join().unwrap()));
            }
            false
        });
        assert_eq!(*combiner.lock(), 2);
    }
}
