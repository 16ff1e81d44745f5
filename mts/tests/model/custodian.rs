//! The custodians: hold letters, forward them, and return them.

use std::time::Duration;

use fipa_mts::core::rules::{self, Again, Cause, HoldDecision};

use crate::hop::Effect;
use crate::protocol::{Mutant, Protocol};
use crate::state::{
    CUSTODIANS, Custodian, Held, Key, LIVES, Message, PauseEnd, Place, RECEIVER, Service, State,
    What,
};

/// Timeout of a custodian. The model has no clock, so the timeout may end at any time.
const TIMEOUT: Duration = Duration::from_millis(50);

impl Protocol {
    pub(crate) fn held(state: &mut State, custodian: usize, key: Key) -> Option<&mut Held> {
        let lane = &mut state.custodians[custodian].held;
        lane.iter_mut().find(|held| held.key == key)
    }

    pub(crate) fn holds(state: &State, custodian: usize, registration: u8, sequence: u8) -> bool {
        let key = Key {
            registration,
            sequence,
        };
        let lane = &state.custodians[custodian].held;
        lane.iter().any(|held| held.key == key)
    }

    /// Removes a letter from the lane, and reports to the services that handed it over.
    pub(crate) fn leave(
        &self,
        state: &mut State,
        custodian: usize,
        key: Key,
        report: fn(bool) -> What,
    ) {
        let lane = &mut state.custodians[custodian].held;
        let Some(place) = lane.iter().position(|held| held.key == key) else {
            return;
        };
        let gone = lane.remove(place);
        self.has_settled(state, Self::at(state, custodian), key.sequence);
        let lane = &mut state.custodians[custodian].held;
        let what = report(gone.uncertain && !self.is(Mutant::CertainReturn));
        for held in lane.iter_mut() {
            if held.key.registration == key.registration && held.after == key.sequence {
                if self.is(Mutant::LowerPastReturned) && matches!(what, What::Returned { .. }) {
                    held.after = gone.after;
                }
                if held.place == Place::Blocked {
                    held.place = Place::Ready;
                }
            }
        }
        let from = Self::at(state, custodian);
        for (slot, transfer) in gone.upstream.into_iter().enumerate() {
            if transfer > 0 {
                let report = Message {
                    from,
                    to: Service::of_slot(slot),
                    key,
                    transfer,
                    what,
                };
                Self::send(state, report);
            }
        }
    }

    /// Whether the receiver's registration has ended on the host of this custodian.
    pub(crate) fn is_gone(&self, state: &State, custodian: usize, key: Key) -> bool {
        state.old_gone
            && key.registration == 0
            && self.topology.next(CUSTODIANS[custodian]) == [RECEIVER.node]
    }

    pub(crate) fn to_custodian(&self, state: &mut State, custodian: usize, message: Message) {
        match message.what {
            What::Copy { after } => {
                if let Some(answer) = self.store(state, custodian, message, after) {
                    Self::reply(state, message, answer);
                }
            }
            What::Predecessor { after } => self.lower(state, custodian, message.key, after),
            _ => self.ended(state, custodian, message),
        }
    }

    pub(crate) fn store(
        &self,
        state: &mut State,
        custodian: usize,
        copy: Message,
        after: u8,
    ) -> Option<What> {
        let Message {
            key,
            transfer,
            from,
            ..
        } = copy;
        if let Some(held) = Self::held(state, custodian, key) {
            let lowered = rules::lower(held.after.into(), after.into()) as u8;
            let is_lower = lowered < held.after;
            if is_lower && held.place == Place::Blocked {
                held.place = Place::Ready;
            }
            held.after = lowered;
            let upstream = &mut held.upstream[from.slot()];
            *upstream = (*upstream).max(transfer);
            if is_lower {
                let at = Self::at(state, custodian);
                Self::end_pause(state, at, |it| it == PauseEnd::LowerPredecessor(key));
            }
            return None;
        }
        if self.is_gone(state, custodian, key) {
            return Some(What::Gone);
        }
        let Custodian { held: lane, .. } = &mut state.custodians[custodian];
        let lowest = lane
            .iter()
            .find(|held| held.key.registration == key.registration)
            .map(|held| held.key.sequence.into());
        if lane.len() >= self.capacity
            && (self.is(Mutant::FullForAll)
                || !rules::admits_when_full(lowest, key.sequence.into()))
        {
            return Some(What::Busy);
        }
        let mut upstream = [0; 1 + LIVES as usize];
        upstream[from.slot()] = transfer;
        let place = lane.partition_point(|held| held.key < key);
        lane.insert(
            place,
            Held {
                key,
                after,
                uncertain: false,
                place: Place::Ready,
                handed: 0,
                at_once: 0,
                upstream,
            },
        );
        None
    }

    pub(crate) fn lower(&self, state: &mut State, custodian: usize, key: Key, after: u8) {
        let from = Self::at(state, custodian);
        let Some(held) = Self::held(state, custodian, key) else {
            return;
        };
        let lowered = rules::lower(held.after.into(), after.into()) as u8;
        if lowered == held.after {
            return;
        }
        held.after = lowered;
        match &mut held.place {
            Place::Blocked => held.place = Place::Ready,
            Place::Out {
                to,
                transfer,
                after,
                ..
            } if to.custodian().is_some() => {
                *after = lowered;
                let note = Message {
                    from,
                    to: *to,
                    key,
                    transfer: *transfer,
                    what: What::Predecessor { after: lowered },
                };
                Self::send(state, note);
            }
            _ => {}
        }
        Self::end_pause(state, from, |it| it == PauseEnd::LowerPredecessor(key));
    }

    pub(crate) fn ended(&self, state: &mut State, custodian: usize, message: Message) {
        let key = message.key;
        let Some(held) = Self::held(state, custodian, key) else {
            return;
        };
        let after = held.after;
        let was_uncertain = held.uncertain;
        match self.effect_of(message, held.place, held.handed) {
            Effect::Nothing => {}
            Effect::Doubt => held.uncertain = true,
            Effect::Delivered => self.leave(state, custodian, key, |_| What::Delivered),
            Effect::Back(cause, end) => {
                let sent = match std::mem::replace(&mut held.place, Place::Ready) {
                    Place::Out { sent, .. } => sent,
                    _ => 0,
                };
                Self::mark(&mut held.uncertain, end);
                match self.again(cause, sent, after) {
                    Again::AtOnce => {}
                    Again::AfterPause => {
                        let at = Self::at(state, custodian);
                        self.pause(state, at, (cause, key));
                    }
                    Again::AfterPredecessor => {
                        held.place = Place::Blocked;
                        if cause == Cause::Returned {
                            self.hold(state, custodian, key);
                        }
                    }
                }
            }
            Effect::Moved => {
                self.leave(state, custodian, key, |uncertain| What::Returned {
                    uncertain,
                });
            }
            Effect::Failed(end) => {
                Self::mark(&mut held.uncertain, end);
                if self.is(Mutant::CertainBehind) {
                    held.uncertain = was_uncertain;
                }
                self.leave(state, custodian, key, |uncertain| What::Failed {
                    uncertain,
                });
            }
        }
    }

    /// Decides about a letter that is blocked, when the timeout has ended.
    pub(crate) fn hold(&self, state: &mut State, custodian: usize, key: Key) {
        let Some(held) = Self::held(state, custodian, key) else {
            return;
        };
        let after = held.after;
        let holds = Self::holds(state, custodian, key.registration, after);
        match rules::hold(holds, TIMEOUT, TIMEOUT) {
            HoldDecision::ForPredecessor | HoldDecision::For(_) => {}
            HoldDecision::Return if self.is(Mutant::NeverReturn) => {}
            HoldDecision::Return => {
                self.leave(state, custodian, key, |uncertain| What::Returned {
                    uncertain,
                });
            }
        }
    }
}
