//! Publishers: the participant of all subscriptions to one topic.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use fipa_acl::{ErrorChain, Message, Performative, escape_name};
use fipa_transport::{FailureReason, log_limit};
use parking_lot::Mutex;
use tokio::sync::{mpsc, oneshot};
use tokio::task::{JoinHandle, JoinSet};

use super::dialogue::{Dialogue, DialogueError, name_of};
use super::serving::{ServedQueue, opening, refuse};
use crate::agent::incoming::Incoming;
use crate::agent::{Agent, AgentCore};
use crate::protocol::peer_shares::PeerPlaces;

/// Maximum number of notifications that wait for one subscriber. Beyond it, `publish` waits.
const MAX_WAITING: usize = 64;

/// Maximum number of subscribers of one publisher. One host alone gets a quarter of them. Further ones of a host that has
/// its share are refused.
const MAX_SUBSCRIBERS: usize = 4_096;

impl Agent {
    /// Accepts the subscriptions (`subscribe`, FIPA00035) whose content is this topic. One call of
    /// [`Publisher::publish`] notifies all subscribers.
    ///
    /// A subscriber that cancels, leaves or dies is removed. Other messages go to
    /// [`receive`](Self::receive), as for [`serve`](Self::serve).
    ///
    /// ```no_run
    /// # async fn example(agent: fipa::Agent) -> Result<(), Box<dyn std::error::Error>> {
    /// use std::time::Duration;
    ///
    /// let charge = agent.publisher("charge")?;
    /// for percent in (0..=100).rev() {
    ///     charge.publish(percent.to_string()).await;
    ///     println!("{} subscribers", charge.subscribers());
    ///     tokio::time::sleep(Duration::from_secs(60)).await;
    /// }
    /// # Ok(())
    /// # }
    /// ```
    ///
    /// # Errors
    /// If the protocol library of the configuration has no `fipa-subscribe`.
    pub fn publisher(&self, topic: impl Into<Bytes>) -> Result<Publisher, DialogueError> {
        let topic: Bytes = topic.into();
        let opens = opening(&self.core, "fipa-subscribe", move |message| {
            message.content().is_some_and(|content| *content == topic)
        })?;
        let runtime = &self.core.endpoint.domain.inner.service.runtime;
        let subscribers = Arc::new(Subscribers::default());
        let queue = ServedQueue::new(&self.core, opens);
        let task = runtime.spawn(accept(queue, Arc::clone(&subscribers)));
        Ok(Publisher { subscribers, task })
    }
}

/// Notifies the subscribers to a topic; see [`Agent::publisher`]. Dropping it ends the subscriptions with
/// `failure`.
#[derive(Debug)]
pub struct Publisher {
    subscribers: Arc<Subscribers>,
    task: JoinHandle<()>,
}

#[derive(Debug, Default)]
struct Subscribers(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    all: HashMap<u64, Subscriber>,
    next: u64,
}

#[derive(Debug)]
struct Subscriber {
    name: String,
    notifications: mpsc::Sender<Notification>,
}

/// A notification for one subscriber.
#[derive(Debug)]
struct Notification {
    content: Bytes,
    /// Receives whether it was delivered.
    delivered: oneshot::Sender<bool>,
}

impl Publisher {
    /// Sends a notification (`inform`) to all subscribers, and waits until each has an outcome. Returns
    /// the number of subscribers to which it was delivered.
    ///
    /// The notifications of several calls arrive in the order of the calls. A subscriber with 64 pending
    /// notifications delays the call, but not the other subscribers.
    pub async fn publish(&self, content: impl Into<Bytes>) -> usize {
        let content: Bytes = content.into();
        let subscribers: Vec<_> = {
            let state = self.subscribers.0.lock();
            let all = state.all.values();
            all.map(|it| it.notifications.clone()).collect()
        };
        let mut sent = JoinSet::new();
        let mut answers = Vec::new();
        for subscriber in subscribers {
            let (delivered, answer) = oneshot::channel();
            let notification = Notification {
                content: content.clone(),
                delivered,
            };
            answers.push(answer);
            match subscriber.try_send(notification) {
                Ok(()) | Err(mpsc::error::TrySendError::Closed(_)) => {}
                Err(mpsc::error::TrySendError::Full(notification)) => {
                    sent.spawn(async move { subscriber.send(notification).await.is_ok() });
                }
            }
        }
        while sent.join_next().await.is_some() {}
        let mut count = 0;
        for answer in answers {
            count += usize::from(answer.await.unwrap_or(false));
        }
        count
    }

    /// Returns the number of subscribers.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        self.subscribers.0.lock().all.len()
    }

    /// Returns the names of the subscribers, sorted.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        let state = self.subscribers.0.lock();
        let mut names: Vec<String> = state.all.values().map(|it| it.name.clone()).collect();
        names.sort_unstable();
        names
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        self.task.abort();
        self.subscribers.0.lock().all.clear();
    }
}

/// Accepts subscriptions until the agent ends.
async fn accept(queue: ServedQueue, subscribers: Arc<Subscribers>) {
    let places = PeerPlaces::new(MAX_SUBSCRIBERS);
    while let Some(first) = queue.next().await {
        let core = Arc::clone(queue.agent());
        let Some(place) = places.take(first.peer()) else {
            refuse(&core, &first, "too many subscribers");
            continue;
        };
        let subscribers = Arc::downgrade(&subscribers);
        tokio::spawn(async move {
            let name = name_of(first.message());
            let served = serve(&core, &first, &subscribers).await;
            drop(place);
            if let Err(error) = served {
                log_limit::info!(of: &*name, subscriber = %escape_name(&name), error = %ErrorChain(&error), "a subscription has ended");
            }
        });
    }
}

/// Serves one subscription until its end.
async fn serve(
    core: &Arc<AgentCore>,
    first: &Incoming,
    subscribers: &std::sync::Weak<Subscribers>,
) -> Result<(), DialogueError> {
    let mut dialogue = Dialogue::join(core, first)?;
    let first = first.message();
    let (sender, mut notifications) = mpsc::channel(MAX_WAITING);
    let Some(registered) = subscribers.upgrade() else {
        return dialogue
            .answer(first, Performative::Refuse, ENDED, None)
            .await;
    };
    // Registered before the `agree`: the subscriber gets each notification that is published after it has
    // received the `agree`.
    let number = {
        let mut state = registered.0.lock();
        state.next += 1;
        let number = state.next;
        let subscriber = Subscriber {
            name: name_of(first),
            notifications: sender,
        };
        state.all.insert(number, subscriber);
        number
    };
    drop(registered);
    let agreed = dialogue.answer(first, Performative::Agree, "", None).await;
    let served = match agreed {
        Ok(()) => notify(&mut dialogue, first, &mut notifications).await,
        Err(error) => Err(error),
    };
    if let Some(subscribers) = subscribers.upgrade() {
        subscribers.0.lock().all.remove(&number);
    }
    served
}

/// The content of the `failure`, or of the `refuse`, at the end of a publisher.
const ENDED: &str = "the publisher has ended";

async fn notify(
    dialogue: &mut Dialogue,
    first: &Message,
    notifications: &mut mpsc::Receiver<Notification>,
) -> Result<(), DialogueError> {
    loop {
        tokio::select! {
            // A cancel precedes the notifications that wait.
            biased;
            received = dialogue.receive(None) => match received {
                Err(DialogueError::Cancelled(cancel)) => {
                    let act = Performative::Inform;
                    return dialogue.answer(&cancel, act, "cancelled", None).await;
                }
                // A mistake of the subscriber does not end its subscription.
                Ok(_) | Err(DialogueError::Violation { .. } | DialogueError::Undelivered(_)) => {}
                Err(error) => return Err(error),
            },
            notification = notifications.recv() => {
                let Some(Notification { content, delivered }) = notification else {
                    dialogue.take_speaker().abandon(first, ENDED);
                    return Ok(());
                };
                let sent = dialogue.answer(first, Performative::Inform, content, None).await;
                // The publisher may have stopped waiting.
                let _ = delivered.send(sent.is_ok());
                match sent {
                    Ok(()) => {}
                    Err(DialogueError::NotDelivered { reason, .. })
                        if reason != FailureReason::NoSuchAgent => {}
                    Err(error) => return Err(error),
                }
            }
        }
    }
}
