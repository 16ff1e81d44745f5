//! Detection of forked children.
//!
//! The kernel zeroes a marked page of memory in a child. Reading it needs no system call, so the
//! check can run for every letter.

use std::ptr::NonNull;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mmap_anonymous};

use crate::memory::{MappedPtr, PAGE};

/// The process that created a value and that alone may use it. The check costs no system call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OwnerMark(u64);

impl OwnerMark {
    /// The running process.
    #[must_use]
    pub fn this() -> Self {
        Self(current())
    }

    /// Whether this is the running process, and not the parent of it.
    #[must_use]
    pub fn is_this(self) -> bool {
        self.0 == current()
    }
}

/// Returns a number that differs between a process and its forked children.
fn current() -> u64 {
    /// Copied to children, so that each continues from its parent's number.
    static LAST: AtomicU64 = AtomicU64::new(0);
    let Some(number) = marker() else {
        return u64::from(std::process::id());
    };
    match number.load(Ordering::Relaxed) {
        0 => {
            let next = LAST.fetch_add(1, Ordering::Relaxed) + 1;
            let set = number.compare_exchange(0, next, Ordering::Relaxed, Ordering::Relaxed);
            // Another thread may have set it first.
            set.map_or_else(|before| before, |_| next)
        }
        known => known,
    }
}

/// Returns a number that is initially zero, and zero again in a forked child. `None` if the kernel
/// cannot do that (before Linux 4.14).
fn marker() -> Option<&'static AtomicU64> {
    static MARKER: OnceLock<Option<MappedPtr<AtomicU64>>> = OnceLock::new();
    let marker = MARKER.get_or_init(map_marker).as_ref()?;
    // SAFETY: `map_marker` has mapped a page there, readable, writable, aligned and longer than the
    // number, and it is never unmapped. Zero is a valid value, and the number is accessed only
    // atomically. A child has the same mapping, filled with zeros.
    Some(unsafe { marker.0.as_ref() })
}

fn map_marker() -> Option<MappedPtr<AtomicU64>> {
    let protection = ProtFlags::READ | ProtFlags::WRITE;
    // SAFETY: the kernel chooses the address of a private mapping, so no memory in use is changed.
    let start =
        unsafe { mmap_anonymous(std::ptr::null_mut(), PAGE, protection, MapFlags::PRIVATE) };
    let start = start.ok()?;
    // SAFETY: the range was mapped above with this length, and no reference to it exists yet. The
    // advice changes the memory of children only.
    unsafe { madvise(start, PAGE, Advice::LinuxWipeOnFork) }.ok()?;
    NonNull::new(start.cast()).map(MappedPtr)
}
