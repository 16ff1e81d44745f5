//! Messages to several receivers, of which an observer gets each copy by itself.

use std::hash::BuildHasher;

use crate::MonitorLimits;
use crate::check::observed::ObservedMessage;
use crate::conversation::Conversation;
use crate::conversation::bindings::RoleBinding;
use crate::conversation::names::Names;
use crate::conversation::rare::Copied;
use crate::conversation::table::Slot;
use crate::monitor::Monitor;
use crate::protocol::role::MessageRoles;
use crate::verdict::ViolationKind as Kind;

/// Fingerprints of a message to several receivers, and of the receiver of this copy.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CopyKey {
    pub(crate) message: u64,
    pub(crate) receiver: u64,
}

impl Monitor {
    /// Returns fingerprints of a message and of its receiver, if this is the copy for one of several
    /// receivers.
    pub(crate) fn copied(&self, observed: &ObservedMessage<'_>) -> Option<CopyKey> {
        let addressed = observed.addressed;
        let first = addressed.first()?;
        let receiver = observed.receivers.first()?;
        if addressed.len() == 1 && first == receiver {
            return None;
        }
        let message = (
            observed.act.name(),
            observed.sender,
            addressed,
            observed.reply_with,
            observed.in_reply_to,
        );
        Some(CopyKey {
            message: self.hasher.hash_one(message),
            receiver: self.hasher.hash_one(&**receiver),
        })
    }
}

/// If the message is another copy of the last one to several receivers: gives its receiver the role of the
/// receivers, unless there are too many.
pub(crate) fn take_copy(
    conversation: &mut Conversation,
    names: &mut Names,
    observed: &ObservedMessage<'_>,
    copy: CopyKey,
    limits: &MonitorLimits,
) -> Option<Result<(), Kind>> {
    let mut all = conversation.rare.as_deref()?.copied.iter().enumerate();
    let (place, copied) = all.find(|(_, copied)| copied.fingerprint == copy.message)?;
    if copied.seen.contains(&copy.receiver) {
        return None;
    }
    let name = observed.receivers.first()?;
    let seen = (copied.seen.len() + 1).next_power_of_two() * size_of::<u64>();
    let bytes = conversation.allocated() + conversation.growth(0, 1, 0);
    let size = Slot::COST + bytes + seen + Names::cost(name.len());
    if conversation.bound.len() >= limits.participants
        || copied.seen.len() == limits.participants
        || size > limits.share_of_bytes()
    {
        return Some(Err(Kind::TooMany));
    }
    let copied = conversation.rare().copied.get_mut(place)?;
    copied.seen.push(copy.receiver);
    if let Some(role) = copied.roles.to.only() {
        let agent = conversation.acquire(names, name);
        conversation.bound.push(RoleBinding { role, agent });
    }
    Some(Ok(()))
}

/// Keeps a message of which further copies may follow.
pub(crate) fn keep_copied(conversation: &mut Conversation, copy: CopyKey, roles: MessageRoles) {
    let copied = &mut conversation.rare().copied;
    copied.retain(|copied| copied.fingerprint != copy.message);
    if copied.len() == Copied::MAX {
        copied.remove(0);
    }
    copied.push(Copied {
        fingerprint: copy.message,
        seen: vec![copy.receiver],
        roles,
    });
}
