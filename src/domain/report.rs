//! The report of a process about the routes of its letters.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::Arc;
use std::time::Duration;

use fipa_mts::core::{Route, RouteState};
use fipa_sds::{Directory, Entry, Query, Role};
use fipa_transport::{Incarnation, Location};
use serde::{Deserialize, Serialize};

/// The routes of one message transport service.
///
/// Serialized as a JSON object with the names of the fields.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct RouteReport {
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
    /// The hosts that were connected within the last hour and are not connected now, the latest first, at most 64;
    /// empty unless the service is a gateway.
    #[serde(default)]
    pub lost: Vec<LostHost>,
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
    /// The HTTP listener; `None` unless the service is a gateway with `http.listen`.
    #[serde(default)]
    pub http: Option<HttpListener>,
}

/// The HTTP listener of a gateway.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct HttpListener {
    /// The address of `http.listen`, with the port that the system has chosen if the configuration leaves it open.
    pub address: SocketAddr,
    /// The URL at which this host and, beyond loopback, other hosts reach it.
    pub url: String,
    /// The file with the token that clients send.
    pub token_file: String,
    /// The SHA-256 of the certificate that it presents, as 64 hexadecimal digits; `None` without encryption.
    #[serde(default)]
    pub fingerprint: Option<String>,
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

/// A gateway whose last connection has ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct LostHost {
    /// The name of the gateway.
    pub name: String,
    /// Seconds since the end of the connection.
    pub seconds: u64,
    /// The fingerprint of the trusted certificate that the gateway proved; `None` without encryption, where the name
    /// is a claim.
    pub certificate: Option<String>,
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
