//! The parts of a conversation that most conversations do not have.

use hashbrown::HashTable;
use smallvec::SmallVec;

use crate::conversation::bindings::RoleBinding;
use crate::conversation::ids::{Name, PartyIndex};
use crate::conversation::party::Party;
use crate::protocol::act::ActNumber;
use crate::protocol::index::StateId;
use crate::protocol::projection::LocalRun;
use crate::protocol::role::{MessageRoles, RoleSet};

/// The parts of a conversation that most conversations do not have.
#[derive(Debug, Default)]
pub(crate) struct Rare {
    /// Agents that receive replies instead of the initiator, and may continue in its place.
    pub(crate) reply_to: Vec<Name>,
    /// State of the members of a multicast. Their names are unknown until they answer.
    pub(crate) unnamed: Option<Box<Party>>,
    /// Agents that receive messages instead of a participant, and may continue in its place: the index
    /// of the party and the agent.
    pub(crate) delegates: Vec<(PartyIndex, Name)>,
    /// Whether the conversation may have begun before the monitor.
    pub(crate) may_continue: bool,
    /// If it may, other states to which the first message to a party may have led: the index of the party, or none
    /// for the members of a multicast, and the state. [`FAILED`](crate::conversation::state::FAILED) stands for any
    /// state: a message to the party was not delivered.
    pub(crate) alternatives: Vec<(Option<PartyIndex>, StateId)>,
    /// The conversation as the role of the monitored agent sees it.
    pub(crate) local: Option<LocalRun>,
    /// Whether an agent has a role in it that the monitored agent knows only from a message of that agent.
    pub(crate) claimed: bool,
    /// Whether the state is uncertain, because an agent that may have claimed its role wrongly has ended the
    /// conversation, or because another agent may have that role.
    pub(crate) contested: bool,
    /// Roles that the monitored agent may have, because the message that excludes them may be of an outsider.
    pub(crate) uncertain_roles: RoleSet,
    /// Whether the last message of the monitored agent was reported as undelivered.
    pub(crate) undelivered: bool,
    /// Whether only a message of an agent that claimed a role has shown that such a message arrived.
    pub(crate) uncertain: bool,
    /// The last message of the monitored agent in it, until it is known to have arrived.
    pub(crate) last_sent: Option<LastSent>,
    /// The roles that the receivers of that message got with it, after it was reported as undelivered. It
    /// may have arrived, so only these agents can answer it.
    pub(crate) asked: SmallVec<[RoleBinding; 2]>,
    /// The last messages of which an observer gets each copy by itself.
    pub(crate) copied: Vec<Copied>,
    /// The parties by their peers, if there are more than [`FEW`](crate::conversation::FEW).
    pub(crate) index: HashTable<(Name, PartyIndex)>,
}

impl Rare {
    /// Bytes of these parts, and those that they have allocated.
    pub(crate) fn allocated(&self) -> usize {
        let unnamed = self.unnamed.as_deref();
        let copies = self.copied.iter();
        size_of::<Self>()
            + self.reply_to.capacity() * size_of::<Name>()
            + unnamed.map_or(0, |party| size_of::<Party>() + party.allocated())
            + self.delegates.capacity() * size_of::<(PartyIndex, Name)>()
            + self.alternatives.capacity() * size_of::<(Option<PartyIndex>, StateId)>()
            + self.copied.capacity() * size_of::<Copied>()
            + copies
                .map(|copied| 8 * copied.seen.capacity())
                .sum::<usize>()
            + match self.asked.spilled() {
                true => self.asked.capacity() * size_of::<RoleBinding>(),
                false => 0,
            }
            + self.index.allocation_size()
            + self.local.as_ref().map_or(0, LocalRun::allocated)
    }
}

/// The last message of the monitored agent in a conversation that its role sees.
#[derive(Debug)]
pub(crate) struct LastSent {
    pub(crate) act: ActNumber,
    pub(crate) reply_with: u64,
    /// The state before it.
    pub(crate) state: StateId,
    /// Whether it is a `not-understood`, which the role does not see.
    pub(crate) ends: bool,
    /// Number of the role bindings before it.
    pub(crate) bound: usize,
    /// Number of the role bindings after it.
    pub(crate) bound_after: usize,
}

/// A message of which an observer gets each copy by itself.
#[derive(Debug)]
pub(crate) struct Copied {
    pub(crate) fingerprint: u64,
    /// Fingerprints of the receivers of the copies.
    pub(crate) seen: Vec<u64>,
    /// Roles of the sender and the receivers.
    pub(crate) roles: MessageRoles,
}

impl Copied {
    /// Maximum number of messages whose copies may mix.
    pub(crate) const MAX: usize = 4;
}
