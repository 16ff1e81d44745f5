//! The outcomes of a message, one per receiver.

use std::fmt;
use std::sync::Arc;

use fipa_acl::escape;
use fipa_mts::Sending;
use fipa_transport::Outcome;

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
            write!(f, "{newline}{}: {outcome}", escape(receiver))?;
        }
        Ok(())
    }
}

/// Waits until every receiver has an outcome.
pub(crate) async fn deliveries(sending: Sending) -> Deliveries {
    let outcomes = sending.outcomes().await.into_iter();
    let delivered = outcomes.map(|(receiver, outcome)| Delivery { receiver, outcome });
    Deliveries(delivered.collect())
}
