//! One conversation that is led by a call.

use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use fipa_acl::{AgentId, BuildError, Message, MessageBuilder, Performative, Time, escape};
use fipa_monitor::{Header, Monitor, Unchecked, Verdict, Violation};
use fipa_mts::{Sending, letter_for};
use fipa_transport::{FailureReason, Incarnation, Outcome};

use crate::agent::Agent;
use crate::delivery::{Deliveries, Delivery, deliveries};
use crate::error::{ReceiveError, SendError};

/// Why a protocol did not yield what it was begun for.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DialogueError {
    /// The other side refused.
    #[error("refused: {0}")]
    Refused(Box<Message>),
    /// The other side tried, and failed.
    #[error("failed: {0}")]
    Failed(Box<Message>),
    /// The other side did not understand what was said to it.
    #[error("did not understand: {0}")]
    NotUnderstood(Box<Message>),
    /// The initiator has cancelled.
    #[error("cancelled: {0}")]
    Cancelled(Box<Message>),
    /// A message did not reach its receiver.
    #[error("not delivered to {}: {reason}", escape(receiver))]
    NotDelivered {
        /// The receiver.
        receiver: String,
        /// Why not.
        reason: FailureReason,
    },
    /// The message transport service told of a message that was not delivered.
    #[error("not delivered: {0}")]
    Undelivered(Box<Message>),
    /// Nothing was said within the time that was given.
    #[error("no answer in time")]
    TimedOut,
    /// The other side said something that the protocol allows, but nobody waited for.
    #[error("not waited for: {0}")]
    Unexpected(Box<Message>),
    /// The other side broke the protocol.
    #[error("{violation}")]
    Violation {
        /// In which way.
        violation: Box<Violation>,
        /// With what.
        message: Box<Message>,
    },
    /// What was to be said breaks the protocol.
    #[error("not sent: {0}")]
    WouldViolate(Box<Violation>),
    /// The protocol cannot be followed with such a message.
    #[error("cannot be followed: {0}")]
    Unchecked(Unchecked),
    /// Nobody has won the auction.
    #[error("nobody has won the auction: no bid was accepted")]
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

/// A message that was received, and what it means.
pub(super) struct Heard {
    pub(super) message: Message,
    pub(super) meaning: Meaning,
}

/// What a message means to its conversation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Meaning {
    pub(super) standing: Standing,
    /// Whether nothing can follow from its sender any more.
    pub(super) over: bool,
    /// Whether it answers what has been said anew since, and changes nothing.
    pub(super) void: bool,
}

/// Where a conversation is after a message.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Standing {
    /// In a state of its protocol.
    Own,
    /// It belongs to a protocol within that began between others.
    Elsewhere,
    NotUnderstood,
    Cancelling,
    Cancelled,
    Undelivered,
}

/// A conversation. Dropped, it is no longer led; what still comes goes to [`Agent::receive`].
pub(super) struct Dialogue<'a> {
    agent: &'a Agent,
    protocol: String,
    id: String,
    monitor: Monitor,
    /// Where its own protocol is, with whoever the last message concerned.
    state: String,
    replies: u32,
}

impl<'a> Dialogue<'a> {
    /// Begins a conversation of this protocol; `due` is when its first answer must have come.
    pub(super) async fn open(
        agent: &'a Agent,
        protocol: &str,
        first: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<(Self, Deliveries), DialogueError> {
        let id = format!("{}--{}", agent.name(), Incarnation::random());
        let mut dialogue = Self::led(agent, protocol, id);
        let deliveries = dialogue.tell(first, due).await?;
        Ok((dialogue, deliveries))
    }

    /// Takes part in the conversation that a message has begun.
    pub(super) fn join(agent: &'a Agent, first: &Message) -> Result<Self, DialogueError> {
        let id = first.conversation_id();
        let id = id.ok_or(DialogueError::Unchecked(Unchecked::NoConversation))?;
        let mut dialogue = Self::led(agent, first.protocol().unwrap_or_default(), id.to_owned());
        dialogue
            .check(first)
            .map_err(|wrong| wrong.of_others(first))?;
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

    /// Says something in this conversation, and that the answer is wanted by then.
    pub(super) async fn tell(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Deliveries, DialogueError> {
        Ok(deliveries(self.post(message, due)?).await)
    }

    /// The same without waiting for the outcomes: it is on its way when this returns.
    pub(super) fn post(
        &mut self,
        message: MessageBuilder,
        due: Option<Instant>,
    ) -> Result<Sending, DialogueError> {
        let message = message.protocol(self.protocol.as_str());
        self.post_within(message, due)
    }

    /// The same in the protocol that the message names, which runs within this one.
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
        self.check(&message).map_err(Wrong::of_ours)?;
        let letter = letter_for(&message, SystemTime::now());
        Ok(self.agent.endpoint.send(&message, letter, deadline)?)
    }

    /// Answers a message of this conversation.
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

    /// The same without waiting for the outcome, so that several can be answered at once and nobody
    /// waits for who cannot be reached.
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

    /// The next message, or none by then. What does not fit the protocol is an error, and so is what
    /// ends it for reasons of no protocol of its own.
    pub(super) async fn hear(&mut self, due: Option<Instant>) -> Result<Heard, DialogueError> {
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
        let meaning = meaning.map_err(|wrong| wrong.of_others(&message))?;
        match meaning.standing {
            Standing::NotUnderstood => Err(DialogueError::NotUnderstood(Box::new(message))),
            Standing::Cancelling => Err(DialogueError::Cancelled(Box::new(message))),
            Standing::Undelivered => Err(DialogueError::Undelivered(Box::new(message))),
            _ => Ok(Heard { message, meaning }),
        }
    }

    /// Cancels the conversation with these (FIPA's cancel meta-protocol), and waits until all have
    /// said whether it is cancelled. The first who did not cancel it is the error.
    pub(super) async fn cancel(
        &mut self,
        mut with: Vec<AgentId>,
        due: Option<Instant>,
    ) -> Result<(), DialogueError> {
        if with.is_empty() {
            return Ok(());
        }
        let cancel = self.agent.message(Performative::Cancel);
        let told = self.tell(cancel.receivers(with.clone()), due).await?;
        let mut result = only_delivered(&told);
        with.retain(|agent| !unreached(&told).any(|name| name == agent.name()));
        while !with.is_empty() {
            let (from, answer) = match self.hear(due).await {
                Ok(Heard { message, meaning }) => {
                    let from = name_of(&message);
                    match meaning.standing {
                        Standing::Cancelled => (from, Ok(())),
                        _ => (from, Err(DialogueError::Failed(Box::new(message)))),
                    }
                }
                Err(DialogueError::NotUnderstood(message)) => {
                    let from = name_of(&message);
                    (from, Err(DialogueError::NotUnderstood(message)))
                }
                // What had been said before the cancel came, or is known already.
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

    /// The agent whose side of the conversation this is.
    pub(super) fn agent(&self) -> &'a Agent {
        self.agent
    }

    pub(super) fn state(&self) -> &str {
        &self.state
    }

    /// Whether its protocol is the one of this name, whatever the messages call it.
    pub(super) fn follows(&self, protocol: &str) -> bool {
        let machine = self.monitor.library().find(&self.protocol);
        machine.is_some_and(|machine| machine.is_called(protocol))
    }

    fn check(&mut self, message: &Message) -> Result<Meaning, Wrong> {
        let now = SystemTime::now();
        let own = Meaning {
            standing: Standing::Own,
            over: false,
            void: false,
        };
        match self.monitor.check(&Header::from(message), now) {
            Verdict::Accepted(accepted) => {
                if message.protocol().is_none_or(|name| name == self.protocol) {
                    accepted.state.clone_into(&mut self.state);
                }
                Ok(Meaning {
                    standing: match accepted.state {
                        _ if accepted.elsewhere => Standing::Elsewhere,
                        _ if accepted.own => Standing::Own,
                        "not-understood" => Standing::NotUnderstood,
                        "cancelling" => Standing::Cancelling,
                        "cancelled" => Standing::Cancelled,
                        "undelivered" => Standing::Undelivered,
                        _ => Standing::Own,
                    },
                    over: accepted.over,
                    void: accepted.void,
                })
            }
            Verdict::Violation(violation) => Err(Wrong::Violation(violation)),
            Verdict::Unchecked(Unchecked::BegunElsewhere) => Ok(Meaning {
                standing: Standing::Elsewhere,
                ..own
            }),
            Verdict::Unchecked(why) => Err(Wrong::Unchecked(why)),
            _ => Ok(own),
        }
    }
}

impl Drop for Dialogue<'_> {
    fn drop(&mut self) {
        self.agent.demultiplexer.end(&self.id);
    }
}

enum Wrong {
    Violation(Box<Violation>),
    Unchecked(Unchecked),
}

impl Wrong {
    fn of_ours(self) -> DialogueError {
        match self {
            Self::Violation(violation) => DialogueError::WouldViolate(violation),
            Self::Unchecked(why) => DialogueError::Unchecked(why),
        }
    }

    fn of_others(self, message: &Message) -> DialogueError {
        match self {
            Self::Violation(violation) => DialogueError::Violation {
                violation,
                message: Box::new(message.clone()),
            },
            Self::Unchecked(why) => DialogueError::Unchecked(why),
        }
    }
}

/// Waits until it is known what became of these messages, though not longer than until then. That
/// changes nothing: who has gone away needs no rejection.
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

/// An error unless all receivers have got it.
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

/// The names of the receivers who have not got it.
pub(super) fn unreached(deliveries: &Deliveries) -> impl Iterator<Item = &str> {
    let failed = |delivery: &&Delivery| !delivery.outcome.is_success();
    let failed = deliveries.0.iter().filter(failed);
    failed.map(|delivery| &*delivery.receiver)
}

/// The name of the sender.
pub(super) fn name_of(message: &Message) -> String {
    let sender = message.sender();
    sender.map_or_else(String::new, |sender| sender.name().to_owned())
}

/// When a span from now is over; never, when that is beyond all times.
pub(super) fn after(span: Duration) -> Option<Instant> {
    Instant::now().checked_add(span)
}
