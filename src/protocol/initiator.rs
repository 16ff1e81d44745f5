//! Asking one agent: request, query, request-when; and proposing.

use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};

use super::dialogue::{Dialogue, DialogueError, after, only_delivered};
use crate::agent::Agent;

impl Agent {
    /// Asks an agent to perform an action (FIPA00026). The message is a `request` with one
    /// receiver; protocol, conversation and what a reply needs are filled in. All answers must
    /// have come within `patience`.
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
    ///     println!("arm_1 is at it");
    /// }
    /// println!("{}", request.result().await?);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// When the message is none that begins the protocol, or does not arrive.
    pub async fn request(
        &self,
        request: MessageBuilder,
        patience: Duration,
    ) -> Result<Request<'_>, DialogueError> {
        Request::begin(self, "fipa-request", request, patience).await
    }

    /// Asks an agent whether something is true (`query-if`) or for an object (`query-ref`)
    /// (FIPA00027); see [`request`](Self::request).
    ///
    /// # Errors
    /// See [`request`](Self::request).
    pub async fn query(
        &self,
        query: MessageBuilder,
        patience: Duration,
    ) -> Result<Request<'_>, DialogueError> {
        Request::begin(self, "fipa-query", query, patience).await
    }

    /// Asks an agent to perform an action once a condition holds (`request-when`, FIPA00028); see
    /// [`request`](Self::request).
    ///
    /// # Errors
    /// See [`request`](Self::request).
    pub async fn request_when(
        &self,
        request: MessageBuilder,
        patience: Duration,
    ) -> Result<Request<'_>, DialogueError> {
        Request::begin(self, "fipa-request-when", request, patience).await
    }

    /// Proposes to an agent to do something oneself (`propose`, FIPA00036), and waits for its
    /// decision.
    ///
    /// # Errors
    /// When the message is none that begins the protocol, does not arrive, or is not decided upon
    /// within `patience`.
    pub async fn propose(
        &self,
        proposal: MessageBuilder,
        patience: Duration,
    ) -> Result<Decision, DialogueError> {
        let due = after(patience);
        let (mut dialogue, sent) = Dialogue::open(self, "fipa-propose", proposal, due).await?;
        only_delivered(&sent)?;
        let message = dialogue.hear(due).await?.message;
        Ok(match message.performative() {
            Performative::AcceptProposal => Decision::Accepted(message),
            _ => Decision::Rejected(message),
        })
    }
}

/// What became of a proposal.
#[derive(Debug, Clone, PartialEq, Eq)]
#[allow(clippy::exhaustive_enums, reason = "the standard is final")]
pub enum Decision {
    /// It was accepted.
    Accepted(Message),
    /// It was rejected.
    Rejected(Message),
}

/// Something that an agent was asked for. Dropped, it is no longer waited for, but not cancelled.
#[must_use = "the answer comes with result()"]
pub struct Request<'a> {
    dialogue: Dialogue<'a>,
    receivers: Vec<AgentId>,
    due: Option<Instant>,
    /// What has come before it was asked for.
    early: Option<Message>,
    agreed: bool,
}

impl<'a> Request<'a> {
    async fn begin(
        agent: &'a Agent,
        protocol: &str,
        request: MessageBuilder,
        patience: Duration,
    ) -> Result<Self, DialogueError> {
        let due = after(patience);
        let receivers = request.clone().build()?.receivers().to_vec();
        let (dialogue, sent) = Dialogue::open(agent, protocol, request, due).await?;
        only_delivered(&sent)?;
        Ok(Self {
            dialogue,
            receivers,
            due,
            early: None,
            agreed: false,
        })
    }

    /// The conversation's id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// Waits until the other side agrees, or does what it was asked for at once: whether it said
    /// that it agrees.
    ///
    /// # Errors
    /// When it refuses, fails, or does not answer in time.
    pub async fn agreed(&mut self) -> Result<bool, DialogueError> {
        if !self.agreed && self.early.is_none() {
            let message = self.dialogue.hear(self.due).await?.message;
            match message.performative() {
                Performative::Agree => self.agreed = true,
                Performative::Refuse => return Err(DialogueError::Refused(Box::new(message))),
                Performative::Failure => return Err(DialogueError::Failed(Box::new(message))),
                _ => self.early = Some(message),
            }
        }
        Ok(self.agreed)
    }

    /// Waits for the result: the `inform` with what the other side has to say.
    ///
    /// # Errors
    /// When it refuses, fails, or does not answer in time.
    pub async fn result(mut self) -> Result<Message, DialogueError> {
        self.agreed().await?;
        if let Some(early) = self.early.take() {
            return Ok(early);
        }
        let message = self.dialogue.hear(self.due).await?.message;
        match message.performative() {
            Performative::Failure => Err(DialogueError::Failed(Box::new(message))),
            _ => Ok(message),
        }
    }

    /// Cancels what was asked for, and waits until the other side has confirmed that.
    ///
    /// # Errors
    /// When it is not cancelled ([`DialogueError::Failed`]), or it is not said in time whether it
    /// is.
    pub async fn cancel(mut self, patience: Duration) -> Result<(), DialogueError> {
        self.dialogue.cancel(self.receivers, after(patience)).await
    }
}
