//! Writes a snapshot.

use std::time::{Duration, UNIX_EPOCH};

use super::{BY_INITIATOR, CANCELED_BY_OTHER, ECHO, MAGIC, SPECIAL, VERSION};
use crate::Moment;
use crate::conversation::ids::SlotIndex;
use crate::conversation::names::Names;
use crate::conversation::party::{Party, Side};
use crate::conversation::state::FAILED;
use crate::limits::MAX_TEXT;
use crate::monitor::Monitor;
use crate::protocol::act::ActNumber;
use crate::protocol::index::StateId;
use crate::protocol::machine::Machine;

impl Monitor {
    /// Returns the conversations of the monitored agent, for the next registration of the agent:
    /// [`restore`](Self::restore) reads them. An observer has none.
    ///
    /// The snapshot must be the last act of this monitor: the next one refuses a legal message if this one
    /// gets messages, or outcomes of messages, after the snapshot.
    ///
    /// The snapshot omits conversations with an uncertain state: those that began between other agents, that may
    /// have begun before the monitor, or whose last message was not delivered; and those of protocols with three or
    /// more roles. It has at most [`MonitorLimits::bytes`](crate::MonitorLimits::bytes) bytes, and keeps the latest
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
