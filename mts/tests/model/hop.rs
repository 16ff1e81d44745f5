//! One hop: messages between services, the receiver, and the meaning of answers and reports to the
//! service that handed a letter over.

use fipa_mts::core::rules::{self, Again, AttemptEnd, Belief, Cause, CustodyReport, Offer};

use crate::protocol::{Mutant, Protocol};
use crate::state::{
    CUSTODIANS, Custodian, Key, Message, PauseEnd, Place, SENDER, Service, State, What,
};

/// The meaning of an answer or a report to the service that handed the letter over.
pub(crate) enum Effect {
    Nothing,
    /// It may have been delivered by an earlier hand-over.
    Doubt,
    Delivered,
    /// It is dispatched again.
    Back(Cause, AttemptEnd),
    Moved,
    Failed(AttemptEnd),
}

impl Protocol {
    pub(crate) fn send(state: &mut State, message: Message) {
        if let Some(custodian) = message.to.custodian()
            && state.custodians[custodian].life != message.to.life
        {
            return;
        }
        let place = state.network.partition_point(|other| *other < message);
        state.network.insert(place, message);
    }

    pub(crate) fn remove(state: &mut State, message: Message) {
        let place = state.network.binary_search(&message);
        state.network.remove(place.expect("it is under way"));
    }

    pub(crate) fn service(state: &State, node: u8) -> Service {
        let mut service = Service { node, life: 0 };
        if let Some(custodian) = service.custodian() {
            service.life = state.custodians[custodian].life;
        }
        service
    }

    pub(crate) fn at(state: &State, custodian: usize) -> Service {
        Self::service(state, CUSTODIANS[custodian])
    }

    pub(crate) fn reply(state: &mut State, to: Message, what: What) {
        let answer = Message {
            from: to.to,
            to: to.from,
            what,
            ..to
        };
        Self::send(state, answer);
    }

    /// Returns the place of a letter in a service, if the service holds the letter.
    pub(crate) fn place_of(state: &State, at: Service, key: Key) -> Option<Place> {
        match at.custodian() {
            None => {
                let letter = &state.letters[usize::from(key.sequence) - 1];
                (at == SENDER
                    && letter.outcome.is_none()
                    && letter.registration == key.registration)
                    .then_some(letter.place)
            }
            Some(custodian) if Self::at(state, custodian) == at => {
                let mut lane = state.custodians[custodian].held.iter();
                lane.find(|held| held.key == key).map(|held| held.place)
            }
            Some(_) => None,
        }
    }

    pub(crate) fn mark(uncertain: &mut bool, end: AttemptEnd) {
        *uncertain = rules::stays_uncertain(*uncertain, end);
    }

    /// Returns the meaning of an answer or a report to a service that holds the letter.
    pub(crate) fn effect_of(&self, message: Message, place: Place, handed: u8) -> Effect {
        let current = match place {
            Place::Out { transfer, .. } => Some(transfer.into()),
            _ => None,
        };
        let answers = matches!(place, Place::Out { to, transfer, .. }
            if to == message.from && transfer == message.transfer);
        let report = match message.what {
            What::Delivered => CustodyReport::Delivered,
            What::Failed { uncertain } | What::Returned { uncertain } => {
                CustodyReport::NotDelivered { uncertain }
            }
            _ if !answers => return Effect::Nothing,
            What::Accepted => return Effect::Delivered,
            What::OutOfOrder { last } => {
                let last = last.into();
                return Effect::Back(Cause::OutOfOrder { last }, AttemptEnd::NotTaken);
            }
            What::Busy => return Effect::Back(Cause::Busy, AttemptEnd::NotTaken),
            What::Refused => return Effect::Failed(AttemptEnd::NotTaken),
            What::Gone => return Effect::Moved,
            What::Copy { .. } | What::Predecessor { .. } => return Effect::Nothing,
        };
        let handed = handed & message.from.bit() != 0;
        let mut belief = rules::believe(handed, report, message.transfer.into(), current);
        if self.is(Mutant::BelieveAny) && handed {
            belief = Belief::Believed;
        }
        let end = match report {
            CustodyReport::NotDelivered { uncertain: true } => AttemptEnd::Unknown,
            _ => AttemptEnd::NotTaken,
        };
        match (belief, message.what) {
            (Belief::Ignored, _) => Effect::Nothing,
            (Belief::OnlyUncertain, _) => Effect::Doubt,
            (Belief::Believed, What::Delivered) => Effect::Delivered,
            (Belief::Believed, What::Failed { .. }) => Effect::Failed(end),
            (Belief::Believed, _) => Effect::Back(Cause::Returned, end),
        }
    }

    pub(crate) fn to_receiver(&self, state: &mut State, copy: Message) {
        let What::Copy { after } = copy.what else {
            return;
        };
        let Key {
            registration,
            sequence,
        } = copy.key;
        if registration == 0 && state.old_gone {
            return Self::reply(state, copy, What::Gone);
        }
        let bit = 1 << sequence;
        let taken = state.taken();
        let passed_over = state
            .open()
            .any(|(other, _)| other < sequence && taken & (1 << other) == 0);
        let receiver = &mut state.registrations[usize::from(registration)];
        let answer = match rules::offer(receiver.last.into(), sequence.into(), after.into()) {
            Offer::Take => {
                state.out_of_order |= receiver.taken >= bit;
                state.passed_over |= passed_over;
                receiver.last = sequence;
                receiver.taken |= bit;
                What::Accepted
            }
            Offer::Earlier if receiver.taken & bit != 0 => What::Accepted,
            Offer::Earlier => What::Refused,
            Offer::OutOfOrder => What::OutOfOrder {
                last: receiver.last,
            },
        };
        Self::reply(state, copy, answer);
    }

    /// Decides when a letter goes again that came back.
    pub(crate) fn again(&self, cause: Cause, sent: u8, after: u8) -> Again {
        match cause {
            Cause::Returned | Cause::OutOfOrder { .. } if self.is(Mutant::AgainAtOnce) => {
                Again::AtOnce
            }
            _ => rules::again(cause, sent.into(), after.into()),
        }
    }

    /// The lane of a service in [`State::lanes`]. The hostile custodian has none.
    pub(crate) fn lane(at: Service) -> Option<usize> {
        match at.custodian() {
            None => Some(0),
            Some(0) => Some(1),
            Some(_) => None,
        }
    }

    /// Pauses the lane of a service.
    pub(crate) fn pause(&self, state: &mut State, at: Service, (cause, key): (Cause, Key)) {
        if let Some(lane) = Self::lane(at).filter(|_| self.hostile) {
            let pause = match cause {
                Cause::Busy => PauseEnd::Credit,
                _ => PauseEnd::LowerPredecessor(key),
            };
            // Either of two pauses may be the longer one; this one ends early more often.
            let pause = state.lanes[lane]
                .pause
                .map_or(pause, |other| other.min(pause));
            state.lanes[lane].pause = Some(pause);
        }
    }

    /// Ends the pause of a lane that this event ends.
    pub(crate) fn end_pause(state: &mut State, at: Service, ends: impl Fn(PauseEnd) -> bool) {
        if let Some(lane) = Self::lane(at) {
            state.lanes[lane].pause.take_if(|pause| ends(*pause));
        }
    }

    /// Records that a letter has left the lane of a service.
    pub(crate) fn has_settled(&self, state: &mut State, at: Service, sequence: u8) {
        if let Some(lane) = Self::lane(at).filter(|_| self.hostile) {
            state.lanes[lane].has_settled = true;
            let is_behind = |pause| matches!(pause, PauseEnd::LowerPredecessor(key) if sequence <= key.sequence);
            Self::end_pause(state, at, is_behind);
        }
    }

    /// Handles a credit, which ends the pause after *busy*.
    pub(crate) fn credit(&self, state: &mut State, at: Service) {
        let Some(lane) = Self::lane(at) else { return };
        let has_settled = state.lanes[lane].has_settled;
        if rules::credit_counts(has_settled) || self.is(Mutant::CreditAlways) {
            Self::end_pause(state, at, |pause| pause == PauseEnd::Credit);
            state.lanes[lane].has_settled = false;
        }
    }

    /// Ends the pause of a lane because its time is over.
    pub(crate) fn pause_is_over(state: &mut State, at: Service) {
        Self::end_pause(state, at, |_| true);
        match at.custodian() {
            None => state.letters.iter_mut().for_each(|it| it.at_once = 0),
            Some(at) => {
                let held = state.custodians[at].held.iter_mut();
                held.for_each(|it| it.at_once = 0);
            }
        }
    }

    /// Answers of the hostile custodian to a copy: all after which the letter goes on.
    pub(crate) fn lies(&self) -> impl Iterator<Item = What> {
        let last = 0..=self.letters as u8;
        let returned = [false, true].map(|uncertain| What::Returned { uncertain });
        let orders = last.map(|last| What::OutOfOrder { last });
        orders.chain(returned).chain([What::Busy])
    }

    /// Ends an attempt or a custody without an answer or a report.
    pub(crate) fn give_up(&self, state: &mut State, at: Service, key: Key, end: AttemptEnd) {
        let (place, uncertain) = match at.custodian() {
            None => {
                let letter = &mut state.letters[usize::from(key.sequence) - 1];
                (&mut letter.place, &mut letter.uncertain)
            }
            Some(custodian) => {
                let Some(held) = Self::held(state, custodian, key) else {
                    return;
                };
                (&mut held.place, &mut held.uncertain)
            }
        };
        *place = Place::Ready;
        if !(self.is(Mutant::CertainLoss) && end == AttemptEnd::CustodianLost) {
            Self::mark(uncertain, end);
        }
    }

    pub(crate) fn die(&self, state: &mut State, custodian: usize, reports_lost: bool) {
        let dead = Self::at(state, custodian);
        state.custodians[custodian] = Custodian {
            life: dead.life + 1,
            held: Vec::new(),
        };
        state.network.retain(|message| {
            let copy = matches!(message.what, What::Copy { .. });
            message.to != dead && (message.from != dead || copy || !reports_lost)
        });
    }
}
