//! The initiator's side of request, query, request-when and propose, with one participant.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_monitor::Violation;

use super::dialogue::{Dialogue, DialogueError, DialogueState, Interpreted, after, only_delivered};
use super::protocols::Protocols;
use super::reachability::Reachability;
use super::receivers::single;
use crate::agent::{Agent, AgentCore};

impl Agent {
    /// Requests an action from an agent (FIPA00026). The message is a `request` with one receiver. The
    /// call sets its protocol, conversation id, `reply-with` and `reply-by`. All answers must arrive
    /// within `timeout`.
    ///
    /// The receiver may be a pattern, or a coalition with a leader, that stands for one agent now. The
    /// request ends with [`DialogueError::Gone`] as soon as the host of the agent reports that it has left
    /// or died. Without a sign of life of that host, [`Request::reachability`] reports this, and the
    /// request goes on.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::{AgentId, Performative};
    ///
    /// let lift = agent
    ///     .message(Performative::Request)
    ///     .receiver(AgentId::new("arm_1")?)
    ///     .content("(lift crate)");
    /// let mut request = agent.request(lift, Duration::from_secs(30)).await?;
    /// if request.agreed().await? {
    ///     println!("arm_1 agreed");
    /// }
    /// println!("{}", request.result().await?);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// If the message does not begin the protocol, or is not delivered.
    pub async fn request(
        &self,
        request: MessageBuilder,
        timeout: Duration,
    ) -> Result<Request, DialogueError> {
        Request::begin(&self.core, "fipa-request", request, timeout).await
    }

    /// Queries an agent for the truth of a proposition (`query-if`) or for an object (`query-ref`)
    /// (FIPA00027); see [`request`](Self::request).
    ///
    /// # Errors
    /// See [`request`](Self::request).
    pub async fn query(
        &self,
        query: MessageBuilder,
        timeout: Duration,
    ) -> Result<Request, DialogueError> {
        Request::begin(&self.core, "fipa-query", query, timeout).await
    }
}

impl Protocols<'_> {
    /// Requests an action from an agent once a condition holds (`request-when`, FIPA00028); see
    /// [`Agent::request`].
    ///
    /// # Errors
    /// See [`Agent::request`].
    pub async fn request_when(
        self,
        request: MessageBuilder,
        timeout: Duration,
    ) -> Result<Request, DialogueError> {
        Request::begin(self.core, "fipa-request-when", request, timeout).await
    }

    /// Proposes an action of this agent to another agent (`propose`, FIPA00036), and waits for the
    /// decision.
    ///
    /// # Errors
    /// If the message does not begin the protocol, is not delivered, or is not decided on within
    /// `timeout`.
    pub async fn propose(
        self,
        proposal: MessageBuilder,
        timeout: Duration,
    ) -> Result<Decision, DialogueError> {
        let due = after(timeout);
        let (proposal, _) = single(self.core, proposal)?;
        let opened = Dialogue::open(self.core, "fipa-propose", proposal, due);
        let (mut dialogue, sent) = opened.await?;
        only_delivered(&sent)?;
        let message = dialogue.receive(due).await?.message;
        Ok(match message.performative() {
            Performative::AcceptProposal => Decision::Accepted(message),
            _ => Decision::Rejected(message),
        })
    }
}

/// The decision on a proposal.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum Decision {
    /// The proposal was accepted. Holds the `accept-proposal`.
    Accepted(Message),
    /// The proposal was rejected. Holds the `reject-proposal`.
    Rejected(Message),
}

/// A request or query. Dropping it does not cancel it; further answers go to [`Agent::receive`].
///
/// A message of the other side that violates the protocol, for example a second `agree`, does not end
/// the wait for the right one. If none arrives in time, the error is the first violation.
#[derive(Debug)]
#[must_use = "result() returns the answer"]
pub struct Request {
    dialogue: Dialogue,
    receivers: Vec<AgentId>,
    due: Option<Instant>,
    agreed: bool,
    /// The end of the request, if it arrived before the caller asked for it. It stays, so that each call
    /// returns it.
    end: Option<End>,
    /// The first message that violated the protocol.
    violation: Option<(Box<Violation>, Box<Message>)>,
}

/// The end of a request.
#[derive(Debug, Clone)]
enum End {
    /// An `inform`, `refuse` or `failure`.
    Answer(Message),
    NotUnderstood(Message),
    Undelivered(Message),
    /// The other side has confirmed the cancel.
    Cancelled(Message),
}

impl End {
    fn into_result(self) -> Result<Message, DialogueError> {
        Err(match self {
            Self::Answer(message) => match message.performative() {
                Performative::Refuse => DialogueError::Refused(Box::new(message)),
                Performative::Failure => DialogueError::Failed(Box::new(message)),
                _ => return Ok(message),
            },
            Self::NotUnderstood(message) => DialogueError::NotUnderstood(Box::new(message)),
            Self::Undelivered(message) => DialogueError::Undelivered(Box::new(message)),
            Self::Cancelled(message) => DialogueError::Cancelled(Box::new(message)),
        })
    }
}

/// The effect of a message on a request.
enum Progress {
    Agreed,
    Ended,
    /// The other side does not cancel.
    GoesOn,
}

impl Request {
    pub(crate) async fn begin(
        core: &Arc<AgentCore>,
        protocol: &str,
        request: MessageBuilder,
        timeout: Duration,
    ) -> Result<Self, DialogueError> {
        let due = after(timeout);
        let (request, receivers) = single(core, request)?;
        let (dialogue, sent) = Dialogue::open(core, protocol, request, due).await?;
        only_delivered(&sent)?;
        Ok(Self {
            dialogue,
            receivers,
            due,
            agreed: false,
            end: None,
            violation: None,
        })
    }

    /// Returns the conversation id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// Returns a receiver of changes of the reachability of the other agent.
    #[must_use]
    pub fn reachability(&self) -> Reachability {
        self.dialogue.reachability()
    }

    /// Takes over the receivers of the reachability of another conversation with the other agent.
    #[cfg(feature = "actions")]
    pub(crate) fn take_reachability(&mut self, other: &mut Self) {
        self.dialogue.take_reachability(&mut other.dialogue);
    }

    /// Waits for the first answer, and returns whether it is an `agree`. If it is the result itself,
    /// [`result`](Self::result) returns it.
    ///
    /// # Errors
    /// If the other side refuses, fails, is gone, or does not answer in time.
    pub async fn agreed(&mut self) -> Result<bool, DialogueError> {
        while !self.agreed && self.end.is_none() {
            self.progress(self.due).await?;
        }
        match &self.end {
            Some(end) if !self.agreed => end.clone().into_result().map(|_| false),
            _ => Ok(self.agreed),
        }
    }

    /// Waits for the result, an `inform`.
    ///
    /// # Errors
    /// If the other side refuses, fails, is gone, or does not answer in time, or if the request was
    /// cancelled ([`DialogueError::Cancelled`]). Dropping the future loses no message, and the next call waits on.
    /// The conversation stays with the request until it is dropped.
    pub async fn result(&mut self) -> Result<Message, DialogueError> {
        loop {
            if let Some(end) = &self.end {
                return end.clone().into_result();
            }
            self.progress(self.due).await?;
        }
    }

    /// Cancels the request, waits for the answer of the other side, and returns true if it has cancelled.
    /// Returns false if the request has ended in the meantime or goes on; [`result`](Self::result) then
    /// returns its result.
    ///
    /// # Errors
    /// If the other side is gone, or does not answer within `timeout`. [`result`](Self::result) can
    /// still wait.
    pub async fn cancel(&mut self, timeout: Duration) -> Result<bool, DialogueError> {
        if self.end.is_some() {
            return Ok(matches!(self.end, Some(End::Cancelled(_))));
        }
        let due = after(timeout);
        let cancel = self.dialogue.agent().message(Performative::Cancel);
        let cancel = cancel.receivers(self.receivers.clone());
        only_delivered(&self.dialogue.send(cancel, due).await?)?;
        loop {
            match self.progress(due).await? {
                // It was sent before the cancel arrived.
                Progress::Agreed => {}
                Progress::GoesOn => return Ok(false),
                Progress::Ended => {
                    return match &self.end {
                        Some(End::Cancelled(_)) => Ok(true),
                        // The result crossed the cancel.
                        Some(End::Answer(_)) => Ok(false),
                        Some(end) => end.clone().into_result().map(|_| false),
                        None => Ok(false),
                    };
                }
            }
        }
    }

    /// Waits for the next message that has an effect.
    async fn progress(&mut self, due: Option<Instant>) -> Result<Progress, DialogueError> {
        loop {
            let end = match self.dialogue.receive(due).await {
                Ok(received) if received.meaning.void => continue,
                Ok(Interpreted { message, meaning }) => match message.performative() {
                    _ if meaning.state == DialogueState::Cancelled => End::Cancelled(message),
                    Performative::Agree => {
                        self.agreed = true;
                        return Ok(Progress::Agreed);
                    }
                    Performative::Failure if !meaning.over => return Ok(Progress::GoesOn),
                    _ => End::Answer(message),
                },
                // A message that crossed the cancel.
                Err(DialogueError::Cancelled(message)) => match message.performative() {
                    Performative::Agree => {
                        self.agreed = true;
                        return Ok(Progress::Agreed);
                    }
                    _ => End::Answer(*message),
                },
                Err(DialogueError::NotUnderstood(message)) => End::NotUnderstood(*message),
                Err(DialogueError::Undelivered(message)) => End::Undelivered(*message),
                Err(DialogueError::Violation { violation, message }) => {
                    self.violation.get_or_insert((violation, message));
                    continue;
                }
                Err(DialogueError::TimedOut) => {
                    return Err(match self.violation.take() {
                        Some((violation, message)) => {
                            DialogueError::Violation { violation, message }
                        }
                        None => DialogueError::TimedOut,
                    });
                }
                Err(other) => return Err(other),
            };
            self.end = Some(end);
            return Ok(Progress::Ended);
        }
    }
}
