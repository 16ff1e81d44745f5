//! The wake-up of the program: its waiting thread, and the descriptor that it polls.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};
use std::task::{Wake, Waker};

use futures_util::task::AtomicWaker;
use rustix::event::{EventfdFlags, eventfd};
use rustix::io::{read, write};

/// Wakes the thread that waits in the queue, and makes the descriptor readable if the program has asked for it.
#[derive(Debug)]
pub struct Bell {
    waiting: AtomicWaker,
    descriptor: OnceLock<OwnedFd>,
    /// Whether the descriptor is readable, or will be when it is created.
    rung: AtomicBool,
}

impl Bell {
    /// Creates a bell without a descriptor.
    #[must_use]
    pub fn new() -> Self {
        Self {
            waiting: AtomicWaker::new(),
            descriptor: OnceLock::new(),
            rung: AtomicBool::new(true),
        }
    }

    /// Sets the thread that waits. All other wake-ups reach the descriptor only.
    pub fn wait(&self, waker: &Waker) {
        self.waiting.register(waker);
    }

    /// Returns the descriptor. It is readable from the first call on, because items may be ready.
    ///
    /// # Errors
    /// If the process has no descriptor left.
    pub fn descriptor(&self) -> io::Result<BorrowedFd<'_>> {
        if let Some(descriptor) = self.descriptor.get() {
            return Ok(descriptor.as_fd());
        }
        let created = eventfd(1, EventfdFlags::NONBLOCK | EventfdFlags::CLOEXEC)?;
        Ok(self.descriptor.get_or_init(|| created).as_fd())
    }

    /// Makes the descriptor unreadable. Returns false if the program has not asked for it. The caller looks for items
    /// afterwards: a wake-up that happens meanwhile leaves the descriptor as it is.
    pub fn quiet(&self) -> bool {
        let Some(descriptor) = self.descriptor.get() else {
            return false;
        };
        // Fails only on an eventfd that is unreadable already.
        let _ = read(descriptor, &mut [0_u8; 8]);
        // After the read: a wake-up in between must not write what the read then takes away.
        self.rung.store(false, Ordering::SeqCst);
        true
    }

    /// Makes the descriptor readable.
    pub fn ring(&self) {
        if let Some(descriptor) = self.descriptor.get()
            && !self.rung.swap(true, Ordering::SeqCst)
        {
            // Fails only on an eventfd that is readable already.
            let _ = write(descriptor, &1_u64.to_ne_bytes());
        }
    }
}

impl Default for Bell {
    fn default() -> Self {
        Self::new()
    }
}

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        // The descriptor first: a thread that wakes may read it at once.
        self.ring();
        self.waiting.wake();
    }
}
