//! Verdicts of a monitor.

use std::fmt;

use fipa_acl::{escape, escape_name};

/// The verdict of a monitor on a message.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Verdict<'m> {
    /// The message fits its conversation and has changed its state.
    Accepted(Accepted<'m>),
    /// The message violates its protocol. The conversation is unchanged.
    Violation(Box<Violation>),
    /// The message cannot be checked.
    Unchecked(Unchecked),
}

impl Verdict<'_> {
    /// Returns the violation, if the verdict is one.
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

/// An accepted message and the new state of its conversation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub struct Accepted<'m> {
    /// Name of the protocol.
    pub protocol: &'m str,
    /// State after the message, toward the participant that sent or received it. For a message to
    /// several participants, the state toward the first.
    pub state: &'m str,
    /// Whether the state is one of the protocol's own. Other states are common to all protocols:
    /// `not-understood`, `cancelling`, `cancelled`, `undelivered`, `elsewhere`.
    pub own: bool,
    /// Whether the message began the conversation or added a participant.
    pub opened: bool,
    /// Whether the protocol may end in the new state.
    pub ended: bool,
    /// Whether only an answer to this message can follow in the new state.
    pub over: bool,
    /// Whether the protocol may end in the states of all participants.
    pub complete: bool,
    /// Whether the message came after the `reply-by` of the message that it answers, or is void.
    pub late: bool,
    /// Whether the message answers one that another message has replaced. It is too late and changes
    /// nothing.
    pub void: bool,
    /// Whether the conversation, or the protocol within it, began between other agents, and the
    /// monitored agent joined it because a `reply-to` names it.
    pub elsewhere: bool,
}

/// A message that violates its protocol.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Violation {
    /// Kind of the violation.
    pub kind: ViolationKind,
    /// Protocol of the conversation.
    pub protocol: String,
    /// Conversation identifier.
    pub conversation_id: String,
    /// Performative of the message.
    pub performative: String,
    /// Sender of the message.
    pub sender: String,
    /// Receivers of the message, at most the first 16.
    pub receivers: Vec<String>,
    /// Participant that `state` belongs to, if each has a state of its own.
    pub participant: Option<String>,
    /// State that does not allow the message.
    pub state: Option<String>,
    /// Messages that the state allows.
    pub expected: Vec<Expected>,
    /// The compared texts, if the kind is [`WrongReply`](ViolationKind::WrongReply).
    pub reply: Option<ReplyMismatch>,
    /// The known protocol with a similar name, if the kind is
    /// [`Misspelled`](ViolationKind::Misspelled).
    pub similar: Option<String>,
}

/// An `in-reply-to` that does not match.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct ReplyMismatch {
    /// The `reply-with` of the message to be answered. Of a long text, only the last 32 bytes.
    pub expected: String,
    /// The `in-reply-to` of the message. Of a long text, only the last 32 bytes.
    pub received: String,
}

/// The kind of a violation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ViolationKind {
    /// The state does not allow the message.
    Unexpected,
    /// The state allows the message only from the other side.
    WrongSender,
    /// The message cannot be sent to one of its receivers.
    WrongReceiver,
    /// The sender has already sent the same performative with the same `reply-with`.
    Repeated,
    /// A later state allows the message: a step is missing.
    OutOfOrder,
    /// The conversation has ended.
    Ended,
    /// The sender does not take part in the conversation.
    Stranger,
    /// The message cannot begin a conversation, and the monitor has none with its identifier: it did
    /// not begin, it began before the monitor did, or it ended long ago.
    NotOpened,
    /// `in-reply-to` differs from the `reply-with` of the message that it answers.
    WrongReply,
    /// The conversation follows another protocol.
    WrongProtocol,
    /// The conversation has too many participants or embedded conversations: see
    /// [`MonitorLimits`](crate::MonitorLimits).
    TooMany,
    /// The message exceeds the limits of the monitor, so that it cannot be checked: its
    /// conversation-id or a name is too long, or it names too many agents. An observer has
    /// [`Unchecked::TooLarge`] instead.
    TooLarge,
    /// The message has a known protocol and no conversation-id.
    NoConversation,
    /// The name of the protocol is unknown and similar to a known one.
    Misspelled,
    /// The message continues a conversation that the monitor does not know.
    Unsolicited,
    /// A rule of the protocol about several participants does not allow the message: for example,
    /// another participant has already been accepted.
    Guard,
}

/// A message that a state allows.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Expected {
    /// The performatives, for example `agree, refuse`.
    pub performative: String,
    /// Sending role, or the agent that has it.
    pub from: String,
    /// Receiving role, or the agent that has it.
    pub to: String,
}

/// The reason that a message cannot be checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, thiserror::Error)]
#[non_exhaustive]
pub enum Unchecked {
    /// The message has no conversation identifier.
    #[error("the message has no conversation-id")]
    NoConversation,
    /// The message begins a conversation and has no protocol.
    #[error("the message has no protocol")]
    NoProtocol,
    /// The library has no machine for the protocol.
    #[error("the protocol has no state machine, so its messages are not checked")]
    UnknownProtocol,
    /// The message has no sender.
    #[error("the message has no sender")]
    NoSender,
    /// The message has no receiver.
    #[error("the message has no receiver")]
    NoReceiver,
    /// The message belongs to a conversation, or a protocol within one, that began between other
    /// agents, and the monitored agent has not received the earlier messages. Examples are the first
    /// answers to an agent that a `reply-to` names.
    #[error("the conversation, or the protocol within it, began between other agents")]
    BegunElsewhere,
    /// The message may continue a conversation that the monitor does not know: it began before the
    /// monitor, the monitor has removed it, or a `reply-to` that the monitor has not seen names the
    /// agent.
    #[error("the monitor does not know the beginning of the conversation")]
    UnknownHistory,
    /// The message is a not-understood that answers a violation.
    #[error("the message answers a message that violates its protocol")]
    AnswersViolation,
    /// The conversation identifier or a name is too long, or the message has too many receivers.
    #[error(
        "the message exceeds the limits of the monitor: its conversation-id or a name is too \
         long, or it has too many receivers"
    )]
    TooLarge,
}

impl ViolationKind {
    /// Name of the kind in JSON: `unexpected`, `wrong-sender` and so on.
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
            Self::TooLarge => "too-large",
            Self::NoConversation => "no-conversation",
            Self::Misspelled => "misspelled",
            Self::Unsolicited => "unsolicited",
            Self::Guard => "guard",
        }
    }

    /// Whether a [`MonitorPolicy`](crate::MonitorPolicy) causes the violation, and not the state of a conversation.
    #[must_use]
    pub fn depends_on_policy(self) -> bool {
        matches!(
            self,
            Self::NoConversation | Self::Misspelled | Self::Unsolicited
        )
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
        let to: Vec<_> = receivers.iter().map(|name| escape_name(name)).collect();
        let to = to.join(" and ");
        write!(
            f,
            "{} from {} to {} breaks {} in conversation {conversation_id:?}: ",
            escape(performative),
            escape_name(sender),
            to,
            escape(protocol)
        )?;
        f.write_str(match self.kind {
            ViolationKind::Unexpected => "the state does not allow this message",
            ViolationKind::WrongSender => "only the other side may send this message",
            ViolationKind::WrongReceiver => "the message cannot be sent to this receiver",
            ViolationKind::Repeated => "the sender has already sent this message",
            ViolationKind::OutOfOrder => "the message is too early, a step is missing",
            ViolationKind::Ended => "the conversation has ended",
            ViolationKind::Stranger => "the sender does not take part",
            ViolationKind::NotOpened => {
                "the conversation is unknown, and the message cannot begin one"
            }
            ViolationKind::WrongReply => "in-reply-to does not match reply-with",
            ViolationKind::WrongProtocol => "the conversation follows another protocol",
            ViolationKind::TooMany => {
                "the conversation has more participants or parts than the monitor allows"
            }
            ViolationKind::TooLarge => {
                "the message exceeds the limits of the monitor: its conversation-id or a name is \
                 too long, or it names too many agents"
            }
            ViolationKind::NoConversation => "the message has a protocol and no conversation-id",
            ViolationKind::Misspelled => "the protocol is unknown",
            ViolationKind::Unsolicited => {
                "the conversation is unknown, and the message only continues one"
            }
            ViolationKind::Guard => {
                "the states of the other participants do not allow this message"
            }
        })?;
        if let Some(similar) = &self.similar {
            write!(f, "; a known protocol is {}", escape(similar))?;
        }
        if let Some(ReplyMismatch { expected, received }) = &self.reply {
            write!(f, "; expected {expected:?}, received {received:?}")?;
        }
        let of_state = match self.kind {
            ViolationKind::Ended => "last state",
            _ => "state",
        };
        match (&self.state, &self.participant) {
            (Some(state), Some(participant)) => {
                let participant = escape_name(participant);
                write!(f, "; {of_state} {state:?} with {participant}")?;
            }
            (Some(state), None) => write!(f, "; {of_state} {state:?}")?,
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
