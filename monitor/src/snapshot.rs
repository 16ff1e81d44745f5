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

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::time::{Duration, UNIX_EPOCH};

use crate::conversation::bindings::RoleBinding;
use crate::conversation::deadlines::Deadline;
use crate::conversation::ids::{PartyIndex, SlotIndex};
use crate::conversation::names::Names;
use crate::conversation::party::{EARLIER, Party, Side, Tail};
use crate::conversation::state::{AFTER_NOT_UNDERSTOOD, CANCELLED, CANCELLING, FAILED};
use crate::limits::{MAX_ALIKE, MAX_DESIGNATED, MAX_TEXT};
use crate::monitor::Monitor;
use crate::protocol::act::ActNumber;
use crate::protocol::index::{MachineIndex, StateId};
use crate::protocol::machine::{Machine, Scope};
use crate::protocol::role::Role;
use crate::{Library, Moment, MonitorLimits};

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
    /// Returns the conversations of the monitored agent, for the next registration of the agent:
    /// [`restore`](Self::restore) reads them. An observer has none.
    ///
    /// The snapshot must be the last act of this monitor: the next one refuses a legal message if this one
    /// gets messages, or outcomes of messages, after the snapshot.
    ///
    /// The snapshot omits conversations with an uncertain state: those that began between other agents,
    /// that may have begun before the monitor, or whose last message was not delivered; and those of
    /// protocols with three or more roles. It has at most [`MonitorLimits::bytes`] bytes, and keeps the latest
    /// conversations. The next monitor does not know the others.
    #[must_use]
    pub fn snapshot(&self, now: impl Into<Moment>) -> Vec<u8> {
        let now = now.into();
        let agent = self.agent.as_deref().unwrap_or_default();
        let mut out = Vec::new();
        out.extend_from_slice(&MAGIC);
        out.extend_from_slice(&VERSION.to_le_bytes());
        // A longer name is that of no agent, and takes part in no conversation.
        let agent = Some(agent)
            .filter(|agent| agent.len() <= MAX_TEXT)
            .unwrap_or_default();
        let _ = put_text(&mut out, agent);
        for key in self.fingerprints.keys() {
            out.extend_from_slice(&key.to_le_bytes());
        }
        let count_at = out.len();
        put_count(&mut out, 0);
        if agent.is_empty() {
            return out;
        }
        let mut mains: Vec<(u64, u64, SlotIndex)> = self.table.mains().collect();
        mains.sort_unstable_by(|one, other| other.cmp(one));
        // The oldest is written first.
        let mut written = Vec::new();
        let mut len = out.len();
        for (.., main) in mains {
            let mut part = Vec::new();
            if self.write_main(main, agent, now, &mut part).is_none() {
                continue;
            }
            len += part.len();
            if len > self.limits.bytes {
                break;
            }
            written.push(part);
        }
        out.truncate(count_at);
        put_count(&mut out, written.len());
        for part in written.iter().rev() {
            out.extend_from_slice(part);
        }
        out
    }

    /// Writes a main conversation with its embedded ones. `None` if one of them is uncertain.
    fn write_main(
        &self,
        main: SlotIndex,
        agent: &str,
        now: Moment,
        out: &mut Vec<u8>,
    ) -> Option<()> {
        self.write_part(main, agent, now, out)?;
        let count_at = out.len();
        put_count(out, 0);
        let (mut count, mut next) = (0_u32, self.table.slot(main)?.child);
        while let Some(child) = next {
            self.write_part(child, agent, now, out)?;
            count += 1;
            next = self.table.sibling(child);
        }
        let place = out.get_mut(count_at..count_at + 4)?;
        place.copy_from_slice(&count.to_le_bytes());
        Some(())
    }

    fn write_part(&self, at: SlotIndex, agent: &str, now: Moment, out: &mut Vec<u8>) -> Option<()> {
        let conversation = &self.table.slot(at)?.conversation;
        let names = &self.names;
        let machine = self.library.machine(conversation.machine)?;
        let rare = conversation.rare.as_deref();
        let local = rare.is_some_and(|rare| rare.local.is_some() || rare.may_continue);
        let named = !conversation.reply_to().is_empty() && names.is(conversation.initiator, agent);
        let takes_part =
            conversation.takes_part(names, agent) || conversation.is_designated(names, agent);
        if local || conversation.joined || named || !takes_part {
            return None;
        }
        put_text(out, machine.name())?;
        put_text(out, self.table.id(at))?;
        put_text(out, names.text(self.table.peer(at)))?;
        put_text(out, names.text(conversation.initiator))?;
        put_count(out, conversation.parties.len());
        for party in conversation.parties.iter() {
            write_party(machine, names, party, now, out)?;
        }
        out.push(u8::from(conversation.unnamed().is_some()));
        if let Some(party) = conversation.unnamed() {
            write_party(machine, names, party, now, out)?;
        }
        put_count(out, conversation.bound.len());
        for bound in conversation.bound.iter() {
            out.push(bound.role.get());
            put_text(out, names.text(bound.agent))?;
        }
        put_count(out, conversation.reply_to().len());
        for agent in conversation.reply_to() {
            put_text(out, names.text(*agent))?;
        }
        put_count(out, conversation.delegates().len());
        for (party, agent) in conversation.delegates() {
            put_count(out, party.get());
            put_text(out, names.text(*agent))?;
        }
        Some(())
    }

    /// Restores the conversations of a [`snapshot`](Self::snapshot) of the same agent, before the first
    /// message. Returns their number, with embedded ones. Conversations of protocols that this monitor does
    /// not have are left out, and so are the oldest ones if [`MonitorLimits`] are exceeded.
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

/// Appends a text. `None` if it is longer than [`MAX_TEXT`].
fn put_text(out: &mut Vec<u8>, text: &str) -> Option<()> {
    let len = u16::try_from(text.len()).ok();
    let len = len.filter(|len| usize::from(*len) <= MAX_TEXT)?;
    out.extend_from_slice(&len.to_le_bytes());
    out.extend_from_slice(text.as_bytes());
    Some(())
}

fn put_count(out: &mut Vec<u8>, count: usize) {
    let count = u32::try_from(count).unwrap_or(u32::MAX);
    out.extend_from_slice(&count.to_le_bytes());
}

const SPECIAL: [StateId; 4] = [AFTER_NOT_UNDERSTOOD, CANCELLING, CANCELLED, FAILED];

fn put_state(machine: &Machine, state: StateId, out: &mut Vec<u8>) -> Option<()> {
    if let Some(special) = SPECIAL.iter().position(|special| *special == state) {
        out.push(u8::try_from(special + 1).ok()?);
        return Some(());
    }
    out.push(0);
    put_text(out, machine.state(state)?.id())
}

/// Writes a party. `None` if its state is uncertain.
fn write_party(
    machine: &Machine,
    names: &Names,
    party: &Party,
    now: Moment,
    out: &mut Vec<u8>,
) -> Option<()> {
    // Only such a party has [`Worlds`](crate::conversation::Worlds).
    if party.state == FAILED {
        return None;
    }
    put_text(out, names.text(party.peer))?;
    for state in [party.state, party.resume, party.before] {
        put_state(machine, state, out)?;
    }
    let flag = |set: bool, flag: u8| if set { flag } else { 0 };
    out.push(
        flag(party.last == Side::Initiator, BY_INITIATOR)
            | flag(party.canceling_side == Side::Other, CANCELED_BY_OTHER)
            | flag(party.echo, ECHO),
    );
    out.extend(party.acts.map(|act| act.map_or(0, ActNumber::byte)));
    for (side, asked) in party.asked.iter().enumerate() {
        out.extend_from_slice(&asked.to_le_bytes());
        put_text(out, party.asked_text(side))?;
        for earlier in party.earlier(side) {
            out.extend_from_slice(&earlier.to_le_bytes());
        }
    }
    out.extend_from_slice(&party.cancel().to_le_bytes());
    let deadline = match party.deadline {
        0 => 0,
        due => {
            let due = now.wall_at(Duration::from_millis(due))?;
            let due = due.duration_since(UNIX_EPOCH).unwrap_or_default();
            u64::try_from(due.as_millis()).ok()?.max(1)
        }
    };
    out.extend_from_slice(&deadline.to_le_bytes());
    Some(())
}

/// A snapshot that was read and checked.
struct Read<'s> {
    keys: [u64; 2],
    mains: Vec<(Part<'s>, Vec<Part<'s>>)>,
}

/// A conversation of a snapshot.
struct Part<'s> {
    machine: MachineIndex,
    id: &'s str,
    peer: &'s str,
    initiator: &'s str,
    parties: Vec<(&'s str, Party)>,
    unnamed: Option<Party>,
    bound: Vec<(Role, &'s str)>,
    reply_to: Vec<&'s str>,
    delegates: Vec<(PartyIndex, &'s str)>,
}

/// The input of the checks of a snapshot.
struct Context<'a> {
    library: &'a Library,
    limits: &'a MonitorLimits,
    agent: &'a str,
    now: Moment,
}

impl<'s> Read<'s> {
    fn new(
        snapshot: &'s [u8],
        library: &Library,
        limits: &MonitorLimits,
        agent: &str,
        now: Moment,
    ) -> Result<Self, SnapshotError> {
        if snapshot.len() > limits.bytes {
            return Err(SnapshotError::TooLarge("length of the snapshot"));
        }
        let mut input = Input(snapshot);
        if input.bytes(MAGIC.len()) != Ok(&MAGIC[..]) {
            return Err(SnapshotError::NotASnapshot);
        }
        let version = input.u32()?;
        if version != VERSION {
            return Err(SnapshotError::Version(version));
        }
        let found = input.text()?;
        if found != agent {
            return Err(SnapshotError::OtherAgent {
                expected: agent.to_owned(),
                found: found.to_owned(),
            });
        }
        let keys = [input.u64()?, input.u64()?];
        let context = Context {
            library,
            limits,
            agent,
            now,
        };
        let count = input.u32()?;
        let mut mains = Vec::new();
        let mut alike = HashMap::new();
        for _ in 0..count {
            let main = input.part(&context)?;
            let children = input.count(limits.embedded, "number of embedded conversations")?;
            let mut parts = Vec::new();
            let mut known = true;
            for _ in 0..children {
                match input.part(&context)? {
                    Some(part) => parts.push(part),
                    None => known = false,
                }
            }
            let Some(main) = main.filter(|_| known) else {
                continue;
            };
            let same = |part: &Part<'_>| part.id == main.id && part.peer == main.peer;
            if !parts.iter().all(same) {
                return Err(SnapshotError::Malformed("an embedded conversation"));
            }
            let number = alike.entry(main.id).or_insert(0);
            *number += 1;
            if *number > MAX_ALIKE {
                return Err(SnapshotError::TooLarge("conversations with one id"));
            }
            mains.push((main, parts));
        }
        if !input.0.is_empty() {
            return Err(SnapshotError::Malformed("bytes after the end"));
        }
        Ok(Self { keys, mains })
    }
}

/// The rest of a snapshot.
struct Input<'s>(&'s [u8]);

impl<'s> Input<'s> {
    fn bytes(&mut self, len: usize) -> Result<&'s [u8], SnapshotError> {
        let (read, rest) = self
            .0
            .split_at_checked(len)
            .ok_or(SnapshotError::Malformed("it ends too early"))?;
        self.0 = rest;
        Ok(read)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], SnapshotError> {
        let read = self.bytes(N)?;
        read.try_into()
            .map_err(|_| SnapshotError::Malformed("it ends too early"))
    }

    fn u8(&mut self) -> Result<u8, SnapshotError> {
        Ok(u8::from_le_bytes(self.array()?))
    }

    fn u32(&mut self) -> Result<u32, SnapshotError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    fn u64(&mut self) -> Result<u64, SnapshotError> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    fn text(&mut self) -> Result<&'s str, SnapshotError> {
        let len = usize::from(u16::from_le_bytes(self.array()?));
        if len > MAX_TEXT {
            return Err(SnapshotError::TooLarge("length of a name"));
        }
        let read = std::str::from_utf8(self.bytes(len)?);
        read.map_err(|_| SnapshotError::Malformed("a text is not UTF-8"))
    }

    /// Reads the name of an agent.
    fn name(&mut self) -> Result<&'s str, SnapshotError> {
        match self.text()? {
            "" => Err(SnapshotError::Malformed("an agent without name")),
            name => Ok(name),
        }
    }

    /// Reads a number of items. No memory is taken for them before they are read.
    fn count(&mut self, max: usize, what: &'static str) -> Result<u32, SnapshotError> {
        let count = self.u32()?;
        match usize::try_from(count) {
            Ok(number) if number <= max => Ok(count),
            _ => Err(SnapshotError::TooLarge(what)),
        }
    }

    /// Reads a conversation. `None` if its protocol is unknown.
    fn part(&mut self, context: &Context<'_>) -> Result<Option<Part<'s>>, SnapshotError> {
        let malformed = |what| Err(SnapshotError::Malformed(what));
        let index = context.library.index_of(self.text()?);
        let machine = index.and_then(|index| context.library.machine(index));
        let (id, peer, initiator) = (self.text()?, self.text()?, self.name()?);
        let participants = context.limits.participants;
        let count = self.count(participants, "number of participants")?;
        let mut parties = Vec::new();
        for _ in 0..count {
            parties.push(self.party(machine, context.now)?);
        }
        let unnamed = match self.u8()? {
            0 => None,
            1 => Some(self.party(machine, context.now)?),
            _ => return malformed("a flag"),
        };
        let count = self.count(participants + 1, "number of agents with roles")?;
        let mut bound = Vec::new();
        for _ in 0..count {
            bound.push((Role::new(self.u8()?), self.name()?));
        }
        let count = self.count(MAX_DESIGNATED, "number of agents in reply-to")?;
        let mut reply_to = Vec::new();
        for _ in 0..count {
            reply_to.push(self.name()?);
        }
        let count = self.count(MAX_DESIGNATED, "number of agents in reply-to")?;
        let mut delegates = Vec::new();
        for _ in 0..count {
            let party = usize::try_from(self.u32()?).unwrap_or(usize::MAX);
            delegates.push((PartyIndex::new(party), self.name()?));
        }
        if reply_to.len() + delegates.len() > MAX_DESIGNATED {
            return Err(SnapshotError::TooLarge("number of agents in reply-to"));
        }
        let (Some(index), Some(machine)) = (index, machine) else {
            return Ok(None);
        };
        // An agent checks a projected protocol by its role.
        if machine.projection.is_some() {
            return malformed("a protocol with three or more roles");
        }
        let names: HashSet<&str> = parties.iter().map(|(name, _)| *name).collect();
        let fits = match machine.scope {
            Scope::Participant => {
                let present = !parties.is_empty() || unnamed.is_some();
                let unnamed = unnamed.as_ref().is_none_or(|(name, _)| name.is_empty());
                let distinct = names.len() == parties.len() && !names.contains("");
                present && unnamed && distinct && bound.is_empty()
            }
            Scope::Conversation => {
                let one = matches!(&parties[..], [(name, _)] if name.is_empty());
                one && unnamed.is_none() && delegates.is_empty()
            }
        };
        if !fits {
            return malformed("participants that do not fit the protocol");
        }
        let unknown = |role: Role| role.index() >= machine.roles.len();
        if bound.iter().any(|(role, _)| unknown(*role)) {
            return malformed("an unknown role");
        }
        let no_party = |at: PartyIndex| at.get() >= parties.len();
        if delegates.iter().any(|(party, _)| no_party(*party)) {
            return malformed("an unknown participant");
        }
        let agent = context.agent;
        let takes_part = initiator == agent
            || names.contains(agent)
            || bound.iter().any(|(_, name)| *name == agent)
            || reply_to.contains(&agent)
            || delegates.iter().any(|(_, name)| *name == agent);
        if !takes_part {
            return malformed("a conversation without the agent");
        }
        if initiator == agent && !reply_to.is_empty() {
            return malformed("a conversation that continues elsewhere");
        }
        Ok(Some(Part {
            machine: index,
            id,
            peer,
            initiator,
            parties,
            unnamed: unnamed.map(|(_, party)| party),
            bound,
            reply_to,
            delegates,
        }))
    }

    /// Reads a party, with the name of its participant.
    fn party(
        &mut self,
        machine: Option<&Machine>,
        now: Moment,
    ) -> Result<(&'s str, Party), SnapshotError> {
        let malformed = |what| Err(SnapshotError::Malformed(what));
        let peer = self.text()?;
        let [state, resume, before] = [
            self.state(machine)?,
            self.state(machine)?,
            self.state(machine)?,
        ];
        if state == FAILED {
            return malformed("an uncertain state");
        }
        // The state after a cancel that fails.
        let is_own = |state: StateId| !SPECIAL.contains(&state);
        if [CANCELLING, AFTER_NOT_UNDERSTOOD].contains(&state) && !is_own(resume) {
            return malformed("a state to resume");
        }
        let flags = self.u8()?;
        if flags > BY_INITIATOR | CANCELED_BY_OTHER | ECHO {
            return malformed("a flag");
        }
        let side = |initiator| match initiator {
            true => Side::Initiator,
            false => Side::Other,
        };
        let mut acts = [None; 2];
        for (act, byte) in acts.iter_mut().zip(self.array::<2>()?) {
            *act = ActNumber::from_byte(byte);
            if act.is_none() && byte != 0 {
                return malformed("an unknown performative");
            }
        }
        let mut party = Party {
            resume,
            before,
            last: side(flags & BY_INITIATOR != 0),
            canceling_side: side(flags & CANCELED_BY_OTHER == 0),
            echo: flags & ECHO != 0,
            acts,
            ..Party::new(None, state)
        };
        for side in 0..2 {
            let asked = self.u64()?;
            let text = self.text()?;
            let mut earlier = [0; EARLIER];
            for earlier in &mut earlier {
                *earlier = self.u32()?;
            }
            party.asked[side] = asked;
            if !text.is_empty() || earlier != [0; EARLIER] {
                let details = party.details();
                details.asked_text[side] = Tail::of(text);
                details.earlier[side] = earlier;
            }
        }
        party.set_cancel(self.u64()?);
        party.deadline = match self.u64()? {
            0 => 0,
            due => {
                let due = UNIX_EPOCH.checked_add(Duration::from_millis(due));
                let due = due.ok_or(SnapshotError::Malformed("a deadline"))?;
                now.millis_at(due)
            }
        };
        Ok((peer, party))
    }

    fn state(&mut self, machine: Option<&Machine>) -> Result<StateId, SnapshotError> {
        let special = match self.u8()? {
            0 => {
                let name = self.text()?;
                let Some(machine) = machine else {
                    return Ok(StateId::FIRST);
                };
                let mut all = (0..).map(StateId::new).zip(&machine.states);
                let found = all.find(|(_, state)| state.id() == name);
                return found
                    .map(|(at, _)| at)
                    .ok_or(SnapshotError::Malformed("an unknown state"));
            }
            special => SPECIAL.get(usize::from(special) - 1),
        };
        special
            .copied()
            .ok_or(SnapshotError::Malformed("an unknown state"))
    }
}
