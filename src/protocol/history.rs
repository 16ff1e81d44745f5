//! Conversations that began elsewhere or earlier.

use fipa_monitor::History;

use crate::agent::Agent;

impl Agent {
    /// Tells the monitor that another agent has begun, or will begin, a conversation with this
    /// identifier and names this agent in a `reply-to` (FIPA00061). The answers that this agent then
    /// receives are not unsolicited.
    ///
    /// Without this call, with `monitor.check` and unless `monitor.exempt` lists the protocol, such an
    /// answer [violates](crate::Incoming::violation) its protocol if its sender is on this host and was
    /// registered after this agent.
    pub fn expect_conversation(&self, id: &str) {
        self.core.endpoint.checks.expect_conversation(id);
    }

    /// Sets the extent of the monitor's knowledge about conversations in which this agent took part
    /// under an earlier registration of its name.
    ///
    /// By default, an agent on this host that was registered after this one, and a conversation id of
    /// [`unique_id`](Self::unique_id), cannot belong to such a conversation, and all others may. A
    /// message that may continue such a conversation is not checked. An agent that restores its
    /// conversations after a restart sets [`History::Unknown`]: it is then not refused any message that
    /// continues one. An agent with a name that is never used again sets [`History::Complete`].
    pub fn set_history(&self, history: History) {
        self.core.endpoint.checks.set_history(history);
    }
}
