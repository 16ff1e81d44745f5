//! The types of `locks` in a build without the feature `locks`: there are no locks.

use fipa_acl::Message;

use crate::agent::AgentCore;

#[derive(Default)]
pub(crate) struct LocksSlot(());

impl LocksSlot {
    pub(crate) fn close(&self, _agent: &AgentCore) {}
}

pub(crate) fn is_internal(_message: &Message) -> bool {
    false
}
