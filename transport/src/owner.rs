//! Which process owns something, when a process forks without exec.

/// The process that made a value, and alone may use it.
///
/// A child that was forked without exec has copies of everything that its parent has: handles,
/// descriptors, locks. Releasing them there would take away what the parent uses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OwnerProcess(u32);

impl OwnerProcess {
    /// The running process.
    #[must_use]
    pub fn this() -> Self {
        Self(std::process::id())
    }

    /// Whether this is the running process. Costs a system call.
    #[must_use]
    pub fn is_this(self) -> bool {
        self == Self::this()
    }

    /// Refuses the use in another process.
    ///
    /// # Errors
    /// When the running process is a forked child.
    pub fn check(self) -> Result<(), Forked> {
        match self.is_this() {
            true => Ok(()),
            false => Err(self.forked()),
        }
    }

    /// Returns the error for a forked child.
    #[must_use]
    pub fn forked(self) -> Forked {
        Forked { owner: self.0 }
    }
}

/// A forked child used what its parent owns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "this process was forked from process {owner}, which joined the domain, and cannot use its \
     membership; open the domain again after the fork"
)]
pub struct Forked {
    /// Identifier of the process that owns it.
    pub owner: u32,
}
