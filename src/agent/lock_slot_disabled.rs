//! The items of `lock_slot.rs` in a build without the feature `locks`: there are no locks.

use crate::agent::AgentCore;
use crate::agent::incoming::Incoming;

#[derive(Default)]
pub(crate) struct LockSlot(());

impl LockSlot {
    pub(crate) fn close(&self, _agent: &AgentCore) {}
}

#[derive(Default)]
pub(crate) struct Neighbors(());

pub(crate) fn is_for_locks(_incoming: &Incoming) -> bool {
    false
}
