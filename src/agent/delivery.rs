//! The outcomes of a message, one per receiver.

use std::fmt;
use std::sync::Arc;

use fipa_acl::{AgentId, escape_name};
use fipa_mts::Sending;
use fipa_transport::{FailureReason, Outcome};
use serde::{Serialize, Serializer};
use serde_json::{Value, json};

use crate::agent::checks::Unsettled;
use crate::agent::stated::{Full, Waiting};

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

/// As a JSON array with an object per receiver: `receiver`, `outcome` (`delivered`, `sent` or `failed`), `via` or
/// `reason`, and the failed `attempts`, each with `via`, `location` and `error`.
impl Serialize for Deliveries {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_seq(self.0.iter().map(Delivery::to_json))
    }
}

impl Delivery {
    fn to_json(&self) -> Value {
        let attempts = self.outcome.attempts().iter().map(|attempt| {
            json!({
                "via": attempt.via.name(),
                "location": attempt.location.to_string(),
                "error": attempt.error.to_string(),
            })
        });
        let (outcome, key, detail) = match &self.outcome {
            Outcome::Delivered { via, .. } => ("delivered", "via", via.name().to_owned()),
            Outcome::Sent { via, .. } => ("sent", "via", via.name().to_owned()),
            Outcome::Failed { reason, .. } => ("failed", "reason", reason.to_string()),
            unknown => ("failed", "reason", unknown.to_string()),
        };
        json!({
            "receiver": self.receiver, "outcome": outcome, key: detail, "attempts": attempts.collect::<Vec<_>>(),
        })
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

/// A message that was sent, or that waits for the introduction of its receivers.
pub(crate) struct Sent {
    way: Way,
    /// The checks that the outcomes concern.
    unsettled: Option<Unsettled>,
}

enum Way {
    Sent(Sending),
    Held {
        receivers: Vec<Arc<str>>,
        waiting: Result<Waiting, Full>,
    },
}

impl Sent {
    pub(crate) fn new(sending: Sending, unsettled: Option<Unsettled>) -> Self {
        let way = Way::Sent(sending);
        Self { way, unsettled }
    }

    /// A message to these receivers that waits, unless too many messages do.
    pub(crate) fn held(
        receivers: &[AgentId],
        waiting: Result<Waiting, Full>,
        unsettled: Option<Unsettled>,
    ) -> Self {
        let receivers = receivers.iter().map(|it| it.name().into()).collect();
        let way = Way::Held { receivers, waiting };
        Self { way, unsettled }
    }
}

impl Way {
    async fn outcomes(self) -> Vec<(Arc<str>, Outcome)> {
        let (receivers, waiting) = match self {
            Self::Sent(sending) => return sending.outcomes().await,
            Self::Held { receivers, waiting } => (receivers, waiting),
        };
        let reason = match waiting {
            Err(Full) => FailureReason::QueueFull,
            Ok(waiting) => match waiting.await {
                Ok(sent) => {
                    let mut all = Vec::new();
                    for sending in sent {
                        all.extend(sending.outcomes().await);
                    }
                    return all;
                }
                Err(_) => FailureReason::Closed,
            },
        };
        let attempts = Vec::new();
        let failed = Outcome::Failed { reason, attempts };
        let failed = receivers.into_iter().map(|it| (it, failed.clone()));
        failed.collect()
    }
}

/// Waits until every receiver has an outcome.
pub(crate) async fn deliveries(sent: Sent) -> Deliveries {
    let outcomes = sent.way.outcomes().await.into_iter();
    let delivered = outcomes.map(|(receiver, outcome)| Delivery { receiver, outcome });
    let deliveries = Deliveries(delivered.collect());
    if let Some(unsettled) = sent.unsettled {
        let failed = deliveries.0.iter().filter(|one| !one.outcome.is_success());
        unsettled.settle(failed.map(|one| &*one.receiver));
    }
    deliveries
}
