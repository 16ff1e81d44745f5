//! Which way letters would go now, and why; what has happened on each way.
//!
//! A robot process tells it of itself ([`Domain::routes`](crate::Domain::routes)), and its host's
//! gateway when it is asked by letter: [`of_gateway`]. The letter is a `request` to the gateway
//! with the [`ONTOLOGY`] and the name or pattern of the receivers as its content, or none for all;
//! the answer is an `inform` in the language `json`, a [`Report`].

use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{AgentId, Performative, escape};
pub use fipa_mts::core::{Route, Standing, Way, WayState};
use fipa_sds::{Directory, Entry, Query, Role};
use fipa_transport::{Incarnation, Location};
use serde::{Deserialize, Serialize};

use crate::{Agent, Deliveries, ReceiveError, SendError};

/// The ontology of a request for routes.
pub const ONTOLOGY: &str = "fipa-mts-routes";

/// What one message transport service does with letters now.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Report {
    /// Its name.
    pub mts: String,
    /// This life of it.
    pub incarnation: Incarnation,
    /// Where it takes letters.
    pub locations: Vec<Location>,
    /// How letters to each agent would go.
    pub routes: Vec<Route>,
    /// What has happened on each way.
    pub ways: Vec<WayState>,
    /// The static peers, and how it stands with them; a gateway's only.
    pub peers: Vec<StaticPeer>,
    /// The gateways that a connection is open with; a gateway's only.
    pub neighbours: Vec<Connected>,
}

/// A line of `discovery.static`, and how it stands with that peer.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct StaticPeer {
    /// Its name in the configuration.
    pub name: String,
    /// Where it answers, if it does.
    pub answers: Option<Location>,
    /// Where it did not answer when it was last asked, and why.
    pub failures: Vec<(Location, String)>,
    /// In how many milliseconds it is asked again; none while an answer is awaited.
    pub asked_again_in: Option<u64>,
}

/// A gateway that a connection is open with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Connected {
    /// Its name.
    pub name: String,
    /// This life of it.
    pub incarnation: Incarnation,
    /// Where it takes letters, as far as is known.
    pub locations: Vec<Location>,
    /// How many connections are open.
    pub connections: usize,
    /// For how many seconds.
    pub seconds: u64,
}

/// Why a gateway did not tell its routes.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum AskError {
    /// The request cannot be written.
    #[error("the request cannot be written: {0}")]
    Build(#[from] fipa_acl::BuildError),
    /// Nor sent.
    #[error("the request cannot be sent: {0}")]
    Send(#[from] SendError),
    /// It did not reach the gateway.
    #[error("the request did not reach the gateway: {0}")]
    NotDelivered(Deliveries),
    /// No answer came.
    #[error("the gateway did not answer within {0:?}; see its log")]
    Silence(Duration),
    /// Nothing can be received any more.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// What came is no report.
    #[error("the gateway's answer is not understood: {}; is it of another version?", escape(.0))]
    NotUnderstood(String),
}

/// Asks the gateway of this agent's host which way it would send letters to the receivers with
/// this name or pattern, or to all it knows. Whatever else comes to the agent meanwhile is lost:
/// use one that is there for this only.
///
/// # Errors
/// When the gateway cannot be asked, or does not answer in time.
pub async fn of_gateway(
    agent: &Agent,
    gateway: &Entry,
    receivers: Option<&str>,
    patience: Duration,
) -> Result<Report, AskError> {
    let reference = Incarnation::random().to_string();
    let receiver =
        AgentId::new(&*gateway.name).map_err(|error| AskError::NotUnderstood(error.to_string()))?;
    let mut request = agent
        .message(Performative::Request)
        .receiver(receiver)
        .ontology(ONTOLOGY)
        .reply_with(reference.as_str());
    if let Some(receivers) = receivers {
        request = request.content(receivers.to_owned());
    }
    let deliveries = agent.send_within(request.build()?, patience).await?;
    if !deliveries.all_succeeded() {
        return Err(AskError::NotDelivered(deliveries));
    }
    let answer = async {
        loop {
            let message = agent.receive().await?.message;
            if message.in_reply_to() == Some(reference.as_str()) {
                return Ok::<_, ReceiveError>(message);
            }
        }
    };
    let answer = tokio::time::timeout(patience, answer);
    let answer = answer.await.map_err(|_| AskError::Silence(patience))??;
    let content = answer.content().map(|bytes| &bytes[..]).unwrap_or_default();
    if *answer.performative() != Performative::Inform {
        let text = String::from_utf8_lossy(content).into_owned();
        return Err(AskError::NotUnderstood(text));
    }
    serde_json::from_slice(content).map_err(|error| AskError::NotUnderstood(error.to_string()))
}

impl From<fipa_mts::core::PeerState> for StaticPeer {
    fn from(state: fipa_mts::core::PeerState) -> Self {
        let failures = state.failures.into_iter();
        let millis = |pause: Duration| u64::try_from(pause.as_millis()).unwrap_or(u64::MAX);
        Self {
            name: state.peer.name.to_string(),
            answers: state.answers,
            failures: failures.map(|(at, why)| (at, why.to_string())).collect(),
            asked_again_in: state.asked_again_in.map(millis),
        }
    }
}

/// The agents that letters can be for, of a search.
pub(crate) fn agents(directory: &dyn Directory, query: &Query) -> Vec<Arc<Entry>> {
    let mut found = directory.search(query);
    found.retain(|entry| entry.role == Role::Agent);
    found
}
