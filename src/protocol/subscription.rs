//! Subscriptions (FIPA00035), and the topics of publishers.
//!
//! A publisher of this project answers the wish of [`Keep`]. A task then reads its notifications, keeps as many as the
//! subscriber asked for, and subscribes again when the publisher has ended and returns. Another partner's notifications
//! stay in the agent's queue until the program reads them.

use std::collections::VecDeque;
use std::fmt;
use std::ops::Deref;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, Message, MessageBuilder, Performative};
use fipa_sds::Change;
use futures_core::Stream;
use tokio::sync::{Mutex, Notify};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::dialogue::{Dialogue, DialogueError, after, only_delivered};
use super::keep::{self, Keep};
use super::reachability::Reachability;
use super::receivers::single;
use crate::agent::{Agent, AgentCore};

/// Maximum number of notifications that are read before the program asks for them, of a subscription to all.
const READ_AHEAD: usize = 64;

/// Maximum number of errors that are kept until the program asks for them.
const MAX_ERRORS: usize = 16;

/// Minimum and maximum time between two attempts to subscribe again.
const AGAIN_FIRST: Duration = Duration::from_secs(1);
const AGAIN_LAST: Duration = Duration::from_secs(30);

/// Minimum time between two attempts to cancel a subscription that the program has dropped.
const CANCEL_AGAIN: Duration = Duration::from_secs(1);

/// Number of notifications of which the rate is that of a subscription.
const RATED: usize = 32;

impl Agent {
    /// Subscribes to the notifications of an agent (`subscribe`, FIPA00035). Waits until the agent
    /// agrees or sends the first notification.
    ///
    /// If the agent publishes the topic with a [`Publisher`](crate::topics::Publisher), the subscriber gets the newest
    /// notification of a stream and all of others ([`Keep::Auto`]); [`subscribe_keeping`](Self::subscribe_keeping) asks
    /// for something else.
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    /// use fipa::Performative;
    /// use fipa::protocol::DialogueError;
    ///
    /// let subscribe = agent.message(Performative::Subscribe).receiver("battery").content("charge");
    /// let mut charge = agent.subscribe(subscribe, Duration::from_secs(5)).await?;
    /// loop {
    ///     match charge.next().await {
    ///         Ok(notification) => println!("{notification}, {} missed", notification.missed()),
    ///         // The subscription goes on when the host or the publisher returns.
    ///         Err(error) if charge.goes_on() => println!("{error}"),
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
        self.subscribe_keeping(Keep::Auto, subscribe, timeout).await
    }

    /// Subscribes like [`subscribe`](Self::subscribe), and asks for these notifications.
    ///
    /// # Errors
    /// See [`subscribe`](Self::subscribe).
    pub async fn subscribe_keeping(
        &self,
        keep: Keep,
        subscribe: MessageBuilder,
        timeout: Duration,
    ) -> Result<Subscription, DialogueError> {
        let subscribe = subscribe.user_defined(keep::DELIVERY, keep.to_string());
        Subscription::begin(&self.core, subscribe, timeout).await
    }
}

/// A notification of a subscription. It is also the message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Notification {
    message: Message,
    missed: u64,
    restarted: bool,
}

impl Notification {
    /// Returns the message (`inform`).
    #[must_use]
    pub fn message(&self) -> &Message {
        &self.message
    }

    /// Returns the message.
    #[must_use]
    pub fn into_message(self) -> Message {
        self.message
    }

    /// Returns the number of notifications between the previous one and this one that the subscription did not get,
    /// because newer ones replaced them or they failed. 0 if the publisher does not number them.
    #[must_use]
    pub fn missed(&self) -> u64 {
        self.missed
    }

    /// Whether it is the first one after the publisher ended and returned. How many were missed is unknown then.
    #[must_use]
    pub fn is_restart(&self) -> bool {
        self.restarted
    }

    /// Returns its number in the topic. `None` if the publisher does not number its notifications.
    #[must_use]
    pub fn number(&self) -> Option<u64> {
        keep::number_of(&self.message)
    }

    /// Returns the time since the publication, by the clocks of both hosts. `None` if the publisher does not say when
    /// it was.
    #[must_use]
    pub fn age(&self) -> Option<Duration> {
        let published = keep::published_at(&self.message)?;
        Some(
            SystemTime::now()
                .duration_since(published)
                .unwrap_or_default(),
        )
    }
}

impl fmt::Display for Notification {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.message.fmt(f)
    }
}

impl Deref for Notification {
    type Target = Message;

    fn deref(&self) -> &Message {
        &self.message
    }
}

/// A subscription. Dropping it cancels it; [`cancel`](Self::cancel) also waits for the confirmation.
///
/// It does not borrow the agent. It is also a [`Stream`], which ends after an error that ends the
/// subscription.
///
/// If the publisher ends, for example with its host, a subscription to a topic of this project goes on: it returns the
/// error once, subscribes again when the publisher returns, at most once a second, and marks the next notification as
/// [restart](Notification::is_restart).
#[must_use = "next() returns the notifications"]
pub struct Subscription {
    id: String,
    reachability: Reachability,
    led: Arc<Mutex<Led>>,
    /// The notifications that a task reads, and that task. `None` if the partner does not know topics.
    reader: Option<Reader>,
    /// The wait of the stream for the next notification.
    waiting: Option<Waiting>,
    /// Whether an error has ended the subscription.
    is_over: bool,
    early: Option<Message>,
    /// The numbers and the times of the last notifications.
    last: VecDeque<(u64, SystemTime)>,
}

type Waiting = Pin<Box<dyn Future<Output = Result<Received, DialogueError>> + Send>>;

/// A notification that was read.
#[derive(Debug)]
struct Received {
    message: Message,
    restarted: bool,
}

impl From<Message> for Received {
    fn from(message: Message) -> Self {
        Self {
            message,
            restarted: false,
        }
    }
}

/// The task that reads the notifications of a topic.
struct Reader {
    queue: Arc<Queue>,
    task: JoinHandle<()>,
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// The notifications that were read and not returned.
#[derive(Debug, Default)]
struct Queue {
    state: parking_lot::Mutex<QueueState>,
    /// Notified when an item is added, and at the end.
    added: Notify,
    /// Notified when an item is taken.
    room: Notify,
}

#[derive(Debug, Default)]
struct QueueState {
    items: VecDeque<Result<Received, DialogueError>>,
    notifications: usize,
    errors: usize,
    /// Number of notifications that are kept; `None` for all.
    keep: Option<usize>,
    /// Whether the next notification is the first of a publisher that has returned.
    restarted: bool,
}

impl Queue {
    fn notification(&self, message: Message) {
        let mut state = self.state.lock();
        if let Some(keep) = Keep::of(&message) {
            state.keep = keep.bound(false);
        }
        let restarted = std::mem::take(&mut state.restarted);
        state.items.push_back(Ok(Received { message, restarted }));
        state.notifications += 1;
        while state.keep.is_some_and(|keep| state.notifications > keep) {
            state.replace_oldest();
        }
        drop(state);
        self.added.notify_one();
    }

    fn error(&self, error: DialogueError) {
        let mut state = self.state.lock();
        if state.errors < MAX_ERRORS {
            state.items.push_back(Err(error));
            state.errors += 1;
        }
        drop(state);
        self.added.notify_one();
    }

    /// Waits until a further notification may be read.
    async fn has_room(&self) {
        loop {
            // Created before the check, so that no room after the check is missed.
            let room = self.room.notified();
            {
                let state = self.state.lock();
                if state.keep.is_some() || state.notifications < READ_AHEAD {
                    return;
                }
            }
            room.await;
        }
    }

    async fn next(&self) -> Result<Received, DialogueError> {
        loop {
            let added = self.added.notified();
            if let Some(item) = self.state.lock().take() {
                self.room.notify_one();
                return item;
            }
            added.await;
        }
    }
}

impl QueueState {
    fn take(&mut self) -> Option<Result<Received, DialogueError>> {
        let item = self.items.pop_front()?;
        match &item {
            Ok(_) => self.notifications -= 1,
            Err(_) => self.errors -= 1,
        }
        Some(item)
    }

    /// Removes the oldest notification. That it was the first after a restart passes on to the next one.
    fn replace_oldest(&mut self) {
        let Some(at) = self.items.iter().position(Result::is_ok) else {
            return;
        };
        let oldest = self.items.remove(at);
        self.notifications -= 1;
        let restarted = matches!(
            oldest,
            Some(Ok(Received {
                restarted: true,
                ..
            }))
        );
        let next = self.items.iter_mut().flatten().next();
        if let Some(next) = next.filter(|_| restarted) {
            next.restarted = true;
        }
    }
}

/// The conversation of a subscription. Dropping it cancels the subscription.
struct Led {
    /// `None` once it was cancelled.
    dialogue: Option<Dialogue>,
    receivers: Vec<AgentId>,
    timeout: Duration,
}

impl Led {
    /// Waits for the answer to the first message.
    async fn first(&mut self, due: Option<std::time::Instant>) -> Result<Message, DialogueError> {
        match &mut self.dialogue {
            Some(dialogue) => Ok(dialogue.receive(due).await?.message),
            None => std::future::pending().await,
        }
    }

    /// Waits for the next message of the other side. A `failure` is an error.
    async fn read(&mut self) -> Result<Message, DialogueError> {
        let Some(dialogue) = &mut self.dialogue else {
            return std::future::pending().await;
        };
        let message = dialogue.receive_or_silence().await?.message;
        match message.performative() {
            Performative::Failure => Err(DialogueError::Failed(Box::new(message))),
            _ => Ok(message),
        }
    }

    async fn cancel(&mut self, timeout: Duration) -> Result<(), DialogueError> {
        let Some(dialogue) = &mut self.dialogue else {
            return Ok(());
        };
        let result = dialogue
            .cancel(self.receivers.clone(), after(timeout))
            .await;
        if result.as_ref().map_or_else(is_end, |()| true) {
            self.dialogue = None;
        }
        result
    }

    /// Goes on with another conversation. The receivers of the reachability stay those of the subscription.
    fn replace(&mut self, mut other: Self) {
        if let (Some(ended), Some(dialogue)) = (&mut self.dialogue, &mut other.dialogue) {
            dialogue.take_reachability(ended);
        }
        *self = other;
    }
}

impl Drop for Led {
    fn drop(&mut self) {
        let Some(dialogue) = self.dialogue.take() else {
            return;
        };
        let inner = &dialogue.agent().endpoint.domain.inner;
        if dialogue.is_over() || dialogue.all_gone() || !inner.owner.is_this() {
            return;
        }
        let runtime = inner.service.runtime.clone();
        let receivers = std::mem::take(&mut self.receivers);
        runtime.spawn(end(dialogue, receivers, self.timeout));
    }
}

/// Cancels a subscription of which the program wants no more notifications, and discards those that still arrive: in
/// the agent's queue they would take the place of other letters.
async fn end(mut dialogue: Dialogue, receivers: Vec<AgentId>, timeout: Duration) {
    loop {
        let earliest = Instant::now() + CANCEL_AGAIN;
        match dialogue.cancel(receivers.clone(), after(timeout)).await {
            Ok(()) => return,
            Err(error) if is_end(&error) => return log_end(&dialogue, &error),
            // The publisher did not get the cancel or did not answer it. Its next message is the earliest sign that
            // another attempt can succeed.
            Err(error) => log_end(&dialogue, &error),
        }
        loop {
            match dialogue.receive(None).await {
                Err(error) if is_end(&error) => return log_end(&dialogue, &error),
                // The report on the cancel itself: without this, each attempt would cause the next one at once.
                Err(DialogueError::Undelivered(_)) => {}
                _ if Instant::now() < earliest => {}
                _ => break,
            }
        }
    }
}

fn log_end(dialogue: &Dialogue, error: &DialogueError) {
    let (agent, conversation) = (&*dialogue.agent().endpoint.name, dialogue.id());
    tracing::debug!(%error, %agent, %conversation, "cannot cancel a subscription");
}

/// A conversation that a partner has accepted.
struct Begun {
    id: String,
    reachability: Reachability,
    led: Led,
    /// The answer of the partner to the wish; `None` if it does not know topics.
    keep: Option<Keep>,
    early: Option<Message>,
}

async fn begin(
    core: &Arc<AgentCore>,
    subscribe: MessageBuilder,
    timeout: Duration,
) -> Result<Begun, DialogueError> {
    let due = after(timeout);
    let (subscribe, receivers) = single(core, subscribe)?;
    let opened = Dialogue::open(core, "fipa-subscribe", subscribe, due);
    let (dialogue, sent) = opened.await?;
    only_delivered(&sent)?;
    let (id, reachability) = (dialogue.id().to_owned(), dialogue.reachability());
    let mut led = Led {
        dialogue: Some(dialogue),
        receivers,
        timeout,
    };
    let first = led.first(due).await?;
    let mut keep = None;
    let early = match first.performative() {
        Performative::Agree => {
            keep = Keep::of(&first);
            None
        }
        Performative::Refuse => return Err(DialogueError::Refused(Box::new(first))),
        Performative::Failure => return Err(DialogueError::Failed(Box::new(first))),
        _ => Some(first),
    };
    Ok(Begun {
        id,
        reachability,
        led,
        keep,
        early,
    })
}

impl Subscription {
    pub(crate) async fn begin(
        core: &Arc<AgentCore>,
        subscribe: MessageBuilder,
        timeout: Duration,
    ) -> Result<Self, DialogueError> {
        let begun = begin(core, subscribe.clone(), timeout).await?;
        let Begun {
            id,
            reachability,
            led,
            keep,
            early,
        } = begun;
        let receivers = led.receivers.clone();
        let led = Arc::new(Mutex::new(led));
        let reader = keep.map(|keep| {
            let queue = Arc::new(Queue::default());
            queue.state.lock().keep = keep.bound(false);
            let reading = Reading {
                core: Arc::clone(core),
                subscribe,
                receivers,
                timeout,
                led: Arc::clone(&led),
                queue: Arc::clone(&queue),
            };
            let runtime = &core.endpoint.domain.inner.service.runtime;
            let task = runtime.spawn(reading.run());
            Reader { queue, task }
        });
        Ok(Self {
            id,
            reachability,
            led,
            reader,
            waiting: None,
            is_over: false,
            early,
            last: VecDeque::new(),
        })
    }

    /// Returns the conversation id of the first conversation with the publisher.
    #[must_use]
    pub fn conversation_id(&self) -> &str {
        &self.id
    }

    /// Returns a receiver of changes of the reachability of the other agent.
    #[must_use]
    pub fn reachability(&self) -> Reachability {
        self.reachability.clone()
    }

    /// Returns the notifications per second, by the numbers and times of the last ones that [`next`](Self::next)
    /// returned. `None` before the second one, if all were published in the same millisecond, and if the publisher does
    /// not number them.
    #[must_use]
    pub fn rate(&self) -> Option<f64> {
        let ((first, from), (last, to)) = (self.last.front()?, self.last.back()?);
        let span = to
            .duration_since(*from)
            .ok()
            .filter(|span| !span.is_zero())?;
        #[expect(
            clippy::cast_precision_loss,
            reason = "a rate of this many notifications needs no exact number"
        )]
        let count = last.checked_sub(*first).filter(|count| *count > 0)? as f64;
        Some(count / span.as_secs_f64())
    }

    /// Whether further notifications can follow. After an error that ends the subscription, none does.
    #[must_use]
    pub fn goes_on(&self) -> bool {
        !self.is_over
    }

    /// Waits for the next notification (`inform`), without a time limit. Dropping the future loses no
    /// notification.
    ///
    /// # Errors
    /// If the other side ends the subscription with `failure` or violates the protocol, or if the agent
    /// is gone ([`DialogueError::Gone`]). [`DialogueError::Unreachable`] is returned once when the host
    /// of the agent becomes silent. [`goes_on`](Self::goes_on) is then true if later calls wait again.
    pub async fn next(&mut self) -> Result<Notification, DialogueError> {
        // Dropping the wait of the stream loses no message.
        self.waiting = None;
        let received = match self.early.take() {
            Some(message) => Ok(message.into()),
            None => self.wait().await,
        };
        self.returned(received)
    }

    /// Waits for the next notification that was not returned.
    fn wait(&self) -> Waiting {
        match &self.reader {
            Some(reader) => {
                let queue = Arc::clone(&reader.queue);
                Box::pin(async move { queue.next().await })
            }
            None => {
                let led = Arc::clone(&self.led);
                Box::pin(async move { led.lock().await.read().await.map(Received::from) })
            }
        }
    }

    /// Counts what was missed.
    fn returned(
        &mut self,
        received: Result<Received, DialogueError>,
    ) -> Result<Notification, DialogueError> {
        let Received { message, restarted } = match received {
            Ok(received) => received,
            Err(error) => {
                self.is_over = !match self.reader {
                    Some(_) => can_return(&error) || goes_on(&error),
                    None => goes_on(&error),
                };
                return Err(error);
            }
        };
        let mut missed = 0;
        if let Some(number) = keep::number_of(&message) {
            if restarted {
                self.last.clear();
            }
            if let Some((last, _)) = self.last.back() {
                missed = number.saturating_sub(*last).saturating_sub(1);
            }
            let published = keep::published_at(&message).unwrap_or_else(SystemTime::now);
            self.last.push_back((number, published));
            while self.last.len() > RATED {
                self.last.pop_front();
            }
        }
        Ok(Notification {
            message,
            missed,
            restarted,
        })
    }

    /// Cancels the subscription and waits for the confirmation of the other side.
    ///
    /// # Errors
    /// If the other side continues the subscription ([`DialogueError::Failed`]), is gone, or does not
    /// answer within `timeout`. Notifications that arrive after the timeout are discarded.
    pub async fn cancel(mut self, timeout: Duration) -> Result<(), DialogueError> {
        self.waiting = None;
        // Its task reads no longer.
        self.reader = None;
        self.led.lock().await.cancel(timeout).await
    }
}

/// The task of a subscription to a topic.
struct Reading {
    core: Arc<AgentCore>,
    subscribe: MessageBuilder,
    receivers: Vec<AgentId>,
    timeout: Duration,
    led: Arc<Mutex<Led>>,
    queue: Arc<Queue>,
}

impl Reading {
    async fn run(self) {
        loop {
            self.queue.has_room().await;
            let read = self.led.lock().await.read().await;
            match read {
                Ok(message) => self.queue.notification(message),
                Err(error) => {
                    let (is_gone, goes_on) = (can_return(&error), goes_on(&error));
                    self.queue.error(error);
                    if is_gone {
                        self.begin_again().await;
                    } else if !goes_on {
                        return;
                    }
                }
            }
        }
    }

    /// Subscribes again until the publisher agrees.
    async fn begin_again(&self) {
        let mut changes = self.core.endpoint.domain.directory().watch();
        let mut pause = AGAIN_FIRST;
        loop {
            // At most one attempt a second, and one at once when the publisher is registered again.
            let (earliest, latest) = (Instant::now() + AGAIN_FIRST, Instant::now() + pause);
            loop {
                tokio::select! {
                    () = tokio::time::sleep_until(latest) => break,
                    change = changes.next() => match change {
                        Some(change) if self.may_have_returned(&change) => {
                            pause = AGAIN_FIRST;
                            tokio::time::sleep_until(earliest).await;
                            break;
                        }
                        Some(_) => {}
                        None => tokio::time::sleep_until(latest).await,
                    },
                }
            }
            pause = (pause * 2).min(AGAIN_LAST);
            match begin(&self.core, self.subscribe.clone(), self.timeout).await {
                Ok(begun) => {
                    self.led.lock().await.replace(begun.led);
                    let mut state = self.queue.state.lock();
                    state.restarted = true;
                    state.keep = begun.keep.and_then(|keep| keep.bound(false));
                    drop(state);
                    if let Some(early) = begun.early {
                        self.queue.notification(early);
                    }
                    return;
                }
                Err(error) => {
                    let agent = &*self.core.endpoint.name;
                    tracing::debug!(%error, %agent, "cannot subscribe again");
                }
            }
        }
    }

    /// Whether the publisher is registered again after this change, or its registration says something else.
    fn may_have_returned(&self, change: &Change) -> bool {
        change.single().iter().any(|change| match change {
            Change::Joined(entry) | Change::Changed { after: entry, .. } => {
                self.receivers.iter().any(|it| it.name() == &*entry.name)
            }
            _ => false,
        })
    }
}

impl Stream for Subscription {
    type Item = Result<Notification, DialogueError>;

    fn poll_next(self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        let this = self.get_mut();
        if let Some(message) = this.early.take() {
            return Poll::Ready(Some(this.returned(Ok(message.into()))));
        }
        if this.is_over {
            return Poll::Ready(None);
        }
        let mut waiting = this.waiting.take().unwrap_or_else(|| this.wait());
        match waiting.as_mut().poll(context) {
            Poll::Ready(received) => Poll::Ready(Some(this.returned(received))),
            Poll::Pending => {
                this.waiting = Some(waiting);
                Poll::Pending
            }
        }
    }
}

/// Whether further notifications can follow after this error, in the same conversation.
fn goes_on(error: &DialogueError) -> bool {
    matches!(
        error,
        DialogueError::Unreachable { .. }
            | DialogueError::Violation { .. }
            | DialogueError::Unchecked(_)
            | DialogueError::Undelivered(_)
    )
}

/// Whether a subscription has ended by the other side, or for this agent.
fn is_end(error: &DialogueError) -> bool {
    matches!(
        error,
        DialogueError::Gone { .. }
            | DialogueError::Failed(_)
            | DialogueError::NotUnderstood(_)
            | DialogueError::Send(_)
            | DialogueError::Receive(_)
    )
}

/// Whether the publisher has ended, and may return.
fn can_return(error: &DialogueError) -> bool {
    matches!(error, DialogueError::Gone { .. } | DialogueError::Failed(_))
}

impl fmt::Debug for Subscription {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Subscription")
            .field("id", &self.id)
            .finish_non_exhaustive()
    }
}
