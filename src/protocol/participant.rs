//! Answering: what a participant does with a message that begins a protocol.

use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{Message, MessageBuilder, Performative};

use super::dialogue::{Dialogue, DialogueError, after, name_of, only_delivered, unreached};
use crate::agent::Agent;
use crate::delivery::deliveries;

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
            first: first.clone(),
            last: first.clone(),
            over: false,
            early: None,
            asked: Vec::new(),
        })
    }
}

/// A participant's side of a conversation. Dropped without a reply, it tells the initiator nothing.
pub struct Task<'a> {
    dialogue: Dialogue<'a>,
    first: Message,
    /// What is answered.
    last: Message,
    /// Whether nothing can follow what the initiator said last.
    over: bool,
    /// What came instead of a decision.
    early: Option<Message>,
    /// To whom something was passed on, and who may still answer.
    asked: Vec<String>,
}

impl Task<'_> {
    /// What the initiator said last.
    #[must_use]
    pub fn message(&self) -> &Message {
        &self.last
    }

    /// Where the conversation is, by the name of the state in the protocol's file (`fipa protocol show
    /// NAME`).
    #[must_use]
    pub fn state(&self) -> &str {
        self.dialogue.state()
    }

    /// Says that it will be done (`agree`).
    ///
    /// # Errors
    /// When the protocol does not allow that now, or it does not arrive.
    pub async fn agree(&mut self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        self.say(Performative::Agree, content).await
    }

    /// Tells something (`inform`) without ending the conversation: for subscriptions, and for brokers
    /// and recruiters that have passed on what they were asked to.
    ///
    /// # Errors
    /// See [`agree`](Self::agree).
    pub async fn inform(&mut self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        self.say(Performative::Inform, content).await
    }

    /// Makes a proposal (`propose`) and waits until it is decided upon: whether it was accepted.
    /// When it was not, there may be another call ([`next_call`](Self::next_call)).
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
        let answer = self.hear(after(patience)).await?;
        match answer.performative() {
            Performative::AcceptProposal => Ok(true),
            Performative::RejectProposal => Ok(false),
            // A revised call, or the next thing in an auction.
            _ => {
                self.early = Some(answer);
                Ok(false)
            }
        }
    }

    /// Waits for the next call for proposals: the revised one of an iterated contract net, or the next
    /// price of an auction. None when there is no further one: the proposal was rejected for good, or
    /// the auction has ended. What was said is in [`message`](Self::message).
    ///
    /// ```no_run
    /// # use fipa::protocol::{DialogueError, Task};
    /// use std::time::Duration;
    ///
    /// const PATIENCE: Duration = Duration::from_secs(60);
    ///
    /// /// Bids up to 20 in an English auction, and says whether it has won.
    /// async fn bid(task: &mut Task<'_>) -> Result<bool, DialogueError> {
    ///     while let Some(call) = task.next_call(PATIENCE).await? {
    ///         let price = String::from_utf8_lossy(call.content().map_or(b"", |c| c)).into_owned();
    ///         // Who leads has nothing to gain from bidding more.
    ///         let leads = task.state() == "called-leading";
    ///         if !leads && price.parse::<u32>().is_ok_and(|price| price <= 20) {
    ///             task.propose("", PATIENCE).await?;
    ///         }
    ///     }
    ///     Ok(task.state() == "won")
    /// }
    /// ```
    ///
    /// # Errors
    /// When nothing is said within `patience`, or something else than that.
    pub async fn next_call(
        &mut self,
        patience: Duration,
    ) -> Result<Option<Message>, DialogueError> {
        if self.over {
            return Ok(None);
        }
        let said = self.next(patience).await?;
        match said.performative() {
            Performative::Cfp => Ok(Some(said)),
            Performative::Inform | Performative::RejectProposal => Ok(None),
            _ => Err(DialogueError::Unexpected(Box::new(said))),
        }
    }

    /// Waits for what the initiator says next, for example what the winner of an auction is asked for.
    ///
    /// # Errors
    /// When nothing is said within `patience`.
    pub async fn next(&mut self, patience: Duration) -> Result<Message, DialogueError> {
        match self.early.take() {
            Some(early) => Ok(early),
            None => self.hear(after(patience)).await,
        }
    }

    /// Passes something on, as a broker (FIPA00033) or recruiter (FIPA00034) that has agreed: the message
    /// begins another protocol, which it names, within this conversation. To a recruiter's message
    /// the initiator gets the answers, unless it has a `reply-to` already; a broker gets them with
    /// [`next_answer`](Self::next_answer). Tell the initiator with [`inform`](Self::inform) that it
    /// is done.
    ///
    /// ```no_run
    /// # use fipa::protocol::{DialogueError, Reply, Task};
    /// # use fipa::{Agent, AgentId, Performative};
    /// use std::time::Duration;
    ///
    /// async fn broker(agent: &Agent, task: &mut Task<'_>) -> Result<Reply, DialogueError> {
    ///     task.agree("").await?;
    ///     let Ok(arm) = AgentId::new("arm_1") else {
    ///         return Ok(Reply::Failure("no match".into()));
    ///     };
    ///     let query = agent.message(Performative::QueryRef).receiver(arm);
    ///     let query = query.protocol("fipa-query").content("(load ?x)");
    ///     let patience = Duration::from_secs(5);
    ///     task.pass_on(query, patience).await?;
    ///     task.inform("passed on").await?;
    ///     while let Some(answer) = task.next_answer(patience).await? {
    ///         task.forward(&answer).await?;
    ///     }
    ///     Ok(Reply::Nothing)
    /// }
    /// ```
    ///
    /// # Errors
    /// When the message begins no protocol that may run here, or arrives at none of its receivers.
    pub async fn pass_on(
        &mut self,
        message: MessageBuilder,
        patience: Duration,
    ) -> Result<(), DialogueError> {
        let recruits = self.dialogue.follows("fipa-recruiting");
        let mut message = message;
        let built = message.clone().build()?;
        if recruits && built.reply_to().is_empty() {
            let answers_to = self
                .dialogue
                .agent()
                .reply(&self.first, Performative::Inform);
            let answers_to = answers_to.build()?;
            let agents = answers_to.receivers().iter().cloned();
            message = agents.fold(message, MessageBuilder::reply_to);
        }
        let sending = self.dialogue.post_within(message, after(patience))?;
        let told = deliveries(sending).await;
        let lost: Vec<&str> = unreached(&told).collect();
        let all = built.receivers().iter().map(|agent| agent.name());
        let reached: Vec<String> = all
            .filter(|name| !lost.contains(name))
            .map(str::to_owned)
            .collect();
        if reached.is_empty() {
            return only_delivered(&told);
        }
        if !recruits {
            self.asked.extend(reached);
        }
        Ok(())
    }

    /// The next answer to what was passed on, as a broker; none when nobody can answer any more.
    ///
    /// # Errors
    /// When none comes within `patience`, or the initiator cancels.
    pub async fn next_answer(
        &mut self,
        patience: Duration,
    ) -> Result<Option<Message>, DialogueError> {
        let due = after(patience);
        while !self.asked.is_empty() {
            let (answer, over) = match self.dialogue.hear(due).await {
                Ok(heard) => (heard.message, heard.meaning.over),
                Err(DialogueError::NotUnderstood(message)) => (*message, true),
                // Who it is about was found out before.
                Err(DialogueError::Undelivered(_)) => continue,
                Err(other) => return Err(self.noted(other)),
            };
            let from = name_of(&answer);
            let Some(at) = self.asked.iter().position(|name| *name == from) else {
                return Err(DialogueError::Unexpected(Box::new(answer)));
            };
            if over {
                self.asked.swap_remove(at);
            }
            return Ok(Some(answer));
        }
        Ok(None)
    }

    /// Passes an answer back to the initiator, as a broker, with its performative and content. A
    /// `failure` ends the brokering.
    ///
    /// # Errors
    /// When the protocol does not allow that now, as before [`inform`](Self::inform), or it does
    /// not arrive.
    pub async fn forward(&mut self, answer: &Message) -> Result<(), DialogueError> {
        let agent = self.dialogue.agent();
        let mut message = agent.reply(&self.first, answer.performative().clone());
        message = match answer.content() {
            Some(content) => message.content(content.clone()),
            None => message,
        };
        for (text, set) in [
            (answer.language(), MessageBuilder::language as fn(_, _) -> _),
            (answer.encoding(), MessageBuilder::encoding),
            (answer.ontology(), MessageBuilder::ontology),
        ] {
            if let Some(text) = text {
                message = set(message, text);
            }
        }
        only_delivered(&self.dialogue.tell(message, None).await?)
    }

    /// Waits until the initiator cancels, for those who work in the meantime (with
    /// `tokio::select!`). Confirm it with [`confirm_cancel`](Self::confirm_cancel).
    ///
    /// # Errors
    /// When something else is said.
    pub async fn cancelled(&mut self) -> Result<(), DialogueError> {
        match self.hear(None).await {
            Err(DialogueError::Cancelled(_)) => Ok(()),
            Ok(message) => Err(DialogueError::Unexpected(Box::new(message))),
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

    /// What the initiator says.
    async fn hear(&mut self, due: Option<Instant>) -> Result<Message, DialogueError> {
        match self.dialogue.hear(due).await {
            Ok(heard) => {
                self.last = heard.message.clone();
                self.over = heard.meaning.over;
                Ok(heard.message)
            }
            Err(error) => Err(self.noted(error)),
        }
    }

    /// A cancel is what is answered next.
    fn noted(&mut self, error: DialogueError) -> DialogueError {
        if let DialogueError::Cancelled(message) = &error {
            self.last = Message::clone(message);
        }
        error
    }
}
