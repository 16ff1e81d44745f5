//! The routes that letters would take now, the reasons, and the state of each route.
//!
//! A process reports its own routes with [`Domain::routes`](crate::Domain::routes), and queries those
//! of the gateway on its host with [`of_gateway`]. The query is a `request` to the gateway with the
//! [`ONTOLOGY`]; its content is the name or pattern of the receivers, or empty for all. The answer is
//! an `inform` in the language `json` whose content is a [`Report`].

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use fipa_acl::{AgentId, Performative, escape};
pub use fipa_mts::core::{Route, RouteCandidate, RouteState, Standing};
use fipa_sds::{Directory, Entry, Query, Role};
use fipa_transport::{Incarnation, Location};
use serde::{Deserialize, Serialize};

use crate::{Agent, Deliveries, Message, ReceiveError, SendError};

/// The ontology of a request for routes.
pub const ONTOLOGY: &str = "fipa-mts-routes";

/// The type of agents that query the gateway for a report, see
/// [`RegisterOptions`](crate::RegisterOptions). Gateways do not announce agents of this type to other
/// hosts: they exist for a moment, and only agents of their own host answer them.
pub const ASKER_TYPE: &str = "fipa-asker";

/// The routes of one message transport service.
///
/// Serialized as a JSON object with the names of the fields.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Report {
    /// The name of the service.
    pub mts: String,
    /// The incarnation of the service: a random number per start.
    pub incarnation: Incarnation,
    /// The locations at which the service accepts letters.
    pub locations: Vec<Location>,
    /// The route to each agent.
    pub routes: Vec<Route>,
    /// The state of each route.
    pub ways: Vec<RouteState>,
    /// The static peers; empty unless the service is a gateway.
    pub peers: Vec<StaticPeer>,
    /// The gateways with an open connection; empty unless the service is a gateway.
    pub neighbors: Vec<Connected>,
    /// The connections that the service has refused because only one side has keys, because a side does not
    /// trust the other, or because the sides have different versions of the protocol, the latest first; empty unless the service is a gateway. Of each address
    /// the latest, of at most 16 addresses.
    #[serde(default)]
    pub refused: Vec<RefusedConnection>,
    /// The connections of the service that peers have refused, the latest first; empty unless the service
    /// is a gateway. Of each address the latest, of at most 16 addresses. A connection that succeeds
    /// removes the refusals of its peer.
    #[serde(default)]
    pub refused_dials: Vec<RefusedDial>,
    /// The names that several gateways have, at most 16; empty unless the service is a gateway.
    #[serde(default)]
    pub namesakes: Vec<Namesakes>,
    /// The agents of the host whose names agents of other hosts also have, at most 64; empty unless the
    /// service is a gateway.
    #[serde(default)]
    pub contested: Vec<ContestedName>,
    /// The configuration with which the service runs, as TOML text by key; empty unless the service is a
    /// gateway. See [`Config::values`](crate::Config::values).
    #[serde(default)]
    pub configuration: BTreeMap<String, String>,
}

/// A name that an agent of this host and an agent of another host have.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct ContestedName {
    /// The name.
    pub name: String,
    /// The gateway of the other agent.
    pub gateway: String,
}

/// A peer in `discovery.static` and its state.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct StaticPeer {
    /// The name of the peer in the configuration.
    pub name: String,
    /// The location at which the peer answers; `None` if it does not answer.
    pub answers: Option<Location>,
    /// The locations that failed in the last attempt, with the reasons.
    pub failures: Vec<(Location, String)>,
    /// Milliseconds until the next attempt; `None` during an attempt.
    pub asked_again_in: Option<u64>,
}

/// A gateway with an open connection.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Connected {
    /// The name of the gateway.
    pub name: String,
    /// The incarnation of the gateway: a random number per start.
    pub incarnation: Incarnation,
    /// The known locations at which the gateway accepts letters.
    pub locations: Vec<Location>,
    /// The number of open connections.
    pub connections: usize,
    /// Seconds since the connection was opened.
    pub seconds: u64,
    /// The security of its connections.
    #[serde(default)]
    pub security: LinkSecurity,
}

/// A connection that a gateway has refused because of keys or of another version of the protocol.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct RefusedConnection {
    /// The address of the peer.
    pub from: IpAddr,
    /// The reason, and the remedy.
    pub why: String,
    /// Seconds since the refusal.
    pub seconds: u64,
}

/// A connection of a gateway that a peer has refused.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct RefusedDial {
    /// The dialed location.
    pub to: Location,
    /// The reason as far as it is known. It may contain text from the peer.
    pub why: String,
    /// Seconds since the refusal.
    pub seconds: u64,
}

/// Gateways with the same name.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Namesakes {
    /// The name.
    pub name: String,
    /// Whether it is the name of the gateway that reports.
    pub is_own: bool,
    /// A location of each other gateway with the name, at most 8.
    pub at: Vec<Location>,
    /// Whether certificates prove all of these gateways. Without, the name is their claim.
    pub is_proved: bool,
}

/// The security of the connections with a gateway. All connections with one gateway have the same.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct LinkSecurity {
    /// Whether letters are encrypted: TLS 1.3, or QUIC.
    pub encrypted: bool,
    /// The fingerprint of the trusted certificate that the gateway has proved, as 64 hexadecimal digits;
    /// `None` without encryption.
    pub certificate: Option<String>,
}

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
) -> Result<Report, AskError> {
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

#[cfg(feature = "net")]
impl From<fipa_transport_net::Refusal> for RefusedConnection {
    fn from(refusal: fipa_transport_net::Refusal) -> Self {
        Self {
            from: refusal.from,
            seconds: refusal.at.elapsed().as_secs(),
            why: refusal.why,
        }
    }
}

#[cfg(feature = "net")]
impl From<fipa_transport_net::RefusedDial> for RefusedDial {
    fn from(refused: fipa_transport_net::RefusedDial) -> Self {
        Self {
            to: refused.to,
            seconds: refused.at.elapsed().as_secs(),
            why: refused.why,
        }
    }
}

/// Returns the agents among the results of a search, without services and coalitions.
pub(crate) fn agents(directory: &dyn Directory, query: &Query) -> Vec<Arc<Entry>> {
    let mut found = directory.search(query);
    found.retain(|entry| entry.role == Role::Agent);
    found
}
