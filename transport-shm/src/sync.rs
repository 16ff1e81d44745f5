//! The atomics and locks of the modules that `tests/interleavings.rs` compiles with those of loom.

pub(crate) use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering, fence};

pub(crate) use parking_lot::{Mutex, MutexGuard};
