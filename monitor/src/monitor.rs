//! The monitor of conversations.

use std::borrow::Cow;
use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use smallvec::SmallVec;

use crate::check::apply::{Change, expire, expire_party};
use crate::check::judge::{Fault, Move, MoveTarget, ObservedMessage, judge, unbound};
use crate::check::report::violation;
use crate::check::roles::take_back_local;
use crate::clock::span_millis;
use crate::conversation::deadlines::{Deadline, Deadlines};
use crate::conversation::fingerprints::Fingerprints;
use crate::conversation::memory::{Refused, Removed};
use crate::conversation::names::{Name, Names};
use crate::conversation::table::{List, Slot, Table};
use crate::conversation::{
    CANCELLED, CANCELLING, Conversation, Copied, FAILED, Holders, NONE, NextState, Party,
    RoleBinding, Side, act_number, is_final, is_over, state_name,
};
use crate::limits::{MAX_ALIKE, MAX_DESIGNATED, MAX_TEXT};
use crate::protocol::act::{Act, CANCEL, FAILURE, INFORM, NOT_UNDERSTOOD};
use crate::protocol::machine::{Machine, Scope, step};
use crate::verdict::{Accepted, Unchecked, Verdict, ViolationKind as Kind};
use crate::{Header, History, Library, Moment, MonitorLimits, MonitorPolicy};

/// Checks messages against the protocols of their conversations.
///
/// [`check`](Self::check) takes the messages in the order in which they were sent or received, and
/// returns a verdict. A message that violates its protocol changes nothing. The monitor has no clock:
/// the caller passes the current time. [`handle_timeout`](Self::handle_timeout) reports overdue
/// messages, and removes conversations that are over or abandoned.
///
/// Several conversations may have one identifier: a message belongs to the one in which its sender and
/// its receivers take part.
#[derive(Debug)]
pub struct Monitor {
    pub(crate) library: Arc<Library>,
    pub(crate) limits: MonitorLimits,
    policy: MonitorPolicy,
    history: History,
    /// The monitored agent; none for an observer.
    pub(crate) agent: Option<Arc<str>>,
    pub(crate) names: Names,
    pub(crate) table: Table,
    pub(crate) removed: Removed,
    refused: Refused,
    pub(crate) deadlines: Deadlines,
    hasher: RandomState,
    pub(crate) fingerprints: Fingerprints,
    /// Whether all messages belong to one conversation.
    single: bool,
    /// Buffer that is reused.
    moves: Vec<Move>,
    forgotten: u64,
    pub(crate) last: Moment,
}

/// An event that has no message.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Event {
    /// No message came by the `reply-by` of the last one, or within the timeout of the state.
    Overdue {
        /// Name of the protocol.
        protocol: String,
        /// Conversation identifier.
        conversation_id: String,
        /// Participant, if each has a state of its own.
        participant: Option<String>,
        /// State in which no message came.
        state: String,
        /// State after the timeout, if the protocol defines one.
        next: Option<String>,
    },
    /// The monitor has removed a conversation that was not over, because it had no message for
    /// [`MonitorLimits::idle`].
    Abandoned {
        /// Name of the protocol.
        protocol: String,
        /// Conversation identifier.
        conversation_id: String,
    },
}

/// The reason that a message was not accepted.
pub(crate) enum Denied {
    Fault(Fault, u32),
    NotOpened(u16),
    /// Refused without a conversation; with a similar protocol, if there is one.
    Refused(Kind, Option<u16>),
    Unchecked(Unchecked),
}

/// The result of an accepted message.
pub(crate) struct Passed {
    pub(crate) machine: u16,
    pub(crate) state: u16,
    pub(crate) opened: bool,
    pub(crate) complete: bool,
    pub(crate) late: bool,
    pub(crate) void: bool,
    pub(crate) elsewhere: bool,
}

impl Monitor {
    /// Creates a monitor of the conversations of all agents.
    #[must_use]
    pub fn observer(library: Arc<Library>) -> Self {
        Self::with(library, None)
    }

    /// Creates a monitor of the conversations of one agent.
    ///
    /// The caller passes all messages that the agent sends and receives, in their order, and no other
    /// ones. So a message of the agent cannot have crossed a message that was passed before it, and the
    /// monitor is stricter than an observer. A message of another agent that does not name the agent
    /// was sent to a group of which it is a member.
    #[must_use]
    pub fn agent(library: Arc<Library>, name: &str) -> Self {
        Self::with(library, Some(name.into()))
    }

    fn with(library: Arc<Library>, agent: Option<Arc<str>>) -> Self {
        let hasher = RandomState::new();
        Self {
            library,
            limits: MonitorLimits::default(),
            policy: MonitorPolicy::default(),
            history: History::Complete,
            agent,
            names: Names::new(hasher.clone()),
            table: Table::new(&hasher),
            removed: Removed::default(),
            refused: Refused::default(),
            deadlines: Deadlines::default(),
            hasher,
            fingerprints: Fingerprints::random(),
            single: false,
            moves: Vec::new(),
            forgotten: 0,
            last: Moment::from(UNIX_EPOCH),
        }
    }

    /// Sets the limits.
    #[must_use]
    pub fn with_limits(mut self, limits: MonitorLimits) -> Self {
        self.limits = limits;
        self
    }

    /// Sets the messages that are refused without a conversation. By default, there are none.
    #[must_use]
    pub fn with_policy(mut self, policy: MonitorPolicy) -> Self {
        self.policy = policy;
        self
    }

    /// Sets the extent of the knowledge of the monitor. By default, it is complete.
    #[must_use]
    pub fn with_history(mut self, history: History) -> Self {
        self.history = history;
        self
    }

    /// Makes all messages with one identifier belong to one conversation. By default, an agent that does
    /// not lead a conversation can begin another one with the same identifier. A caller that knows that
    /// a message continues its conversation forbids this: the message is then a violation, unless its
    /// protocol may run within the conversation now.
    #[must_use]
    pub fn with_one_conversation(mut self) -> Self {
        self.single = true;
        self
    }

    /// Changes the extent of the knowledge of the monitor: see [`with_history`](Self::with_history).
    pub fn set_history(&mut self, history: History) {
        self.history = history;
    }

    /// Records that a conversation with this identifier may have begun without the monitor: before it,
    /// or between other agents of which one names the monitored agent in a `reply-to`. A message that
    /// continues it is then [unchecked](Unchecked::UnknownHistory) instead of a violation.
    pub fn expect(&mut self, id: &str) {
        self.remember_removed(id);
    }

    /// Protocols of the monitor.
    #[must_use]
    pub fn library(&self) -> &Library {
        &self.library
    }

    /// Number of conversations, including embedded ones.
    #[must_use]
    pub fn len(&self) -> usize {
        self.table.len()
    }

    /// Whether the monitor has no conversation.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Number of conversations that were evicted before their end because of
    /// [`MonitorLimits::conversations`] or [`MonitorLimits::bytes`].
    #[must_use]
    pub fn forgotten(&self) -> u64 {
        self.forgotten
    }

    /// Bytes of all conversations: see [`MonitorLimits::bytes`].
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.table.bytes()
    }

    /// Checks a message. If it fits its conversation, updates the conversation.
    pub fn check(&mut self, header: &Header<'_>, now: impl Into<Moment>) -> Verdict<'_> {
        let now = now.into();
        self.last = now;
        match self.take(header, now) {
            Ok(passed) => self.accepted(&passed),
            Err(denied) => self.denied(header, denied),
        }
    }

    #[cold]
    fn denied(&mut self, header: &Header<'_>, denied: Denied) -> Verdict<'_> {
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

    /// Reports that a message, which was accepted, was not delivered to a receiver, or that this is
    /// uncertain. If it is the last message of its conversation, it may be sent again.
    pub fn undelivered(&mut self, header: &Header<'_>, receiver: &str, now: impl Into<Moment>) {
        let now = now.into();
        self.last = now;
        let (Some(id), Some(sender)) = (header.conversation(), header.sender_name()) else {
            return;
        };
        let act = header.act();
        let reply_with = self.fingerprints.of(header.reply_with_text());
        let library = Arc::clone(&self.library);
        let mains = self.table.find_all(id);
        let mains = mains.map(|(main, slot)| (main, slot.child));
        let mains: SmallVec<[(u32, u32); MAX_ALIKE]> = mains.collect();
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
                        true => take_back_local(
                            machine,
                            &mut slot.conversation,
                            &mut self.names,
                            (act_number(act), reply_with),
                        ),
                        false => take_back(
                            machine,
                            &mut slot.conversation,
                            &self.names,
                            (sender, receiver),
                            (act_number(act), reply_with),
                        ),
                    }
                {
                    self.touch(main, now.millis());
                    self.charge(at);
                    return;
                }
                if self.table.slot(next).is_none() {
                    break;
                }
                (at, next) = (next, self.table.sibling(next));
            }
        }
    }

    /// Whether a conversation with this identifier that the monitor does not have did not begin.
    pub(crate) fn is_certain(&self, id: &str) -> bool {
        self.history == History::Complete && !self.removed.contains(self.hasher.hash_one(id))
    }

    /// Records that the monitor does not know the conversations with this identifier any more.
    pub(crate) fn remember_removed(&mut self, id: &str) {
        self.removed.add(self.hasher.hash_one(id));
    }

    fn accepted(&self, passed: &Passed) -> Verdict<'_> {
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

    fn take(&mut self, header: &Header<'_>, now: Moment) -> Result<Passed, Denied> {
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
            sender,
            receivers,
            reply_with: self.fingerprints.of(header.reply_with_text()),
            reply_with_text: header.reply_with_text().unwrap_or_default(),
            in_reply_to: self.fingerprints.of(header.in_reply_to_text()),
            own,
            undelivered_to: header.undelivered_name(),
            own_receiver,
        };
        let Some((main, slot)) = self.place(id, header, &observed) else {
            if observed.undelivered_to.is_some() {
                return unchecked(Unchecked::UnknownHistory);
            }
            let Some(protocol) = header.protocol_name() else {
                return unchecked(Unchecked::NoProtocol);
            };
            let Some(machine) = self.library.index_of(protocol) else {
                return Err(self.unknown_protocol(protocol));
            };
            return self.open(id, NONE, machine, header, &observed, now);
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
            let passed = self.advance(main, header, &observed, now);
            return passed.map_err(|denied| self.recheck(main, &observed, denied, now));
        }
        let library = Arc::clone(&self.library);
        self.embedded(&library, main, header, &observed, now)
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

    /// Finds the conversation of a message among those with its identifier: the one in which sender and
    /// receiver take part. Otherwise, an agent that does not lead one of them can begin another.
    fn place(
        &self,
        id: &str,
        header: &Header<'_>,
        observed: &ObservedMessage<'_>,
    ) -> Option<(u32, &Slot)> {
        // One search: hashing the identifier is a large part of a check.
        let mut found = self.table.find_all(id);
        let first = found.next()?;
        let fits_role = |slot: &Slot| self.fits_role(&slot.conversation, header, observed);
        // A service stands for the agent that did not get a message.
        let sender = observed.undelivered_to.unwrap_or(observed.sender);
        let Some(second) = found.next() else {
            // Nearly all identifiers have one conversation.
            let (_, slot) = first;
            if fits_role(slot) || self.rank(slot, sender, observed) == 2 {
                return Some(first);
            }
            return self.place_among(id, &[first], header, observed);
        };
        let alike = [first, second].into_iter().chain(found);
        let alike: SmallVec<[(u32, &Slot); MAX_ALIKE]> = alike.collect();
        let local = alike.iter().find(|(_, slot)| fits_role(slot)).copied();
        local.or_else(|| self.place_among(id, &alike, header, observed))
    }

    /// Finds the conversation of a message among those with its identifier, when the roles of the agents do not
    /// select one.
    #[inline(never)]
    fn place_among<'s>(
        &self,
        id: &str,
        alike: &[(u32, &'s Slot)],
        header: &Header<'_>,
        observed: &ObservedMessage<'_>,
    ) -> Option<(u32, &'s Slot)> {
        let sender = observed.undelivered_to.unwrap_or(observed.sender);
        // Of several, the last that began.
        let (at, slot) = *alike.iter().max_by_key(|(at, slot)| {
            let rank = self.rank(slot, sender, observed);
            // Other agents may take part in a conversation that began elsewhere.
            let joined = rank == 0 && slot.conversation.joined;
            let has_protocol = self.has_protocol(*at, header, observed);
            (rank, joined, has_protocol, self.table.serial(*at), *at)
        })?;
        if self.single || self.rank(slot, sender, observed) == 2 {
            return Some((at, slot));
        }
        if observed.undelivered_to.is_some() {
            return None;
        }
        let begins = |machine: &Machine| {
            step(&machine.initial().steps, observed.act, u32::MAX, u32::MAX).is_some()
                || self.begins_for_role(machine, observed)
        };
        let named = header.protocol_name();
        let machine = named.and_then(|name| self.library.find(name));
        let stays = match machine {
            Some(machine) if begins(machine) => !self.begins_another(at, machine, observed),
            // The monitor may have removed the conversation of the message.
            _ => self.is_certain(id),
        };
        stays.then_some((at, slot))
    }

    /// 2 if the sender and a receiver take part in the conversation or in one within it, 1 if the
    /// sender does.
    #[inline]
    fn rank(&self, slot: &Slot, sender: &str, observed: &ObservedMessage<'_>) -> u8 {
        match self.links(&slot.conversation, sender, observed) {
            true => 2,
            false => self.rank_without_link(slot, sender, observed),
        }
    }

    fn rank_without_link(&self, slot: &Slot, sender: &str, observed: &ObservedMessage<'_>) -> u8 {
        let children = std::iter::successors(Some(slot.child), |at| Some(self.table.sibling(*at)));
        let children = children.map_while(|at| self.table.slot(at));
        let inner = || children.clone().map(|slot| &slot.conversation);
        let all = || inner().chain([&slot.conversation]);
        let sends = |conversation: &Conversation| self.sends_in(conversation, sender);
        let receives = |conversation: &Conversation| self.receives_in(conversation, observed);
        let embeds = slot.child != NONE;
        if embeds
            && (inner().any(|conversation| self.links(conversation, sender, observed))
                || all().any(sends) && all().any(receives))
        {
            return 2;
        }
        u8::from(all().any(sends))
    }

    /// Whether a message of this sender fits the agents of the conversation.
    #[inline]
    fn links(
        &self,
        conversation: &Conversation,
        sender: &str,
        observed: &ObservedMessage<'_>,
    ) -> bool {
        let machine = self.library.machine(conversation.machine);
        if machine.is_none_or(|machine| machine.scope == Scope::Conversation) {
            return self.sends_in(conversation, sender) && self.receives_in(conversation, observed);
        }
        // With a state for each participant, these exchange messages with the initiator only.
        let names = &self.names;
        let leads = |agent: &str| {
            names.is(conversation.initiator, agent) || conversation.is_designated(names, agent)
        };
        let answers = |agent: &str| {
            conversation.unnamed().is_some() || conversation.party(names, agent).is_some()
        };
        let receivers = || observed.receivers.iter().take(MAX_LOOKED_AT);
        leads(sender) && receivers().any(|receiver| answers(receiver))
            || answers(sender) && receivers().any(|receiver| leads(receiver))
    }

    fn sends_in(&self, conversation: &Conversation, sender: &str) -> bool {
        conversation.unnamed().is_some() || self.has(conversation, sender)
    }

    fn receives_in(&self, conversation: &Conversation, observed: &ObservedMessage<'_>) -> bool {
        let mut receivers = observed.receivers.iter().take(MAX_LOOKED_AT);
        receivers.any(|receiver| self.has(conversation, receiver))
    }

    /// Whether the agent takes part in the conversation, or may.
    fn has(&self, conversation: &Conversation, agent: &str) -> bool {
        conversation.is_local() && self.agent.as_deref() == Some(agent)
            || conversation.takes_part(&self.names, agent)
            || conversation.is_designated(&self.names, agent)
    }

    /// Whether the protocol of a message is that of the conversation or of one within it, or may begin
    /// within it.
    fn has_protocol(&self, at: u32, header: &Header<'_>, observed: &ObservedMessage<'_>) -> bool {
        let Some(name) = header.protocol_name() else {
            return true;
        };
        let mut part = at;
        while let Some(slot) = self.table.slot(part) {
            let machine = self.machine_of(&self.library, part);
            if machine.is_some_and(|machine| machine.is_called(name))
                || self.may_begin(&self.library, part, name, observed.sender)
            {
                return true;
            }
            part = if part == at {
                slot.child
            } else {
                self.table.sibling(part)
            };
        }
        false
    }

    /// Whether a message of this protocol, in a conversation of another one, cancels the conversation or
    /// answers the cancel: the cancel meta-protocol is part of every protocol. If it may run within the
    /// conversation as a subprotocol, it does.
    fn is_cancel_of(&self, main: u32, protocol: &str, sender: &str, act: Act<'_>) -> bool {
        let named = self.library.find(protocol);
        if ![CANCEL, INFORM, FAILURE, NOT_UNDERSTOOD].contains(&act)
            || named.is_none_or(|machine| !machine.is_called(CANCEL_PROTOCOL))
        {
            return false;
        }
        let mut part = main;
        while let Some(slot) = self.table.slot(part) {
            let inner = part != main;
            let machine = self.machine_of(&self.library, part);
            if inner && machine.is_some_and(|machine| machine.is_called(protocol))
                || self.may_begin(&self.library, part, protocol, sender)
            {
                return false;
            }
            part = if inner {
                self.table.sibling(part)
            } else {
                slot.child
            };
        }
        true
    }

    /// Whether the first message of a protocol begins another conversation than this one.
    fn begins_another(&self, at: u32, machine: &Machine, observed: &ObservedMessage<'_>) -> bool {
        let name = machine.name();
        let mut part = at;
        while let Some(slot) = self.table.slot(part) {
            let conversation = &slot.conversation;
            let initiates = part == at && self.names.is(conversation.initiator, observed.sender);
            let leads = !conversation.joined
                && (initiates || conversation.is_designated(&self.names, observed.sender));
            if leads || self.may_begin(&self.library, part, name, observed.sender) {
                return false;
            }
            part = if part == at {
                slot.child
            } else {
                self.table.sibling(part)
            };
        }
        true
    }

    /// Reconsiders the refusal of a message in a conversation of which the monitor may not know all.
    #[cold]
    fn recheck(
        &mut self,
        at: u32,
        observed: &ObservedMessage<'_>,
        denied: Denied,
        now: Moment,
    ) -> Denied {
        if observed.undelivered_to.is_some() {
            return denied;
        }
        let denied = self.recheck_delegated(at, observed, denied, now);
        self.recheck_beginning(at, denied)
    }

    /// If a conversation may have begun before the monitor, a violation is none: it shows that the
    /// first message continued the conversation.
    fn recheck_beginning(&mut self, at: u32, denied: Denied) -> Denied {
        let slot = self.table.slot(at);
        let rare = slot.and_then(|slot| slot.conversation.rare.as_deref());
        let uncertain = rare.is_some_and(|rare| !rare.alternatives.is_empty());
        match denied {
            Denied::Fault(..) if uncertain => {
                self.forget(at);
                Denied::Unchecked(Unchecked::UnknownHistory)
            }
            denied => denied,
        }
    }

    /// Checks a message with another protocol than its conversation has. It belongs to an embedded
    /// conversation.
    fn embedded(
        &mut self,
        library: &Library,
        main: u32,
        header: &Header<'_>,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        let name = header.protocol_name().unwrap_or_default();
        let (mut denied, mut open) = (None, None);
        let mut children = 0;
        let mut may_begin = self.may_begin(library, main, name, observed.sender);
        let mut child = self.table.slot(main).map_or(NONE, |slot| slot.child);
        while child != NONE {
            children += 1;
            may_begin |= self.may_begin(library, child, name, observed.sender);
            let called = self.machine_of(library, child);
            if called.is_some_and(|machine| machine.is_called(name)) {
                match self.advance(child, header, observed, now) {
                    Ok(passed) => {
                        self.touch(main, now.millis());
                        return Ok(passed);
                    }
                    Err(fault) if self.may_continue_elsewhere(child) => open = Some((child, fault)),
                    Err(fault) => denied = denied.or(Some(fault)),
                }
            }
            child = self.table.sibling(child);
        }
        if !may_begin {
            return Err(match (denied, open) {
                (Some(denied), _) => denied,
                (None, Some((child, fault))) => self.recheck_delegated(child, observed, fault, now),
                (None, None) if self.began_elsewhere(library, main, name, observed.sender) => {
                    let inner = library.index_of(name).filter(|_| !observed.own);
                    if let Some(inner) = inner.filter(|_| children < self.limits.embedded) {
                        let id = header.conversation().unwrap_or_default();
                        let _ = self.join(id, main, inner, (header, observed), now);
                    }
                    Denied::Unchecked(Unchecked::BegunElsewhere)
                }
                (None, None) if self.is_joined(main) => {
                    Denied::Unchecked(Unchecked::BegunElsewhere)
                }
                (None, None) => Denied::Fault(Fault::plain(Kind::WrongProtocol), main),
            });
        }
        let Some(machine) = library.index_of(name) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        if children >= self.limits.embedded {
            return Err(Denied::Fault(Fault::plain(Kind::TooMany), main));
        }
        let id = header.conversation().unwrap_or_default();
        match self.open(id, main, machine, header, observed, now) {
            Ok(passed) => {
                self.touch(main, now.millis());
                Ok(passed)
            }
            Err(not_opened) => Err(denied.unwrap_or(not_opened)),
        }
    }

    /// Whether the agent may begin a conversation of this protocol within another conversation.
    fn may_begin(&self, library: &Library, at: u32, protocol: &str, sender: &str) -> bool {
        self.is_begun(library, at, protocol, |roles| roles.of(sender))
    }

    /// Whether another agent than the monitored one may have begun a conversation of this protocol
    /// within its conversation, so that an unknown agent sends messages to it. Recruited agents do so.
    fn began_elsewhere(&self, library: &Library, at: u32, protocol: &str, sender: &str) -> bool {
        let Some(agent) = &self.agent else {
            return false;
        };
        let takes_part = |name: &str| {
            let slot = self.table.slot(at);
            slot.is_some_and(|slot| slot.conversation.takes_part(&self.names, name))
        };
        !takes_part(sender) && self.is_begun(library, at, protocol, |roles| !roles.of(agent))
    }

    /// Whether agents with the roles `by` may begin the protocol now.
    fn is_begun(
        &self,
        library: &Library,
        at: u32,
        protocol: &str,
        by: impl Fn(&Holders<'_>) -> u32,
    ) -> bool {
        let Some((slot, machine)) = self.table.slot(at).zip(self.machine_of(library, at)) else {
            return false;
        };
        let inner = library.find(protocol);
        slot.conversation.parties.iter().any(|party| {
            let roles = by(&Holders {
                conversation: &slot.conversation,
                machine,
                party,
                names: &self.names,
            });
            let state = machine.state(party.state);
            let mut embedded = state.into_iter().flat_map(|state| &state.embedded);
            embedded.any(|sub| {
                let named = match inner {
                    Some(inner) => sub.admits(inner),
                    None => sub.name.matches(protocol),
                };
                named && sub.from.mask & roles != 0
            })
        })
    }

    fn open(
        &mut self,
        id: &str,
        parent: u32,
        machine: u16,
        header: &Header<'_>,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        let library = Arc::clone(&self.library);
        let Some(protocol) = library.machine(machine) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        // Checked before eviction, so that an invalid message evicts no conversation.
        if parent == NONE
            && let Some(projection) = protocol.projection.clone().filter(|_| self.agent.is_some())
        {
            let machine = (machine, protocol);
            return self.open_local(id, machine, &projection, (header, observed), now);
        }
        let begins = step(&protocol.initial().steps, observed.act, u32::MAX, u32::MAX);
        let Some(begins) = begins else {
            return Err(match parent {
                NONE => self.unopened(id, machine, protocol, header, observed, now),
                _ => Denied::NotOpened(machine),
            });
        };
        let at = self.insert(id, parent, machine, (header, observed), now)?;
        let may_continue = parent == NONE && !self.is_certain(id);
        if let Some(slot) = self.table.slot_mut(at) {
            let conversation = &mut slot.conversation;
            conversation.initiator = conversation.acquire(&mut self.names, observed.sender);
            if protocol.scope == Scope::Conversation {
                let party = Party::new(NONE, protocol.initial);
                conversation.parties.push(party);
            }
            if may_continue && protocol.may_repeat(observed.act, begins) {
                conversation.rare().may_continue = true;
            }
        }
        let passed = self.advance(at, header, observed, now);
        passed.map_err(|denied| {
            self.remove(at);
            match denied {
                Denied::Fault(fault, _) if fault.kind == Kind::TooMany => {
                    Denied::Refused(Kind::TooMany, None)
                }
                Denied::Fault(..) => Denied::NotOpened(machine),
                other => other,
            }
        })
    }

    /// Inserts a conversation that a message begins, and evicts others for it.
    pub(crate) fn insert(
        &mut self,
        id: &str,
        parent: u32,
        machine: u16,
        (header, observed): (&Header<'_>, &ObservedMessage<'_>),
        now: Moment,
    ) -> Result<u32, Denied> {
        if parent == NONE {
            self.evict_alike(id)?;
        }
        let peer = match self.table.slot(parent) {
            Some(_) => self.names.acquire_again(self.table.peer(parent)),
            None if observed.own => NONE,
            None => {
                let peer = header.peer_name().unwrap_or(observed.sender);
                self.names.acquire(peer)
            }
        };
        let peer_cost = match peer {
            NONE => 0,
            peer => Names::cost(self.names.text(peer).len()),
        };
        // Its bytes are charged, and others evicted for them, when the message has been accepted.
        self.evict(parent, peer, 1);
        let at = self.table.insert(id, parent, peer, machine, now.millis());
        if let Some(slot) = self.table.slot_mut(at) {
            slot.conversation.charge(peer_cost);
        }
        Ok(at)
    }

    /// Returns the verdict on a message that begins no conversation, if the monitor has none for it.
    fn unopened(
        &mut self,
        id: &str,
        machine: u16,
        protocol: &Machine,
        header: &Header<'_>,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Denied {
        if !protocol.may_follow(observed.act) {
            return Denied::NotOpened(machine);
        }
        let certain = self.is_certain(id);
        if self.agent.is_none() || observed.own {
            if certain {
                return Denied::NotOpened(machine);
            }
            return Denied::Unchecked(Unchecked::UnknownHistory);
        }
        if certain && self.policy.unsolicited && !self.policy.exempts(protocol.name()) {
            return Denied::Refused(Kind::Unsolicited, None);
        }
        // The sender may have named the monitored agent in a `reply-to`, or the agent has restarted.
        if protocol.shows_initiator(observed.act) {
            if let Err(denied) = self.join(id, NONE, machine, (header, observed), now) {
                return denied;
            }
            return Denied::Unchecked(Unchecked::BegunElsewhere);
        }
        // The agent may answer.
        self.remember_removed(id);
        Denied::Unchecked(Unchecked::UnknownHistory)
    }

    /// Removes the least recently active conversation with this identifier, if there are too many of
    /// them. Those that the monitored agent began stay.
    fn evict_alike(&mut self, id: &str) -> Result<(), Denied> {
        let alike = self.table.find_all(id).map(|(at, _)| at);
        let alike: SmallVec<[u32; MAX_ALIKE]> = alike.collect();
        if alike.len() < MAX_ALIKE {
            return Ok(());
        }
        let slots = alike
            .iter()
            .filter_map(|at| Some((*at, self.table.slot(*at)?)));
        let of_peers = slots.filter(|(at, _)| self.table.peer(*at) != NONE || self.agent.is_none());
        let oldest = of_peers.min_by_key(|(at, slot)| (slot.touched, self.table.serial(*at)));
        match oldest.map(|(at, _)| at) {
            Some(at) => {
                self.forgotten += 1;
                self.forget(at);
                Ok(())
            }
            None => Err(Denied::Refused(Kind::TooMany, None)),
        }
    }

    /// Charges the peer of a conversation, and evicts others if it has grown beyond a limit.
    pub(crate) fn charge(&mut self, at: u32) {
        if self.table.charge(at)
            && let Some(slot) = self.table.slot(at)
        {
            let main = if slot.parent == NONE { at } else { slot.parent };
            self.evict(main, self.table.peer(at), 0);
        }
    }

    /// Removes conversations until the limits hold, with so many more of this peer. The conversation `keep`
    /// is kept.
    pub(crate) fn evict(&mut self, keep: u32, peer: Name, more: usize) {
        loop {
            let full = self.table.len() + more > self.limits.conversations.max(1);
            let heavy = self.table.bytes() > self.limits.bytes;
            let (count, held) = self.table.of_peer(peer);
            let over = peer != NONE
                && (held > self.limits.share_of_bytes()
                    || count + more > self.limits.share_of_conversations());
            if !full && !heavy && !over {
                return;
            }
            let own = |list| self.table.oldest_but(keep, Some(peer), list);
            let any = |list| self.table.oldest_but(keep, None, list);
            let own = || own(List::Ended).or_else(|| own(List::Open));
            let any = || any(List::Ended).or_else(|| any(List::Open));
            let oldest = match over {
                true => own().or_else(|| any().filter(|_| full || heavy)),
                false => any(),
            };
            let Some(at) = oldest else {
                return;
            };
            let slot = self.table.slot(at);
            if slot.is_some_and(|slot| slot.list() == List::Open) {
                self.forgotten += 1;
            }
            self.forget(at);
        }
    }

    /// Checks a message in an existing conversation and updates the conversation.
    fn advance(
        &mut self,
        at: u32,
        header: &Header<'_>,
        observed: &ObservedMessage<'_>,
        now: Moment,
    ) -> Result<Passed, Denied> {
        let now_ms = now.millis();
        let fault = |kind| Denied::Fault(Fault::plain(kind), at);
        let copied = self.copied(header, observed);
        let Some(slot) = self.table.slot_mut(at) else {
            return Err(fault(Kind::NotOpened));
        };
        let index = slot.conversation.machine;
        let Some(machine) = self.library.machine(index) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        expire(machine, &mut slot.conversation, now_ms);
        let copied = copied.filter(|_| machine.scope == Scope::Conversation);
        if let Some((fingerprint, receiver)) = copied {
            let names = &mut self.names;
            let copy = (fingerprint, receiver);
            match take_copy(&mut slot.conversation, names, observed, copy, &self.limits) {
                Some(Ok(())) => {
                    let passed = Passed::in_state_of(&slot.conversation, machine, index);
                    self.charge(at);
                    return Ok(passed);
                }
                Some(Err(kind)) => return Err(fault(kind)),
                None => {}
            }
        }
        let conversation = &slot.conversation;
        judge(
            machine,
            conversation,
            &self.names,
            observed,
            &mut self.moves,
        )
        .map_err(|fault| Denied::Fault(fault, at))?;
        let is_new = |made: &&Move| made.target.is_new();
        let added = self.moves.iter().filter(is_new).count();
        let grown = conversation.parties.len() + added;
        let moves = self.moves.as_slice();
        let bindings = NewBindings::by(machine, conversation, &self.names, observed, moves, header);
        let adds =
            added > 0 || !header.reply_to_names().is_empty() || observed.undelivered_to.is_some();
        let growth = if adds || machine.scope == Scope::Conversation {
            let moves = (moves, &bindings, copied.is_some());
            growth_by(machine, conversation, observed, moves, header)
        } else {
            0
        };
        let size = || Slot::COST + conversation.allocated() + growth;
        if grown > self.limits.participants
            || conversation.bound.len() + bindings.count() > self.limits.participants + 1
            || is_crowded(conversation, &self.names, header)
            || growth > 0 && size() > self.limits.share_of_bytes()
        {
            return Err(fault(Kind::TooMany));
        }
        let due = header.reply_by_time(now.wall);
        let due = due.map_or(0, |due| now.millis_at(due));
        let roles = self.moves.first().map(|made| made.next_state.roles);
        let mut change = Change {
            machine,
            names: &mut self.names,
            deadlines: &mut self.deadlines,
            observed,
            deadline: Deadline {
                due: 0,
                at,
                generation: slot.generation,
                party: 0,
            },
            now: now_ms,
            due,
            opened: false,
            late: false,
            void: false,
            state: None,
        };
        let before = PartiesBefore::of(&slot.conversation, machine);
        for made in &self.moves {
            if machine.scope == Scope::Conversation {
                change.bind(&mut slot.conversation, made.next_state.roles);
            }
            change.make(&mut slot.conversation, made);
        }
        if !header.reply_to_names().is_empty() {
            if change.names_designated(&slot.conversation, &self.moves) {
                change.designate(&mut slot.conversation, header);
            } else {
                change.delegate(&mut slot.conversation, &self.moves, header);
            }
        }
        let (opened, moved) = (change.opened, change.state);
        let (late, void) = (change.late, change.void);
        if let Some(((fingerprint, receiver), roles)) = copied.zip(roles) {
            keep_copied(&mut slot.conversation, fingerprint, receiver, roles);
        }
        if let Some(before) = before {
            let moves = (self.moves.as_slice(), before);
            keep_alternatives(machine, &mut slot.conversation, observed, moves);
        }
        let passed = Passed::in_state_of(&slot.conversation, machine, index);
        let passed = Passed {
            state: moved.unwrap_or(passed.state),
            opened,
            late,
            void,
            ..passed
        };
        let is_charged = slot.is_charged();
        // An embedded conversation is in no list, and one that is not complete is not over.
        let is_main = slot.parent == NONE;
        if is_main && (passed.complete || !slot.touch(List::Open, now_ms)) {
            self.touch(at, now_ms);
        }
        if !is_charged {
            self.charge(at);
        }
        if self.deadlines.are_many() {
            self.remove_stale_deadlines();
        }
        Ok(passed)
    }

    /// Returns fingerprints of a message and of its receiver, if this is the copy for one of several
    /// receivers.
    fn copied(&self, header: &Header<'_>, observed: &ObservedMessage<'_>) -> Option<(u64, u64)> {
        let addressed = header.addressed();
        let first = addressed.first()?;
        let receiver = observed.receivers.first()?;
        if addressed.len() == 1 && first == receiver {
            return None;
        }
        let message = (
            header.act().name(),
            observed.sender,
            addressed,
            observed.reply_with,
            observed.in_reply_to,
        );
        Some((
            self.hasher.hash_one(message),
            self.hasher.hash_one(&**receiver),
        ))
    }

    /// Updates the time and the list of a main conversation.
    pub(crate) fn touch(&mut self, at: u32, now: u64) {
        let library = &self.library;
        let over = |slot: &Slot| {
            let conversation = &slot.conversation;
            let machine = library.machine(conversation.machine);
            conversation.unnamed().is_none()
                && machine.is_some_and(|machine| {
                    let mut parties = conversation.parties.iter();
                    parties.all(|party| is_over(machine, party.state))
                })
        };
        let Some(slot) = self.table.slot(at) else {
            return;
        };
        let mut all_over = over(slot);
        let mut child = slot.child;
        while all_over && let Some(slot) = self.table.slot(child) {
            all_over = over(slot);
            child = self.table.sibling(child);
        }
        let list = if all_over { List::Ended } else { List::Open };
        self.table.touch(at, list, now);
    }

    /// Time at which the caller must call [`handle_timeout`](Self::handle_timeout) next, on the wall
    /// clock of the last call.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<SystemTime> {
        self.last.wall_at(self.poll_elapsed()?)
    }

    /// Time at which the caller must call [`handle_timeout`](Self::handle_timeout) next, on the
    /// monotonic clock: see [`Moment::elapsed`].
    #[must_use]
    pub fn poll_elapsed(&self) -> Option<Duration> {
        let kept = |list, span: Duration| {
            let slot = self.table.slot(self.table.oldest(list)?)?;
            Some(
                slot.touched
                    .saturating_add(span_millis(span))
                    .saturating_add(1),
            )
        };
        let ended = kept(List::Ended, self.limits.ended);
        let idle = kept(List::Open, self.limits.idle);
        let due = self.deadlines.next().map(|due| due.saturating_add(1));
        let next = [ended, idle, due].into_iter().flatten().min()?;
        Some(Duration::from_millis(next))
    }

    /// Handles timeouts: reports overdue messages, and removes conversations that are over or
    /// abandoned.
    pub fn handle_timeout(&mut self, now: impl Into<Moment>) -> Vec<Event> {
        self.last = now.into();
        let now = self.last.millis();
        let mut events = Vec::new();
        while let Some(deadline) = self.deadlines.pop_before(now) {
            events.extend(self.overdue(deadline));
        }
        let spans = [
            (List::Ended, span_millis(self.limits.ended)),
            (List::Open, span_millis(self.limits.idle)),
        ];
        for (list, span) in spans {
            while let Some(at) = self.table.oldest(list) {
                let slot = self.table.slot(at);
                let Some(slot) = slot.filter(|slot| slot.touched.saturating_add(span) < now) else {
                    break;
                };
                let machine = self.library.machine(slot.conversation.machine);
                let resting =
                    |party: &Party| machine.is_some_and(|machine| is_final(machine, party.state));
                let conversation = &slot.conversation;
                // The monitor does not know the state of a conversation that continues elsewhere.
                let known = list == List::Open && !self.may_continue_elsewhere(at);
                if known && !conversation.parties.iter().all(resting) {
                    events.push(Event::Abandoned {
                        protocol: machine.map_or("", Machine::name).to_owned(),
                        conversation_id: self.table.id(at).to_owned(),
                    });
                }
                // After an undelivered message, a conversation may continue.
                let undelivered = |party: &Party| party.state == FAILED;
                if list == List::Ended && !conversation.parties.iter().any(undelivered) {
                    self.remove_all(at);
                } else {
                    self.forget(at);
                }
            }
        }
        events
    }

    fn overdue(&mut self, deadline: Deadline) -> Option<Event> {
        // The answer may have been sent to another agent.
        let complete = !self.may_continue_elsewhere(deadline.at);
        let slot = self.table.slot_mut(deadline.at)?;
        if slot.generation != deadline.generation {
            return None;
        }
        let machine = self.library.machine(slot.conversation.machine)?;
        let party = slot.conversation.parties.get_mut(deadline.party as usize)?;
        // A later message has set another deadline or none.
        if party.deadline != deadline.due || is_over(machine, party.state) {
            return None;
        }
        let before = party.state;
        let (peer, scope) = (party.peer, machine.scope);
        expire_party(machine, party);
        let next = (party.state != before).then(|| state_name(machine, party.state).to_owned());
        let (touched, parent) = (slot.touched, slot.parent);
        let event = Event::Overdue {
            protocol: machine.name().to_owned(),
            conversation_id: self.table.id(deadline.at).to_owned(),
            participant: (scope == Scope::Participant).then(|| self.names.text(peer).to_owned()),
            state: state_name(machine, before).to_owned(),
            next,
        };
        let main = match parent {
            NONE => deadline.at,
            parent => parent,
        };
        self.touch(main, touched);
        complete.then_some(event)
    }

    /// Removes a main conversation with its embedded conversations before its time. Messages to it may
    /// still come.
    fn forget(&mut self, at: u32) {
        if self.table.slot(at).is_some() {
            let id = self.hasher.hash_one(self.table.id(at));
            self.removed.add(id);
        }
        self.remove_all(at);
    }

    /// Removes a main conversation with its embedded conversations, without remembering that the
    /// monitor had it. A further message to it is a violation.
    fn remove_all(&mut self, at: u32) {
        while let Some(slot) = self.table.slot(at) {
            let child = slot.child;
            if child == NONE {
                break;
            }
            self.remove(child);
        }
        self.remove(at);
    }

    fn remove(&mut self, at: u32) {
        if let Some(slot) = self.table.slot(at) {
            let conversation = &slot.conversation;
            self.names.release(conversation.initiator);
            let peers = conversation.parties.iter().map(|party| party.peer);
            let bound = conversation.bound.iter().map(|bound| bound.agent);
            let delegates = conversation.delegates().iter().map(|(_, agent)| *agent);
            let rare = conversation.rare.as_deref().into_iter();
            let asked = rare.flat_map(|rare| rare.asked.iter().map(|asked| asked.agent));
            let named = peers
                .chain(bound)
                .chain(conversation.reply_to().iter().copied())
                .chain(delegates)
                .chain(asked)
                .chain([self.table.peer(at)]);
            for name in named.filter(|name| *name != NONE) {
                self.names.release(name);
            }
        }
        self.table.remove(at);
    }

    fn machine_of<'l>(&self, library: &'l Library, at: u32) -> Option<&'l Machine> {
        library.machine(self.table.slot(at)?.conversation.machine)
    }

    fn remove_stale_deadlines(&mut self) {
        let table = &self.table;
        let counts = |deadline: &Deadline| {
            let slot = table.slot(deadline.at);
            let slot = slot.filter(|slot| slot.generation == deadline.generation);
            let parties = slot.map(|slot| &slot.conversation.parties);
            let party = parties.and_then(|parties| parties.get(deadline.party as usize));
            party.is_some_and(|party| party.deadline == deadline.due)
        };
        self.deadlines.remove_stale(counts);
    }
}

impl Passed {
    /// The result of a message that changes nothing.
    #[inline]
    pub(crate) fn in_state_of(conversation: &Conversation, machine: &Machine, index: u16) -> Self {
        let parties = &conversation.parties;
        Self {
            machine: index,
            state: parties.first().map_or(machine.initial, |party| party.state),
            opened: false,
            complete: conversation.unnamed().is_none()
                && parties.iter().all(|party| is_final(machine, party.state)),
            late: false,
            void: false,
            elsewhere: conversation.joined,
        }
    }
}

/// Number of receivers that are looked at to find the conversation of a message.
const MAX_LOOKED_AT: usize = 16;

/// The name of the cancel meta-protocol as a protocol of its own.
const CANCEL_PROTOCOL: &str = "fipa-cancel";

/// Whether the message names more agents in `reply-to` than a conversation keeps.
fn is_crowded(conversation: &Conversation, names: &Names, header: &Header<'_>) -> bool {
    let reply_to = header.reply_to_names();
    if reply_to.is_empty() {
        return false;
    }
    let new = |name: &&Cow<'_, str>| {
        !conversation.is_designated(names, name)
            && !conversation
                .delegates()
                .iter()
                .any(|(_, known)| names.is(*known, name))
    };
    let kept = conversation.reply_to().len() + conversation.delegates().len();
    kept + reply_to.iter().filter(new).count() > MAX_DESIGNATED
}

/// The role bindings that a message adds at most, with one state for all participants.
#[derive(Debug, Default)]
struct NewBindings {
    /// Of the sender: 0 or 1.
    sender: usize,
    /// Of the receivers: one each, or none.
    receivers: usize,
    /// Of the agents in the `reply-to` of a participant: each role of the participant.
    delegates: usize,
}

impl NewBindings {
    fn by(
        machine: &Machine,
        conversation: &Conversation,
        names: &Names,
        observed: &ObservedMessage<'_>,
        moves: &[Move],
        header: &Header<'_>,
    ) -> Self {
        let Some(made) = moves
            .first()
            .filter(|_| machine.scope == Scope::Conversation)
        else {
            return Self::default();
        };
        let free = unbound(machine, conversation);
        let (from, to) = made.next_state.roles;
        // A pattern of several roles binds none.
        let binds = |roles: u32| roles & free != 0 && roles.count_ones() == 1;
        let sender = usize::from(binds(from));
        let reply_to = header.reply_to_names().len();
        let leads = || conversation.speaks_for_initiator(names, observed.sender);
        let delegates = match reply_to {
            0 => 0,
            _ if leads() => 0,
            _ => {
                let bound = conversation.bound.iter();
                let held = bound.filter(|bound| names.is(bound.agent, observed.sender));
                (held.count() + sender) * reply_to
            }
        };
        Self {
            sender,
            receivers: if binds(to) {
                observed.receivers.len()
            } else {
                0
            },
            delegates,
        }
    }

    fn count(&self) -> usize {
        self.sender + self.receivers + self.delegates
    }
}

/// Returns an upper bound of the bytes that a message adds to a conversation: with new participants, roles
/// or agents in `reply-to`, as the first of several copies, or as the report of undelivered messages.
fn growth_by(
    machine: &Machine,
    conversation: &Conversation,
    observed: &ObservedMessage<'_>,
    (moves, bindings, is_copied): (&[Move], &NewBindings, bool),
    header: &Header<'_>,
) -> usize {
    let name = |name: &Cow<'_, str>| Names::cost(name.len());
    let sender = Names::cost(observed.sender.len());
    let reply_to = header.reply_to_names();
    let designated = reply_to.iter().map(name).sum::<usize>();
    let reported = moves.iter().filter(|made| made.reported).count() * Party::GROWTH_BY_REPORT;
    let growth = match machine.scope {
        Scope::Participant => {
            let new = moves.iter().filter_map(|made| match made.target {
                MoveTarget::Receiver(number) => observed.receivers.get(number).map(name),
                MoveTarget::Sender => Some(sender),
                MoveTarget::Party(_) | MoveTarget::Unnamed => None,
            });
            let growth = conversation.growth(new.clone().count(), 0, reply_to.len());
            growth + new.sum::<usize>() + designated
        }
        Scope::Conversation => {
            let receivers = match bindings.receivers {
                0 => &[],
                _ => observed.receivers,
            };
            // The agents in `reply-to` have a name each, and one for each binding.
            let held = bindings.delegates.checked_div(reply_to.len());
            let copies = match is_copied {
                true => Copied::MAX * size_of::<Copied>() + size_of::<u64>(),
                false => 0,
            };
            conversation.growth(0, bindings.count(), reply_to.len())
                + bindings.sender * sender
                + receivers.iter().map(name).sum::<usize>()
                + held.unwrap_or(0).max(1) * designated
                + copies
        }
    };
    growth + reported
}

/// If the message is another copy of the last one to several receivers: gives its receiver the role of the
/// receivers, unless there are too many.
fn take_copy(
    conversation: &mut Conversation,
    names: &mut Names,
    observed: &ObservedMessage<'_>,
    (fingerprint, receiver): (u64, u64),
    limits: &MonitorLimits,
) -> Option<Result<(), Kind>> {
    let mut all = conversation.rare.as_deref()?.copied.iter().enumerate();
    let (place, copied) = all.find(|(_, copied)| copied.fingerprint == fingerprint)?;
    if copied.seen.contains(&receiver) {
        return None;
    }
    let name = observed.receivers.first()?;
    let seen = (copied.seen.len() + 1).next_power_of_two() * size_of::<u64>();
    let bytes = conversation.allocated() + conversation.growth(0, 1, 0);
    let size = Slot::COST + bytes + seen + Names::cost(name.len());
    if conversation.bound.len() >= limits.participants
        || copied.seen.len() == limits.participants
        || size > limits.share_of_bytes()
    {
        return Some(Err(Kind::TooMany));
    }
    let copied = conversation.rare().copied.get_mut(place)?;
    copied.seen.push(receiver);
    let (_, to) = copied.roles;
    if to.count_ones() == 1 {
        let role = u8::try_from(to.trailing_zeros()).unwrap_or(0);
        let agent = conversation.acquire(names, name);
        conversation.bound.push(RoleBinding { role, agent });
    }
    Some(Ok(()))
}

/// Keeps a message of which further copies may follow.
fn keep_copied(
    conversation: &mut Conversation,
    fingerprint: u64,
    receiver: u64,
    roles: (u32, u32),
) {
    let copied = &mut conversation.rare().copied;
    copied.retain(|copied| copied.fingerprint != fingerprint);
    if copied.len() == Copied::MAX {
        copied.remove(0);
    }
    copied.push(Copied {
        fingerprint,
        seen: vec![receiver],
        roles,
    });
}

/// The parties of a conversation before a message.
#[derive(Debug, Clone, Copy)]
struct PartiesBefore {
    /// Number of the parties with messages.
    count: usize,
    has_unnamed: bool,
}

impl PartiesBefore {
    /// Returns the parties of a conversation that may have begun before the monitor.
    #[inline]
    fn of(conversation: &Conversation, machine: &Machine) -> Option<Self> {
        let rare = conversation.rare.as_deref();
        let may_continue = rare.is_some_and(|rare| rare.may_continue);
        may_continue.then(|| Self::known(conversation, machine))
    }

    #[cold]
    fn known(conversation: &Conversation, machine: &Machine) -> Self {
        let mut parties = conversation.parties.iter();
        // With one state for all participants, the party exists before the first message.
        let is_new =
            machine.scope == Scope::Conversation && parties.all(|party| party.acts == [0; 2]);
        Self {
            count: if is_new {
                0
            } else {
                conversation.parties.len()
            },
            has_unnamed: conversation.unnamed().is_some(),
        }
    }
}

/// In a conversation that may have begun before the monitor: notes the other states to which the first
/// message to a party may have led, and removes those which a later message does not fit.
#[cold]
fn keep_alternatives(
    machine: &Machine,
    conversation: &mut Conversation,
    observed: &ObservedMessage<'_>,
    (moves, before): (&[Move], PartiesBefore),
) {
    let count = conversation.parties.len();
    let Some(rare) = conversation.rare.as_deref_mut() else {
        return;
    };
    let index = |at: usize| u32::try_from(at).unwrap_or(NONE);
    let step_of = |party: u32| {
        let mut steps = moves.iter().filter(|made| {
            let NextState { void, state, .. } = made.next_state;
            !void && !made.reported && state != FAILED
        });
        steps.find(|made| match made.target {
            MoveTarget::Party(at) => index(at) == party,
            MoveTarget::Unnamed => party == NONE,
            MoveTarget::Receiver(_) | MoveTarget::Sender => false,
        })
    };
    // A cancel and its answers fit any state, but a message may also be a step of the protocol.
    let fits_any_state = |made: &Move| {
        let NextState { state, crossed, .. } = made.next_state;
        made.next_state.answers_cancel || [CANCELLING, CANCELLED].contains(&state) && !crossed
    };
    let alternatives = std::mem::take(&mut rare.alternatives);
    let kept = alternatives.into_iter().flat_map(|(party, state)| {
        let made = step_of(party).filter(|_| state != FAILED);
        let stays = made.is_none_or(fits_any_state);
        let step = made.and_then(|_| {
            let state = machine.state(state)?;
            step(&state.steps, observed.act, u32::MAX, u32::MAX)
        });
        let stays = stays.then_some((party, state));
        stays
            .into_iter()
            .chain(step.map(|step| (party, step.target)))
    });
    let reported = moves.iter().filter(|made| made.reported);
    let reported = reported.filter_map(|made| match made.target {
        MoveTarget::Party(at) => Some(any_state_of(at)),
        MoveTarget::Unnamed | MoveTarget::Receiver(_) | MoveTarget::Sender => None,
    });
    rare.alternatives = kept.chain(reported).collect();
    rare.alternatives.sort_unstable();
    rare.alternatives.dedup();
    let first = &machine.initial().steps;
    let Some(first) = step(first, observed.act, u32::MAX, u32::MAX) else {
        return;
    };
    let unnamed = (rare.unnamed.is_some() && !before.has_unnamed).then_some(NONE);
    let new = (before.count..count).map(index);
    let others = machine.later_targets(observed.act, first);
    for party in new.chain(unnamed) {
        let others = others.iter().map(|state| (party, *state));
        rare.alternatives.extend(others);
    }
}

/// Takes a message of a sender to a receiver back, if it is the last one between them: the number of its
/// performative, and its `reply-with`.
fn take_back(
    machine: &Machine,
    conversation: &mut Conversation,
    names: &Names,
    (sender, receiver): (&str, &str),
    (act, reply_with): (u8, u64),
) -> bool {
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

/// The entry of [`Rare::alternatives`](crate::conversation::Rare::alternatives) of a party after an
/// undelivered message: the state before the first known message is unknown, and a message that has ruled
/// out states has no effect.
fn any_state_of(party: usize) -> (u32, u16) {
    (u32::try_from(party).unwrap_or(NONE), FAILED)
}

#[cfg(test)]
mod tests {
    use fipa_acl::{Performative, Time};

    use super::*;
    use crate::conversation::names::COMPARISONS;
    use crate::conversation::{Details, Rare};

    #[test]
    fn stale_deadlines_are_removed() {
        let mut monitor = Monitor::observer(Arc::new(Library::standard()));
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let due = Time::from_system_time(now + Duration::from_secs(3_600));
        let due = due.expect("a time of this century");
        for number in 0..5_000 {
            let say = |act, from: &'static str, to: &'static str| {
                let header = Header::new(act).sender(from).receivers([to]);
                let header = header.protocol("fipa-contract-net");
                header.conversation_id(number.to_string())
            };
            let call = say(Performative::Cfp, "ann", "ben").reply_by(due);
            assert!(monitor.check(&call, now).is_accepted());
            let answer = say(Performative::Refuse, "ben", "ann");
            assert!(monitor.check(&answer, now).is_accepted());
        }
        assert!(
            monitor.deadlines.len() < 1_100,
            "{:?}",
            monitor.deadlines.len()
        );
    }

    #[test]
    fn embedded_conversations_have_references_to_the_peer_of_theirs() {
        let mut monitor = Monitor::agent(Arc::new(Library::standard()), "ben");
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let hour = Duration::from_secs(3_600);
        let mut say = |words: &'static str, protocol, id, now| {
            let (act, agents) = words.split_once(' ').unwrap();
            let (from, to) = agents.split_once('>').unwrap();
            let header = Header::new(act.parse().unwrap()).sender(from);
            let header = header.receivers([to]).protocol(protocol);
            assert!(
                monitor
                    .check(&header.conversation_id(id), now)
                    .is_accepted()
            );
        };
        say("request zed>ben", "fipa-request", "1", now);
        say("request ann>ben", "fipa-request", "2", now);
        say("proxy ann>ben", "fipa-brokering", "3", now);
        say("agree ben>ann", "fipa-brokering", "3", now);
        say("request ben>cid", "fipa-request", "3", now);
        say("query-if ben>cid", "fipa-query", "3", now);
        say("cfp ben>cid", "fipa-contract-net", "3", now);
        say("agree ben>zed", "fipa-request", "1", now + 20 * hour);
        say("agree ben>ann", "fipa-request", "2", now + 20 * hour);
        let held = |monitor: &Monitor, name| {
            let name = monitor.names.known(name);
            name.map(|name| monitor.table.of_peer(name).0)
        };
        let both = |monitor: &Monitor| ["zed", "ann"].map(|name| held(monitor, name));
        assert_eq!(both(&monitor), [Some(1), Some(5)]);
        monitor.handle_timeout(now + 25 * hour);
        assert_eq!(both(&monitor), [Some(1), Some(1)]);
        monitor.handle_timeout(now + 50 * hour);
        assert_eq!(monitor.names.len(), 0);
    }

    #[test]
    fn names_of_undelivered_messages_are_released() {
        let text = r#"<scxml initial="1">
            <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="propagate" from="b" to="c" target="3"/></state>
            <state id="3"><transition performative="inform" from="c" to="a" target="4"/></state>
            <state id="4" final="yes"/></scxml>"#;
        let mut library = Library::standard();
        library.add(Machine::read("own", text).unwrap()).unwrap();
        let mut monitor = Monitor::agent(Arc::new(library), "ann");
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let request = |to: &'static str| {
            let header = Header::new(Performative::Request).sender("ann");
            header.receivers([to]).protocol("own").conversation_id("1")
        };
        let mut bytes = Vec::new();
        for to in ["ben", "cid", "dan"] {
            assert!(monitor.check(&request(to), now).is_accepted());
            assert!(monitor.names.known(to).is_some());
            assert_eq!(monitor.names.len(), 2, "{to}");
            bytes.push(monitor.bytes());
            monitor.undelivered(&request(to), to, now);
            assert_eq!(monitor.names.len(), 2, "{to}");
        }
        assert_eq!(bytes[1], bytes[2]);
        monitor.handle_timeout(now + Duration::from_secs(100_000));
        assert_eq!(monitor.names.len(), 0);
    }

    #[test]
    fn names_are_compared_in_linear_steps() {
        const MANY: usize = 500;
        let text = r#"<scxml initial="1">
            <state id="1"><transition performative="request" from="a" to="b" target="2"/></state>
            <state id="2"><transition performative="inform" from="a" to="b" target="3"/></state>
            <state id="3"><transition performative="agree" from="b" to="a" target="3"/></state></scxml>"#;
        let mut library = Library::standard();
        library.add(Machine::read("plain", text).unwrap()).unwrap();
        let library = Arc::new(library);
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let header = |act, protocol| Header::new(act).protocol(protocol).conversation_id("1");
        let all = || (0..MANY).map(|number| format!("agent {number}"));
        for (protocol, acts) in [
            ("plain", [Performative::Request, Performative::Inform]),
            (
                "fipa-contract-net",
                [Performative::Cfp, Performative::Cancel],
            ),
        ] {
            let mut monitor = Monitor::observer(Arc::clone(&library));
            let sent = |act| header(act, protocol).sender("ann").receivers(all());
            let lost = header(Performative::Failure, protocol).sender("mts");
            let lost = lost.receivers(all()).undelivered_to("ann");
            for message in acts.map(sent).into_iter().chain([lost]) {
                let before = COMPARISONS.get();
                let verdict = monitor.check(&message, now);
                assert!(verdict.is_accepted(), "{verdict:?}");
                let made = COMPARISONS.get() - before;
                assert!(made < 10 * MANY, "{protocol}: {made} comparisons");
            }
        }
    }

    #[test]
    fn a_conversation_may_have_the_whole_share_of_a_peer() {
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        let library = Arc::new(Library::standard());
        let begun = |share| {
            let limits = MonitorLimits {
                bytes: share * 8,
                ..MonitorLimits::default()
            };
            let mut monitor = Monitor::observer(Arc::clone(&library)).with_limits(limits);
            let request = Header::new(Performative::Request).sender("ann");
            let request = request.receivers(["ben"]).protocol("fipa-request");
            let verdict = monitor.check(&request.conversation_id("1"), now);
            (verdict.is_accepted(), monitor.bytes())
        };
        let (_, bytes) = begun(1 << 20);
        // The conversation may need details and rare parts later.
        let bound = bytes + size_of::<Details>() + size_of::<Rare>();
        assert_eq!(begun(bound), (true, bytes));
        assert_eq!(begun(bound - 1), (false, 0));
    }

    #[test]
    fn names_are_released_with_the_last_conversation() {
        let mut monitor = Monitor::observer(Arc::new(Library::standard()));
        let now = UNIX_EPOCH + Duration::from_secs(1_700_000_000);
        for id in ["1", "2"] {
            let call = Header::new(Performative::Cfp).sender("ann");
            let call = call.receivers(["ben", "cid"]).reply_to(["dan"]);
            let call = call.protocol("fipa-contract-net").conversation_id(id);
            assert!(monitor.check(&call, now).is_accepted());
        }
        assert_eq!(monitor.names.len(), 4);
        monitor.handle_timeout(now + Duration::from_secs(100_000));
        assert_eq!(monitor.names.len(), 0);
    }
}
