//! The check of a message: the conversation to which it belongs, the verdict, and the changes that it makes.

mod alternatives;
pub(crate) mod apply;
mod bound;
mod copies;
mod delegated;
mod embedded;
mod find;
pub(crate) mod judge;
mod next_state;
mod observed;
mod open;
pub(crate) mod outcome;
pub(crate) mod report;
mod roles;
mod undelivered;

use std::borrow::Cow;
use std::hash::BuildHasher;
use std::sync::Arc;

use smallvec::SmallVec;

use crate::check::apply::{Change, expire};
use crate::check::bound::Additions;
use crate::check::copies::take_copy;
use crate::check::find::MAX_LOOKED_AT;
use crate::check::judge::judge;
use crate::check::observed::ObservedMessage;
use crate::check::open::Opening;
use crate::check::outcome::{Denied, Fault, Passed};
use crate::check::report::violation;
use crate::conversation::deadlines::Deadline;
use crate::conversation::ids::{PartyIndex, SlotIndex};
use crate::conversation::state::{is_final, is_over, state_name};
use crate::conversation::table::List;
use crate::limits::{MAX_DESIGNATED, MAX_TEXT};
use crate::monitor::Monitor;
use crate::protocol::act::NOT_UNDERSTOOD;
use crate::protocol::machine::{Machine, Scope};
use crate::verdict::{Accepted, Unchecked, Verdict, ViolationKind as Kind};
use crate::{Header, Moment};

impl Monitor {
    #[cold]
    pub(crate) fn denied(&mut self, header: &Header<'_>, denied: Denied) -> Verdict<'_> {
        match denied {
            Denied::Unchecked(why) => Verdict::Unchecked(why),
            // A service that reports a failure follows no protocol.
            Denied::Fault(..) | Denied::NotOpened(_) if header.undelivered_name().is_some() => {
                Verdict::Unchecked(Unchecked::UnknownHistory)
            }
            denied => {
                let key = |from, to: &str| self.key_of_refused(header, from, to);
                let sender = header.sender_name().unwrap_or_default();
                if header.act() == NOT_UNDERSTOOD {
                    let receivers = header.receiver_names().iter().take(MAX_LOOKED_AT);
                    let answered: SmallVec<[u64; 2]> =
                        receivers.map(|receiver| key(receiver, sender)).collect();
                    if self.refused.take(&answered) {
                        return Verdict::Unchecked(Unchecked::AnswersViolation);
                    }
                } else {
                    let receivers = header.receiver_names().iter().take(MAX_LOOKED_AT);
                    let refused: SmallVec<[u64; 2]> =
                        receivers.map(|receiver| key(sender, receiver)).collect();
                    self.refused.add(&refused);
                }
                let violation = violation(&self.library, &self.table, &self.names, header, denied);
                Verdict::Violation(Box::new(violation))
            }
        }
    }

    fn key_of_refused(&self, header: &Header<'_>, from: &str, to: &str) -> u64 {
        self.hasher.hash_one((header.conversation(), from, to))
    }

    pub(crate) fn accepted(&self, passed: &Passed) -> Verdict<'_> {
        let Some(machine) = self.library.machine(passed.machine) else {
            return Verdict::Unchecked(Unchecked::UnknownProtocol);
        };
        let own = machine.state(passed.state);
        let (state, ended, over) = match own {
            Some(own) => (own.id(), own.is_final(), own.is_over()),
            None => (
                state_name(machine, passed.state),
                is_final(machine, passed.state),
                is_over(machine, passed.state),
            ),
        };
        Verdict::Accepted(Accepted {
            protocol: machine.name(),
            state,
            own: own.is_some(),
            opened: passed.opened,
            ended,
            over,
            complete: passed.complete,
            late: passed.late,
            void: passed.void,
            elsewhere: passed.elsewhere,
        })
    }

    /// Finds the conversation of a message, judges the message, and applies its changes if it is accepted.
    pub(crate) fn judge_and_apply(
        &mut self,
        header: &Header<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        let unchecked = |why| Err(Denied::Unchecked(why));
        let Some(id) = header.conversation() else {
            return Err(self.without_conversation(header));
        };
        let Some(sender) = header.sender_name() else {
            return unchecked(Unchecked::NoSender);
        };
        if header.receiver_names().is_empty() {
            return unchecked(Unchecked::NoReceiver);
        }
        if self.is_too_large(header, id, sender) {
            return Err(match self.agent {
                // Otherwise a large message would evade the checks.
                Some(_) => Denied::Refused(Kind::TooLarge, None),
                None => Denied::Unchecked(Unchecked::TooLarge),
            });
        }
        let own = self.agent.as_deref() == Some(sender);
        let other = header.other_receivers();
        let mut receivers = other.as_deref().unwrap_or(header.receiver_names());
        let mut own_receiver = None;
        let (member, members);
        if let Some(agent) = self.agent.as_ref().filter(|_| !own) {
            own_receiver = receivers.iter().position(|receiver| **receiver == **agent);
            if own_receiver.is_none() {
                member = Arc::clone(agent);
                members = [Cow::Borrowed(&*member)];
                (receivers, own_receiver) = (&members, Some(0));
            }
        }
        if receivers.is_empty() {
            return unchecked(Unchecked::NoReceiver);
        }
        let observed = ObservedMessage {
            act: header.act(),
            conversation_id: id,
            protocol: header.protocol_name(),
            sender,
            receivers,
            reply_with: self.fingerprints.of(header.reply_with_text()),
            reply_with_text: header.reply_with_text().unwrap_or_default(),
            in_reply_to: self.fingerprints.of(header.in_reply_to_text()),
            reply_to: header.reply_to_names(),
            reply_by: header.reply_by_time(now.wall),
            addressed: header.addressed(),
            peer: header.peer_name(),
            own,
            undelivered_to: header.undelivered_name(),
            own_receiver,
        };
        let Some((main, slot)) = self.place(id, &observed) else {
            if observed.undelivered_to.is_some() {
                return unchecked(Unchecked::UnknownHistory);
            }
            let Some(protocol) = header.protocol_name() else {
                return unchecked(Unchecked::NoProtocol);
            };
            let Some(machine) = self.library.index_of(protocol) else {
                return Err(self.unknown_protocol(protocol));
            };
            return self.open(Opening::alone(id, machine), &observed, now);
        };
        let machine = self.library.machine(slot.conversation.machine);
        let follows = |name| {
            machine.is_some_and(|machine: &Machine| machine.is_called(name))
                || self.is_cancel_of(main, name, observed.sender, observed.act)
        };
        if header.protocol_name().is_none_or(follows) {
            if slot.conversation.is_local()
                && let Some(projection) = machine.and_then(|machine| machine.projection.clone())
            {
                let passed = self.advance_local(main, &projection, &observed, now);
                return passed.map_err(|denied| self.recheck_local(id, main, denied));
            }
            let passed = self.advance(main, &observed, now);
            return passed.map_err(|denied| self.recheck(main, &observed, denied, now));
        }
        let library = Arc::clone(&self.library);
        self.embedded(&library, main, &observed, now)
    }

    fn is_too_large(&self, header: &Header<'_>, id: &str, sender: &str) -> bool {
        let too_long = |text: &str| text.len() > MAX_TEXT;
        let (receivers, reply_to) = (header.receiver_names(), header.reply_to_names());
        let too_long_one = |names: &[Cow<'_, str>]| names.iter().any(|name| too_long(name));
        too_long(id)
            || too_long(sender)
            || header.peer_name().is_some_and(too_long)
            || header.undelivered_name().is_some_and(too_long)
            || header.receiver_count() > self.limits.participants
            || header.addressed().len() > self.limits.participants
            || reply_to.len() > MAX_DESIGNATED
            || too_long_one(receivers)
            || too_long_one(reply_to)
            || header.groups().any(too_long_one)
    }

    fn without_conversation(&self, header: &Header<'_>) -> Denied {
        let named = header.protocol_name();
        let machine = named.and_then(|name| self.library.find(name));
        if machine.is_some_and(|known| !self.policy.exempts(known.name()))
            && self.policy.conversation_id
        {
            return Denied::Refused(Kind::NoConversation, None);
        }
        Denied::Unchecked(Unchecked::NoConversation)
    }

    fn unknown_protocol(&self, name: &str) -> Denied {
        if self.policy.spelling && !self.policy.exempts(name) {
            let is_checked = |machine: &Machine| !self.policy.exempts(machine.name());
            if let Some(similar) = self.library.index_near(name, is_checked) {
                return Denied::Refused(Kind::Misspelled, Some(similar));
            }
        }
        Denied::Unchecked(Unchecked::UnknownProtocol)
    }

    /// Checks a message in an existing conversation and updates the conversation.
    pub(crate) fn advance(
        &mut self,
        at: SlotIndex,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        let fault = |kind| Denied::Fault(Fault::plain(kind), at);
        let copy = self.copied(observed);
        let Some(slot) = self.table.slot_mut(at) else {
            return Err(fault(Kind::NotOpened));
        };
        let index = slot.conversation.machine;
        let Some(machine) = self.library.machine(index) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        expire(machine, &mut slot.conversation, now.millis());
        let copy = copy.filter(|_| machine.scope == Scope::Conversation);
        if let Some(copy) = copy
            && let Some(further) = take_copy(
                &mut slot.conversation,
                &mut self.names,
                observed,
                copy,
                &self.limits,
            )
        {
            further.map_err(fault)?;
            let passed = Passed::in_state_of(&slot.conversation, machine, index);
            self.charge(at);
            return Ok(passed);
        }
        let (conversation, moves) = (&slot.conversation, &mut self.moves);
        judge(machine, conversation, &self.names, observed, moves)
            .map_err(|fault| Denied::Fault(fault, at))?;
        let additions = Additions {
            machine,
            conversation,
            names: &self.names,
            observed,
            moves,
            is_copied: copy.is_some(),
        };
        if !additions.fit(&self.limits) {
            return Err(fault(Kind::TooMany));
        }
        let deadline = Deadline {
            due: 0,
            at,
            generation: slot.generation,
            party: PartyIndex::new(0),
        };
        let change = Change {
            machine,
            names: &mut self.names,
            deadlines: &mut self.deadlines,
            observed,
            deadline,
            now: now.millis(),
            due: observed.reply_by.map_or(0, |due| now.millis_at(due)),
            opened: false,
            late: false,
            void: false,
            state: None,
        };
        let passed = change.apply(&mut slot.conversation, &self.moves, copy);
        let is_charged = slot.is_charged();
        // An embedded conversation is in no list, and one that is not complete is not over.
        let is_listed =
            slot.parent.is_some() || !passed.complete && slot.touch(List::Open, now.millis());
        self.settle(at, is_listed, is_charged, now.millis());
        Ok(passed)
    }

    /// Updates the place of a conversation in the lists, if it is not `is_listed` there yet, and the bytes with
    /// which its peer is charged.
    #[inline]
    fn settle(&mut self, at: SlotIndex, is_listed: bool, is_charged: bool, now: u64) {
        if !is_listed {
            self.touch(at, now);
        }
        if !is_charged {
            self.charge(at);
        }
        if self.deadlines.are_many() {
            self.remove_stale_deadlines();
        }
    }
}
