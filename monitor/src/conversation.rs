//! The state of one conversation, and the state transitions of its parties.
//!
//! With [`Scope::Participant`], each participant has a [`Party`] with a state of its own. With
//! [`Scope::Conversation`], there is one party without a participant, and a list of role bindings.

use smallvec::SmallVec;

use crate::act::{Act, CANCEL, FAILURE, INFORM, NOT_UNDERSTOOD};
use crate::machine::{Cancel, Machine, Roles, Scope, Transition, step};
use crate::names::{Name, Names};
use crate::verdict::ViolationKind as Kind;

/// The absence of a name or an index.
pub(crate) const NONE: u32 = u32::MAX;

/// State of every protocol after `not-understood`.
pub(crate) const AFTER_NOT_UNDERSTOOD: u16 = u16::MAX;
/// State of every protocol after `cancel`, before the answer to it.
pub(crate) const CANCELLING: u16 = u16::MAX - 1;
/// State of every protocol after the answer `inform` to a `cancel`.
pub(crate) const CANCELLED: u16 = u16::MAX - 2;
/// State of every protocol after the message transport service reported a failure.
pub(crate) const FAILED: u16 = u16::MAX - 3;
/// State that the monitor does not know: see [`crate::delegated`].
pub(crate) const ELSEWHERE: u16 = u16::MAX - 4;

/// Returns the name of a state.
pub(crate) fn state_name(machine: &Machine, state: u16) -> &str {
    match state {
        AFTER_NOT_UNDERSTOOD => "not-understood",
        CANCELLING => "cancelling",
        CANCELLED => "cancelled",
        FAILED => "undelivered",
        ELSEWHERE => "elsewhere",
        own => machine.state(own).map_or("", |state| state.id()),
    }
}

pub(crate) fn is_final(machine: &Machine, state: u16) -> bool {
    match state {
        AFTER_NOT_UNDERSTOOD | CANCELLED | FAILED => true,
        CANCELLING => false,
        own => machine.state(own).is_some_and(|state| state.is_final()),
    }
}

/// Whether no further message can follow.
pub(crate) fn is_over(machine: &Machine, state: u16) -> bool {
    match state {
        AFTER_NOT_UNDERSTOOD | CANCELLED | FAILED => true,
        CANCELLING => false,
        own => machine.state(own).is_some_and(|state| state.is_over()),
    }
}

/// The side that sends a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Side {
    Initiator,
    Other,
}

impl Side {
    pub(crate) fn opposite(self) -> Self {
        match self {
            Self::Initiator => Self::Other,
            Self::Other => Self::Initiator,
        }
    }
}

/// The state of a conversation with one participant or with all of them.
#[derive(Debug, Clone)]
pub(crate) struct Party {
    /// The participant, or [`NONE`].
    pub(crate) peer: Name,
    pub(crate) state: u16,
    /// During a cancel or after a failure: the state before it.
    pub(crate) resume: u16,
    /// The state before the last message.
    pub(crate) before: u16,
    /// The side that sent the last message.
    pub(crate) last: Side,
    /// The side that canceled.
    pub(crate) canceling_side: Side,
    /// Whether the answer to the cancel may still come, because the message that was taken for it may
    /// have been sent before the cancel arrived.
    pub(crate) echo: bool,
    /// [`act_number`] of the last message of each side; 0 for none.
    pub(crate) acts: [u8; 2],
    /// Fingerprint of the last `reply-with` of each side; 0 for none.
    pub(crate) asked: [u64; 2],
    /// Fingerprint of the `reply-with` before that.
    pub(crate) asked_before: [u64; 2],
    /// Fingerprint of the `reply-with` of the cancel.
    pub(crate) cancel: u64,
    /// Deadline of the next message in milliseconds since 1970; 0 for none.
    pub(crate) deadline: u64,
}

impl Party {
    pub(crate) fn new(peer: Name, state: u16) -> Self {
        Self {
            peer,
            state,
            resume: state,
            before: state,
            last: Side::Other,
            canceling_side: Side::Initiator,
            echo: false,
            acts: [0; 2],
            asked: [0; 2],
            asked_before: [0; 2],
            cancel: 0,
            deadline: 0,
        }
    }

    /// Whether no message was sent yet.
    fn is_fresh(&self) -> bool {
        self.acts == [0; 2]
    }
}

/// A role and the agent that has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RoleBinding {
    pub(crate) role: u8,
    pub(crate) agent: Name,
}

#[derive(Debug)]
pub(crate) struct Conversation {
    pub(crate) id: String,
    /// Index into the library.
    pub(crate) machine: u16,
    pub(crate) initiator: Name,
    pub(crate) parties: SmallVec<[Party; 1]>,
    pub(crate) bound: SmallVec<[RoleBinding; 2]>,
    /// Whether the conversation began between other agents, and the monitored agent joined it because
    /// a `reply-to` names it. It then has the place of the initiator.
    pub(crate) joined: bool,
    /// Agents that receive replies instead of the initiator, and may continue in its place.
    pub(crate) reply_to: Vec<Name>,
    /// State of the members of a multicast. Their names are unknown until they answer.
    pub(crate) unnamed: Option<Box<Party>>,
}

impl Conversation {
    /// Whether the agent has sent or received a message of this conversation.
    pub(crate) fn takes_part(&self, names: &Names, agent: &str) -> bool {
        let peers = self.parties.iter().map(|party| party.peer);
        let bound = self.bound.iter().map(|bound| bound.agent);
        let mut known = peers.chain(bound).chain([self.initiator]);
        known.any(|name| names.is(name, agent))
    }

    /// Whether a `reply-to` names the agent instead of the initiator.
    pub(crate) fn is_designated(&self, names: &Names, agent: &str) -> bool {
        self.reply_to.iter().any(|name| names.is(*name, agent))
    }

    /// With one state for all participants: whether the agent is the initiator, or continues in its
    /// place without a role of its own.
    pub(crate) fn speaks_for_initiator(&self, names: &Names, agent: &str) -> bool {
        let has_part = || self.bound.iter().any(|bound| names.is(bound.agent, agent));
        names.is(self.initiator, agent) || self.is_designated(names, agent) && !has_part()
    }
}

/// The roles of agents in a conversation, with respect to one party.
pub(crate) struct Holders<'a> {
    pub(crate) conversation: &'a Conversation,
    pub(crate) machine: &'a Machine,
    pub(crate) party: &'a Party,
    pub(crate) names: &'a Names,
}

impl Holders<'_> {
    pub(crate) fn of(&self, agent: &str) -> u32 {
        let initiator = 1_u32 << self.machine.initiator;
        match self.machine.scope {
            Scope::Participant if self.names.is(self.conversation.initiator, agent) => initiator,
            Scope::Participant if self.names.is(self.party.peer, agent) => !initiator,
            Scope::Participant => 0,
            Scope::Conversation => {
                let bound = self.conversation.bound.iter();
                let held = bound.filter(|bound| self.names.is(bound.agent, agent));
                held.fold(0, |mask, bound| mask | (1 << bound.role))
            }
        }
    }
}

/// A message with respect to one party of its conversation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PartyMessage<'a> {
    pub(crate) act: Act<'a>,
    pub(crate) side: Side,
    /// Roles that the sender may have.
    pub(crate) from: u32,
    /// Roles that every receiver may have.
    pub(crate) to: u32,
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
    pub(crate) state: u16,
    pub(crate) resume: u16,
    pub(crate) echo: bool,
    /// Whether the message was sent before its sender had received the last one.
    pub(crate) crossed: bool,
    /// Whether the message answers one that another message has replaced. It is too late and changes
    /// nothing.
    pub(crate) void: bool,
    /// Roles of the sender and the receivers in the transition; 0 for none.
    pub(crate) roles: (u32, u32),
}

impl NextState {
    pub(crate) fn to(state: u16) -> Self {
        Self {
            state,
            resume: state,
            echo: false,
            crossed: false,
            void: false,
            roles: (0, 0),
        }
    }

    fn taking(step: &Transition) -> Self {
        let single = |roles: &Roles| if roles.anyone { 0 } else { roles.mask };
        Self {
            roles: (single(&step.from), single(&step.to)),
            ..Self::to(step.target)
        }
    }
}

/// Returns the state after a message, or the kind of violation.
pub(crate) fn next_state(
    machine: &Machine,
    party: &Party,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    match party.state {
        CANCELLING => while_cancelling(machine, party, message),
        CANCELLED
            if party.echo && message.side != party.canceling_side && is_cancel_answer(message) =>
        {
            Ok(NextState::to(CANCELLED))
        }
        AFTER_NOT_UNDERSTOOD | CANCELLED => Err(ended(party, message)),
        // A message that was reported as failed may have arrived, or is sent again.
        FAILED => in_state(machine, party, party.resume, message)
            .or_else(|kind| in_state(machine, party, party.before, message).map_err(|_| kind)),
        own => in_state(machine, party, own, message),
    }
}

fn is_cancel_answer(message: &PartyMessage<'_>) -> bool {
    [INFORM, FAILURE, NOT_UNDERSTOOD].contains(&message.act)
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
            NOT_UNDERSTOOD => Ok(NextState::to(AFTER_NOT_UNDERSTOOD)),
            _ if is_repeated(party, message) => Err(Kind::Repeated),
            _ => Err(Kind::Unexpected),
        };
    }
    // `in-reply-to` distinguishes the answer from a message that crossed the cancel.
    let told_apart = message.in_reply_to != 0 && party.cancel != 0;
    let answers = !told_apart || message.in_reply_to == party.cancel;
    let crossing = in_state(machine, party, party.resume, message);
    if answers && is_cancel_answer(message) {
        return Ok(match message.act {
            INFORM => NextState {
                echo: !told_apart && crossing.is_ok(),
                ..NextState::to(CANCELLED)
            },
            // The cancel failed, and the conversation continues.
            FAILURE => NextState::to(party.resume),
            _ => NextState::to(AFTER_NOT_UNDERSTOOD),
        });
    }
    // If the cancel fails, the conversation continues in the state after the crossing message.
    crossing.map(|next_state| match next_state.state {
        AFTER_NOT_UNDERSTOOD => next_state,
        _ => NextState {
            state: CANCELLING,
            crossed: true,
            ..next_state
        },
    })
}

/// Returns the state after a message in one of the protocol's own states.
fn in_state(
    machine: &Machine,
    party: &Party,
    state: u16,
    message: &PartyMessage<'_>,
) -> Result<NextState, Kind> {
    let Some(here) = machine.state(state) else {
        return Err(Kind::Unexpected);
    };
    let taken = step(&here.steps, message.act, message.from, message.to);
    let proxied = || {
        let mut embedded = here.embedded.iter();
        embedded.any(|sub| {
            let to = sub.proxied_to.as_ref();
            sub.from.includes(message.from) && to.is_some_and(|to| to.includes(message.to))
        })
    };
    if let Some(step) = taken {
        return Ok(match in_reply(party, message)? {
            Reply::ToLast => NextState::taking(step),
            Reply::ToEarlier => NextState {
                void: true,
                ..NextState::to(state)
            },
        });
    }
    if proxied() {
        return Ok(NextState::to(state));
    }
    if let Some(next_state) = by_default(machine, party, state, message) {
        return Ok(next_state);
    }
    Err(wrong(machine, party, state, message))
}

/// Returns the state after a message that every protocol allows, as in figure 6 of the paper about
/// fipa_acl.
fn by_default(
    machine: &Machine,
    party: &Party,
    state: u16,
    message: &PartyMessage<'_>,
) -> Option<NextState> {
    if party.is_fresh() || !message.known {
        return None;
    }
    let here = machine.state(state)?;
    let has_ended = here.is_final;
    // The receiver of the last message may not have understood it. Its sender cannot send
    // `not-understood`.
    let answers_last = party.last != message.side;
    match message.act {
        NOT_UNDERSTOOD => (!has_ended || answers_last).then(|| NextState::to(AFTER_NOT_UNDERSTOOD)),
        CANCEL => {
            let may = match machine.cancel {
                Cancel::Initiator => message.side == Side::Initiator,
                Cancel::Anyone => true,
                Cancel::Nobody => false,
            };
            // After the end, a cancel is allowed only if its sender may not have received the last
            // message.
            let too_late = here.is_over() && (message.own || !answers_last);
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

/// The message that a message answers.
enum Reply {
    /// The last message of the other side, or unspecified.
    ToLast,
    /// The message before the last one. The answer and the last message have crossed, as a bid and
    /// the next call of an auction may.
    ToEarlier,
}

fn in_reply(party: &Party, message: &PartyMessage<'_>) -> Result<Reply, Kind> {
    let other = side_index(message.side.opposite());
    let (asked, before) = (party.asked[other], party.asked_before[other]);
    if !message.answers || [0, asked].contains(&message.in_reply_to) || asked == 0 {
        Ok(Reply::ToLast)
    } else if message.in_reply_to == before && !message.own {
        Ok(Reply::ToEarlier)
    } else {
        Err(Kind::WrongReply)
    }
}

pub(crate) fn side_index(side: Side) -> usize {
    match side {
        Side::Initiator => 0,
        Side::Other => 1,
    }
}

fn is_repeated(party: &Party, message: &PartyMessage<'_>) -> bool {
    let index = side_index(message.side);
    let same_act = act_number(message.act) != 0 && party.acts[index] == act_number(message.act);
    same_act && message.reply_with != 0 && party.asked[index] == message.reply_with
}

/// Returns the number of a standard performative, plus 1, and 255 for other performatives.
pub(crate) fn act_number(act: Act<'_>) -> u8 {
    match act {
        Act::Standard(number) => number + 1,
        Act::Other(_) => u8::MAX,
    }
}

fn wrong(machine: &Machine, party: &Party, state: u16, message: &PartyMessage<'_>) -> Kind {
    if is_repeated(party, message) {
        return Kind::Repeated;
    }
    let Some(here) = machine.state(state) else {
        return Kind::Unexpected;
    };
    if here.is_over() {
        return Kind::Ended;
    }
    if step(&here.steps, message.act, message.to, message.from).is_some() {
        return Kind::WrongSender;
    }
    // Checks whether a later state allows the message.
    let mut reached = vec![false; machine.states.len()];
    let mut next = vec![state];
    while let Some(id) = next.pop() {
        let fresh = reached.get_mut(usize::from(id)).filter(|seen| !**seen);
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
