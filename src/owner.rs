//! Which process owns a membership: its forked children may not use it.

use fipa_transport::{Forked, OwnerProcess};

/// The process that joined a domain. Cheap enough to be asked for every letter.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Owner {
    process: OwnerProcess,
    /// Asking it costs no system call.
    #[cfg(feature = "shm")]
    mark: fipa_transport_shm::Owner,
}

impl Owner {
    /// The running process.
    pub(crate) fn this() -> Self {
        Self {
            process: OwnerProcess::this(),
            #[cfg(feature = "shm")]
            mark: fipa_transport_shm::Owner::this(),
        }
    }

    /// Whether this is the running process, and no forked child of it.
    pub(crate) fn is_this(self) -> bool {
        #[cfg(feature = "shm")]
        return self.mark.is_this();
        #[cfg(not(feature = "shm"))]
        self.process.is_this()
    }

    /// Refuses the use in a forked child.
    pub(crate) fn check(self) -> Result<(), Forked> {
        match self.is_this() {
            true => Ok(()),
            false => Err(self.process.forked()),
        }
    }
}
