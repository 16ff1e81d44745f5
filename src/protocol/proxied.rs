//! The initiator's side of brokering (FIPA00033) and recruiting (FIPA00034).

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};

use super::dialogue::{Dialogue, DialogueError, DialogueState, Interpreted, after, only_delivered};
use super::protocols::Protocols;
use super::reachability::Reachability;
use super::receivers::single;
use crate::agent::AgentCore;

impl Protocols<'_> {
    /// Requests a broker to pass a message on to suitable agents and to forward their answers (`proxy`,
    /// FIPA00033). The content holds the message and the description of the agents. Waits until the
    /// broker has agreed and passed the message on.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::{AgentId, Performative};
    ///
    /// let proxy = agent
    ///     .message(Performative::Proxy)
    ///     .receiver(AgentId::new("broker")?)
    ///     .content("(any-arm (query-ref (load ?x)))");
    /// let mut answers = agent.protocols().brokering(proxy, Duration::from_secs(5)).await?;
    /// println!("{}", answers.next(Duration::from_secs(5)).await?);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// If the message does not begin the protocol or is not delivered, or if the broker refuses, finds
    /// no agent ([`DialogueError::Failed`]) or does not answer within `timeout`.
    pub async fn brokering(
        self,
        proxy: MessageBuilder,
        timeout: Duration,
    ) -> Result<Proxied, DialogueError> {
        Proxied::begin(self.core, "fipa-brokering", proxy, timeout).await
    }

    /// Requests a recruiter to pass a message on to suitable agents (FIPA00034), which answer this agent
    /// directly, in this conversation. Their first answers are not checked against the protocol of the
    /// message that was passed on, because this agent has not seen it. Continue with
    /// [`Proxied::answer`].
    ///
    /// # Errors
    /// See [`brokering`](Self::brokering).
    pub async fn recruiting(
        self,
        proxy: MessageBuilder,
        timeout: Duration,
    ) -> Result<Proxied, DialogueError> {
        Proxied::begin(self.core, "fipa-recruiting", proxy, timeout).await
    }
}

/// A message that a broker or recruiter has passed on. After dropping it, the answers go to
/// [`Agent::receive`](crate::Agent::receive).
#[derive(Debug)]
#[must_use = "next() returns the answers"]
pub struct Proxied {
    dialogue: Dialogue,
    receivers: Vec<AgentId>,
    /// Answers that arrived before the report that the message was passed on.
    early: VecDeque<Message>,
}

/// Maximum number of early answers.
const MAX_EARLY: usize = 1_024;

impl Proxied {
    async fn begin(
        core: &Arc<AgentCore>,
        protocol: &str,
        proxy: MessageBuilder,
        timeout: Duration,
    ) -> Result<Self, DialogueError> {
        let due = after(timeout);
        let (proxy, receivers) = single(core, proxy)?;
        let (dialogue, sent) = Dialogue::open(core, protocol, proxy, due).await?;
        only_delivered(&sent)?;
        let mut proxied = Self {
            dialogue,
            receivers,
            early: VecDeque::new(),
        };
        proxied.passed_on(due).await?;
        if proxied.dialogue.follows("fipa-recruiting") {
            // The answers do not depend on the recruiter any more.
            for recruiter in &proxied.receivers {
                proxied.dialogue.unwatch(recruiter.name());
            }
        }
        Ok(proxied)
    }

    async fn passed_on(&mut self, due: Option<Instant>) -> Result<(), DialogueError> {
        while self.early.len() < MAX_EARLY {
            let Interpreted { message, meaning } = self.dialogue.receive(due).await?;
            if meaning.state == DialogueState::Delegated {
                self.early.push_back(message);
                continue;
            }
            match message.performative() {
                Performative::Refuse => return Err(DialogueError::Refused(Box::new(message))),
                Performative::Failure => return Err(DialogueError::Failed(Box::new(message))),
                Performative::Inform => break,
                // An `agree`.
                _ => {}
            }
        }
        Ok(())
    }

    /// Returns a receiver of changes of the reachability of the broker, and of the recruited agents that
    /// were answered.
    #[must_use]
    pub fn reachability(&self) -> Reachability {
        self.dialogue.reachability()
    }

    /// Returns the conversation id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// Waits for the next answer of any performative, at most for `timeout`. The protocol does not mark
    /// the last answer.
    ///
    /// # Errors
    /// If no answer arrives in time, if the broker sends `failure` or is gone, or if a recruited agent
    /// that was [answered](Self::answer) is gone.
    pub async fn next(&mut self, timeout: Duration) -> Result<Message, DialogueError> {
        if let Some(early) = self.early.pop_front() {
            return Ok(early);
        }
        let due = after(timeout);
        loop {
            let Interpreted { message, meaning } = self.dialogue.receive(due).await?;
            match message.performative() {
                _ if meaning.state == DialogueState::Delegated => return Ok(message),
                Performative::Failure => return Err(DialogueError::Failed(Box::new(message))),
                // Messages of a recruiter are not answers, and may arrive after those of the agents.
                _ if self.dialogue.follows("fipa-recruiting") => {}
                _ => return Ok(message),
            }
        }
    }

    /// Answers a recruited agent in the protocol of its answer, for example accepts a proposal.
    /// [`next`](Self::next) returns its next message.
    ///
    /// ```no_run
    /// # use std::time::Duration;
    /// # use fipa::Performative;
    /// # use fipa::protocol::{DialogueError, Proxied};
    /// # async fn example(mut answers: Proxied) -> Result<(), DialogueError> {
    /// let timeout = Duration::from_secs(5);
    /// let proposal = answers.next(timeout).await?;
    /// let accept = Performative::AcceptProposal;
    /// answers.answer(&proposal, accept, "", timeout).await?;
    /// println!("{}", answers.next(timeout).await?);
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// If that protocol does not allow the message after this answer, which is always so for answers
    /// that a broker forwards, or if it is not delivered.
    pub async fn answer(
        &mut self,
        to: &Message,
        act: Performative,
        content: impl Into<bytes::Bytes>,
        timeout: Duration,
    ) -> Result<(), DialogueError> {
        let due = after(timeout);
        self.dialogue.answer_within(to, act, content, due).await?;
        if let Some(agent) = to.sender().filter(|_| to.reply_to().is_empty()) {
            self.dialogue.watch(agent.name());
        }
        Ok(())
    }

    /// Cancels the request and waits for the confirmation of the broker or recruiter.
    ///
    /// # Errors
    /// If it does not cancel ([`DialogueError::Failed`]), or does not answer within `timeout`.
    pub async fn cancel(mut self, timeout: Duration) -> Result<(), DialogueError> {
        for receiver in &self.receivers {
            self.dialogue.watch(receiver.name());
        }
        self.dialogue.cancel(self.receivers, after(timeout)).await
    }
}
