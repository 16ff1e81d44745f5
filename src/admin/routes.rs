//! The routes that letters would take now, the reasons, and the state of each route.
//!
//! A process reports its own routes with [`Domain::routes`](crate::Domain::routes), and queries those
//! of the gateway on its host with [`of_gateway`]. The query is a `request` to the gateway with the
//! [`ONTOLOGY`]; its content is the name or pattern of the receivers, or empty for all. The answer is
//! an `inform` in the language `json` whose content is a [`RouteReport`].

use std::time::Duration;

use fipa_acl::{AgentId, Performative, escape};
pub use fipa_mts::core::{Route, RouteCandidate, RouteState, Standing};
use fipa_sds::Entry;
use fipa_transport::Incarnation;

pub use crate::domain::report::{
    Connected, ContestedName, HttpListener, LinkSecurity, LostHost, Namesakes, RefusedConnection,
    RefusedDial, RouteReport, StaticPeer,
};
use crate::error::{ReceiveError, SendError};
use crate::{Agent, Deliveries, Message};

/// The ontology of a request for routes.
pub const ONTOLOGY: &str = "fipa-mts-routes";

/// The type of agents that query the gateway for a report, see
/// [`RegisterOptions`](crate::RegisterOptions). Gateways do not announce agents of this type to other
/// hosts: they exist for a moment, and only agents of their own host answer them.
pub const ASKER_TYPE: &str = "fipa-asker";

/// The error of [`of_gateway`].
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AskError {
    /// The request cannot be built.
    #[error("cannot build the request to the gateway")]
    Build(#[from] fipa_acl::BuildError),
    /// The request cannot be sent.
    #[error("cannot send the request to the gateway")]
    Send(#[from] SendError),
    /// The request was not delivered to the gateway.
    #[error("the request did not reach the gateway: {0}")]
    NotDelivered(Deliveries),
    /// The gateway did not answer in time.
    #[error("the gateway did not answer within {0:?}; see the log of the gateway")]
    Silence(Duration),
    /// No message can be received.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// The answer is not a report.
    #[error(
        "the answer of the gateway is not a report of routes: {}; check that the gateway has the same \
         version as this program",
        escape(.0)
    )]
    NotUnderstood(String),
}

/// Queries the gateway of this agent's host for its routes to the receivers with this name or pattern,
/// or to all agents in its directory. Other messages that reach the agent in the meantime are lost, so
/// use an agent that serves no other purpose.
///
/// # Errors
/// If the request cannot be sent or delivered, or if no report arrives within `timeout`.
pub async fn of_gateway(
    agent: &Agent,
    gateway: &Entry,
    receivers: Option<&str>,
    timeout: Duration,
) -> Result<RouteReport, AskError> {
    let request = (ONTOLOGY, receivers.map(str::to_owned));
    let answer = ask(agent, gateway, request, timeout).await?;
    let content = answer.content().map(|bytes| &bytes[..]).unwrap_or_default();
    if *answer.performative() != Performative::Inform {
        let text = String::from_utf8_lossy(content).into_owned();
        return Err(AskError::NotUnderstood(text));
    }
    serde_json::from_slice(content).map_err(|error| AskError::NotUnderstood(error.to_string()))
}

/// Sends a request with this ontology and content to the gateway, and returns the answer.
pub(crate) async fn ask(
    agent: &Agent,
    gateway: &Entry,
    (ontology, content): (&str, Option<String>),
    timeout: Duration,
) -> Result<Message, AskError> {
    let reference = Incarnation::random().to_string();
    let receiver =
        AgentId::new(&*gateway.name).map_err(|error| AskError::NotUnderstood(error.to_string()))?;
    let mut request = agent
        .message(Performative::Request)
        .receiver(receiver)
        .ontology(ontology)
        .reply_with(reference.as_str());
    if let Some(content) = content {
        request = request.content(content);
    }
    let deliveries = agent.send_within(request.build()?, timeout).await?;
    if !deliveries.all_succeeded() {
        return Err(AskError::NotDelivered(deliveries));
    }
    let answer = async {
        loop {
            let message = agent.receive().await?.into_message();
            if message.in_reply_to() == Some(reference.as_str()) {
                return Ok::<_, ReceiveError>(message);
            }
        }
    };
    let answer = tokio::time::timeout(timeout, answer);
    Ok(answer.await.map_err(|_| AskError::Silence(timeout))??)
}
