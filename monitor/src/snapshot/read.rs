//! Reads and checks a snapshot.

use std::collections::{HashMap, HashSet};
use std::time::{Duration, UNIX_EPOCH};

use super::{BY_INITIATOR, CANCELED_BY_OTHER, ECHO, MAGIC, SPECIAL, SnapshotError, VERSION};
use crate::conversation::ids::PartyIndex;
use crate::conversation::party::{EARLIER, Party, Side, Tail};
use crate::conversation::state::{AFTER_NOT_UNDERSTOOD, CANCELLING, FAILED};
use crate::limits::{MAX_ALIKE, MAX_DESIGNATED, MAX_TEXT};
use crate::protocol::act::ActNumber;
use crate::protocol::index::{MachineIndex, StateId};
use crate::protocol::machine::{Machine, Scope};
use crate::protocol::role::Role;
use crate::{Library, Moment, MonitorLimits};

/// A snapshot that was read and checked.
pub(super) struct Read<'s> {
    pub(super) keys: [u64; 2],
    pub(super) mains: Vec<(Part<'s>, Vec<Part<'s>>)>,
}

impl<'s> Read<'s> {
    pub(super) fn new(
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

/// A conversation of a snapshot.
pub(super) struct Part<'s> {
    pub(super) machine: MachineIndex,
    pub(super) id: &'s str,
    pub(super) peer: &'s str,
    pub(super) initiator: &'s str,
    pub(super) parties: Vec<(&'s str, Party)>,
    pub(super) unnamed: Option<Party>,
    pub(super) bound: Vec<(Role, &'s str)>,
    pub(super) reply_to: Vec<&'s str>,
    pub(super) delegates: Vec<(PartyIndex, &'s str)>,
}

/// The input of the checks of a snapshot.
struct Context<'a> {
    library: &'a Library,
    limits: &'a MonitorLimits,
    agent: &'a str,
    now: Moment,
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
