//! The timeouts of a monitor: overdue messages, and conversations that are over or abandoned.

use std::time::{Duration, SystemTime};

use crate::Moment;
use crate::check::apply::expire_party;
use crate::clock::span_millis;
use crate::conversation::deadlines::Deadline;
use crate::conversation::ids::SlotIndex;
use crate::conversation::party::Party;
use crate::conversation::state::{FAILED, is_final, is_over, state_name};
use crate::conversation::table::{List, Slot};
use crate::monitor::{Event, Monitor};
use crate::protocol::machine::{Machine, Scope};

impl Monitor {
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
        let removal_at = |list, span: Duration| {
            let slot = self.table.slot(self.table.oldest(list)?)?;
            Some(
                slot.touched
                    .saturating_add(span_millis(span))
                    .saturating_add(1),
            )
        };
        let ended = removal_at(List::Ended, self.limits.ended);
        let idle = removal_at(List::Open, self.limits.idle);
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
        let party = slot.conversation.parties.get_mut(deadline.party.get())?;
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
        self.touch(parent.unwrap_or(deadline.at), touched);
        complete.then_some(event)
    }

    pub(crate) fn remove_stale_deadlines(&mut self) {
        let table = &self.table;
        let counts = |deadline: &Deadline| {
            let slot = table.slot(deadline.at);
            let slot = slot.filter(|slot| slot.generation == deadline.generation);
            let parties = slot.map(|slot| &slot.conversation.parties);
            let party = parties.and_then(|parties| parties.get(deadline.party.get()));
            party.is_some_and(|party| party.deadline == deadline.due)
        };
        self.deadlines.remove_stale(counts);
    }

    /// Updates the time and the list of a main conversation.
    pub(crate) fn touch(&mut self, at: SlotIndex, now: u64) {
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
        while all_over
            && let Some(at) = child
            && let Some(slot) = self.table.slot(at)
        {
            all_over = over(slot);
            child = self.table.sibling(at);
        }
        let list = if all_over { List::Ended } else { List::Open };
        self.table.touch(at, list, now);
    }
}
