//! Topics: an agent publishes values, and other agents subscribe to them by name.
//!
//! [`Agent::publisher`](crate::Agent::publisher) publishes a topic; [`Agent::subscribe`](crate::Agent::subscribe)
//! subscribes to it. Both are the protocol `fipa-subscribe` (FIPA00035), so any FIPA agent can take part.
//!
//! `topic.rs` is the description of a topic, `publisher.rs` the participant of all subscriptions to it.

mod publisher;
mod topic;

pub use publisher::{NotificationResult, Notified, Publication, Publisher, TopicLoan};
pub use topic::Topic;
