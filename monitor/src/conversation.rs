//! One conversation, and what a message would do to it.
//!
//! Where each participant has a state of its own ([`Scope::Participant`]), it is kept in a
//! [`Party`] each; otherwise there is one party, nobody's, and a list of who has which role.

use smallvec::SmallVec;

use crate::act::{Act, CANCEL, FAILURE, INFORM, NOT_UNDERSTOOD};
use crate::machine::{Cancel, Machine, Roles, Scope, Transition, step};
use crate::names::{Name, Names};
use crate::verdict::ViolationKind as Kind;

/// Nobody, or nothing.
pub(crate) const NONE: u32 = u32::MAX;

/// States that every protocol has: after `not-understood` …
pub(crate) const AFTER_NOT_UNDERSTOOD: u16 = u16::MAX;
/// … after `cancel`, before its answer …
pub(crate) const CANCELLING: u16 = u16::MAX - 1;
/// … when that was `inform` …
pub(crate) const CANCELLED: u16 = u16::MAX - 2;
/// … and when the message transport service told of a failure.
pub(crate) const FAILED: u16 = u16::MAX - 3;
/// The state of which only others know: see [`crate::elsewhere`].
pub(crate) const ELSEWHERE: u16 = u16::MAX - 4;

/// The name of a state.
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

/// Whether nothing more is to come.
pub(crate) fn is_over(machine: &Machine, state: u16) -> bool {
    match state {
        AFTER_NOT_UNDERSTOOD | CANCELLED | FAILED => true,
        CANCELLING => false,
        own => machine.state(own).is_some_and(|state| state.is_over()),
    }
}

/// Who speaks.
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

/// Where a conversation is, with one participant or altogether.
#[derive(Debug, Clone)]
pub(crate) struct Party {
    /// The participant.
    pub(crate) peer: Name,
    pub(crate) state: u16,
    /// While cancelling or after a failure: the state from which that came.
    pub(crate) resume: u16,
    /// The state before the last message.
    pub(crate) before: u16,
    /// Who spoke last.
    pub(crate) last: Side,
    /// Who cancelled; and whether the answer to the cancel may still come, because what was
    /// taken for it may have been something that was said before.
    pub(crate) canceller: Side,
    pub(crate) echo: bool,
    /// The number of what each side said last, plus 1.
    pub(crate) acts: [u8; 2],
    /// The fingerprint of the last `reply-with` of each side; 0 for none.
    pub(crate) asked: [u64; 2],
    /// Of the one before that.
    pub(crate) asked_before: [u64; 2],
    /// That of the cancel.
    pub(crate) cancel: u64,
    /// When the next message is due, in milliseconds since 1970; 0 for no time.
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
            canceller: Side::Initiator,
            echo: false,
            acts: [0; 2],
            asked: [0; 2],
            asked_before: [0; 2],
            cancel: 0,
            deadline: 0,
        }
    }

    /// Whether the initiator has said anything yet.
    fn is_fresh(&self) -> bool {
        self.acts == [0; 2]
    }
}

/// A role that somebody has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Bound {
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
    pub(crate) bound: SmallVec<[Bound; 2]>,
    /// Whether it began between others, and the agent that watches itself came into it because a
    /// `reply-to` names it. It stands for the initiator then.
    pub(crate) joined: bool,
    /// Who gets replies instead of the initiator, and may go on instead.
    pub(crate) reply_to: Vec<Name>,
    /// What the members of a multicast have been told, who are not known by name before they
    /// answer.
    pub(crate) unnamed: Option<Box<Party>>,
}

impl Conversation {
    /// Whether the agent has said anything here, or been told.
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

    /// Where there is one state for all: whether the agent began, or goes on instead and has no
    /// part of its own.
    pub(crate) fn speaks_for_initiator(&self, names: &Names, agent: &str) -> bool {
        let has_part = || self.bound.iter().any(|bound| names.is(bound.agent, agent));
        names.is(self.initiator, agent) || self.is_designated(names, agent) && !has_part()
    }
}

/// Who has which role in a conversation, as far as one party is concerned.
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

/// A message as far as one party of its conversation is concerned.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Said<'a> {
    pub(crate) act: Act<'a>,
    pub(crate) side: Side,
    /// The roles that the sender may have, and all receivers have in common.
    pub(crate) from: u32,
    pub(crate) to: u32,
    pub(crate) reply_with: u64,
    pub(crate) in_reply_to: u64,
    /// Whether in-reply-to can be compared: the conversation is between two.
    pub(crate) answers: bool,
    /// Whether the sender is the agent that watches itself: it knows all it was told.
    pub(crate) own: bool,
    /// Whether sender and receivers take part already.
    pub(crate) known: bool,
}

/// Where a message leads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Lead {
    pub(crate) state: u16,
    pub(crate) resume: u16,
    pub(crate) echo: bool,
    /// Whether the message was sent before its sender could know of the last one.
    pub(crate) crossed: bool,
    /// Whether it answers what has been said anew since: it was too late, and changes nothing.
    pub(crate) void: bool,
    /// The roles of the sender and the receivers in the step that was taken; 0 for none.
    pub(crate) roles: (u32, u32),
}

impl Lead {
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

/// Where the message leads, or in which way it is wrong.
pub(crate) fn lead(machine: &Machine, party: &Party, said: &Said<'_>) -> Result<Lead, Kind> {
    match party.state {
        CANCELLING => while_cancelling(machine, party, said),
        CANCELLED if party.echo && said.side != party.canceller && is_cancel_answer(said) => {
            Ok(Lead::to(CANCELLED))
        }
        AFTER_NOT_UNDERSTOOD | CANCELLED => Err(ended(party, said)),
        // What was reported as failed may have arrived all the same, or is tried again.
        FAILED => in_state(machine, party, party.resume, said)
            .or_else(|kind| in_state(machine, party, party.before, said).map_err(|_| kind)),
        own => in_state(machine, party, own, said),
    }
}

fn is_cancel_answer(said: &Said<'_>) -> bool {
    [INFORM, FAILURE, NOT_UNDERSTOOD].contains(&said.act)
}

fn ended(party: &Party, said: &Said<'_>) -> Kind {
    if is_repeated(party, said) {
        Kind::Repeated
    } else {
        Kind::Ended
    }
}

fn while_cancelling(machine: &Machine, party: &Party, said: &Said<'_>) -> Result<Lead, Kind> {
    let group = machine.scope == Scope::Conversation;
    if said.side == party.canceller && !group {
        return match said.act {
            NOT_UNDERSTOOD => Ok(Lead::to(AFTER_NOT_UNDERSTOOD)),
            _ if is_repeated(party, said) => Err(Kind::Repeated),
            _ => Err(Kind::Unexpected),
        };
    }
    // `in-reply-to` tells the answer from what was on its way when the cancel came.
    let told_apart = said.in_reply_to != 0 && party.cancel != 0;
    let answers = !told_apart || said.in_reply_to == party.cancel;
    let crossing = in_state(machine, party, party.resume, said);
    if answers && is_cancel_answer(said) {
        return Ok(match said.act {
            INFORM => Lead {
                echo: !told_apart && crossing.is_ok(),
                ..Lead::to(CANCELLED)
            },
            // It was not cancelled, and goes on.
            FAILURE => Lead::to(party.resume),
            _ => Lead::to(AFTER_NOT_UNDERSTOOD),
        });
    }
    // Where it leads to is where the conversation goes on if it is not cancelled.
    crossing.map(|lead| match lead.state {
        AFTER_NOT_UNDERSTOOD => lead,
        _ => Lead {
            state: CANCELLING,
            crossed: true,
            ..lead
        },
    })
}

/// What the message means in one of the protocol's own states.
fn in_state(machine: &Machine, party: &Party, state: u16, said: &Said<'_>) -> Result<Lead, Kind> {
    let Some(here) = machine.state(state) else {
        return Err(Kind::Unexpected);
    };
    let taken = step(&here.steps, said.act, said.from, said.to);
    let proxied = || {
        let mut embedded = here.embedded.iter();
        embedded.any(|sub| {
            let to = sub.proxied_to.as_ref();
            sub.from.includes(said.from) && to.is_some_and(|to| to.includes(said.to))
        })
    };
    if let Some(step) = taken {
        return Ok(match in_reply(party, said)? {
            Reply::ToLast => Lead::taking(step),
            Reply::ToEarlier => Lead {
                void: true,
                ..Lead::to(state)
            },
        });
    }
    if proxied() {
        return Ok(Lead::to(state));
    }
    if let Some(lead) = by_default(machine, party, state, said) {
        return Ok(lead);
    }
    Err(wrong(machine, party, state, said))
}

/// What every protocol allows, in the way of Figure 6 of the paper about fipa_acl.
fn by_default(machine: &Machine, party: &Party, state: u16, said: &Said<'_>) -> Option<Lead> {
    if party.is_fresh() || !said.known {
        return None;
    }
    let here = machine.state(state)?;
    let has_ended = here.is_final;
    // Who has been told the last thing may not have understood it; who said it has no reason.
    let answers_last = party.last != said.side;
    match said.act {
        NOT_UNDERSTOOD => (!has_ended || answers_last).then(|| Lead::to(AFTER_NOT_UNDERSTOOD)),
        CANCEL => {
            let may = match machine.cancel {
                Cancel::Initiator => said.side == Side::Initiator,
                Cancel::Anyone => true,
                Cancel::Nobody => false,
            };
            // Sent before the end was known, if not by somebody who knew it.
            let too_late = here.is_over() && (said.own || !answers_last);
            (may && !too_late).then_some(Lead {
                resume: state,
                ..Lead::to(CANCELLING)
            })
        }
        FAILURE if machine.failure_by_parties => (!has_ended).then_some(Lead {
            resume: state,
            ..Lead::to(FAILED)
        }),
        _ => None,
    }
}

/// What a message answers.
enum Reply {
    /// The last one of the other side, as far as it tells.
    ToLast,
    /// The one before, which its sender took for the last: the two have crossed, as a bid and the
    /// next call of an auction may.
    ToEarlier,
}

fn in_reply(party: &Party, said: &Said<'_>) -> Result<Reply, Kind> {
    let other = side_index(said.side.opposite());
    let (asked, before) = (party.asked[other], party.asked_before[other]);
    if !said.answers || [0, asked].contains(&said.in_reply_to) || asked == 0 {
        Ok(Reply::ToLast)
    } else if said.in_reply_to == before && !said.own {
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

fn is_repeated(party: &Party, said: &Said<'_>) -> bool {
    let index = side_index(said.side);
    let same_act = act_number(said.act) != 0 && party.acts[index] == act_number(said.act);
    same_act && said.reply_with != 0 && party.asked[index] == said.reply_with
}

/// The number of a standard performative, plus 1; 255 for others.
pub(crate) fn act_number(act: Act<'_>) -> u8 {
    match act {
        Act::Standard(number) => number + 1,
        Act::Other(_) => u8::MAX,
    }
}

fn wrong(machine: &Machine, party: &Party, state: u16, said: &Said<'_>) -> Kind {
    if is_repeated(party, said) {
        return Kind::Repeated;
    }
    let Some(here) = machine.state(state) else {
        return Kind::Unexpected;
    };
    if here.is_over() {
        return Kind::Ended;
    }
    if step(&here.steps, said.act, said.to, said.from).is_some() {
        return Kind::WrongSender;
    }
    // Whether a later state allows it.
    let mut reached = vec![false; machine.states.len()];
    let mut next = vec![state];
    while let Some(id) = next.pop() {
        let fresh = reached.get_mut(usize::from(id)).filter(|seen| !**seen);
        let Some((seen, later)) = fresh.zip(machine.state(id)) else {
            continue;
        };
        *seen = true;
        if step(&later.steps, said.act, said.from, said.to).is_some() {
            return Kind::OutOfOrder;
        }
        next.extend(later.transitions.iter().map(|step| step.target));
    }
    Kind::Unexpected
}
