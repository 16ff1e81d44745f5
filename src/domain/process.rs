//! The process that owns a membership. Its forked children must not use the membership.

use fipa_transport::{Forked, OwnerProcess};

/// The process that joined a domain. The check is cheap enough to run for every letter.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Owner {
    process: OwnerProcess,
    /// Its check costs no system call.
    #[cfg(feature = "shm")]
    mark: fipa_transport_shm::OwnerMark,
}

impl Owner {
    /// Returns the running process.
    pub(crate) fn this() -> Self {
        Self {
            process: OwnerProcess::this(),
            #[cfg(feature = "shm")]
            mark: fipa_transport_shm::OwnerMark::this(),
        }
    }

    /// Whether the calling process is the owner and not a forked child of it.
    pub(crate) fn is_this(self) -> bool {
        #[cfg(feature = "shm")]
        return self.mark.is_this();
        #[cfg(not(feature = "shm"))]
        self.process.is_this()
    }

    /// Returns an error in a forked child.
    pub(crate) fn check(self) -> Result<(), Forked> {
        match self.is_this() {
            true => Ok(()),
            false => Err(self.process.forked()),
        }
    }
}
