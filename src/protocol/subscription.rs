//! Being told of every change (FIPA00035).

use std::time::Duration;

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};

use super::dialogue::{Dialogue, DialogueError, after, only_delivered};
use crate::agent::Agent;

impl Agent {
    /// Subscribes to what an agent has to tell (`subscribe`, FIPA00035), and waits until it
    /// agrees, or tells something at once.
    ///
    /// # Errors
    /// When the message is none that begins the protocol, does not arrive, is refused, or is not
    /// answered within `patience`.
    pub async fn subscribe(
        &self,
        subscribe: MessageBuilder,
        patience: Duration,
    ) -> Result<Subscription<'_>, DialogueError> {
        let due = after(patience);
        let receivers = subscribe.clone().build()?.receivers().to_vec();
        let (mut dialogue, sent) = Dialogue::open(self, "fipa-subscribe", subscribe, due).await?;
        only_delivered(&sent)?;
        let first = dialogue.hear(due).await?.message;
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

/// A subscription. Dropped, it is no longer read, but not cancelled.
#[must_use = "what is told comes with next()"]
pub struct Subscription<'a> {
    dialogue: Dialogue<'a>,
    receivers: Vec<AgentId>,
    early: Option<Message>,
}

impl Subscription<'_> {
    /// The conversation's id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        self.dialogue.id()
    }

    /// What is told next (`inform`); waits as long as it takes.
    ///
    /// # Errors
    /// When the other side ends the subscription with `failure`, or breaks the protocol.
    pub async fn next(&mut self) -> Result<Message, DialogueError> {
        if let Some(early) = self.early.take() {
            return Ok(early);
        }
        let message = self.dialogue.hear(None).await?.message;
        match message.performative() {
            Performative::Failure => Err(DialogueError::Failed(Box::new(message))),
            _ => Ok(message),
        }
    }

    /// Ends the subscription, and waits until the other side has confirmed that.
    ///
    /// # Errors
    /// When it goes on ([`DialogueError::Failed`]), or it is not said in time whether it does.
    pub async fn cancel(mut self, patience: Duration) -> Result<(), DialogueError> {
        self.dialogue.cancel(self.receivers, after(patience)).await
    }
}
