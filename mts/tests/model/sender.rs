//! The sender's process: assigns streams, computes predecessors, moves letters, gives outcomes.

use fipa_mts::core::rules::{self, Again, Cause};

use crate::hop::Effect;
use crate::protocol::{Mutant, Protocol};
use crate::state::{Key, Letter, Message, Outcome, Place, RECEIVER, SENDER, State, What};

impl Protocol {
    /// The predecessor of a letter in its stream, which a copy carries.
    pub(crate) fn predecessor(&self, state: &State, sequence: u8) -> u8 {
        if self.is(Mutant::NoPredecessor) {
            return 0;
        }
        let registration = state.letters[usize::from(sequence) - 1].registration;
        let open = state
            .open()
            .filter(|(_, letter)| letter.registration == registration);
        rules::predecessor(open.map(|(other, _)| other.into()), sequence.into()) as u8
    }

    /// The predecessor of a letter that has been handed over already, which a note carries. Open
    /// letters that have moved to another stream count: they must not be passed over either.
    pub(crate) fn predecessor_by_name(&self, state: &State, sequence: u8) -> u8 {
        if self.is(Mutant::NoPredecessor) || self.is(Mutant::NoteByStream) {
            return self.predecessor(state, sequence);
        }
        let open = state.open().map(|(other, _)| other.into());
        rules::predecessor(open, sequence.into()) as u8
    }

    /// Gives a letter its outcome, and tells the services that hold later ones.
    pub(crate) fn conclude(&self, state: &mut State, sequence: u8, outcome: Outcome) {
        state.letters[usize::from(sequence) - 1] = Letter {
            outcome: Some(outcome),
            registration: 0,
            uncertain: false,
            place: Place::Ready,
            handed: 0,
            at_once: 0,
        };
        self.has_settled(state, SENDER, sequence);
        if !self.notes || outcome == Outcome::Delivered {
            return;
        }
        for later in sequence + 1..=self.letters as u8 {
            let letter = &state.letters[usize::from(later) - 1];
            let Place::Out {
                to,
                transfer,
                sent,
                after: lowered,
            } = letter.place
            else {
                continue;
            };
            let after = self.predecessor_by_name(state, later);
            if letter.outcome.is_some() || after >= lowered || to == RECEIVER {
                continue;
            }
            let letter = &mut state.letters[usize::from(later) - 1];
            letter.place = Place::Out {
                to,
                transfer,
                sent,
                after,
            };
            let note = Message {
                from: SENDER,
                to,
                key: Key {
                    registration: letter.registration,
                    sequence: later,
                },
                transfer,
                what: What::Predecessor { after },
            };
            Self::send(state, note);
        }
    }

    pub(crate) fn fail(&self, state: &mut State, sequence: u8) {
        let outcome = match state.letters[usize::from(sequence) - 1].uncertain {
            true => Outcome::Unconfirmed,
            false => Outcome::Failed,
        };
        self.conclude(state, sequence, outcome);
    }

    /// Moves letters to the new registration, or ends them with the old one.
    pub(crate) fn move_letters(&self, state: &mut State) {
        if !state.new_known {
            return;
        }
        for sequence in 1..=self.letters as u8 {
            let letter = &mut state.letters[usize::from(sequence) - 1];
            let waits = matches!(letter.place, Place::Ready | Place::Moved);
            if letter.outcome.is_some() || letter.registration == 1 || !waits {
                continue;
            }
            if rules::may_move(letter.uncertain) || self.is(Mutant::MoveUncertain) {
                letter.registration = 1;
                letter.place = Place::Ready;
            } else {
                self.conclude(state, sequence, Outcome::Unconfirmed);
            }
        }
    }

    /// Whether the sender's process may dispatch a letter now.
    pub(crate) fn may_send(&self, state: &State, sequence: u8) -> bool {
        let letter = &state.letters[usize::from(sequence) - 1];
        let earlier = || state.open().take_while(|(other, _)| *other < sequence);
        let under_way = state
            .open()
            .filter(|(_, letter)| matches!(letter.place, Place::Out { .. }))
            .count();
        letter.outcome.is_none()
            && letter.place == Place::Ready
            && state.lanes[0].pause.is_none()
            && under_way < self.window
            && (!self.in_order
                || earlier().all(|(_, letter)| matches!(letter.place, Place::Out { .. })))
            && (rules::may_dispatch(
                earlier().map(|(_, letter)| letter.registration),
                letter.registration,
            ) || self.is(Mutant::NoWaitForOld))
    }

    pub(crate) fn to_sender(&self, state: &mut State, message: Message) {
        let sequence = message.key.sequence;
        let after = self.predecessor_by_name(state, sequence);
        let letter = &mut state.letters[usize::from(sequence) - 1];
        if letter.outcome.is_some() || letter.registration != message.key.registration {
            return;
        }
        match self.effect_of(message, letter.place, letter.handed) {
            Effect::Nothing => {}
            Effect::Doubt => letter.uncertain = true,
            Effect::Delivered => self.conclude(state, sequence, Outcome::Delivered),
            Effect::Back(cause, end) => {
                let sent = match std::mem::replace(&mut letter.place, Place::Ready) {
                    Place::Out { sent, .. } => sent,
                    _ => 0,
                };
                if self.is(Mutant::ForgetUncertain) && cause == Cause::Returned {
                    letter.uncertain = false;
                }
                Self::mark(&mut letter.uncertain, end);
                let lower = state.open().rfind(|(other, _)| *other < sequence);
                let is_behind = lower.is_some_and(|(_, lower)| lower.place == Place::Ready);
                match self.again(cause, sent, after) {
                    Again::AtOnce => {}
                    Again::AfterPredecessor if is_behind => {}
                    Again::AfterPause | Again::AfterPredecessor => {
                        self.pause(state, SENDER, (cause, message.key));
                    }
                }
            }
            Effect::Moved => letter.place = Place::Moved,
            Effect::Failed(end) => {
                Self::mark(&mut letter.uncertain, end);
                self.fail(state, sequence);
            }
        }
    }
}
