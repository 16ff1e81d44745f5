//! Messages that were accepted, and were not delivered.

use std::sync::Arc;

use smallvec::SmallVec;

use crate::check::alternatives::any_state_of;
use crate::check::observed::SentMessage;
use crate::check::roles::take_back_local;
use crate::conversation::Conversation;
use crate::conversation::ids::SlotIndex;
use crate::conversation::names::Names;
use crate::conversation::party::Side;
use crate::limits::MAX_ALIKE;
use crate::monitor::Monitor;
use crate::protocol::act::ActNumber;
use crate::protocol::machine::{Machine, Scope};
use crate::{Header, Moment};

impl Monitor {
    /// Reports that a message, which was accepted, was not delivered to a receiver, or that this is
    /// uncertain. If it is the last message of its conversation, it may be sent again.
    pub fn undelivered(&mut self, header: &Header<'_>, receiver: &str, now: impl Into<Moment>) {
        let now = now.into();
        self.last = now;
        let (Some(id), Some(sender)) = (header.conversation(), header.sender_name()) else {
            return;
        };
        let sent = SentMessage {
            sender,
            receiver,
            act: ActNumber::of(header.act()),
            reply_with: self.fingerprints.of(header.reply_with_text()),
        };
        let library = Arc::clone(&self.library);
        let mains = self.table.find_all(id);
        let mains = mains.map(|(main, slot)| (main, slot.child));
        let mains: SmallVec<[(SlotIndex, Option<SlotIndex>); MAX_ALIKE]> = mains.collect();
        for (main, child) in mains {
            let (mut at, mut next) = (main, child);
            loop {
                let machine = self.machine_of(&library, at);
                let named = header.protocol_name();
                let called = |machine: &&Machine| named.is_none_or(|name| machine.is_called(name));
                let agent = self.agent.as_deref();
                if let Some(machine) = machine.filter(called)
                    && let Some(slot) = self.table.slot_mut(at)
                    && match slot.conversation.is_local() && agent == Some(sender) {
                        true => {
                            take_back_local(machine, &mut slot.conversation, &mut self.names, &sent)
                        }
                        false => take_back(machine, &mut slot.conversation, &self.names, &sent),
                    }
                {
                    self.touch(main, now.millis());
                    self.charge(at);
                    return;
                }
                let Some(child) = next else {
                    break;
                };
                (at, next) = (child, self.table.sibling(child));
            }
        }
    }
}

/// Takes a message back, if it is the last one between its sender and its receiver.
fn take_back(
    machine: &Machine,
    conversation: &mut Conversation,
    names: &Names,
    sent: &SentMessage<'_>,
) -> bool {
    let SentMessage {
        sender,
        receiver,
        act,
        reply_with,
    } = *sent;
    let leads = names.is(conversation.initiator, sender)
        || conversation.is_designated(names, sender) && conversation.party(names, sender).is_none();
    let (at, side) = match machine.scope {
        Scope::Participant if leads => {
            // The members of a pattern have one state until they answer.
            match conversation.party(names, receiver) {
                Some((at, _)) => (at, Side::Initiator),
                None => return false,
            }
        }
        Scope::Participant => match conversation.party(names, sender) {
            Some((at, _)) => (at, Side::Other),
            None => return false,
        },
        Scope::Conversation if conversation.speaks_for_initiator(names, sender) => {
            (0, Side::Initiator)
        }
        Scope::Conversation => (0, Side::Other),
    };
    let party = conversation.parties.get_mut(at);
    let taken = party.is_some_and(|party| party.take_back(side, act, reply_with));
    let rare = conversation.rare.as_deref_mut();
    if let Some(rare) = rare.filter(|rare| taken && rare.may_continue)
        && !rare.alternatives.contains(&any_state_of(at))
    {
        rare.alternatives.push(any_state_of(at));
    }
    taken
}
