//! One conversation that a call leads.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, BuildError, Message, MessageBuilder, Performative, Time, escape};
use fipa_monitor::{Header, Monitor, Unchecked, Verdict, Violation};
use fipa_mts::{Sending, letter_for};
use fipa_transport::{FailureReason, Incarnation, Outcome};

use crate::agent::Agent;
use crate::delivery::{Deliveries, Delivery, deliveries};
use crate::error::{ReceiveError, SendError};

/// The error of a conversation.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DialogueError {
    /// The other side refused. Holds its `refuse`.
    #[error("the other side refused: {0}")]
    Refused(Box<Message>),
    /// The other side failed. Holds its `failure`.
    #[error("the other side failed: {0}")]
    Failed(Box<Message>),
    /// The other side did not understand a message. Holds its `not-understood`.
    #[error("the other side did not understand a message: {0}")]
    NotUnderstood(Box<Message>),
    /// The initiator cancelled the conversation. Holds its `cancel`.
    #[error("the initiator cancelled: {0}")]
    Cancelled(Box<Message>),
    /// A message was not delivered.
    #[error("not delivered to {}: {reason}", escape(receiver))]
    NotDelivered {
        /// The name of the receiver.
        receiver: String,
        /// The reason.
        reason: FailureReason,
    },
    /// A message transport service reported a message as not delivered. Holds the report.
    #[error("a message transport service reports an undelivered message: {0}")]
    Undelivered(Box<Message>),
    /// No message arrived within the given time.
    #[error("no answer arrived in time")]
    TimedOut,
    /// The other side sent a message that the protocol allows but the call does not expect.
    #[error("received a message that this call does not expect: {0}")]
    Unexpected(Box<Message>),
    /// The other side violated the protocol.
    #[error("{violation}")]
    Violation {
        /// The violation.
        violation: Box<Violation>,
        /// The message.
        message: Box<Message>,
    },
    /// The message to be sent violates the protocol, and was not sent.
    #[error("not sent: {0}")]
    WouldViolate(Box<Violation>),
    /// The message cannot be checked against a protocol, for example because it names none.
    #[error("cannot follow the protocol: {0}")]
    Unchecked(Unchecked),
    /// The auction has no winner.
    #[error("the auction has no winner: no bid was accepted")]
    NoWinner,
    /// The message cannot be built.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// The message cannot be sent.
    #[error(transparent)]
    Send(#[from] SendError),
    /// No message can be received.
    #[error(transparent)]
    Receive(ReceiveError),
}

/// A received message and its meaning for the conversation.
pub(super) struct Interpreted {
    pub(super) message: Message,
    pub(super) meaning: Meaning,
}

/// The meaning of a message for its conversation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Meaning {
    pub(super) state: DialogueState,
    /// Whether it is the last message that its sender may send in the conversation.
    pub(super) over: bool,
    /// Whether it answers a message that a later one has replaced, and so has no effect.
    pub(super) void: bool,
}

/// The state of a conversation after a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DialogueState {
    /// A state of its own protocol.
    Own,
    /// A state of a protocol within the conversation that other agents began.
    Delegated,
    NotUnderstood,
    Cancelling,
    Cancelled,
    Undelivered,
}

/// A conversation. After dropping it, its further messages go to [`Agent::receive`].
pub(super) struct Dialogue<'a> {
    agent: &'a Agent,
    protocol: String,
    id: String,
    monitor: Monitor,
    /// The state of its own protocol, with the agent of the last message.
    state: String,
    replies: u32,
}

impl<'a> Dialogue<'a> {
    /// Begins a conversation of this protocol. The first answer must arrive by `due`.
    pub(super) async fn open(
        agent: &'a Agent,
        protocol: &str,
        first: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<(Self, Deliveries), DialogueError> {
        let id = format!("{}--{}", agent.name(), Incarnation::random());
        let mut dialogue = Self::led(agent, protocol, id);
        let deliveries = dialogue.send(first, due).await?;
        Ok((dialogue, deliveries))
    }

    /// Takes part in the conversation that a message has begun.
    pub(super) fn join(agent: &'a Agent, first: &Message) -> Result<Self, DialogueError> {
        let id = first.conversation_id();
        let id = id.ok_or(DialogueError::Unchecked(Unchecked::NoConversation))?;
        let mut dialogue = Self::led(agent, first.protocol().unwrap_or_default(), id.to_owned());
        dialogue
            .check(first)
            .map_err(|failure| failure.on_received(first))?;
        Ok(dialogue)
    }

    fn led(agent: &'a Agent, protocol: &str, id: String) -> Self {
        agent.demultiplexer.begin(&id);
        let library = Arc::clone(agent.domain().inner.rules.library());
        Self {
            agent,
            protocol: protocol.to_owned(),
            id,
            monitor: Monitor::agent(library, agent.name()),
            state: String::new(),
            replies: 0,
        }
    }

    /// Sends a message in this conversation, with `due` as its `reply-by`, and waits for the outcomes.
    pub(super) async fn send(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Deliveries, DialogueError> {
        Ok(deliveries(self.post(message, due)?).await)
    }

    /// Sends a message like [`send`](Self::send), without waiting for the outcomes.
    pub(super) fn post(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Sending, DialogueError> {
        let message = message.protocol(self.protocol.as_str());
        self.post_within(message, due)
    }

    /// Sends a message like [`post`](Self::post), in the protocol that the message names, which runs
    /// within this one.
    pub(super) fn post_within(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Sending, DialogueError> {
        self.replies += 1;
        let mut message = message
            .conversation_id(self.id.as_str())
            .reply_with(format!("{}--{}", self.id, self.replies));
        let mut deadline = self.agent.domain().inner.deadline;
        if let Some(due) = due {
            let left = due.saturating_duration_since(Instant::now());
            deadline = deadline.min(left);
            let by = SystemTime::now().checked_add(left);
            if let Some(by) = by.and_then(|by| Time::from_system_time(by).ok()) {
                message = message.reply_by(by);
            }
        }
        let message = message.build()?;
        self.check(&message).map_err(CheckFailure::on_sent)?;
        let letter = letter_for(&message, SystemTime::now());
        Ok(self.agent.endpoint.send(&message, letter, deadline)?)
    }

    /// Answers a message of this conversation, and waits for the outcome.
    pub(super) async fn answer(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        let sending = self.post_answer(to, act, content, due)?;
        only_delivered(&deliveries(sending).await)
    }

    /// Answers a message without waiting for the outcome, so that an unreachable agent does not delay
    /// answers to others.
    pub(super) fn post_answer(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        due: Option<Instant>,
    ) -> Result<Sending, DialogueError> {
        self.post(self.agent.reply(to, act).content(content), due)
    }

    /// Answers a message of a protocol that runs within this one, in that protocol.
    pub(super) async fn answer_within(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        let answer = self.agent.reply(to, act).content(content);
        let sending = self.post_within(answer, due)?;
        only_delivered(&deliveries(sending).await)
    }

    /// Waits for the next message until `due`. A message that violates the protocol is an error, and so
    /// are not-understood, cancel and the report of an undelivered message.
    pub(super) async fn receive(
        &mut self,
        due: Option<Instant>,
    ) -> Result<Interpreted, DialogueError> {
        let next = self
            .agent
            .demultiplexer
            .next_of(&self.agent.endpoint, &self.id);
        let received = match due {
            None => next.await,
            Some(due) => tokio::time::timeout_at(due.into(), next)
                .await
                .map_err(|_| DialogueError::TimedOut)?,
        };
        let message = match received {
            Ok(incoming) => incoming.message,
            Err(ReceiveError::Violation {
                violation,
                incoming,
            }) => {
                let message = Box::new(incoming.message);
                return Err(DialogueError::Violation { violation, message });
            }
            Err(other) => return Err(DialogueError::Receive(other)),
        };
        let meaning = self.check(&message);
        let meaning = meaning.map_err(|failure| failure.on_received(&message))?;
        match meaning.state {
            DialogueState::NotUnderstood => Err(DialogueError::NotUnderstood(Box::new(message))),
            DialogueState::Cancelling => Err(DialogueError::Cancelled(Box::new(message))),
            DialogueState::Undelivered => Err(DialogueError::Undelivered(Box::new(message))),
            _ => Ok(Interpreted { message, meaning }),
        }
    }

    /// Cancels the conversation with these agents (FIPA's cancel meta-protocol), and waits until all
    /// have answered. The error is that of the first agent that did not cancel.
    pub(super) async fn cancel(
        &mut self,
        mut with: Vec<AgentId>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        if with.is_empty() {
            return Ok(());
        }
        let cancel = self.agent.message(Performative::Cancel);
        let sent = self.send(cancel.receivers(with.clone()), due).await?;
        let mut result = only_delivered(&sent);
        with.retain(|agent| !unreached(&sent).any(|name| name == agent.name()));
        while !with.is_empty() {
            let (from, answer) = match self.receive(due).await {
                Ok(Interpreted { message, meaning }) => {
                    let from = name_of(&message);
                    match meaning.state {
                        DialogueState::Cancelled => (from, Ok(())),
                        _ => (from, Err(DialogueError::Failed(Box::new(message)))),
                    }
                }
                Err(DialogueError::NotUnderstood(message)) => {
                    let from = name_of(&message);
                    (from, Err(DialogueError::NotUnderstood(message)))
                }
                // A cancel that crossed this one, or an outcome that is known already.
                Err(DialogueError::Cancelled(_) | DialogueError::Undelivered(_)) => continue,
                Err(other) => return Err(other),
            };
            if let Some(at) = with.iter().position(|agent| agent.name() == from) {
                with.swap_remove(at);
                result = result.and(answer);
            }
        }
        result
    }

    pub(super) fn id(&self) -> &str {
        &self.id
    }

    /// Returns the agent whose side of the conversation this is.
    pub(super) fn agent(&self) -> &'a Agent {
        self.agent
    }

    pub(super) fn state(&self) -> &str {
        &self.state
    }

    /// Whether the conversation follows the protocol of this name, including its aliases.
    pub(super) fn follows(&self, protocol: &str) -> bool {
        let machine = self.monitor.library().find(&self.protocol);
        machine.is_some_and(|machine| machine.is_called(protocol))
    }

    fn check(&mut self, message: &Message) -> Result<Meaning, CheckFailure> {
        let now = SystemTime::now();
        let own = Meaning {
            state: DialogueState::Own,
            over: false,
            void: false,
        };
        match self.monitor.check(&Header::from(message), now) {
            Verdict::Accepted(accepted) => {
                if message.protocol().is_none_or(|name| name == self.protocol) {
                    accepted.state.clone_into(&mut self.state);
                }
                Ok(Meaning {
                    state: match accepted.state {
                        _ if accepted.elsewhere => DialogueState::Delegated,
                        _ if accepted.own => DialogueState::Own,
                        "not-understood" => DialogueState::NotUnderstood,
                        "cancelling" => DialogueState::Cancelling,
                        "cancelled" => DialogueState::Cancelled,
                        "undelivered" => DialogueState::Undelivered,
                        _ => DialogueState::Own,
                    },
                    over: accepted.over,
                    void: accepted.void,
                })
            }
            Verdict::Violation(violation) => Err(CheckFailure::Violation(violation)),
            Verdict::Unchecked(Unchecked::BegunElsewhere) => Ok(Meaning {
                state: DialogueState::Delegated,
                ..own
            }),
            Verdict::Unchecked(why) => Err(CheckFailure::Unchecked(why)),
            _ => Ok(own),
        }
    }
}

impl fmt::Debug for Dialogue<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Dialogue")
            .field("protocol", &self.protocol)
            .field("id", &self.id)
            .field("state", &self.state)
            .finish_non_exhaustive()
    }
}

impl Drop for Dialogue<'_> {
    fn drop(&mut self) {
        self.agent.demultiplexer.end(&self.id);
    }
}

/// The failure of the check of a message.
enum CheckFailure {
    Violation(Box<Violation>),
    Unchecked(Unchecked),
}

impl CheckFailure {
    fn on_sent(self) -> DialogueError {
        match self {
            Self::Violation(violation) => DialogueError::WouldViolate(violation),
            Self::Unchecked(why) => DialogueError::Unchecked(why),
        }
    }

    fn on_received(self, message: &Message) -> DialogueError {
        match self {
            Self::Violation(violation) => DialogueError::Violation {
                violation,
                message: Box::new(message.clone()),
            },
            Self::Unchecked(why) => DialogueError::Unchecked(why),
        }
    }
}

/// Waits for the outcomes of these messages, at most until `due`. The outcomes are ignored: an agent
/// that has ended needs no rejection.
pub(super) async fn settle(sent: impl IntoIterator<Item = Sending>, due: Option<Instant>) {
    for sending in sent {
        let settled = deliveries(sending);
        match due {
            None => drop(settled.await),
            Some(due) => {
                if tokio::time::timeout_at(due.into(), settled).await.is_err() {
                    return;
                }
            }
        }
    }
}

/// Returns an error unless the message was delivered to all receivers.
pub(super) fn only_delivered(deliveries: &Deliveries) -> Result<(), DialogueError> {
    for delivery in &deliveries.0 {
        if let Outcome::Failed { reason, .. } = &delivery.outcome {
            return Err(DialogueError::NotDelivered {
                receiver: delivery.receiver.to_string(),
                reason: *reason,
            });
        }
    }
    Ok(())
}

/// Returns the names of the receivers to which the message was not delivered.
pub(super) fn unreached(deliveries: &Deliveries) -> impl Iterator<Item = &str> {
    let failed = |delivery: &&Delivery| !delivery.outcome.is_success();
    let failed = deliveries.0.iter().filter(failed);
    failed.map(|delivery| &*delivery.receiver)
}

/// Returns the name of the sender.
pub(super) fn name_of(message: &Message) -> String {
    let sender = message.sender();
    sender.map_or_else(String::new, |sender| sender.name().to_owned())
}

/// Returns the time after this span from now, or `None` if it cannot be represented.
pub(super) fn after(span: Duration) -> Option<Instant> {
    Instant::now().checked_add(span)
}
