//! Who says which letters are taken.

use std::time::Instant;

use fipa_acl::Letter;

/// Who says which letters are taken: by an agent of this service, or into a gateway's custody.
pub trait Gate: Send + Sync {
    /// Whether a letter to the agent with this name is taken. Is asked once for a letter, when there
    /// is room for it: neither for copies of one that was taken, nor for one that has to wait. Must
    /// not wait nor call the service back.
    ///
    /// # Errors
    /// Why not, as its sender is told.
    fn admits(&self, now: Instant, receiver: &str, letter: &Letter) -> Result<(), String>;
}
