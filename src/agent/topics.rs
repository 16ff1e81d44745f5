//! The topics that an agent publishes. The publishers are in `protocol`.

use std::collections::BTreeMap;

use parking_lot::Mutex;

/// Maximum length in bytes of the list of topics in a refusal.
const MAX_LISTED: usize = 1_000;

/// The topics of an agent.
#[derive(Debug, Default)]
pub(crate) struct Topics(Mutex<Declared>);

#[derive(Debug, Default)]
struct Declared {
    /// The number of publishers of each topic.
    publishers: BTreeMap<String, usize>,
    /// Whether a task refuses subscriptions to other topics. It ends with the agent.
    is_refusing: bool,
}

impl Topics {
    /// Adds a publisher of a topic. Returns whether it is the first one that the agent ever had.
    pub(crate) fn add(&self, topic: &str) -> bool {
        let mut declared = self.0.lock();
        *declared.publishers.entry(topic.to_owned()).or_default() += 1;
        !std::mem::replace(&mut declared.is_refusing, true)
    }

    /// Removes a publisher of a topic.
    pub(crate) fn remove(&self, topic: &str) {
        let mut declared = self.0.lock();
        if let Some(count) = declared.publishers.get_mut(topic) {
            *count -= 1;
            if *count == 0 {
                declared.publishers.remove(topic);
            }
        }
    }

    pub(crate) fn is_empty(&self) -> bool {
        self.0.lock().publishers.is_empty()
    }

    /// Returns the reason of a refusal, with the topics that exist, as far as they fit.
    pub(crate) fn refusal(&self) -> String {
        let mut text = "there is no such topic; topics:".to_owned();
        for topic in self.0.lock().publishers.keys() {
            if text.len() + topic.len() > MAX_LISTED {
                text += " ...";
                break;
            }
            text = text + " " + topic;
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_lists_the_topics_as_far_as_they_fit() {
        let topics = Topics::default();
        assert!(topics.add("image"));
        assert!(!topics.add("charge"));
        assert_eq!(
            topics.refusal(),
            "there is no such topic; topics: charge image"
        );
        topics.add("charge");
        topics.remove("charge");
        topics.add(&"z".repeat(MAX_LISTED));
        assert!(topics.refusal().ends_with(" charge image ..."));
        topics.remove("charge");
        assert!(!topics.refusal().contains("charge"));
    }
}
