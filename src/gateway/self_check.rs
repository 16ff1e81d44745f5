//! Letters of the gateway to itself, which show that its delivery core works.
//!
//! Such a letter passes the parts that every letter to the gateway passes: the directory, the delivery core, the queue
//! of the gateway, and the task that reads the queue. A service manager restarts a gateway whose check fails.

use std::fmt;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use fipa_acl::{AgentId, AgentIdError, BuildError, Message, Performative};
use fipa_mts::core::{Received, Submission};
use fipa_mts::{PostError, letter_for};
use fipa_sds::Directory;
use fipa_transport::Incarnation;
use tokio::sync::broadcast;
use tokio::sync::broadcast::error::RecvError;

use crate::domain::service::Service;
use crate::{Deliveries, Delivery};

/// The ontology of the letters.
const ONTOLOGY: &str = "fipa-self-check";

/// Maximum number of arrivals that a check has not yet seen. Other agents of the host can send letters with the
/// ontology, too.
const MAX_UNSEEN: usize = 16;

/// The numbers in the letters that have arrived.
#[derive(Debug, Clone)]
pub(super) struct Arrivals(broadcast::Sender<u64>);

impl Default for Arrivals {
    fn default() -> Self {
        Self(broadcast::Sender::new(MAX_UNSEEN))
    }
}

impl Arrivals {
    /// Handles a letter to the gateway. Returns whether it is one of a check.
    pub(super) fn handle(&self, message: &Message, received: &Received) -> bool {
        if received.remote || message.ontology() != Some(ONTOLOGY) {
            return false;
        }
        let content = message.content().map(|content| &content[..]);
        let content = content.and_then(|content| <[u8; 8]>::try_from(content).ok());
        if let Some(number) = content.map(u64::from_be_bytes) {
            // Without a check, there is no receiver.
            let _ = self.0.send(number);
        }
        true
    }
}

/// The check of a gateway, from [`Gateway::self_check`](super::Gateway::self_check).
pub struct SelfCheck {
    pub(super) service: Arc<Service>,
    pub(super) view: Arc<dyn Directory>,
    pub(super) arrivals: Arrivals,
}

impl fmt::Debug for SelfCheck {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SelfCheck")
            .field("mts", &self.service.own)
            .finish_non_exhaustive()
    }
}

/// The error of a [`SelfCheck`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SelfCheckError {
    /// The directory does not list the gateway, for example because another program removed its files.
    #[error("the directory of this host does not list the gateway")]
    NotListed,
    /// The name of the gateway is no agent's name.
    #[error("the gateway's name cannot be addressed")]
    Name(#[from] AgentIdError),
    /// The letter cannot be built.
    #[error("cannot build the letter")]
    Build(#[from] BuildError),
    /// The letter cannot be encoded.
    #[error("cannot encode the letter")]
    Encode(#[from] PostError),
    /// The letter was not delivered.
    #[error("the letter was not delivered to {0}")]
    NotDelivered(Deliveries),
    /// The gateway did not take the letter in time.
    #[error("the gateway did not take the letter within {0:?}")]
    Silence(Duration),
}

impl SelfCheck {
    /// Sends a letter from the gateway to itself, and waits until the gateway has taken it.
    ///
    /// # Errors
    /// If the letter cannot be sent or delivered, or if the gateway does not take it within `timeout`.
    pub async fn pass_letter(&self, timeout: Duration) -> Result<(), SelfCheckError> {
        let passed = tokio::time::timeout(timeout, self.pass(timeout)).await;
        passed.unwrap_or(Err(SelfCheckError::Silence(timeout)))
    }

    async fn pass(&self, deadline: Duration) -> Result<(), SelfCheckError> {
        let (service, own) = (&self.service, self.service.own.incarnation);
        let entry = self.view.registered_as(own, &service.name);
        let entry = entry.ok_or(SelfCheckError::NotListed)?;
        let id = AgentId::new(&*service.name)?;
        let number = Incarnation::random().as_u64();
        let message = Message::builder(Performative::Inform)
            .sender(id.clone())
            .receiver(id)
            .ontology(ONTOLOGY)
            .content(number.to_be_bytes().to_vec())
            .build()?;
        let mut arrivals = self.arrivals.0.subscribe();
        let submission = Submission {
            sender: own,
            letter: letter_for(&message, SystemTime::now())?,
            receivers: Vec::new(),
            deadline,
        };
        let outcomes = service.mts.submit_to(submission, &entry).await.into_iter();
        let outcomes = outcomes.map(|(receiver, outcome)| Delivery { receiver, outcome });
        let deliveries = Deliveries(outcomes.collect());
        if !deliveries.all_succeeded() {
            return Err(SelfCheckError::NotDelivered(deliveries));
        }
        loop {
            match arrivals.recv().await {
                Ok(arrived) if arrived == number => return Ok(()),
                Ok(_) => {}
                // More letters of other agents than the channel holds; this one may be among the lost ones, and the
                // next check sends another.
                Err(RecvError::Lagged(_)) => {}
                // The sender is part of this value.
                Err(RecvError::Closed) => return Err(SelfCheckError::Silence(deadline)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Config, Gateway};

    #[tokio::test(flavor = "multi_thread")]
    async fn a_gateway_that_takes_no_letters_does_not_pass() {
        let mut config = Config::for_host("checked");
        config.domain = format!("self-check-{}", std::process::id());
        config.discovery.mdns = false;
        let gateway = Gateway::open(&config).await.unwrap();
        let check = gateway.self_check();
        for _ in 0..3 {
            check.pass_letter(Duration::from_secs(60)).await.unwrap();
        }
        for task in &gateway.tasks {
            task.abort();
        }
        while !gateway.tasks.iter().all(|task| task.is_finished()) {
            tokio::task::yield_now().await;
        }
        let stuck = check.pass_letter(Duration::from_millis(50)).await;
        assert!(
            matches!(stuck, Err(SelfCheckError::Silence(_))),
            "{stuck:?}"
        );
        gateway.close().await;
    }
}
