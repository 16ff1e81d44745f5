//! What a message would do to its conversation, with every participant it concerns; nothing is
//! changed here.

use std::borrow::Cow;

use crate::act::{Act, FAILURE};
use crate::conversation::{
    AFTER_NOT_UNDERSTOOD, CANCELLED, CANCELLING, Conversation, FAILED, Lead, NONE, Party, Said,
    Side, lead, side_index,
};
use crate::machine::{Machine, Scope};
use crate::names::{Name, Names};
use crate::verdict::ViolationKind as Kind;

/// A message, and what it has to do with one conversation.
pub(crate) struct Heard<'a> {
    pub(crate) act: Act<'a>,
    pub(crate) sender: &'a str,
    pub(crate) receivers: &'a [Cow<'a, str>],
    pub(crate) reply_with: u64,
    pub(crate) in_reply_to: u64,
    /// Whether the sender is the agent that watches itself.
    pub(crate) own: bool,
    /// Which of the receivers is, when it is told by somebody else.
    pub(crate) told: Option<usize>,
}

/// One change.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Move {
    pub(crate) who: Who,
    pub(crate) side: Side,
    pub(crate) lead: Lead,
    /// Whether this was told from outside, so that nobody who takes part has said anything.
    pub(crate) told: bool,
}

/// Whose state changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Who {
    /// The party of this number.
    Party(usize),
    /// The receiver of this number, who is new.
    Receiver(usize),
    /// The members of a multicast who have not answered yet.
    Unnamed,
    /// The sender, who was one of those.
    Sender,
}

/// Why a message is wrong, and with whom.
#[derive(Debug, Clone)]
pub(crate) struct Fault {
    pub(crate) kind: Kind,
    pub(crate) state: Option<u16>,
    pub(crate) participant: Option<String>,
}

impl Fault {
    pub(crate) fn plain(kind: Kind) -> Self {
        Self {
            kind,
            state: None,
            participant: None,
        }
    }
}

/// Writes all changes, or tells the first fault.
pub(crate) fn judge(
    machine: &Machine,
    conversation: &Conversation,
    names: &Names,
    heard: &Heard<'_>,
    moves: &mut Vec<Move>,
) -> Result<(), Fault> {
    moves.clear();
    let judge = Judge {
        machine,
        conversation,
        names,
        heard,
    };
    match machine.scope {
        Scope::Participant => judge.with_each(moves),
        Scope::Conversation => judge.with_all(moves),
    }
}

/// Whether a receiver is a pattern of names: what of a multicast is not known beforehand.
fn is_pattern(receiver: &str) -> bool {
    receiver.contains(['*', '+', '?', '[', '(', '{', '|', '^', '$', '\\'])
}

struct Judge<'a> {
    machine: &'a Machine,
    conversation: &'a Conversation,
    names: &'a Names,
    heard: &'a Heard<'a>,
}

impl Judge<'_> {
    fn with_each(&self, moves: &mut Vec<Move>) -> Result<(), Fault> {
        let sender = self.heard.sender;
        if self.names.is(self.conversation.initiator, sender) {
            return self.by_initiator(moves);
        }
        let known = self.party(sender);
        let known = known.map(|(at, party)| (Who::Party(at), party));
        let unnamed = self.conversation.unnamed.as_deref();
        let Some((who, party)) = known.or(unnamed.map(|party| (Who::Sender, party))) else {
            if self.conversation.is_designated(self.names, sender) {
                return self.by_initiator(moves);
            }
            if self.heard.act == FAILURE && self.all_take_part() {
                self.reported_failure(moves);
                return Ok(());
            }
            return Err(Fault::plain(Kind::Stranger));
        };
        self.by_participant(who, party, moves).or_else(|fault| {
            // Who takes part himself may have been named in a `reply-to` as well.
            if !self.conversation.is_designated(self.names, sender) {
                return Err(fault);
            }
            self.by_initiator(moves).map_err(|other| match fault.kind {
                Kind::WrongReceiver => other,
                _ => fault,
            })
        })
    }

    /// What the initiator says, or who goes on instead: with those who take part already.
    fn by_initiator(&self, moves: &mut Vec<Move>) -> Result<(), Fault> {
        let fresh = Party::new(NONE, self.machine.initial);
        let conversation = self.conversation;
        let began =
            !conversation.joined && self.names.is(conversation.initiator, self.heard.sender);
        // Who watches himself does not know what others who are told the same have answered before.
        let told = self.heard.told.and_then(|at| self.heard.receivers.get(at));
        for (number, receiver) in self.heard.receivers.iter().enumerate() {
            if told.is_some_and(|agent| receiver != agent && !is_pattern(receiver)) {
                continue;
            }
            let (who, party) = match self.party(receiver) {
                Some((at, party)) => (Who::Party(at), party),
                None if is_pattern(receiver) && (began || conversation.unnamed.is_some()) => {
                    let unnamed = conversation.unnamed.as_deref();
                    (Who::Unnamed, unnamed.unwrap_or(&fresh))
                }
                None if began => (Who::Receiver(number), &fresh),
                None => return Err(self.fault(Kind::WrongReceiver, &fresh, receiver)),
            };
            let said = self.said(Side::Initiator);
            let mut led = lead(self.machine, party, &said).map(|lead| (Side::Initiator, lead));
            // Who talks to himself has both roles.
            if led.is_err() && **receiver == *self.heard.sender {
                let answer = lead(self.machine, party, &self.said(Side::Other));
                led = answer.map(|lead| (Side::Other, lead)).or(led);
            }
            let (side, lead) = led.map_err(|kind| self.fault(kind, party, receiver))?;
            // Somebody named twice is told once.
            let again = match who {
                Who::Receiver(_) => self.heard.receivers[..number].contains(receiver),
                who => moves.iter().any(|made| made.who == who),
            };
            if !again {
                let told = false;
                moves.push(Move {
                    who,
                    side,
                    lead,
                    told,
                });
            }
        }
        Ok(())
    }

    fn by_participant(&self, who: Who, party: &Party, moves: &mut Vec<Move>) -> Result<(), Fault> {
        let mut receivers = self.heard.receivers.iter();
        let elsewhere = receivers.any(|receiver| !self.gets_replies(receiver));
        let name = self.heard.sender;
        if elsewhere {
            return Err(self.fault(Kind::WrongReceiver, party, name));
        }
        let lead = lead(self.machine, party, &self.said(Side::Other))
            .map_err(|kind| self.fault(kind, party, name))?;
        moves.push(Move {
            who,
            side: Side::Other,
            lead,
            told: false,
        });
        Ok(())
    }

    /// Somebody outside, a message transport service, tells a party that something it said was
    /// not delivered. To whom is in the content: where it can be only one, the protocol has ended
    /// with that one.
    fn reported_failure(&self, moves: &mut Vec<Move>) {
        for receiver in self.heard.receivers {
            let initiator = self.names.is(self.conversation.initiator, receiver);
            let designated = self.conversation.is_designated(self.names, receiver);
            let concerns = |(_, party): &(usize, &Party)| {
                let side = if !initiator && self.names.is(party.peer, receiver) {
                    Side::Other
                } else if initiator || designated {
                    Side::Initiator
                } else {
                    return false;
                };
                let asked = party.asked[side_index(side)];
                let answers =
                    self.heard.in_reply_to == 0 || asked == 0 || self.heard.in_reply_to == asked;
                party.last == side && answers
            };
            let mut concerned = self
                .conversation
                .parties
                .iter()
                .enumerate()
                .filter(concerns);
            if let (Some((at, party)), None) = (concerned.next(), concerned.next()) {
                moves.push(failed(at, party));
            }
        }
    }

    fn all_take_part(&self) -> bool {
        let mut receivers = self.heard.receivers.iter();
        receivers.all(|receiver| self.gets_replies(receiver) || self.party(receiver).is_some())
    }

    /// Whether what participants say may be for this agent.
    fn gets_replies(&self, agent: &str) -> bool {
        self.names.is(self.conversation.initiator, agent)
            || self.conversation.is_designated(self.names, agent)
    }

    fn with_all(&self, moves: &mut Vec<Move>) -> Result<(), Fault> {
        let conversation = self.conversation;
        let Some(party) = conversation.parties.first() else {
            return Err(Fault::plain(Kind::NotOpened));
        };
        let sender = self.heard.sender;
        let side = if conversation.speaks_for_initiator(self.names, sender) {
            Side::Initiator
        } else {
            Side::Other
        };
        let unbound = unbound(self.machine, conversation);
        let has = self.roles_of(sender);
        let (mut to, mut all_bound, mut stranger) = (u32::MAX, has != 0, false);
        for receiver in self.heard.receivers {
            let roles = self.roles_of(receiver);
            to &= roles | unbound;
            all_bound &= roles != 0;
            stranger |= roles | unbound == 0;
        }
        let said = Said {
            from: has | unbound,
            to,
            known: all_bound,
            answers: conversation.bound.len() == 2,
            ..self.said(side)
        };
        let outside = has == 0 && unbound == 0;
        let lead = match lead(self.machine, party, &said) {
            Ok(lead) => lead,
            Err(_) if outside && self.heard.act == FAILURE && !stranger => {
                moves.push(failed(0, party));
                return Ok(());
            }
            Err(kind) => {
                let kind = match kind {
                    _ if outside => Kind::Stranger,
                    Kind::Unexpected | Kind::OutOfOrder if stranger => Kind::WrongReceiver,
                    kind => kind,
                };
                let state = Some(party.state);
                let participant = None;
                return Err(Fault {
                    kind,
                    state,
                    participant,
                });
            }
        };
        moves.push(Move {
            who: Who::Party(0),
            side,
            lead,
            told: false,
        });
        Ok(())
    }

    fn roles_of(&self, agent: &str) -> u32 {
        let bound = self.conversation.bound.iter();
        let held = bound.filter(|bound| self.names.is(bound.agent, agent));
        let roles = held.fold(0, |mask, bound| mask | (1 << bound.role));
        if self.conversation.is_designated(self.names, agent) {
            return roles | (1 << self.machine.initiator);
        }
        roles
    }

    fn said(&self, side: Side) -> Said<'_> {
        let initiator = 1 << self.machine.initiator;
        let (from, to) = match side {
            Side::Initiator => (initiator, !initiator),
            Side::Other => (!initiator, initiator),
        };
        Said {
            act: self.heard.act,
            side,
            from,
            to,
            reply_with: self.heard.reply_with,
            in_reply_to: self.heard.in_reply_to,
            answers: true,
            own: self.heard.own,
            known: true,
        }
    }

    fn party(&self, name: &str) -> Option<(usize, &Party)> {
        const FEW: usize = 8;
        let parties = &self.conversation.parties;
        if parties.len() <= FEW {
            let mut parties = parties.iter().enumerate();
            return parties.find(|(_, party)| self.names.is(party.peer, name));
        }
        let known: Name = self.names.known(name)?;
        let mut parties = parties.iter().enumerate();
        parties.find(|(_, party)| party.peer == known)
    }

    fn fault(&self, kind: Kind, party: &Party, participant: &str) -> Fault {
        Fault {
            kind,
            state: Some(party.state),
            participant: Some(participant.to_owned()),
        }
    }
}

/// The roles that nobody has yet.
pub(crate) fn unbound(machine: &Machine, conversation: &Conversation) -> u32 {
    let all = 1_u64.checked_shl(machine.roles.len().try_into().unwrap_or(32));
    let all = u32::try_from(all.unwrap_or(0).wrapping_sub(1)).unwrap_or(u32::MAX);
    let bound = conversation.bound.iter();
    all & !bound.fold(0, |mask, bound| mask | (1 << bound.role))
}

/// What the last message of a party, not having been delivered, leads to.
fn failed(at: usize, party: &Party) -> Move {
    let failed = |resume| Lead {
        resume,
        ..Lead::to(FAILED)
    };
    let lead = match party.state {
        // What had ended has not begun again.
        ended @ (AFTER_NOT_UNDERSTOOD | CANCELLED) => Lead {
            echo: party.echo,
            ..Lead::to(ended)
        },
        // The cancel was not heard.
        CANCELLING => Lead::to(party.resume),
        FAILED => failed(party.resume),
        state => failed(state),
    };
    Move {
        who: Who::Party(at),
        side: party.last,
        lead,
        told: true,
    }
}
