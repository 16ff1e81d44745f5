//! Counts the steps of the core in builds with debug assertions: letters visited, receivers, and
//! kilobytes read. Tests bound them by the bytes that arrived.

#[cfg(debug_assertions)]
thread_local! {
    static STEPS: std::cell::Cell<u64> = const { std::cell::Cell::new(0) };
}

/// Adds steps. Does nothing without debug assertions.
#[inline]
pub(crate) fn steps(count: usize) {
    #[cfg(debug_assertions)]
    STEPS.with(|steps| steps.set(steps.get().saturating_add(count as u64)));
    #[cfg(not(debug_assertions))]
    let _ = count;
}

/// Returns the steps that this thread has made since the last call.
#[cfg(debug_assertions)]
#[must_use]
pub fn taken() -> u64 {
    STEPS.with(std::cell::Cell::take)
}
