//! Subscribes to the topics of a recording as an agent.

use std::collections::HashSet;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa::protocol::{DialogueError, Keep, Subscription};
use fipa::topics::TopicStatus;
use fipa::{Agent, AgentId, Config, Domain, Matcher, Performative};
use fipa_acl::{escape, escape_name};
use tokio::sync::mpsc::Sender;
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;

use super::recorder::{Observation, TopicValue};
use crate::command::df::asking;
use crate::command::topics::list_all;
use crate::membership;
use crate::report::{self, Failure};

/// Time between two looks for new topics.
const INTERVAL: Duration = Duration::from_secs(2);
/// Maximum wait for the agreement of a publisher.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Maximum number of topics.
const MAX_TOPICS: usize = 1000;

/// The agent that subscribes to topics.
pub(super) struct Topics {
    domain: Domain,
    agent: Arc<Agent>,
    patterns: Vec<Matcher>,
    config: Config,
}

impl Topics {
    /// Joins the domain, unless there are no patterns.
    pub(super) async fn join(
        patterns: &[Matcher],
        config: &Config,
    ) -> Result<Option<Self>, Failure> {
        if patterns.is_empty() {
            return Ok(None);
        }
        let domain = membership::join(config).await?;
        match asking(&domain, "record", config).await {
            Ok(agent) => Ok(Some(Self {
                domain,
                agent: Arc::new(agent),
                patterns: patterns.to_vec(),
                config: config.clone(),
            })),
            Err(failure) => {
                domain.close().await;
                Err(failure)
            }
        }
    }

    /// The name of the agent.
    pub(super) fn name(&self) -> String {
        self.agent.name().to_owned()
    }

    /// Forwards the values of all topics that match, also of those that appear later.
    pub(super) async fn run(&self, sender: &Sender<Observation>) {
        let mut turns = tokio::time::interval(INTERVAL);
        turns.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut followed = HashSet::new();
        let mut following = JoinSet::new();
        loop {
            tokio::select! {
                Some(ended) = following.join_next() => {
                    // A later turn subscribes again.
                    if let Ok(Some(source)) = ended {
                        followed.remove(&source);
                    }
                }
                _ = turns.tick() => match list_all(&self.agent, &self.config).await {
                    Ok(listed) => {
                        let topics = listed.iter().flat_map(|(agent, topics)| {
                            topics.iter().flatten().map(move |topic| (agent, topic))
                        });
                        for (agent, topic) in topics {
                            let source = (agent.clone(), topic.name.clone());
                            let is_followed = followed.len() >= MAX_TOPICS || followed.contains(&source);
                            if is_followed || !self.matches(agent, topic) {
                                continue;
                            }
                            if let Ok(publisher) = AgentId::new(agent.as_str()) {
                                followed.insert(source.clone());
                                let follower = self.follower(publisher, topic, sender);
                                following.spawn(async move {
                                    follower.follow().await.then_some(source)
                                });
                            }
                        }
                    }
                    Err(failure) => report::warn(&format!("cannot list the topics: {}", failure.problem())),
                },
            }
        }
    }

    fn matches(&self, agent: &str, topic: &TopicStatus) -> bool {
        let name = format!("{agent}/{}", topic.name);
        self.patterns.iter().any(|pattern| pattern.matches(&name))
    }

    fn follower(
        &self,
        publisher: AgentId,
        topic: &TopicStatus,
        sender: &Sender<Observation>,
    ) -> Follower {
        Follower {
            agent: Arc::clone(&self.agent),
            publisher,
            topic: topic.name.as_str().into(),
            media_type: topic.media_type.as_deref().unwrap_or_default().into(),
            sender: sender.clone(),
        }
    }

    /// Leaves the domain.
    pub(super) async fn leave(self) {
        self.domain.close().await;
    }
}

/// Follows one topic.
struct Follower {
    agent: Arc<Agent>,
    publisher: AgentId,
    topic: Arc<str>,
    media_type: Arc<str>,
    sender: Sender<Observation>,
}

impl Follower {
    /// Returns whether the publisher is gone, so that the topic can appear again.
    async fn follow(&self) -> bool {
        let followed = self.values().await;
        if let Err(error) = &followed {
            report::warn(&format!(
                "the topic {} of {} is not recorded: {}",
                escape(&self.topic),
                escape_name(self.publisher.name()),
                escape(&error.to_string())
            ));
        }
        followed.is_ok()
    }

    /// Forwards all values until the publisher ends the topic.
    async fn values(&self) -> Result<(), DialogueError> {
        let subscribe = self
            .agent
            .message(Performative::Subscribe)
            .receiver(&self.publisher)
            .content(self.topic.to_string());
        let subscribed = self.agent.subscribe_keeping(Keep::All, subscribe, TIMEOUT);
        let mut subscription: Subscription = subscribed.await?;
        let agent: Arc<str> = self.publisher.name().into();
        loop {
            let notification = match subscription.next().await {
                Ok(notification) => notification,
                // Values can follow.
                Err(_) if subscription.goes_on() => continue,
                Err(DialogueError::Gone { .. }) => return Ok(()),
                Err(error) => return Err(error),
            };
            let now = SystemTime::now();
            let age = notification.age().unwrap_or_default();
            let value = TopicValue {
                agent: Arc::clone(&agent),
                topic: Arc::clone(&self.topic),
                media_type: Arc::clone(&self.media_type),
                at: now.checked_sub(age).unwrap_or(now),
                missed: notification.missed(),
                // A copy, because the memory belongs to the publisher.
                content: notification
                    .content()
                    .map(|content| bytes::Bytes::copy_from_slice(content))
                    .unwrap_or_default(),
            };
            if self.sender.send(Observation::Value(value)).await.is_err() {
                return Ok(());
            }
        }
    }
}
