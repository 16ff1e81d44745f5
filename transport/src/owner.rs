//! The process that owns a value, across forks without exec.

/// The process that created a value and that alone may use it.
///
/// A child that was forked without exec has copies of all handles, descriptors and locks of its
/// parent. If it released them, the parent would lose them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OwnerProcess(u32);

impl OwnerProcess {
    /// The running process.
    #[must_use]
    pub fn this() -> Self {
        Self(std::process::id())
    }

    /// Whether this is the running process. Makes a system call.
    #[must_use]
    pub fn is_this(self) -> bool {
        self == Self::this()
    }

    /// Checks that the running process is the owner.
    ///
    /// # Errors
    /// Returns an error in a forked child.
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

/// A forked child used a value that its parent owns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "this process was forked from process {owner}, which joined the domain, and cannot use its \
     membership; open the domain again after the fork"
)]
pub struct Forked {
    /// Process identifier of the owner.
    pub owner: u32,
}
