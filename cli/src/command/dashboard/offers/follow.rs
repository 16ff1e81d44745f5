//! Asks the agents at which pages look, and subscribes to their topics.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use fipa::error::ErrorChain;
use fipa::platform::{AgentDescription, PlatformError};
use fipa::protocol::{DialogueError, Keep};
use fipa::{Agent, AgentId, Performative};
use tokio::task::JoinSet;
use tokio::time::{Instant, MissedTickBehavior};

use super::value::TopicValue;
use super::{Answers, Offers};

/// Time between two looks for agents at which no page looks any more.
const INTERVAL: Duration = Duration::from_secs(1);

/// Time between two questions to an agent.
const QUESTIONS: Duration = Duration::from_secs(2);

/// Maximum wait for the agreement of a publisher, and for its confirmation of the end.
const WITHIN: Duration = Duration::from_secs(5);

/// Time between two values of a topic with more of them.
const PACE: Duration = Duration::from_millis(500);

/// Time before the next attempt to subscribe, and between two values that are too large.
const RETRY: Duration = Duration::from_secs(5);

/// The problem of a topic with values that pages do not show.
const TOO_LARGE: &str = "its values are larger than 1 MiB";

/// The type of the services that list topics.
const TOPIC: &str = "topic";

/// A task that ends when this value is dropped.
type Task = JoinSet<()>;

fn start(work: impl Future<Output = ()> + Send + 'static) -> Task {
    let mut task = Task::new();
    task.spawn(work);
    task
}

/// Follows the agents at which pages look, with this agent. Never ends.
pub(in crate::command::dashboard) async fn serve(offers: &Arc<Offers>, agent: &Agent) {
    let _cleared = Cleared(offers);
    let mut tasks: BTreeMap<String, Task> = BTreeMap::new();
    let mut turns = tokio::time::interval(INTERVAL);
    turns.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        tokio::select! {
            _ = turns.tick() => {}
            () = offers.added.notified() => {}
        }
        let names = offers.followed();
        tasks.retain(|name, _| names.contains(name));
        for name in names {
            if !tasks.contains_key(&name)
                && let Ok(publisher) = AgentId::new(name.as_str())
            {
                let follower = Follower {
                    offers: Arc::clone(offers),
                    agent: agent.clone(),
                    name: name.clone(),
                    publisher,
                };
                tasks.insert(name, start(Arc::new(follower).run()));
            }
        }
    }
}

/// Forgets the offers at the end, because nothing is followed then.
struct Cleared<'a>(&'a Offers);

impl Drop for Cleared<'_> {
    fn drop(&mut self) {
        self.0.clear();
    }
}

/// Follows one agent.
struct Follower {
    offers: Arc<Offers>,
    agent: Agent,
    name: String,
    publisher: AgentId,
}

impl Follower {
    async fn run(self: Arc<Self>) {
        let mut topics: BTreeMap<String, Task> = BTreeMap::new();
        let mut turns = tokio::time::interval(QUESTIONS);
        turns.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            turns.tick().await;
            let answers = self.ask().await;
            let followed = self.offers.take(&self.name, answers);
            topics.retain(|topic, _| followed.contains(topic));
            for topic in followed {
                topics.entry(topic.clone()).or_insert_with(|| {
                    let follower = Arc::clone(&self);
                    start(async move { follower.follow(&topic).await })
                });
            }
        }
    }

    /// Asks the directory facilitator for the description of the agent and, if it lists topics there, the agent for
    /// their state. Other agents may not answer. The subscriptions of this program do not count.
    async fn ask(&self) -> Answers {
        let description = match self.description().await {
            Ok(description) => description,
            Err(error) => {
                return Answers {
                    description: None,
                    topics: None,
                    problem: Some(ErrorChain(&error).to_string()),
                };
            }
        };
        let services = description.iter().flat_map(|it| &it.services);
        let has_topics = services
            .filter_map(|service| service.service_type.as_deref())
            .any(|service_type| service_type.eq_ignore_ascii_case(TOPIC));
        let mut problem = None;
        let topics = match has_topics {
            true => match self.agent.topics_of(&self.publisher).await {
                Ok(mut topics) => {
                    for topic in &mut topics {
                        let own = topic.first_subscribers.iter();
                        let own = own.filter(|it| it.name == self.agent.name()).count() as u64;
                        topic.subscribers = topic.subscribers.saturating_sub(own);
                    }
                    Some(topics)
                }
                Err(error) => {
                    problem = Some(ErrorChain(&error).to_string());
                    None
                }
            },
            false => Some(Vec::new()),
        };
        Answers {
            description,
            topics,
            problem,
        }
    }

    async fn description(&self) -> Result<Option<AgentDescription>, PlatformError> {
        let template = AgentDescription {
            name: Some(self.publisher.clone()),
            ..AgentDescription::default()
        };
        Ok(self.agent.df()?.search(&template).await?.into_iter().next())
    }

    /// Takes values of a topic.
    async fn follow(&self, topic: &str) {
        loop {
            let pause = match self.values(topic).await {
                Ok(pause) => pause,
                Err(error) => {
                    let problem = ErrorChain(&error).to_string();
                    self.offers.fail(&self.name, topic, &problem);
                    RETRY
                }
            };
            tokio::time::sleep(pause).await;
        }
    }

    /// Subscribes, and takes values for as long as they do not come faster than pages show them: a page does not make
    /// a network carry each image of a camera. The rate and the length that the publisher states may be wrong. Returns
    /// the time before the next subscription.
    async fn values(&self, topic: &str) -> Result<Duration, DialogueError> {
        if self.offers.is_too_large(&self.name, topic) {
            self.offers.fail(&self.name, topic, TOO_LARGE);
            return Ok(PACE);
        }
        let subscribe = self.agent.message(Performative::Subscribe);
        let subscribe = subscribe
            .receiver(&self.publisher)
            .content(topic.to_owned());
        let subscribed = self
            .agent
            .subscribe_keeping(Keep::latest(1), subscribe, WITHIN);
        let mut subscription = subscribed.await?;
        // The first value may be an old one.
        let mut is_first = true;
        let mut last: Option<Instant> = None;
        loop {
            let notification = match subscription.next().await {
                Ok(notification) => notification,
                Err(_) if subscription.goes_on() => continue,
                Err(error) => return Err(error),
            };
            let value = TopicValue::of(&notification);
            // Its memory is the publisher's.
            drop(notification);
            let is_too_large = value.is_too_large();
            let mut is_fast = self.offers.take_value(&self.name, topic, value);
            if !std::mem::take(&mut is_first) {
                let last = last.replace(Instant::now());
                is_fast |= last.is_some_and(|last| last.elapsed() < PACE);
            }
            if is_too_large {
                self.offers.fail(&self.name, topic, TOO_LARGE);
            }
            if is_too_large || is_fast {
                subscription.cancel(WITHIN).await?;
                return Ok(if is_too_large { RETRY } else { PACE });
            }
        }
    }
}
