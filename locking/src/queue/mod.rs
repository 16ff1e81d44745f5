//! Requests that wait at an owner, in the order of their arrival.
//!
//! * A member has at most one entry. A repeated request changes its time only, and a later one keeps its place.
//! * A member that is proved gone leaves. With the algorithm [`OwnerQueue`](crate::OwnerQueue), a suspected member
//!   keeps its place until its turn: then the owner asks it for a sign of life. Without an answer within the
//!   timeout of a probe it goes to the end once, and leaves the second time. Members behind it that are suspected,
//!   too, are asked at the same time.
//! * Members are told their places when these change, up to [`MAX_PLACE`]. So a change of the queue causes a
//!   bounded number of letters.
//! * A restarted owner is silent at first. The entries that arrive in this time are sorted by the places of the
//!   owner's life before; those without a place follow.

use std::collections::VecDeque;

use crate::owner::OwnerStep;
use crate::{Act, Conversation, LockDialect, LockPeer, Millis, OwnerGate};

/// Highest place in an owner's queue that a member is told.
pub const MAX_PLACE: u32 = 8;

/// The queue of an owner, for one resource.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Default)]
pub(crate) struct Queue {
    waiters: VecDeque<Waiter>,
    /// Set if the algorithm is the owner's queue.
    rules: Option<Rules>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct Rules {
    /// Time in which a suspected member has to answer when it is its turn.
    probe_timeout: Millis,
}

/// A request that waits.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub(crate) struct Waiter {
    pub(crate) peer: LockPeer,
    pub(crate) conversation: Conversation,
    /// Time that the grant repeats. Legacy agents have none.
    pub(crate) asked: Option<Millis>,
    /// Place in the owner's life before.
    former: Option<u32>,
    /// Place that the member was told.
    last_place_sent: Option<u32>,
    presence: Presence,
    /// Whether it has gone to the end.
    is_moved: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Presence {
    Present,
    Suspected,
    /// It is its turn, and it was asked for a sign of life. The time is the end of the wait for an answer.
    Asked(Millis),
}

impl Waiter {
    pub(crate) fn new(peer: LockPeer, conversation: Conversation, asked: Option<Millis>) -> Self {
        Self {
            peer,
            conversation,
            asked,
            former: None,
            last_place_sent: None,
            presence: Presence::Present,
            is_moved: false,
        }
    }

    fn dialect(&self) -> LockDialect {
        match self.asked {
            Some(_) => LockDialect::Own,
            None => LockDialect::Legacy,
        }
    }
}

impl Queue {
    /// Sets the rules of the algorithm [`OwnerQueue`](crate::OwnerQueue).
    pub(crate) fn be_fair(&mut self, probe_timeout: Millis) {
        self.rules = Some(Rules { probe_timeout });
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = &Waiter> {
        self.waiters.iter()
    }

    pub(crate) fn get(&self, index: usize) -> Option<&Waiter> {
        self.waiters.get(index)
    }

    pub(crate) fn find(&mut self, peer: &LockPeer) -> Option<&mut Waiter> {
        self.waiters.iter_mut().find(|waiter| waiter.peer == *peer)
    }

    pub(crate) fn remove(&mut self, index: usize) -> Option<Waiter> {
        self.waiters.remove(index)
    }

    /// Removes the request of this conversation.
    pub(crate) fn withdraw(&mut self, peer: &LockPeer, conversation: &Conversation) {
        self.waiters
            .retain(|waiter| waiter.peer != *peer || waiter.conversation != *conversation);
    }

    /// Adds a request at the end, or replaces the earlier one of the member. Returns whether it is new.
    pub(crate) fn add(
        &mut self,
        peer: &LockPeer,
        conversation: &Conversation,
        asked: Option<Millis>,
    ) -> bool {
        match self.find(peer) {
            Some(waiter) if conversation.is_not_after(&waiter.conversation) => false,
            Some(waiter) => {
                waiter.conversation = conversation.clone();
                waiter.asked = asked;
                waiter.last_place_sent = None;
                waiter.presence = Presence::Present;
                true
            }
            None => {
                let waiter = Waiter::new(peer.clone(), conversation.clone(), asked);
                self.waiters.push_back(waiter);
                true
            }
        }
    }

    /// Sorts a request by its place in the owner's life before.
    pub(crate) fn sort_in(&mut self, peer: &LockPeer, place: u32) {
        let index = self.waiters.iter().position(|waiter| waiter.peer == *peer);
        let Some(mut waiter) = index.and_then(|index| self.waiters.remove(index)) else {
            return;
        };
        waiter.former = Some(place);
        let behind = |other: &Waiter| other.former.is_none_or(|former| former > place);
        let at = self.waiters.iter().position(behind);
        self.waiters
            .insert(at.unwrap_or(self.waiters.len()), waiter);
    }

    /// Handles the loss of a member. `gone` is a proof that its registration or its process has ended.
    pub(crate) fn lost(&mut self, peer: &LockPeer, gone: bool) {
        if gone || self.rules.is_none() {
            self.waiters.retain(|waiter| waiter.peer != *peer);
        } else if let Some(waiter) = self.find(peer)
            && waiter.presence == Presence::Present
        {
            waiter.presence = Presence::Suspected;
        }
    }

    /// Handles a sign of life.
    pub(crate) fn sign_of_life(&mut self, peer: &LockPeer) {
        if let Some(waiter) = self.find(peer) {
            waiter.presence = Presence::Present;
        }
    }

    /// Returns the index of the request whose turn it is, if it is to be granted.
    pub(crate) fn next(
        &mut self,
        now: Millis,
        gate: OwnerGate,
        out: &mut Vec<OwnerStep>,
    ) -> Option<usize> {
        let Some(rules) = self.rules else {
            let mut waiters = self.waiters.iter();
            return waiters.position(|waiter| gate.lets_pass(waiter.dialect()));
        };
        // Each round ends the search, or moves a member to the end for the only time, or removes it.
        loop {
            match self.waiters.front()?.presence {
                Presence::Present => return Some(0),
                Presence::Suspected => {
                    self.ask(now, rules, out);
                    return None;
                }
                Presence::Asked(until) if now < until => return None,
                Presence::Asked(_) => {
                    let mut waiter = self.waiters.pop_front()?;
                    if !waiter.is_moved {
                        waiter.is_moved = true;
                        waiter.presence = Presence::Suspected;
                        self.waiters.push_back(waiter);
                    }
                }
            }
        }
    }

    /// Asks the first members for a sign of life, up to the first one that is not suspected.
    fn ask(&mut self, now: Millis, rules: Rules, out: &mut Vec<OwnerStep>) {
        let waiters = self.waiters.iter_mut();
        for waiter in waiters.take_while(|waiter| waiter.presence == Presence::Suspected) {
            waiter.presence = Presence::Asked(now.saturating_add(rules.probe_timeout));
            let to = waiter.peer.clone();
            out.push(OwnerStep::Probe { to, at: now });
        }
    }

    /// Tells the first members their places, if they have changed.
    pub(crate) fn tell(&mut self, out: &mut Vec<OwnerStep>) {
        if self.rules.is_none() {
            return;
        }
        for (place, waiter) in (1..=MAX_PLACE).zip(&mut self.waiters) {
            if waiter.last_place_sent != Some(place) {
                waiter.last_place_sent = Some(place);
                out.push(OwnerStep::Send {
                    to: waiter.peer.clone(),
                    conversation: waiter.conversation.clone(),
                    act: Act::Place { place },
                });
            }
        }
        for waiter in self.waiters.iter_mut().skip(MAX_PLACE as usize) {
            // It went to the end.
            waiter.last_place_sent = None;
        }
    }

    /// Time of the next timeout, while no grant is live.
    pub(crate) fn poll_timeout(&self) -> Option<Millis> {
        match self.waiters.front()?.presence {
            Presence::Asked(until) => Some(until),
            Presence::Present | Presence::Suspected => None,
        }
    }

    #[cfg(test)]
    pub(crate) fn rebase(&mut self, by: Millis) {
        for waiter in &mut self.waiters {
            waiter.asked = waiter.asked.map(|asked| asked.saturating_sub(by));
            if let Presence::Asked(until) = &mut waiter.presence {
                *until = until.saturating_sub(by);
            }
        }
    }
}

#[cfg(test)]
mod tests;
