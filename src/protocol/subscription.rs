//! Subscriptions (FIPA00035).

use std::time::Duration;

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};

use super::dialogue::{Dialogue, DialogueError, after, only_delivered};
use crate::agent::Agent;

impl Agent {
    /// Subscribes to the notifications of an agent (`subscribe`, FIPA00035). Waits until the agent
    /// agrees or sends the first notification.
    ///
    /// # Errors
    /// If the message does not begin the protocol, is not delivered, is refused, or is not answered
    /// within `patience`.
    pub async fn subscribe(
        &self,
        subscribe: MessageBuilder,
        patience: Duration,
    ) -> Result<Subscription<'_>, DialogueError> {
        let due = after(patience);
        let receivers = subscribe.clone().build()?.receivers().to_vec();
        let (mut dialogue, sent) = Dialogue::open(self, "fipa-subscribe", subscribe, due).await?;
        only_delivered(&sent)?;
        let first = dialogue.receive(due).await?.message;
        let early = match first.performative() {
            Performative::Agree => None,
            Performative::Refuse => return Err(DialogueError::Refused(Box::new(first))),
            Performative::Failure => return Err(DialogueError::Failed(Box::new(first))),
            _ => Some(first),
        };
        Ok(Subscription {
            dialogue,
            receivers,
            early,
        })
    }
}

/// A subscription. Dropping it does not cancel it; further notifications go to [`Agent::receive`].
#[derive(Debug)]
#[must_use = "next() returns the notifications"]
pub struct Subscription<'a> {
    dialogue: Dialogue<'a>,
    receivers: Vec<AgentId>,
    early: Option<Message>,
}

impl Subscription<'_> {
    /// Returns the conversation id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// Waits for the next notification (`inform`), without a time limit.
    ///
    /// # Errors
    /// If the other side ends the subscription with `failure`, or violates the protocol.
    pub async fn next(&mut self) -> Result<Message, DialogueError> {
        if let Some(early) = self.early.take() {
            return Ok(early);
        }
        let message = self.dialogue.receive(None).await?.message;
        match message.performative() {
            Performative::Failure => Err(DialogueError::Failed(Box::new(message))),
            _ => Ok(message),
        }
    }

    /// Cancels the subscription and waits for the confirmation of the other side.
    ///
    /// # Errors
    /// If the other side continues the subscription ([`DialogueError::Failed`]), or does not answer
    /// within `patience`.
    pub async fn cancel(mut self, patience: Duration) -> Result<(), DialogueError> {
        self.dialogue.cancel(self.receivers, after(patience)).await
    }
}
