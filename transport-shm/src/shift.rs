//! Work that one thread at a time does, and that whoever comes meanwhile need not wait for.

use std::sync::atomic::{AtomicBool, Ordering};

use parking_lot::{Mutex, MutexGuard};

/// What is worked on, by one thread at a time.
///
/// Whoever finds another thread at it leaves word, tries once more, and goes; whoever was at it
/// asks for word after letting go. Leaving word and asking for it are exchanges of one variable, so
/// one comes first: either the word is found, or the second try comes after the letting go.
/// Hence nothing is overlooked, and nobody waits.
#[derive(Debug)]
pub(crate) struct Shift<T> {
    work: Mutex<T>,
    /// Somebody wants it to be looked at.
    wanted: AtomicBool,
}

impl<T> Shift<T> {
    pub(crate) fn new(work: T) -> Self {
        Self {
            work: Mutex::new(work),
            wanted: AtomicBool::new(false),
        }
    }

    /// Works until nobody has left word. Says whether there was anything, as `once` does; nothing
    /// is done here when another thread is at it.
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

    /// Whether there is something to be done: what `has_any` says, or because somebody has left
    /// word meanwhile. Whoever is told so has to [work](Self::work). When another thread is at it,
    /// that one looks again.
    pub(crate) fn has_any(&self, has_any: impl FnOnce(&T) -> bool) -> bool {
        self.begin().is_some_and(|work| {
            let found = has_any(&work);
            self.end(work) || found
        })
    }

    /// For what must not be left to others: waits until it is this thread's turn.
    pub(crate) fn lock(&self) -> MutexGuard<'_, T> {
        self.work.lock()
    }

    /// Takes the turn, if nobody has it; else leaves word.
    fn begin(&self) -> Option<MutexGuard<'_, T>> {
        self.work.try_lock().or_else(|| {
            self.wanted.swap(true, Ordering::AcqRel);
            self.work.try_lock()
        })
    }

    /// Gives the turn back. Says whether word was left meanwhile.
    fn end(&self, work: MutexGuard<'_, T>) -> bool {
        drop(work);
        self.wanted.swap(false, Ordering::AcqRel)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Another thread comes at this moment, and goes again.
    fn somebody_comes(shift: &Shift<u32>) {
        std::thread::scope(|scope| {
            let other = scope.spawn(|| shift.work(|_| panic!("two at a time")));
            assert!(!other.join().unwrap());
        });
    }

    #[test]
    fn who_comes_while_another_works_has_it_done() {
        let shift = Shift::new(0);
        shift.work(|times| {
            *times += 1;
            if *times == 1 {
                somebody_comes(&shift);
            }
            false
        });
        assert_eq!(*shift.lock(), 2);
    }

    #[test]
    fn who_comes_while_another_only_looks_is_not_forgotten() {
        let shift = Shift::new(0);
        let found = shift.has_any(|_| {
            somebody_comes(&shift);
            // It looked before there was anything.
            false
        });
        assert!(found, "somebody has come since");
        assert!(!shift.has_any(|_| false));
        assert!(shift.has_any(|_| true));
    }

    #[test]
    fn who_only_looks_while_another_works_is_not_forgotten() {
        let shift = Shift::new(0);
        shift.work(|times| {
            *times += 1;
            if *times == 1 {
                let looks = || shift.has_any(|_| panic!("two at a time"));
                std::thread::scope(|scope| assert!(!scope.spawn(looks).join().unwrap()));
            }
            false
        });
        assert_eq!(*shift.lock(), 2);
    }
}
