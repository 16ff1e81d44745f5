//! The offers of agents at which pages look: their services, their topics, and the newest values of topics.
//!
//! [`follow`] asks an agent and subscribes to its topics only while a page shows the agent. [`value`] is the part of a
//! value that pages show.
//!
//! All tables are bounded, and so is each text: any process of the domain can describe itself.

mod follow;
mod value;

use std::collections::BTreeMap;
use std::time::Duration;

use bytes::Bytes;
use fipa::Time;
use fipa::platform::{AgentDescription, ServiceDescription};
use fipa::topics::TopicStatus;
use parking_lot::Mutex;
use serde_json::{Map, Value, json};
use tokio::sync::Notify;
use tokio::time::Instant;

pub(super) use self::follow::serve;
use self::value::TopicValue;
use super::picture::clipped;
use super::view::View;

/// Maximum number of agents at which pages look at the same time.
const MAX_AGENTS: usize = 4;

/// Maximum number of topics of an agent whose values are shown at the same time.
const MAX_SHOWN: usize = 4;

/// Maximum number of services and of topics of an agent, and of entries of a list. Further ones are left out.
const MAX_ROWS: usize = 100;

/// Time after the last look of a page at an agent, or at a topic, for which it is followed.
const KEPT: Duration = Duration::from_secs(3);

/// Maximum number of values per second of a topic to which the subscription stays. Of others, single values are taken.
const SLOW: f64 = 2.0;

/// The agents at which pages look.
#[derive(Debug, Default)]
pub(super) struct Offers {
    looked: Mutex<BTreeMap<String, Looked>>,
    /// Notified when a page begins to look at an agent.
    added: Notify,
}

/// An agent at which a page looks.
#[derive(Debug)]
struct Looked {
    last: Instant,
    /// The topics that pages have chosen, with the times of their last looks.
    chosen: BTreeMap<String, Instant>,
    description: Option<AgentDescription>,
    topics: BTreeMap<String, Topic>,
    problem: Option<String>,
}

/// A topic of an agent.
#[derive(Debug)]
struct Topic {
    status: TopicStatus,
    is_followed: bool,
    newest: Option<TopicValue>,
    /// Number of the newest value, from 1.
    number: u64,
    problem: Option<String>,
}

/// The answers of an agent, and of the directory facilitator about it.
#[derive(Debug)]
struct Answers {
    description: Option<AgentDescription>,
    /// `None` if the agent does not answer: the last ones stay.
    topics: Option<Vec<TopicStatus>>,
    problem: Option<String>,
}

impl Offers {
    /// Notes that a page looks at an agent, and perhaps has chosen one of its topics.
    pub(super) fn look_at(&self, name: &str, topic: Option<&str>) {
        let now = Instant::now();
        let mut looked = self.looked.lock();
        if looked.len() >= MAX_AGENTS && !looked.contains_key(name) {
            looked.retain(|_, agent| agent.is_kept(now));
            if looked.len() >= MAX_AGENTS {
                return;
            }
        }
        let agent = looked.entry(name.to_owned()).or_insert_with(|| {
            self.added.notify_one();
            Looked::new(now)
        });
        agent.last = now;
        if let Some(topic) = topic
            && (agent.chosen.len() < MAX_SHOWN || agent.chosen.contains_key(topic))
        {
            agent.chosen.insert(topic.to_owned(), now);
        }
    }

    /// Adds the offer of an agent to a view.
    pub(super) fn put(&self, name: &str, view: &mut View) {
        for section in ["offer", "services", "topics"] {
            view.section(section);
        }
        match self.looked.lock().get(name) {
            Some(agent) => agent.put(name, view),
            None => {
                let problem = format!("pages look at {MAX_AGENTS} other agents; close one");
                view.put("offer", name, &offer_row(None, Some(&problem)));
            }
        }
    }

    /// The newest image of a topic, with its media type.
    pub(super) fn image(&self, name: &str, topic: &str) -> Option<(&'static str, Bytes)> {
        let looked = self.looked.lock();
        let newest = looked.get(name)?.topics.get(topic)?.newest.as_ref()?;
        newest.image()
    }

    /// Forgets the agents at which no page looks any more. Returns the names of the others.
    fn followed(&self) -> Vec<String> {
        let now = Instant::now();
        let mut looked = self.looked.lock();
        looked.retain(|_, agent| agent.is_kept(now));
        looked.keys().cloned().collect()
    }

    /// Takes the answers of an agent. Returns the topics to follow.
    fn take(&self, name: &str, answers: Answers) -> Vec<String> {
        let mut looked = self.looked.lock();
        let agent = looked.get_mut(name);
        agent.map_or_else(Vec::new, |agent| agent.take(answers, Instant::now()))
    }

    /// Takes a value of a topic. Returns whether the publisher states that they come faster than pages show them.
    fn take_value(&self, name: &str, topic: &str, value: TopicValue) -> bool {
        self.change(name, topic, |topic| {
            topic.number += 1;
            topic.newest = Some(value);
            topic.problem = None;
            topic.is_fast()
        })
        .unwrap_or_default()
    }

    /// Takes the reason why a topic cannot be followed.
    fn fail(&self, name: &str, topic: &str, problem: &str) {
        self.change(name, topic, |topic| topic.problem = Some(clipped(problem)));
    }

    /// Whether the newest value of a topic is too large to be shown.
    fn is_too_large(&self, name: &str, topic: &str) -> bool {
        let is_too_large = |topic: &mut Topic| topic.status.bytes.is_some_and(value::is_too_large);
        self.change(name, topic, is_too_large).unwrap_or_default()
    }

    fn change<T>(
        &self,
        name: &str,
        topic: &str,
        change: impl FnOnce(&mut Topic) -> T,
    ) -> Option<T> {
        let mut looked = self.looked.lock();
        let topic = looked.get_mut(name)?.topics.get_mut(topic)?;
        Some(change(topic))
    }

    /// Forgets everything.
    fn clear(&self) {
        self.looked.lock().clear();
    }
}

impl Looked {
    fn new(now: Instant) -> Self {
        Self {
            last: now,
            chosen: BTreeMap::new(),
            description: None,
            topics: BTreeMap::new(),
            problem: None,
        }
    }

    fn is_kept(&self, now: Instant) -> bool {
        now.duration_since(self.last) < KEPT
    }

    fn take(&mut self, answers: Answers, now: Instant) -> Vec<String> {
        self.description = answers.description;
        self.problem = answers.problem;
        if let Some(topics) = answers.topics {
            let mut known = std::mem::take(&mut self.topics);
            for status in topics.into_iter().take(MAX_ROWS) {
                let name = clipped(&status.name);
                let topic = match known.remove(&name) {
                    Some(topic) => Topic { status, ..topic },
                    None => Topic::new(status),
                };
                self.topics.insert(name, topic);
            }
        }
        self.chosen
            .retain(|_, last| now.duration_since(*last) < KEPT);
        let chosen = self.chosen.keys();
        let first = self
            .topics
            .keys()
            .filter(|it| !self.chosen.contains_key(*it));
        let known = chosen
            .chain(first)
            .filter(|it| self.topics.contains_key(*it));
        let followed: Vec<String> = known.take(MAX_SHOWN).cloned().collect();
        for (name, topic) in &mut self.topics {
            topic.is_followed = followed.contains(name);
            if !topic.is_followed {
                topic.newest = None;
            }
        }
        followed
    }

    fn put(&self, name: &str, view: &mut View) {
        let row = offer_row(self.description.as_ref(), self.problem.as_deref());
        view.put("offer", name, &row);
        let services = self.description.iter().flat_map(|it| &it.services);
        for (number, service) in services.take(MAX_ROWS).enumerate() {
            view.put("services", number.to_string(), &service_row(service));
        }
        for (name, topic) in &self.topics {
            view.put("topics", name, &topic.row(name));
        }
    }
}

impl Topic {
    fn new(status: TopicStatus) -> Self {
        Self {
            status,
            is_followed: false,
            newest: None,
            number: 0,
            problem: None,
        }
    }

    /// Whether its values come faster than pages show them.
    fn is_fast(&self) -> bool {
        let rate = self.status.measured_rate.or(self.status.rate);
        rate.is_some_and(|rate| rate > SLOW)
    }

    fn row(&self, name: &str) -> Value {
        let TopicStatus {
            media_type,
            rate,
            measured_rate,
            published,
            bytes,
            subscribers,
            ..
        } = &self.status;
        let value = self.newest.as_ref().map(|value| value.row(self.number));
        json!({
            "name": name, "media_type": media_type.as_deref().map(clipped), "rate": rate,
            "measured_rate": measured_rate, "published": published, "bytes": bytes, "subscribers": subscribers,
            "followed": self.is_followed, "value": value, "problem": self.problem,
        })
    }
}

fn texts(texts: &[String]) -> Vec<String> {
    texts.iter().take(MAX_ROWS).map(|it| clipped(it)).collect()
}

fn offer_row(description: Option<&AgentDescription>, problem: Option<&str>) -> Value {
    let list = |list: fn(&AgentDescription) -> &Vec<String>| {
        description.map_or_else(Vec::new, |description| texts(list(description)))
    };
    let lease = description.and_then(|it| it.lease_time);
    json!({
        "listed": description.is_some(), "lease": lease.and_then(Time::to_rfc3339),
        "protocols": list(|it| &it.protocols), "ontologies": list(|it| &it.ontologies),
        "languages": list(|it| &it.languages), "problem": problem.map(clipped),
    })
}

fn service_row(service: &ServiceDescription) -> Value {
    let text = |text: &Option<String>| text.as_deref().map(clipped);
    let properties = service.properties.iter().take(MAX_ROWS).map(|property| {
        let value = property.value.as_ref().map(ToString::to_string);
        (
            clipped(&property.name),
            json!(value.as_deref().map(clipped)),
        )
    });
    json!({
        "name": text(&service.name), "type": text(&service.service_type), "ownership": text(&service.ownership),
        "protocols": texts(&service.protocols), "ontologies": texts(&service.ontologies),
        "languages": texts(&service.languages), "properties": properties.collect::<Map<String, Value>>(),
    })
}
