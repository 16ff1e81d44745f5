//! Who says which letters are taken.

use std::time::Instant;

use fipa_acl::Letter;
use fipa_transport::{Incarnation, Kind};

/// The link on which a letter came.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Link {
    /// The kind of transport.
    pub via: Kind,
    /// The service at its other end, as it introduced itself on this link; unknown for a legacy
    /// peer. Only on a [host-local](Kind::is_host_local) link is that a process of this user.
    pub service: Incarnation,
}

/// Who says which letters are taken: by an agent of this service, or into a gateway's custody.
pub trait Gate: Send + Sync {
    /// Whether a letter to the agent with this name that came on this link is taken. Is asked once for a letter, when there
    /// is room for it: neither for copies of one that was taken, nor for one that has to wait. Must
    /// not wait nor call the service back.
    ///
    /// # Errors
    /// Why not, as its sender is told.
    fn admits(
        &self,
        now: Instant,
        receiver: &str,
        letter: &Letter,
        link: Link,
    ) -> Result<(), String>;
}
