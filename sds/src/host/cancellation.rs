//! Cancellation of calls that wait for other processes.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::HostError;

/// Ends calls that wait for other processes, from another thread. Clones share one state.
#[derive(Debug, Clone, Default)]
pub struct Cancellation(Arc<AtomicBool>);

impl Cancellation {
    /// Creates a state that is not canceled.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Cancels the calls. They end within milliseconds if they wait. A call that has passed its last
    /// check completes.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Release);
    }

    /// Whether [`cancel`](Self::cancel) was called.
    #[must_use]
    pub fn is_canceled(&self) -> bool {
        self.0.load(Ordering::Acquire)
    }

    /// Checks that the call may continue.
    ///
    /// # Errors
    /// Fails with [`HostError::Canceled`] after [`cancel`](Self::cancel).
    pub fn check(&self) -> Result<(), HostError> {
        match self.is_canceled() {
            true => Err(HostError::Canceled),
            false => Ok(()),
        }
    }
}
