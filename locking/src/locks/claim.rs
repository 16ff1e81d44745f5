//! A lock of one or several resources that this agent requests or holds.

use crate::{Millis, Resource};

/// A lock of one or several resources that this agent requests or holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct ClaimId(pub(super) u64);

/// A claim acquires its resources in the order of their names.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(super) struct Claim {
    pub(super) resources: Vec<Resource>,
    /// Number of resources that are held. The next one is requested.
    pub(super) held: usize,
    pub(super) deadline: Option<Millis>,
}

impl Claim {
    pub(super) fn is_acquired(&self) -> bool {
        self.held == self.resources.len()
    }

    pub(super) fn wanted(&self) -> Option<&Resource> {
        self.resources.get(self.held)
    }
}
