//! The steps of the model: every step that a service or the network can take, each decided by
//! the functions of [`fipa_mts::core::rules`].

use fipa_mts::core::rules::AttemptEnd;
use stateright::{Model, Property};

use crate::state::{
    CUSTODIANS, Custodian, Key, LIVES, MAX_LETTERS, Message, Outcome, PauseEnd, Place, SENDER,
    Service, State, What,
};

/// Arrangement of the two custodians between the sender and the receiver.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Topology {
    /// One behind the other.
    Chain,
    /// Side by side, as two routes.
    Routes,
    /// One behind the other; the second can also be reached directly.
    Shortcut,
    /// The first custodian, and a route that leads to the receiver directly.
    Direct,
}

impl Topology {
    /// The nodes that a node hands letters to.
    pub(crate) fn next(self, node: u8) -> &'static [u8] {
        match (self, node) {
            (Self::Chain, 0) => &[1],
            (Self::Chain | Self::Shortcut, 1) => &[2],
            (Self::Routes | Self::Shortcut, 0) => &[1, 2],
            (Self::Direct, 0) => &[1, 3],
            _ => &[3],
        }
    }
}

/// A change that breaks the protocol. The model has to find each.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mutant {
    /// Rule 3: every copy carries `after = 0`.
    NoPredecessor,
    /// Rule 9: a full lane answers *busy* to every letter that it does not hold.
    FullForAll,
    /// Rule 11: a custodian never returns a letter.
    NeverReturn,
    /// Rule 12: a custodian does not report that an attempt ended unconfirmed.
    CertainReturn,
    /// Rule 12: a custodian ignores the uncertainty that the custodian behind it reported.
    CertainBehind,
    /// Rule 13: at the sender's process, the latest return replaces the uncertainty noted before.
    ForgetUncertain,
    /// Rule 15: uncertain letters move to the new registration, too.
    MoveUncertain,
    /// Rule 16: letters for the new registration do not wait for those for the old one.
    NoWaitForOld,
    /// Rule 17: reports are believed even if they name another transfer.
    BelieveAny,
    /// Rule 18: the loss of a custodian leaves its letters certain.
    CertainLoss,
    /// Rule 21: a custodian lowers `after` past a letter that it returned.
    LowerPastReturned,
    /// A note of a lower predecessor ignores open letters that have moved to another stream.
    NoteByStream,
    /// A letter that was returned or out of order goes again at once.
    AgainAtOnce,
    /// Each credit ends a pause.
    CreditAlways,
}

/// Kinds of faults. Each fault takes one of [`State::faults_left`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Fault {
    /// A frame, an answer or a note is lost.
    Loss,
    /// An attempt times out; its frame and its answer may still arrive.
    Late,
    /// An attempt ends, and the transport certifies that its frame was not sent.
    NotSent,
    /// A report or a note arrives twice.
    Duplicate,
    /// A custodian or the receiver refuses a copy for good.
    Refusal,
    /// The deadline of a letter ends at the sender's process.
    Expiry,
    /// The deadline of a letter ends at a custodian.
    EarlyExpiry,
    /// A custodian returns a letter because it is about to end.
    Closing,
    /// A custodian dies. Another starts at once.
    Death,
}

pub(crate) const ALL_FAULTS: [Fault; 9] = [
    Fault::Loss,
    Fault::Late,
    Fault::NotSent,
    Fault::Duplicate,
    Fault::Refusal,
    Fault::Expiry,
    Fault::EarlyExpiry,
    Fault::Closing,
    Fault::Death,
];

/// A configuration of the model.
#[derive(Debug, Clone)]
pub(crate) struct Protocol {
    pub(crate) topology: Topology,
    pub(crate) letters: usize,
    /// Number of faults that a run may have.
    pub(crate) faults: u8,
    /// Kinds of faults that a run may have.
    pub(crate) kinds: &'static [Fault],
    /// Whether the receiver is registered again once.
    pub(crate) moves: bool,
    /// Letters that fit into the lanes of a custodian.
    pub(crate) capacity: usize,
    /// Letters of the sender that may be in transit at once.
    pub(crate) window: usize,
    /// Whether notes of a lower predecessor are sent.
    pub(crate) notes: bool,
    /// Whether each service dispatches the letters of a stream in order (rules 9 and 13).
    pub(crate) in_order: bool,
    /// Whether the second custodian is hostile: it answers each copy in any way after which the letter
    /// goes on, and sends credits at any time. Lanes pause then.
    pub(crate) hostile: bool,
    pub(crate) mutant: Option<Mutant>,
}

/// One step.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) enum Action {
    /// The sender's process hands a letter over.
    Send { sequence: u8, to: u8 },
    /// A custodian hands a letter over.
    Pass { custodian: usize, key: Key, to: u8 },
    /// A message arrives.
    Arrive(Message),
    /// A report or note arrives; a second one is in transit.
    ArriveTwice(Message),
    /// A message is lost.
    Lose(Message),
    /// A copy arrives and is refused for good.
    Refuse(Message),
    /// A premature timeout: the attempt is concluded as unconfirmed.
    TimeOut { at: Service, key: Key },
    /// The transport certifies that the frame of the attempt has not left.
    NotSent(Message),
    /// The attempt times out; nothing of it is left in transit.
    GiveUp { at: Service, key: Key },
    /// The service notices that the custodian it handed the letter to has died.
    NoticeDeath { at: Service, key: Key },
    /// The predecessor of a letter has not arrived within the timeout of the custodian.
    LoseTimeout { custodian: usize, key: Key },
    /// The letter's deadline ends at the sender's process.
    Expire { sequence: u8 },
    /// The letter's deadline ends at a custodian.
    ExpireEarly { custodian: usize, key: Key },
    /// A custodian that is about to end returns the letter.
    ReturnEarly { custodian: usize, key: Key },
    /// A custodian dies; its reports that are in transit are lost with it or not.
    Die {
        custodian: usize,
        reports_lost: bool,
    },
    /// The receiver is registered again. The old registration may still take letters.
    Register,
    /// The old registration ends.
    EndOld,
    /// The sender's directory shows the new registration.
    Learn,
    /// Nothing was heard of a letter for the registration that has ended.
    ConcludeOld { sequence: u8 },
    /// The hostile custodian answers a copy.
    Lie { copy: Message, what: What },
    /// The hostile custodian sends a credit.
    Credit { to: Service },
    /// The pause of a lane is over.
    PauseIsOver { at: Service },
}

impl Action {
    /// Whether the step is a fault, or another event that the protocol may not wait for.
    pub(crate) fn is_fault(&self) -> bool {
        matches!(
            self,
            Self::ArriveTwice(_)
                | Self::Lose(_)
                | Self::Refuse(_)
                | Self::TimeOut { .. }
                | Self::NotSent(_)
                | Self::Expire { .. }
                | Self::ExpireEarly { .. }
                | Self::ReturnEarly { .. }
                | Self::Die { .. }
                | Self::Register
                | Self::EndOld
                | Self::Lie { .. }
                | Self::Credit { .. }
        )
    }

    /// Whether the step takes one of the faults that a run may have.
    fn is_counted(&self) -> bool {
        let is_free = matches!(
            self,
            Self::Register | Self::EndOld | Self::Lie { .. } | Self::Credit { .. }
        );
        self.is_fault() && !is_free
    }

    /// Returns the step without the numbers that rise at each repetition. A fair run takes a step
    /// of each class that stays possible.
    pub(crate) fn class(&self) -> Self {
        match *self {
            Self::Arrive(message) => {
                let what = match message.what {
                    What::Copy { .. } => What::Copy { after: 0 },
                    What::OutOfOrder { .. } => What::OutOfOrder { last: 0 },
                    What::Predecessor { .. } => What::Predecessor { after: 0 },
                    other => other,
                };
                Self::Arrive(Message {
                    transfer: 0,
                    what,
                    ..message
                })
            }
            other => other,
        }
    }
}

impl Protocol {
    /// Counts a hand-over with a hostile custodian, as far as the bound needs it.
    fn counted(&self, at_once: u8) -> u8 {
        match self.hostile {
            true => at_once.saturating_add(1),
            false => 0,
        }
    }

    pub(crate) fn is(&self, mutant: Mutant) -> bool {
        self.mutant == Some(mutant)
    }

    fn allows(&self, state: &State, fault: Fault) -> bool {
        state.faults_left > 0 && self.kinds.contains(&fault)
    }

    /// Whether every letter has an outcome.
    pub(crate) fn is_done(state: &State) -> bool {
        state.open().next().is_none()
    }

    /// Steps that follow from a letter having been handed over.
    fn out_actions(
        &self,
        state: &State,
        at: Service,
        key: Key,
        place: Place,
        actions: &mut Vec<Action>,
    ) {
        let Place::Out { to, transfer, .. } = place else {
            return;
        };
        if let Some(custodian) = to.custodian()
            && state.custodians[custodian].life != to.life
        {
            actions.push(Action::NoticeDeath { at, key });
            return;
        }
        let under_way = state.network.iter().any(|message| {
            message.key == key
                && message.transfer == transfer
                && match message.what {
                    What::Copy { .. } => message.from == at && message.to == to,
                    What::Predecessor { .. } => false,
                    _ => message.to == at && message.from == to,
                }
        });
        let in_custody = to.custodian().is_some_and(|custodian| {
            state.custodians[custodian]
                .held
                .iter()
                .any(|held| held.key == key && held.upstream[at.slot()] == transfer)
        });
        if !under_way && !in_custody {
            actions.push(Action::GiveUp { at, key });
        } else if self.allows(state, Fault::Late) {
            actions.push(Action::TimeOut { at, key });
        }
    }

    /// Whether this is the hostile custodian.
    fn is_hostile(&self, service: Service) -> bool {
        self.hostile && service.custodian() == Some(1)
    }

    fn message_actions(&self, state: &State, message: Message, actions: &mut Vec<Action>) {
        if self.is_hostile(message.to) && matches!(message.what, What::Copy { .. }) {
            let copy = message;
            return actions.extend(self.lies().map(|what| Action::Lie { copy, what }));
        }
        actions.push(Action::Arrive(message));
        let (copy, note, report) = match message.what {
            What::Copy { .. } => (true, false, false),
            What::Predecessor { .. } => (false, true, false),
            What::Delivered | What::Failed { .. } | What::Returned { .. } => (false, false, true),
            _ => (false, false, false),
        };
        if !report && self.allows(state, Fault::Loss) {
            actions.push(Action::Lose(message));
        }
        if (note || report) && self.allows(state, Fault::Duplicate) {
            actions.push(Action::ArriveTwice(message));
        }
        if copy && self.allows(state, Fault::Refusal) {
            actions.push(Action::Refuse(message));
        }
        if copy && self.allows(state, Fault::NotSent) && self.attempt_of(state, message) {
            actions.push(Action::NotSent(message));
        }
    }

    /// Whether this copy is of an attempt that is not concluded.
    fn attempt_of(&self, state: &State, copy: Message) -> bool {
        let place = Self::place_of(state, copy.from, copy.key);
        matches!(place, Some(Place::Out { to, transfer, .. })
            if to == copy.to && transfer == copy.transfer)
    }
}

impl Model for Protocol {
    type State = State;
    type Action = Action;

    fn init_states(&self) -> Vec<State> {
        vec![State::new(self.letters, self.faults)]
    }

    fn actions(&self, state: &State, actions: &mut Vec<Action>) {
        for (sequence, letter) in state.open() {
            let key = Key {
                registration: letter.registration,
                sequence,
            };
            if self.may_send(state, sequence) {
                for to in self.topology.next(SENDER.node) {
                    actions.push(Action::Send { sequence, to: *to });
                }
            }
            self.out_actions(state, SENDER, key, letter.place, actions);
            if self.allows(state, Fault::Expiry) {
                actions.push(Action::Expire { sequence });
            }
            if state.new_known && letter.registration == 0 {
                actions.push(Action::ConcludeOld { sequence });
            }
        }
        for (custodian, Custodian { life, held: lane }) in state.custodians.iter().enumerate() {
            let node = CUSTODIANS[custodian];
            let at = Service { node, life: *life };
            for held in lane {
                let key = held.key;
                let first = lane
                    .iter()
                    .filter(|other| other.key.registration == key.registration)
                    .find(|other| other.place == Place::Ready);
                let pauses = Self::lane(at).is_some_and(|lane| state.lanes[lane].pause.is_some());
                if first.is_some_and(|first| first.key == key || !self.in_order)
                    && held.place == Place::Ready
                    && !pauses
                {
                    for to in self.topology.next(node) {
                        actions.push(Action::Pass {
                            custodian,
                            key,
                            to: *to,
                        });
                    }
                }
                if held.place == Place::Blocked
                    && !Self::holds(state, custodian, key.registration, held.after)
                {
                    actions.push(Action::LoseTimeout { custodian, key });
                }
                self.out_actions(state, at, key, held.place, actions);
                if self.allows(state, Fault::EarlyExpiry) {
                    actions.push(Action::ExpireEarly { custodian, key });
                }
                if self.allows(state, Fault::Closing) {
                    actions.push(Action::ReturnEarly { custodian, key });
                }
            }
            if *life + 1 < LIVES && self.allows(state, Fault::Death) {
                let reports = state.network.iter().any(|message| {
                    message.from == at && !matches!(message.what, What::Copy { .. })
                });
                actions.push(Action::Die {
                    custodian,
                    reports_lost: true,
                });
                if reports {
                    actions.push(Action::Die {
                        custodian,
                        reports_lost: false,
                    });
                }
            }
        }
        let mut previous = None;
        for message in &state.network {
            if previous.replace(message) != Some(message) {
                self.message_actions(state, *message, actions);
            }
        }
        for at in [SENDER, Self::at(state, 0)] {
            let pause = Self::lane(at).and_then(|lane| state.lanes[lane].pause);
            if pause.is_some() {
                actions.push(Action::PauseIsOver { at });
            }
            if pause == Some(PauseEnd::Credit) {
                actions.push(Action::Credit { to: at });
            }
        }
        if self.moves && !state.registered_anew {
            actions.push(Action::Register);
        }
        if state.registered_anew && !state.old_gone {
            actions.push(Action::EndOld);
        }
        if state.registered_anew && !state.new_known {
            actions.push(Action::Learn);
        }
    }

    fn next_state(&self, before: &State, action: Action) -> Option<State> {
        let mut next = before.clone();
        let state = &mut next;
        if action.is_counted() {
            state.faults_left -= 1;
        }
        match action {
            Action::Send { sequence, to } => {
                let to = Self::service(state, to);
                let after = self.predecessor(state, sequence);
                let transfer = Self::next_transfer(state, SENDER, sequence);
                let letter = &mut state.letters[usize::from(sequence) - 1];
                letter.handed |= to.bit();
                letter.at_once = self.counted(letter.at_once);
                letter.place = Place::Out {
                    to,
                    transfer,
                    sent: after,
                    after,
                };
                let key = Key {
                    registration: letter.registration,
                    sequence,
                };
                let copy = Message {
                    from: SENDER,
                    to,
                    key,
                    transfer,
                    what: What::Copy { after },
                };
                Self::send(state, copy);
            }
            Action::Pass { custodian, key, to } => {
                let from = Self::at(state, custodian);
                let to = Self::service(state, to);
                let transfer = Self::next_transfer(state, from, key.sequence);
                let held = Self::held(state, custodian, key)?;
                held.handed |= to.bit();
                held.at_once = self.counted(held.at_once);
                let after = held.after;
                held.place = Place::Out {
                    to,
                    transfer,
                    sent: after,
                    after,
                };
                let copy = Message {
                    from,
                    to,
                    key,
                    transfer,
                    what: What::Copy { after },
                };
                Self::send(state, copy);
            }
            Action::Arrive(message) | Action::ArriveTwice(message) => {
                if matches!(action, Action::Arrive(_)) {
                    Self::remove(state, message);
                }
                match message.to.custodian() {
                    Some(custodian) => self.to_custodian(state, custodian, message),
                    None if message.to == SENDER => self.to_sender(state, message),
                    None => self.to_receiver(state, message),
                }
            }
            Action::Lose(message) => Self::remove(state, message),
            Action::Refuse(message) => {
                Self::remove(state, message);
                Self::reply(state, message, What::Refused);
            }
            Action::TimeOut { at, key } | Action::GiveUp { at, key } => {
                self.give_up(state, at, key, AttemptEnd::Unknown);
            }
            Action::NotSent(message) => {
                Self::remove(state, message);
                self.give_up(state, message.from, message.key, AttemptEnd::NotTaken);
            }
            Action::NoticeDeath { at, key } => {
                self.give_up(state, at, key, AttemptEnd::CustodianLost);
            }
            Action::LoseTimeout { custodian, key } => self.hold(state, custodian, key),
            Action::Expire { sequence } => {
                let letter = &mut state.letters[usize::from(sequence) - 1];
                letter.uncertain |= matches!(letter.place, Place::Out { .. });
                self.fail(state, sequence);
            }
            Action::ExpireEarly { custodian, key } => {
                let held = Self::held(state, custodian, key)?;
                held.uncertain |= matches!(held.place, Place::Out { .. });
                self.leave(state, custodian, key, |uncertain| What::Failed {
                    uncertain,
                });
            }
            Action::ReturnEarly { custodian, key } => {
                let held = Self::held(state, custodian, key)?;
                held.uncertain |= matches!(held.place, Place::Out { .. });
                self.leave(state, custodian, key, |uncertain| What::Returned {
                    uncertain,
                });
            }
            Action::Die {
                custodian,
                reports_lost,
            } => self.die(state, custodian, reports_lost),
            Action::Register => state.registered_anew = true,
            Action::EndOld => state.old_gone = true,
            Action::Learn => state.new_known = true,
            Action::ConcludeOld { sequence } => {
                self.conclude(state, sequence, Outcome::Unconfirmed);
            }
            Action::Lie { copy, what } => {
                Self::remove(state, copy);
                Self::reply(state, copy, what);
            }
            Action::Credit { to } => self.credit(state, to),
            Action::PauseIsOver { at } => Self::pause_is_over(state, at),
        }
        self.move_letters(state);
        Self::forget(state);
        Self::renumber(state);
        Some(next)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::always("in order", |_, state: &State| !state.out_of_order),
            Property::always("at most once", |_, state: &State| {
                state.registrations[0].taken & state.registrations[1].taken == 0
            }),
            Property::always("no false delivered", |model: &Self, state: &State| {
                model.all(state, Outcome::Delivered, |taken| taken)
            }),
            Property::always(
                "no certain failure of a taken letter",
                |model: &Self, state| model.all(state, Outcome::Failed, |taken| !taken),
            ),
            Property::always(
                "nothing but delivered without faults",
                |model: &Self, state| {
                    (model.faults > 0 || model.moves)
                        || (model.all(state, Outcome::Failed, |_| false)
                            && model.all(state, Outcome::Unconfirmed, |_| false))
                },
            ),
            Property::always("no open letter is passed over", |_, state: &State| {
                !state.passed_over
            }),
            // The first time, once for each letter before it, which lowers its predecessor, and once for a
            // credit at first and after each letter that is settled.
            Property::always(
                "no repetitions without a pause",
                |model: &Self, state: &State| {
                    let sent = state.letters.iter().map(|letter| letter.at_once);
                    let passed = state.custodians.iter().flat_map(|it| &it.held);
                    let mut all = sent.chain(passed.map(|held| held.at_once));
                    all.all(|at_once| usize::from(at_once) <= 2 * model.letters)
                },
            ),
        ]
    }
}

impl Protocol {
    /// Whether this holds for all letters with this outcome.
    fn all(&self, state: &State, outcome: Outcome, holds: fn(bool) -> bool) -> bool {
        (1..=MAX_LETTERS as u8)
            .zip(&state.letters)
            .take(self.letters)
            .filter(|(_, letter)| letter.outcome == Some(outcome))
            .all(|(sequence, _)| holds(state.taken() & (1 << sequence) != 0))
    }
}
