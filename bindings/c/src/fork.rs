//! Forked children, which must not use the state of their parent.

use std::sync::Once;
use std::sync::atomic::{AtomicBool, Ordering};

static IS_CHILD: AtomicBool = AtomicBool::new(false);
static WATCH: Once = Once::new();

/// Whether this process was forked from one that had called the library. A lock of the parent may be taken forever
/// in the child.
pub(crate) fn is_child() -> bool {
    WATCH.call_once(|| {
        // SAFETY: The handler only stores to an atomic, which is allowed in the child of a process with threads.
        let refused = unsafe { libc::pthread_atfork(None, None, Some(mark)) };
        // It fails only without memory for one entry. The library then detects the fork by its own checks.
        debug_assert_eq!(refused, 0);
    });
    IS_CHILD.load(Ordering::Relaxed)
}

extern "C" fn mark() {
    IS_CHILD.store(true, Ordering::Relaxed);
}
