//! Publishers: the participant of all subscriptions to one topic.
//!
//! Each subscriber has a task and a queue of its own, so a slow one delays no other. One notification is under way to
//! each, or two to a distant one; the queue has those that wait. The queue of a subscriber that keeps the newest `n` never
//! has more.

use std::collections::{HashMap, VecDeque};
use std::fmt;
use std::pin::Pin;
use std::sync::{Arc, Weak};
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use fipa_acl::{ErrorChain, Message, Performative, escape_name};
use fipa_mts::core::MAX_DEADLINE;
use fipa_sds::Reach;
use fipa_transport::{FailureReason, LoanedContent, Outcome, log_limit};
use parking_lot::Mutex;
use tokio::sync::{Notify, oneshot};
use tokio::task::JoinHandle;
use tokio::time::Instant;

use super::listing;
use super::question::answer_questions;
use super::rate::MeasuredRate;
use super::topic::Topic;
use crate::agent::delivery::{Deliveries, deliveries};
use crate::agent::demultiplexer::Precedence;
use crate::agent::incoming::Incoming;
use crate::agent::topics::{SubscriberStatus, TopicSource, TopicStatus};
use crate::agent::{Agent, AgentCore};
use crate::error::SendError;
use crate::protocol::dialogue::{Dialogue, name_of};
use crate::protocol::keep::{DELIVERY, marked};
use crate::protocol::peer_shares::PeerPlaces;
use crate::protocol::serving::{ServedQueue, opening, refuse};
use crate::protocol::{DialogueError, Keep};

/// Maximum number of notifications that wait for one subscriber to all of them. Beyond it, `publish` waits.
const MAX_WAITING: usize = 64;

/// Maximum number of subscribers of one publisher. One host alone gets a quarter of them. Further ones of a host that has
/// its share are refused.
const MAX_SUBSCRIBERS: usize = 4_096;

impl Agent {
    /// Publishes a topic: accepts the subscriptions (`subscribe`, FIPA00035) whose content is its name. One call of
    /// [`Publisher::publish`] notifies all subscribers.
    ///
    /// A subscriber that cancels, leaves or dies is removed. A subscription to a topic that no publisher of this agent
    /// has is refused, with the topics that exist, unless the agent [serves](Self::serve) `fipa-subscribe`. Other
    /// messages go to [`receive`](Self::receive).
    ///
    /// The directory facilitator of the host lists the topic as a service of the type `topic`, with its name, media
    /// type and rate. The agent answers questions for its topics; see [`topics_of`](Self::topics_of).
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
    pub fn publisher(&self, topic: impl Into<Topic>) -> Result<Publisher, DialogueError> {
        let topic: Topic = topic.into();
        let name = topic.name().to_owned();
        let opens = opening(&self.core, "fipa-subscribe", move |message| {
            message.content().is_some_and(|content| *content == name)
        })?;
        let runtime = &self.core.endpoint.domain.inner.service.runtime;
        let state = State {
            is_stream: topic.rate.is_some(),
            ..State::default()
        };
        let shared = Arc::new(Shared {
            topic,
            state: Mutex::new(state),
            room: Notify::new(),
        });
        let queue = ServedQueue::new(&self.core, opens, Precedence::Part);
        let task = runtime.spawn(accept(queue, Arc::clone(&shared)));
        let source: Weak<dyn TopicSource> = Arc::downgrade(&shared) as _;
        if self.core.topics.add(shared.topic.name(), source) {
            start(&self.core)?;
        }
        Ok(Publisher {
            shared,
            task,
            core: Arc::clone(&self.core),
        })
    }
}

/// Notifies the subscribers to a topic; see [`Agent::publisher`]. Dropping it ends the subscriptions with
/// `failure`.
pub struct Publisher {
    shared: Arc<Shared>,
    task: JoinHandle<()>,
    core: Arc<AgentCore>,
}

#[derive(Debug)]
struct Shared {
    topic: Topic,
    state: Mutex<State>,
    /// Notified when a full queue has room, and when a subscriber has ended.
    room: Notify,
}

#[derive(Debug, Default)]
struct State {
    subscribers: HashMap<u64, Subscriber>,
    last_subscriber: u64,
    /// The number of the newest sample. The first is 1.
    last_sample: u64,
    /// The newest samples, for new subscribers.
    latched: VecDeque<Sample>,
    /// Whether subscribers get the newest sample by default.
    is_stream: bool,
    /// Length of the newest sample in bytes.
    len: Option<u64>,
    measured_rate: MeasuredRate,
}

/// A published content.
#[derive(Debug, Clone)]
struct Sample {
    number: u64,
    content: Bytes,
    published: SystemTime,
}

#[derive(Debug)]
struct Subscriber {
    name: String,
    /// Whether it is on another host.
    is_remote: bool,
    keep: Keep,
    waiting: VecDeque<Waiting>,
    /// Number of notifications that are under way.
    under_way: u64,
    /// Notified when a sample is added.
    added: Arc<Notify>,
    /// Numbers of notifications by their result.
    delivered: u64,
    replaced: u64,
    failed: u64,
    last_failure: Option<String>,
}

/// A sample that has not been sent to one subscriber.
#[derive(Debug)]
struct Waiting {
    sample: Sample,
    /// Receives the result. `None` for a latched sample.
    result: Option<oneshot::Sender<NotificationResult>>,
}

impl Waiting {
    fn settle(self, result: NotificationResult) {
        if let Some(sender) = self.result {
            // The publisher may not wait for it.
            let _ = sender.send(result);
        }
    }
}

/// A published content on its way to the subscribers; see [`Publisher::publish`]. Dropping it stops no notification.
#[derive(Debug)]
pub struct Publication {
    number: u64,
    results: Vec<(String, oneshot::Receiver<NotificationResult>)>,
}

impl Publication {
    /// Returns its number in the topic, which each notification carries in `X-sample`. The first is 1.
    #[must_use]
    pub fn number(&self) -> u64 {
        self.number
    }

    /// Returns the number of subscribers at the time of the publication.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        self.results.len()
    }

    /// Waits until each subscriber has received the notification, or will not.
    pub async fn results(self) -> Vec<Notified> {
        let mut all = Vec::with_capacity(self.results.len());
        for (subscriber, result) in self.results {
            let result = result.await.unwrap_or(NotificationResult::Ended);
            all.push(Notified { subscriber, result });
        }
        all
    }

    /// Waits like [`results`](Self::results). Returns the number of subscribers that received the notification.
    pub async fn delivered(self) -> usize {
        let results = self.results().await;
        let received = results.iter().filter(|it| it.result.is_success());
        received.count()
    }
}

/// A subscriber, and the result of a notification for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Notified {
    /// The name of the subscriber.
    pub subscriber: String,
    /// The result.
    pub result: NotificationResult,
}

/// The result of a notification for one subscriber.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum NotificationResult {
    /// The notification was sent, and has this outcome.
    Outcome(Outcome),
    /// A newer one replaced it before it left, as the subscriber asked.
    Replaced,
    /// The subscriber asked for all notifications, and too many wait for it.
    TooSlow,
    /// The subscription ended before.
    Ended,
}

impl NotificationResult {
    /// Whether the subscriber received the notification, or a peer that cannot confirm got it.
    #[must_use]
    pub fn is_success(&self) -> bool {
        matches!(self, Self::Outcome(outcome) if outcome.is_success())
    }
}

/// Memory for the next content of a topic; see [`Publisher::loan`].
pub struct TopicLoan(Box<dyn LoanedContent>);

impl TopicLoan {
    /// Returns the memory of the content, to be written. Its initial bytes are arbitrary.
    pub fn content_mut(&mut self) -> &mut [u8] {
        self.0.content_mut()
    }
}

impl fmt::Debug for TopicLoan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("TopicLoan").finish_non_exhaustive()
    }
}

impl Publisher {
    /// Sends a notification (`inform`) with this content to all subscribers. Returns when it waits for each of them;
    /// [`Publication::results`] has the results.
    ///
    /// The notifications of several calls arrive in the order of the calls. A subscriber that keeps the newest ones
    /// never delays the call. One that asks for all, or is a partner that cannot ask, and has 64 that wait, delays it
    /// for at most [`Topic::wait_for_slow`], and does not delay the other subscribers.
    pub async fn publish(&self, content: impl Into<Bytes>) -> Publication {
        let mut content: Bytes = content.into();
        // Each subscriber of another host gets a copy in any case.
        if self.shared.state.lock().on_this_host() > 1
            && let Some(shared) = self.core.endpoint.mts().shared_content(&content)
        {
            content = shared;
        }
        self.hand_over(content).await
    }

    /// Loans memory of `len` bytes for the next content, in shared memory where possible. The application writes the
    /// content once, and all subscribers on this host read it in place. [`publish_loan`](Self::publish_loan) sends it.
    ///
    /// Short content, and content for which no shared memory is free, is on the heap.
    ///
    /// # Errors
    /// If a letter with this content would be larger than the limit ([`SendError::TooLarge`]).
    pub fn loan(&self, len: usize) -> Result<TopicLoan, SendError> {
        let limit = self.core.endpoint.domain.inner.max_letter;
        if len as u64 > limit {
            return Err(SendError::TooLarge {
                len: len as u64,
                limit,
            });
        }
        Ok(TopicLoan(self.core.endpoint.mts().loan_shared(len)))
    }

    /// Sends the content of a loan like [`publish`](Self::publish). The topic is a stream from then on: subscribers
    /// get the newest content unless they ask for others ([`Keep::Auto`]).
    pub async fn publish_loan(&self, loan: TopicLoan) -> Publication {
        self.shared.state.lock().is_stream = true;
        self.hand_over(loan.0.freeze()).await
    }

    async fn hand_over(&self, content: Bytes) -> Publication {
        let until = Instant::now() + self.shared.topic.wait;
        loop {
            // Created before the check, so that no room after the check is missed.
            let room = self.shared.room.notified();
            if self.shared.state.lock().has_room() || Instant::now() >= until {
                break;
            }
            let _ = tokio::time::timeout_at(until, room).await;
        }
        self.shared.add(content)
    }

    /// Returns the number of subscribers.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        self.shared.state.lock().subscribers.len()
    }

    /// Returns the names of the subscribers, sorted.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        let state = self.shared.state.lock();
        let names = state.subscribers.values().map(|it| it.name.clone());
        let mut names: Vec<String> = names.collect();
        names.sort_unstable();
        names
    }
}

impl fmt::Debug for Publisher {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Publisher")
            .field("topic", &self.shared.topic)
            .field("subscribers", &self.subscribers())
            .finish_non_exhaustive()
    }
}

impl Drop for Publisher {
    fn drop(&mut self) {
        self.task.abort();
        let source: Weak<dyn TopicSource> = Arc::downgrade(&self.shared) as _;
        self.core.topics.remove(self.shared.topic.name(), &source);
        let subscribers = std::mem::take(&mut self.shared.state.lock().subscribers);
        for subscriber in subscribers.into_values() {
            subscriber.added.notify_one();
        }
    }
}

impl Shared {
    /// Adds a sample to the queues of all subscribers.
    fn add(&self, content: Bytes) -> Publication {
        let mut state = self.state.lock();
        state.last_sample += 1;
        let sample = Sample {
            number: state.last_sample,
            content,
            published: SystemTime::now(),
        };
        state.len = Some(sample.content.len() as u64);
        state.measured_rate.count(Instant::now());
        if self.topic.latched > 0 {
            state.latched.push_back(sample.clone());
            while state.latched.len() > self.topic.latched {
                state.latched.pop_front();
            }
        }
        let is_stream = state.is_stream;
        let mut results = Vec::with_capacity(state.subscribers.len());
        for subscriber in state.subscribers.values_mut() {
            let (sender, result) = oneshot::channel();
            results.push((subscriber.name.clone(), result));
            let waiting = Waiting {
                sample: sample.clone(),
                result: Some(sender),
            };
            subscriber.add(waiting, is_stream);
        }
        Publication {
            number: sample.number,
            results,
        }
    }

    /// Time between two notifications, as far as it is known.
    fn period(&self) -> Option<Duration> {
        let hertz = self.topic.rate;
        let hertz = hertz.or_else(|| self.state.lock().measured_rate.hertz(Instant::now()))?;
        Duration::try_from_secs_f64(1.0 / hertz).ok()
    }

    /// Adds a subscriber, which gets the latched samples.
    fn register(&self, name: String, is_remote: bool, keep: Keep) -> (u64, Arc<Notify>) {
        let mut state = self.state.lock();
        state.last_subscriber += 1;
        let number = state.last_subscriber;
        let mut subscriber = Subscriber {
            name,
            is_remote,
            keep,
            waiting: VecDeque::new(),
            under_way: 0,
            added: Arc::default(),
            delivered: 0,
            replaced: 0,
            failed: 0,
            last_failure: None,
        };
        for sample in &state.latched {
            let sample = sample.clone();
            let waiting = Waiting {
                sample,
                result: None,
            };
            subscriber.add(waiting, state.is_stream);
        }
        let added = Arc::clone(&subscriber.added);
        state.subscribers.insert(number, subscriber);
        (number, added)
    }

    /// Takes the next sample for a subscriber. `None` if the publisher has ended.
    fn take(&self, number: u64) -> Option<Option<(Waiting, Keep)>> {
        let mut state = self.state.lock();
        let is_stream = state.is_stream;
        let subscriber = state.subscribers.get_mut(&number)?;
        let was_full = subscriber.is_full(is_stream);
        let next = subscriber.waiting.pop_front();
        subscriber.under_way += u64::from(next.is_some());
        let keep = subscriber.effective_keep(is_stream);
        drop(state);
        if was_full {
            self.room.notify_waiters();
        }
        Some(next.map(|waiting| (waiting, keep)))
    }

    /// Counts the outcome of the notification that was under way to a subscriber.
    fn count(&self, number: u64, outcome: &Outcome) {
        let mut state = self.state.lock();
        if let Some(subscriber) = state.subscribers.get_mut(&number) {
            subscriber.under_way = subscriber.under_way.saturating_sub(1);
            match outcome.is_success() {
                true => subscriber.delivered += 1,
                false => subscriber.fail(outcome.to_string()),
            }
        }
    }

    fn remove(&self, number: u64) {
        drop(self.state.lock().subscribers.remove(&number));
        self.room.notify_waiters();
    }
}

/// Maximum number of subscribers in the status of a topic.
const MAX_LISTED: usize = 64;

impl TopicSource for Shared {
    fn status(&self) -> TopicStatus {
        let state = self.state.lock();
        let all = state.subscribers.values();
        let mut first: Vec<SubscriberStatus> = all.map(|it| it.status(state.is_stream)).collect();
        first.sort_unstable_by(|one, other| one.name.cmp(&other.name));
        first.truncate(MAX_LISTED);
        TopicStatus {
            name: self.topic.name().to_owned(),
            media_type: self.topic.media_type.clone(),
            rate: self.topic.rate,
            measured_rate: state.measured_rate.hertz(Instant::now()),
            published: state.last_sample,
            bytes: state.len,
            subscribers: state.subscribers.len() as u64,
            first_subscribers: first,
        }
    }
}

impl State {
    /// Returns the number of subscribers on this host.
    fn on_this_host(&self) -> usize {
        let subscribers = self.subscribers.values();
        subscribers.filter(|it| !it.is_remote).count()
    }

    /// Whether the next sample has room in each queue.
    fn has_room(&self) -> bool {
        let mut subscribers = self.subscribers.values();
        !subscribers.any(|it| it.is_full(self.is_stream))
    }
}

impl Subscriber {
    /// Whether it is to get all samples, and as many wait as may.
    fn is_full(&self, is_stream: bool) -> bool {
        self.keep.bound(is_stream).is_none() && self.waiting.len() >= MAX_WAITING
    }

    fn add(&mut self, waiting: Waiting, is_stream: bool) {
        if self.is_full(is_stream) {
            self.fail(format!(
                "{MAX_WAITING} notifications wait for the subscriber"
            ));
            return waiting.settle(NotificationResult::TooSlow);
        }
        self.waiting.push_back(waiting);
        if let Some(most) = self.keep.bound(is_stream) {
            while self.waiting.len() > most {
                if let Some(oldest) = self.waiting.pop_front() {
                    self.replaced += 1;
                    oldest.settle(NotificationResult::Replaced);
                }
            }
        }
        self.added.notify_one();
    }

    fn fail(&mut self, reason: String) {
        self.failed += 1;
        self.last_failure = Some(reason);
    }

    fn status(&self, is_stream: bool) -> SubscriberStatus {
        SubscriberStatus {
            name: self.name.clone(),
            keep: self.effective_keep(is_stream).to_string(),
            delivered: self.delivered,
            replaced: self.replaced,
            failed: self.failed,
            waiting: self.waiting.len() as u64 + self.under_way,
            last_failure: self.last_failure.clone(),
        }
    }

    /// The notifications that the subscriber gets.
    fn effective_keep(&self, is_stream: bool) -> Keep {
        match self.keep.bound(is_stream) {
            None => Keep::All,
            Some(n) => Keep::latest(u32::try_from(n).unwrap_or(u32::MAX)),
        }
    }
}

/// Starts the tasks of an agent that publishes its first topic: subscriptions to other topics are refused, questions for
/// the topics are answered, and the directory facilitator lists them.
fn start(core: &Arc<AgentCore>) -> Result<(), DialogueError> {
    let agent = Arc::downgrade(core);
    let opens = opening(core, "fipa-subscribe", move |_| {
        agent.upgrade().is_some_and(|core| !core.topics.is_empty())
    })?;
    let queue = ServedQueue::new(core, opens, Precedence::Rest);
    let runtime = &core.endpoint.domain.inner.service.runtime;
    runtime.spawn(async move {
        while let Some(first) = queue.next().await {
            refuse(queue.agent(), &first, &queue.agent().topics.refusal());
        }
    });
    runtime.spawn(listing::list(Arc::downgrade(core), answer_questions(core)?));
    Ok(())
}

/// Accepts subscriptions until the agent ends.
async fn accept(queue: ServedQueue, shared: Arc<Shared>) {
    let places = PeerPlaces::new(MAX_SUBSCRIBERS);
    while let Some(first) = queue.next().await {
        let core = Arc::clone(queue.agent());
        let Some(place) = places.take(first.peer()) else {
            refuse(&core, &first, "too many subscribers");
            continue;
        };
        let shared = Arc::downgrade(&shared);
        tokio::spawn(async move {
            let name = name_of(first.message());
            let served = serve(&core, &first, &shared).await;
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
    shared: &Weak<Shared>,
) -> Result<(), DialogueError> {
    let mut dialogue = Dialogue::join(core, first)?;
    let first = first.message();
    let Some(registered) = shared.upgrade() else {
        return dialogue
            .answer(first, Performative::Refuse, ENDED, None)
            .await;
    };
    let asked = Keep::of(first);
    // Registered before the `agree`: the subscriber gets each notification that is published after it has
    // received the `agree`.
    let (name, is_remote) = (name_of(first), is_remote(core, first));
    let (number, added) = registered.register(name, is_remote, asked.unwrap_or(Keep::All));
    let kind = Kind {
        language: registered.topic.language.clone(),
        ontology: registered.topic.ontology.clone(),
    };
    drop(registered);
    let agree = core.endpoint.reply(first, Performative::Agree).content("");
    let agree = match asked {
        // Shows a partner that its wish is known.
        Some(keep) => agree.user_defined(DELIVERY, keep.to_string()),
        None => agree,
    };
    let begun = Instant::now();
    let served = match dialogue.say(agree, None).await {
        Ok(()) => {
            let distance = Distance {
                is_remote,
                round_trip: begun.elapsed(),
            };
            let subscriber = (number, &*added);
            notify(&mut dialogue, first, shared, subscriber, &kind, distance).await
        }
        Err(error) => Err(error),
    };
    if let Some(shared) = shared.upgrade() {
        shared.remove(number);
    }
    served
}

/// The content of the `failure`, or of the `refuse`, at the end of a publisher.
const ENDED: &str = "the publisher has ended";

/// The kind of the contents, which each notification names.
struct Kind {
    language: Option<String>,
    ontology: Option<String>,
}

/// The way to a subscriber.
#[derive(Debug, Clone, Copy)]
struct Distance {
    /// Whether it is on another host.
    is_remote: bool,
    /// The shortest time from a notification, or from the `agree`, to its outcome.
    round_trip: Duration,
}

impl Distance {
    /// Returns the number of notifications that may be under way. With one, a subscriber gets one notification per
    /// round trip. A second one fills the way if the round trip is longer than the period of the topic. Over a thin link
    /// it would only wait behind the first one; there the short `agree` shows that the round trip is short.
    fn max_under_way(self, period: Option<Duration>) -> usize {
        match period {
            Some(period) if self.is_remote && self.round_trip > period => 2,
            _ => 1,
        }
    }
}

/// Whether the sender of a message is an agent of another host.
fn is_remote(core: &AgentCore, message: &Message) -> bool {
    let entry = core.endpoint.domain.directory().known(&name_of(message));
    entry.is_some_and(|entry| entry.reach != Reach::Local)
}

/// A notification that was sent.
struct UnderWay {
    begun: Instant,
    outcomes: Pin<Box<dyn Future<Output = Deliveries> + Send>>,
    result: Option<oneshot::Sender<NotificationResult>>,
}

async fn notify(
    dialogue: &mut Dialogue,
    first: &Message,
    shared: &Weak<Shared>,
    (number, added): (u64, &Notify),
    kind: &Kind,
    mut distance: Distance,
) -> Result<(), DialogueError> {
    let mut under_way: VecDeque<UnderWay> = VecDeque::new();
    let mut has_ended = false;
    loop {
        let is_free = match under_way.len() {
            _ if has_ended => false,
            0 => true,
            sent => sent < distance.max_under_way(shared.upgrade().and_then(|it| it.period())),
        };
        if has_ended && under_way.is_empty() {
            dialogue.take_speaker().abandon(first, ENDED);
            return Ok(());
        }
        let oldest = under_way.front_mut().map(|sent| &mut sent.outcomes);
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
            deliveries = finished(oldest) => {
                dialogue.settle(&deliveries);
                let sent = under_way.pop_front();
                let round_trip = sent.as_ref().map_or(Duration::MAX, |sent| sent.begun.elapsed());
                distance.round_trip = distance.round_trip.min(round_trip);
                let result = sent.and_then(|sent| sent.result);
                let Some(delivery) = deliveries.0.into_iter().next() else {
                    continue;
                };
                let is_gone = matches!(
                    delivery.outcome,
                    Outcome::Failed { reason: FailureReason::NoSuchAgent, .. }
                );
                if let Some(shared) = shared.upgrade() {
                    shared.count(number, &delivery.outcome);
                }
                if let Some(result) = result {
                    // The publisher may not wait for it.
                    let _ = result.send(NotificationResult::Outcome(delivery.outcome));
                }
                if is_gone && !dialogue.may_return() {
                    let agent = delivery.receiver.to_string();
                    return Err(DialogueError::Gone { agent });
                }
            }
            next = next_sample(shared, number, added), if is_free => {
                let Some((waiting, keep)) = next else {
                    has_ended = true;
                    continue;
                };
                under_way.push_back(send(dialogue, first, waiting, kind, keep)?);
            }
        }
    }
}

/// Waits for the outcomes of the oldest notification that is under way.
async fn finished(
    outcomes: Option<&mut Pin<Box<dyn Future<Output = Deliveries> + Send>>>,
) -> Deliveries {
    match outcomes {
        Some(outcomes) => outcomes.await,
        None => std::future::pending().await,
    }
}

/// Waits for the next sample. `None` if the publisher has ended.
async fn next_sample(
    shared: &Weak<Shared>,
    number: u64,
    added: &Notify,
) -> Option<(Waiting, Keep)> {
    loop {
        if let Some(next) = shared.upgrade()?.take(number)? {
            return Some(next);
        }
        added.notified().await;
    }
}

fn send(
    dialogue: &mut Dialogue,
    first: &Message,
    waiting: Waiting,
    kind: &Kind,
    keep: Keep,
) -> Result<UnderWay, DialogueError> {
    let Waiting { sample, result } = waiting;
    let mut notification = dialogue.agent().endpoint.reply(first, Performative::Inform);
    if let Some(language) = &kind.language {
        notification = notification.language(language);
    }
    if let Some(ontology) = &kind.ontology {
        notification = notification.ontology(ontology);
    }
    let notification = notification.content(sample.content);
    let notification = marked(notification, sample.number, sample.published, keep);
    // With a short deadline, each end of it would leave one more outdated content in the queue of a subscriber that
    // is stopped.
    let sent = match keep {
        Keep::Latest(_) => dialogue.post_until(notification, MAX_DEADLINE)?,
        _ => dialogue.post(notification, None)?,
    };
    Ok(UnderWay {
        begun: Instant::now(),
        outcomes: Box::pin(deliveries(sent)),
        result,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_notifications_are_under_way_if_one_would_leave_a_distant_way_empty() {
        let most = |is_remote, round_trip, period| {
            let round_trip = Duration::from_millis(round_trip);
            let distance = Distance {
                is_remote,
                round_trip,
            };
            distance.max_under_way(Option::map(period, Duration::from_millis))
        };
        assert_eq!(most(true, 100, Some(33)), 2);
        assert_eq!(most(true, 10, Some(33)), 1);
        assert_eq!(most(true, 100, None), 1);
        // A subscriber on this host that is slow, or stopped.
        assert_eq!(most(false, 100, Some(33)), 1);
    }
}
