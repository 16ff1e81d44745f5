//! The initiator's side of request, query, request-when and propose, with one participant.

use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};

#[cfg(feature = "actions")]
use super::dialogue::DialogueState;
use super::dialogue::{Dialogue, DialogueError, after, only_delivered};
use super::reachability::Reachability;
use super::receivers::single;
use crate::agent::{Agent, AgentCore};

impl Agent {
    /// Requests an action from an agent (FIPA00026). The message is a `request` with one receiver. The
    /// call sets its protocol, conversation id, `reply-with` and `reply-by`. All answers must arrive
    /// within `patience`.
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
        patience: Duration,
    ) -> Result<Request, DialogueError> {
        Request::begin(&self.core, "fipa-request", request, patience).await
    }

    /// Queries an agent for the truth of a proposition (`query-if`) or for an object (`query-ref`)
    /// (FIPA00027); see [`request`](Self::request).
    ///
    /// # Errors
    /// See [`request`](Self::request).
    pub async fn query(
        &self,
        query: MessageBuilder,
        patience: Duration,
    ) -> Result<Request, DialogueError> {
        Request::begin(&self.core, "fipa-query", query, patience).await
    }

    /// Requests an action from an agent once a condition holds (`request-when`, FIPA00028); see
    /// [`request`](Self::request).
    ///
    /// # Errors
    /// See [`request`](Self::request).
    pub async fn request_when(
        &self,
        request: MessageBuilder,
        patience: Duration,
    ) -> Result<Request, DialogueError> {
        Request::begin(&self.core, "fipa-request-when", request, patience).await
    }

    /// Proposes an action of this agent to another agent (`propose`, FIPA00036), and waits for the
    /// decision.
    ///
    /// # Errors
    /// If the message does not begin the protocol, is not delivered, or is not decided on within
    /// `patience`.
    pub async fn propose(
        &self,
        proposal: MessageBuilder,
        patience: Duration,
    ) -> Result<Decision, DialogueError> {
        let due = after(patience);
        let (proposal, _) = single(&self.core, proposal)?;
        let opened = Dialogue::open(&self.core, "fipa-propose", proposal, due);
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
#[derive(Debug)]
#[must_use = "result() returns the answer"]
pub struct Request {
    dialogue: Dialogue,
    receivers: Vec<AgentId>,
    due: Option<Instant>,
    /// A message that arrived before the caller asked for it.
    early: Option<Message>,
    agreed: bool,
}

impl Request {
    pub(crate) async fn begin(
        core: &Arc<AgentCore>,
        protocol: &str,
        request: MessageBuilder,
        patience: Duration,
    ) -> Result<Self, DialogueError> {
        let due = after(patience);
        let (request, receivers) = single(core, request)?;
        let (dialogue, sent) = Dialogue::open(core, protocol, request, due).await?;
        only_delivered(&sent)?;
        Ok(Self {
            dialogue,
            receivers,
            due,
            early: None,
            agreed: false,
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

    /// Waits for the first answer, and returns whether it is an `agree`. If it is the result itself,
    /// [`result`](Self::result) returns it.
    ///
    /// # Errors
    /// If the other side refuses, fails, is gone, or does not answer in time.
    pub async fn agreed(&mut self) -> Result<bool, DialogueError> {
        if !self.agreed && self.early.is_none() {
            let message = self.dialogue.receive(self.due).await?.message;
            match message.performative() {
                Performative::Agree => self.agreed = true,
                Performative::Refuse => return Err(DialogueError::Refused(Box::new(message))),
                Performative::Failure => return Err(DialogueError::Failed(Box::new(message))),
                _ => self.early = Some(message),
            }
        }
        Ok(self.agreed)
    }

    /// Waits for the result, an `inform`.
    ///
    /// # Errors
    /// If the other side refuses, fails, is gone, or does not answer in time.
    pub async fn result(mut self) -> Result<Message, DialogueError> {
        self.finished().await
    }

    /// Waits for the result like [`result`](Self::result). Dropping the future loses no message.
    pub(crate) async fn finished(&mut self) -> Result<Message, DialogueError> {
        self.agreed().await?;
        if let Some(early) = self.early.take() {
            return match early.performative() {
                Performative::Failure => Err(DialogueError::Failed(Box::new(early))),
                _ => Ok(early),
            };
        }
        let message = self.dialogue.receive(self.due).await?.message;
        match message.performative() {
            Performative::Failure => Err(DialogueError::Failed(Box::new(message))),
            _ => Ok(message),
        }
    }

    /// Cancels the request and waits for the confirmation of the other side.
    ///
    /// # Errors
    /// If the other side does not cancel ([`DialogueError::Failed`]), or does not answer within
    /// `patience`.
    pub async fn cancel(mut self, patience: Duration) -> Result<(), DialogueError> {
        self.dialogue.cancel(self.receivers, after(patience)).await
    }

    /// Cancels like [`cancel`](Self::cancel), and returns whether the other side has cancelled.
    /// Otherwise the request has ended or goes on, and [`finished`](Self::finished) returns its result.
    #[cfg(feature = "actions")]
    pub(crate) async fn stop(&mut self, patience: Duration) -> Result<bool, DialogueError> {
        if self.early.is_some() {
            return Ok(false);
        }
        let due = after(patience);
        let cancel = self.dialogue.agent().message(Performative::Cancel);
        let cancel = cancel.receivers(self.receivers.clone());
        only_delivered(&self.dialogue.send(cancel, due).await?)?;
        let crossed = match self.dialogue.receive(due).await {
            Ok(answer) if answer.meaning.state == DialogueState::Cancelled => return Ok(true),
            // The other side does not cancel.
            Ok(answer) if !answer.meaning.over => return Ok(false),
            Ok(answer) => answer.message,
            // The result crossed the cancel.
            Err(DialogueError::Cancelled(message)) => *message,
            Err(error) => return Err(error),
        };
        self.early = Some(crossed);
        Ok(false)
    }
}
