//! The topics that an agent publishes. The publishers are in `topics`.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::sync::{Arc, Weak};

use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::sync::Notify;

/// Maximum length in bytes of the list of topics in a refusal.
const MAX_LISTED: usize = 1_000;

/// A topic that an agent publishes, as [`Agent::topics_of`](crate::Agent::topics_of) returns it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename = "topic", rename_all = "kebab-case")]
#[non_exhaustive]
pub struct TopicStatus {
    /// The name.
    pub name: String,
    /// The media type of the contents, if the publisher declares it.
    pub media_type: Option<String>,
    /// Notifications per second that the publisher declares.
    pub rate: Option<f64>,
    /// Notifications per second, measured over the last 32 ones. `None` before the second one.
    pub measured_rate: Option<f64>,
    /// Number of contents that were published.
    pub published: u64,
    /// Length of the newest content in bytes.
    pub bytes: Option<u64>,
    /// The number of subscribers.
    pub subscribers: u64,
    /// The subscribers by name, at most 64.
    pub first_subscribers: Vec<SubscriberStatus>,
}

/// A subscriber to a topic, as its publisher counts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename = "subscriber", rename_all = "kebab-case")]
#[non_exhaustive]
pub struct SubscriberStatus {
    /// The name of the subscriber.
    pub name: String,
    /// The notifications that it gets: `all` or `latest(n)`.
    pub keep: String,
    /// Number of notifications that it received, or that went to a peer that cannot confirm.
    pub delivered: u64,
    /// Number of notifications that newer ones replaced.
    pub replaced: u64,
    /// Number of notifications that failed, or for which too many others waited.
    pub failed: u64,
    /// Number of notifications that wait or are under way.
    pub waiting: u64,
    /// The reason of the last failure.
    pub last_failure: Option<String>,
}

/// A publisher, as the table of its agent knows it.
pub(crate) trait TopicSource: Debug + Send + Sync {
    fn status(&self) -> TopicStatus;
}

/// The topics of an agent.
#[derive(Debug, Default)]
pub(crate) struct Topics {
    declared: Mutex<Declared>,
    /// Notified when the topics change, and when the agent ends.
    changed: Arc<Notify>,
    /// Held while this agent changes its description in the directory facilitator of its host: the application and the
    /// list of topics each read and replace the whole description.
    pub(crate) describing: tokio::sync::Mutex<()>,
}

#[derive(Debug, Default)]
struct Declared {
    /// The publishers of each topic. An agent may have several of one.
    sources: BTreeMap<String, Vec<Weak<dyn TopicSource>>>,
    /// Whether the agent ever had a publisher.
    is_known: bool,
}

impl Topics {
    /// Adds a publisher of a topic. Returns whether it is the first one that the agent ever had.
    pub(crate) fn add(&self, topic: &str, source: Weak<dyn TopicSource>) -> bool {
        let mut declared = self.declared.lock();
        let sources = declared.sources.entry(topic.to_owned()).or_default();
        sources.push(source);
        self.changed.notify_one();
        !std::mem::replace(&mut declared.is_known, true)
    }

    /// Removes a publisher of a topic.
    pub(crate) fn remove(&self, topic: &str, source: &Weak<dyn TopicSource>) {
        let mut declared = self.declared.lock();
        if let Some(sources) = declared.sources.get_mut(topic) {
            sources.retain(|other| !Weak::ptr_eq(other, source));
            if sources.is_empty() {
                declared.sources.remove(topic);
            }
        }
        self.changed.notify_one();
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.declared.lock().sources.is_empty()
    }

    /// Returns the status of each topic, by name.
    pub(crate) fn status(&self) -> Vec<TopicStatus> {
        let sources: Vec<_> = self
            .declared
            .lock()
            .sources
            .values()
            .flatten()
            .filter_map(Weak::upgrade)
            .collect();
        // A publisher has a lock of its own.
        sources.into_iter().map(|source| source.status()).collect()
    }

    /// Is notified when the topics change, and when the agent ends.
    pub(crate) fn changed(&self) -> Arc<Notify> {
        Arc::clone(&self.changed)
    }

    /// Returns the reason of a refusal, with the topics that exist, as far as they fit.
    pub(crate) fn refusal(&self) -> String {
        let mut text = "there is no such topic; topics:".to_owned();
        for topic in self.declared.lock().sources.keys() {
            if text.len() + topic.len() > MAX_LISTED {
                text += " ...";
                break;
            }
            text = text + " " + topic;
        }
        text
    }
}

impl Drop for Topics {
    fn drop(&mut self) {
        self.changed.notify_one();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug)]
    struct Source;

    impl TopicSource for Source {
        fn status(&self) -> TopicStatus {
            unreachable!("not asked")
        }
    }

    #[test]
    fn a_refusal_lists_the_topics_as_far_as_they_fit() {
        let topics = Topics::default();
        let sources = [Arc::new(Source), Arc::new(Source)];
        let weak = sources.each_ref().map(|source| {
            let source: Weak<dyn TopicSource> = Arc::downgrade(source) as _;
            source
        });
        assert!(topics.add("image", weak[0].clone()));
        assert!(!topics.add("charge", weak[0].clone()));
        assert_eq!(
            topics.refusal(),
            "there is no such topic; topics: charge image"
        );
        topics.add("charge", weak[1].clone());
        topics.remove("charge", &weak[1]);
        topics.add(&"z".repeat(MAX_LISTED), weak[0].clone());
        assert!(topics.refusal().ends_with(" charge image ..."));
        topics.remove("charge", &weak[0]);
        assert!(!topics.refusal().contains("charge"));
    }
}
