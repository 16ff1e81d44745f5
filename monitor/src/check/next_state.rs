//! The state of a party after a message, with the messages that every protocol allows: cancel,
//! not-understood and failure.
//!
//! This module does not change the party.

use crate::conversation::party::{EARLIER, Party, Side, World, Worlds, short, side_index};
use crate::conversation::state::{AFTER_NOT_UNDERSTOOD, CANCELLED, CANCELLING, FAILED};
use crate::protocol::act::{Act, ActNumber, CANCEL, FAILURE, INFORM, NOT_UNDERSTOOD};
use crate::protocol::index::StateId;
use crate::protocol::machine::{Cancel, Guard, Machine, Roles, Scope, State, Transition, step};
use crate::protocol::role::{MessageRoles, RoleSet};
use crate::verdict::ViolationKind as Kind;

/// A message with respect to one party of its conversation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PartyMessage<'a> {
    pub(crate) act: Act<'a>,
    pub(crate) side: Side,
    /// Roles that the sender may have.
    pub(crate) from: RoleSet,
    /// Roles that every receiver may have.
    pub(crate) to: RoleSet,
    pub(crate) reply_with: u64,
    pub(crate) in_reply_to: u64,
    /// Whether `in-reply-to` can be compared: the conversation has two participants.
    pub(crate) answers: bool,
    /// Whether the sender is the monitored agent, which has received all earlier messages.
    pub(crate) own: bool,
    /// Whether sender and receivers already take part.
    pub(crate) known: bool,
}

/// The state after a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct NextState {
    pub(crate) state: StateId,
    pub(crate) resume: StateId,
    pub(crate) echo: bool,
    /// Whether the message was sent before its sender had received the last one.
    pub(crate) crossed: bool,
    /// Whether the message answers one that another message has replaced. It is too late and changes
    /// nothing.
    pub(crate) void: bool,
    /// Roles of the sender and the receivers in the transition; empty for none.
    pub(crate) roles: MessageRoles,
    pub(crate) guard: Guard,
    /// The state in which the message fits, if it is not the present one.
    pub(crate) before: Option<StateId>,
    /// Whether the message shows that one reported as failed has arrived, or that it has not.
    pub(crate) world: Option<World>,
    /// Whether the message answers a cancel, and is no step of the protocol itself.
    pub(crate) answers_cancel: bool,
}

impl NextState {
    pub(crate) fn to(state: StateId) -> Self {
        Self {
            state,
            resume: state,
            echo: false,
            crossed: false,
            void: false,
            roles: MessageRoles::NONE,
            guard: Guard::default(),
            before: None,
            world: None,
            answers_cancel: false,
        }
    }

    /// A void message after one that was reported as failed: it does not show whether that one has arrived.
    fn void_in_failed(party: &Party) -> Self {
        Self {
            resume: party.resume,
            void: true,
            ..Self::to(FAILED)
        }
    }

    fn not_understood_in(state: StateId) -> Self {
        Self {
            resume: state,
            ..Self::to(AFTER_NOT_UNDERSTOOD)
        }
    }

    fn taking(step: &Transition) -> Self {
        let listed = |roles: &Roles| match roles.anyone {
            true => RoleSet::NONE,
            false => roles.mask,
        };
        Self {
            roles: MessageRoles {
                from: listed(&step.from),
                to: listed(&step.to),
            },
            guard: step.guard,
            ..Self::to(step.target)
        }
    }
}

/// Returns the state after a message, or the kind of violation.
#[inline]
pub(crate) fn next_state(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    match party.state {
        AFTER_NOT_UNDERSTOOD | CANCELLING | CANCELLED | FAILED => {
            after_common_step(machine, party, message)
        }
        _ if party.echo => after_common_step(machine, party, message),
        own => in_state(machine, party, own, message),
    }
}

/// Returns the state after a message that follows a cancel, a not-understood or a failure.
fn after_common_step(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    match party.state {
        CANCELLING => while_cancelling(machine, party, message),
        CANCELLED if party.echo && message.side != party.canceling_side => {
            after_crossing(machine, party, message)
        }
        // The side that canceled has not understood a message that crossed the cancel, and has not received
        // the answer to the cancel yet.
        CANCELLED
            if message.act == NOT_UNDERSTOOD
                && message.side == party.canceling_side
                && message.side != party.last
                && answers_protocol(party, message)
                && !message.own =>
        {
            Ok(NextState {
                resume: party.resume,
                echo: party.echo,
                void: true,
                ..NextState::to(CANCELLED)
            })
        }
        CANCELLED => Err(ended(party, message)),
        AFTER_NOT_UNDERSTOOD => after_not_understood(machine, party, message),
        // A message that was reported as failed may have arrived, or is sent again.
        FAILED if let Some(worlds) = party.worlds() => in_worlds(machine, party, worlds, message),
        FAILED => {
            let in_state = |state| {
                let taken = in_state(machine, party, state, message)?;
                Ok(NextState {
                    before: Some(state),
                    ..taken
                })
            };
            // If the last message did not arrive, the protocol has not ended, and can be canceled.
            let over = machine.state(party.resume).is_some_and(State::is_over);
            let (first, second) = match message.act == CANCEL && over {
                true => (party.before, party.resume),
                false => (party.resume, party.before),
            };
            let taken = in_state(first);
            // A message that is void after the undelivered one did not cross it, if that one did not
            // arrive. It then counts in the state before.
            match (&taken, in_state(second)) {
                (Ok(void), Ok(other)) if void.void && !other.void => Ok(other),
                (Ok(void), Ok(_)) if void.void => Ok(NextState::void_in_failed(party)),
                (Err(_), Ok(other)) => Ok(other),
                _ => taken,
            }
        }
        // The message that counted as the failure of a cancel was a failure of the protocol.
        own if party.echo
            && message.side != party.canceling_side
            && is_told_apart(party, message)
            && message.in_reply_to == party.cancel()
            && is_cancel_answer(message) =>
        {
            Ok(NextState {
                answers_cancel: true,
                ..match message.act {
                    INFORM => NextState::to(CANCELLED),
                    FAILURE => NextState::to(own),
                    _ => NextState::not_understood_in(own),
                }
            })
        }
        own => in_state(machine, party, own, message),
    }
}

/// Returns the state after a message that follows one which was not delivered, or of which that is
/// uncertain.
fn in_worlds(
    machine: &Machine,
    party: &Party,
    worlds: &Worlds,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let in_world = |world| {
        let party = match world {
            World::Missing => &worlds.missing,
            World::Arrived => &worlds.arrived,
        };
        let taken = next_state(machine, party, message)?;
        Ok(NextState {
            world: Some(world),
            ..taken
        })
    };
    let taken = in_world(World::Missing);
    let arrived = in_world(World::Arrived);
    match (&taken, arrived) {
        (Ok(void), Ok(other)) if void.void && !other.void => Ok(other),
        (Ok(void), Ok(_)) if void.void => Ok(NextState::void_in_failed(party)),
        (Err(_), Ok(other)) => Ok(other),
        _ => taken,
    }
}

fn is_cancel_answer(message: &PartyMessage<'_>) -> bool {
    [INFORM, FAILURE, NOT_UNDERSTOOD].contains(&message.act)
}

/// Whether a message names the last message of the other side that is a step of the protocol.
fn answers_protocol(party: &Party, message: &PartyMessage<'_>) -> bool {
    let asked = party.asked[side_index(message.side.opposite())];
    message.in_reply_to != 0 && message.in_reply_to == asked
}

/// Whether `in-reply-to` distinguishes the answer to a cancel from other messages.
fn is_told_apart(party: &Party, message: &PartyMessage<'_>) -> bool {
    message.in_reply_to != 0 && party.cancel() != 0
}

/// Returns the state after a message that follows a not-understood. One that was sent before the
/// not-understood arrived changes nothing. A cancel that has crossed it is answered nevertheless.
fn after_not_understood(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let crossing = match !message.own && message.side != party.last {
        true => in_state(machine, party, party.resume, message),
        false => Err(ended(party, message)),
    };
    let told_apart = is_told_apart(party, message);
    let answers = party.echo
        && message.side != party.canceling_side
        && is_cancel_answer(message)
        && (!told_apart || message.in_reply_to == party.cancel());
    let after = NextState::to(AFTER_NOT_UNDERSTOOD);
    match crossing {
        crossing if answers => Ok(NextState {
            resume: party.resume,
            echo: !told_apart && crossing.is_ok(),
            answers_cancel: true,
            ..after
        }),
        Ok(NextState { state, .. }) => Ok(NextState {
            resume: machine.state(state).map_or(party.resume, |_| state),
            echo: party.echo || state == CANCELLING,
            void: true,
            ..after
        }),
        Err(_) => Err(ended(party, message)),
    }
}

/// Returns the state after a message of the canceled side. The message that was taken for the answer to
/// the cancel may have crossed it, and so may this one.
fn after_crossing(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let told_apart = is_told_apart(party, message);
    let answers =
        is_cancel_answer(message) && (!told_apart || message.in_reply_to == party.cancel());
    let crossing = in_state(machine, party, party.resume, message);
    match (message.act, crossing) {
        // The cancel failed, so the conversation continues. If this is a failure of the protocol
        // itself, the answer to the cancel fits too.
        (FAILURE, crossing) if answers => Ok(NextState {
            echo: !told_apart && crossing.is_ok(),
            answers_cancel: true,
            ..NextState::to(party.resume)
        }),
        (_, Ok(next_state)) if !(told_apart && answers) => Ok(match next_state.state {
            AFTER_NOT_UNDERSTOOD => next_state,
            state => NextState {
                resume: match state {
                    // Two cancels crossed, or a failure crossed one.
                    CANCELLING | FAILED => party.resume,
                    own => own,
                },
                echo: true,
                ..NextState::to(CANCELLED)
            },
        }),
        _ if answers => Ok(NextState {
            answers_cancel: true,
            ..NextState::to(CANCELLED)
        }),
        _ => Err(ended(party, message)),
    }
}

fn ended(party: &Party, message: &PartyMessage<'_>) -> Kind {
    if is_repeated(party, message) {
        Kind::Repeated
    } else {
        Kind::Ended
    }
}

fn while_cancelling(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let group = machine.scope == Scope::Conversation;
    if message.side == party.canceling_side && !group {
        return match message.act {
            // The cancel is still to be answered.
            NOT_UNDERSTOOD => Ok(NextState {
                echo: true,
                ..NextState::not_understood_in(party.resume)
            }),
            _ if is_repeated(party, message) => Err(Kind::Repeated),
            _ => Err(Kind::Unexpected),
        };
    }
    let told_apart = is_told_apart(party, message);
    let answers = !told_apart || message.in_reply_to == party.cancel();
    let crossing = in_state(machine, party, party.resume, message);
    if answers && is_cancel_answer(message) {
        let next_state = match message.act {
            INFORM => match crossing {
                Ok(crossing) if !told_apart => NextState {
                    resume: crossing.state,
                    echo: true,
                    ..NextState::to(CANCELLED)
                },
                _ => NextState::to(CANCELLED),
            },
            // The cancel failed, and the conversation continues.
            FAILURE => NextState {
                echo: !told_apart && crossing.is_ok(),
                ..NextState::to(party.resume)
            },
            _ => NextState {
                echo: !told_apart && crossing.is_ok(),
                ..NextState::not_understood_in(party.resume)
            },
        };
        return Ok(NextState {
            answers_cancel: true,
            ..next_state
        });
    }
    // If the cancel fails, the conversation continues in the state after the crossing message.
    crossing.map(|next_state| match next_state.state {
        // The answer to the cancel follows.
        AFTER_NOT_UNDERSTOOD => NextState {
            echo: true,
            ..next_state
        },
        _ => NextState {
            state: CANCELLING,
            crossed: true,
            guard: Guard::default(),
            ..next_state
        },
    })
}

/// Returns the state after a message in one of the protocol's own states.
fn in_state(
    machine: &Machine,
    party: &Party,
    state: StateId,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let Some(current) = machine.state(state) else {
        return Err(Kind::Unexpected);
    };
    let Some(step) = step(&current.steps, message.act, message.from, message.to) else {
        return without_step(machine, party, state, message);
    };
    Ok(match in_reply(party, message)? {
        Reply::ToLast => NextState::taking(step),
        Reply::ToEarlier => NextState {
            void: true,
            ..NextState::to(state)
        },
    })
}

/// Returns the state after a message for which one of the protocol's own states has no transition.
fn without_step(
    machine: &Machine,
    party: &Party,
    state: StateId,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let embedded = machine.state(state).map(|current| current.embedded.iter());
    let proxied = embedded.into_iter().flatten().any(|sub| {
        let to = sub.proxied_to.as_ref();
        sub.from.includes(message.from) && to.is_some_and(|to| to.includes(message.to))
    });
    if proxied {
        return Ok(NextState::to(state));
    }
    if let Some(next_state) = by_default(machine, party, state, message) {
        return Ok(next_state);
    }
    if has_crossed(machine, party, state, message) {
        return Ok(NextState {
            void: true,
            ..NextState::to(state)
        });
    }
    Err(wrong(machine, party, state, message))
}

/// Whether a message that does not fit the state was sent before its sender had received the last
/// messages of the other side, as a bid that arrives after the end of an auction. It changes nothing.
fn has_crossed(
    machine: &Machine,
    party: &Party,
    state: StateId,
    message: &PartyMessage<'_>,
) -> bool {
    if message.own || !message.answers {
        return false;
    }
    let fits = |state: &State| step(&state.steps, message.act, message.from, message.to).is_some();
    let other = side_index(message.side.opposite());
    match message.in_reply_to {
        // Without `in-reply-to`, only one message of the other side may have crossed it. A timeout
        // does not cross messages.
        0 => {
            let before = machine.state(party.before).filter(|before| fits(before));
            let mut led = before.into_iter().flat_map(|before| &before.steps);
            party.last != message.side
                && led.any(|step| step.target == state && step.from.includes(message.to))
        }
        answered => {
            answered != party.asked[other]
                && may_have_asked(party.earlier(other), answered)
                && machine.states.iter().any(fits)
        }
    }
}

/// Returns the state after a message that every protocol allows, as in figure 6 of the paper about
/// fipa_acl.
fn by_default(
    machine: &Machine,
    party: &Party,
    state: StateId,
    message: &PartyMessage<'_>,
) -> Option<NextState> {
    if party.is_fresh() || !message.known {
        return None;
    }
    let current = machine.state(state)?;
    let has_ended = current.is_final;
    // The receiver of the last message may not have understood it. Its sender cannot send
    // `not-understood`.
    let answers_last = party.last != message.side;
    match message.act {
        NOT_UNDERSTOOD => {
            // It may have crossed the message that ended the protocol, if others can still follow.
            let ended_by = party.acts[side_index(message.side.opposite())];
            let ended_by = ended_by.and_then(ActNumber::standard);
            let ends = |step: &Transition| {
                step.target == state
                    && step.from.includes(message.to)
                    && ended_by.is_some_and(|act| step.acts.contains(act))
            };
            let has_crossed = !message.own
                && !current.is_over()
                && machine.states.iter().flat_map(|it| &it.steps).any(ends);
            let may = !has_ended || answers_last || has_crossed;
            may.then(|| NextState::not_understood_in(state))
        }
        CANCEL => {
            let may = match machine.cancel {
                Cancel::Initiator => message.side == Side::Initiator,
                Cancel::Anyone => true,
                Cancel::Nobody => false,
            };
            // After the end, a cancel is allowed only if its sender may not have received the last
            // message.
            let too_late = current.is_over() && (message.own || !answers_last);
            (may && !too_late).then_some(NextState {
                resume: state,
                ..NextState::to(CANCELLING)
            })
        }
        FAILURE if machine.failure_by_parties => (!has_ended).then_some(NextState {
            resume: state,
            ..NextState::to(FAILED)
        }),
        _ => None,
    }
}

/// Whether a side may have sent this `reply-with` before its last one. Beyond the bound, the monitor does
/// not know.
fn may_have_asked(earlier: &[u32; EARLIER], reply_with: u64) -> bool {
    earlier.contains(&short(reply_with)) || earlier[EARLIER - 1] != 0
}

/// The message that a message answers.
enum Reply {
    /// The last message of the other side, or unspecified.
    ToLast,
    /// A message before the last one. The answer and the later messages have crossed, as a bid and
    /// the next calls of an auction may.
    ToEarlier,
}

fn in_reply(party: &Party, message: &PartyMessage<'_>) -> Result<Reply, Kind> {
    let other = side_index(message.side.opposite());
    let asked = party.asked[other];
    let earlier = || party.earlier(other);
    // A message that crossed the `not-understood` answers the message before it.
    let is_crossing = || {
        let [before, ..] = earlier();
        party.state == AFTER_NOT_UNDERSTOOD && short(message.in_reply_to) == *before
    };
    if !message.answers || [0, asked].contains(&message.in_reply_to) || asked == 0 || is_crossing()
    {
        Ok(Reply::ToLast)
    } else if may_have_asked(earlier(), message.in_reply_to) && !message.own {
        Ok(Reply::ToEarlier)
    } else {
        Err(Kind::WrongReply)
    }
}

fn is_repeated(party: &Party, message: &PartyMessage<'_>) -> bool {
    let index = side_index(message.side);
    let same_act = party.acts[index] == Some(ActNumber::of(message.act));
    same_act && message.reply_with != 0 && party.asked[index] == message.reply_with
}

fn wrong(machine: &Machine, party: &Party, state: StateId, message: &PartyMessage<'_>) -> Kind {
    if is_repeated(party, message) {
        return Kind::Repeated;
    }
    let Some(current) = machine.state(state) else {
        return Kind::Unexpected;
    };
    if current.is_over() {
        return Kind::Ended;
    }
    if step(&current.steps, message.act, message.to, message.from).is_some() {
        return Kind::WrongSender;
    }
    // Checks whether a later state allows the message.
    let mut reached = vec![false; machine.states.len()];
    let mut next = vec![state];
    while let Some(id) = next.pop() {
        let fresh = reached.get_mut(id.index()).filter(|seen| !**seen);
        let Some((seen, later)) = fresh.zip(machine.state(id)) else {
            continue;
        };
        *seen = true;
        if step(&later.steps, message.act, message.from, message.to).is_some() {
            return Kind::OutOfOrder;
        }
        next.extend(later.transitions.iter().map(|step| step.target));
    }
    Kind::Unexpected
}
