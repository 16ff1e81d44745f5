//! Messages that a client of the page sends and goals that it cancels, as the agent `dashboard@<mts.name>`. The rules of
//! access of the receivers apply to it as to every agent.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, SystemTime};

use fipa::actions::{ActionError, GoalRef};
use fipa::error::ErrorChain;
use fipa::{Agent, AgentId, Config, Domain, Performative, RegisterOptions, log_limit};
use fipa_acl::{escape, escape_name};
use parking_lot::Mutex;
use serde::Deserialize;
use serde_json::{Value, json};
use tokio::sync::watch;

use super::goals::Cancelled;
use super::picture::{Picture, clipped};
use crate::membership;

/// Maximum wait for the registration of the agent, and for the outcome of a message.
const WITHIN: Duration = Duration::from_secs(10);

/// Maximum wait for the end of a goal.
const STOP: Duration = Duration::from_secs(8);

/// Time before the next attempt to register the agent.
const RETRY: Duration = Duration::from_secs(5);

/// A message to send.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Order {
    to: String,
    performative: String,
    content: Option<String>,
    language: Option<String>,
    ontology: Option<String>,
    protocol: Option<String>,
    conversation: Option<String>,
}

/// A goal to cancel.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CancelOrder {
    robot: String,
    goal: String,
    client: String,
}

/// The error of an order.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(super) enum OrderError {
    /// Clients may only see.
    #[error("http.control is false: the page only shows the domain")]
    NoControl,
    /// The agent is not registered.
    #[error("the agent of the page cannot be registered; see the log of the gateway")]
    NotReady,
    /// It is not an order.
    #[error("not an order: {0}")]
    Malformed(#[from] serde_json::Error),
    /// Its performative is none.
    #[error("{0:?} is no performative")]
    Performative(String),
    /// The message cannot be sent.
    #[error("{}", ErrorChain(.0))]
    Send(#[from] fipa::error::SendError),
    /// The name of the robot is none.
    #[error("{}", ErrorChain(.0))]
    Name(#[from] fipa::error::AgentIdError),
    /// The robot does not cancel the goal.
    #[error("{}", ErrorChain(.0))]
    Robot(#[from] ActionError),
    /// The goal has not ended in time.
    #[error("the goal has not ended within {STOP:?}; the list shows whether it goes on")]
    GoesOn,
}

/// The agent of the page.
#[derive(Debug)]
pub(super) struct Orders {
    is_permitted: bool,
    agent: watch::Sender<Option<Arc<Agent>>>,
    /// Number of the next cancel.
    next: AtomicU64,
}

impl Orders {
    pub(super) fn new(config: &Config) -> Self {
        Self {
            is_permitted: config.http.control,
            agent: watch::Sender::default(),
            next: AtomicU64::default(),
        }
    }

    /// Whether clients may send messages.
    pub(super) fn are_permitted(&self) -> bool {
        self.is_permitted
    }

    /// Registers the agent, and reads its letters until the future is dropped: the page shows them as all others. Never
    /// ends if clients may only see. While another agent has the name, the page shows the domain all the same.
    pub(super) async fn serve(&self, domain: &Domain, config: &Config) {
        if !self.is_permitted {
            return std::future::pending().await;
        }
        let name = format!("dashboard@{}", config.mts.name);
        let options = RegisterOptions {
            agent_type: "fipa-dashboard".to_owned(),
            description: "sends messages of the web page of this gateway".to_owned(),
        };
        let agent = loop {
            match membership::register(domain, &name, options.clone(), config).await {
                Ok(agent) => break Arc::new(agent),
                Err(failure) => {
                    let (name, problem) = (escape_name(&name), failure.problem());
                    let problem = escape(&problem);
                    log_limit::warn!("the dashboard has no agent {name}; trying again: {problem}");
                }
            }
            tokio::time::sleep(RETRY).await;
        };
        let _left = Left(&self.agent);
        self.agent.send_replace(Some(Arc::clone(&agent)));
        while agent.receive().await.is_ok() {}
    }

    /// Sends a message, and returns its outcomes in the JSON of `fipa send`. Waits for the registration of the agent.
    ///
    /// # Errors
    /// If clients may only see, or the order is not valid.
    pub(super) async fn send(&self, order: &[u8]) -> Result<Value, OrderError> {
        if !self.is_permitted {
            return Err(OrderError::NoControl);
        }
        let Order {
            to,
            performative,
            content,
            language,
            ontology,
            protocol,
            conversation,
        } = serde_json::from_slice(order)?;
        let known: Result<Performative, _> = performative.parse();
        let performative = known.map_err(|_| OrderError::Performative(clipped(&performative)))?;
        let agent = self.registered().await?;
        let mut message = agent.message(performative).receiver(to);
        if let Some(content) = content {
            message = message.content(content);
        }
        if let Some(language) = language {
            message = message.language(language);
        }
        if let Some(ontology) = ontology {
            message = message.ontology(ontology);
        }
        if let Some(protocol) = protocol {
            message = message.protocol(protocol);
        }
        if let Some(conversation) = conversation {
            message = message.conversation_id(conversation);
        }
        let deliveries = agent.send_within(message, WITHIN).await?;
        Ok(json!({ "deliveries": deliveries }))
    }

    /// Cancels a goal, and waits until it has ended. Waits for the registration of the agent. The picture shows the
    /// cancel from its begin: it may take effect although its client has left.
    ///
    /// # Errors
    /// If clients may only see, the order is not valid, or the robot does not cancel the goal.
    pub(super) async fn cancel(
        &self,
        order: &[u8],
        picture: &Mutex<Picture>,
    ) -> Result<Cancelled, OrderError> {
        if !self.is_permitted {
            return Err(OrderError::NoControl);
        }
        let order: CancelOrder = serde_json::from_slice(order)?;
        let agent = self.registered().await?;
        let robot = agent.robot(AgentId::new(&*order.robot)?);
        let mut cancelled = Cancelled {
            number: self.next.fetch_add(1, Ordering::Relaxed),
            at: SystemTime::now(),
            by: agent.name().to_owned(),
            robot: order.robot,
            goal: order.goal.clone(),
            client: order.client.clone(),
            outcome: None,
        };
        picture.lock().goals.put_cancelled(&cancelled);
        let ended = robot.cancel(GoalRef::from(order.goal).of(order.client));
        let ended = match tokio::time::timeout(STOP, ended).await {
            Ok(ended) => ended.map_err(OrderError::from),
            Err(_) => Err(OrderError::GoesOn),
        };
        let (outcome, error) = match ended {
            Ok(status) => (Ok(status), None),
            Err(error) => (Err(error.to_string()), Some(error)),
        };
        cancelled.outcome = Some(outcome);
        picture.lock().goals.put_cancelled(&cancelled);
        error.map_or(Ok(cancelled), Err)
    }

    /// The agent of the page, if it is registered.
    pub(super) fn agent(&self) -> Option<Arc<Agent>> {
        self.agent.borrow().clone()
    }

    async fn registered(&self) -> Result<Arc<Agent>, OrderError> {
        let mut agent = self.agent.subscribe();
        let registered = tokio::time::timeout(WITHIN, agent.wait_for(Option::is_some)).await;
        let agent = registered.ok().and_then(|agent| agent.ok()?.clone());
        agent.ok_or(OrderError::NotReady)
    }
}

/// Takes the agent away at the end, so that it leaves the domain with its owner.
struct Left<'a>(&'a watch::Sender<Option<Arc<Agent>>>);

impl Drop for Left<'_> {
    fn drop(&mut self) {
        self.0.send_replace(None);
    }
}
