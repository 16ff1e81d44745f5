//! The monitor of conversations.

use std::hash::{BuildHasher, RandomState};
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use crate::change::{Change, expire, expire_party, millis, span_millis};
use crate::conversation::{Holders, NONE, Party, is_final, is_over, state_name};
use crate::deadlines::{Deadline, Deadlines};
use crate::judge::{Fault, Move, MoveTarget, ObservedMessage, judge};
use crate::limits::MAX_TEXT;
use crate::machine::{Machine, Scope, step};
use crate::names::Names;
use crate::report::violation;
use crate::table::{List, Table};
use crate::verdict::{Accepted, Unchecked, Verdict, ViolationKind as Kind};
use crate::{Header, Library, Limits};

/// Checks messages against the protocols of their conversations.
///
/// [`check`](Self::check) takes the messages in the order in which they were sent or received, and
/// returns a verdict. A message that violates its protocol changes nothing. The monitor has no clock:
/// the caller passes the current time. [`handle_timeout`](Self::handle_timeout) reports overdue
/// messages, and removes conversations that are over or abandoned.
#[derive(Debug)]
pub struct Monitor {
    pub(crate) library: Arc<Library>,
    pub(crate) limits: Limits,
    /// The monitored agent; none for an observer.
    pub(crate) agent: Option<String>,
    pub(crate) names: Names,
    pub(crate) table: Table,
    deadlines: Deadlines,
    hasher: RandomState,
    /// Buffer that is reused.
    moves: Vec<Move>,
    forgotten: u64,
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
    /// [`Limits::idle`].
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
    Unchecked(Unchecked),
}

/// The result of an accepted message.
struct Passed {
    machine: u16,
    state: u16,
    opened: bool,
    complete: bool,
    late: bool,
    void: bool,
    elsewhere: bool,
}

impl Monitor {
    /// Creates a monitor of the conversations of all agents.
    #[must_use]
    pub fn observer(library: Arc<Library>) -> Self {
        Self::with(library, None)
    }

    /// Creates a monitor of the conversations of one agent.
    ///
    /// The caller passes all messages that the agent sends and receives, in their order. So a message
    /// of the agent cannot have crossed a message that was passed before it, and the monitor is
    /// stricter than an observer.
    #[must_use]
    pub fn agent(library: Arc<Library>, name: &str) -> Self {
        Self::with(library, Some(name.to_owned()))
    }

    fn with(library: Arc<Library>, agent: Option<String>) -> Self {
        let hasher = RandomState::new();
        Self {
            library,
            limits: Limits::default(),
            agent,
            names: Names::new(hasher.clone()),
            table: Table::new(hasher.clone()),
            deadlines: Deadlines::default(),
            hasher,
            moves: Vec::new(),
            forgotten: 0,
        }
    }

    /// Sets the limits.
    #[must_use]
    pub fn with_limits(mut self, limits: Limits) -> Self {
        self.limits = limits;
        self
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
    /// [`Limits::conversations`].
    #[must_use]
    pub fn forgotten(&self) -> u64 {
        self.forgotten
    }

    /// Checks a message. If it fits its conversation, updates the conversation.
    pub fn check(&mut self, header: &Header<'_>, now: SystemTime) -> Verdict<'_> {
        match self.take(header, now) {
            Ok(passed) => self.accepted(&passed),
            Err(Denied::Unchecked(why)) => Verdict::Unchecked(why),
            Err(denied) => {
                let violation = violation(&self.library, &self.table, &self.names, header, denied);
                Verdict::Violation(Box::new(violation))
            }
        }
    }

    fn accepted(&self, passed: &Passed) -> Verdict<'_> {
        let Some(machine) = self.library.machine(passed.machine) else {
            return Verdict::Unchecked(Unchecked::UnknownProtocol);
        };
        Verdict::Accepted(Accepted {
            protocol: machine.name(),
            state: state_name(machine, passed.state),
            own: machine.state(passed.state).is_some(),
            opened: passed.opened,
            ended: is_final(machine, passed.state),
            over: is_over(machine, passed.state),
            complete: passed.complete,
            late: passed.late,
            void: passed.void,
            elsewhere: passed.elsewhere,
        })
    }

    fn take(&mut self, header: &Header<'_>, now: SystemTime) -> Result<Passed, Denied> {
        let unchecked = |why| Err(Denied::Unchecked(why));
        let Some(id) = header.conversation() else {
            return unchecked(Unchecked::NoConversation);
        };
        let Some(sender) = header.sender_name() else {
            return unchecked(Unchecked::NoSender);
        };
        let receivers = header.receiver_names();
        if receivers.is_empty() {
            return unchecked(Unchecked::NoReceiver);
        }
        let named = receivers.iter().chain(header.reply_to_names());
        let too_long = |text: &str| text.len() > MAX_TEXT;
        if too_long(id)
            || too_long(sender)
            || receivers.len() + header.reply_to_names().len() > self.limits.participants
            || named.into_iter().any(|name| too_long(name))
        {
            return unchecked(Unchecked::TooLarge);
        }
        let agent = self.agent.as_deref();
        let fingerprint = |text: Option<&str>| text.map_or(0, |text| self.hasher.hash_one(text));
        let observed = ObservedMessage {
            act: header.act(),
            sender,
            receivers,
            reply_with: fingerprint(header.reply_with_text()),
            in_reply_to: fingerprint(header.in_reply_to_text()),
            own: agent == Some(sender),
            own_receiver: agent.filter(|agent| *agent != sender).and_then(|agent| {
                let mut receivers = receivers.iter();
                receivers.position(|receiver| *receiver == agent)
            }),
        };
        let Some(main) = self.table.find(id) else {
            let Some(protocol) = header.protocol_name() else {
                return unchecked(Unchecked::NoProtocol);
            };
            let Some(machine) = self.library.index_of(protocol) else {
                return unchecked(Unchecked::UnknownProtocol);
            };
            return self.open(id, NONE, machine, header, &observed, now);
        };
        let machine = self.machine_of(&self.library, main);
        let follows = |name| machine.is_some_and(|machine: &Machine| machine.is_called(name));
        if header.protocol_name().is_none_or(follows) {
            let passed = self.advance(main, header, &observed, now);
            return passed.map_err(|denied| self.recheck_delegated(main, &observed, denied, now));
        }
        let library = Arc::clone(&self.library);
        self.embedded(&library, main, header, &observed, now)
    }

    /// Checks a message with another protocol than its conversation has. It belongs to an embedded
    /// conversation.
    fn embedded(
        &mut self,
        library: &Library,
        main: u32,
        header: &Header<'_>,
        observed: &ObservedMessage<'_>,
        now: SystemTime,
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
                        self.touch(main, millis(now));
                        return Ok(passed);
                    }
                    Err(fault) if self.may_continue_elsewhere(child) => open = Some((child, fault)),
                    Err(fault) => denied = denied.or(Some(fault)),
                }
            }
            child = self.table.slot(child).map_or(NONE, |slot| slot.sibling);
        }
        if !may_begin {
            return Err(match (denied, open) {
                (Some(denied), _) => denied,
                (None, Some((child, fault))) => self.recheck_delegated(child, observed, fault, now),
                (None, None) if self.began_elsewhere(library, main, name, observed.sender) => {
                    let inner = library.index_of(name).filter(|_| !observed.own);
                    if let Some(inner) = inner.filter(|_| children < self.limits.embedded) {
                        let id = header.conversation().unwrap_or_default();
                        self.join(id, main, inner, observed, now);
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
                self.touch(main, millis(now));
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
                    None => sub.name.is_match(protocol),
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
        now: SystemTime,
    ) -> Result<Passed, Denied> {
        let library = Arc::clone(&self.library);
        let Some(protocol) = library.machine(machine) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        // Checked before eviction, so that an invalid message evicts no conversation.
        let begins = step(&protocol.initial().steps, observed.act, u32::MAX, u32::MAX);
        if begins.is_none() {
            // The initiator may have named the monitored agent in a `reply-to`.
            let named = parent == NONE && self.agent.is_some() && !observed.own;
            return Err(if named && protocol.is_answer(observed.act) {
                self.join(id, parent, machine, observed, now);
                Denied::Unchecked(Unchecked::BegunElsewhere)
            } else {
                Denied::NotOpened(machine)
            });
        }
        self.evict(parent);
        let at = self.table.insert(id, parent, machine, millis(now));
        let initiator = self.names.acquire(observed.sender);
        if let Some(slot) = self.table.slot_mut(at) {
            slot.conversation.initiator = initiator;
            if protocol.scope == Scope::Conversation {
                let party = Party::new(NONE, protocol.initial);
                slot.conversation.parties.push(party);
            }
        }
        let passed = self.advance(at, header, observed, now);
        passed.map_err(|denied| {
            self.remove(at);
            match denied {
                Denied::Fault(..) => Denied::NotOpened(machine),
                other => other,
            }
        })
    }

    /// Removes conversations until there is space for one more. The conversation `keep` is kept.
    pub(crate) fn evict(&mut self, keep: u32) {
        while self.table.len() >= self.limits.conversations.max(1) {
            let other = |at: &u32| *at != keep;
            let ended = self.table.oldest(List::Ended).filter(other);
            let Some(at) = ended.or_else(|| self.table.oldest(List::Open).filter(other)) else {
                return;
            };
            if ended.is_none() {
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
        now: SystemTime,
    ) -> Result<Passed, Denied> {
        let now_ms = millis(now);
        let fault = |kind| Denied::Fault(Fault::plain(kind), at);
        let Some(slot) = self.table.slot_mut(at) else {
            return Err(fault(Kind::NotOpened));
        };
        let index = slot.conversation.machine;
        let Some(machine) = self.library.machine(index) else {
            return Err(Denied::Unchecked(Unchecked::UnknownProtocol));
        };
        expire(machine, &mut slot.conversation, now_ms);
        let conversation = &slot.conversation;
        judge(
            machine,
            conversation,
            &self.names,
            observed,
            &mut self.moves,
        )
        .map_err(|fault| Denied::Fault(fault, at))?;
        let new =
            |made: &&Move| matches!(made.target, MoveTarget::Receiver(_) | MoveTarget::Sender);
        let grown = conversation.parties.len() + self.moves.iter().filter(new).count();
        if grown > self.limits.participants
            || conversation.bound.len() + observed.receivers.len() > self.limits.participants + 1
        {
            return Err(fault(Kind::TooMany));
        }
        let due = header.reply_by_time(now).map_or(0, millis);
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
        for made in &self.moves {
            if machine.scope == Scope::Conversation {
                change.bind(&mut slot.conversation, made.next_state.roles);
            }
            change.make(&mut slot.conversation, *made);
        }
        if change.names_designated(&slot.conversation, &self.moves) {
            change.designate(&mut slot.conversation, header);
        }
        let (opened, moved) = (change.opened, change.state);
        let (late, void) = (change.late, change.void);
        let parties = &slot.conversation.parties;
        let first = parties.first().map_or(machine.initial, |party| party.state);
        let complete = slot.conversation.unnamed.is_none()
            && parties.iter().all(|party| is_final(machine, party.state));
        let passed = Passed {
            machine: index,
            state: moved.unwrap_or(first),
            opened,
            complete,
            late,
            void,
            elsewhere: slot.conversation.joined,
        };
        let is_main = slot.parent == NONE;
        if is_main {
            self.touch(at, now_ms);
        }
        self.keep_deadlines_few();
        Ok(passed)
    }

    /// Updates the time and the list of a main conversation.
    pub(crate) fn touch(&mut self, at: u32, now: u64) {
        let library = &self.library;
        let over = |slot: &crate::table::Slot| {
            let conversation = &slot.conversation;
            let machine = library.machine(conversation.machine);
            conversation.unnamed.is_none()
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
        while let Some(slot) = self.table.slot(child) {
            all_over &= over(slot);
            child = slot.sibling;
        }
        let list = if all_over { List::Ended } else { List::Open };
        self.table.touch(at, list, now);
    }

    /// Time at which the caller must call [`handle_timeout`](Self::handle_timeout) next.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<SystemTime> {
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
        UNIX_EPOCH.checked_add(Duration::from_millis(next))
    }

    /// Handles timeouts: reports overdue messages, and removes conversations that are over or
    /// abandoned.
    pub fn handle_timeout(&mut self, now: SystemTime) -> Vec<Event> {
        let now = millis(now);
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
                        conversation_id: slot.conversation.id.clone(),
                    });
                }
                self.forget(at);
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
        let event = Event::Overdue {
            protocol: machine.name().to_owned(),
            conversation_id: slot.conversation.id.clone(),
            participant: (scope == Scope::Participant).then(|| self.names.text(peer).to_owned()),
            state: state_name(machine, before).to_owned(),
            next,
        };
        let touched = slot.touched;
        let main = if slot.parent == NONE {
            deadline.at
        } else {
            slot.parent
        };
        self.touch(main, touched);
        complete.then_some(event)
    }

    /// Removes a main conversation with its embedded conversations.
    fn forget(&mut self, at: u32) {
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
            let named = peers
                .chain(bound)
                .chain(conversation.reply_to.iter().copied());
            for name in named.filter(|name| *name != NONE) {
                self.names.release(name);
            }
        }
        self.table.remove(at);
    }

    fn machine_of<'l>(&self, library: &'l Library, at: u32) -> Option<&'l Machine> {
        library.machine(self.table.slot(at)?.conversation.machine)
    }

    /// Removes stale deadlines if there are too many.
    fn keep_deadlines_few(&mut self) {
        let table = &self.table;
        let counts = |deadline: &Deadline| {
            let slot = table.slot(deadline.at);
            let slot = slot.filter(|slot| slot.generation == deadline.generation);
            let parties = slot.map(|slot| &slot.conversation.parties);
            let party = parties.and_then(|parties| parties.get(deadline.party as usize));
            party.is_some_and(|party| party.deadline == deadline.due)
        };
        self.deadlines.keep_few(counts);
    }
}

#[cfg(test)]
mod tests {
    use fipa_acl::{Performative, Time};

    use super::*;

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
