//! The lock around the state of an iceoryx2 port, which the port shares with its samples.
//!
//! A letter takes it about twenty times, mostly without contention. The lock of `ipc_threadsafe` is a
//! recursive POSIX mutex; this one is parking_lot's, which takes a fraction of the instructions.

use std::fmt::Debug;
use std::ops::Deref;
use std::ptr::NonNull;
use std::sync::Arc;

use iceoryx2_bb_elementary_traits::testing::abandonable::Abandonable;
use iceoryx2_cal::arc_sync_policy::{ArcSyncPolicy, ArcSyncPolicyCreationError, LockGuard};
use parking_lot::{ReentrantMutex, ReentrantMutexGuard};

/// A shared value behind a lock. iceoryx2 may take it again in the thread that holds it.
#[derive(Debug)]
pub(crate) struct Locked<T>(Arc<ReentrantMutex<T>>);

impl<T> Clone for Locked<T> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<T: Send + Debug + Abandonable> ArcSyncPolicy<T> for Locked<T> {
    type LockGuard<'parent>
        = Guard<'parent, T>
    where
        Self: 'parent,
        T: 'parent;

    fn new(value: T) -> Result<Self, ArcSyncPolicyCreationError> {
        Ok(Self(Arc::new(ReentrantMutex::new(value))))
    }

    fn lock(&self) -> Guard<'_, T> {
        Guard(self.0.lock())
    }
}

impl<T: Abandonable> Abandonable for Locked<T> {
    unsafe fn abandon_in_place(mut this: NonNull<Self>) {
        // SAFETY: the caller gives up the value, so nothing else refers to it.
        let this = unsafe { this.as_mut() };
        match Arc::get_mut(&mut this.0) {
            // SAFETY: this is the only owner of the value, and does not use it afterwards.
            Some(only) => unsafe { T::abandon_in_place(NonNull::from(only.get_mut())) },
            // SAFETY: the caller does not use or drop the value afterwards.
            None => unsafe { std::ptr::drop_in_place(&raw mut this.0) },
        }
    }
}

/// Access to the value while it is locked.
pub(crate) struct Guard<'parent, T>(ReentrantMutexGuard<'parent, T>);

impl<T> Deref for Guard<'_, T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.0
    }
}

impl<'parent, T: Send + Abandonable> LockGuard<'parent, T> for Guard<'parent, T> {}
