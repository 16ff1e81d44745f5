//! Whether this process is a forked child of the one that made something.
//!
//! A page of memory that the kernel empties in a child says so without a system call, so that it
//! can be asked for every letter.

use std::ptr::NonNull;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mmap_anonymous};

use crate::memory::{Address, PAGE};

/// The process that made a value, and alone may use it. Asking costs no system call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Owner(u64);

impl Owner {
    /// The running process.
    #[must_use]
    pub fn this() -> Self {
        Self(current())
    }

    /// Whether this is the running process, and no forked child of it.
    #[must_use]
    pub fn is_this(self) -> bool {
        self.0 == current()
    }
}

/// Returns a number that differs between a process and its forked children.
fn current() -> u64 {
    /// Is copied to children, so that each counts on from its parent's number.
    static LAST: AtomicU64 = AtomicU64::new(0);
    let Some(number) = page() else {
        return u64::from(std::process::id());
    };
    match number.load(Ordering::Relaxed) {
        0 => {
            let next = LAST.fetch_add(1, Ordering::Relaxed) + 1;
            let set = number.compare_exchange(0, next, Ordering::Relaxed, Ordering::Relaxed);
            // Another thread may have been first.
            set.map_or_else(|before| before, |_| next)
        }
        known => known,
    }
}

/// Returns a number that is zero at first, and again in a forked child. None where the kernel
/// cannot do that (before Linux 4.14).
fn page() -> Option<&'static AtomicU64> {
    static PAGE_OF_PROCESS: OnceLock<Option<Address<AtomicU64>>> = OnceLock::new();
    let page = PAGE_OF_PROCESS.get_or_init(map).as_ref()?;
    // SAFETY: `map` has mapped a page there, readable and writable, aligned and longer than the
    // number, and nothing unmaps it. Zero is a valid value, and it is accessed atomically only. A
    // child has the same mapping, emptied.
    Some(unsafe { page.0.as_ref() })
}

fn map() -> Option<Address<AtomicU64>> {
    let protection = ProtFlags::READ | ProtFlags::WRITE;
    // SAFETY: the kernel chooses where to map, so no memory in use is touched.
    let start =
        unsafe { mmap_anonymous(std::ptr::null_mut(), PAGE, protection, MapFlags::PRIVATE) };
    let start = start.ok()?;
    // SAFETY: the range was mapped above and nothing refers to it yet. The advice concerns
    // children only.
    unsafe { madvise(start, PAGE, Advice::LinuxWipeOnFork) }.ok()?;
    NonNull::new(start.cast()).map(Address)
}
