//! The conversations of an agent, to be carried to its next registration.
//!
//! ```text
//! snapshot     := "fipa-cnv" version(u32) agent(text) key(u64) key(u64) count(u32) conversation*
//! conversation := part(main) children(u32) part(child)*
//! part         := protocol(text) id(text) peer(text) initiator(text)
//!                 parties(u32) party* unnamed(u8) party?
//!                 bound(u32) (role(u8) agent(text))*
//!                 reply-to(u32) agent(text)*
//!                 delegates(u32) (party(u32) agent(text))*
//! party        := participant(text) state resume(state) before(state) flags(u8) acts(u8 u8)
//!                 (asked(u64) tail(text) earlier(u32)*)* cancel(u64) deadline(u64)
//! state        := 0(u8) id(text) | special(u8)
//! text         := length(u16) UTF-8
//! ```
//!
//! All integers are little-endian. `version` is 1. An empty `peer` stands for the agent itself. `deadline`
//! is in milliseconds since 1970-01-01T00:00:00Z; 0 stands for none.
//!
//! Fingerprints of `reply-with` are keyed. The snapshot carries the key, and the monitor that reads it
//! takes the key over. No table of the monitor uses it.
//!
//! A snapshot comes from outside. It is checked completely before it changes the monitor.

mod read;
mod write;

use std::sync::Arc;

use self::read::{Part, Read};
use crate::Moment;
use crate::conversation::bindings::RoleBinding;
use crate::conversation::deadlines::Deadline;
use crate::conversation::ids::{PartyIndex, SlotIndex};
use crate::conversation::names::Names;
use crate::conversation::party::Party;
use crate::conversation::state::{AFTER_NOT_UNDERSTOOD, CANCELLED, CANCELLING, FAILED};
use crate::monitor::Monitor;
use crate::protocol::index::StateId;

const MAGIC: [u8; 8] = *b"fipa-cnv";

const VERSION: u32 = 1;

const BY_INITIATOR: u8 = 1;

const CANCELED_BY_OTHER: u8 = 2;

const ECHO: u8 = 4;

/// Error of restoring conversations. The monitor is unchanged.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SnapshotError {
    /// The bytes are no snapshot.
    #[error("the bytes are no snapshot of conversations; `Monitor::snapshot` writes one")]
    NotASnapshot,
    /// The snapshot has another version.
    #[error("the snapshot has version {0}, and this program reads version {VERSION}")]
    Version(u32),
    /// The snapshot is that of another agent.
    #[error("the snapshot is that of the agent {found:?}, and the monitor is that of {expected:?}")]
    OtherAgent {
        /// The agent of the monitor.
        expected: String,
        /// The agent of the snapshot.
        found: String,
    },
    /// The monitor already has conversations, or is an observer.
    #[error("conversations can be restored only into a monitor of an agent that has none yet")]
    InUse,
    /// The snapshot exceeds a limit of the monitor.
    #[error("the snapshot exceeds a limit of the monitor: {0}")]
    TooLarge(&'static str),
    /// The snapshot is malformed, or does not fit the protocols of the monitor.
    #[error("the snapshot is malformed: {0}")]
    Malformed(&'static str),
}

impl Monitor {
    /// Restores the conversations of a [`snapshot`](Self::snapshot) of the same agent, before the first
    /// message. Returns their number, with embedded ones. Conversations of protocols that this monitor does
    /// not have are left out, and so are the oldest ones if [`MonitorLimits`](crate::MonitorLimits) are exceeded.
    ///
    /// # Errors
    /// If the snapshot is malformed, exceeds a limit of this monitor, or is that of another agent; or if
    /// this monitor has conversations. Nothing is changed.
    pub fn restore(
        &mut self,
        snapshot: &[u8],
        now: impl Into<Moment>,
    ) -> Result<usize, SnapshotError> {
        let now = now.into();
        let Some(agent) = self.agent.clone().filter(|_| self.is_empty()) else {
            return Err(SnapshotError::InUse);
        };
        let library = Arc::clone(&self.library);
        let read = Read::new(snapshot, &library, &self.limits, &agent, now)?;
        self.fingerprints.set_keys(read.keys);
        for (part, children) in &read.mains {
            let main = self.put(part, None, now);
            for child in children {
                self.put(child, Some(main), now);
            }
            self.touch(main, now.millis());
            let peer = self.table.peer(main);
            self.evict(Some(main), peer, 0);
        }
        self.last = now;
        Ok(self.len())
    }

    fn put(&mut self, part: &Part<'_>, parent: Option<SlotIndex>, now: Moment) -> SlotIndex {
        let peer = match part.peer {
            "" => None,
            peer => Some(self.names.acquire(peer)),
        };
        let at = self
            .table
            .insert(part.id, parent, peer, part.machine, now.millis());
        let Some(slot) = self.table.slot_mut(at) else {
            return at;
        };
        let generation = slot.generation;
        let conversation = &mut slot.conversation;
        if peer.is_some() {
            conversation.charge(Names::cost(part.peer.len()));
        }
        conversation.initiator = Some(conversation.acquire(&mut self.names, part.initiator));
        for (index, (peer, party)) in part.parties.iter().enumerate() {
            let peer = match *peer {
                "" => None,
                peer => Some(conversation.acquire(&mut self.names, peer)),
            };
            if party.deadline != 0 {
                self.deadlines.push(Deadline {
                    due: party.deadline,
                    at,
                    generation,
                    party: PartyIndex::new(index),
                });
            }
            conversation.add(Party {
                peer,
                ..party.clone()
            });
        }
        if let Some(party) = &part.unnamed {
            conversation.rare().unnamed = Some(Box::new(party.clone()));
        }
        for (role, agent) in &part.bound {
            let agent = conversation.acquire(&mut self.names, agent);
            let role = *role;
            let binding = RoleBinding { role, agent };
            conversation.bound.push(binding);
        }
        for agent in &part.reply_to {
            let agent = conversation.acquire(&mut self.names, agent);
            conversation.rare().reply_to.push(agent);
        }
        for (party, agent) in &part.delegates {
            let agent = conversation.acquire(&mut self.names, agent);
            conversation.rare().delegates.push((*party, agent));
        }
        self.table.charge(at);
        at
    }
}

const SPECIAL: [StateId; 4] = [AFTER_NOT_UNDERSTOOD, CANCELLING, CANCELLED, FAILED];
