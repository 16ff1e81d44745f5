//! The participant's side of a conversation.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use fipa_acl::{Message, MessageBuilder, Performative};
use parking_lot::Mutex;

use super::dialogue::{
    Dialogue, DialogueError, Speaker, after, name_of, only_delivered, unreached,
};
use super::receivers::expand;
use crate::agent::delivery::deliveries;
use crate::agent::incoming::Incoming;
#[cfg(feature = "opentelemetry")]
use crate::agent::trace_context;
use crate::agent::{Agent, AgentCore};

/// The last message of a participant.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Reply {
    /// Refuses the request (`refuse`). Holds the reason.
    Refuse(Bytes),
    /// Reports the completion or the answer (`inform`). Holds the content.
    Inform(Bytes),
    /// Reports a failure (`failure`). Holds the reason.
    Failure(Bytes),
    /// Accepts the initiator's proposal (`accept-proposal`). Holds the content.
    Accept(Bytes),
    /// Rejects the initiator's proposal (`reject-proposal`). Holds the reason.
    Reject(Bytes),
    /// Sends no message, for example because the cancel of the initiator is already confirmed.
    Nothing,
}

impl Agent {
    /// Takes part in the conversation that a message of a known protocol begins. Every message of the
    /// conversation is checked against the protocol before it is sent.
    ///
    /// ```no_run
    /// use fipa::protocol::{DialogueError, Reply, Task};
    ///
    /// async fn lift(task: &mut Task) -> Result<Reply, DialogueError> {
    ///     if task.message().content().is_none() {
    ///         return Ok(Reply::Refuse("lift what?".into()));
    ///     }
    ///     task.agree("").await?;
    ///     Ok(Reply::Inform("done".into()))
    /// }
    ///
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// let incoming = agent.receive().await?;
    /// let mut task = agent.take_part(&incoming)?;
    /// let reply = lift(&mut task).await?;
    /// task.reply(reply).await?;
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// The further messages of the initiator go to the task, also those that wait for [`receive`](Agent::receive).
    ///
    /// # Errors
    /// If the message does not begin a known protocol ([`DialogueError::NotOpening`] or
    /// [`DialogueError::Unchecked`]), for example because it is an answer.
    pub fn take_part(&self, first: &Incoming) -> Result<Task, DialogueError> {
        Task::join(&self.core, first, None)
    }
}

/// The participant's side of a conversation.
///
/// Dropping it before the conversation is over tells the initiator: with `failure`, or with
/// `not-understood` if nothing was sent yet.
#[derive(Debug)]
pub struct Task {
    dialogue: Dialogue,
    first: Message,
    /// The letter of the first message.
    #[cfg(feature = "opentelemetry")]
    first_letter: fipa_acl::Letter,
    /// The last message of the initiator, which the next message answers.
    last: Message,
    /// A message that arrived instead of a decision.
    early: Option<Message>,
    /// The agents to which a message was passed on and that may still answer.
    asked: Vec<String>,
    /// Whether the initiator expects no further message: the last one was sent.
    is_done: bool,
    /// Receives the right to send the last message when the task is dropped.
    home: Option<Home>,
}

/// The place of the [`Farewell`] of a dropped task.
pub(super) type Home = Arc<Mutex<Option<Farewell>>>;

/// The right to send the last message of a task that was dropped.
pub(super) struct Farewell {
    speaker: Speaker,
    last: Message,
}

impl std::fmt::Debug for Farewell {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Farewell").finish_non_exhaustive()
    }
}

impl Farewell {
    /// Sends the last message of the participant.
    pub(super) async fn reply(mut self, reply: Reply) -> Result<(), DialogueError> {
        let Some((act, content)) = reply.into_parts() else {
            return Ok(());
        };
        let sent = self.speaker.post_answer(&self.last, act, content, None);
        match sent {
            Ok(sending) => only_delivered(&deliveries(sending).await),
            Err(error) => {
                self.fail(&error.to_string());
                Err(error)
            }
        }
    }

    /// Refuses a conversation in which nothing was sent.
    pub(super) fn refuse(mut self, reason: &str) {
        let act = Performative::Refuse;
        match self
            .speaker
            .post_answer(&self.last, act, reason.to_owned(), None)
        {
            // The letter is sent although its outcome is not awaited.
            Ok(sending) => drop(sending),
            Err(_) => self.fail(reason),
        }
    }

    /// Tells the initiator that the task has failed.
    pub(super) fn fail(mut self, reason: &str) {
        self.speaker.abandon(&self.last, reason);
    }
}

impl Drop for Task {
    fn drop(&mut self) {
        if self.is_done {
            return;
        }
        let farewell = Farewell {
            speaker: self.dialogue.take_speaker(),
            last: self.last.clone(),
        };
        match &self.home {
            Some(home) => *home.lock() = Some(farewell),
            None => farewell.fail("the participant has dropped the task"),
        }
    }
}

impl Reply {
    /// Returns the performative and the content of the message, if there is one.
    fn into_parts(self) -> Option<(Performative, Bytes)> {
        Some(match self {
            Self::Refuse(content) => (Performative::Refuse, content),
            Self::Inform(content) => (Performative::Inform, content),
            Self::Failure(content) => (Performative::Failure, content),
            Self::Accept(content) => (Performative::AcceptProposal, content),
            Self::Reject(content) => (Performative::RejectProposal, content),
            Self::Nothing => return None,
        })
    }
}

impl Task {
    pub(super) fn join(
        core: &Arc<AgentCore>,
        first: &Incoming,
        home: Option<Home>,
    ) -> Result<Self, DialogueError> {
        Ok(Self {
            dialogue: Dialogue::join(core, first)?,
            first: first.message().clone(),
            #[cfg(feature = "opentelemetry")]
            first_letter: first.letter().clone(),
            last: first.message().clone(),
            early: None,
            asked: Vec::new(),
            is_done: false,
            home,
        })
    }

    /// See [`Dialogue::may_return`].
    #[cfg(feature = "actions")]
    pub(crate) fn may_return(&self) -> bool {
        self.dialogue.may_return()
    }

    /// Returns the last message of the initiator.
    #[must_use]
    pub fn message(&self) -> &Message {
        &self.last
    }

    /// Returns an OpenTelemetry context whose span is the remote one in which the first message of the conversation was
    /// sent (feature `opentelemetry`); see [`Incoming::trace_context`].
    #[cfg(feature = "opentelemetry")]
    #[must_use]
    pub fn trace_context(&self) -> opentelemetry::Context {
        trace_context::of(&self.first_letter)
    }

    /// Returns the state of the conversation: the name of the state in the file of the protocol
    /// (`fipa protocol show NAME`).
    #[must_use]
    pub fn state(&self) -> &str {
        self.dialogue.state()
    }

    /// Agrees to the request (`agree`).
    ///
    /// # Errors
    /// If the protocol does not allow the message in this state, or it is not delivered.
    pub async fn agree(&mut self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        self.send(Performative::Agree, content).await
    }

    /// Sends an `inform` that does not end the conversation: a notification of a subscription, or the
    /// report of a broker or recruiter that it has passed the message on.
    ///
    /// # Errors
    /// See [`agree`](Self::agree).
    pub async fn inform(&mut self, content: impl Into<Bytes>) -> Result<(), DialogueError> {
        self.send(Performative::Inform, content).await
    }

    /// Makes a proposal (`propose`), waits for the decision, and returns whether it was accepted. After
    /// a rejection there may be another call ([`next_call`](Self::next_call)).
    ///
    /// # Errors
    /// If the protocol does not allow the message in this state, if it is not delivered, or if no
    /// decision arrives within `timeout`.
    pub async fn propose(
        &mut self,
        content: impl Into<Bytes>,
        timeout: Duration,
    ) -> Result<bool, DialogueError> {
        self.send(Performative::Propose, content).await?;
        let answer = self.receive(after(timeout)).await?;
        match answer.performative() {
            Performative::AcceptProposal => Ok(true),
            Performative::RejectProposal => Ok(false),
            // A revised call, or the next message of an auction.
            _ => {
                self.early = Some(answer);
                Ok(false)
            }
        }
    }

    /// Waits for the next call for proposals: the revised call of an iterated contract net, or the next
    /// price of an auction. Returns `None` if there is no further call, because the proposal was
    /// finally rejected or the auction has ended. [`message`](Self::message) then returns the last
    /// message.
    ///
    /// ```no_run
    /// # use fipa::protocol::{DialogueError, Task};
    /// use std::time::Duration;
    ///
    /// const TIMEOUT: Duration = Duration::from_secs(60);
    ///
    /// /// Bids up to 20 in an English auction, and returns whether it has won.
    /// async fn bid(task: &mut Task) -> Result<bool, DialogueError> {
    ///     while let Some(call) = task.next_call(TIMEOUT).await? {
    ///         let price = String::from_utf8_lossy(call.content().map_or(b"", |c| c)).into_owned();
    ///         // The leading bidder gains nothing from a higher bid.
    ///         let leads = task.state() == "called-leading";
    ///         if !leads && price.parse::<u32>().is_ok_and(|price| price <= 20) {
    ///             task.propose("", TIMEOUT).await?;
    ///         }
    ///     }
    ///     Ok(task.state() == "won")
    /// }
    /// ```
    ///
    /// # Errors
    /// If no message arrives within `timeout`, or a message of another kind arrives.
    pub async fn next_call(&mut self, timeout: Duration) -> Result<Option<Message>, DialogueError> {
        if self.early.is_none() && self.dialogue.is_over() {
            return Ok(None);
        }
        let message = self.next(timeout).await?;
        match message.performative() {
            Performative::Cfp => Ok(Some(message)),
            Performative::Inform | Performative::RejectProposal => Ok(None),
            _ => Err(DialogueError::Unexpected(Box::new(message))),
        }
    }

    /// Waits for the next message of the initiator, for example the request to the winner of an
    /// auction.
    ///
    /// # Errors
    /// If no message arrives within `timeout`.
    pub async fn next(&mut self, timeout: Duration) -> Result<Message, DialogueError> {
        match self.early.take() {
            Some(early) => Ok(early),
            None => self.receive(after(timeout)).await,
        }
    }

    /// Passes a message on, as a broker (FIPA00033) or recruiter (FIPA00034) that has agreed. The
    /// message begins another protocol, which it names, within this conversation. A broker gets the
    /// answers with [`next_answer`](Self::next_answer). The answers to a recruiter's message go to the
    /// initiator, unless the message has a `reply-to`. Report the completion to the initiator with
    /// [`inform`](Self::inform).
    ///
    /// ```no_run
    /// # use fipa::protocol::{DialogueError, Reply, Task};
    /// # use fipa::{Agent, AgentId, Performative};
    /// use std::time::Duration;
    ///
    /// async fn broker(agent: &Agent, task: &mut Task) -> Result<Reply, DialogueError> {
    ///     task.agree("").await?;
    ///     let Ok(arm) = AgentId::new("arm_1") else {
    ///         return Ok(Reply::Failure("no match".into()));
    ///     };
    ///     let query = agent.message(Performative::QueryRef).receiver(arm);
    ///     let query = query.protocol("fipa-query").content("(load ?x)");
    ///     let timeout = Duration::from_secs(5);
    ///     task.pass_on(query, timeout).await?;
    ///     task.inform("passed on").await?;
    ///     while let Some(answer) = task.next_answer(timeout).await? {
    ///         task.forward(&answer).await?;
    ///     }
    ///     Ok(Reply::Nothing)
    /// }
    /// ```
    ///
    /// # Errors
    /// If the message does not begin a protocol that is allowed within this one, or if it is delivered
    /// to none of its receivers.
    pub async fn pass_on(
        &mut self,
        message: MessageBuilder,
        timeout: Duration,
    ) -> Result<(), DialogueError> {
        let recruits = self.dialogue.follows("fipa-recruiting");
        let mut message = message;
        let mut built = message.clone().build()?;
        let expanded = expand(self.dialogue.agent(), built.receivers()).agents;
        if !expanded.is_empty() {
            message = message.replace_receivers(expanded);
            built = message.clone().build()?;
        }
        if !recruits {
            for receiver in built.receivers() {
                self.dialogue.admit(receiver.name());
            }
        }
        if recruits && built.reply_to().is_empty() {
            let endpoint = &self.dialogue.agent().endpoint;
            let to_initiator = endpoint.reply(&self.first, Performative::Inform);
            let to_initiator = to_initiator.build()?;
            let agents = to_initiator.receivers().iter().cloned();
            message = agents.fold(message, MessageBuilder::reply_to);
        }
        let sent = self.dialogue.post_within(message, after(timeout))?;
        let sent = self.dialogue.outcomes(sent).await;
        let lost: Vec<&str> = unreached(&sent).collect();
        let all = built.receivers().iter().map(|agent| agent.name());
        let reached: Vec<String> = all
            .filter(|name| !lost.contains(name))
            .map(str::to_owned)
            .collect();
        if reached.is_empty() {
            return only_delivered(&sent);
        }
        if !recruits {
            for name in &reached {
                self.dialogue.watch(name);
            }
            self.asked.extend(reached);
        }
        Ok(())
    }

    /// Waits, as a broker, for the next answer to a message that was passed on. Returns `None` if no
    /// further agent can answer.
    ///
    /// # Errors
    /// If no answer arrives within `timeout`, if the initiator cancels, or if the initiator or an agent
    /// that was to answer is gone.
    pub async fn next_answer(
        &mut self,
        timeout: Duration,
    ) -> Result<Option<Message>, DialogueError> {
        let due = after(timeout);
        while !self.asked.is_empty() {
            let (answer, over) = match self.dialogue.receive(due).await {
                Ok(received) => (received.message, received.meaning.over),
                Err(DialogueError::NotUnderstood(message)) => (*message, true),
                // `pass_on` has already left out its receiver.
                Err(DialogueError::Undelivered(_)) => continue,
                Err(DialogueError::Gone { agent }) => {
                    self.asked.retain(|name| *name != agent);
                    return Err(DialogueError::Gone { agent });
                }
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

    /// Forwards an answer to the initiator, as a broker, with its performative and content. A `failure`
    /// ends the brokering.
    ///
    /// # Errors
    /// If the protocol does not allow the message in this state, for example before
    /// [`inform`](Self::inform), or if it is not delivered.
    pub async fn forward(&mut self, answer: &Message) -> Result<(), DialogueError> {
        let endpoint = &self.dialogue.agent().endpoint;
        let mut message = endpoint.reply(&self.first, answer.performative().clone());
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
        only_delivered(&self.dialogue.send(message, None).await?)
    }

    /// Waits for a cancel of the initiator, for use in `tokio::select!` beside the work. Confirm the
    /// cancel with [`confirm_cancel`](Self::confirm_cancel).
    ///
    /// # Errors
    /// If another message arrives, or the initiator is gone ([`DialogueError::Gone`]).
    pub async fn cancelled(&mut self) -> Result<(), DialogueError> {
        match self.receive(None).await {
            Err(DialogueError::Cancelled(_)) => Ok(()),
            Ok(message) => Err(DialogueError::Unexpected(Box::new(message))),
            Err(other) => Err(other),
        }
    }

    /// Confirms a cancel of the initiator. Returns [`Reply::Nothing`], because no reply may follow.
    ///
    /// # Errors
    /// See [`agree`](Self::agree).
    pub async fn confirm_cancel(&mut self) -> Result<Reply, DialogueError> {
        self.send(Performative::Inform, "cancelled").await?;
        Ok(Reply::Nothing)
    }

    /// Answers a cancel of the initiator with `failure`: the conversation goes on.
    #[cfg(feature = "actions")]
    pub(crate) async fn fail_cancel(
        &mut self,
        content: impl Into<Bytes>,
    ) -> Result<(), DialogueError> {
        self.send(Performative::Failure, content).await?;
        // The result answers the request, not the cancel.
        self.last = self.first.clone();
        Ok(())
    }

    /// Sends the last message of the participant.
    ///
    /// # Errors
    /// See [`agree`](Self::agree).
    pub async fn reply(mut self, reply: Reply) -> Result<(), DialogueError> {
        if let Some((act, content)) = reply.into_parts() {
            self.send(act, content).await?;
        }
        self.is_done = true;
        Ok(())
    }

    async fn send(
        &mut self,
        act: Performative,
        content: impl Into<Bytes>,
    ) -> Result<(), DialogueError> {
        self.dialogue.answer(&self.last, act, content, None).await
    }

    /// Waits for the next message of the initiator.
    async fn receive(&mut self, due: Option<Instant>) -> Result<Message, DialogueError> {
        match self.dialogue.receive(due).await {
            Ok(received) => {
                self.last = received.message.clone();
                Ok(received.message)
            }
            Err(error) => Err(self.noted(error)),
        }
    }

    /// Stores a cancel as the message that the next message answers.
    fn noted(&mut self, error: DialogueError) -> DialogueError {
        if let DialogueError::Cancelled(message) = &error {
            self.last = Message::clone(message);
        }
        error
    }
}
