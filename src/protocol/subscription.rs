//! Subscriptions (FIPA00035).

use std::fmt;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use futures_core::Stream;
use tokio::sync::Mutex;

use super::dialogue::{Dialogue, DialogueError, after, only_delivered};
use super::reachability::Reachability;
use super::receivers::single;
use crate::agent::{Agent, AgentCore};

impl Agent {
    /// Subscribes to the notifications of an agent (`subscribe`, FIPA00035). Waits until the agent
    /// agrees or sends the first notification.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::protocol::DialogueError;
    /// use fipa::{AgentId, Performative};
    ///
    /// let subscribe = agent
    ///     .message(Performative::Subscribe)
    ///     .receiver(AgentId::new("battery")?)
    ///     .content("charge");
    /// let mut charge = agent.subscribe(subscribe, Duration::from_secs(5)).await?;
    /// loop {
    ///     match charge.next().await {
    ///         Ok(notification) => println!("{notification}"),
    ///         // The subscription goes on when the host returns.
    ///         Err(silent @ DialogueError::Unreachable { .. }) => println!("{silent}"),
    ///         Err(error) => return Err(error.into()),
    ///     }
    /// }
    /// # }
    /// ```
    ///
    /// # Errors
    /// If the message does not begin the protocol, is not delivered, is refused, or is not answered
    /// within `timeout`.
    pub async fn subscribe(
        &self,
        subscribe: MessageBuilder,
        timeout: Duration,
    ) -> Result<Subscription, DialogueError> {
        Subscription::begin(&self.core, subscribe, timeout).await
    }
}

/// A subscription. Dropping it does not cancel it; further notifications go to [`Agent::receive`].
///
/// It does not borrow the agent. It is also a [`Stream`], which ends after an error that ends the
/// subscription.
#[must_use = "next() returns the notifications"]
pub struct Subscription {
    id: String,
    reachability: Reachability,
    dialogue: Arc<Mutex<Dialogue>>,
    /// The wait of the stream for the next notification.
    waiting: Option<Waiting>,
    /// Whether the stream has returned the error that ended the subscription.
    is_over: bool,
    receivers: Vec<AgentId>,
    early: Option<Message>,
}

type Waiting = Pin<Box<dyn Future<Output = Result<Message, DialogueError>> + Send>>;

impl Subscription {
    pub(crate) async fn begin(
        core: &Arc<AgentCore>,
        subscribe: MessageBuilder,
        timeout: Duration,
    ) -> Result<Self, DialogueError> {
        let due = after(timeout);
        let (subscribe, receivers) = single(core, subscribe)?;
        let opened = Dialogue::open(core, "fipa-subscribe", subscribe, due);
        let (mut dialogue, sent) = opened.await?;
        only_delivered(&sent)?;
        let first = dialogue.receive(due).await?.message;
        let early = match first.performative() {
            Performative::Agree => None,
            Performative::Refuse => return Err(DialogueError::Refused(Box::new(first))),
            Performative::Failure => return Err(DialogueError::Failed(Box::new(first))),
            _ => Some(first),
        };
        Ok(Self {
            id: dialogue.id().to_owned(),
            reachability: dialogue.reachability(),
            dialogue: Arc::new(Mutex::new(dialogue)),
            waiting: None,
            is_over: false,
            receivers,
            early,
        })
    }

    /// Returns the conversation id.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        &self.id
    }

    /// Returns a receiver of changes of the reachability of the other agent.
    #[must_use]
    pub fn reachability(&self) -> Reachability {
        self.reachability.clone()
    }

    /// Waits for the next notification (`inform`), without a time limit. Dropping the future loses no
    /// notification.
    ///
    /// # Errors
    /// If the other side ends the subscription with `failure` or violates the protocol, or if the agent
    /// is gone ([`DialogueError::Gone`]). [`DialogueError::Unreachable`] is returned once when the host
    /// of the agent becomes silent; the subscription goes on, and later calls wait again.
    pub async fn next(&mut self) -> Result<Message, DialogueError> {
        // Dropping the wait of the stream loses no message.
        self.waiting = None;
        match self.early.take() {
            Some(early) => Ok(early),
            None => wait(Arc::clone(&self.dialogue)).await,
        }
    }

    /// Cancels the subscription and waits for the confirmation of the other side.
    ///
    /// # Errors
    /// If the other side continues the subscription ([`DialogueError::Failed`]), is gone, or does not
    /// answer within `timeout`.
    pub async fn cancel(mut self, timeout: Duration) -> Result<(), DialogueError> {
        self.waiting = None;
        let mut dialogue = self.dialogue.lock().await;
        dialogue.cancel(self.receivers, after(timeout)).await
    }
}

async fn wait(dialogue: Arc<Mutex<Dialogue>>) -> Result<Message, DialogueError> {
    let message = dialogue.lock().await.receive_or_silence().await?.message;
    match message.performative() {
        Performative::Failure => Err(DialogueError::Failed(Box::new(message))),
        _ => Ok(message),
    }
}

impl Stream for Subscription {
    type Item = Result<Message, DialogueError>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        if let Some(early) = this.early.take() {
            return Poll::Ready(Some(Ok(early)));
        }
        if this.is_over {
            return Poll::Ready(None);
        }
        let dialogue = &this.dialogue;
        let waiting = this
            .waiting
            .get_or_insert_with(|| Box::pin(wait(Arc::clone(dialogue))));
        let polled = waiting.as_mut().poll(context);
        if let Poll::Ready(received) = &polled {
            this.waiting = None;
            this.is_over = received.as_ref().is_err_and(|error| !goes_on(error));
        }
        polled.map(Some)
    }
}

/// Whether further notifications can follow after this error.
fn goes_on(error: &DialogueError) -> bool {
    matches!(
        error,
        DialogueError::Unreachable { .. }
            | DialogueError::Violation { .. }
            | DialogueError::Unchecked(_)
            | DialogueError::Undelivered(_)
    )
}

impl fmt::Debug for Subscription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Subscription")
            .field("id", &self.id)
            .field("receivers", &self.receivers)
            .finish_non_exhaustive()
    }
}
