//! What a message that was accepted changes, and what time does.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crate::Header;
use crate::conversation::{
    Bound, CANCELLING, Conversation, FAILED, NONE, Party, Side, act_number, side_index,
};
use crate::deadlines::{Deadline, Deadlines};
use crate::judge::{Heard, Move, Who, unbound};
use crate::machine::{After, Machine};
use crate::names::Names;

/// Takes the time-outs that are due.
pub(crate) fn expire(machine: &Machine, conversation: &mut Conversation, now: u64) {
    for party in &mut conversation.parties {
        if party.deadline != 0 && party.deadline < now {
            expire_party(machine, party);
        }
    }
}

/// Takes the time-out of the party's state, which is due.
pub(crate) fn expire_party(machine: &Machine, party: &mut Party) {
    let timeout = machine.state(party.state).and_then(|state| state.timeout);
    if let Some(timeout) = timeout {
        party.before = party.state;
        party.state = timeout.target;
    }
}

/// What a message changes.
pub(crate) struct Change<'a> {
    pub(crate) machine: &'a Machine,
    pub(crate) names: &'a mut Names,
    pub(crate) deadlines: &'a mut Deadlines,
    pub(crate) heard: &'a Heard<'a>,
    pub(crate) place: Deadline,
    pub(crate) now: u64,
    /// The message's `reply-by`, or 0.
    pub(crate) due: u64,
    pub(crate) opened: bool,
    pub(crate) late: bool,
    pub(crate) void: bool,
    pub(crate) state: Option<u16>,
}

impl Change<'_> {
    pub(crate) fn make(&mut self, conversation: &mut Conversation, made: Move) {
        let fresh = |peer| Party::new(peer, self.machine.initial);
        let index = match made.who {
            Who::Party(index) => index,
            Who::Receiver(number) => {
                let receiver = self.heard.receivers.get(number);
                let peer = self.names.acquire(receiver.map_or("", |name| name));
                conversation.parties.push(fresh(peer));
                conversation.parties.len() - 1
            }
            Who::Sender => {
                let peer = self.names.acquire(self.heard.sender);
                let told = conversation.unnamed.as_deref().cloned();
                let party = told.unwrap_or_else(|| fresh(peer));
                conversation.parties.push(Party { peer, ..party });
                conversation.parties.len() - 1
            }
            Who::Unnamed => {
                self.opened |= conversation.unnamed.is_none();
                let mut party = match conversation.unnamed.take() {
                    Some(party) => party,
                    None => Box::new(fresh(NONE)),
                };
                self.move_party(&mut party, made);
                conversation.unnamed = Some(party);
                return;
            }
        };
        self.opened |= matches!(made.who, Who::Receiver(_) | Who::Sender);
        if let Some(party) = conversation.parties.get_mut(index) {
            self.opened |= party.acts == [0; 2];
            self.move_party(party, made);
            if party.deadline != 0 {
                self.deadlines.push(Deadline {
                    due: party.deadline,
                    party: u32::try_from(index).unwrap_or(NONE),
                    ..self.place
                });
            }
        }
    }

    fn move_party(&mut self, party: &mut Party, made: Move) {
        let Move { side, lead, .. } = made;
        let answers = party.last != side && !made.told;
        self.late |= party.deadline != 0 && party.deadline < self.now && answers;
        let cancels = lead.state == CANCELLING && party.state != CANCELLING;
        if lead.void {
            (party.state, party.resume, party.echo) = (lead.state, lead.resume, lead.echo);
            self.state = self.state.or(Some(party.state));
            (self.late, self.void) = (true, true);
            return;
        }
        if made.told || lead.state == FAILED {
            // What failed may be said again, from the state before it.
            (party.state, party.resume, party.echo) = (lead.state, lead.resume, lead.echo);
            self.state = self.state.or(Some(party.state));
            return;
        }
        party.before = match party.state {
            FAILED => party.before,
            state => state,
        };
        if cancels {
            party.canceller = side;
            party.cancel = self.heard.reply_with;
        } else {
            let index = side_index(side);
            party.acts[index] = act_number(self.heard.act);
            party.asked_before[index] = party.asked[index];
            party.asked[index] = self.heard.reply_with;
        }
        (party.state, party.resume, party.echo) = (lead.state, lead.resume, lead.echo);
        if !lead.crossed {
            party.last = side;
        }
        let timeout = self
            .machine
            .state(party.state)
            .and_then(|state| state.timeout);
        party.deadline = match timeout.map(|timeout| timeout.after) {
            Some(After::Span(span)) => self.now.saturating_add(span_millis(span)),
            _ => self.due,
        };
        self.state = self.state.or(Some(party.state));
    }

    /// Gives roles that nobody has to those who speak and are spoken to in them.
    pub(crate) fn bind(&mut self, conversation: &mut Conversation, (from, to): (u32, u32)) {
        let free = unbound(self.machine, conversation);
        let mut give = |role: u32, agent: &str| {
            if role & free != 0 && role.count_ones() == 1 {
                let agent = self.names.acquire(agent);
                let role = u8::try_from(role.trailing_zeros()).unwrap_or(0);
                conversation.bound.push(Bound { role, agent });
            }
        };
        give(from, self.heard.sender);
        for receiver in self.heard.receivers {
            give(to, receiver);
        }
    }

    /// Whether the message can say who gets the replies: the initiator's can, and that of who goes
    /// on instead.
    pub(crate) fn names_designated(&self, conversation: &Conversation, moves: &[Move]) -> bool {
        let sender = self.heard.sender;
        self.names.is(conversation.initiator, sender)
            || conversation.is_designated(self.names, sender)
                && moves.iter().any(|made| made.side == Side::Initiator)
    }

    pub(crate) fn designate(&mut self, conversation: &mut Conversation, header: &Header<'_>) {
        for name in header.reply_to_names() {
            let known = conversation.reply_to.iter();
            let known = known.chain([&conversation.initiator]);
            if !known.into_iter().any(|agent| self.names.is(*agent, name))
                && conversation.reply_to.len() < MAX_DESIGNATED
            {
                let name = self.names.acquire(name);
                conversation.reply_to.push(name);
            }
        }
    }
}

/// Most agents that get replies instead of the initiator.
const MAX_DESIGNATED: usize = 64;

/// Milliseconds since 1970, at least 1.
pub(crate) fn millis(time: SystemTime) -> u64 {
    let since = time.duration_since(UNIX_EPOCH).unwrap_or_default();
    span_millis(since).max(1)
}

pub(crate) fn span_millis(span: Duration) -> u64 {
    u64::try_from(span.as_millis()).unwrap_or(u64::MAX)
}
