//! The outcomes of a message, one per receiver.

use std::fmt;
use std::sync::Arc;

use fipa_acl::{AgentId, escape_name};
use fipa_mts::Sending;
use fipa_transport::{FailureReason, Outcome};

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
