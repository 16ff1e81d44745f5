//! Topics: an agent publishes values, and other agents subscribe to them by name.
//!
//! [`Agent::publisher`](crate::Agent::publisher) publishes a topic; [`Agent::subscribe`](crate::Agent::subscribe)
//! subscribes to it. Both are the protocol `fipa-subscribe` (FIPA00035), so any FIPA agent can take part.
//! [`Agent::topics_of`](crate::Agent::topics_of) asks an agent for its topics, their rates and their subscribers.
//!
//! `topic.rs` is the description of a topic, `publisher.rs` the participant of all subscriptions to it. `question.rs`
//! has the question for the topics of an agent, and `listing.rs` keeps them in the directory facilitator.

mod listing;
mod publisher;
mod question;
mod rate;
mod topic;

pub use publisher::{NotificationResult, Notified, Publication, Publisher, TopicLoan};
pub use question::{ONTOLOGY, TopicsError};
pub use topic::Topic;

pub use crate::agent::topics::{SubscriberStatus, TopicStatus};
