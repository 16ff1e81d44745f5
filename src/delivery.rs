//! The outcomes of a message, one per receiver.

use std::fmt;
use std::sync::Arc;

use fipa_acl::escape_name;
use fipa_mts::Sending;
use fipa_transport::Outcome;

use crate::checks::Unsettled;

/// The outcomes of a message, one [`Delivery`] per receiver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Deliveries(pub Vec<Delivery>);

/// The outcome of a message at one receiver.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Delivery {
    /// The name of the receiver, or the name or pattern that matched no agent.
    pub receiver: Arc<str>,
    /// The outcome.
    pub outcome: Outcome,
}

impl Deliveries {
    /// Whether every receiver's outcome is a success: delivered, or handed to a peer that cannot
    /// confirm.
    #[must_use]
    pub fn all_succeeded(&self) -> bool {
        self.0.iter().all(|delivery| delivery.outcome.is_success())
    }
}

impl fmt::Display for Deliveries {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, Delivery { receiver, outcome }) in self.0.iter().enumerate() {
            let newline = if index > 0 { "\n" } else { "" };
            write!(f, "{newline}{}: {outcome}", escape_name(receiver))?;
        }
        Ok(())
    }
}

/// A message that was sent.
pub(crate) struct Sent {
    sending: Sending,
    /// The checks that the outcomes concern.
    unsettled: Option<Unsettled>,
}

impl Sent {
    pub(crate) fn new(sending: Sending, unsettled: Option<Unsettled>) -> Self {
        Self { sending, unsettled }
    }
}

/// Waits until every receiver has an outcome.
pub(crate) async fn deliveries(sent: Sent) -> Deliveries {
    let outcomes = sent.sending.outcomes().await.into_iter();
    let delivered = outcomes.map(|(receiver, outcome)| Delivery { receiver, outcome });
    let deliveries = Deliveries(delivered.collect());
    if let Some(unsettled) = sent.unsettled {
        let failed = deliveries.0.iter().filter(|one| !one.outcome.is_success());
        unsettled.settle(failed.map(|one| &*one.receiver));
    }
    deliveries
}
