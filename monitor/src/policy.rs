//! Settings of a monitor beside its limits: the messages that it refuses without a conversation, and
//! the extent of its knowledge.

use std::collections::BTreeSet;

/// The messages that a monitor refuses although no conversation shows them to be wrong.
///
/// A refused message is a [`Violation`](crate::Violation) whose kind
/// [depends on the policy](crate::ViolationKind::depends_on_policy). A caller should only warn if the
/// message comes from a peer that predates these rules.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct MonitorPolicy {
    /// Whether a message with a known protocol needs a `conversation-id` (FIPA00061).
    pub conversation_id: bool,
    /// Whether a protocol name that differs from a known one by one typing error is refused.
    pub spelling: bool,
    /// Whether a received message that continues a conversation which did not begin is refused. Without
    /// it, such a message is [unchecked](crate::Unchecked::UnknownHistory). If the conversation may have
    /// begun without the monitor, the message is unchecked in any case: see [`History`] and
    /// [`Monitor::expect`](crate::Monitor::expect).
    pub unsolicited: bool,
    /// Names of protocols to which this policy does not apply, and names that are no misspelled ones. Case
    /// is ignored.
    pub exempt: BTreeSet<String>,
}

impl MonitorPolicy {
    /// Creates a policy that refuses all of these messages.
    #[must_use]
    pub fn strict() -> Self {
        Self {
            conversation_id: true,
            spelling: true,
            unsolicited: true,
            exempt: BTreeSet::new(),
        }
    }

    pub(crate) fn exempts(&self, protocol: &str) -> bool {
        let mut exempt = self.exempt.iter();
        exempt.any(|name| name.eq_ignore_ascii_case(protocol))
    }
}

/// The extent of the knowledge of a monitor about conversations that it does not have.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum History {
    /// The monitor gets all messages since the first of the agent, or of all agents. A conversation
    /// that the monitor does not have, and has not removed before its end, did not begin.
    #[default]
    Complete,
    /// Conversations may have begun before the monitor: the agent has restarted or moved, or the
    /// observer began late.
    Unknown,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exempt_protocols_are_found_in_any_case() {
        let mut policy = MonitorPolicy::strict();
        policy.exempt.insert("fipa-query".into());
        assert!(policy.exempts("FIPA-Query") && !policy.exempts("fipa-request"));
    }
}
