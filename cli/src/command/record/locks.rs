//! Finds lost and refused locks in the observed letters.

use std::collections::HashMap;

use fipa::Message;
use fipa::admin::watch::Passage;
use fipa::locks::Fence;
use fipa_acl::{escape, escape_name};
use fipa_locking::codec::{is_lock_protocol, read};
use fipa_locking::{Act, Content};

use crate::command::watch::json;

/// Maximum number of resources whose holders are remembered.
const MAX_RESOURCES: usize = 10_000;

/// The grants that were observed.
#[derive(Debug, Default)]
pub(super) struct Grants {
    holders: HashMap<String, Grant>,
}

#[derive(Debug)]
struct Grant {
    holder: String,
    fence: Fence,
}

/// An event of a lock.
#[derive(Debug)]
pub(super) struct LockEvent {
    pub(super) event: &'static str,
    pub(super) resource: String,
    /// The agent that has lost the lock or did not get it.
    pub(super) agent: String,
    pub(super) text: String,
}

impl Grants {
    /// Forgets all grants, because letters are missing.
    pub(super) fn forget(&mut self) {
        self.holders.clear();
    }

    /// Handles a letter. Returns the event that it reports, if there is one.
    pub(super) fn handle(&mut self, passage: &Passage) -> Option<LockEvent> {
        let protocol = passage.message.as_ref().and_then(Message::protocol)?;
        if !is_lock_protocol(protocol) {
            return None;
        }
        let message = json::message(passage)?;
        let sender = message.sender()?.name().to_owned();
        // A message of another implementation, or one whose content was not observed.
        let Content::Lock { resource, act } = read(&message).ok()?.content else {
            return None;
        };
        self.act(&sender, &passage.receiver, resource.as_str(), act)
    }

    fn act(&mut self, sender: &str, receiver: &str, resource: &str, act: Act) -> Option<LockEvent> {
        match act {
            Act::Granted { fence, .. } => self.grant(receiver, resource, fence),
            Act::Release => {
                let is_of = |grant: &Grant| grant.holder == sender;
                if self.holders.get(resource).is_some_and(is_of) {
                    self.holders.remove(resource);
                }
                None
            }
            Act::Refused { reason, .. } => Some(LockEvent {
                event: "lock_refused",
                resource: resource.to_owned(),
                agent: receiver.to_owned(),
                text: format!(
                    "{} does not grant {} to {}: {reason}",
                    escape_name(sender),
                    escape(resource),
                    escape_name(receiver)
                ),
            }),
            _ => None,
        }
    }

    fn grant(&mut self, holder: &str, resource: &str, fence: Fence) -> Option<LockEvent> {
        let is_known = self.holders.contains_key(resource);
        if !is_known && self.holders.len() >= MAX_RESOURCES {
            return None;
        }
        let grant = Grant {
            holder: holder.to_owned(),
            fence,
        };
        let position = grant.fence.position();
        let before = self.holders.insert(resource.to_owned(), grant)?;
        // An extension has the fence of the grant.
        if before.fence.position() == position {
            return None;
        }
        Some(LockEvent {
            event: "lock_lost",
            resource: resource.to_owned(),
            text: format!(
                "{} lost {} without releasing it; {} has it now",
                escape_name(&before.holder),
                escape(resource),
                escape_name(holder)
            ),
            agent: before.holder,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn granted(number: u64) -> Act {
        Act::Granted {
            fence: format!("7.{number}.00000000000000ff@owner#dock")
                .parse()
                .unwrap(),
            lease: 5000,
            asked: 0,
        }
    }

    #[test]
    fn a_lock_that_passes_on_without_a_release_is_lost() {
        let mut grants = Grants::default();
        let mut act = |from: &str, to: &str, act: Act| {
            let event = grants.act(from, to, "dock", act);
            event.map(|it| (it.event, it.agent))
        };
        assert_eq!(act("owner", "a", granted(1)), None);
        // Extended, then released.
        assert_eq!(act("owner", "a", granted(1)), None);
        assert_eq!(act("a", "owner", Act::Release), None);
        assert_eq!(act("owner", "b", granted(2)), None);
        // The release of another agent changes nothing.
        assert_eq!(act("a", "owner", Act::Release), None);
        let lost = Some(("lock_lost", "b".to_owned()));
        assert_eq!(act("owner", "c", granted(3)), lost);
    }
}
