//! What a monitor says about a message.

use std::fmt;

use fipa_acl::escape;

/// What a monitor says about a message.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Verdict<'m> {
    /// It fits its conversation, which has moved on.
    Accepted(Accepted<'m>),
    /// It does not; the conversation is as it was.
    Violation(Box<Violation>),
    /// Nothing can be said.
    Unchecked(Unchecked),
}

impl Verdict<'_> {
    /// The violation, if it is one.
    #[must_use]
    pub fn violation(&self) -> Option<&Violation> {
        match self {
            Self::Violation(violation) => Some(violation),
            _ => None,
        }
    }

    /// Whether the message fits its conversation.
    #[must_use]
    pub fn is_accepted(&self) -> bool {
        matches!(self, Self::Accepted(_))
    }
}

/// A message that fits, and where its conversation is now.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Accepted<'m> {
    /// The standard name of the protocol.
    pub protocol: &'m str,
    /// The new state: of the participant whom the message concerns, the first of several.
    pub state: &'m str,
    /// Whether that is a state of the protocol's own, and none that all have: `not-understood`,
    /// `cancelling`, `cancelled`, `undelivered`.
    pub own: bool,
    /// Whether the message began the conversation, or brought another participant in.
    pub opened: bool,
    /// Whether the protocol may end in the new state.
    pub ended: bool,
    /// Whether nothing can follow in the new state but an answer to this message.
    pub over: bool,
    /// Whether it may end in the states of all participants.
    pub complete: bool,
    /// Whether it came after the `reply-by` of the message it answers, or is void.
    pub late: bool,
    /// Whether it answers a message in whose place another had come before: it was too late, and
    /// changes nothing.
    pub void: bool,
    /// Whether the conversation, or the protocol within it, began between others: the agent that
    /// watches itself came into it because a `reply-to` names it.
    pub elsewhere: bool,
}

/// A message that does not fit.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Violation {
    /// In which way.
    pub kind: ViolationKind,
    /// The protocol of the conversation.
    pub protocol: String,
    /// The conversation.
    pub conversation_id: String,
    /// What the message does.
    pub performative: String,
    /// Who sent it.
    pub sender: String,
    /// To whom; of many the first 16.
    pub receivers: Vec<String>,
    /// The participant whose state is meant, where each has one.
    pub participant: Option<String>,
    /// The state that does not allow the message.
    pub state: Option<String>,
    /// What would have been right.
    pub expected: Vec<Expected>,
}

/// How a message can be wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ViolationKind {
    /// The state does not allow it.
    Unexpected,
    /// It would be right if the other side had said it.
    WrongSender,
    /// It is for somebody to whom it cannot be said.
    WrongReceiver,
    /// It was there already: the same performative with the same `reply-with`.
    Repeated,
    /// A later state would allow it: a step is missing in between.
    OutOfOrder,
    /// The conversation has ended.
    Ended,
    /// The sender takes no part in the conversation.
    Stranger,
    /// No conversation begins so, and none with this id is known: it did not begin, began before
    /// it was watched, or is over for long.
    NotOpened,
    /// `in-reply-to` is not what the message that it answers has as `reply-with`.
    WrongReply,
    /// The conversation follows another protocol.
    WrongProtocol,
    /// The conversation has as many participants or parts as can be watched.
    TooMany,
}

/// A message that would have been right.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Expected {
    /// The performatives, for example `agree, refuse`.
    pub performative: String,
    /// The role from which, or the agent that has it.
    pub from: String,
    /// The role to which, or the agent that has it.
    pub to: String,
}

/// Why nothing can be said about a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum Unchecked {
    /// It belongs to no conversation.
    #[error("the message has no conversation-id")]
    NoConversation,
    /// It is the first of its conversation and names no protocol.
    #[error("the message names no protocol")]
    NoProtocol,
    /// No machine for its protocol is known.
    #[error("the protocol is not known")]
    UnknownProtocol,
    /// It is anonymous.
    #[error("the message has no sender")]
    NoSender,
    /// It names nobody to whom it is sent.
    #[error("the message has no receiver")]
    NoReceiver,
    /// It belongs to a conversation, or a protocol within one, that began between others: the agent
    /// that watches itself was not told. So are the first answers of the recruited to whom a
    /// `reply-to` names, and later ones that something must have come before which was not said
    /// to it.
    #[error("the conversation, or the protocol within it, began between others")]
    BegunElsewhere,
    /// A conversation id or name is too long to be kept, or there are too many receivers.
    #[error(
        "the message is beyond what is watched: an id or a name too long, or too many receivers"
    )]
    TooLarge,
}

impl ViolationKind {
    /// A word for it, as it stands in JSON: `unexpected`, `wrong-sender` …
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Unexpected => "unexpected",
            Self::WrongSender => "wrong-sender",
            Self::WrongReceiver => "wrong-receiver",
            Self::Repeated => "repeated",
            Self::OutOfOrder => "out-of-order",
            Self::Ended => "ended",
            Self::Stranger => "stranger",
            Self::NotOpened => "not-opened",
            Self::WrongReply => "wrong-reply",
            Self::WrongProtocol => "wrong-protocol",
            Self::TooMany => "too-many",
        }
    }
}

impl fmt::Display for Violation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self {
            performative,
            sender,
            receivers,
            protocol,
            conversation_id,
            ..
        } = self;
        let to = listed(receivers.iter().map(String::as_str), " and ");
        write!(
            f,
            "{} from {} to {} breaks {} in conversation {conversation_id:?}: ",
            escape(performative),
            escape(sender),
            escape(&to),
            escape(protocol)
        )?;
        f.write_str(match self.kind {
            ViolationKind::Unexpected => "not allowed",
            ViolationKind::WrongSender => "the other side says that",
            ViolationKind::WrongReceiver => "not to this receiver",
            ViolationKind::Repeated => "said already",
            ViolationKind::OutOfOrder => "too early, a step is missing",
            ViolationKind::Ended => "the conversation has ended",
            ViolationKind::Stranger => "the sender takes no part",
            ViolationKind::NotOpened => "no such conversation, and none begins so",
            ViolationKind::WrongReply => "in-reply-to does not match",
            ViolationKind::WrongProtocol => "the conversation follows another protocol",
            ViolationKind::TooMany => "more participants than can be watched",
        })?;
        match (&self.state, &self.participant) {
            (Some(state), Some(participant)) => {
                let participant = escape(participant);
                write!(f, "; state {state:?} with {participant}")?;
            }
            (Some(state), None) => write!(f, "; state {state:?}")?,
            (None, _) => {}
        }
        for (index, expected) in self.expected.iter().enumerate() {
            let Expected {
                performative,
                from,
                to,
            } = expected;
            let before = if index == 0 { "; expected" } else { ", or" };
            let [performative, from, to] = [performative, from, to].map(|text| escape(text));
            write!(f, "{before} {performative} from {from} to {to}")?;
        }
        Ok(())
    }
}

fn listed<'a>(names: impl Iterator<Item = &'a str>, and: &str) -> String {
    names.collect::<Vec<_>>().join(and)
}
