//! Answering: what a participant does with a message that begins a protocol.

use std::time::Duration;

use bytes::Bytes;
use fipa_acl::{Message, Performative};

use super::dialogue::{Dialogue, DialogueError, after};
use crate::agent::Agent;

/// How a participant answers in the end.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Reply {
    /// It will not (`refuse`), with a reason.
    Refuse(Bytes),
    /// It is done, or this is the answer (`inform`).
    Inform(Bytes),
    /// It was tried in vain (`failure`), with a reason.
    Failure(Bytes),
    /// The proposal that was made is accepted (`accept-proposal`).
    Accept(Bytes),
    /// It is not (`reject-proposal`).
    Reject(Bytes),
    /// All has been said already, for example because the initiator cancelled.
    Nothing,
}

impl Agent {
    /// Takes part in the conversation that a message of a known protocol begins. What is said in
    /// it is checked against the protocol before it is sent.
    ///
    /// ```no_run
    /// use fipa::protocol::{DialogueError, Reply, Task};
    ///
    /// async fn lift(task: &mut Task<'_>) -> Result<Reply, DialogueError> {
    ///     if task.message().content().is_none() {
    ///         return Ok(Reply::Refuse("lift what?".into()));
    ///     }
    ///     task.agree("").await?;
    ///     Ok(Reply::Inform("done".into()))
    /// }
    ///
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// let incoming = agent.receive().await?;
    /// let mut task = agent.take_part(&incoming.message)?;
    /// let reply = lift(&mut task).await?;
    /// task.reply(reply).await?;
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// When the message begins no known protocol.
    pub fn take_part(&self, first: &Message) -> Result<Task<'_>, DialogueError> {
        Ok(Task {
            dialogue: Dialogue::join(self, first)?,
            last: first.clone(),
        })
    }
}

/// A participant's side of a conversation. Dropped without a reply, it tells the initiator nothing.
pub struct Task<'a> {
    dialogue: Dialogue<'a>,
    /// What is answered.
    last: Message,
}

impl Task<'_> {
    /// What the initiator said last.
    #[must_use]
    pub fn message(&self) -> &Message {
        &self.last
    }

    /// Says that it will be done (`agree`).
    ///
    /// # Errors
    /// When the protocol does not allow that now, or it does not arrive.
    pub async fn agree(&mut self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        self.say(Performative::Agree, content).await
    }

    /// Tells something (`inform`) without ending the conversation: for subscriptions.
    ///
    /// # Errors
    /// See [`agree`](Self::agree).
    pub async fn inform(&mut self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        self.say(Performative::Inform, content).await
    }

    /// Makes a proposal (`propose`) and waits until it is decided upon: whether it was accepted.
    ///
    /// # Errors
    /// When the protocol does not allow that now, it does not arrive, or nothing is decided within
    /// `patience`.
    pub async fn propose(
        &mut self,
        content: impl Into<Bytes>,
        patience: Duration,
    ) -> Result<bool, DialogueError> {
        self.say(Performative::Propose, content).await?;
        self.last = self.dialogue.hear(after(patience)).await?.message;
        Ok(*self.last.performative() == Performative::AcceptProposal)
    }

    /// Waits until the initiator cancels, for those who work in the meantime (with
    /// `tokio::select!`). Confirm it with [`confirm_cancel`](Self::confirm_cancel).
    ///
    /// # Errors
    /// When something else is said.
    pub async fn cancelled(&mut self) -> Result<(), DialogueError> {
        match self.dialogue.hear(None).await {
            Err(DialogueError::Cancelled(message)) => {
                self.last = *message;
                Ok(())
            }
            Ok(heard) => Err(DialogueError::Unexpected(Box::new(heard.message))),
            Err(other) => Err(other),
        }
    }

    /// Says that what was asked for is cancelled; what is left to reply is nothing then.
    ///
    /// # Errors
    /// See [`agree`](Self::agree).
    pub async fn confirm_cancel(&mut self) -> Result<Reply, DialogueError> {
        self.say(Performative::Inform, "cancelled").await?;
        Ok(Reply::Nothing)
    }

    /// Says the last thing.
    ///
    /// # Errors
    /// See [`agree`](Self::agree).
    pub async fn reply(mut self, reply: Reply) -> Result<(), DialogueError> {
        let (act, content) = match reply {
            Reply::Refuse(content) => (Performative::Refuse, content),
            Reply::Inform(content) => (Performative::Inform, content),
            Reply::Failure(content) => (Performative::Failure, content),
            Reply::Accept(content) => (Performative::AcceptProposal, content),
            Reply::Reject(content) => (Performative::RejectProposal, content),
            Reply::Nothing => return Ok(()),
        };
        self.say(act, content).await
    }

    async fn say(
        &mut self,
        act: Performative,
        content: impl Into<Bytes>,
    ) -> Result<(), DialogueError> {
        self.dialogue.answer(&self.last, act, content, None).await
    }
}
