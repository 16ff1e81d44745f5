//! Conversations, their parts, and the table that has them.
//!
//! With [`Scope::Participant`](crate::Scope::Participant), each participant has a [`Party`] with a state of its
//! own. With [`Scope::Conversation`](crate::Scope::Conversation), there is one party without a participant, and a
//! list of role bindings.
//!
//! The rules that decide on a message do not belong here, but in [`crate::check`].

pub(crate) mod bindings;
pub(crate) mod deadlines;
pub(crate) mod fingerprints;
pub(crate) mod ids;
mod index;
pub(crate) mod memory;
pub(crate) mod names;
mod parties;
pub(crate) mod party;
pub(crate) mod rare;
pub(crate) mod state;
pub(crate) mod table;

use smallvec::SmallVec;

use crate::conversation::bindings::{Bound, RoleBinding};
use crate::conversation::ids::{Name, PartyIndex};
use crate::conversation::names::{Names, spread};
use crate::conversation::parties::Parties;
use crate::conversation::party::Party;
use crate::conversation::rare::Rare;
use crate::limits::MAX_DESIGNATED;
use crate::protocol::index::MachineIndex;
use crate::protocol::role::Role;

/// The order of the fields is that of the memory: see [`Slot`](crate::conversation::table::Slot).
#[derive(Debug)]
#[repr(C)]
pub(crate) struct Conversation {
    /// Index into the library.
    pub(crate) machine: MachineIndex,
    /// Whether the conversation began between other agents, and the monitored agent joined it because
    /// a `reply-to` names it. It then has the place of the initiator.
    pub(crate) joined: bool,
    /// None for an unused slot.
    pub(crate) initiator: Option<Name>,
    /// Bytes that the texts of the conversation are charged with: its identifier and its names.
    charged_texts: u32,
    /// Bytes with which the peer is charged.
    pub(crate) cost: u32,
    pub(crate) rare: Option<Box<Rare>>,
    pub(crate) bound: Bound,
    pub(crate) parties: Parties,
}

/// Number of parties that are searched one by one.
const FEW: usize = 8;

impl Conversation {
    /// A conversation without agents, as an unused slot has it.
    pub(crate) fn unused() -> Self {
        Self {
            machine: MachineIndex::FIRST,
            joined: false,
            initiator: None,
            charged_texts: 0,
            cost: 0,
            rare: None,
            bound: Bound::default(),
            parties: Parties::default(),
        }
    }

    /// Removes all but a buffer for the next conversation.
    pub(crate) fn clear(&mut self) {
        let mut parties = std::mem::take(&mut self.parties);
        parties.clear();
        *self = Self {
            parties,
            ..Self::unused()
        };
    }

    /// Adds to the bytes of the texts.
    pub(crate) fn charge(&mut self, bytes: usize) {
        let bytes = u32::try_from(bytes).unwrap_or(u32::MAX);
        self.charged_texts = self.charged_texts.saturating_add(bytes);
    }

    /// Subtracts from the bytes of the texts.
    pub(crate) fn discharge(&mut self, bytes: usize) {
        let bytes = u32::try_from(bytes).unwrap_or(u32::MAX);
        self.charged_texts = self.charged_texts.saturating_sub(bytes);
    }

    /// Bytes that the conversation has allocated.
    #[inline]
    pub(crate) fn allocated(&self) -> usize {
        let rare = self.rare.as_deref().map_or(0, Rare::allocated);
        let texts = usize::try_from(self.charged_texts).unwrap_or(usize::MAX);
        self.parties.allocated() + self.bound.allocated() + rare + texts
    }

    /// Returns an upper bound of the bytes that so many more parties, role bindings and agents in `reply-to`
    /// allocate, without their names.
    pub(crate) fn growth(&self, parties: usize, bindings: usize, designated: usize) -> usize {
        if [parties, bindings, designated] == [0; 3] {
            return 0;
        }
        let rare = match &self.rare {
            Some(_) => 0,
            None => size_of::<Rare>(),
        };
        let count = self.parties.len() + parties;
        let index = match parties {
            0 => 0,
            _ if count <= FEW => 0,
            // A table has a byte more for each place, is at most seven eighths full, and ends with a group.
            _ => (count * 8 / 7).next_power_of_two() * (size_of::<(Name, PartyIndex)>() + 1) + 16,
        };
        let designated = match designated {
            0 => 0,
            _ => MAX_DESIGNATED * size_of::<(PartyIndex, Name)>(),
        };
        self.parties.growth(parties) + self.bound.growth(bindings) + rare + index + designated
    }

    /// Takes a reference to a name for this conversation.
    pub(crate) fn acquire(&mut self, names: &mut Names, text: &str) -> Name {
        self.charge(Names::cost(text.len()));
        names.acquire(text)
    }

    /// Releases the names of [`Rare::asked`], of the roles for which `is_known` holds.
    pub(crate) fn release_asked(&mut self, names: &mut Names, is_known: impl Fn(Role) -> bool) {
        let Some(rare) = self.rare.as_deref_mut() else {
            return;
        };
        let (known, others) = rare.asked.drain(..).partition(|asked| is_known(asked.role));
        rare.asked = others;
        let known: SmallVec<[RoleBinding; 2]> = known;
        for RoleBinding { agent, .. } in known {
            self.discharge(Names::cost(names.text(agent).len()));
            names.release(agent);
        }
    }

    /// Whether it is checked as the role of the monitored agent sees it.
    pub(crate) fn is_local(&self) -> bool {
        self.rare
            .as_deref()
            .is_some_and(|rare| rare.local.is_some())
    }

    pub(crate) fn rare(&mut self) -> &mut Rare {
        self.rare.get_or_insert_default()
    }

    /// Adds a party. Returns its index.
    pub(crate) fn add(&mut self, party: Party) -> usize {
        self.parties.push(party);
        let count = self.parties.len();
        // The index is made when there are many parties, and kept from then on.
        if count == FEW + 1 {
            for at in 0..count {
                self.index(at);
            }
        } else if count > FEW {
            self.index(count - 1);
        }
        count - 1
    }

    fn index(&mut self, at: usize) {
        let Some(peer) = self.parties.get(at).and_then(|party| party.peer) else {
            return;
        };
        let entry = (peer, PartyIndex::new(at));
        let index = &mut self.rare().index;
        index.insert_unique(spread(peer), entry, |(peer, _)| spread(*peer));
    }

    /// Finds the party of an agent: a participant, or an agent that continues in its place.
    #[inline]
    pub(crate) fn party(&self, names: &Names, agent: &str) -> Option<(usize, &Party)> {
        match &self.parties {
            Parties::One(only) if names.is(only.peer, agent) => Some((0, only)),
            _ => self.other_party(names, agent),
        }
    }

    fn other_party(&self, names: &Names, agent: &str) -> Option<(usize, &Party)> {
        let found = match &self.parties {
            Parties::None(_) | Parties::One(_) => None,
            Parties::Many(parties) if parties.len() <= FEW => {
                let mut parties = parties.iter();
                parties.position(|party| names.is(party.peer, agent))
            }
            Parties::Many(_) => self.indexed(names, agent),
        };
        let found = found.or_else(|| self.delegating(names, agent))?;
        self.parties.get(found).map(|party| (found, party))
    }

    /// Finds a participant among many.
    fn indexed(&self, names: &Names, agent: &str) -> Option<usize> {
        let index = &self.rare.as_deref()?.index;
        let peer = names.known(agent)?;
        let (_, at) = index.find(spread(peer), |(known, _)| *known == peer)?;
        Some(at.get())
    }

    /// Finds the participant in whose place an agent continues.
    fn delegating(&self, names: &Names, agent: &str) -> Option<usize> {
        let mut delegates = self.delegates().iter();
        let (at, _) = delegates.find(|(_, delegate)| names.is(*delegate, agent))?;
        Some(at.get())
    }

    pub(crate) fn delegates(&self) -> &[(PartyIndex, Name)] {
        let rare = self.rare.as_deref();
        rare.map_or(&[], |rare| &rare.delegates)
    }

    pub(crate) fn reply_to(&self) -> &[Name] {
        let rare = self.rare.as_deref();
        rare.map_or(&[], |rare| &rare.reply_to)
    }

    pub(crate) fn unnamed(&self) -> Option<&Party> {
        self.rare.as_deref()?.unnamed.as_deref()
    }

    /// Whether the agent has sent or received a message of this conversation, or may.
    pub(crate) fn takes_part(&self, names: &Names, agent: &str) -> bool {
        let bound = self.bound.iter().map(|bound| bound.agent);
        let mut known = bound.map(Some).chain([self.initiator]);
        self.party(names, agent).is_some() || known.any(|name| names.is(name, agent))
    }

    /// Whether a `reply-to` names the agent instead of the initiator.
    pub(crate) fn is_designated(&self, names: &Names, agent: &str) -> bool {
        self.reply_to().iter().any(|name| names.is(*name, agent))
    }

    /// With one state for all participants: whether the agent is the initiator, or continues in its
    /// place without a role of its own.
    pub(crate) fn speaks_for_initiator(&self, names: &Names, agent: &str) -> bool {
        let has_part = || self.bound.iter().any(|bound| names.is(bound.agent, agent));
        names.is(self.initiator, agent) || self.is_designated(names, agent) && !has_part()
    }
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use super::*;
    use crate::conversation::party::{Details, EARLIER, Side, Worlds};
    use crate::conversation::rare::Copied;
    use crate::conversation::state::FAILED;
    use crate::protocol::act::{ActNumber, INFORM};
    use crate::protocol::index::StateId;
    use crate::protocol::role::MessageRoles;

    #[test]
    fn what_parties_allocate_is_counted_and_one_buffer_is_kept() {
        let mut names = Names::new(std::hash::RandomState::new());
        let mut conversation = Conversation::unused();
        let party = Party::new(None, StateId::FIRST);
        conversation.add(party.clone());
        assert_eq!(conversation.allocated(), 0);
        let [first] = &mut conversation.parties[..] else {
            panic!()
        };
        first.ask(Side::Initiator, 0, "");
        assert_eq!(first.allocated(), 0);
        first.begin_step(Side::Initiator, ActNumber::of(INFORM), 7, false);
        first.ask(Side::Initiator, 7, "r7");
        assert_eq!(first.asked_text(0), "r7");
        assert_eq!(first.allocated(), size_of::<Details>());
        assert!(!first.take_back(Side::Initiator, ActNumber::of(INFORM), 8));
        assert!(first.take_back(Side::Initiator, ActNumber::of(INFORM), 7));
        assert_eq!(first.state, FAILED);
        // Two worlds with details each.
        let uncertain = 3 * size_of::<Details>() + size_of::<Worlds>();
        assert_eq!(first.allocated(), uncertain);
        conversation.add(party);
        let both = conversation.parties.allocated();
        assert_eq!(both, uncertain + 2 * size_of::<Party>());
        let agent = conversation.acquire(&mut names, "ann");
        conversation.bound.push(RoleBinding {
            role: Role::new(0),
            agent,
        });
        let bound = size_of::<SmallVec<[RoleBinding; 2]>>();
        assert_eq!(conversation.allocated(), both + bound + Names::cost(3));
        conversation.clear();
        assert_eq!(conversation.allocated(), 0);
        // The buffer of a single party serves the next one.
        let mut single = Party::new(None, StateId::FIRST);
        single.ask(Side::Other, 9, "r9");
        conversation.add(single);
        conversation.clear();
        assert_eq!(conversation.allocated(), size_of::<Details>());
        conversation.add(Party::new(None, StateId::FIRST));
        assert_eq!(conversation.allocated(), size_of::<Details>());
        let party = conversation.parties.first().unwrap();
        assert_eq!((party.asked_text(1), party.earlier(1)), ("", &[0; EARLIER]));
    }

    #[test]
    fn what_a_conversation_counts_is_what_it_allocates() {
        let mut conversation = Conversation::unused();
        let fill = |conversation: &mut Conversation| {
            for agent in (0..20).map(Name::new) {
                conversation.add(Party::new(Some(agent), StateId::FIRST));
                conversation.bound.push(RoleBinding {
                    role: Role::new(0),
                    agent,
                });
            }
            for party in conversation.parties.iter_mut().take(7) {
                party.begin_step(Side::Initiator, ActNumber::of(INFORM), 7, false);
                party.ask(Side::Initiator, 7, "r7");
            }
            // An uncertain one has two worlds.
            assert!(conversation.parties[0].take_back(Side::Initiator, ActNumber::of(INFORM), 7));
            let mut unnamed = Party::new(None, StateId::FIRST);
            unnamed.ask(Side::Initiator, 7, "r7");
            let rare = conversation.rare();
            rare.unnamed = Some(Box::new(unnamed));
            rare.reply_to.extend((0..3).map(Name::new));
            let delegate = |agent| (PartyIndex::new(0), Name::new(agent));
            rare.delegates.extend((0..5).map(delegate));
            let party = Some(PartyIndex::new(0));
            rare.alternatives
                .extend((0..7).map(|state| (party, StateId::new(state))));
            let asked = |agent| RoleBinding {
                role: Role::new(0),
                agent,
            };
            rare.asked.extend((0..3).map(Name::new).map(asked));
            for receivers in [2, 9] {
                rare.copied.push(Copied {
                    fingerprint: 0,
                    seen: (0..receivers).collect(),
                    roles: MessageRoles::NONE,
                });
            }
        };
        let measured = allocation_counter::measure(|| fill(&mut conversation));
        let allocated = i64::try_from(conversation.allocated()).unwrap();
        assert_eq!(allocated, measured.bytes_current);
        let measured = allocation_counter::measure(|| conversation.clear());
        assert_eq!(measured.bytes_current, -allocated);
    }

    #[test]
    fn what_the_rare_parts_allocate_is_counted() {
        let mut conversation = Conversation::unused();
        let mut before = 0;
        let mut added = |change: &dyn Fn(&mut Rare)| {
            change(conversation.rare());
            let now = conversation.allocated();
            now - std::mem::replace(&mut before, now)
        };
        assert_eq!(added(&|_| ()), size_of::<Rare>());
        let bytes = added(&|rare| rare.reply_to.reserve_exact(3));
        assert_eq!(bytes, 3 * size_of::<Name>());
        let bytes = added(&|rare| rare.delegates.reserve_exact(3));
        assert_eq!(bytes, 3 * size_of::<(PartyIndex, Name)>());
        let bytes = added(&|rare| rare.alternatives.reserve_exact(3));
        assert_eq!(bytes, 3 * size_of::<(Option<PartyIndex>, StateId)>());
        let bytes = added(&|rare| rare.copied.reserve_exact(3));
        assert_eq!(bytes, 3 * size_of::<Copied>());
        for receivers in [3, 5] {
            let bytes = added(&|rare| {
                rare.copied.push(Copied {
                    fingerprint: 0,
                    seen: Vec::with_capacity(receivers),
                    roles: MessageRoles::NONE,
                });
            });
            assert_eq!(bytes, receivers * size_of::<u64>());
        }
        let agent = Name::new(0);
        let asked = RoleBinding {
            role: Role::new(0),
            agent,
        };
        assert_eq!(added(&|rare| rare.asked.push(asked)), 0);
        let bytes = added(&|rare| rare.asked.grow(5));
        assert_eq!(bytes, 5 * size_of::<RoleBinding>());
        let bytes = added(&|rare| {
            let mut party = Party::new(None, StateId::FIRST);
            party.ask(Side::Initiator, 7, "r7");
            rare.unnamed = Some(Box::new(party));
        });
        assert_eq!(bytes, size_of::<Party>() + size_of::<Details>());
        let bytes = added(&|rare| {
            let name = Name::new(1);
            let entry = (name, PartyIndex::new(0));
            rare.index.insert_unique(spread(name), entry, |_| 0);
        });
        assert!(bytes >= size_of::<(Name, PartyIndex)>());
    }

    #[test]
    fn the_growth_of_a_conversation_is_bounded() {
        // At 14 and 448, the index is full.
        for before in [0, 1, 2, 3, 8, 9, 14, 100, 500] {
            for added in [0, 1, 2, 5, 7, 8, 90, 348, 600] {
                let mut names = Names::new(std::hash::RandomState::new());
                let mut conversation = Conversation::unused();
                let mut grow = |conversation: &mut Conversation, numbers: Range<usize>| {
                    for number in numbers {
                        let agent = names.acquire(&number.to_string());
                        conversation.add(Party::new(Some(agent), StateId::FIRST));
                        conversation.bound.push(RoleBinding {
                            role: Role::new(0),
                            agent,
                        });
                    }
                };
                grow(&mut conversation, 0..before);
                let bound = conversation.allocated() + conversation.growth(added, added, 64);
                grow(&mut conversation, before..before + added);
                for party in conversation.parties.iter_mut() {
                    party.details();
                }
                for _ in 0..MAX_DESIGNATED {
                    conversation
                        .rare()
                        .delegates
                        .push((PartyIndex::new(0), Name::new(0)));
                }
                let allocated = conversation.allocated();
                assert!(
                    allocated <= bound,
                    "{before} and {added}: {allocated} > {bound}"
                );
                if before == 0 {
                    // Two bindings are in the place of a pointer.
                    let inline = 2 * size_of::<RoleBinding>();
                    assert!(bound <= allocated + inline, "{added}: {bound}");
                }
                // A further role binding needs no more than itself.
                let further = conversation.bound.growth(1);
                assert_eq!(conversation.growth(0, 1, 0), further);
            }
        }
    }

    #[test]
    fn a_party_is_found_among_few_and_many() {
        let mut names = Names::new(std::hash::RandomState::new());
        let mut table = table::Table::new(&std::hash::RandomState::new());
        let at = table.insert("c", None, None, MachineIndex::FIRST, 1);
        let conversation = &mut table.slot_mut(at).unwrap().conversation;
        for number in 0..40 {
            let peer = conversation.acquire(&mut names, &number.to_string());
            conversation.add(Party::new(Some(peer), StateId::FIRST));
            for known in 0..=number {
                let found = conversation.party(&names, &known.to_string());
                assert_eq!(found.map(|(at, _)| at), Some(known));
            }
            assert!(conversation.party(&names, "other").is_none());
        }
        let delegate = conversation.acquire(&mut names, "other");
        conversation
            .rare()
            .delegates
            .push((PartyIndex::new(17), delegate));
        assert_eq!(
            conversation.party(&names, "other").map(|(at, _)| at),
            Some(17)
        );
        assert!(conversation.allocated() > 40 * size_of::<Party>());
    }
}
